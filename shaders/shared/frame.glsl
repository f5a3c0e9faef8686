// The numbers of one frame. Positions are scene units relative to the scene's origin, colours linear.
// Twin: `Frame` in src/render/frame.rs.
layout(std140, binding = 0) uniform FrameBlock {
    mat4 clip_from_world;
    mat4 map_from_world;   // to the shadow map: x, y and depth from 0 to 1
    mat4 world_from_image; // columns x, y, 1 of normalised device coordinates to a direction
    vec4 eye;              // and 1 where a ground is below it: who sees nothing may see that
    vec4 to_sun;           // and 1 where the ground may hide something
    vec4 sunlight;
    vec4 skylight;
    vec4 zenith;
    vec4 horizon;
    vec4 up;               // and the height of the ground
    vec4 ground;           // colour, and the distance at which it fades into the horizon
    vec4 ground_centre;    // and half the side of the plane
    vec4 shadow;           // least variance, bleeding, threshold of alpha, side of the map in texels
    vec4 ground_depth;     // depth of the ground at (x, y) of the map: a x + b y + c; side of a texel in scene units
} frame;
