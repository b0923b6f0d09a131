uniform sampler2D receivers;  // the number of each pixel's plane
uniform float number;

void main() { if (texelFetch(receivers, ivec2(gl_FragCoord.xy), 0).r != number) discard; }
