//! Headless OpenGL renderer: uploads a scene to the device, draws frames of it and reads their pixels back.
//!
//! | pass | what it does | runs when |
//! |---|---|---|
//! | raster | shadow depth, visibility or both, drawn by the compute rasterizer ([`RasterBackend`]) | the look asks for it |
//! | shadow cull | lists of the triangles that may appear in the shadow map (compute) | triangles are culled |
//! | shadow | depth as seen from the sun; cut-outs leave holes | the look has a shadow |
//! | blur | depth to moments, blurred in x and in y (compute) | the shadow is a variance map |
//! | occluders | depth of the triangles that the last frame saw, and its pyramid (compute) | hidden triangles are culled |
//! | cull | lists of the triangles that the camera may see (compute) | triangles are culled |
//! | visibility | triangle id and depth of each sample; masked materials discard | some triangle is not blended |
//! | unpack | keys of the compute rasterizer, and the ground, to ids (compute) | it drew the visibility |
//! | ground | id and depth of the ground | the look has a ground, the camera is above it, and something is below it |
//! | blended | light of translucent triangles over each other; no depth writes | two-pass transparency, some triangle is blended |
//! | count, scan, fill | a list of the blended fragments of each pixel | exact transparency, some triangle is blended |
//! | resolve | lists sorted by depth, shaded and blended (compute) | exact transparency, some triangle is blended |
//! | backdrop | shades tiles that see no opaque triangle; lists the other tiles (compute) | always |
//! | shade | Phong shading in the listed tiles; samples to pixels (compute) | some triangle is not blended |
//! | bloom | spreads bright light, then applies the tone curve (compute) | the look has a bloom |
//! | encode | linear light to sRGB bytes, top row first; smooths edges and dithers (compute) | always |
//!
//! Submitting a frame and collecting its pixels are separate calls, so that several frames can be in flight
//! ([`PendingFrame`]).
//!
//! Two outputs are drawn only on request, with programs and buffers that are created on first use: picking, which finds
//! the triangles at a few pixels ([`PendingPick`]), and AOV (arbitrary output variable) readbacks, which deliver numbers
//! instead of colors ([`AovImage`]).
//!
//! Shading is deferred: the rasterizer writes ids only, and each visible triangle is shaded once per pixel, whatever
//! lies behind it. Multisampled id buffers are not cleared; the depth buffer says which samples hold an id. A frame
//! draws only into the screen region that the bounds of the vertices can reach, and clears only the region that earlier
//! frames wrote.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

mod device;
mod layout;
mod pass;
mod passes;
mod plan;
mod region;
mod renderer;
mod resources;
mod scene_data;
mod shaders;
mod types;
mod uniforms;

pub use self::device::readback_ring::MAX_FRAMES_IN_FLIGHT;
pub use self::device::{EglDevice, devices};
pub use self::pass::{FrameTimes, Pass, RenderStage, TimeKey};
pub use self::passes::aov::{Aov, AovImage};
pub use self::passes::picking::{PendingPick, PickHit};
pub use self::plan::{Allocation, OmittedFeature, RenderPlan, plan};
pub use self::renderer::{MappedPixels, PendingFrame, Renderer};
pub use self::resources::scene_buffers::SceneBuffers;
pub use self::types::{
    BlurMethod, CullStats, DevicePreference, FrameCullStats, FrameImage, FrameParams, FrameStats, OitStats,
    RasterBackend, RasterBackends, RendererInfo, VisibilityId,
};
pub use self::uniforms::frame::{shadow_clip_from_world, shadow_texel_axes};
