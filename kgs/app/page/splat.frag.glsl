#version 300 es
// The alpha of a Gaussian at a pixel, and its colour multiplied by alpha.
precision highp float;

in vec2 offset;
flat in vec4 colour;
out vec4 result;

void main() {
  float alpha = min(colour.a * exp(-0.5 * dot(offset, offset)), 0.99);
  if (alpha < 1.0 / 255.0) discard;
  result = vec4(alpha * colour.rgb, alpha);
}
