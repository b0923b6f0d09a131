out vec3 at;

void main() {
    at = tree_texture();
    gl_Position = projected(tree_position(tree_offset()));
}
