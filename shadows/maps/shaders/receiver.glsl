// Compare the visible point of a pixel with a light's depth map. docs/shadow-maps.md derives it.
uniform sampler2D position_frame_m;  // rgb: the visible points
uniform sampler2D normal_frame;      // rgb: unit normals of their triangles, a: crease; negative off the triangles of a map's
                                     // ground, or, without such ground, on the top of a column
uniform sampler2D node_frame_m;      // rgb: nodes of a map's ground, a: 1 if the quad south-east of it is cut to its south-east
uniform sampler2D corner_frame_m;    // rgb: three texels per pixel, the corners of the triangle; zeros on a map's ground
uniform sampler2D depth_map;
uniform bool on_nodes;               // whether the view has a map's ground
uniform bool has_corners;
uniform bool lamp;
uniform mat3 light_from_frame;
uniform vec3 light_offset_m;
uniform vec3 window_m;               // extent of the sun's map
uniform vec2 texel_m;
uniform float tangent;               // half the width of a lamp's map at distance 1
uniform vec2 near_far_m;
uniform int faces;                   // 1, or 6 of an omni light, in two rows of three
uniform mat3 face_from_lamp[6];
uniform ivec2 map_size;              // texels of a face
uniform vec2 first_node;             // node coordinates (column, row) of the first pixel's centre
uniform vec2 node_step;
uniform bool placed;                 // whether the pixels are gathered from a map's, with their places in ``place``
uniform sampler2D place;             // rg: column and row of a pixel
uniform bool uses_triangles;           // whether depths are compared on known triangles
uniform bool uses_offset;              // whether other points are moved along their normals
uniform float bias_scale;            // factor of the derived offset
uniform float error_m;               // float32 error of a position
uniform float depth_step;            // resolution of the map's depths in [0, 1]
uniform int taps;                    // taps along a side of the square around a point
uniform int taps_without_triangle;             // the same where no triangle is known
uniform bool lit_by_taps;            // whether the taps alone determine the visibility

// The ring around a node, counter-clockwise from above: its neighbours, and the corners of its quads between them.
const ivec2 RING[8] = ivec2[](
    ivec2(1, 0), ivec2(1, -1), ivec2(0, -1), ivec2(-1, -1), ivec2(-1, 0), ivec2(-1, 1), ivec2(0, 1), ivec2(1, 1)
);

const float ON_EDGE = 1e-5;          // share of a cell: a point so near to an edge belongs to both sides

vec3 point;                          // in light space, as are the following
vec3 normal;                         // towards the light
float crease;
vec3 middle, ring[9];                // a corner of the known triangles, and the others relative to it
int triangles = 0;
bool own = false;                    // whether the known triangle is the point's own
bool on_top;                         // on the top of a column: the triangle and its other half
bool in_the_open = false;            // whether no tap can meet a caster
vec3 e, g;                           // for the sun: its sides over its area, its slope, and the amount subtracted from its depth
vec2 slope;
float slack_m;
ivec2 face_origin = ivec2(0);

float cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

// Return the texel coordinates of a light-space point, and the map's depth for a distance along the light's axis.
vec2 texel_of(vec3 p) { return lamp ? (0.5 + 0.5 * p.xy / (p.z * tangent)) * vec2(map_size) : p.xy / texel_m; }
float depth_of(float z) {
    if (!lamp) return z / window_m.z;
    float n = near_far_m.x, f = near_far_m.y;
    return 0.5 + 0.5 * ((f + n) - 2.0 * f * n / max(z, 0.5 * n)) / (f - n);
}

bool is_outside(vec2 at) { return any(lessThan(at, vec2(0.0))) || any(greaterThanEqual(at, vec2(map_size))); }
float held(vec2 at) { return texelFetch(depth_map, face_origin + ivec2(at), 0).r; }

// Return whether a distance along the light's axis is lit in a texel.
bool is_lit(vec2 at, float z) {
    float rounding = uses_offset ? 0.5 * depth_step : 0.0;
    return is_outside(at) || min(depth_of(z) - rounding, 1.0) <= held(at);
}

// Return whether the light meets a triangle (a corner, and its sides from there) at a texel's centre, and the distance along the
// light's axis. The slack is the depth error from the rasteriser's grid of 1/256 texel. The triangle must face the sun; under a
// lamp it may face either way.
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

vec3 in_light(vec3 frame_m) { return light_from_frame * frame_m + light_offset_m; }

// Return the point moved clear of every surface that passes through it, for ``count`` taps along a side.
vec3 clear_of(int count) {
    if (!uses_offset) return point;
    vec2 side = lamp ? vec2(2.0 * tangent * point.z) / vec2(map_size) : texel_m;
    vec2 reach = (0.5 * float(count) + 1.0 / 128.0) * side;
    float offset_m = (dot(reach, abs(normal.xy)) + length(reach) * crease) / max(1.0 - 0.5 * crease * crease, 0.25);
    return point + normal * (bias_scale * offset_m + error_m) - vec3(0.0, 0.0, error_m);
}

// Return whether the map holds no caster in a square of taps around a point.
bool is_empty(vec3 p, int count) {
    vec2 first = floor(texel_of(p) - 0.5 * float(count - 1));
    for (int row = 0; row < count; row++) {
        for (int col = 0; col < count; col++) {
            vec2 at = first + vec2(col, row);
            if (!is_outside(at) && held(at) < 1.0) return false;
        }
    }
    return true;
}

