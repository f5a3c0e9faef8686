// Uniforms of one frame. Positions are in scene units relative to the frame's origin; colors are linear. Twin:
// `FrameUniforms` in src/render/uniforms/frame.rs.
layout(std140, binding = 0) uniform FrameBlock {
    mat4 clip_from_world;
    mat4 shadow_from_world;    // to x, y and depth in the shadow map, each from 0 to 1
    mat4 world_from_ndc;       // from (x, y, 1) in normalized device coordinates to the direction of a view ray
    vec4 eye;                  // w: 1 if the scene has a ground and the camera is above it, else 0
    vec4 to_sun;               // w: radius of the ambient occlusion, in scene units
    vec4 sunlight;
    vec4 skylight;
    vec4 zenith;
    vec4 horizon;
    vec4 up;                   // a coordinate axis; w: height of the ground
    vec4 ground;               // color; w: fade length D: at distance d from the center, its weight is exp(-(d / D)^2)
    vec4 ground_center;        // w: half the side of the ground's square
    vec4 shadow;               // minimum variance, light bleeding reduction, alpha threshold, side of the map in texels
    // xyz: (a, b, c), the ground's depth at (x, y) of the map is a x + b y + c; w: side of a texel, in scene units.
    vec4 shadow_ground_plane;
    vec4 occlusion_sphere;     // center; w: squared radius of the sphere outside of which ambient light is not occluded
    vec4 edges;                // color of the lines along mesh edges; w: their width in pixels
} frame;
