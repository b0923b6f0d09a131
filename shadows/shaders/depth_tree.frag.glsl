uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

// One level at a time: each covers its share at the threshold, a blend of two does not. It is flatter than either.
void main() { if (textureLod(foliage, at, round(textureQueryLod(foliage, at.xy).y)).a < threshold) discard; }
