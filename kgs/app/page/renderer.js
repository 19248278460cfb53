"use strict";
// Decodes a splat (the format is described in kgs/app/page/data.py) and draws it with WebGL2, sorted from back to front.

const TEXELS_PER_ROW = 2048;
const FLOATS_PER_GAUSSIAN = 12;  // in the geometry texture, see splat.vert.glsl

const SAMPLE_PIXELS = 64;  // of the longer side of the small image that tells how much of the canvas is covered

// The bytes of a gzip file that is encoded in base64.
async function unzipped(base64) {
  const bytes = Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0));
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

// A splat as the content of two textures, from its layout and base64-encoded content.
async function decodeSplat(layout, base64) {
  const { count, degree } = layout;
  const columns = decodeColumns(layout, await unzipped(base64));
  const coefficients = (degree + 1) ** 2;
  return {
    count,
    coefficients,
    geometry: geometryTexels(columns, count),
    harmonics: harmonicsTexels(columns, count, coefficients),
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
      const offsets = new Uint32Array(65537);
      for (let k = 0; k < count; k++) offsets[digit(from[k]) + 1]++;
      for (let value = 0; value < 65536; value++) offsets[value + 1] += offsets[value];
      for (let k = 0; k < count; k++) to[offsets[digit(from[k])]++] = from[k];
      [from, to] = [to, from];
    }
    return from.subarray(0, count);
  }
}

// A pair of shaders; its uniforms are set by name.
class Program {
  constructor(gl, vertexSource, fragmentSource) {
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
    Object.assign(this, { gl, program, locations: new Map() });
  }

  // `textures` has texture units by name, `values` floats: numbers, vectors, and matrices of 3 by 3 as rows.
  use(textures, values) {
    this.gl.useProgram(this.program);
    for (const [name, unit] of Object.entries(textures)) this.gl.uniform1i(this.location(name), unit);
    for (const [name, value] of Object.entries(values)) this.set(this.location(name), [value].flat(2));
  }

  set(location, values) {
    const { gl } = this;
    if (values.length === 9) gl.uniformMatrix3fv(location, true, values);
    else gl[`uniform${values.length}f`](location, ...values);
  }

  location(name) {
    if (!this.locations.has(name)) this.locations.set(name, this.gl.getUniformLocation(this.program, name));
    return this.locations.get(name);
  }
}

// A texture that can be drawn to.
class Target {
  constructor(gl, unit, [format, channels, type]) {
    Object.assign(this, { gl, unit, format, channels, type, texture: gl.createTexture() });
    this.framebuffer = gl.createFramebuffer();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, this.texture);
    for (const side of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, side, gl.NEAREST);
    for (const axis of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, axis, gl.CLAMP_TO_EDGE);
  }

  resize(width, height) {
    const { gl } = this;
    Object.assign(this, { width, height });
    gl.activeTexture(gl.TEXTURE0 + this.unit);
    gl.texImage2D(gl.TEXTURE_2D, 0, this.format, width, height, 0, this.channels, this.type, null);
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.framebufferTexture2D(gl.FRAMEBUFFER, gl.COLOR_ATTACHMENT0, gl.TEXTURE_2D, this.texture, 0);
  }

  // The next draw calls draw to it, on this colour.
  begin(...colour) {
    const { gl } = this;
    gl.bindFramebuffer(gl.FRAMEBUFFER, this.framebuffer);
    gl.viewport(0, 0, this.width, this.height);
    gl.clearColor(...colour);
    gl.clear(gl.COLOR_BUFFER_BIT);
  }
}

// Texture units.
const GEOMETRY = 0, HARMONICS = 1, PICTURE = 2, SAMPLE = 3;

