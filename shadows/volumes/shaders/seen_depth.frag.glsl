uniform sampler2D seen;  // depth of a point; -1 where drawing the surface gives it, NaN where no point is wanted
uniform bool marking;

void main() {
    float depth = texelFetch(seen, ivec2(gl_FragCoord.xy), 0).r;
    if (depth != depth || !(marking || depth >= 0.0)) discard;
    gl_FragDepth = depth;
}
