in vec3 position;

void main() { gl_Position = projected(position); }
