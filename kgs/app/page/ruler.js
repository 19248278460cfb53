"use strict";
// Measures the distance between two points of the splat, which a user clicks.

const SHOWN_DIGITS = 2;  // significant ones of the distance that is shown
const DISTANCE_DIGITS = 5;  // likewise of the one that the coordinates in the command have

class Ruler {
  constructor(viewer, frame) {
    this.viewer = viewer;
    this.svg = frame.querySelector(".ruler");
    this.words = frame.querySelector(".measured");
    this.button = frame.querySelector(".measure");
    this.points = [];  // in the world, two at most
    this.isOn = false;
    this.button.addEventListener("click", () => this.toggle());
    viewer.canvas.addEventListener("click", (event) => this.choose(event));
  }

  toggle() {
    this.isOn = !this.isOn;
    this.points = [];
    this.button.setAttribute("aria-pressed", String(this.isOn));
    this.viewer.canvas.classList.toggle("measures", this.isOn);
    this.show(this.isOn ? "Choose two points in the picture." : "");
  }

  choose({ clientX, clientY }) {
    if (!this.isOn || this.viewer.dragged > CLICK_PIXELS) return;
    const point = this.viewer.pointAt(clientX, clientY);
    if (!point) {
      this.show("The splat shows nothing there: choose another point.");
      return;
    }
    if (this.points.length === 2) this.points = [];
    this.points.push(point);
    if (this.points.length === 1) {
      this.show("Choose the second point.");
      return;
    }
    const distance = Math.hypot(...add(...this.points, -1));
    if (distance === 0) {
      this.points.pop();
      return;
    }
    const digits = clamped(DISTANCE_DIGITS - 1 - Math.floor(Math.log10(distance)), 0, 20);
    const offset = this.viewer.scene.offset ?? [0, 0, 0];
    const [a, b] = this.points.map((point) => add(point, offset).map((value) => value.toFixed(digits)).join(","));
    this.show(`${Number(distance.toPrecision(SHOWN_DIGITS))} units apart. With the true length in place of LENGTH, in metres `
      + "say, this command scales splat, cameras and page to it; OUT is the folder of this page, METRES a new one:",
      `kgs scale OUT --by ${a} ${b} LENGTH -o METRES`);
  }

  show(text, command = "") {
    this.words.textContent = text;
    if (command) {
      const code = document.createElement("code");
      for (const part of command.split(/(--\w+)/)) {
        const span = document.createElement("span");
        span.textContent = part;
        span.classList.toggle("option", part.startsWith("--"));  // no line ends inside it
        code.append(span);
      }
      this.words.append(document.createElement("br"), code);
    }
    this.draw();
  }

  draw() {
    const { viewer } = this;
    const { ratio, sides } = viewer.view;
    const seen = this.points.map((point) => viewer.seen(point));
    const isInFront = seen.every((point) => point[2] > 0);
    const pixels = isInFront ? seen.map((point) => viewer.pagePixel(point).split(" ")) : [];
    const [line, ...marks] = this.svg.children;
    this.svg.setAttribute("viewBox", `0 0 ${sides[0] / ratio} ${sides[1] / ratio}`);
    marks.forEach((mark, i) => {
      mark.style.display = pixels[i] ? "" : "none";
      if (pixels[i]) ["cx", "cy"].forEach((name, axis) => mark.setAttribute(name, pixels[i][axis]));
    });
    line.style.display = pixels.length === 2 ? "" : "none";
    if (pixels.length === 2) {
      ["x1", "y1", "x2", "y2"].forEach((name, i) => line.setAttribute(name, pixels.flat()[i]));
    }
  }
}
