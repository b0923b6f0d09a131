// One vertex of a tree. gl_VertexID numbers four corners of each of three quads. See terrain/gbuffer/tree_instances.py.
in vec3 base;
in vec4 shape;  // half width of the upright quads, half width of the level quad, tree height, height of the level quad
in vec3 look;   // cosine and sine of the rotation about the stem, index of the tree variant
uniform float curvature;

const vec2 CORNERS[4] = vec2[](vec2(-1, 0), vec2(1, 0), vec2(1, 1), vec2(-1, 1));

// Offset from the foot: east, north and up. tree_position applies the curvature to "up".
vec3 tree_offset() {
    int quad = gl_VertexID / 4;
    vec2 corner = CORNERS[gl_VertexID % 4];
    vec2 level = quad == 0 ? vec2(corner.x * shape.x, 0.0) : quad == 1 ? vec2(0.0, corner.x * shape.x)
        : vec2(corner.x, 2.0 * corner.y - 1.0) * shape.y;
    float up = quad == 2 ? shape.w : corner.y * shape.z;
    return vec3(level.x * look.x - level.y * look.y, level.x * look.y + level.y * look.x, up);
}

vec3 tree_position(vec3 offset) {
    vec3 up = normalize(vec3(base.xy * curvature, 1.0));
    return base + vec3(offset.xy, 0.0) + offset.z * up;
}

// Texture coordinates and layer: side views are even layers, top views odd ones.
vec3 tree_texture() {
    vec2 corner = CORNERS[gl_VertexID % 4];
    return vec3(0.5 * corner.x + 0.5, 1.0 - corner.y, 2.0 * look.z + (gl_VertexID / 4 == 2 ? 1.0 : 0.0));
}
