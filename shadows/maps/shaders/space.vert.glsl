// Transform points of the frame to a projective space, and from there to a picture of that space.
uniform mat4 space_rows;     // from the frame to the space
uniform mat4 picture_rows;   // from the space to the picture
out vec4 in_space;

vec4 light_clip(vec3 frame_m) {
    in_space = vec4(frame_m, 1.0) * space_rows;
    return in_space * picture_rows;
}
