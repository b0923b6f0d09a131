#version 430
// Visibility of the sun from an orthographic depth map. The comparison is derived in shadows/shadow_map.py.
uniform sampler2D position_frame_m;  // rgb: the visible points
uniform sampler2D normal_frame;      // rgb: their triangles' unit normals, a: crease
uniform sampler2D node_frame_m;      // rgb: the nodes of the surface they lie on
uniform sampler2D depth_map;
uniform mat3 light_from_frame;
uniform vec3 light_offset_m;
uniform vec3 window_m;
uniform vec2 texel_m;
uniform ivec2 map_size;
uniform vec2 first_node;  // node coordinates (column, row) of the first pixel's centre
uniform vec2 node_step;
uniform int taps;
uniform float bias_scale;  // 1: as derived
uniform float error_m;     // of a position in float32
uniform float step_m;      // between two depths
out float visibility;

const ivec2 RING[6] = ivec2[](ivec2(1, 0), ivec2(1, -1), ivec2(0, -1), ivec2(-1, 0), ivec2(-1, 1), ivec2(0, 1));

float cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

bool is_lit(vec2 at, float depth) {
    bool outside = any(lessThan(at, vec2(0.0))) || any(greaterThanEqual(at, vec2(map_size)));
    return outside || min(depth, 1.0) <= texelFetch(depth_map, ivec2(at), 0).r;
}

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec3 point = light_from_frame * texelFetch(position_frame_m, pixel, 0).xyz + light_offset_m;
    vec4 facing = texelFetch(normal_frame, pixel, 0);
    vec3 normal = light_from_frame * facing.xyz;
    float crease = facing.w;

    // The nearest node and the six round it.
    ivec2 node = ivec2(floor(first_node + node_step * vec2(pixel) + 0.5));
    vec3 middle = light_from_frame * texelFetch(node_frame_m, node, 0).xyz + light_offset_m;
    vec3 ring[7];
    for (int k = 0; k < 6; k++) {
        ring[k] = light_from_frame * texelFetch(node_frame_m, node + RING[k], 0).xyz + light_offset_m - middle;
    }
    ring[6] = ring[0];

    float rounding = (0.5 * step_m + error_m) / window_m.z;
    int lit = 0, counted = 0;
    for (int row = 0; row < taps; row++) {
        for (int col = 0; col < taps; col++) {
            vec2 at = floor(point.xy / texel_m + vec2(col, row) - 0.5 * float(taps - 1));
            vec2 aside = (at + 0.5) * texel_m - middle.xy;
            for (int k = 0; k < 6; k++) {
                vec3 a = ring[k], b = ring[k + 1];
                float area = cross2(a.xy, b.xy);  // positive where the triangle faces the sun; NaN without a node
                float u = cross2(aside, b.xy), v = cross2(a.xy, aside);
                if (area > 0.0 && u >= 0.0 && v >= 0.0 && u + v <= area) {
                    vec2 slope = vec2(a.z * b.y - b.z * a.y, b.z * a.x - a.z * b.x) / area;
                    float surface = mix(point.z, middle.z + dot(slope, aside), bias_scale);
                    float slack = min(dot(abs(slope), texel_m / 128.0 + error_m), length(a - b) + length(a));
                    if (is_lit(at, (surface - slack) / window_m.z - rounding)) lit++;
                    counted++;
                    break;
                }
            }
        }
    }

    if (counted == 0) {  // all beside the ring: a point moved clear of every surface that passes through it
        vec2 reach = (0.5 * float(taps) + 1.0 / 128.0) * texel_m;
        float offset_m = (dot(reach, abs(normal.xy)) + length(reach) * crease) / max(1.0 - 0.5 * crease * crease, 0.25);
        vec3 clear = point + normal * (bias_scale * offset_m + error_m);
        for (int row = 0; row < taps; row++) {
            for (int col = 0; col < taps; col++) {
                vec2 at = floor(clear.xy / texel_m + vec2(col, row) - 0.5 * float(taps - 1));
                if (is_lit(at, clear.z / window_m.z - rounding)) lit++;
                counted++;
            }
        }
    }
    visibility = float(lit) / float(counted);
}
