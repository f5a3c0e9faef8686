// Cascades of a shadow map that is split by distance from the camera. A cascade is a layer that covers a part of the
// whole map. Twin: `ShadowCascades` in src/render/uniforms/cascades.rs.
layout(std140, binding = 2) uniform CascadeBlock {
    vec4 scale_offsets[4]; // scale (xy) and offset (zw) from the whole map to the layer
    vec4 end_depths;       // depth along the view axis at which each cascade ends; unused for the last one
} cascades;

vec2 to_cascade(vec2 position, int layer) { return position * cascades.scale_offsets[layer].xy + cascades.scale_offsets[layer].zw; }
vec2 from_cascade(vec2 position, int layer) { return (position - cascades.scale_offsets[layer].zw) / cascades.scale_offsets[layer].xy; }

// Cascade of a point. The last one also covers all farther points, and points whose depth is NaN.
int cascade_of(vec3 world) {
    mat4 m = frame.clip_from_world;
    float depth = dot(vec4(m[0].w, m[1].w, m[2].w, m[3].w), vec4(world, 1.0));
    for (int layer = 0; layer < CASCADES - 1; layer++) {
        if (depth < cascades.end_depths[layer]) return layer;
    }
    return CASCADES - 1;
}
