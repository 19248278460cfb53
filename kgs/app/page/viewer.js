"use strict";
// The viewer: an eye that turns around a splat, moves, zooms, and flies to the cameras of the photos and along them, on
// the path of the film: slowly until it is touched, and at the speed of the film where one plays it. It turns as far
// around the splat as the cameras of the film do, unless it may roam.
// OpenCV axes: the rows of a rotation are the directions right, down and forward in the world.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const add = (a, b, factor = 1) => a.map((value, i) => value + factor * b[i]);
const normalised = (a) => a.map((value) => value / Math.hypot(...a));
const interpolated = (a, b, share) => a.map((value, i) => value + share * (b[i] - value));
const clamped = (value, min, max) => Math.min(max, Math.max(min, value));

const CLICK_PIXELS = 4;  // a pointer that moves farther than this drags
const FLIGHT_MILLISECONDS = 700;
const STEEPEST = 1.5;  // largest angle above or below the horizon, in radians
const ROAMING_ARC = Math.PI;  // radians that a drag across the stage turns where the cameras set no limit
const SOFT_END = 0.1;  // where the eye turns less and less, at either end of the arc, as a share of the arc
const MIN_COVERAGE = 1 / 3;  // of the stage, by the splat: where the eye roams to
const MIN_PART = 1 / 2;  // likewise, of what it covers from the photo's camera, where that is less
const ROAMING_STEP = 0.1;  // radians: how finely this is tested
const NEAR_CAMERA = 0.02;  // of the distance: an eye farther than this from all cameras is beside them
const NEAREST = 1 / 4;  // of the distance to the surface ahead: where zooming in ends
const FARTHEST = 3;  // times the distance at the camera that the eye last jumped to
const SLOW_SECONDS_PER_CAMERA = 4;  // of a tour that nobody asked for
const TOUR_BEGIN_SECONDS = 2;  // in which the eye joins the path
const TOUR_STILL_SECONDS = 1.5;  // of each picture, where the system asks for less motion
const LONGEST_FRAME_SECONDS = 0.1;  // of a tour: it goes on where it was after a pause
const TURN_PER_KEY = 0.06;
const MOVE_PER_KEY = 20;  // pixels
const ZOOM_PER_KEY = 0.9;
const ZOOM_PER_WHEEL_PIXEL = 0.0015;  // natural logarithm of the distance
const MAX_ZOOM_PER_WHEEL_EVENT = 0.3;
const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
const ZOOM_KEYS = { "+": ZOOM_PER_KEY, "=": ZOOM_PER_KEY, "-": 1 / ZOOM_PER_KEY };

// A vector rotated about an axis of length 1, by an angle in radians (Rodrigues' formula).
function rotated(vector, axis, angle) {
  const cosine = Math.cos(angle), sine = Math.sin(angle);
  const along = (1 - cosine) * dot(axis, vector);
  const side = cross(axis, vector);
  return vector.map((value, i) => cosine * value + sine * side[i] + along * axis[i]);
}

// The part of a change of an angle that is left near the ends of an arc: less and less, down to nothing.
function softened(change, angle, [low, high]) {
  const left = change > 0 ? high - angle : angle - low;
  const share = clamped(left / (SOFT_END * (high - low)), 0, 1);
  return clamped(angle + share * change, Math.min(angle, low), Math.max(angle, high)) - angle;
}

const wantsLessMotion = () => matchMedia("(prefers-reduced-motion: reduce)").matches;

// The point that an eye turns around.
function target({ position, rotation, distance }) {
  return add(position, rotation[2], distance);
}

class Viewer {
  // `scene` is what `viewer_scene` of kgs/app/page/cameras.py returns, and `offset`, the origin of its coordinates in
  // those of the splat's file.
  constructor(frame, renderer, scene) {
    this.frame = frame;
    this.canvas = frame.querySelector("canvas");
    this.overlay = frame.querySelector("svg");
    this.strip = frame.querySelector(".strip");  // of thumbnails
    this.thumbnails = new Map([...this.strip.children].map((button) => [Number(button.dataset.camera), button]));
    this.renderer = renderer;
    this.scene = scene;
    this.redrawRequested = false;
    this.flight = null;  // where and when a flight to the eye began, while it goes on
    this.dragged = 0;  // pixels since the pointer was pressed
    this.pyramids = scene.cameras.map((camera, index) => this.addPyramid(camera, index));
    this.quarters = 0;  // by which all pictures are turned clockwise
    this.isRoaming = false;
    this.isEngaged = false;  // the last press of a pointer was on the stage
    this.tour = null;  // the latest one, while it goes on
    this.playButton = frame.querySelector(".play");
    this.jumpTo(scene.first);
    this.listen(frame);
    this.ruler = new Ruler(this, frame);
    new ResizeObserver(() => this.requestDraw()).observe(this.canvas);
    this.draw();
    if (!wantsLessMotion()) this.flyTour(this.slowRound());
  }

