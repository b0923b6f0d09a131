uniform mat4 clip_from_frame;
uniform vec3 origin_frame_m;
out vec3 at;

void main() {
    at = tree_texture();
    gl_Position = clip_from_frame * vec4(tree_position(tree_offset()) - origin_frame_m, 1.0);
}
