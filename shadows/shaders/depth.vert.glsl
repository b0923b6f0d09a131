#version 430
// Light space is affine, so clip coordinates are those of the map's window: metres from its corner over its extent.
in vec3 position;
uniform mat3 light_from_frame;
uniform vec3 light_offset_m;
uniform vec3 window_m;

void main() {
    vec3 light_m = light_from_frame * position + light_offset_m;
    gl_Position = vec4(2.0 * light_m / window_m - 1.0, 1.0);
}
