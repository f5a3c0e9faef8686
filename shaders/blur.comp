// One direction of the Gaussian blur (equation 3.11). The first direction reads depth and makes the moments (m, m m) of
// m = depth - 1/2; the second reads those. One invocation makes RUN texels in a row along its direction, so that a texel is
// read once for all of them.
layout(local_size_x = LANES) in;
layout(binding = 0) uniform sampler2D from;
layout(rg32f, binding = 0) uniform writeonly image2D to;

vec2 moments(ivec2 at, int side) {
#ifdef FIRST
    at.x = clamp(at.x, 0, side - 1);
    float depth = texelFetch(from, at, 0).x;
    if (depth >= 1.0) {
        // Nothing is there but the ground behind it. The ground casts no shadow, but with its own depth in place of the
        // far plane's the bound is exact on it: the share of the blur's weight that lies off the caster.
        vec2 place = (vec2(at) + 0.5) / float(side);
        depth = clamp(dot(frame.ground_depth.xy, place) + frame.ground_depth.z, 0.0, 1.0);
    }
    depth -= 0.5;
    return vec2(depth, depth * depth);
#else
    at.y = clamp(at.y, 0, side - 1);
    return texelFetch(from, at, 0).xy;
#endif
}

void main() {
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    int side = int(frame.shadow.w);
#ifdef FIRST
    const ivec2 along = ivec2(1, 0);
#else
    const ivec2 along = ivec2(0, 1);
#endif
    at += (RUN - 1) * at * along;
    if (at.x >= side) return;
    vec2 sums[RUN];
    blur(at, along, side, sums);
    // Stores beyond the edge of the map are dropped.
    for (int index = 0; index < RUN; index++) {
        imageStore(to, at + index * along, vec4(sums[index], 0.0, 0.0));
    }
}
