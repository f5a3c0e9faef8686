// Reads back the triangles that the pixels of a small rectangle see; the host computes the intersections in f64.
//   ids     [height][width]  R32UI; the rectangle is at the lower left, bottom row first (in)
//   picked  [rows][columns]  top row first: id, three corners, three positions, three normals; 22 words (out)
layout(local_size_x = WORKGROUP_SIZE) in;
layout(location = 0) uniform int rectangle; // columns, and rows shifted by 16
layout(std430, binding = 0) writeonly buffer Words { uint picked[]; };

void main() {
    ivec2 size = ivec2(rectangle & 0xFFFF, rectangle >> 16);
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, size))) return;
    uint id = texelFetch(ids, at, 0).x;
    uint first = 22u * uint((size.y - 1 - at.y) * size.x + at.x);
    picked[first] = id;
    if (id == NO_ID) return;
    ivec3 corners = ivec3(texelFetch(triangle_corners, int(id - 1u)).xyz);
    ivec3 vertices = ivec3(texelFetch(triangle_vertices, int(id - 1u)).xyz);
    for (int index = 0; index < 3; index++) {
        vec3 position = texelFetch(positions, vertices[index]).xyz;
        vec3 normal = texelFetch(normals, corners[index]).xyz;
        picked[first + 1u + uint(index)] = uint(corners[index]);
        for (int axis = 0; axis < 3; axis++) {
            picked[first + 4u + uint(3 * index + axis)] = floatBitsToUint(position[axis]);
            picked[first + 13u + uint(3 * index + axis)] = floatBitsToUint(normal[axis]);
        }
    }
}
