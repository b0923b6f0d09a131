// Perspective with reversed depth near / z: 1 at the near plane, 0 at infinity.
in vec3 position;
uniform mat3 camera_from_frame;
uniform vec3 eye_frame_m;
uniform vec4 window;  // clip = xy * window.xy + z * window.zw
uniform float near_m;

void main() {
    vec3 camera = camera_from_frame * (position - eye_frame_m);
    gl_Position = vec4(camera.xy * window.xy + camera.z * window.zw, near_m, camera.z);
}
