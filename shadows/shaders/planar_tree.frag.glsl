uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

// The full-resolution texture, as rays meet it.
void main() { if (textureLod(foliage, at, 0.0).a < threshold) discard; }
