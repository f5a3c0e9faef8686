// Reads back the triangles that are visible in a small rectangle of pixels. The host intersects them with view rays in
// f64.
//   ids     (in)   [height][width]      R32UI, bottom row first; only the rectangle, at the lower left, is drawn
//   picked  (out)  [rows][columns][22]  top row first: id, 3 corner indices, 3 positions, 3 normals (1 + 3 + 9 + 9)
layout(local_size_x = WORKGROUP_SIZE) in;
layout(location = 0) uniform int rectangle; // columns in the lower 16 bits, rows in the upper 16
layout(std430, binding = 0) writeonly buffer Words { uint picked[]; };

void main() {
    ivec2 size = ivec2(rectangle & 0xFFFF, rectangle >> 16);
    ivec2 pixel = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(pixel, size))) return;
    uint id = texelFetch(ids, pixel, 0).x;
    uint first_word = 22u * uint((size.y - 1 - pixel.y) * size.x + pixel.x);
    picked[first_word] = id;
    if (id == NO_ID) return;
    // Word offsets: 1 for the corners, 4 for the positions, 13 for the normals.
    ivec3 corners = ivec3(texelFetch(triangle_corners, int(id - 1u)).xyz);
    ivec3 vertices = ivec3(texelFetch(triangle_vertices, int(id - 1u)).xyz);
    for (int corner = 0; corner < 3; corner++) {
        vec3 position = texelFetch(positions, vertices[corner]).xyz;
        vec3 normal = texelFetch(normals, corners[corner]).xyz;
        picked[first_word + 1u + uint(corner)] = uint(corners[corner]);
        for (int axis = 0; axis < 3; axis++) {
            picked[first_word + 4u + uint(3 * corner + axis)] = floatBitsToUint(position[axis]);
            picked[first_word + 13u + uint(3 * corner + axis)] = floatBitsToUint(normal[axis]);
        }
    }
}
