// Writes the id of the ground.
in vec2 ndc;
layout(location = 0) out uint id;

void main() {
    if (!ray_hits_ground(view_ray(ndc))) discard;
    id = GROUND_ID;
}
