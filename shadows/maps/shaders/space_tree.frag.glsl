uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

void main() { if (is_outside_cube() || textureLod(foliage, at, floor(textureQueryLod(foliage, at.xy).y)).a < threshold) discard; }
