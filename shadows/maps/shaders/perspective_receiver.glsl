// The visible point of a pixel, as a perspective shadow map has it, held against the map. Derived in
// shadows/maps/perspective_shadow_map.py.
uniform sampler2D position_frame_m;  // rgb: the visible points
uniform sampler2D normal_frame;      // rgb: their triangles' unit normals, a: crease
uniform sampler2D corner_frame_m;    // rgb: three texels a pixel, the corners of the triangle
uniform sampler2D depth_map;
uniform mat4 map_rows;               // to columns, rows and depths in [0, 1] of the map, and what they are divided by
uniform ivec2 map_size;
uniform float bias_scale;            // 1: as derived
uniform float position_error;        // of a position in float32, as a share of its coordinates
uniform float depth_step;            // between two depths that the map can tell apart, in [0, 1]
uniform int taps;                    // that decide on a point, a side of their square, ...
uniform int taps_beside;             // ... and where no triangle is known

const bool lamp = false, on_nodes = false, own = true, in_the_open = false;
const int triangles = 1;
const float ROUNDING = 2.4e-7;       // of a division, as a share of the whole depth

vec3 point;                          // in the map: texels and depth
float w;                             // what it was divided by
vec3 seen;                           // in the frame, as is its normal, towards the light
vec3 normal;
float crease;
float error_m;                       // of positions here
vec3 along_x, along_y, along_z;      // what a step in the frame does in the map
float depth_error;
vec3 share, share_right, share_up;   // of the triangle's corners in the point: there, and how they change by texels
vec2 slope;                          // of the triangle's depth
float depth_at, slack;               // its depth there, and what is taken off it
vec2 range_;                         // the depths of its corners: where the light grazes it, all that is known

float cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

vec2 texel_of(vec3 p) { return p.xy; }
bool is_outside(vec2 at) { return any(lessThan(at, vec2(0.0))) || any(greaterThanEqual(at, vec2(map_size))); }
float held(vec2 at) { return texelFetch(depth_map, ivec2(at), 0).r; }
bool is_lit(vec2 at, float z) { return is_outside(at) || min(z - 0.5 * depth_step, 1.0) <= held(at); }

// Read a pixel; false where there is no surface.
bool receive(ivec2 pixel) {
    seen = texelFetch(position_frame_m, pixel, 0).xyz;
    if (seen.x != seen.x) return false;
    vec4 through = vec4(seen, 1.0) * map_rows;
    w = through.w;
    point = through.xyz / w;
    vec4 facing = texelFetch(normal_frame, pixel, 0);
    normal = facing.xyz;
    crease = facing.w;

    along_x = (map_rows[0].xyz - point.x * map_rows[3].xyz) / w;
    along_y = (map_rows[1].xyz - point.y * map_rows[3].xyz) / w;
    along_z = (map_rows[2].xyz - point.z * map_rows[3].xyz) / w;

    ivec2 first = ivec2(pixel.x * 3, pixel.y);
    vec3 a = texelFetch(corner_frame_m, first, 0).xyz, b = texelFetch(corner_frame_m, first + ivec2(1, 0), 0).xyz;
    vec3 c = texelFetch(corner_frame_m, first + ivec2(2, 0), 0).xyz;
    mat3 sides = transpose(mat3(a - seen, b - seen, c - seen));
    vec3 more = sides * map_rows[3].xyz, ahead = w + more;
    vec3 x = sides * map_rows[0].xyz - point.x * more, y = sides * map_rows[1].xyz - point.y * more;
    vec3 deep = sides * map_rows[2].xyz - point.z * more;
    share = cross(x, y);  // of two corners each, for the third
    share_right = cross(y, ahead);
    share_up = cross(ahead, x);
    float area = 1.0 / dot(share, ahead);
    share *= area;
    share_right *= area;
    share_up *= area;
    slope = vec2(dot(deep, share_right), dot(deep, share_up));
    depth_at = point.z + dot(deep, share);
    range_ = point.z + vec2(-1e30, 1e30);
    if (all(greaterThan(ahead, vec3(0.0)))) {
        deep /= ahead;
        range_ = point.z + vec2(min(deep.x, min(deep.y, deep.z)), max(deep.x, max(deep.y, deep.z)));
    }
    error_m = position_error * sqrt(max(max(dot(a, a), dot(b, b)), dot(c, c)));
    depth_error = error_m * length(along_z) + ROUNDING;
    vec2 grid = 1.0 / 128.0 + error_m * vec2(length(along_x), length(along_y));
    slack = min(dot(abs(slope), grid), range_.y - range_.x) + depth_error;
    // The weights' sum is 1 / w: taps lie up to three texels aside, where errors may be larger.
    float nearer = 1.0 + 3.0 * w * (abs(dot(share_right, vec3(1.0))) + abs(dot(share_up, vec3(1.0))));
    slack *= nearer * nearer;
    return true;
}

// Whether a texel's centre falls into the point's own triangle, and the depth there that the map holds unless something is nearer.
bool is_on_own(vec2 at, out float z) {
    vec2 aside = at + 0.5 - point.xy;
    z = mix(point.z, clamp(depth_at + dot(slope, aside), range_.x, range_.y), bias_scale) - slack;
    return all(greaterThanEqual(share + share_right * aside.x + share_up * aside.y, vec3(0.0)));
}
bool is_on_any(vec2 at, out float z) { return is_on_own(at, z); }

// The point moved clear, for ``taps`` taps a side, of every surface that passes through it.
vec3 clear_of(int taps) {
    // A texel in the frame, at the same depth in the map: the inverse of what a step there does.
    vec3 ray = cross(along_x, along_y), right = cross(along_y, along_z), up = cross(along_z, along_x);
    float volume = dot(ray, along_z);
    right /= volume;
    up /= volume;
    // Foliage is lit from either side; what the light grazes must not be turned into its own body by rounding.
    if (dot(normal, ray) * sign(volume) > 1e-4 * length(ray)) normal = -normal;
    float reach = 0.5 * float(taps) + 1.0 / 128.0;
    float widest = max(length(right + up), length(right - up));
    float offset_m = reach * (abs(dot(normal, right)) + abs(dot(normal, up)) + crease * widest) / max(1.0 - 0.5 * crease * crease, 0.25);
    offset_m /= max(1.0 - offset_m * dot(map_rows[3].xyz, normal) / w, 0.25);
    vec4 through = vec4(seen + normal * (bias_scale * offset_m + error_m), 1.0) * map_rows;
    vec3 clear = through.xyz / through.w;
    return vec3(clear.xy, max(clear.z - depth_error, depth_step));  // what casts before depth 0 is held there, and shades it still
}
