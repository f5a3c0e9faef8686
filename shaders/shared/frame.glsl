// Uniforms of one frame. Positions are in scene units relative to the frame's origin; colors are linear. Twin:
// `FrameUniforms` in src/render/uniforms/frame.rs.
layout(std140, binding = 0) uniform FrameBlock {
    mat4 clip_from_world;
    mat4 shadow_from_world;    // to the shadow map: x, y and depth from 0 to 1
    mat4 world_from_ndc;       // (x, y, 1) of normalized device coordinates to the direction of a view ray
    vec4 eye;                  // w: 1 if samples without an id see the ground where a view ray hits it, else 0
    vec4 to_sun;               // w: 0 if the ground lies behind everything else, else 1
    vec4 sunlight;
    vec4 skylight;
    vec4 zenith;
    vec4 horizon;
    vec4 up;                   // w: height of the ground
    vec4 ground;               // color; w: distance at which it fades into the horizon
    vec4 ground_center;        // w: half the side of the square
    vec4 shadow;               // least variance, light bleeding, alpha threshold, side of the map in texels
    vec4 shadow_ground_plane;  // depth of the ground at (x, y) of the map: a x + b y + c; w: side of a texel in scene units
} frame;
