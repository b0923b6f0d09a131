uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

// Sample the full-resolution texture, as the reference's rays do.
void main() { if (textureLod(foliage, at, 0.0).a < threshold) discard; }
