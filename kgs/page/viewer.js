"use strict";
// The viewer: turns, moves and zooms an eye over a splat, and flies it to the photos' cameras.
// Axes are those of OpenCV: the rows of a rotation are right, down and forward in the world.

const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const add = (a, b, times = 1) => a.map((value, i) => value + times * b[i]);
const unit = (a) => a.map((value) => value / Math.hypot(...a));
const mix = (a, b, share) => a.map((value, i) => value + share * (b[i] - value));

const CLICK = 4;  // pixels of the page that a pointer may move without dragging

// A vector turned about a unit axis, by radians.
function turned(vector, axis, angle) {
  const c = Math.cos(angle), s = Math.sin(angle), along = dot(axis, vector) * (1 - c), side = cross(axis, vector);
  return vector.map((value, i) => c * value + s * side[i] + along * axis[i]);
}

class Viewer {
  // `scene` has cameras (name, part, size, focal, centre, rotation, position, distance), first (the index of the one
  // that the viewer opens at), up (a unit vector) and pyramid (the depth of the pyramids that stand for cameras).
  constructor(frame, renderer, scene) {
    this.canvas = frame.querySelector("canvas");
    this.overlay = frame.querySelector("svg");
    this.choice = frame.querySelector("select");  // of a camera, for the keyboard too
    Object.assign(this, { renderer, scene, waiting: false, flight: 0, dragged: 0 });
    this.pyramids = scene.cameras.map((camera, index) => this.pyramid(camera, index));
    this.place(scene.first);
    this.listen(frame);
    new ResizeObserver(() => this.ask()).observe(this.canvas);
    this.draw();
  }

  // -- the eye: rotation, position, distance of the point that it turns about, and the lens of a camera

  place(index) {
    const { rotation, position, distance, size, focal, centre } = this.scene.cameras[index];
    this.eye = { rotation, position, distance, size, focal, centre };
    this.choice.value = index;
  }

  flyTo(index) {
    const from = this.eye, begin = performance.now(), flight = ++this.flight;
    this.place(index);
    const to = this.eye, still = matchMedia("(prefers-reduced-motion: reduce)").matches;
    const step = (now) => {
      if (flight !== this.flight) return;  // something else has moved the eye
      const share = still ? 1 : Math.min(1, Math.max(0, now - begin) / 700), eased = share * share * (3 - 2 * share);
      const forward = unit(mix(from.rotation[2], to.rotation[2], eased));
      const right = mix(from.rotation[0], to.rotation[0], eased);
      const down = unit(cross(forward, right));
      this.eye = share === 1 ? to : {
        ...to,
        rotation: [cross(down, forward), down, forward],
        position: mix(from.position, to.position, eased),
        focal: mix(from.focal, to.focal, eased),
        centre: mix(from.centre, to.centre, eased),
      };
      this.draw();
      if (share < 1) requestAnimationFrame(step);
    };
    requestAnimationFrame(step);
  }

  change(values) {
    this.flight++;
    this.eye = { ...this.eye, ...values };
    this.ask();
  }

  target() {
    return add(this.eye.position, this.eye.rotation[2], this.eye.distance);
  }

  // About the upright axis through the target, then about the eye's own horizontal one; never over the top.
  turn(across, along) {
    const { rotation, distance } = this.eye, { up } = this.scene, target = this.target();
    const steep = Math.asin(Math.max(-1, Math.min(1, dot(up, rotation[2])))), most = 1.5;
    const pitch = Math.max(-most, Math.min(most, steep - along)) - steep;
    const rows = rotation.map((row) => turned(turned(row, rotation[0], pitch), up, -across));
    this.change({ rotation: rows, position: add(target, rows[2], -distance) });
  }

  zoom(factor) {
    const distance = this.eye.distance * factor;
    this.change({ distance, position: add(this.target(), this.eye.rotation[2], -distance) });
  }

  // By pixels of the page: what the eye turns about follows the pointer.
  move(x, y) {
    const { rotation, position, distance, focal } = this.eye, units = distance / (focal[0] * this.scale());
    this.change({ position: add(add(position, rotation[0], -x * units), rotation[1], -y * units) });
  }

  // -- drawing

  // Pixels of the page for one of the photo; the whole photo is in the picture.
  scale() {
    const [width, height] = this.eye.size;
    return Math.min(this.canvas.clientWidth / width, this.canvas.clientHeight / height);
  }

  ask() {
    if (this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => { this.waiting = false; this.draw(); });
  }

  draw() {
    const { canvas, eye } = this, ratio = Math.min(2, window.devicePixelRatio || 1);
    const sides = [canvas.clientWidth, canvas.clientHeight].map((side) => Math.max(1, Math.round(side * ratio)));
    this.renderer.resize(...sides);
    const scale = ratio * this.scale();
    const borders = sides.map((side, axis) => (side - scale * eye.size[axis]) / 2);
    this.view = {
      scale, sides, ratio,
      focal: eye.focal.map((value) => scale * value),
      centre: eye.centre.map((value, axis) => borders[axis] + scale * (value + 0.5) - 0.5),
    };
    this.renderer.draw(eye, this.view);
    this.drawPyramids();
  }

  // -- the cameras

  pyramid(camera, index) {
    const shape = document.createElementNS("http://www.w3.org/2000/svg", "path");
    shape.innerHTML = "<title></title>";  // what a pointer that rests on it shows
    shape.firstChild.textContent = `${camera.part} ${camera.name}`;
    shape.setAttribute("class", camera.part === "test" ? "held-out" : "");
    shape.addEventListener("click", () => { if (this.dragged <= CLICK) this.flyTo(index); });
    this.overlay.append(shape);
    return shape;
  }

