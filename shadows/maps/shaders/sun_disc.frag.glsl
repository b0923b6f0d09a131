// Compute the visibility of the sun's disc from a depth map: the share of its samples that no texel covers. Each texel is projected
// onto the disc at its stored depth. docs/shadow-maps.md derives it.
uniform sampler2D least_depth;       // minimum depth of each block of block_texels x block_texels texels
uniform int block_texels;
uniform ivec2 first_texel;           // first texel of the map, relative to the anchor
uniform float disc_tangent;          // tangent of the disc's angular radius
uniform vec2 widest_m;               // upper bound of the disc's half widths across the map
uniform uvec4 left_of[129];          // bits of the samples whose position right (in [-1, 1]) is less than an edge's
uniform uvec4 below[129];            // the same for up
out float visibility;

const uvec4 NONE = uvec4(0u), ALL = uvec4(0xffffffffu);
const int ACROSS = 16;               // cells along the disc's diameter; more texels are merged into cells

int count(uvec4 samples) {
    ivec4 bits = bitCount(samples);
    return bits.x + bits.y + bits.z + bits.w;
}

// Return the samples in a rectangle.
uvec4 samples_in(vec2 low, vec2 high) {
    ivec4 edge = ivec4((0.5 * clamp(vec4(low, high), -1.0, 1.0) + 0.5) * 128.0 + 0.5);
    return left_of[edge.z] & ~left_of[edge.x] & below[edge.w] & ~below[edge.y];
}

// Return the samples behind the receiver's own plane.
uvec4 samples_behind_own() {
    uvec4 behind = NONE;
    if (-normal.z > disc_tangent * length(normal.xy)) return behind;
    for (int k = 0; k < 128; k++) {
        float turn = float(k) * 2.39996323, away = sqrt((float(k) + 0.5) / 128.0);
        vec3 direction = vec3(disc_tangent * away * vec2(cos(turn), sin(turn)), -1.0);
        if (dot(normal, direction) <= 0.0) behind[k / 32] |= 1u << (k % 32);
    }
    return behind;
}

// Return half the disc's widths (right, up) at the distance ``ahead_m`` in front of the point: at least a texel, to avoid stairs.
vec2 disc_m(float ahead_m) { return clamp(vec2(ahead_m * disc_tangent), texel_m, widest_m); }

// Return whether a depth at a texel lies on the receiver's own plane, up to rounding.
bool is_own(vec2 texel, float z) {
    vec2 tilt = -normal.xy / min(normal.z, -1e-6);
    float slack_m = dot(abs(tilt), texel_m / 128.0 + error_m) + error_m + 0.5 * depth_step * window_m.z;
    return abs(z - point.z - dot(tilt, texel * texel_m - point.xy)) <= slack_m;
}

// Return the largest distance from the point, across the light's axis, at which an occluder can cover a part of the disc.
vec2 reach_m(float far_m) {
    vec2 reach = vec2(0.0);
    float size = float(block_texels);
    vec2 most = min(vec2(point.z * disc_tangent), widest_m) + texel_m;
    ivec2 last_block = map_size / block_texels - 1;
    ivec2 first = clamp(ivec2(floor((point.xy - most) / (texel_m * size))), ivec2(0), last_block);
    ivec2 last = clamp(ivec2(floor((point.xy + most) / (texel_m * size))), ivec2(0), last_block);
    for (int row = first.y; row <= last.y; row++) {
        for (int col = first.x; col <= last.x; col++) {
            float ahead_m = point.z - texelFetch(least_depth, ivec2(col, row), 0).r * window_m.z;
            vec2 low = vec2(col, row) * size * texel_m - point.xy, high = low + size * texel_m;
            vec2 apart = max(max(low, -high), vec2(0.0)), disc = disc_m(ahead_m);
            if (ahead_m >= far_m && all(lessThan(apart, disc))) reach = max(reach, disc);
        }
    }
    return reach;
}

