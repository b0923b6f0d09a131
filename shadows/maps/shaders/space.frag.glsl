uniform float edge;          // half the side of the cube that is shown
in vec4 in_space;

bool is_outside_cube() { return in_space.w <= 0.0 || any(greaterThan(abs(in_space.xyz), vec3(edge * in_space.w))); }
