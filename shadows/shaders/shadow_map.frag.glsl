// Visibility of a light from a depth map. The comparison is derived in shadows/shadow_map.py.
uniform sampler2D position_frame_m;  // rgb: the visible points
uniform sampler2D normal_frame;      // rgb: their triangles' unit normals, a: crease
uniform sampler2D node_frame_m;      // rgb: the nodes of a map's ground
uniform sampler2D corner_frame_m;    // rgb: three texels a pixel, the corners of the triangle; zeros on a map's ground
uniform sampler2D depth_map;
uniform bool on_nodes;               // whether there is a map's ground
uniform bool has_corners;
uniform bool lamp;
uniform mat3 light_from_frame;
uniform vec3 light_offset_m;
uniform vec3 window_m;               // the sun's map
uniform vec2 texel_m;
uniform float tangent;               // a lamp's map
uniform vec2 near_far_m;
uniform int faces;                   // 1, or 6 of an omni light: three beside one another, in two rows
uniform mat3 face_from_lamp[6];
uniform ivec2 map_size;              // of a face
uniform vec2 first_node;             // node coordinates (column, row) of the first pixel's centre
uniform vec2 node_step;
uniform int taps;
uniform float bias_scale;            // 1: as derived
uniform float error_m;               // of a position in float32
uniform float depth_step;                  // between two depths that the map can tell apart, in [0, 1]
out float visibility;

const ivec2 RING[6] = ivec2[](ivec2(1, 0), ivec2(1, -1), ivec2(0, -1), ivec2(-1, 0), ivec2(-1, 1), ivec2(0, 1));

ivec2 face_origin = ivec2(0);

float cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

// Texel coordinates of a light-space point, and the depth that the map would hold for a distance along its axis.
vec2 texel_of(vec3 p) { return lamp ? (0.5 + 0.5 * p.xy / (p.z * tangent)) * vec2(map_size) : p.xy / texel_m; }
float depth_of(float z) {
    if (!lamp) return z / window_m.z;
    float n = near_far_m.x, f = near_far_m.y;
    return 0.5 + 0.5 * ((f + n) - 2.0 * f * n / max(z, 0.5 * n)) / (f - n);
}

bool is_lit(vec2 at, float depth) {
    bool outside = any(lessThan(at, vec2(0.0))) || any(greaterThanEqual(at, vec2(map_size)));
    return outside || min(depth, 1.0) <= texelFetch(depth_map, face_origin + ivec2(at), 0).r;
}

// Whether the light meets a triangle (a corner, and its sides from there) in a texel's centre, and how far along its axis; the
// slack is what the rasteriser's grid of 1/256 texel makes of the slope. The sun's must face it, a lamp's may lie either way.
bool meets(vec3 base, vec3 e, vec3 g, vec2 centre, out float z, out float slack) {
    float around = length(e) + length(g);
    if (lamp) {
        vec3 ray = vec3((2.0 * centre / vec2(map_size) - 1.0) * tangent, 1.0);
        vec3 p = base, q = base + e, r = base + g;
        vec3 sides = vec3(dot(cross(q, r), ray), dot(cross(r, p), ray), dot(cross(p, q), ray));
        bool front = all(greaterThanEqual(sides, vec3(0.0))), back = all(lessThanEqual(sides, vec3(0.0)));
        vec3 normal = cross(q - p, r - p);
        float along = dot(normal, ray);
        z = dot(normal, p) / along;
        float slope = length(normal.xy) / max(abs(along), 1e-30);
        slack = min(slope * (abs(z) * tangent / (64.0 * float(map_size.x)) + error_m), around);
        return along != 0.0 && z > 0.0 && (front || back);
    }
    vec2 aside = centre * texel_m - base.xy;
    float area = cross2(e.xy, g.xy);
    float u = cross2(aside, g.xy), v = cross2(e.xy, aside);
    vec2 slope = vec2(e.z * g.y - g.z * e.y, g.z * e.x - e.z * g.x) / area;
    z = base.z + dot(slope, aside);
    slack = min(dot(abs(slope), texel_m / 128.0 + error_m), around);
    return area > 0.0 && u >= 0.0 && v >= 0.0 && u + v <= area;
}

// How much of a tap lies in the square of count - 1 texels round the point: the share of lit texels in it has no stairs.
float weight_of(int count, int col, int row, vec2 beyond) {
    if (count == 1) return 1.0;
    float across = col == 0 ? 1.0 - beyond.x : col == count - 1 ? beyond.x : 1.0;
    float down = row == 0 ? 1.0 - beyond.y : row == count - 1 ? beyond.y : 1.0;
    return max(across * down, 1e-6);
}

vec3 in_light(vec3 frame_m) { return light_from_frame * frame_m + light_offset_m; }

