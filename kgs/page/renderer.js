"use strict";
// Decodes a splat (the layout is described in kgs/page/data.py) and draws it with WebGL2, sorted, back to front.

const TEXELS_PER_ROW = 2048;

async function decodeSplat(layout, base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const { count, degree } = layout, coefficients = (degree + 1) ** 2;
  const columns = {};
  let start = 0;
  for (const [name, width, low, step] of layout.columns) {
    const values = columns[name] = new Float64Array(count);
    for (let plane = 0; plane < width; plane++, start += count) {
      for (let i = 0; i < count; i++) values[i] = 256 * values[i] + planes[start + i];
    }
    for (let i = 0; i < count; i++) values[i] = low + step * values[i];
  }

  const texels = (each) => new Float32Array(4 * TEXELS_PER_ROW * Math.ceil(Math.max(1, each * count) / TEXELS_PER_ROW));
  const geometry = texels(3), harmonics = texels(coefficients);
  const turn = [0, 0, 0, 0];
  for (let i = 0; i < count; i++) {
    const largest = columns.largest[i];
    let rest = 1;
    for (let axis = 0; axis < 3; axis++) {
      const value = columns["quat" + axis][i];
      turn[axis + (axis >= largest)] = value;
      rest -= value * value;
    }
    turn[largest] = Math.sqrt(Math.max(rest, 0));
    const [w, x, y, z] = turn;
    const axes = [  // columns of the rotation
      [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
      [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
      [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
    ];
    geometry.set([columns.x[i], columns.y[i], columns.z[i], columns.opacity[i]], 12 * i);
    for (let axis = 0; axis < 3; axis++) {
      const variance = Math.exp(2 * columns["scale" + axis][i]), [a, b, c] = axes[axis];
      [a * a, a * b, a * c, b * b, b * c, c * c].forEach((part, k) => geometry[12 * i + 4 + k] += variance * part);
    }
  }
  for (let k = 0; k < coefficients; k++) {
    ["r", "g", "b"].forEach((channel, place) => {
      const column = columns["sh" + k + channel];
      for (let i = 0; i < count; i++) harmonics[4 * (i * coefficients + k) + place] = column[i] * Math.abs(column[i]);
    });
  }
  return { count, coefficients, geometry, harmonics };
}

// An order of the depths from far to near, exact: two counting sorts by 16 of the 32 bits of a positive float.
class DepthOrder {
  constructor(count) {
    this.depths = new Float32Array(count);
    this.bits = new Uint32Array(this.depths.buffer);
    this.orders = [new Uint32Array(count), new Uint32Array(count)];
  }

  // Gaussians beyond the near plane, the farthest first; an array that the next call overwrites.
  sort(geometry, rotation, position, nearPlane) {
    const [x, y, z] = rotation[2], [px, py, pz] = position, { depths, bits } = this;
    let [from, to] = this.orders, count = 0;
    for (let i = 0; i < depths.length; i++) {
      const depth = x * (geometry[12 * i] - px) + y * (geometry[12 * i + 1] - py) + z * (geometry[12 * i + 2] - pz);
      depths[i] = depth;
      if (depth > nearPlane) from[count++] = i;
    }
    for (const shift of [0, 16]) {
      const places = new Uint32Array(65537);
      for (let k = 0; k < count; k++) places[65535 - ((bits[from[k]] >>> shift) & 65535) + 1]++;
      for (let digit = 0; digit < 65536; digit++) places[digit + 1] += places[digit];
      for (let k = 0; k < count; k++) to[places[65535 - ((bits[from[k]] >>> shift) & 65535)]++] = from[k];
      [from, to] = [to, from];
    }
    return from.subarray(0, count);
  }
}

class SplatRenderer {
  // `shaders` holds the sources by name.
  // `settings` has nearPlane, lowPass (in square pixels of a photo), margin (a share of the photo's size) and background.
  constructor(canvas, splat, shaders, settings) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
    if (!gl) throw new Error("this browser has no WebGL2");
    Object.assign(this, { canvas, gl, splat, settings });
    this.order = new DepthOrder(splat.count);
    this.fine = Boolean(gl.getExtension("EXT_color_buffer_float"));  // else blending has 8 bits
    this.program = this.link(shaders.splatVertex, shaders.splatFragment);
    this.screen = this.link(shaders.screenVertex, shaders.screenFragment);
    this.upload(0, gl.RGBA32F, splat.geometry);
    this.upload(1, gl.RGBA16F, splat.harmonics);
    this.corners = this.attribute("corner", 0);
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.indices = this.attribute("gaussian", 1);
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.target = gl.createTexture());
    this.frame = gl.createFramebuffer();
  }

  link(...sources) {
    const { gl } = this, program = gl.createProgram();
    [gl.VERTEX_SHADER, gl.FRAGMENT_SHADER].forEach((kind, i) => {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, sources[i]);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    });
    gl.bindAttribLocation(program, 0, "corner");
    gl.bindAttribLocation(program, 1, "gaussian");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  upload(unit, format, values) {
    const { gl } = this;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, format, TEXELS_PER_ROW, values.length / 4 / TEXELS_PER_ROW, 0,
      gl.RGBA, gl.FLOAT, values);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }

  attribute(name, place) {
    const { gl } = this, buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(place);
    return buffer;
  }

  // Makes the canvas so many pixels large.
  resize(width, height) {
    const { canvas, gl } = this;
    if (canvas.width === width && canvas.height === height && this.sized) return;
    [canvas.width, canvas.height, this.sized] = [width, height, true];
    gl.activeTexture(gl.TEXTURE2);
    gl.texImage2D(gl.TEXTURE_2D, 0, this.fine ? gl.RGBA16F : gl.RGBA8, width, height, 0,
      gl.RGBA, this.fine ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.target, 0);
  }

  // The tangents x/z and y/z, at the first and at the last border of the photo and a margin outside it: kgs holds the
  // footprint's slope between them. They depend on the photo's frame, not on the shape of the canvas.
  tangentLimits({ size, focal, centre }) {
    const { margin } = this.settings;
    return [
      size.map((side, axis) => (-0.5 - margin * side - centre[axis]) / focal[axis]),
      size.map((side, axis) => (side - 0.5 + margin * side - centre[axis]) / focal[axis]),
    ];
  }

  // Draws what `eye` sees: it has rotation (rows), position, and size, focal and centre in pixels of the photo.
  // `view` has focal and centre in pixels of the canvas, and scale: how many of these a pixel of the photo takes.
  draw(eye, view) {
    const { gl, canvas, settings, program } = this, { width, height } = canvas;
    const uniform = (kind, name, ...value) => gl["uniform" + kind](gl.getUniformLocation(program, name), ...value);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.frame);
    gl.viewport(0, 0, width, height);
    gl.clearColor(...settings.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);
    gl.useProgram(program);
    uniform("1i", "geometry", 0);
    uniform("1i", "harmonics", 1);
    uniform("1i", "texelsPerRow", TEXELS_PER_ROW);
    uniform("1i", "coefficients", this.splat.coefficients);
    uniform("Matrix3fv", "rotation", true, eye.rotation.flat());
    uniform("3f", "position", ...eye.position);
    uniform("2f", "focal", ...view.focal);
    uniform("2f", "centre", ...view.centre);
    uniform("2f", "size", width, height);
    const [leastTangent, largestTangent] = this.tangentLimits(eye);
    uniform("2f", "leastTangent", ...leastTangent);
    uniform("2f", "largestTangent", ...largestTangent);
    uniform("1f", "nearPlane", settings.nearPlane);
    // The low-pass filter grows with the picture: a larger one shows the splat as it was fitted, only larger.
    uniform("1f", "lowPass", settings.lowPass * Math.max(1, view.scale ** 2));
    const sorted = this.order.sort(this.splat.geometry, eye.rotation, eye.position, settings.nearPlane);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, sorted, gl.DYNAMIC_DRAW);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, sorted.length);
    gl.disable(gl.BLEND);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.screen);
    gl.uniform1i(gl.getUniformLocation(this.screen, "picture"), 2);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}
