// AOV (arbitrary output variable) readback: one number or three for each pixel, top row first.
//   ids      [height][width][SAMPLES]  R32UI, bottom row first                                         (in)
//   values   [vertices]                a scalar per vertex                                (in, with VALUES)
//   words    DEPTH    [height][width]           f32 along the view axis times `scale`; infinite without an id  (out)
//            NORMALS  [height][width][3]        f32, unit normal on the visible side; zeros without an id
//            VALUES   [height][width][SAMPLES]  value times `scale`, and the cosine to the eye, 16 bits each;
//                                               0 without an id, else the cosine is at least 1 / 65535
layout(local_size_x = WORKGROUP_SIZE) in;
layout(location = 0) uniform int scale_bits;
layout(std430, binding = 0) writeonly buffer Words { uint words[]; };
#ifdef VALUES
layout(binding = 24) uniform samplerBuffer values;
#endif

// A triangle, evaluated at an image point.
struct SurfacePoint {
    vec3 share;
    vec3 depths;
    vec3 world;
    vec3 normal; // on the visible side; not normalized
    ivec3 vertices;
};

SurfacePoint interpolate_surface(int number, vec2 image) {
    SurfacePoint met;
    ivec3 corners = ivec3(texelFetch(triangle_corners, number).xyz);
    met.vertices = ivec3(texelFetch(triangle_vertices, number).xyz);
    mat3 world, clip, normal;
    for (int index = 0; index < 3; index++) {
        world[index] = texelFetch(positions, met.vertices[index]).xyz;
        vec4 there = to_clip(world[index]);
        clip[index] = vec3(there.xy - image * there.w, there.w);
        met.depths[index] = there.w;
        normal[index] = texelFetch(normals, corners[index]).xyz;
    }
    Barycentrics found = barycentrics(clip[0], clip[1], clip[2], vec2(0.0));
    met.share = found.weights;
    met.world = world * met.share;
    met.normal = found.front ? normal * met.share : -(normal * met.share);
    return met;
}

vec3 normalize_or_zero(vec3 v) {
    float most = max(max(abs(v.x), abs(v.y)), abs(v.z));
    return most > 0.0 && !isinf(most) ? normalize(v / most) : vec3(0.0);
}

#ifdef DEPTH
// For the ground: the ray has unit length along the view axis, so the ray parameter is the depth.
float depth(uint id, vec2 image) {
    if (id == NO_ID) return uintBitsToFloat(0x7F800000u);
#ifdef HAS_GROUND
    if (id == GROUND_ID) {
        vec3 direction = mat3(frame.world_from_ndc) * vec3(image, 1.0);
        float fall = min(dot(direction, frame.up.xyz), -1e-9 * length(direction));
        return (frame.up.w - dot(frame.eye.xyz, frame.up.xyz)) / fall;
    }
#endif
    SurfacePoint met = interpolate_surface(int(id - 1u), image);
    return dot(met.depths, met.share);
}
#endif

#ifdef NORMALS
vec3 normal_of(uint id, vec2 image) {
    if (id == NO_ID) return vec3(0.0);
    return normalize_or_zero(interpolate_surface(int(id - 1u), image).normal);
}
#endif

#ifdef VALUES
uint value_of(uint id, vec2 image, float scale) {
    if (id == NO_ID) return 0u;
    SurfacePoint met = interpolate_surface(int(id - 1u), image);
    vec3 own = vec3(0.0);
    for (int index = 0; index < 3; index++) own[index] = texelFetch(values, met.vertices[index]).x;
    float facing = dot(normalize_or_zero(met.normal), normalize_or_zero(frame.eye.xyz - met.world));
    return packUnorm2x16(vec2(dot(own, met.share) * scale, max(facing, 1.0 / 65535.0)));
}
#endif

void main() {
    ivec2 size = id_image_size();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (at.x >= size.x) return;
    uint place = uint(size.y - 1 - at.y) * uint(size.x) + uint(at.x);
    float scale = intBitsToFloat(scale_bits);
    for (int index = 0; index < SAMPLES; index++) {
        uint id = texelFetch(ids, at, index).x;
        vec2 image = 2.0 * (vec2(at) + SAMPLE_POSITIONS[index]) / vec2(size) - 1.0;
#ifdef DEPTH
        words[place] = floatBitsToUint(scale * depth(id, image));
#endif
#ifdef NORMALS
        vec3 normal = normal_of(id, image);
        for (int axis = 0; axis < 3; axis++) words[3u * place + uint(axis)] = floatBitsToUint(normal[axis]);
#endif
#ifdef VALUES
        words[uint(SAMPLES) * place + uint(index)] = value_of(id, image, scale);
#endif
    }
}
