#version 300 es
// One corner of the quadrilateral that covers a Gaussian's footprint; the rules are those of kgs/projection.py.
precision highp float;
precision highp int;
precision highp sampler2D;

uniform sampler2D geometry;   // three texels a Gaussian: centre and opacity, covariance xx xy xz yy, yz zz
uniform sampler2D harmonics;  // one texel (red, green, blue) for each coefficient
uniform int texelsPerRow;
uniform int coefficients;     // 1, 4, 9 or 16
uniform mat3 rotation;        // world to camera
uniform vec3 position;        // of the camera
uniform vec2 focal, centre, size;  // pixels of the canvas, the first pixel's centre at 0
uniform vec2 leastTangent, largestTangent;  // x/z and y/z at which footprints stop growing, from the photo's frame
uniform float nearPlane, lowPass;
in vec2 corner;               // -1 or 1
in uint gaussian;
out vec2 offset;              // from the centre, in standard deviations
flat out vec4 colour;         // with the opacity

const float ALPHA_THRESHOLD = 1.0 / 255.0;

vec4 texel(sampler2D source, int place) {
  return texelFetch(source, ivec2(place % texelsPerRow, place / texelsPerRow), 0);
}

vec3 coefficient(int k) {
  return texel(harmonics, int(gaussian) * coefficients + k).rgb;
}

// Real spherical harmonics up to degree 3, as in kgs/harmonics.py.
vec3 seenFrom(vec3 direction) {
  float x = direction.x, y = direction.y, z = direction.z, xx = x * x, yy = y * y, zz = z * z;
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
  return max(sum, 0.0);
}

void main() {
  vec4 first = texel(geometry, 3 * int(gaussian)), second = texel(geometry, 3 * int(gaussian) + 1);
  vec4 third = texel(geometry, 3 * int(gaussian) + 2);
  float opacity = first.a, reach = sqrt(2.0 * log(max(opacity / ALPHA_THRESHOLD, 1.0)));
  vec3 point = rotation * (first.xyz - position);
  gl_Position = vec4(0.0, 0.0, 2.0, 1.0);  // nothing is drawn
  if (point.z <= nearPlane || reach == 0.0) return;

  // The first-order footprint, linearised at a point that is not far outside the photo's frame.
  vec2 tangent = clamp(point.xy / point.z, leastTangent, largestTangent);
  mat3 slope = mat3(focal.x, 0, 0, 0, focal.y, 0, -focal * tangent, 0) * (1.0 / point.z);
  mat3 covariance = mat3(second.x, second.y, second.z, second.y, second.w, third.x, second.z, third.x, third.y);
  mat3 turned = slope * rotation, footprint = turned * covariance * transpose(turned);
  float xx = footprint[0][0] + lowPass, xy = footprint[0][1], yy = footprint[1][1] + lowPass;

  // Its axes.
  float mean = 0.5 * (xx + yy), spread = length(vec2(0.5 * (xx - yy), xy));
  vec2 axis = abs(xy) > 1e-9 * mean ? normalize(vec2(xy, mean + spread - xx)) : vec2(xx >= yy, xx < yy);
  vec2 deviations = sqrt(max(vec2(mean + spread, mean - spread), 1e-6));
  offset = reach * corner;
  vec2 shift = offset.x * deviations.x * axis + offset.y * deviations.y * vec2(-axis.y, axis.x);
  vec2 pixel = focal * point.xy / point.z + centre + shift;
  gl_Position = vec4(vec2(2.0, -2.0) * (pixel + 0.5) / size + vec2(-1.0, 1.0), 0.0, 1.0);
  colour = vec4(seenFrom(normalize(first.xyz - position)), opacity);
}
