// Writes the id of the ground, which is shaded later like the triangles.
in vec2 image;
layout(location = 0) out uint id;

void main() {
    if (!ray_hits_ground(view_ray(image))) discard;
    id = GROUND_ID;
}
