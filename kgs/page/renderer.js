"use strict";
// Decodes a splat (the format is described in kgs/page/data.py) and draws it with WebGL2, sorted from back to front.

const TEXELS_PER_ROW = 2048;
const FLOATS_PER_GAUSSIAN = 12;  // in the geometry texture, see splat.vert.glsl

// The splat as the content of two textures, from its layout and base64-encoded content.
async function decodeSplat(layout, base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const columns = decodeColumns(layout, planes);
  const coefficients = (layout.degree + 1) ** 2;
  return {
    count: layout.count,
    coefficients,
    geometry: geometryTexels(columns, layout.count),
    harmonics: harmonicsTexels(columns, layout.count, coefficients),
  };
}

// One Float64Array per column, by name.
function decodeColumns({ count, columns }, planes) {
  const found = {};
  let start = 0;
  for (const [name, width, low, step] of columns) {
    const values = new Float64Array(count);
    for (let plane = 0; plane < width; plane++) {
      for (let i = 0; i < count; i++) values[i] = 256 * values[i] + planes[start + i];
      start += count;
    }
    for (let i = 0; i < count; i++) values[i] = low + step * values[i];
    found[name] = values;
  }
  return found;
}

// Room for so many texels of four floats, in whole rows.
function texels(count) {
  return new Float32Array(4 * TEXELS_PER_ROW * Math.ceil(Math.max(1, count) / TEXELS_PER_ROW));
}

// Centre, opacity and covariance (xx, xy, xz, yy, yz, zz) of each Gaussian, in three texels.
function geometryTexels(columns, count) {
  const geometry = texels(3 * count);
  for (let i = 0; i < count; i++) {
    const start = FLOATS_PER_GAUSSIAN * i;
    geometry.set([columns.x[i], columns.y[i], columns.z[i], columns.opacity[i]], start);
    rotationColumns(decodeQuaternion(columns, i)).forEach(([a, b, c], axis) => {
      const variance = Math.exp(2 * columns["scale" + axis][i]);
      [a * a, a * b, a * c, b * b, b * c, c * c].forEach((product, k) => {
        geometry[start + 4 + k] += variance * product;
      });
    });
  }
  return geometry;
}

// The unit quaternion w, x, y, z of Gaussian i: its largest component follows from the three others.
function decodeQuaternion(columns, i) {
  const others = [0, 1, 2].map((k) => columns["quat" + k][i]);
  const rest = 1 - others.reduce((sum, value) => sum + value * value, 0);
  const quaternion = [...others];
  quaternion.splice(columns.largest[i], 0, Math.sqrt(Math.max(rest, 0)));
  return quaternion;
}

