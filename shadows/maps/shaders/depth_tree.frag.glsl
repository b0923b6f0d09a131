uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

// One level at a time, the finer of two: each covers its share at the threshold, a blend of both does not, for it is flatter than
// either; and what a coarser level has run together throws more shade within a crown.
void main() { if (textureLod(foliage, at, floor(textureQueryLod(foliage, at.xy).y)).a < threshold) discard; }
