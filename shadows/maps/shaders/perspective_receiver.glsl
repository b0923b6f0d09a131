// Compare the visible point of a pixel with a perspective shadow map. perspective_shadow_map.py derives it.
uniform sampler2D position_frame_m;  // rgb: the visible points
uniform sampler2D normal_frame;      // rgb: unit normals of their triangles, a: crease
uniform sampler2D corner_frame_m;    // rgb: three texels per pixel, the corners of the triangle
uniform sampler2D depth_map;
uniform mat4 map_rows;               // to columns, rows and depths in [0, 1] of the map, and their divisor w
uniform ivec2 map_size;
uniform float bias_scale;            // factor of the derived offset
uniform float position_error;        // float32 error of a position, as a share of its coordinates
uniform float depth_step;            // resolution of the map's depths in [0, 1]
uniform int taps;                    // taps along a side of the square around a point
uniform int taps_without_triangle;             // the same where no triangle is known

const bool lamp = false, on_nodes = false, in_the_open = false;
const int triangles = 1;
const float ROUNDING = 2.4e-7;       // error of a division, as a share of the whole depth

vec3 point;                          // in the map: texels and depth
float w;                             // divisor of the point
vec3 seen;                           // the point in the frame; its normal there faces the light
vec3 normal;
float crease;
float error_m;                       // error of positions at this point
vec3 along_x, along_y, along_z;      // derivatives of the map's coordinates by the frame's
float depth_error;
vec3 share, share_right, share_up;   // barycentric weights of the triangle's corners, and their derivatives by texels
vec2 slope;                          // derivatives of the triangle's depth by texels
float depth_at, slack;               // its depth at the point, and the amount subtracted from it
vec2 range_;                         // bounds of its corners' depths, which limit the depth at grazing light

bool own;                            // whether the triangle is known

float cross2(vec2 a, vec2 b) { return a.x * b.y - a.y * b.x; }

vec2 texel_of(vec3 p) { return p.xy; }
bool is_outside(vec2 at) { return any(lessThan(at, vec2(0.0))) || any(greaterThanEqual(at, vec2(map_size))); }
float held(vec2 at) { return texelFetch(depth_map, ivec2(at), 0).r; }
bool is_lit(vec2 at, float z) { return is_outside(at) || min(z - 0.5 * depth_step, 1.0) <= held(at); }

// Read a pixel; return false off the surface.
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
    own = a != b;
    mat3 sides = transpose(mat3(a - seen, b - seen, c - seen));
    vec3 more = sides * map_rows[3].xyz, ahead = w + more;
    vec3 x = sides * map_rows[0].xyz - point.x * more, y = sides * map_rows[1].xyz - point.y * more;
    vec3 deep = sides * map_rows[2].xyz - point.z * more;
    share = cross(x, y);  // each from two corners, for the third
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
    // The weights sum to 1 / w. Taps lie up to three texels away, where errors may be larger.
    float nearer = 1.0 + 3.0 * w * (abs(dot(share_right, vec3(1.0))) + abs(dot(share_up, vec3(1.0))));
    slack *= nearer * nearer;
    return true;
}

// Return whether a texel's centre lies in the point's own triangle, and the triangle's depth there.
bool is_on_own(vec2 at, out float z) {
    vec2 aside = at + 0.5 - point.xy;
    z = mix(point.z, clamp(depth_at + dot(slope, aside), range_.x, range_.y), bias_scale) - slack;
    return all(greaterThanEqual(share + share_right * aside.x + share_up * aside.y, vec3(0.0)));
}
bool is_on_any(vec2 at, out float z) { return is_on_own(at, z); }

// Return the point moved clear of every surface that passes through it, for ``taps`` taps along a side.
vec3 clear_of(int taps) {
    // A texel's sides in the frame, at constant depth in the map: the inverse of the derivatives.
    vec3 ray = cross(along_x, along_y), right = cross(along_y, along_z), up = cross(along_z, along_x);
    float volume = dot(ray, along_z);
    right /= volume;
    up /= volume;
    // Foliage is lit from either side. Rounding must not flip the normal of a grazed surface into its body.
    if (dot(normal, ray) * sign(volume) > 1e-4 * length(ray)) normal = -normal;
    float reach = 0.5 * float(taps) + 1.0 / 128.0;
    float widest = max(length(right + up), length(right - up));
    float offset_m = reach * (abs(dot(normal, right)) + abs(dot(normal, up)) + crease * widest) / max(1.0 - 0.5 * crease * crease, 0.25);
    offset_m /= max(1.0 - offset_m * dot(map_rows[3].xyz, normal) / w, 0.25);
    vec4 through = vec4(seen + normal * (bias_scale * offset_m + error_m), 1.0) * map_rows;
    vec3 clear = through.xyz / through.w;
    return vec3(clear.xy, max(clear.z - depth_error, depth_step));  // casters in front of depth 0 are clamped to it
}
