uniform sampler2D receivers;  // the number of each pixel's plane
uniform float number;
uniform sampler2DArray foliage;
uniform float threshold;
in vec3 at;

void main() {
    if (texelFetch(receivers, ivec2(gl_FragCoord.xy), 0).r != number) discard;
    // Sample the full-resolution texture, as the reference's rays do.
    if (textureLod(foliage, at, 0.0).a < threshold) discard;
}
