// What every sample sees to the colour of its pixel, in linear light. A triangle is shaded once in a pixel, in the middle of
// the samples that see it, however many those are; the mean of the samples, as they are shown, is the pixel.
//   ids      [height][width][SAMPLES]  R32UI, bottom row first: NOTHING, GROUND, or triangle + 1; NOTHING for ground
//                                      that was not drawn                                               (in)
//   drawn    [height][width][SAMPLES]  depth: 1 where there is no id                                    (in)
//   layers   [height][width][SAMPLES]  RGBA16F: light of the blended surfaces, share that they let by   (in)
//   picture  [height][width]           RGBA16F, bottom row first                                        (out)
//   glare    [height][width]           RGBA16F: light that glows                                        (out)
// Two dispatches: with BACKDROP for all tiles of pixels, to paint those that see sky and ground alone and to list the
// others; then for the listed tiles. A software rasteriser runs both sides of every branch, and most tiles of most pictures
// see no triangle.
layout(local_size_x = TILE, local_size_y = TILE) in;
#ifdef LISTED
// Of exact transparency: a layer a sample, written where there are blended fragments alone.
layout(binding = 22) uniform sampler2DArray layers;
layout(binding = 23) uniform usampler2D kept;
#elif defined(LAYERS)
#if SAMPLES > 1
layout(binding = 22) uniform sampler2DMS layers;
#else
layout(binding = 22) uniform sampler2D layers;
#endif
#endif
layout(rgba16f, binding = 0) uniform writeonly image2D picture;
#ifdef BLOOM
layout(rgba16f, binding = 1) uniform writeonly image2D glare;
#endif
// The number of groups of the second dispatch, in rows; then the tiles, x and y in one word, in any order.
layout(std430, binding = 1) buffer Tiles {
    uint groups[3];
    uint count;
    uint tiles[];
};
#ifdef BACKDROP
shared uint sees_triangle;
#endif

#ifdef GROUND_SEEN
vec3 ground_seen(vec3 direction) {
    // Rasterised ground is below the eye, and the direction to it goes down; a rounded one must not turn back.
    float fall = min(dot(direction, frame.up.xyz), -1e-9 * length(direction));
    float way = (frame.up.w - dot(frame.eye.xyz, frame.up.xyz)) / fall;
    return ground(frame.eye.xyz + way * direction);
}
#endif

// What a sample sees. Ground that was not drawn lies behind all else.
uint seen_by(ivec2 at, int index, ivec2 size) {
    uint id = id_at(at, index);
#ifdef GROUND_SEEN
    if (id == NOTHING && frame.eye.w > 0.0) {
        vec2 image = 2.0 * (vec2(at) + SAMPLE_PLACES[index]) / vec2(size) - 1.0;
        if (meets_ground(towards(image))) id = GROUND;
    }
#endif
    return id;
}

vec3 shaded(uint id, vec2 image, vec2 texel) {
    vec3 direction = towards(image);
    vec3 light = sky(direction);
#ifdef GROUND_SEEN
    if (id == GROUND) light = ground_seen(direction);
#endif
#ifndef BACKDROP
    if (id != NOTHING && id != GROUND) light = triangle_seen(int(id - 1u), image, texel).rgb;
#endif
    return light;
}

// What a pixel's samples show together.
vec3 pixel(ivec2 at, ivec2 size, uint seen[SAMPLES]) {
    vec2 texel = 2.0 / vec2(size);
    Gathered sum = Gathered(vec3(0.0), vec3(0.0));
    uint left = (1u << SAMPLES) - 1u;
#ifdef LISTED
    bool blended = texelFetch(kept, at, 0).x > 0u;
#endif
    // The loop is left at its end: a software rasteriser runs the body of a loop for lanes that are done.
    do {
        uint id = NOTHING;
        for (int index = SAMPLES - 1; index >= 0; index--) {
            if ((left >> index & 1u) != 0u) id = seen[index];
        }
        uint same = 0u;
        vec2 middle = vec2(0.0);
        for (int index = 0; index < SAMPLES; index++) {
            if ((left >> index & 1u) != 0u && seen[index] == id) {
                same |= 1u << index;
                middle += SAMPLE_PLACES[index];
            }
        }
        float count = float(bitCount(same));
        vec3 light = shaded(id, (vec2(at) + middle / count) * texel - 1.0, texel);
#ifdef LAYERS
        for (int index = 0; index < SAMPLES; index++) {
#ifdef LISTED
            vec4 layer = vec4(0.0, 0.0, 0.0, 1.0);
            if (blended) layer = texelFetch(layers, ivec3(at, index), 0);
#else
            vec4 layer = texelFetch(layers, at, index);
#endif
            if ((same >> index & 1u) != 0u) gather(sum, layer.rgb + layer.a * light, 1.0);
        }
#else
        gather(sum, light, count);
#endif
        left &= ~same;
    } while (left != 0u);
#ifdef BLOOM
    imageStore(glare, at, vec4(sum.glow / float(SAMPLES), 1.0));
#endif
    return sum.shown / float(SAMPLES);
}

void main() {
    ivec2 size = size_of_ids();
    uint seen[SAMPLES];
#ifdef BACKDROP
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    bool inside = all(lessThan(at, size));
    bool sees = false;
    for (int index = 0; index < SAMPLES; index++) {
        seen[index] = seen_by(min(at, size - 1), index, size);
        sees = sees || (seen[index] != NOTHING && seen[index] != GROUND);
    }
    if (gl_LocalInvocationIndex == 0u) sees_triangle = 0u;
    memoryBarrierShared();
    barrier();
    if (inside && sees) sees_triangle = 1u;
    memoryBarrierShared();
    barrier();
    if (sees_triangle != 0u) {
        if (gl_LocalInvocationIndex == 0u) {
            uint place = atomicAdd(count, 1u);
            if (place % ROW == 0u) atomicAdd(groups[1], 1u);
            tiles[place] = gl_WorkGroupID.x | gl_WorkGroupID.y << 16;
        }
    } else if (inside) {
        imageStore(picture, at, vec4(pixel(at, size, seen), 1.0));
    }
#else
    uint place = gl_WorkGroupID.y * ROW + gl_WorkGroupID.x;
    uint tile = tiles[min(place, count - 1u)];
    ivec2 at = TILE * ivec2(tile & 0xFFFFu, tile >> 16) + ivec2(gl_LocalInvocationID.xy);
    if (place >= count || any(greaterThanEqual(at, size))) return;
    for (int index = 0; index < SAMPLES; index++) seen[index] = seen_by(at, index, size);
    imageStore(picture, at, vec4(pixel(at, size, seen), 1.0));
#endif
}
