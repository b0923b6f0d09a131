in vec3 position;

void main() { gl_Position = light_clip(position); }
