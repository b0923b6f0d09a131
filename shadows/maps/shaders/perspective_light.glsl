// Transform points from a frame to the clip space of a perspective shadow map.
uniform mat4 clip_rows;

vec4 light_clip(vec3 frame_m) { return vec4(frame_m, 1.0) * clip_rows; }