class SplatRenderer {
  // `shaders` holds the sources by name. `settings` has nearPlane and farNearPlane (world units), lowPass (variance in
  // square pixels of a photo), antialiased, margin (share of a photo's size) and background (RGB).
  constructor(canvas, splat, shaders, settings) {
    const gl = canvas.getContext("webgl2", { alpha: false, antialias: false });
    if (!gl) throw new Error("this browser has no WebGL2");
    Object.assign(this, { canvas, gl, settings, textures: [] });
    const hasFloatTargets = Boolean(gl.getExtension("EXT_color_buffer_float"));  // otherwise blending has 8 bits
    const bytes = [gl.RGBA8, gl.RGBA, gl.UNSIGNED_BYTE];
    const halfFloats = [gl.RGBA16F, gl.RGBA, gl.HALF_FLOAT];
    this.splatProgram = new Program(gl, shaders.splatVertex, shaders.splatFragment);
    this.screenProgram = new Program(gl, shaders.screenVertex, shaders.screenFragment);
    this.picture = new Target(gl, PICTURE, hasFloatTargets ? halfFloats : bytes);
    this.sample = new Target(gl, SAMPLE, bytes);
    this.take(splat);
    this.addBuffer(0);  // the corners of a quadrilateral
    gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
    gl.vertexAttribPointer(0, 2, gl.FLOAT, false, 0, 0);
    this.indices = this.addBuffer(1);  // of Gaussians, one per quadrilateral
    gl.vertexAttribIPointer(1, 1, gl.UNSIGNED_INT, 0, 0);
    gl.vertexAttribDivisor(1, 1);
  }

  // Draws this splat from now on.
  take(splat) {
    const { gl } = this;
    this.splat = splat;
    this.order = new DepthOrder(splat.count);
    this.everyGaussian = Uint32Array.from({ length: splat.count }, (_, i) => i);
    this.upload(GEOMETRY, gl.RGBA32F, splat.geometry);
    this.upload(HARMONICS, gl.RGBA16F, splat.harmonics);
  }

