// Anti-aliasing of images with one sample per pixel, after Lottes 2009, "FXAA" (NVIDIA white paper). At an edge in
// luma, the shader searches both ends of the edge along its row of pixels. It blends the pixel with its neighbor across
// the edge by the area that a straight line between the ends covers. Edges are detected in perceptual luma but linear
// light is blended, as in multisampling. Pixels without an edge do not change.

// Minimum contrast of an edge: a fraction of the maximum luma of the pixel and its neighbors, and an absolute luma.
// Chosen for the least error of the tree scene's image against 8 x 8 samples per pixel.
const float RELATIVE_THRESHOLD = 0.2;
const float ABSOLUTE_THRESHOLD = 0.0416;
// Maximum length of the edge search to each side, in pixels.
const int SEARCH_STEPS = 16;
// Maximum blend weight of an isolated pixel, which lies on no edge.
const float SUBPIXEL_STRENGTH = 0.5;

ivec2 clamp_to_image(ivec2 pixel) { return clamp(pixel, ivec2(0), textureSize(scene_color, 0) - 1); }

// Perceptual luma, 0 to 1: the square root approximates the sRGB curve.
float luma(ivec2 pixel) { return sqrt(dot(texelFetch(scene_color, clamp_to_image(pixel), 0).rgb, vec3(0.2126, 0.7152, 0.0722))); }

// Searches the end of a pixel's edge in one direction: the first pixel at which the mean luma across the edge differs
// from `edge_mean` by at least `tolerance`. x of the result: distance from the pixel's center in pixels; y: the
// difference at the end.
vec2 find_edge_end(ivec2 pixel, ivec2 edge_direction, ivec2 across_edge, float edge_mean, float tolerance) {
    float difference = 0.0;
    int steps = 0;
    do {
        steps++;
        ivec2 edge_pixel = pixel + steps * edge_direction;
        difference = 0.5 * (luma(edge_pixel) + luma(edge_pixel + across_edge)) - edge_mean;
    } while (abs(difference) < tolerance && steps < SEARCH_STEPS);
    return vec2(float(steps) - 0.5, difference);
}

vec3 fxaa_color(ivec2 pixel) {
    vec3 color = texelFetch(scene_color, pixel, 0).rgb;
    // Luma of the pixel (m, the middle) and of its neighbors (n for north, ne for northeast).
    float m = luma(pixel);
    float n = luma(pixel + ivec2(0, 1)), s = luma(pixel - ivec2(0, 1));
    float e = luma(pixel + ivec2(1, 0)), w = luma(pixel - ivec2(1, 0));
    float max_luma = max(m, max(max(n, s), max(e, w))), min_luma = min(m, min(min(n, s), min(e, w)));
    float contrast = max_luma - min_luma;
    if (!(contrast >= max(ABSOLUTE_THRESHOLD, RELATIVE_THRESHOLD * max_luma))) return color;

    float ne = luma(pixel + ivec2(1, 1)), nw = luma(pixel + ivec2(-1, 1));
    float se = luma(pixel + ivec2(1, -1)), sw = luma(pixel + ivec2(-1, -1));
    // Absolute second differences of luma in the vertical and in the horizontal direction. A larger vertical difference
    // means a horizontal edge.
    float vertical_curvature = abs(nw + sw - 2.0 * w) + 2.0 * abs(n + s - 2.0 * m) + abs(ne + se - 2.0 * e);
    float horizontal_curvature = abs(nw + ne - 2.0 * n) + 2.0 * abs(w + e - 2.0 * m) + abs(sw + se - 2.0 * s);
    bool is_horizontal = vertical_curvature >= horizontal_curvature;
    ivec2 edge_direction = is_horizontal ? ivec2(1, 0) : ivec2(0, 1);
    ivec2 across_edge = is_horizontal ? ivec2(0, 1) : ivec2(1, 0);
    float across_luma = is_horizontal ? n : e, opposite_luma = is_horizontal ? s : w;
    if (abs(opposite_luma - m) > abs(across_luma - m)) {
        across_edge = -across_edge;
        across_luma = opposite_luma;
    }
    float edge_mean = 0.5 * (m + across_luma), tolerance = 0.25 * abs(across_luma - m);
    vec2 forward_end = find_edge_end(pixel, edge_direction, across_edge, edge_mean, tolerance);
    vec2 backward_end = find_edge_end(pixel, -edge_direction, across_edge, edge_mean, tolerance);
    vec2 nearest_end = forward_end.x < backward_end.x ? forward_end : backward_end;
    // The smoothed edge is a straight line between the two ends of the pixel staircase. It enters only pixels in the
    // half next to the nearest end, and only on the side of the edge whose luma changes at that end. That side is the
    // pixel's own if the difference at the end and `m - edge_mean` have opposite signs.
    float blend_weight = 0.0;
    if ((nearest_end.y < 0.0) != (m < edge_mean)) blend_weight = 0.5 - nearest_end.x / (forward_end.x + backward_end.x);
    // A pixel that differs from all its neighbors, such as a thin line or a leaf smaller than a pixel.
    float neighbor_mean = (2.0 * (n + s + e + w) + ne + nw + se + sw) / 12.0;
    float isolation = smoothstep(0.0, 1.0, min(abs(neighbor_mean - m) / contrast, 1.0));
    blend_weight = max(blend_weight, SUBPIXEL_STRENGTH * isolation * isolation);
    return mix(color, texelFetch(scene_color, clamp_to_image(pixel + across_edge), 0).rgb, blend_weight);
}
