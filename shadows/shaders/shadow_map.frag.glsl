#version 430
// Visibility of the sun from an orthographic depth map. The bias is derived in shadows/shadow_map.py.
uniform sampler2D position_frame_m;  // rgb
uniform sampler2D normal_frame;      // rgb: the triangle's unit normal, a: crease
uniform sampler2D depth_map;
uniform mat3 light_from_frame;
uniform vec3 light_offset_m;
uniform vec3 window_m;
uniform vec2 texel_m;
uniform ivec2 map_size;
uniform int taps;
uniform float normal_bias_scale;  // 1: the derived bias
uniform float position_error_m;
uniform float depth_bias;         // of the window's depth
out float visibility;

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec3 point = texelFetch(position_frame_m, pixel, 0).xyz;
    vec4 facing = texelFetch(normal_frame, pixel, 0);
    vec3 normal = facing.xyz;
    float crease = facing.w;

    vec2 half_width = (0.5 * float(taps) + 1.0 / 128.0) * texel_m;
    vec2 across = abs((light_from_frame * normal).xy);
    float offset_m = (dot(half_width, across) + length(half_width) * crease) / max(1.0 - 0.5 * crease * crease, 0.25);
    vec3 light_m = light_from_frame * (point + normal * (normal_bias_scale * offset_m + position_error_m)) + light_offset_m;

    vec2 texel = light_m.xy / texel_m - 0.5 * float(taps - 1);
    float depth = min(light_m.z / window_m.z, 1.0) - depth_bias;
    int lit = 0;
    for (int row = 0; row < taps; row++) {
        for (int col = 0; col < taps; col++) {
            ivec2 at = ivec2(floor(texel)) + ivec2(col, row);
            bool outside = any(lessThan(at, ivec2(0))) || any(greaterThanEqual(at, map_size));
            if (outside || depth <= texelFetch(depth_map, at, 0).r) lit++;
        }
    }
    visibility = float(lit) / float(taps * taps);
}
