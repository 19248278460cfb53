#version 300 es
// Copies the finished image, which was blended with more than 8 bits per channel, to the canvas. What no photo shows
// fades to the ground.
precision highp float;

uniform sampler2D picture;
uniform sampler2D coverage;  // with fewer pixels
uniform vec3 ground;
uniform float fades;          // 1 or 0
out vec4 result;

void main() {
  vec3 colour = texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb;
  if (fades > 0.0) {
    float share = texture(coverage, gl_FragCoord.xy / vec2(textureSize(picture, 0))).r;
    colour = mix(ground, colour, share);
  }
  result = vec4(colour, 1.0);
}
