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

// The colour of the side view as an upright billboard that faces the eye, whichever quad is seen. Otherwise the stretched texture
// of a quad seen edge-on would draw a line through the crown. The alpha test still uses the quad's own texture.
vec3 facing_color(vec3 own) {
    vec3 ray = foot + above_foot;
    vec2 ahead = normalize(foot.xy);
    float forward = dot(ray.xy, ahead);
    vec3 there = above_foot - ray * (dot(above_foot.xy, ahead) / max(forward, 1e-3 * length(ray)));
    vec2 place = vec2(0.5 + 0.5 * dot(there.xy, vec2(ahead.y, -ahead.x)) / crown.x, 1.0 - there.z / crown.y);
    vec3 facing = texture(foliage, vec3(clamp(place, 0.0, 1.0), crown.z), level_bias).rgb;
    return mix(own, facing, smoothstep(FLAT.x, FLAT.y, forward / length(ray)));
}

void main() {
    vec4 leaf = texture(foliage, at, level_bias);
    if (leaf.a < threshold) discard;
    vec3 color = in_map ? leaf.rgb : facing_color(leaf.rgb);
    seen = uint(first + triangle) + 1u;
    albedo = vec4(sqrt(color), 1.0);  // square roots, so that eight bits resolve dark greens
}
