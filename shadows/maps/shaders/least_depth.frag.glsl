// Compute the minimum depth of a block of texels.
uniform sampler2D depth_map;
uniform int block_texels;
out float least;

void main() {
    ivec2 first = ivec2(gl_FragCoord.xy) * block_texels;
    least = 1.0;
    for (int row = 0; row < block_texels; row++) {
        for (int col = 0; col < block_texels; col++) least = min(least, texelFetch(depth_map, first + ivec2(col, row), 0).r);
    }
}
