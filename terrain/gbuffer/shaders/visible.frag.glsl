uniform int first;  // number of triangles in earlier draws
layout(location = 0) out uint seen;
layout(location = 1) out vec4 albedo;

void main() {
    seen = uint(first + gl_PrimitiveID) + 1u;
    albedo = vec4(0.0);
}
