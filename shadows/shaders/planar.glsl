// A caster's point, projected onto the plane z = 0 and into the view; see shadows/planar.py.
uniform mat4 clip_from_caster;
uniform float error_m;  // of a height in float32

vec4 projected(vec3 caster_m) {
    gl_ClipDistance[0] = caster_m.z - error_m;
    return clip_from_caster * vec4(caster_m, 1.0);
}
