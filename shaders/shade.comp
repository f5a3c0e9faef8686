// Deferred shading: converts ids to the color of each pixel, in linear light. A triangle is shaded once per pixel, at
// the center of the samples that see it. The color of a pixel is the mean of its samples after the tone curve.
//   ids           (in)   [height][width][SAMPLES]  R32UI; NO_ID for sky and ground
//   blend_layers  (in)   [height][width][SAMPLES]  RGBA16F: light of the blended surfaces, transmittance
//   scene_color   (out)  [height][width]           RGBA16F
//   bloom_source  (out)  [height][width]           RGBA16F: light above the bloom threshold
// All images have the bottom row first. The shading runs as two dispatches. The first, with BACKGROUND, covers all
// tiles of pixels: it shades tiles that see only sky and ground, and lists the other tiles. The second covers the
// listed tiles. This is for software rasterizers, which execute both sides of every branch: most tiles of most images
// see no triangle.
layout(local_size_x = TILE, local_size_y = TILE) in;
#ifdef OIT
// Exact transparency: one layer of the array per sample, written only where there are blended fragments.
layout(binding = 22) uniform sampler2DArray blend_layers;
layout(binding = 23) uniform usampler2D fragment_counts;
#elif defined(BLEND_LAYERS)
#if SAMPLES > 1
layout(binding = 22) uniform sampler2DMS blend_layers;
#else
layout(binding = 22) uniform sampler2D blend_layers;
#endif
#endif
layout(rgba16f, binding = 0) uniform writeonly image2D scene_color;
#ifdef BLOOM
layout(rgba16f, binding = 1) uniform writeonly image2D bloom_source;
#endif
#ifdef BACKGROUND
shared uint tile_has_triangle;
#endif

// Id of a sample. The ground is behind all triangles, also those below it, so that it never hides a deformed object.
uint sample_id(ivec2 pixel, int sample_index, ivec2 size) {
    uint id = load_id(pixel, sample_index);
#ifdef HAS_GROUND
    // `eye.w` is 1 if the camera is above the ground.
    if (id == NO_ID && frame.eye.w > 0.0) {
        vec2 ndc = 2.0 * (vec2(pixel) + SAMPLE_POSITIONS[sample_index]) / vec2(size) - 1.0;
        if (ray_hits_ground(view_ray(ndc))) id = GROUND_ID;
    }
#endif
    return id;
}

vec3 shade_id(uint id, vec2 ndc, vec2 pixel_size) {
    vec3 direction = view_ray(ndc);
    vec3 light = sky(direction);
#ifdef HAS_GROUND
    if (id == GROUND_ID) {
        vec3 world = frame.eye.xyz + ground_ray_depth(direction) * direction;
        float ambient_visibility = 1.0;
#ifdef AMBIENT_OCCLUSION
        if (is_near_surfaces(world)) ambient_visibility = ambient_visibility_of(world, frame.up.xyz, ndc);
#endif
        light = shade_ground(world, ambient_visibility);
    }
#endif
#ifndef BACKGROUND
    if (id != NO_ID && id != GROUND_ID) light = shade_triangle(int(id - 1u), ndc, pixel_size).rgb;
#endif
    return light;
}

// Mean of a pixel's samples after the tone curve.
vec3 shade_pixel(ivec2 pixel, ivec2 size, uint sample_ids[SAMPLES]) {
    vec2 pixel_size = 2.0 / vec2(size);
    PixelAccumulator sum = PixelAccumulator(vec3(0.0), vec3(0.0));
    uint remaining_samples = (1u << SAMPLES) - 1u;
#ifdef OIT
    bool has_fragments = texelFetch(fragment_counts, pixel, 0).x > 0u;
#endif
    // Each iteration shades one distinct id. A `while` loop would run once more on a software rasterizer, which
    // executes the body for inactive lanes.
    do {
        uint id = NO_ID;
        for (int sample_index = SAMPLES - 1; sample_index >= 0; sample_index--) {
            if ((remaining_samples >> sample_index & 1u) != 0u) id = sample_ids[sample_index];
        }
        uint matching_samples = 0u;
        vec2 position_sum = vec2(0.0);
        for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
            if ((remaining_samples >> sample_index & 1u) != 0u && sample_ids[sample_index] == id) {
                matching_samples |= 1u << sample_index;
                position_sum += SAMPLE_POSITIONS[sample_index];
            }
        }
        float count = float(bitCount(matching_samples));
        vec3 light = shade_id(id, (vec2(pixel) + position_sum / count) * pixel_size - 1.0, pixel_size);
#ifdef BLEND_LAYERS
        for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
#ifdef OIT
            vec4 layer = vec4(0.0, 0.0, 0.0, 1.0);
            if (has_fragments) layer = texelFetch(blend_layers, ivec3(pixel, sample_index), 0);
#else
            vec4 layer = texelFetch(blend_layers, pixel, sample_index);
#endif
            if ((matching_samples >> sample_index & 1u) != 0u) accumulate_sample(sum, layer.rgb + layer.a * light, 1.0);
        }
#else
        accumulate_sample(sum, light, count);
#endif
        remaining_samples &= ~matching_samples;
    } while (remaining_samples != 0u);
#ifdef BLOOM
    imageStore(bloom_source, pixel, vec4(sum.bloom / float(SAMPLES), 1.0));
#endif
    return sum.color / float(SAMPLES);
}

void main() {
    ivec2 size = id_image_size();
    uint sample_ids[SAMPLES];
#ifdef BACKGROUND
    ivec2 pixel = image_pixel();
    bool is_inside = all(lessThan(pixel, size));
    bool sees_triangle = false;
    for (int sample_index = 0; sample_index < SAMPLES; sample_index++) {
        sample_ids[sample_index] = sample_id(min(pixel, size - 1), sample_index, size);
        sees_triangle = sees_triangle || (sample_ids[sample_index] != NO_ID && sample_ids[sample_index] != GROUND_ID);
    }
    if (gl_LocalInvocationIndex == 0u) tile_has_triangle = 0u;
    memoryBarrierShared();
    barrier();
    if (is_inside && sees_triangle) tile_has_triangle = 1u;
    memoryBarrierShared();
    barrier();
    if (tile_has_triangle != 0u) {
        if (gl_LocalInvocationIndex == 0u) append_tile();
    } else if (is_inside) {
        imageStore(scene_color, pixel, vec4(shade_pixel(pixel, size, sample_ids), 1.0));
    }
#else
    ivec2 pixel = listed_pixel(listed_tile_index());
    if (!has_listed_tile(listed_tile_index()) || any(greaterThanEqual(pixel, size))) return;
    for (int sample_index = 0; sample_index < SAMPLES; sample_index++) sample_ids[sample_index] = sample_id(pixel, sample_index, size);
    imageStore(scene_color, pixel, vec4(shade_pixel(pixel, size, sample_ids), 1.0));
#endif
}
