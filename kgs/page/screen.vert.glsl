#version 300 es
// A quadrilateral over the whole canvas.
in vec2 corner;

void main() {
  gl_Position = vec4(corner, 0.0, 1.0);
}
