#version 300 es
// Copies the finished image, which was blended with more than 8 bits per channel, to the canvas.
precision highp float;

uniform sampler2D picture;
out vec4 result;

void main() {
  result = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0);
}
