// Downsamples by two. Texel d is the mean of the texels 2 d - 1 to 2 d + 2 in each direction with weights 1, 3, 3, 1: a
// quadratic B-spline (pyramid of Burt and Adelson 1983). The weights preserve sum and centroid. Outside the image the
// edge texel is repeated. For even sizes, the sum is preserved there too.
//   source       (in)   [height][width]                RGBA16F
//   destination  (out)  [ceil height/2][ceil width/2]  RGBA16F
layout(local_size_x = TILE, local_size_y = TILE) in;
layout(binding = 0) uniform sampler2D source;
layout(rgba16f, binding = 0) uniform writeonly image2D destination;

void main() {
    ivec2 destination_texel = image_pixel();
    ivec2 max_texel = textureSize(source, 0) - 1;
    if (any(greaterThanEqual(destination_texel, imageSize(destination)))) return;
    const float weights[4] = float[](0.125, 0.375, 0.375, 0.125);
    vec3 sum = vec3(0.0);
    for (int y = 0; y < 4; y++) {
        for (int x = 0; x < 4; x++) {
            ivec2 source_texel = clamp(2 * destination_texel + ivec2(x, y) - 1, ivec2(0), max_texel);
            sum += weights[x] * weights[y] * texelFetch(source, source_texel, 0).rgb;
        }
    }
    imageStore(destination, destination_texel, vec4(sum, 1.0));
}
