// The maps of a shadow that is split by distance from the camera: each a layer that covers a part of the whole map.
// Twin: `Splits` in src/render/splits.rs.
layout(std140, binding = 2) uniform SplitBlock {
    vec4 places[4]; // scale and offset from the whole map to the layer's
    vec4 depths;    // the camera's distance at which each but the last ends
} splits;

vec2 in_layer(vec2 at, int index) { return at * splits.places[index].xy + splits.places[index].zw; }
vec2 in_whole(vec2 at, int index) { return (at - splits.places[index].zw) / splits.places[index].xy; }

// The layer of a point; the last holds all that is farther, and what has no distance.
int layer_of(vec3 world) {
    mat4 m = frame.clip_from_world;
    float depth = dot(vec4(m[0].w, m[1].w, m[2].w, m[3].w), vec4(world, 1.0));
    for (int index = 0; index < SPLITS - 1; index++) {
        if (depth < splits.depths[index]) return index;
    }
    return SPLITS - 1;
}