  // -- The eye: rotation, position, distance to the point that it turns around, and the intrinsics of a photo's camera.

  // Puts the eye at a camera at once.
  jumpTo(index) {
    const { rotation, position, distance, size, focal, centre } = this.scene.cameras[index];
    this.eye = { rotation, position, distance, size, focal, centre };
    this.usualDistance = distance;
    this.flight = null;
    this.surface = distance;  // ahead of the eye at the usual distance, as it was last measured; at most that
    this.chosen = index;
    this.mark(index);
    this.usualCoverage = null;  // not measured yet
    this.roamedTo = null;  // the last direction in which the splat was found to cover twice what is enough
  }

  // Marks the thumbnail of the photo that the eye is at, or none, and brings it into the strip's view.
  mark(index) {
    this.strip.querySelector("[aria-current]")?.removeAttribute("aria-current");
    const button = this.thumbnails.get(index);
    if (!button) return;
    button.setAttribute("aria-current", "true");
    for (const other of this.thumbnails.values()) other.tabIndex = other === button ? 0 : -1;
    const { strip } = this;
    strip.scrollTo({
      left: button.offsetLeft - (strip.clientWidth - button.offsetWidth) / 2,
      top: button.offsetTop - (strip.clientHeight - button.offsetHeight) / 2,
      behavior: wantsLessMotion() ? "instant" : "smooth",
    });
  }

  // Moves the eye to a camera smoothly. What turns or moves it meanwhile changes where the flight ends.
  flyTo(index) {
    const from = this.eyeInFlight();
    this.endTour();
    this.jumpTo(index);
    if (!wantsLessMotion()) this.flight = { from, begin: performance.now() };
    this.requestDraw();
  }

  // The eye, or where it is on its way there.
  eyeInFlight() {
    if (!this.flight) return this.eye;
    const { from, begin } = this.flight;
    const time = clamped((performance.now() - begin) / FLIGHT_MILLISECONDS, 0, 1);
    if (time === 1) this.flight = null;
    return this.between(from, this.eye, time * time * (3 - 2 * time));
  }

  // The eye on the way between two others; `share` is 0 at the first and 1 at the second.
  between(from, to, share) {
    if (share === 1) return to;
    const forward = normalised(interpolated(from.rotation[2], to.rotation[2], share));
    const right = interpolated(from.rotation[0], to.rotation[0], share);
    const down = normalised(cross(forward, right));
    return {
      ...to,
      rotation: [cross(down, forward), down, forward],
      position: interpolated(from.position, to.position, share),
      focal: interpolated(from.focal, to.focal, share),
      centre: interpolated(from.centre, to.centre, share),
    };
  }

  // Seconds of a round of the tour at which one can look at the scene in peace.
  slowRound() {
    const stops = this.scene.cameras.filter((camera) => camera.part !== "test").length;
    return SLOW_SECONDS_PER_CAMERA * clamped(stops, 2, 12);  // of more, kgs/app/files/film.py skips some
  }

