// Which triangle of the scene a fragment belongs to; one draw call begins at `first_triangle`.
layout(location = 0) uniform int first_triangle;

int own_triangle() { return first_triangle + gl_PrimitiveID; }
