// Project a caster's point onto a plane and into the view; shadows/planar.py derives it.
uniform mat4 clip_from_caster;
uniform float position_error;  // float32 error, as a share of a position's largest coordinate
uniform vec4 plane;            // its dot product with a homogeneous point is the point's height
uniform float plane_error_m;   // bound of the receivers' distance from the plane

vec4 projected(vec3 caster_m) {
    vec3 away = abs(caster_m);
    float error_m = max(position_error * max(max(away.x, away.y), away.z), plane_error_m);
    gl_ClipDistance[0] = dot(plane, vec4(caster_m, 1.0)) - error_m;
    return clip_from_caster * vec4(caster_m, 1.0);
}
