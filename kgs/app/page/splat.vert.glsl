#version 300 es
// One corner of the quadrilateral that covers a Gaussian's footprint, as kgs/projection.py computes it.
precision highp float;
precision highp int;
precision highp sampler2D;

uniform sampler2D geometry;   // three texels per Gaussian: centre and opacity; covariance xx, xy, xz, yy; yz, zz
uniform sampler2D harmonics;  // one texel (red, green, blue) per coefficient
uniform int texelsPerRow;
uniform int coefficients;     // per Gaussian: 1, 4, 9 or 16
uniform mat3 rotation;        // world to camera
uniform vec3 position;        // of the camera
uniform vec2 focal, centre;   // in pixels of the canvas; the centre of the first pixel is 0
uniform vec2 size;            // of the canvas, in pixels
uniform vec2 leastTangent, largestTangent;  // limits of x/z and y/z at which footprints are linearised
uniform float nearPlane;      // in world units
uniform float lowPass;        // variance added to footprints, in square pixels
uniform float antialiased;    // 1 or 0: whether footprints that the low-pass filter widens get fainter
in vec2 corner;               // -1 or 1
in uint gaussian;             // index
out vec2 offset;              // from the centre, in standard deviations
flat out vec4 colour;         // and opacity

const float ALPHA_THRESHOLD = 1.0 / 255.0;
const float LARGEST_COLOUR = 65504.0;  // of half floats, which are blended

vec4 texel(sampler2D source, int index) {
  return texelFetch(source, ivec2(index % texelsPerRow, index / texelsPerRow), 0);
}

vec3 coefficient(int k) {
  return texel(harmonics, int(gaussian) * coefficients + k).rgb;
}

// The colour seen in a direction: real spherical harmonics up to degree 3, as in kgs/harmonics.py.
vec3 colourTowards(vec3 direction) {
  float x = direction.x, y = direction.y, z = direction.z;
  float xx = x * x, yy = y * y, zz = z * z;
  vec3 sum = 0.28209479 * coefficient(0) + 0.5;
  if (coefficients > 1) {
    sum += 0.48860251 * (z * coefficient(2) - y * coefficient(1) - x * coefficient(3));
  }
  if (coefficients > 4) {
    sum += 1.0925485 * (x * y * coefficient(4) - y * z * coefficient(5) - x * z * coefficient(7));
    sum += 0.31539157 * (2.0 * zz - xx - yy) * coefficient(6) + 0.54627422 * (xx - yy) * coefficient(8);
  }
  if (coefficients > 9) {
    sum -= 0.59004359 * (y * (3.0 * xx - yy) * coefficient(9) + x * (xx - 3.0 * yy) * coefficient(15));
    sum += 2.8906114 * x * y * z * coefficient(10) + 1.4453057 * z * (xx - yy) * coefficient(14);
    sum -= 0.45704580 * (4.0 * zz - xx - yy) * (y * coefficient(11) + x * coefficient(13));
    sum += 0.37317633 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * coefficient(12);
  }
  return clamp(sum, 0.0, LARGEST_COLOUR);
}

void main() {
  vec4 first = texel(geometry, 3 * int(gaussian));
  vec4 second = texel(geometry, 3 * int(gaussian) + 1);
  vec4 third = texel(geometry, 3 * int(gaussian) + 2);
  vec3 mean = first.xyz;
  float opacity = first.a;
  mat3 covariance = mat3(second.x, second.y, second.z, second.y, second.w, third.x, second.z, third.x, third.y);

  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // outside of the clip volume: nothing is drawn
  vec3 point = rotation * (mean - position);
  if (point.z <= nearPlane) return;

  // The first-order footprint: the covariance in pixels of the canvas.
  vec2 tangent = clamp(point.xy / point.z, leastTangent, largestTangent);
  mat3 jacobian = mat3(focal.x, 0, 0, 0, focal.y, 0, -focal * tangent, 0) * (1.0 / point.z);
  mat3 toPixels = jacobian * rotation;
  mat3 footprint = toPixels * covariance * transpose(toPixels);
  float xx = footprint[0][0] + lowPass;
  float xy = footprint[0][1];
  float yy = footprint[1][1] + lowPass;
  if (antialiased > 0.0) {
    float sharp = footprint[0][0] * footprint[1][1] - xy * xy;
    opacity *= sqrt(max(sharp, 0.0) / (sharp + lowPass * (footprint[0][0] + yy)));  // of both determinants
  }
  float radius = sqrt(2.0 * log(max(opacity / ALPHA_THRESHOLD, 1.0)));  // where alpha is cut, in standard deviations
  if (radius == 0.0) return;

  // Its principal axes.
  float average = 0.5 * (xx + yy);
  float spread = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = abs(xy) > 1e-9 * average ? normalize(vec2(xy, average + spread - xx)) : vec2(xx >= yy, xx < yy);
  vec2 deviations = sqrt(max(vec2(average + spread, average - spread), 1e-6));

  offset = radius * corner;
  vec2 shift = offset.x * deviations.x * axis + offset.y * deviations.y * vec2(-axis.y, axis.x);
  vec2 pixel = focal * point.xy / point.z + centre + shift;
  gl_Position = vec4(vec2(2.0, -2.0) * (pixel + 0.5) / size + vec2(-1.0, 1.0), 0.0, 1.0);
  colour = vec4(colourTowards(normalize(mean - position)), opacity);
}
