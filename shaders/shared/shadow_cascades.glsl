// Cascades of a shadow map that is split by distance from the camera. Each is a layer that covers a part of the whole
// map. Twin: `ShadowCascades` in src/render/cascades.rs.
layout(std140, binding = 2) uniform CascadeBlock {
    vec4 scale_offsets[4]; // scale and offset from the whole map to the layer
    vec4 end_depths;    // camera distance at which each cascade but the last ends
} cascades;

vec2 to_cascade(vec2 at, int index) { return at * cascades.scale_offsets[index].xy + cascades.scale_offsets[index].zw; }
vec2 from_cascade(vec2 at, int index) { return (at - cascades.scale_offsets[index].zw) / cascades.scale_offsets[index].xy; }

// Cascade of a point. The last one covers all farther points and those whose distance is NaN.
int cascade_of(vec3 world) {
    mat4 m = frame.clip_from_world;
    float depth = dot(vec4(m[0].w, m[1].w, m[2].w, m[3].w), vec4(world, 1.0));
    for (int index = 0; index < CASCADES - 1; index++) {
        if (depth < cascades.end_depths[index]) return index;
    }
    return CASCADES - 1;
}
