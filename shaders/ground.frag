// The ground is a thing that is seen, like a triangle; it is shaded where the picture is.
layout(location = 0) out uint id;

void main() { id = GROUND; }