  // Moves the eye along the cameras of the film, around and around, from where it is until something else moves it. Where
  // the system asks for less motion, it shows one picture after the other instead.
  flyTour(secondsPerRound) {
    const { poses } = this.scene.tour;
    const begin = { ...this.eyeInFlight(), distance: this.usualDistance };
    const distances = poses.map(({ position }) => Math.hypot(...add(position, begin.position, -1)));
    const start = distances.indexOf(Math.min(...distances));
    const still = wantsLessMotion() ? Math.ceil(TOUR_STILL_SECONDS * poses.length / secondsPerRound) : 0;
    const tour = {};
    let isVisible = true, seconds = 0, before = null;
    const observer = new IntersectionObserver((entries) => {
      isVisible = entries[entries.length - 1].isIntersecting;
    });
    observer.observe(this.canvas);
    this.flight = null;
    this.mark(null);
    this.tour = tour;
    const pose = (index) => ({ ...begin, ...poses[(start + index) % poses.length] });
    const eyeAt = (seconds) => {
      const onTour = poses.length * seconds / secondsPerRound;
      if (still) return pose(still * Math.floor(onTour / still));
      const begun = Math.min(1, seconds / TOUR_BEGIN_SECONDS);
      const onPath = this.between(pose(Math.floor(onTour)), pose(Math.floor(onTour) + 1), onTour % 1);
      return this.between(begin, onPath, begun * begun * (3 - 2 * begun));
    };
    const step = (now) => {
      if (tour !== this.tour) {
        observer.disconnect();
        return;
      }
      if (isVisible && before !== null) {
        seconds += Math.min(LONGEST_FRAME_SECONDS, (now - before) / 1000);
        this.eye = eyeAt(seconds);
        this.draw();
      }
      before = now;
      requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  endTour() {
    this.tour = null;
    this.playButton.setAttribute("aria-pressed", "false");
  }

  // Begins the tour at the speed of the film, or ends it; returns whether it goes on.
  playOrEnd() {
    const isPlaying = this.playButton.getAttribute("aria-pressed") === "true";
    if (isPlaying) this.endTour();
    else this.flyTour(this.scene.tour.seconds);
    return !isPlaying;
  }

  change(values) {
    this.endTour();
    this.mark(null);
    this.eye = { ...this.eye, ...values };
    this.requestDraw();
  }

  // Radians that the eye turns by for one pixel of a drag: across the stage it is the arc of the cameras.
  turnPerPixel() {
    const { yaw } = this.scene.arc;
    return (yaw && !this.isRoaming ? yaw[1] - yaw[0] : ROAMING_ARC) / Math.max(1, this.canvas.clientWidth);
  }

  // Turns the eye around its target by angles in radians: `yaw` about the upright axis, `pitch` about the horizontal.
  turn(yaw, pitch) {
    const farthest = Math.max(Math.abs(yaw), Math.abs(pitch));
    const steps = this.isRoaming ? Math.max(1, Math.ceil(farthest / ROAMING_STEP)) : 1;
    let { eye } = this;
    for (let i = 0; i < steps; i++) {
      const next = this.turned(eye, yaw / steps, pitch / steps);
      if (this.isRoaming && !this.showsEnough(next, eye)) break;
      eye = next;
    }
    this.change(eye);
  }

  // Whether the splat covers enough of the stage there, or at least not less than from `before`.
  showsEnough(eye, before) {
    const ahead = eye.rotation[2];
    if (this.roamedTo && dot(ahead, this.roamedTo) > Math.cos(ROAMING_STEP / 2)) return true;
    const coverage = (from) => this.renderer.coverage(this.withNearPlane(from), this.viewOf(from));
    this.usualCoverage ??= coverage(this.scene.cameras[this.chosen]);
    const farther = Math.max(1, eye.distance / this.usualDistance);
    const enough = Math.min(MIN_COVERAGE, MIN_PART * this.usualCoverage) / farther ** 2;
    const covered = coverage(eye);
    if (covered >= 2 * enough) this.roamedTo = ahead;
    return covered >= enough || covered >= coverage(before);
  }

  // An eye that is turned around its target.
  turned(eye, yaw, pitch) {
    const { rotation, distance } = eye;
    const { up, arc } = this.scene;
    const back = rotation[2].map((value) => -value);
    const elevation = Math.asin(clamped(dot(up, back), -1, 1));
    let [around, raised] = [-yaw, pitch];
    if (!this.isRoaming) {
      raised = softened(raised, elevation, arc.pitch);
      if (arc.yaw) {
        const angle = Math.atan2(dot(up, cross(arc.origin, back)), dot(arc.origin, back));
        const turns = Math.round(((arc.yaw[0] + arc.yaw[1]) / 2 - angle) / (2 * Math.PI));
        around = softened(around, angle + 2 * Math.PI * turns, arc.yaw);
      }
    }
    raised = clamped(elevation + raised, -STEEPEST, STEEPEST) - elevation;
    const rows = rotation.map((row) => rotated(rotated(row, rotation[0], -raised), up, around));
    return { ...eye, rotation: rows, position: add(target(eye), rows[2], -distance) };
  }

  // Multiplies the distance to the target; the eye stays before the surface ahead.
  zoom(factor) {
    if (this.measured !== this.eye) this.surface = this.surfaceAhead();
    const nearest = this.usualDistance - (1 - NEAREST) * this.surface;
    this.change(this.atDistance(clamped(this.eye.distance * factor, nearest, FARTHEST * this.usualDistance)));
    this.measured = this.eye;  // it moves along its axis only
  }

  // The eye at another distance to its target.
  atDistance(distance) {
    return { ...this.eye, distance, position: add(target(this.eye), this.eye.rotation[2], -distance) };
  }

  // The distance to the surface on the axis of the eye, from the usual distance to the target, or the latter if less.
  surfaceAhead() {
    const eye = this.withNearPlane(this.atDistance(this.usualDistance));
    const view = this.viewOf(eye);
    return Math.min(this.renderer.medianDepth(eye, view, view.centre) ?? Infinity, this.usualDistance);
  }

  // Moves the eye sideways so that its target follows the pointer, by pixels of the page.
  move(x, y) {
    const { rotation, position, distance, focal } = this.eye;
    const unitsPerPixel = distance / (focal[0] * this.scale());
    const sideways = add(position, rotation[0], -x * unitsPerPixel);
    this.change({ position: add(sideways, rotation[1], -y * unitsPerPixel) });
  }

  // Turns all pictures clockwise by a quarter, where photos lie on their side: right, down = -down, right.
  rollQuarter() {
    const { scene } = this;
    this.flight = null;  // it would begin at pictures that are not turned
    const turnedFrame = ([right, down, forward]) => [down.map((value) => -value), right, forward];
    const turned = ({ rotation, size: [width, height], focal: [fx, fy], centre: [cx, cy], ...rest }) => ({
      ...rest, rotation: turnedFrame(rotation), size: [height, width], focal: [fy, fx], centre: [height - 1 - cy, cx],
    });
    if (!this.quarters) this.uprights = [{ up: scene.up, arc: scene.arc }, ...scene.turned];
    this.quarters = (this.quarters + 1) % 4;
    this.scene = {
      ...scene, ...this.uprights[this.quarters], cameras: scene.cameras.map(turned),
      tour: {
        ...scene.tour, poses: scene.tour.poses.map((pose) => ({ ...pose, rotation: turnedFrame(pose.rotation) })),
      },
    };
    this.change(turned(this.eye));
    document.documentElement.style.setProperty("--aspect", this.eye.size.join(" / "));
    this.strip.style.setProperty("--quarters", this.quarters);
    this.strip.classList.toggle("on-side", this.quarters % 2 === 1);
  }

  // -- Drawing.

  // Pixels of the page per pixel of the photo, such that the whole photo is inside the canvas.
  scale() {
    const [width, height] = this.eye.size;
    return Math.min(this.canvas.clientWidth / width, this.canvas.clientHeight / height);
  }

  // The lens of an eye in pixels of the canvas.
  viewOf({ size, focal, centre }) {
    const { canvas } = this;
    const ratio = Math.min(2, window.devicePixelRatio || 1);  // pixels of the canvas per pixel of the page
    const sides = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    const scale = ratio * this.scale();
    const borders = sides.map((side, axis) => (side - scale * size[axis]) / 2);
    return {
      scale,
      ratio,
      sides,
      focal: focal.map((value) => scale * value),
      centre: centre.map((value, axis) => borders[axis] + scale * (value + 0.5) - 0.5),  // integer pixel centres
    };
  }

  // An eye with its near plane: that of the fit at a photo's camera, farther away beside it, and as
  // much nearer as the surface ahead where it zooms in.
  withNearPlane(eye) {
    const { nearPlane, farNearPlane } = this.renderer.settings;
    const distances = this.scene.cameras.map(({ position }) => Math.hypot(...add(position, eye.position, -1)));
    const share = clamped(Math.min(...distances) / (NEAR_CAMERA * eye.distance), 0, 1);
    const zoomed = clamped(1 - (this.usualDistance - eye.distance) / this.surface, 0, 1);
    return { ...eye, nearPlane: nearPlane + zoomed * share * (farNearPlane - nearPlane) };
  }

  // Draws with the next frame of the browser, once.
  requestDraw() {
    if (this.redrawRequested) return;
    this.redrawRequested = true;
    requestAnimationFrame(() => {
      this.redrawRequested = false;
      this.draw();
    });
  }

  draw() {
    const eye = this.eyeInFlight();
    this.drawn = eye;
    this.view = this.viewOf(eye);
    this.renderer.resize(...this.view.sides);
    this.renderer.draw(this.withNearPlane(eye), this.view);
    this.drawPyramids();
    this.ruler.draw();
    if (this.flight) this.requestDraw();
  }

  // -- The pyramids that mark the cameras.

  addPyramid(camera, index) {
    const path = document.createElementNS("http://www.w3.org/2000/svg", "path");
    path.innerHTML = "<title></title>";  // shown while a pointer rests on it
    path.firstChild.textContent = camera.label;
    path.setAttribute("class", camera.part === "test" ? "held-out" : "");
    path.addEventListener("click", () => {
      if (this.dragged <= CLICK_PIXELS) this.flyTo(index);
    });
    this.overlay.append(path);
    return path;
  }

  drawPyramids() {
    const { ratio, sides } = this.view;
    this.overlay.setAttribute("viewBox", `0 0 ${sides[0] / ratio} ${sides[1] / ratio}`);
    this.scene.cameras.forEach((camera, index) => {
      this.pyramids[index].setAttribute("d", this.outline(camera));
    });
  }

  // The pyramid of a camera as an SVG path; empty if the eye is inside it or part of it is behind the eye.
  outline(camera) {
    const depth = this.scene.pyramid;
    const [width, height] = camera.size;
    const corners = [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]];
    const base = corners.map((corner) => {
      const [x, y] = corner.map((value, axis) => depth * (value - camera.centre[axis]) / camera.focal[axis]);
      const [right, down, forward] = camera.rotation;
      return add(add(add(camera.position, right, x), down, y), forward, depth);
    });
    const points = [camera.position, ...base].map((point) => this.seen(point));
    if (points.some((point) => point[2] <= 0.2 * depth)) return "";
    const [tip, ...rectangle] = points.map((point) => this.pagePixel(point));
    return `M${rectangle.join("L")}Z` + rectangle.map((corner) => `M${tip}L${corner}`).join("");
  }

  // A point of the world in the axes of the eye.
  seen(point) {
    const relative = add(point, this.drawn.position, -1);
    return this.drawn.rotation.map((row) => dot(row, relative));
  }

  // A point in the axes of the eye as "x y" in pixels of the page.
  pagePixel([x, y, z]) {
    const { focal, centre, ratio } = this.view;
    const pixel = [x, y].map((value, axis) => (focal[axis] * value / z + centre[axis] + 0.5) / ratio);
    return pixel.map((value) => value.toFixed(1)).join(" ");
  }

  // The point of the splat that a pixel of the page shows, in the world; null where the splat lets more than half of the
  // light through.
  pointAt(clientX, clientY) {
    const { left, top } = this.canvas.getBoundingClientRect();
    const { ratio, focal, centre } = this.view;
    const { rotation: [right, down, forward], position } = this.drawn;
    const pixel = [clientX - left, clientY - top].map((value) => ratio * value - 0.5);  // integer pixel centres
    const depth = this.renderer.medianDepth(this.withNearPlane(this.drawn), this.view, pixel);
    if (depth === null) return null;
    const [x, y] = pixel.map((value, axis) => depth * (value - centre[axis]) / focal[axis]);
    return add(add(add(position, right, x), down, y), forward, depth);
  }

  // -- Input.

  listen(frame) {
    this.listenToPointers(frame.querySelector(".stage"));  // which holds the canvas and, over it, the pyramids
    this.listenToKeys();
    this.listenToStrip();
    this.listenToTools(frame);
  }

  listenToPointers(stage) {
    const pointers = new Map();  // positions of those that are pressed
    const gesture = () => {
      const [a, b = a] = [...pointers.values()];
      return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], spread: Math.hypot(a[0] - b[0], a[1] - b[1]) };
    };
    document.addEventListener("pointerdown", (event) => {
      this.isEngaged = stage.contains(event.target);
    });
    stage.addEventListener("pointerdown", (event) => {
      this.endTour();
      if (!pointers.size) this.dragged = 0;
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    stage.addEventListener("pointermove", (event) => {
      if (!event.buttons) pointers.delete(event.pointerId);  // released outside of the window
      if (!pointers.has(event.pointerId)) return;
      const before = gesture();
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      const after = gesture();
      const [x, y] = add(after.middle, before.middle, -1);
      this.dragged += Math.hypot(x, y);
      // Captured earlier, a pyramid would not get its click.
      if (this.dragged > CLICK_PIXELS) stage.setPointerCapture(event.pointerId);
      if (pointers.size > 1 || event.shiftKey || event.buttons > 1) this.move(x, y);
      else this.turn(this.turnPerPixel() * x, this.turnPerPixel() * y);
      if (pointers.size > 1 && after.spread > 0) this.zoom(before.spread / after.spread);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      stage.addEventListener(end, (event) => pointers.delete(event.pointerId));
    }
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => {
      if (!this.isEngaged && !document.fullscreenElement) return;  // the page scrolls
      event.preventDefault();
      const logarithm = ZOOM_PER_WHEEL_PIXEL * event.deltaY;
      this.zoom(Math.exp(clamped(logarithm, -MAX_ZOOM_PER_WHEEL_EVENT, MAX_ZOOM_PER_WHEEL_EVENT)));
    }, { passive: false });
  }

  listenToKeys() {
    this.canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;  // shortcuts of the browser
      const arrow = ARROWS[event.key];
      if (arrow && event.shiftKey) this.move(-MOVE_PER_KEY * arrow[0], -MOVE_PER_KEY * arrow[1]);
      else if (arrow) this.turn(TURN_PER_KEY * arrow[0], TURN_PER_KEY * arrow[1]);
      else if (event.key in ZOOM_KEYS) this.zoom(ZOOM_KEYS[event.key]);
      else if (event.key.toLowerCase() === "r") this.rollQuarter();
      else if (event.key === "0" || event.key === "Home") this.flyTo(this.scene.first);
      else return;
      event.preventDefault();
    });
  }

  // Tab leads to one thumbnail, and arrow keys from it to the others.
  listenToStrip() {
    const buttons = [...this.thumbnails.values()];
    if (buttons.length && !buttons.some((button) => button.tabIndex === 0)) buttons[0].tabIndex = 0;
    this.thumbnails.forEach((button, index) => button.addEventListener("click", () => this.flyTo(index)));
    this.strip.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;
      const here = buttons.indexOf(event.target);
      const [right, down] = ARROWS[event.key] ?? [0, 0];
      const next = { Home: 0, End: buttons.length - 1 }[event.key] ?? clamped(here + right + down, 0, buttons.length - 1);
      if (next === here) return;
      event.preventDefault();
      buttons[next].focus();
      buttons[next].click();
    });
  }

  listenToTools(frame) {
    frame.querySelector(".start").addEventListener("click", () => this.flyTo(this.scene.first));
    const addSwitch = (name, toggle, state = "aria-pressed") => {
      const button = frame.querySelector(name);
      button.addEventListener("click", () => button.setAttribute(state, String(toggle())));
    };
    addSwitch(".play", () => this.playOrEnd());
    addSwitch(".roam", () => this.isRoaming = !this.isRoaming);
    addSwitch(".pyramids", () => !this.overlay.toggleAttribute("hidden"));
    addSwitch(".unfold", () => !frame.querySelector(".more").toggleAttribute("hidden"), "aria-expanded");
    frame.querySelector(".quarter").addEventListener("click", () => this.rollQuarter());
    const full = frame.querySelector(".full");
    full.hidden = !document.fullscreenEnabled;
    full.addEventListener("click", () => {
      if (document.fullscreenElement) document.exitFullscreen();
      else frame.requestFullscreen();
    });
  }
}

