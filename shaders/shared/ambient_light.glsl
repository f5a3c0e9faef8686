// Ambient light on a surface before occlusion. `RenderSettings::studio_light` in src/model/scene/lighting.rs has the
// colors of the cube.
#ifdef STUDIO
// Ambient cube (McTaggart 2004): a color for each side of a box, weighted by the squared components of the normal.
vec3 ambient_light(vec3 normal) {
    vec3 weights = normal * normal;
    // A surface whose normal is 0 or not finite receives light from three sides.
    float squared_length = weights.x + weights.y + weights.z;
    weights = squared_length > 0.25 && squared_length < 4.0 ? weights : vec3(1.0 / 3.0);
    return weights.x * (normal.x < 0.0 ? AMBIENT_CUBE[1] : AMBIENT_CUBE[0])
        + weights.y * (normal.y < 0.0 ? AMBIENT_CUBE[3] : AMBIENT_CUBE[2])
        + weights.z * (normal.z < 0.0 ? AMBIENT_CUBE[5] : AMBIENT_CUBE[4]);
}
#else
vec3 ambient_light(vec3 normal) { return frame.skylight.rgb; }
#endif
