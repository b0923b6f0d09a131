// One vertex of a tree: four corners of each of three quads, numbered by gl_VertexID. See terrain/gbuffer/tree_instances.py.
in vec3 base;
in vec4 shape;  // half widths of the upright quads and of the level one, height, height of the level one
in vec3 look;   // cosine and sine of the turn, number of the look
uniform float curvature;

const vec2 CORNERS[4] = vec2[](vec2(-1, 0), vec2(1, 0), vec2(1, 1), vec2(-1, 1));

// Offset from the foot: east and north before the lean of "up", and up.
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

// Texture coordinates and layer: pictures from the side are even layers, from above odd ones.
vec3 tree_texture() {
    vec2 corner = CORNERS[gl_VertexID % 4];
    return vec3(0.5 * corner.x + 0.5, 1.0 - corner.y, 2.0 * look.z + (gl_VertexID / 4 == 2 ? 1.0 : 0.0));
}
