// Cascades of a shadow map that is split by distance from the camera. Each is a layer that covers a part of the whole
// map. Twin: `Splits` in src/render/splits.rs.
layout(std140, binding = 2) uniform SplitBlock {
    vec4 places[4]; // scale and offset from the whole map to the layer
    vec4 depths;    // camera distance at which each cascade but the last ends
} splits;

vec2 in_layer(vec2 at, int index) { return at * splits.places[index].xy + splits.places[index].zw; }
vec2 in_whole(vec2 at, int index) { return (at - splits.places[index].zw) / splits.places[index].xy; }

// Cascade of a point. The last one covers all farther points and those whose distance is NaN.
int layer_of(vec3 world) {
    mat4 m = frame.clip_from_world;
    float depth = dot(vec4(m[0].w, m[1].w, m[2].w, m[3].w), vec4(world, 1.0));
    for (int index = 0; index < SPLITS - 1; index++) {
        if (depth < splits.depths[index]) return index;
    }
    return SPLITS - 1;
}
