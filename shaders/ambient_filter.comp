// Filters the noise of the ambient occlusion: averages a square of AMBIENT_NOISE x AMBIENT_NOISE texels, whose slice
// directions all differ. The center of the square is half a texel to the left of the texel and half a texel below it.
//   surface             (in)   see ambient_surface.comp
//   noisy_visibility    (in)   see ambient_occlusion.comp
//   ambient_visibility  (out)  of the same size  RG32F: visibility, 0 to 1; 1 / depth, 0 for the sky
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(binding = 0) uniform usampler2D surface;
layout(binding = 1) uniform sampler2D noisy_visibility;
layout(rg32f, binding = 0) uniform writeonly image2D ambient_visibility;

void main() {
    ivec2 texel = image_pixel(), size = imageSize(ambient_visibility);
    if (any(greaterThanEqual(texel, size))) return;
    uvec2 packed_surface = texelFetch(surface, texel, 0).xy;
    float depth = abs(uintBitsToFloat(packed_surface.x)), visibility = 1.0;
    if (depth > 0.0) {
        mat3 rays = ambient_rays();
        vec3 normal = decode_octahedral(unpackSnorm2x16(packed_surface.y));
        AmbientPlane plane = ambient_plane(rays, normal, depth * (rays * vec3(texel, 1.0)), depth);
        float sum = 0.0, weight_sum = 0.0;
        for (int y = -AMBIENT_NOISE / 2; y < AMBIENT_NOISE / 2; y++) {
            for (int x = -AMBIENT_NOISE / 2; x < AMBIENT_NOISE / 2; x++) {
                ivec2 tap_texel = clamp(texel + ivec2(x, y), ivec2(0), size - 1);
                vec2 tap = texelFetch(noisy_visibility, tap_texel, 0).xy;
                float weight = ambient_weight(plane, vec2(tap_texel), tap.y);
                sum += weight * tap.x;
                weight_sum += weight;
            }
        }
        visibility = sum / weight_sum;
    }
    imageStore(ambient_visibility, texel, vec4(visibility, depth > 0.0 ? 1.0 / depth : 0.0, 0.0, 0.0));
}
