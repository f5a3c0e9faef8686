// The ground is a thing that is seen, like a triangle; it is shaded where the picture is.
in vec2 image;
layout(location = 0) out uint id;

void main() {
    if (!meets_ground(towards(image))) discard;
    id = GROUND;
}
