uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

// Sample one mip level, the finer of the two. Each level keeps its coverage at the threshold. A blend of both does not, since it
// has less contrast than either. A coarser level merges leaves, which cast more shade within a crown.
void main() { if (textureLod(foliage, at, floor(textureQueryLod(foliage, at.xy).y)).a < threshold) discard; }
