uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

void main() { if (texture(foliage, at).a < threshold) discard; }
