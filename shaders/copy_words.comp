// Copies the first words of a buffer. A copy command of OpenGL would take longer, because it makes the GPU switch from
// its compute engine to its copy engine.
//   source       (in)   [word_count]
//   destination  (out)  [word_count]
layout(local_size_x = WORKGROUP_SIZE) in;
layout(std430, binding = 0) readonly buffer Source { uint source[]; };
layout(std430, binding = 1) writeonly buffer Destination { uint destination[]; };
layout(location = 0) uniform int word_count;

void main() {
    uint workgroup = gl_WorkGroupID.y * gl_NumWorkGroups.x + gl_WorkGroupID.x;
    uint word = workgroup * uint(WORKGROUP_SIZE) + gl_LocalInvocationID.x;
    if (word < uint(word_count)) destination[word] = source[word];
}