async function openViewer() {
  const frame = document.querySelector(".viewer");
  const canvas = frame.querySelector("canvas");
  const text = (id) => document.getElementById(id).textContent;
  const { layout, content, scene, settings } = JSON.parse(text("splat"));
  const shaders = {
    splatVertex: text("splat-vertex"),
    splatFragment: text("splat-fragment"),
    screenVertex: text("screen-vertex"),
    screenFragment: text("screen-fragment"),
  };
  const show = (state, message = "") => {
    frame.dataset.state = state;
    frame.querySelector(".failure").textContent = message;
  };
  const attempt = async (work) => {
    try {
      await work();
      show("ready");
    } catch (error) {
      show("failed", `The viewer cannot run here: ${error.message}.`);
    }
  };
  const newRenderer = (splat) => new SplatRenderer(canvas, splat, shaders, settings);
  await attempt(async () => {
    window.viewer = new Viewer(frame, newRenderer(await decodeSplat(layout, content)), scene);
  });
  // Browsers release the graphics context of pages in the background, and restore it later.
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();  // otherwise it is not restored
    show("lost", "The browser has released the graphics of this page for now.");
  });
  canvas.addEventListener("webglcontextrestored", () => attempt(() => {
    viewer.renderer = newRenderer(viewer.renderer.splat);
    viewer.draw();
  }));
}

openViewer();