  // A texture of four floats per texel, in the place of the one that the unit had.
  upload(unit, format, values) {
    const { gl, textures } = this;
    gl.deleteTexture(textures[unit] ?? null);
    textures[unit] = gl.createTexture();
    gl.activeTexture(gl.TEXTURE0 + unit);
    gl.bindTexture(gl.TEXTURE_2D, textures[unit]);
    const rows = values.length / 4 / TEXELS_PER_ROW;
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

  // Sets the size of the canvas, and with it of both targets, in pixels.
  resize(width, height) {
    const { canvas } = this;
    if (canvas.width === width && canvas.height === height && this.hasSize) return;
    canvas.width = width;
    canvas.height = height;
    this.hasSize = true;
    this.picture.resize(width, height);
    const shrink = Math.min(1, SAMPLE_PIXELS / Math.max(width, height));
    this.sample.resize(...[width, height].map((side) => Math.max(1, Math.round(shrink * side))));
  }

  // Smallest and largest x/z and y/z at which footprints are linearised: those of the photo's frame and a margin around
  // it, as in kgs/geometry/lenses.py. They do not depend on the shape of the canvas.
  tangentLimits({ size, focal, centre }) {
    const { margin } = this.settings;
    return [
      size.map((side, axis) => (-0.5 - margin * side - centre[axis]) / focal[axis]),
      size.map((side, axis) => (side - 0.5 + margin * side - centre[axis]) / focal[axis]),
    ];
  }

  // Draws what a camera sees. `camera` has rotation (rows), position, nearPlane, and size, focal and centre in pixels of
  // the photo; `view` has focal and centre in pixels of the canvas, and scale, the number of these per pixel of the
  // photo.
  draw(camera, view) {
    const { gl, canvas, settings, splat } = this;
    const sorted = this.order.sort(splat.geometry, camera.rotation, camera.position, camera.nearPlane);
    this.picture.begin(...settings.background, 1);
    this.drawGaussians(camera, view, this.picture, sorted);
    gl.bindFramebuffer(gl.FRAMEBUFFER, null);
    gl.viewport(0, 0, canvas.width, canvas.height);
    this.screenProgram.use({ picture: PICTURE }, {});
    gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
  }

  // The share of the canvas that the splat covers: its mean alpha, which does not depend on the order.
  coverage(camera, view) {
    const { gl, canvas, sample } = this;
    const shrink = sample.width / canvas.width;
    sample.begin(0, 0, 0, 0);
    this.drawGaussians(camera, {
      scale: shrink * view.scale,
      focal: view.focal.map((value) => shrink * value),
      centre: view.centre.map((value) => shrink * (value + 0.5) - 0.5),
    }, sample, this.everyGaussian);
    const pixels = new Uint8Array(4 * sample.width * sample.height);
    gl.readPixels(0, 0, sample.width, sample.height, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
    let sum = 0;
    for (let i = 3; i < pixels.length; i += 4) sum += pixels[i];
    return 4 * sum / (255 * pixels.length);
  }

  // The low-pass filter in square pixels of the canvas. On a canvas larger than the photo it is enlarged too: it shows
  // the fitted image, enlarged.
  lowPassOf(view) {
    return this.settings.lowPass * Math.max(1, view.scale ** 2);
  }

  // The depth, at a pixel of the canvas, of the first Gaussian behind which the transmittance is below one half, as
  // kgs.GaussianRenderer computes it (median_depth); null if there is none.
  medianDepth(camera, view, pixel) {
    const { geometry } = this.splat;
    const sorted = this.order.sort(geometry, camera.rotation, camera.position, camera.nearPlane);
    const limits = this.tangentLimits(camera);
    let transmittance = 1;
    for (let k = sorted.length - 1; k >= 0; k--) {
      const start = FLOATS_PER_GAUSSIAN * sorted[k];
      const [alpha, depth] = this.alphaAt(camera, view, pixel, geometry.subarray(start, start + 10), limits);
      if (alpha < 1 / 255) continue;
      transmittance *= 1 - alpha;
      if (transmittance < 0.5) return depth;
    }
    return null;
  }

  // The alpha of a Gaussian at a pixel, as in the shaders, and its depth.
  alphaAt(camera, view, pixel, gaussian, [min, max]) {
    const { rotation, position } = camera;
    const [x, y, z, opacity, cxx, cxy, cxz, cyy, cyz, czz] = gaussian;
    const relative = [x - position[0], y - position[1], z - position[2]];
    const depth = dot(rotation[2], relative);
    const rows = [0, 1].map((axis) => {  // of the Jacobian times the rotation
      const slope = clamped(dot(rotation[axis], relative) / depth, min[axis], max[axis]);
      return rotation[axis].map((value, i) => view.focal[axis] * (value - slope * rotation[2][i]) / depth);
    });
    const spread = rows.map(([a, b, c]) => [
      cxx * a + cxy * b + cxz * c, cxy * a + cyy * b + cyz * c, cxz * a + cyz * b + czz * c,
    ]);
    const lowPass = this.lowPassOf(view);
    const [sharpX, xy, sharpY] = [dot(rows[0], spread[0]), dot(rows[0], spread[1]), dot(rows[1], spread[1])];
    const determinant = (sharpX + lowPass) * (sharpY + lowPass) - xy * xy;
    const fainter = this.settings.antialiased ? Math.sqrt(Math.max(0, sharpX * sharpY - xy * xy) / determinant) : 1;
    const [dx, dy] = pixel.map((value, axis) => {
      return value - view.centre[axis] - view.focal[axis] * dot(rotation[axis], relative) / depth;
    });
    const square = ((sharpY + lowPass) * dx * dx - 2 * xy * dx * dy + (sharpX + lowPass) * dy * dy) / determinant;
    return [Math.min(0.99, fainter * opacity * Math.exp(-0.5 * square)), depth];
  }

  // Blends Gaussians over a target, in the order of their indices.
  drawGaussians(camera, view, target, indices) {
    const { gl, settings } = this;
    const [leastTangent, largestTangent] = this.tangentLimits(camera);
    this.splatProgram.use({ geometry: GEOMETRY, harmonics: HARMONICS }, {
      rotation: camera.rotation, position: camera.position, nearPlane: camera.nearPlane, leastTangent, largestTangent,
      focal: view.focal, centre: view.centre, size: [target.width, target.height],
      lowPass: this.lowPassOf(view), antialiased: Number(settings.antialiased),
    });
    gl.uniform1i(this.splatProgram.location("texelsPerRow"), TEXELS_PER_ROW);
    gl.uniform1i(this.splatProgram.location("coefficients"), this.splat.coefficients);
    gl.bindBuffer(gl.ARRAY_BUFFER, this.indices);
    gl.bufferData(gl.ARRAY_BUFFER, indices, gl.DYNAMIC_DRAW);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.ONE, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawArraysInstanced(gl.TRIANGLE_STRIP, 0, 4, indices.length);
    gl.disable(gl.BLEND);
  }
}