function rotationColumns([w, x, y, z]) {
  return [
    [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
    [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
    [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
  ];
}

// Red, green and blue of each coefficient of each Gaussian, in one texel.
function harmonicsTexels(columns, count, coefficients) {
  const harmonics = texels(coefficients * count);
  for (let k = 0; k < coefficients; k++) {
    ["r", "g", "b"].forEach((letter, channel) => {
      const roots = columns["sh" + k + letter];  // signed square roots
      for (let i = 0; i < count; i++) {
        harmonics[4 * (i * coefficients + k) + channel] = roots[i] * Math.abs(roots[i]);
      }
    });
  }
  return harmonics;
}

// Sorts Gaussians by depth, exactly: a radix sort with two passes over 16 bits each. The bits of positive floats, read
// as integers, have the order of the floats.
class DepthOrder {
  constructor(count) {
    this.depths = new Float32Array(count);
    this.bits = new Uint32Array(this.depths.buffer);
    this.orders = [new Uint32Array(count), new Uint32Array(count)];
  }

  // Indices of the Gaussians beyond the near plane, the farthest one first. The next call overwrites the array.
  sort(geometry, rotation, position, nearPlane) {
    const { depths, bits } = this;
    const [x, y, z] = rotation[2];
    const [px, py, pz] = position;
    let [from, to] = this.orders;
    let count = 0;
    for (let i = 0; i < depths.length; i++) {
      const start = FLOATS_PER_GAUSSIAN * i;
      const depth = x * (geometry[start] - px) + y * (geometry[start + 1] - py) + z * (geometry[start + 2] - pz);
      depths[i] = depth;
      if (depth > nearPlane) from[count++] = i;
    }
    for (const shift of [0, 16]) {
      const digit = (i) => 65535 - ((bits[i] >>> shift) & 65535);  // a larger depth has a smaller digit
      const places = new Uint32Array(65537);
      for (let k = 0; k < count; k++) places[digit(from[k]) + 1]++;
      for (let value = 0; value < 65536; value++) places[value + 1] += places[value];
      for (let k = 0; k < count; k++) to[places[digit(from[k])]++] = from[k];
      [from, to] = [to, from];
    }
    return from.subarray(0, count);
  }
}

class SplatRenderer {
  // `shaders` holds the sources by name. `settings` has nearPlane (world units), lowPass (variance in square pixels of
  // a photo), margin (share of a photo's size) and background (RGB).
  constructor(canvas, splat, shaders, settings) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
    if (!gl) throw new Error("this browser has no WebGL2");
    Object.assign(this, { canvas, gl, splat, settings });
    this.order = new DepthOrder(splat.count);
    this.hasFloatTargets = Boolean(gl.getExtension("EXT_color_buffer_float"));  // otherwise blending has 8 bits
    this.splatProgram = this.link(shaders.splatVertex, shaders.splatFragment);
    this.screenProgram = this.link(shaders.screenVertex, shaders.screenFragment);
    this.upload(0, gl.RGBA32F, splat.geometry);
    this.upload(1, gl.RGBA16F, splat.harmonics);
    this.addBuffer(0);  // the corners of a quadrilateral
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.indices = this.addBuffer(1);  // of Gaussians, one per quadrilateral
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
    this.target = gl.createTexture();
    gl.activeTexture(gl.TEXTURE2);
    gl.bindTexture(gl.TEXTURE_2D, this.target);
    this.framebuffer = gl.createFramebuffer();
  }

  link(vertexSource, fragmentSource) {
    const { gl } = this;
    const program = gl.createProgram();
    for (const [kind, source] of [[gl.VERTEX_SHADER, vertexSource], [gl.FRAGMENT_SHADER, fragmentSource]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, source);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.bindAttribLocation(program, 0, "corner");
    gl.bindAttribLocation(program, 1, "gaussian");
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    return program;
  }

  upload(unit, format, values) {
    const { gl } = this;
    const rows = values.length / 4 / TEXELS_PER_ROW;
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, gl.createTexture());
    gl.texImage2D(gl.TEXTURE_2D, 0, format, TEXELS_PER_ROW, rows, 0, gl.RGBA, gl.FLOAT, values);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MAG_FILTER, gl.NEAREST);
  }

  // A buffer for the vertex attribute at this location.
  addBuffer(location) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.enableVertexAttribArray(location);
    return buffer;
  }

  // Sets the size of the canvas and of the texture in which Gaussians are blended, in pixels.
  resize(width, height) {
    const { canvas, gl } = this;
    if (canvas.width === width && canvas.height === height && this.hasSize) return;
    canvas.width = width;
    canvas.height = height;
    this.hasSize = true;
    const format = this.hasFloatTargets ? gl.RGBA16F : gl.RGBA8;
    const type = this.hasFloatTargets ? gl.HALF_FLOAT : gl.UNSIGNED_BYTE;
    gl.activeTexture(gl.TEXTURE2);
    gl.texImage2D(gl.TEXTURE_2D, 0, format, width, height, 0, gl.RGBA, type, null);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.NEAREST);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.target, 0);
  }

  // Smallest and largest x/z and y/z at which footprints are linearised: those of the photo's frame and a margin around
  // it, as in kgs/camera.py. They do not depend on the shape of the canvas.
  tangentLimits({ size, focal, centre }) {
    const { margin } = this.settings;
    return [
      size.map((side, axis) => (-0.5 - margin * side - centre[axis]) / focal[axis]),
      size.map((side, axis) => (side - 0.5 + margin * side - centre[axis]) / focal[axis]),
    ];
  }

  // Draws what a camera sees. `camera` has rotation (rows), position, and size, focal and centre in pixels of the
  // photo; `view` has focal and centre in pixels of the canvas, and scale, the number of these per pixel of the photo.
  draw(camera, view) {
    const { gl, canvas, settings, splat } = this;
    const { rotation, position } = camera;
    const [leastTangent, largestTangent] = this.tangentLimits(camera);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...settings.background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT);

    gl.useProgram(this.splatProgram);
    const location = (name) => gl.getUniformLocation(this.splatProgram, name);
    gl.uniform1i(location("geometry"), 0);
    gl.uniform1i(location("harmonics"), 1);
    gl.uniform1i(location("texelsPerRow"), TEXELS_PER_ROW);
    gl.uniform1i(location("coefficients"), splat.coefficients);
    gl.uniformMatrix3fv(location("rotation"), true, rotation.flat());
    gl.uniform3f(location("position"), ...position);
    gl.uniform2f(location("focal"), ...view.focal);
    gl.uniform2f(location("centre"), ...view.centre);
    gl.uniform2f(location("size"), canvas.width, canvas.height);
    gl.uniform2f(location("leastTangent"), ...leastTangent);
    gl.uniform2f(location("largestTangent"), ...largestTangent);
    gl.uniform1f(location("nearPlane"), settings.nearPlane);
    // On a canvas larger than the photo, the low-pass filter is enlarged too: it shows the fitted image, enlarged.
    gl.uniform1f(location("lowPass"), settings.lowPass * Math.max(1, view.scale ** 2));

    const sorted = this.order.sort(splat.geometry, rotation, position, settings.nearPlane);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, sorted, gl.DYNAMIC_DRAW);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, sorted.length);
    gl.disable(gl.BLEND);

    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.useProgram(this.screenProgram);
    gl.uniform1i(gl.getUniformLocation(this.screenProgram, "picture"), 2);
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }
}
