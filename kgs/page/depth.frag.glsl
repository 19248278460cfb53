#version 300 es
// The depth of a Gaussian at a pixel, times its alpha, and the alpha: what coverage.frag.glsl needs of the splat.
precision highp float;

uniform float depthUnit;  // keeps depths within the range of half floats
in vec2 offset;
flat in vec4 colour;
flat in float depth;
out vec4 result;

void main() {
  float alpha = min(colour.a * exp(-0.5 * dot(offset, offset)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(alpha * min(depth / depthUnit, 1e4), 0.0, 0.0, alpha);
}
