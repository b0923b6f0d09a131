uniform int first;
uniform sampler2DArray foliage;
uniform float threshold;
uniform float level_bias;  // mip level bias of the leaves' textures, for views with pixels narrower than their spacing
uniform bool in_map;
flat in int triangle;
flat in vec3 foot;
flat in vec3 crown;
in vec3 above_foot;
in vec3 at;
layout(location = 0) out uint seen;
layout(location = 1) out vec4 albedo;

// Range of the ray's cosine to the horizontal over which the colour changes from the quad's own to that of the facing side view.
const vec2 FLAT = vec2(0.35, 0.65);

// Largest ratio of the pixel's extents in the texture. Wider extents are cut: otherwise the mip level of a quad seen edge-on would
// hide its leaves in blocks of a few texels.
const float MAX_ANISOTROPY = 1.5;

// The texture with a mip level for the pixel's extent, cut to MAX_ANISOTROPY times its narrower side.
vec4 leaf_texture(vec3 place) {
    vec2 a = dFdx(place.xy), b = dFdy(place.xy);
    float longest = max(length(a), length(b));
    float area = abs(a.x * b.y - a.y * b.x);
    float scale = min(1.0, MAX_ANISOTROPY * area / max(longest * longest, 1e-12));
    return textureGrad(foliage, place, a * scale * exp2(level_bias), b * scale * exp2(level_bias));
}

// The colour of the side view as an upright billboard that faces the eye, whichever quad is seen. Otherwise the stretched texture
// of a quad seen edge-on would draw a line through the crown. The alpha test still uses the quad's own texture. Beside the billboard's
// leaves the colour is the quad's own.
vec3 facing_color(vec3 own) {
    vec3 ray = foot + above_foot;
    vec2 ahead = normalize(foot.xy);
    float forward = dot(ray.xy, ahead);
    vec3 there = above_foot - ray * (dot(above_foot.xy, ahead) / max(forward, 1e-3 * length(ray)));
    vec2 place = vec2(0.5 + 0.5 * dot(there.xy, vec2(ahead.y, -ahead.x)) / crown.x, 1.0 - there.z / crown.y);
    vec4 facing = texture(foliage, vec3(clamp(place, 0.0, 1.0), crown.z), level_bias);
    float weight = smoothstep(FLAT.x, FLAT.y, forward / length(ray)) * smoothstep(0.0, threshold, facing.a);
    return mix(own, facing.rgb, weight);
}

void main() {
    vec4 leaf = in_map ? texture(foliage, at, level_bias) : leaf_texture(at);
    if (leaf.a < threshold) discard;
    vec3 color = in_map ? leaf.rgb : facing_color(leaf.rgb);
    seen = uint(first + triangle) + 1u;
    albedo = vec4(sqrt(color), 1.0);  // square roots, so that eight bits resolve dark greens
}