// Read a pixel; return false off the surface.
bool receive(ivec2 pixel) {
    vec3 seen = texelFetch(position_frame_m, pixel, 0).xyz;
    if (seen.x != seen.x) return false;
    point = in_light(seen);
    vec4 facing = texelFetch(normal_frame, pixel, 0);
    normal = light_from_frame * facing.xyz;
    on_top = !on_nodes && facing.w < 0.0;
    crease = on_top ? 0.0 : abs(facing.w);

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
    if (dot(normal, lamp ? point : vec3(0.0, 0.0, 1.0)) > 0.0) normal = -normal;  // foliage is lit from either side
    if (!uses_triangles) return true;
    if (lit_by_taps && !lamp && is_empty(point, taps) && is_empty(clear_of(taps_without_triangle), taps_without_triangle)) {
        in_the_open = true;
        return true;
    }

    // The triangles that the map may hold at the point's taps: those around the nearest node of a map's ground, otherwise the
    // point's own.
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
    if (on_nodes && !own && facing.w >= 0.0) {
        vec2 at = first_node + node_step * (placed ? texelFetch(place, pixel, 0).xy : vec2(pixel));
        ivec2 low = ivec2(ceil(at - 0.5 - ON_EDGE)), high = ivec2(floor(at + 0.5 + ON_EDGE)), node = low;
        vec3 centre = texelFetch(node_frame_m, node, 0).xyz;
        middle = turned * in_light(centre);
        for (int k = 1; k < 4; k++) {  // half-way between nodes, take the one nearest to the light
            ivec2 other = ivec2(k % 2 == 1 ? high.x : low.x, k / 2 == 1 ? high.y : low.y);
            if (other == node) continue;
            vec3 candidate = texelFetch(node_frame_m, other, 0).xyz, in_map = turned * in_light(candidate);
            if (in_map.z < middle.z || middle.z != middle.z) { node = other; centre = candidate; middle = in_map; }
        }
        vec2 aside = at - vec2(node);
        // The ring's nodes, without corners of quads whose cut misses the node.
        vec3 around[9];
        ivec2 beside[9];
        for (int k = 0; k < 8; k++) {
            if (k % 2 == 1) {
                bool is_cut_nw_se = texelFetch(node_frame_m, node + min(RING[k], ivec2(0)), 0).w > 0.5;
                if (is_cut_nw_se != (RING[k].x == RING[k].y)) continue;
            }
            around[triangles] = texelFetch(node_frame_m, node + RING[k], 0).xyz;
            beside[triangles++] = RING[k];
        }
        around[triangles] = around[0];
        beside[triangles] = beside[0];
        // The point's own triangle comes first. Where several share the point, it is the one that faces the light most.
        vec3 to_light = transpose(turned * light_from_frame) * (lamp ? -point : vec3(0.0, 0.0, -1.0));
        int mine = 0;
        float most = -1e30;
        for (int k = 0; k < triangles; k++) {
            vec2 a = vec2(beside[k]), b = vec2(beside[k + 1]);
            if (cross2(a, aside) > ON_EDGE || cross2(aside, b) > ON_EDGE) continue;  // rows run down: counter-clockwise is negative
            vec3 face = cross(around[k] - centre, around[k + 1] - centre);
            float facing = dot(face, to_light) / length(face);
            if (facing > most) { most = facing; mine = k; }
        }
        for (int k = 0; k < triangles; k++)
            ring[k] = turned * in_light(around[(mine + k) % triangles]) - middle;
        ring[triangles] = ring[0];
    }
    if (own && !lamp) {  // as in ``meets``, with the common terms of all taps
        e = ring[0];
        g = ring[1];
        float area = cross2(e.xy, g.xy);
        slope = vec2(e.z * g.y - g.z * e.y, g.z * e.x - e.z * g.x) / area;
        slack_m = min(dot(abs(slope), texel_m / 128.0 + error_m), length(e) + length(g)) + error_m;
        g /= area;
        e /= area;
    }
    return true;
}

// Return whether a texel's centre lies in the point's own triangle, and the triangle's depth there; for the sun.
bool is_on_own(vec2 at, out float z) {
    vec2 aside = (at + 0.5) * texel_m - middle.xy;
    float u = cross2(aside, g.xy), v = cross2(e.xy, aside);
    z = mix(point.z, middle.z + dot(slope, aside), bias_scale) - slack_m;
    return u >= 0.0 && v >= 0.0 && (on_top ? max(u, v) : u + v) <= 1.0;
}

// Return the same for any known triangle: the own one first, otherwise the one whose depth is nearest to the point's. A centre may
// lie in several triangles if the ring is folded as seen from the light. This is a function of its own, since a test in each tap's
// loop would cost more than the taps.
bool is_on_any(vec2 at, out float z) {
    float least = 1e30;
    for (int k = 0; k < triangles; k++) {
        float there, slack;
        if (!meets(middle, ring[k], ring[k + 1], at + 0.5, there, slack)) continue;
        float apart = k == 0 ? -1.0 : abs(there - point.z);
        if (apart >= least) continue;
        least = apart;
        z = mix(point.z, there, bias_scale) - slack - error_m;
        if (k == 0) return true;
    }
    return least < 1e30;
}
