// Map: position is a pixel's column and row, and a height from 0 to 1. The depth test keeps the highest.
in vec3 position;
uniform vec2 size_px;

void main() { gl_Position = vec4(2.0 * position.xy / size_px - 1.0, position.z, 1.0); }
