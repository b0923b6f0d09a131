// Transform points from a frame to a light's clip space. The sun's map is orthographic: metres from its corner over its extent. A
// lamp's map is in perspective, with depths between the nearest and the farthest receiver.
uniform bool lamp;
uniform mat3 light_from_frame;
uniform vec3 light_offset_m;
uniform vec3 window_m;       // extent of the sun's map
uniform float tangent;       // half the width of a lamp's map at distance 1
uniform vec2 near_far_m;     // depth range of a lamp's map

vec4 light_clip(vec3 frame_m) {
    vec3 light_m = light_from_frame * frame_m + light_offset_m;
    if (!lamp) return vec4(2.0 * light_m / window_m - 1.0, 1.0);
    float n = near_far_m.x, f = near_far_m.y;
    return vec4(light_m.xy / tangent, (light_m.z * (f + n) - 2.0 * f * n) / (f - n), light_m.z);
}
