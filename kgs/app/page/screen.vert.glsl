#version 300 es
// One corner of a quadrilateral that covers the whole canvas.
in vec2 corner;

void main() {
  gl_Position = vec4(corner, 0.0, 1.0);
}
