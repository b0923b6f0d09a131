// Transform a homogeneous point of a receiver, a caster or a shadow volume. One path for all gives coincident points equal depths.
in vec4 position;
uniform mat4 clip_from_frame;
uniform vec3 origin_frame_m;
invariant gl_Position;

void main() { gl_Position = clip_from_frame * vec4(position.xyz - position.w * origin_frame_m, position.w); }
