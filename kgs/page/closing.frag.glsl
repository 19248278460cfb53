#version 300 es
// Closes gaps in the coverage that are at most two pixels wide (a morphological closing with a square of 3 by 3), as at
// the edges of things, where mean depths lie between two surfaces.
precision highp float;

uniform sampler2D coverage;
out vec4 result;

void main() {
  ivec2 last = textureSize(coverage, 0) - 1;
  float least = 1.0;
  for (int y = -1; y <= 1; y++) {
    for (int x = -1; x <= 1; x++) {
      float largest = 0.0;
      for (int dy = -1; dy <= 1; dy++) {
        for (int dx = -1; dx <= 1; dx++) {
          ivec2 place = clamp(ivec2(gl_FragCoord.xy) + ivec2(x + dx, y + dy), ivec2(0), last);
          largest = max(largest, texelFetch(coverage, place, 0).r);
        }
      }
      least = min(least, largest);
    }
  }
  result = vec4(least);
}
