// Project a caster's point onto the plane z = 0 and into the view; shadows/planar.py derives it.
uniform mat4 clip_from_caster;
uniform float position_error;  // float32 error, as a share of a position's largest coordinate

vec4 projected(vec3 caster_m) {
    vec3 away = abs(caster_m);
    gl_ClipDistance[0] = caster_m.z - position_error * max(max(away.x, away.y), away.z);
    return clip_from_caster * vec4(caster_m, 1.0);
}
