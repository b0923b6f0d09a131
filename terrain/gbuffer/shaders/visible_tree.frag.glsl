uniform int first;
uniform sampler2DArray foliage;
uniform float threshold;
uniform float level_bias;  // of the pictures of leaves, where pixels are less wide than their distance
uniform bool in_map;
flat in int tree;
flat in vec3 foot;
flat in vec3 crown;
in vec3 above_foot;
in vec3 at;
layout(location = 0) out uint seen;
layout(location = 1) out vec4 albedo;

// Rays flatter than the second (a cosine) take their colour from the picture upright before the eye, steeper ones than the first none.
const vec2 FLAT = vec2(0.35, 0.65);

// The colour that the picture from the side would show if it stood upright before the eye, whichever quad is seen: what is drawn out
// on a quad that is seen along its plane would draw a line through the crown. What is leaf and what is gap the quad says.
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
    seen = uint(first + tree * 6 + gl_PrimitiveID) + 1u;
    albedo = vec4(sqrt(color), 1.0);  // roots, so that eight bits hold dark greens
}
