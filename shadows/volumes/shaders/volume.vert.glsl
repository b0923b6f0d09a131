// A homogeneous point of a receiver, a caster or a shadow volume: all by this one path, so that what coincides has the same depth.
in vec4 position;
uniform mat4 clip_from_frame;
uniform vec3 origin_frame_m;
invariant gl_Position;

void main() { gl_Position = clip_from_frame * vec4(position.xyz - position.w * origin_frame_m, position.w); }
