// The ground plane as one triangle over the whole image. Normalized device depth is linear in the image, so three
// corners define it. Corners of a square in world space could lie behind the eye, and the depth of the clipped
// triangles would deviate from the plane.
out vec2 image;

void main() {
    image = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    vec2 slope;
    gl_Position = vec4(image, ground_plane_depth(image, slope), 1.0);
}
