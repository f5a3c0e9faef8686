// Anti-aliasing of images with one sample per pixel, after Lottes 2009, "FXAA" (NVIDIA white paper). Where luma jumps,
// both ends of the edge are searched along its row of pixels; the pixel is blended with its neighbor across the edge by
// the area that a straight line between the ends covers. Edges are detected in perceptual luma but linear light is
// blended, as in multisampling. Pixels without an edge do not change.

// Thresholds chosen by the error of the tree's picture against 8 x 8 samples per pixel. An edge needs a contrast of at
// least this share of the brightest pixel around, and of at least this luma.
const float RELATIVE_THRESHOLD = 0.2;
const float ABSOLUTE_THRESHOLD = 0.0416;
// Maximum length of the edge search to each side, in pixels.
const int SEARCH_STEPS = 16;
// Maximum blend weight of an isolated pixel, which no edge explains.
const float SUBPIXEL_STRENGTH = 0.5;

ivec2 clamp_to_image(ivec2 at) { return clamp(at, ivec2(0), textureSize(scene_color, 0) - 1); }

// Perceptual luma, 0 to 1: the square root approximates the sRGB curve.
float luma(ivec2 at) { return sqrt(dot(texelFetch(scene_color, clamp_to_image(at), 0).rgb, vec3(0.2126, 0.7152, 0.0722))); }

// Distance in pixels from the center of a pixel to the end of its edge in one direction, where the mean across the edge
// differs from that at the pixel. y: the difference.
vec2 find_edge_end(ivec2 at, ivec2 along, ivec2 across, float mean, float slack) {
    float off = 0.0;
    int steps = 0;
    do {
        steps++;
        ivec2 there = at + steps * along;
        off = 0.5 * (luma(there) + luma(there + across)) - mean;
    } while (abs(off) < slack && steps < SEARCH_STEPS);
    return vec2(float(steps) - 0.5, off);
}

vec3 fxaa_color(ivec2 at) {
    vec3 own = texelFetch(scene_color, at, 0).rgb;
    float m = luma(at);
    float n = luma(at + ivec2(0, 1)), s = luma(at - ivec2(0, 1));
    float e = luma(at + ivec2(1, 0)), w = luma(at - ivec2(1, 0));
    float most = max(m, max(max(n, s), max(e, w))), least = min(m, min(min(n, s), min(e, w)));
    float jump = most - least;
    if (!(jump >= max(ABSOLUTE_THRESHOLD, RELATIVE_THRESHOLD * most))) return own;

    float ne = luma(at + ivec2(1, 1)), nw = luma(at + ivec2(-1, 1));
    float se = luma(at + ivec2(1, -1)), sw = luma(at + ivec2(-1, -1));
    // Second differences across rows and across columns: the edge runs along the direction with the smaller one.
    float rows = abs(nw + sw - 2.0 * w) + 2.0 * abs(n + s - 2.0 * m) + abs(ne + se - 2.0 * e);
    float columns = abs(nw + ne - 2.0 * n) + 2.0 * abs(w + e - 2.0 * m) + abs(sw + se - 2.0 * s);
    bool flat_edge = rows >= columns;
    ivec2 along = flat_edge ? ivec2(1, 0) : ivec2(0, 1);
    ivec2 across = flat_edge ? ivec2(0, 1) : ivec2(1, 0);
    float ahead = flat_edge ? n : e, behind = flat_edge ? s : w;
    if (abs(behind - m) > abs(ahead - m)) {
        across = -across;
        ahead = behind;
    }
    float mean = 0.5 * (m + ahead), slack = 0.25 * abs(ahead - m);
    vec2 one = find_edge_end(at, along, across, mean, slack);
    vec2 other = find_edge_end(at, -along, across, mean, slack);
    vec2 nearer = one.x < other.x ? one : other;
    // The fitted line crosses the middle of the row halfway between its ends. At the nearer end it is on this pixel's
    // side only if the row changes to the other side's color there.
    float taken = 0.0;
    if ((nearer.y < 0.0) != (m < mean)) taken = 0.5 - nearer.x / (one.x + other.x);
    // A pixel that differs from all its neighbors, like a thin line or a leaf smaller than a pixel.
    float around = (2.0 * (n + s + e + w) + ne + nw + se + sw) / 12.0;
    float lone = smoothstep(0.0, 1.0, min(abs(around - m) / jump, 1.0));
    taken = max(taken, SUBPIXEL_STRENGTH * lone * lone);
    return mix(own, texelFetch(scene_color, clamp_to_image(at + across), 0).rgb, taken);
}
