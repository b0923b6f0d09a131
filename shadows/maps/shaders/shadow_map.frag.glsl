// Compute the visibility of a light from a depth map: the share of lit texels in a square around the point.
out float visibility;

// Return the overlap of a tap with the square of count - 1 texels around the point. The lit share of this square has no stairs.
float weight_of(int count, int col, int row, vec2 beyond) {
    if (count == 1) return 1.0;
    float across = col == 0 ? 1.0 - beyond.x : col == count - 1 ? beyond.x : 1.0;
    float down = row == 0 ? 1.0 - beyond.y : row == count - 1 ? beyond.y : 1.0;
    return max(across * down, 1e-6);
}

void main() {
    if (!receive(ivec2(gl_FragCoord.xy))) { visibility = 1.0; return; }
    if (lamp && point.z <= 0.0) { visibility = 0.0; return; }
    if (in_the_open) { visibility = 1.0; return; }
    precise float lit = 0.0, counted = 0.0;  // summed in the same order, so that full visibility is exactly 1
    float z;
    vec2 corner = texel_of(point) - 0.5 * float(taps - 1);
    vec2 first_tap = floor(corner), beyond = fract(corner);
    if (own && !lamp) {
        for (int row = 0; row < taps; row++) {
            for (int col = 0; col < taps; col++) {
                vec2 at = first_tap + vec2(col, row);
                if (is_on_own(at, z)) {
                    float weight = weight_of(taps, col, row, beyond);
                    if (is_lit(at, z)) lit += weight;
                    counted += weight;
                }
            }
        }
    } else if ((lamp || on_nodes) && triangles > 0) {  // compiled away where constants exclude it
        for (int row = 0; row < taps; row++) {
            for (int col = 0; col < taps; col++) {
                vec2 at = first_tap + vec2(col, row);
                if (is_on_any(at, z)) {
                    float weight = weight_of(taps, col, row, beyond);
                    if (is_lit(at, z)) lit += weight;
                    counted += weight;
                }
            }
        }
    }
    if (counted == 0.0) {
        vec3 clear = clear_of(taps_without_triangle);
        corner = texel_of(clear) - 0.5 * float(taps_without_triangle - 1);
        first_tap = floor(corner);
        beyond = fract(corner);
        for (int row = 0; row < taps_without_triangle; row++) {
            for (int col = 0; col < taps_without_triangle; col++) {
                float weight = weight_of(taps_without_triangle, col, row, beyond);
                if (is_lit(first_tap + vec2(col, row), clear.z)) lit += weight;
                counted += weight;
            }
        }
    }
    visibility = lit / counted;
}