  drawPyramids() {
    const { rotation, position } = this.eye, { focal, centre, ratio, sides } = this.view;
    this.overlay.setAttribute("viewBox", `0 0 ${sides[0] / ratio} ${sides[1] / ratio}`);
    this.scene.cameras.forEach((camera, index) => {
      const deep = this.scene.pyramid, [width, height] = camera.size;
      const corners = [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]];
      const points = [[0, 0, 0], ...corners.map(([x, y]) => [
        deep * (x - camera.centre[0]) / camera.focal[0], deep * (y - camera.centre[1]) / camera.focal[1], deep,
      ])].map(([x, y, z]) => {
        let world = camera.position;
        [x, y, z].forEach((value, axis) => { world = add(world, camera.rotation[axis], value); });
        return rotation.map((row) => dot(row, add(world, position, -1)));
      });
      // One that the eye is in, or that is partly behind it, is not drawn.
      const seen = points.every((point) => point[2] > 0.2 * deep);
      const [tip, ...base] = points.map(([x, y, z]) => [x, y].map(
        (value, axis) => ((focal[axis] * value / z + centre[axis] + 0.5) / ratio).toFixed(1)).join(" "));
      this.pyramids[index].setAttribute("d", seen
        ? `M${base.join("L")}Z` + base.map((corner) => `M${tip}L${corner}`).join("") : "");
    });
  }

  // -- what the user does

  listen(frame) {
    // Pyramids lie over the canvas; what is done to either reaches the stage.
    const { canvas } = this, stage = frame.querySelector(".stage"), pointers = new Map();
    const spread = () => {
      const [a, b = a] = [...pointers.values()];
      return { middle: [(a[0] + b[0]) / 2, (a[1] + b[1]) / 2], apart: Math.hypot(a[0] - b[0], a[1] - b[1]) };
    };
    stage.addEventListener("pointerdown", (event) => {
      if (!pointers.size) this.dragged = 0;
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
    });
    stage.addEventListener("pointermove", (event) => {
      if (!event.buttons) pointers.delete(event.pointerId);  // let go of outside
      if (!pointers.has(event.pointerId)) return;
      const before = spread();
      pointers.set(event.pointerId, [event.clientX, event.clientY]);
      const after = spread(), [x, y] = add(after.middle, before.middle, -1);
      this.dragged += Math.hypot(x, y);
      if (this.dragged > CLICK) stage.setPointerCapture(event.pointerId);  // before that a click belongs to a pyramid
      if (pointers.size > 1 || event.shiftKey || event.buttons > 1) this.move(x, y);
      else this.turn(0.005 * x, 0.005 * y);
      if (pointers.size > 1 && after.apart > 0) this.zoom(before.apart / after.apart);
    });
    for (const end of ["pointerup", "pointercancel"]) {
      stage.addEventListener(end, (event) => pointers.delete(event.pointerId));
    }
    stage.addEventListener("contextmenu", (event) => event.preventDefault());
    stage.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(Math.max(-0.3, Math.min(0.3, 0.0015 * event.deltaY))));
    }, { passive: false });
    canvas.addEventListener("keydown", (event) => {
      if (event.ctrlKey || event.metaKey || event.altKey) return;  // the browser's own
      const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
      const nearer = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 }[event.key];
      if (arrow && event.shiftKey) this.move(-20 * arrow[0], -20 * arrow[1]);
      else if (arrow) this.turn(0.06 * arrow[0], 0.06 * arrow[1]);
      else if (nearer) this.zoom(nearer);
      else if (event.key === "0" || event.key === "Home") this.flyTo(this.scene.first);
      else return;
      event.preventDefault();
    });
    const pyramids = frame.querySelector(".pyramids");
    this.choice.addEventListener("change", () => this.flyTo(Number(this.choice.value)));
    frame.querySelector(".start").addEventListener("click", () => this.flyTo(this.scene.first));
    pyramids.addEventListener("click", () => {
      const hidden = this.overlay.toggleAttribute("hidden");
      pyramids.setAttribute("aria-pressed", String(!hidden));
    });
    const full = frame.querySelector(".full");
    full.hidden = !document.fullscreenEnabled;
    full.addEventListener("click", () => {
      if (document.fullscreenElement) document.exitFullscreen();
      else frame.requestFullscreen();
    });
  }
}

async function openViewer() {
  const frame = document.querySelector(".viewer"), canvas = frame.querySelector("canvas");
  const text = (id) => document.getElementById(id).textContent;
  const { layout, content, scene, settings } = JSON.parse(text("splat"));
  const shaders = {
    splatVertex: text("splat-vertex"), splatFragment: text("splat-fragment"),
    screenVertex: text("screen-vertex"), screenFragment: text("screen-fragment"),
  };
  const say = (state, words = "") => {
    frame.dataset.state = state;
    frame.querySelector(".failure").textContent = words;
  };
  const attempt = async (work) => {
    try {
      await work();
      say("ready");
    } catch (error) {
      say("failed", `The viewer cannot run here: ${error.message}.`);
    }
  };
  let splat;
  const renderer = () => new SplatRenderer(canvas, splat, shaders, settings);
  await attempt(async () => {
    splat = await decodeSplat(layout, content);
    window.viewer = new Viewer(frame, renderer(), scene);
  });
  // Browsers take the graphics from pages that nobody looks at, and give them back.
  canvas.addEventListener("webglcontextlost", (event) => {
    event.preventDefault();  // else they stay away
    say("lost", "The browser has taken back its graphics for now.");
  });
  canvas.addEventListener("webglcontextrestored", () => attempt(() => {
    viewer.renderer = renderer();
    viewer.draw();
  }));
}

openViewer();
