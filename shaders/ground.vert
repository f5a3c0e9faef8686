// The plane of the ground as one triangle over the picture. As depth over w is linear in the picture, three corners say it
// all; corners of a square in the world would lie behind the eye, and what a rasteriser makes of those is no plane any more.
out vec2 image;

void main() {
    image = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    vec2 slope;
    gl_Position = vec4(image, ground_depth(image, slope), 1.0);
}
