#version 300 es
// Smooths the coverage and makes its ends steep again: narrow gaps close, as at the edges of things, where mean depths
// lie between two surfaces; single pixels go, and outlines get soft. Where all around is covered nothing changes.
precision highp float;

uniform sampler2D coverage;
out vec4 result;

const int RADIUS = 4;          // pixels of the coverage
const float DEVIATION = 2.0;   // of the Gaussian weights

void main() {
  ivec2 last = textureSize(coverage, 0) - 1;
  vec2 sums = vec2(0.0);
  for (int y = -RADIUS; y <= RADIUS; y++) {
    for (int x = -RADIUS; x <= RADIUS; x++) {
      float weight = exp(-float(x * x + y * y) / (2.0 * DEVIATION * DEVIATION));
      ivec2 place = clamp(ivec2(gl_FragCoord.xy) + ivec2(x, y), ivec2(0), last);
      sums += weight * vec2(texelFetch(coverage, place, 0).r, 1.0);
    }
  }
  float mean = sums.x / sums.y;
  result = vec4(mean * smoothstep(0.15, 0.6, mean));
}
