out vec3 at;

void main() {
    at = tree_texture();
    gl_Position = light_clip(tree_position(tree_offset()));
}
