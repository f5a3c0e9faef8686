// The sky behind everything.
in vec3 direction;
layout(location = 0) out vec4 colour;

void main() { colour = vec4(sky(direction), 1.0); }
