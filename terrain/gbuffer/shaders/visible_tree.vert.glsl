uniform mat3 camera_from_frame;
uniform vec3 eye_frame_m;
uniform vec4 window;
uniform float near_m;
uniform bool in_map;
uniform vec2 size_px;
uniform mat2 px_from_m;  // maps: pixels (column, row) per metre east and north
uniform float height_m;  // maps: the range of heights that 0 to 1 represent
flat out int triangle;   // number of the triangle whose last corner this is: two triangles for each quad
flat out vec3 foot;      // relative to the eye
flat out vec3 crown;     // half width and height of the upright quads, layer of their texture
out vec3 above_foot;
out vec3 at;

void main() {
    vec3 offset = tree_offset();
    triangle = 6 * gl_InstanceID + 2 * (gl_VertexID / 4) + (gl_VertexID % 4 == 3 ? 1 : 0);
    at = tree_texture();
    above_foot = offset;
    foot = base - eye_frame_m;
    crown = vec3(shape.x, shape.z, 2.0 * look.z);
    if (in_map) {
        vec2 px = base.xy + px_from_m * offset.xy;
        gl_Position = vec4(2.0 * px / size_px - 1.0, base.z + offset.z / height_m, 1.0);
    } else {
        vec3 camera = camera_from_frame * (tree_position(offset) - eye_frame_m);
        gl_Position = vec4(camera.xy * window.xy + camera.z * window.zw, near_m, camera.z);
    }
}
