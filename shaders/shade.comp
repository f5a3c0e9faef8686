// Deferred shading: converts ids to the color of each pixel, in linear light. A triangle is shaded once per pixel, at
// the center of the samples that see it. The pixel is the mean of its samples after the tone curve.
//   ids      [height][width][SAMPLES]  R32UI, bottom row first: NOTHING, GROUND, or triangle + 1; NOTHING for ground
//                                      that was not rasterized                                          (in)
//   drawn    [height][width][SAMPLES]  depth: 1 where there is no id                                    (in)
//   layers   [height][width][SAMPLES]  RGBA16F: light of the blended surfaces, transmittance            (in)
//   picture  [height][width]           RGBA16F, bottom row first                                        (out)
//   glare    [height][width]           RGBA16F: bright light for the bloom                              (out)
// Runs as two dispatches. The first, with BACKDROP, covers all tiles of pixels: it shades those that see only sky and
// ground, and lists the others. The second covers the listed tiles. A software rasterizer executes both sides of every
// branch, and most tiles of most pictures see no triangle.
layout(local_size_x = TILE, local_size_y = TILE) in;
#ifdef OIT
// Exact transparency: one array layer per sample, written only where there are blended fragments.
layout(binding = 22) uniform sampler2DArray layers;
layout(binding = 23) uniform usampler2D fragment_counts;
#elif defined(BLEND_LAYERS)
#if SAMPLES > 1
layout(binding = 22) uniform sampler2DMS layers;
#else
layout(binding = 22) uniform sampler2D layers;
#endif
#endif
layout(rgba16f, binding = 0) uniform writeonly image2D scene_color;
#ifdef BLOOM
layout(rgba16f, binding = 1) uniform writeonly image2D bloom_source;
#endif
// Indirect dispatch arguments of the second dispatch, in rows of workgroups; then the tiles, x and y in one word, in
// any order.
layout(std430, binding = 1) buffer Tiles {
    uint groups[3];
    uint count;
    uint tiles[];
};
#ifdef BACKGROUND
shared uint tile_has_triangle;
#endif

#ifdef HAS_GROUND
vec3 shade_ground_ray(vec3 direction) {
    // Rasterized ground is below the eye, and the ray to it points down; rounding must not turn the ray upwards.
    float fall = min(dot(direction, frame.up.xyz), -1e-9 * length(direction));
    float way = (frame.up.w - dot(frame.eye.xyz, frame.up.xyz)) / fall;
    return shade_ground(frame.eye.xyz + way * direction);
}
#endif

// Id of a sample. Ground that was not rasterized is behind everything else.
uint sample_id(ivec2 at, int index, ivec2 size) {
    uint id = load_id(at, index);
#ifdef HAS_GROUND
    if (id == NO_ID && frame.eye.w > 0.0) {
        vec2 image = 2.0 * (vec2(at) + SAMPLE_POSITIONS[index]) / vec2(size) - 1.0;
        if (ray_hits_ground(view_ray(image))) id = GROUND_ID;
    }
#endif
    return id;
}

vec3 shade_id(uint id, vec2 image, vec2 texel) {
    vec3 direction = view_ray(image);
    vec3 light = sky(direction);
#ifdef HAS_GROUND
    if (id == GROUND_ID) light = shade_ground_ray(direction);
#endif
#ifndef BACKGROUND
    if (id != NO_ID && id != GROUND_ID) light = shade_triangle(int(id - 1u), image, texel).rgb;
#endif
    return light;
}

// Mean of a pixel's samples as they are displayed.
vec3 shade_pixel(ivec2 at, ivec2 size, uint seen[SAMPLES]) {
    vec2 texel = 2.0 / vec2(size);
    PixelAccumulator sum = PixelAccumulator(vec3(0.0), vec3(0.0));
    uint left = (1u << SAMPLES) - 1u;
#ifdef OIT
    bool blended = texelFetch(fragment_counts, at, 0).x > 0u;
#endif
    // The condition is tested at the end, because a software rasterizer runs the loop body for inactive lanes.
    do {
        uint id = NO_ID;
        for (int index = SAMPLES - 1; index >= 0; index--) {
            if ((left >> index & 1u) != 0u) id = seen[index];
        }
        uint same = 0u;
        vec2 middle = vec2(0.0);
        for (int index = 0; index < SAMPLES; index++) {
            if ((left >> index & 1u) != 0u && seen[index] == id) {
                same |= 1u << index;
                middle += SAMPLE_POSITIONS[index];
            }
        }
        float count = float(bitCount(same));
        vec3 light = shade_id(id, (vec2(at) + middle / count) * texel - 1.0, texel);
#ifdef BLEND_LAYERS
        for (int index = 0; index < SAMPLES; index++) {
#ifdef OIT
            vec4 layer = vec4(0.0, 0.0, 0.0, 1.0);
            if (blended) layer = texelFetch(layers, ivec3(at, index), 0);
#else
            vec4 layer = texelFetch(layers, at, index);
#endif
            if ((same >> index & 1u) != 0u) accumulate_sample(sum, layer.rgb + layer.a * light, 1.0);
        }
#else
        accumulate_sample(sum, light, count);
#endif
        left &= ~same;
    } while (left != 0u);
#ifdef BLOOM
    imageStore(bloom_source, at, vec4(sum.glow / float(SAMPLES), 1.0));
#endif
    return sum.shown / float(SAMPLES);
}

void main() {
    ivec2 size = id_image_size();
    uint seen[SAMPLES];
#ifdef BACKGROUND
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    bool inside = all(lessThan(at, size));
    bool sees = false;
    for (int index = 0; index < SAMPLES; index++) {
        seen[index] = sample_id(min(at, size - 1), index, size);
        sees = sees || (seen[index] != NO_ID && seen[index] != GROUND_ID);
    }
    if (gl_LocalInvocationIndex == 0u) tile_has_triangle = 0u;
    memoryBarrierShared();
    barrier();
    if (inside && sees) tile_has_triangle = 1u;
    memoryBarrierShared();
    barrier();
    if (tile_has_triangle != 0u) {
        if (gl_LocalInvocationIndex == 0u) {
            uint place = atomicAdd(count, 1u);
            if (place % TILES_PER_ROW == 0u) atomicAdd(groups[1], 1u);
            tiles[place] = gl_WorkGroupID.x | gl_WorkGroupID.y << 16;
        }
    } else if (inside) {
        imageStore(scene_color, at, vec4(shade_pixel(at, size, seen), 1.0));
    }
#else
    uint place = gl_WorkGroupID.y * TILES_PER_ROW + gl_WorkGroupID.x;
    uint tile = tiles[min(place, count - 1u)];
    ivec2 at = TILE * ivec2(tile & 0xFFFFu, tile >> 16) + ivec2(gl_LocalInvocationID.xy);
    if (place >= count || any(greaterThanEqual(at, size))) return;
    for (int index = 0; index < SAMPLES; index++) seen[index] = sample_id(at, index, size);
    imageStore(scene_color, at, vec4(shade_pixel(at, size, seen), 1.0));
#endif
}
