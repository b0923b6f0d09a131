uniform int first;
uniform sampler2DArray foliage;
uniform float threshold;
uniform float level_bias;  // of the pictures of leaves, where pixels are less wide than their distance
flat in int tree;
in vec3 at;
layout(location = 0) out uint seen;
layout(location = 1) out vec4 albedo;

void main() {
    vec4 leaf = texture(foliage, at, level_bias);
    if (leaf.a < threshold) discard;
    seen = uint(first + tree * 6 + gl_PrimitiveID) + 1u;
    albedo = vec4(sqrt(leaf.rgb), 1.0);  // roots, so that eight bits hold dark greens
}
