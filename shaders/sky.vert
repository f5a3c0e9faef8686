// One triangle over the whole picture, at the far plane.
out vec3 direction;

void main() {
    vec2 corner = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    direction = mat3(frame.world_from_image) * vec3(corner, 1.0);
    gl_Position = vec4(corner, 1.0, 1.0);
}
