// Draws the ground plane as one triangle over the whole image. Normalized device depth is linear in the image, so three
// corners define it. A square in world space would need clipping, and the depth of the clipped triangles would deviate
// from the plane.
out vec2 ndc;

void main() {
    ndc = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    vec2 slope;
    gl_Position = vec4(ndc, ground_plane_depth(ndc, slope), 1.0);
}
