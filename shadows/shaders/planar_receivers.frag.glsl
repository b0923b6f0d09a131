uniform sampler2D receivers;  // 1 where the view shows the ground

void main() { if (texelFetch(receivers, ivec2(gl_FragCoord.xy), 0).r == 0.0) discard; }
