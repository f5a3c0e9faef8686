// What every sample sees to the colour of its pixel, in linear light. A triangle is shaded once in a pixel, in the middle of
// the samples that see it, however many those are; each sample is clamped, and their mean is the pixel.
//   ids      [height][width][SAMPLES]  R32UI, bottom row first: NOTHING, GROUND, or triangle + 1       (in)
//   layers   [height][width][SAMPLES]  RGBA16F: light of the blended surfaces, share that they let by   (in)
//   picture  [height][width]           RGBA16F, bottom row first                                        (out)
layout(local_size_x = TILE, local_size_y = TILE) in;
#ifdef LAYERS
#if SAMPLES > 1
layout(binding = 22) uniform sampler2DMS layers;
#else
layout(binding = 22) uniform sampler2D layers;
#endif
#endif
layout(rgba16f, binding = 0) uniform writeonly image2D picture;

// A direction in the world, as long as it takes to go one unit of depth.
vec3 through(vec2 image) { return mat3(frame.world_from_image) * vec3(image, 1.0); }

#ifdef GROUND_SEEN
vec3 ground_seen(vec3 direction) {
    // Rasterised ground is below the eye, and the direction to it goes down; a rounded one must not turn back.
    float fall = min(dot(direction, frame.up.xyz), -1e-9 * length(direction));
    float way = (frame.up.w - dot(frame.eye.xyz, frame.up.xyz)) / fall;
    return ground(frame.eye.xyz + way * direction);
}
#endif

vec3 shaded(uint id, vec2 image, vec2 texel) {
    vec3 direction = through(image);
    vec3 light = sky(direction);
#ifdef GROUND_SEEN
    if (id == GROUND) light = ground_seen(direction);
#endif
#ifdef TRIANGLES
    if (id != NOTHING && id != GROUND) light = triangle_seen(int(id - 1u), image, texel);
#endif
    return light;
}

// Each sample is clamped by itself, so that one bright sample does not whiten an edge; a NaN fails the comparison and is
// black.
vec3 clamped(vec3 light) { return mix(vec3(0.0), min(light, vec3(1.0)), greaterThan(light, vec3(0.0))); }

void main() {
    ivec2 size = size_of_ids();
    ivec2 at = ivec2(gl_GlobalInvocationID.xy);
    if (any(greaterThanEqual(at, size))) return;
    uint seen[SAMPLES];
    for (int index = 0; index < SAMPLES; index++) seen[index] = texelFetch(ids, at, index).x;
    vec2 texel = 2.0 / vec2(size);
    vec3 sum = vec3(0.0);
    uint left = (1u << SAMPLES) - 1u;
    // The loop is left at its end: a software rasteriser runs the body of a loop, or of a branch, for lanes that are done.
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
            vec4 layer = texelFetch(layers, at, index);
            if ((same >> index & 1u) != 0u) sum += clamped(layer.rgb + layer.a * light);
        }
#else
        sum += count * clamped(light);
#endif
        left &= ~same;
    } while (left != 0u);
    imageStore(picture, at, vec4(sum / float(SAMPLES), 1.0));
}
