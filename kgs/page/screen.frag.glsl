#version 300 es
// The finished picture, which was blended in more than 8 bits, onto the canvas.
precision highp float;

uniform sampler2D picture;
out vec4 result;

void main() {
  result = vec4(texelFetch(picture, ivec2(gl_FragCoord.xy), 0).rgb, 1.0);
}