void main() {
    ivec2 pixel = ivec2(gl_FragCoord.xy);
    vec3 seen = texelFetch(position_frame_m, pixel, 0).xyz;
    if (seen.x != seen.x) { visibility = 1.0; return; }  // no surface
    vec3 point = in_light(seen);
    vec4 facing = texelFetch(normal_frame, pixel, 0);
    vec3 normal = light_from_frame * facing.xyz;
    float crease = facing.w;

    mat3 turned = mat3(1.0);
    if (faces == 6) {  // the face that the point lies in front of
        float best = 0.0;
        int face = 0;
        for (int k = 0; k < 6; k++) {
            float ahead = (face_from_lamp[k] * point).z;
            if (ahead > best) { best = ahead; face = k; }
        }
        turned = face_from_lamp[face];
        face_origin = ivec2(face % 3, face / 3) * map_size;
        point = turned * point;
        normal = turned * normal;
    }
    if (lamp && point.z <= 0.0) { visibility = 0.0; return; }
    if (dot(normal, lamp ? point : vec3(0.0, 0.0, 1.0)) > 0.0) normal = -normal;  // foliage is lit from either side

    // The triangles that the map may hold where the point is looked up: the six round the nearest node of a map's ground, else
    // the point's own.
    vec3 middle = point, ring[7];
    int triangles = 0;
    bool own = false;
    if (has_corners) {
        ivec2 first = ivec2(pixel.x * 3, pixel.y);
        vec3 a = texelFetch(corner_frame_m, first, 0).xyz, b = texelFetch(corner_frame_m, first + ivec2(1, 0), 0).xyz;
        vec3 c = texelFetch(corner_frame_m, first + ivec2(2, 0), 0).xyz;
        own = a != b;
        if (own) {
            middle = turned * in_light(a);
            ring[0] = turned * in_light(b) - middle;
            ring[1] = turned * in_light(c) - middle;
            triangles = 1;
        }
    }
    if (on_nodes && !own) {
        ivec2 node = ivec2(floor(first_node + node_step * vec2(pixel) + 0.5));
        middle = turned * in_light(texelFetch(node_frame_m, node, 0).xyz);
        for (int k = 0; k < 6; k++) ring[k] = turned * in_light(texelFetch(node_frame_m, node + RING[k], 0).xyz) - middle;
        ring[6] = ring[0];
        triangles = 6;
    }

    float rounding = 0.5 * depth_step;
    float lit = 0.0, counted = 0.0;
    vec2 corner = texel_of(point) - 0.5 * float(taps - 1);
    vec2 first_tap = floor(corner), beyond = fract(corner);
    if (own && !lamp) {  // as ``meets`` says, with all that the taps share taken out
        vec3 e = ring[0], g = ring[1];
        float area = cross2(e.xy, g.xy);
        vec2 slope = vec2(e.z * g.y - g.z * e.y, g.z * e.x - e.z * g.x) / area;
        float slack = min(dot(abs(slope), texel_m / 128.0 + error_m), length(e) + length(g)) + error_m;
        g /= area;
        e /= area;
        for (int row = 0; row < taps; row++) {
            for (int col = 0; col < taps; col++) {
                vec2 at = first_tap + vec2(col, row);
                vec2 aside = (at + 0.5) * texel_m - middle.xy;
                float u = cross2(aside, g.xy), v = cross2(e.xy, aside);
                if (u >= 0.0 && v >= 0.0 && u + v <= 1.0) {
                    float weight = weight_of(taps, col, row, beyond);
                    float surface = mix(point.z, middle.z + dot(slope, aside), bias_scale);
                    if (is_lit(at, depth_of(surface - slack) - rounding)) lit += weight;
                    counted += weight;
                }
            }
        }
    } else {
        for (int row = 0; row < taps; row++) {
            for (int col = 0; col < taps; col++) {
                vec2 at = first_tap + vec2(col, row);
                for (int k = 0; k < triangles; k++) {
                    float z, slack;
                    if (meets(middle, ring[k], ring[k + 1], at + 0.5, z, slack)) {
                        float weight = weight_of(taps, col, row, beyond);
                        float surface = mix(point.z, z, bias_scale);
                        if (is_lit(at, depth_of(surface - slack - error_m) - rounding)) lit += weight;
                        counted += weight;
                        break;
                    }
                }
            }
        }
    }

    if (counted == 0.0) {  // all beside them: a point moved clear of every surface that passes through it
        vec2 side = lamp ? vec2(2.0 * tangent * point.z) / vec2(map_size) : texel_m;
        int few = min(taps, 2);  // the fewer, the nearer: what is moved far clear of its own misses what touches it
        vec2 reach = (0.5 * float(few) + 1.0 / 128.0) * side;
        float offset_m = (dot(reach, abs(normal.xy)) + length(reach) * crease) / max(1.0 - 0.5 * crease * crease, 0.25);
        vec3 clear = point + normal * (bias_scale * offset_m + error_m);
        corner = texel_of(clear) - 0.5 * float(few - 1);
        first_tap = floor(corner);
        beyond = fract(corner);
        for (int row = 0; row < few; row++) {
            for (int col = 0; col < few; col++) {
                float weight = weight_of(few, col, row, beyond);
                if (is_lit(first_tap + vec2(col, row), depth_of(clear.z - error_m) - rounding)) lit += weight;
                counted += weight;
            }
        }
    }
    visibility = lit / counted;
}