// Return half the disc's widths at the occluder in a cell of ``size`` texels; 0 unless it lies ``far_m`` in front of the point.
vec2 covering_m(ivec2 cell, ivec2 size, float far_m) {
    ivec2 texel = cell * size + size / 2 - first_texel;
    if (any(lessThan(texel, ivec2(0))) || any(greaterThanEqual(texel, map_size))) return vec2(0.0);
    float z = texelFetch(depth_map, texel, 0).r * window_m.z;
    return point.z - z >= far_m && !is_own(vec2(texel) + 0.5, z) ? disc_m(point.z - z) : vec2(0.0);
}

// Return the samples covered by occluders at least ``far_m`` in front of the point.
uvec4 covered(float far_m) {
    uvec4 dark = samples_behind_own();
    vec2 reach = reach_m(far_m);
    if (reach.x == 0.0) return dark;
    ivec2 size = max(ivec2(ceil(2.0 * reach / (float(ACROSS) * texel_m))), ivec2(1));
    vec2 cell_m = texel_m * vec2(size);
    ivec2 whole = ivec2(floor((vec2(first_texel) + 0.5) / vec2(size)));  // cells are relative to the anchor, so all maps share them
    vec2 shift = vec2(first_texel - whole * size);
    ivec2 first = ivec2(floor(((point.xy - reach) / texel_m + shift) / vec2(size))) + whole;
    ivec2 last = ivec2(floor(((point.xy + reach) / texel_m + shift) / vec2(size))) + whole;
    for (int row = first.y; row <= last.y && dark != ALL; row++) {
        vec2 left = vec2(0.0);
        for (int col = first.x; col <= last.x; col++) {
            vec2 disc = covering_m(ivec2(col, row), size, far_m);
            if (disc.x > 0.0) {
                vec2 corner = vec2(ivec2(col, row) * size - first_texel) * texel_m - point.xy, low = corner / disc;
                vec2 under = covering_m(ivec2(col, row - 1), size, far_m);
                // Close the gap to the previous cells, whose edges are projected from other depths.
                if (left.x > 0.0) low.x = min(low.x, corner.x / left.x);
                if (under.y > 0.0) low.y = min(low.y, corner.y / under.y);
                dark |= samples_in(low, (corner + cell_m) / disc);
            }
            left = disc;
        }
    }
    return dark;
}

// Return whether an occluder in a texel, nearer to the point than ``far_m``, shades a depth.
bool blocks(vec2 at, float z, float far_m) { return !is_lit(at, z) && point.z - held(at) * window_m.z < far_m; }

void main() {
    visibility = 1.0;
    if (!receive(ivec2(gl_FragCoord.xy))) return;
    // At this distance the disc is as wide as a texel. Farther occluders need no bias: they are hundreds of texels away.
    float far_m = min(texel_m.x, texel_m.y) / disc_tangent;
    // Both methods include the range between. A caster that spans both is never missed.
    uvec4 open = ~covered(0.5 * far_m);
    if (open == NONE) { visibility = 0.0; return; }

    // Nearer occluders: the samples spread over a texel's radius, and its texels are compared as in the square filter.
    uvec4 blocked = NONE, unknown = NONE;
    vec2 from = texel_of(point), first = floor(from - 1.0);
    for (int row = 0; row < 3; row++) {
        for (int col = 0; col < 3; col++) {
            vec2 at = first + vec2(col, row);
            float z;
            bool known = own ? is_on_own(at, z) : is_on_any(at, z);
            if (!known) unknown |= samples_in(at - from, at - from + 1.0);
            else if (blocks(at, z, far_m)) blocked |= samples_in(at - from, at - from + 1.0);
        }
    }
    uvec4 counted = open & ~unknown;
    if (counted == NONE) {
        counted = open;
        blocked = NONE;
        vec3 clear = clear_of(taps_without_triangle);
        float radius = 0.5 * float(taps_without_triangle - 1);
        from = texel_of(clear);
        first = floor(from - radius);
        for (int row = 0; row < taps_without_triangle; row++) {
            for (int col = 0; col < taps_without_triangle; col++) {
                vec2 at = first + vec2(col, row);
                if (blocks(at, clear.z, far_m)) blocked |= samples_in((at - from) / radius, (at - from + 1.0) / radius);
            }
        }
    }
    visibility = float(count(open)) / 128.0 * float(count(counted & ~blocked)) / float(count(counted));
}
