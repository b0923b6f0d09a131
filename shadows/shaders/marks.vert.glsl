in vec2 position;  // column and row of a pixel that is marked
uniform vec2 size_px;

void main() { gl_Position = vec4(2.0 * (position + 0.5) / size_px - 1.0, 0.0, 1.0); }
