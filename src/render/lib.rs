//! Headless OpenGL renderer: uploads a scene to the device, draws frames of it and reads their pixels back.
//!
//! The passes of a frame, in execution order. The *look* of a scene is its render settings. An *id* names the triangle
//! that is visible in a sample, or the ground. A *tile* is a square of 8 x 8 pixels. A *cut-out* is an alpha-tested
//! triangle.
//!
//! | pass | output | condition |
//! |---|---|---|
//! | raster shadow, raster visibility | shadow depth, visibility or both, drawn by the compute rasterizer ([`RasterBackend`]) | a compute rasterizer is attached |
//! | shadow cull | lists of the triangles that may cast a shadow (compute) | triangles are culled |
//! | shadow | depth as seen from the sun, with holes of cut-outs | the look has a shadow |
//! | blur | moments of the depth, blurred in x and in y (compute) | the shadow is a variance map |
//! | occluders | depth of the triangles that were visible in the last frame, and its Hi-Z pyramid (compute) | occlusion culling |
//! | cull | lists of the triangles that the camera may see (compute) | triangles are culled |
//! | visibility | triangle id and depth of each sample, with holes of cut-outs | some triangle is not blended |
//! | record visible | triangles that are visible, as the occluders of the next frame (compute) | occlusion culling |
//! | unpack | ids, converted from the output of the compute rasterizer (compute) | the compute rasterizer drew the visibility |
//! | ambient occlusion | part of the ambient light that reaches each texel, without noise (compute) | the look has ambient occlusion |
//! | blended | light of the blended triangles, blended in draw order without depth writes | two-pass transparency, some triangle is blended |
//! | oit count, oit allocate, oit fill | a list of the blended fragments of each pixel | exact transparency, some triangle is blended |
//! | oit resolve | lists sorted by depth, shaded and blended (compute) | exact transparency, some triangle is blended |
//! | background | shaded tiles without opaque triangles, and a list of the other tiles (compute) | always |
//! | shade | Phong shading of the listed tiles; the mean of the samples of each pixel (compute) | some triangle is not blended |
//! | bloom | blurred bright light, added to the shaded image (compute) | the look has a bloom |
//! | encode | sRGB bytes, top row first, optionally with anti-aliasing and dithering (compute) | always |
//!
//! Submitting a frame and reading its pixels are separate calls, so that several frames can be in flight
//! ([`PendingFrame`]).
//!
//! A frame that may take long, as the first one of a scene, is submitted in steps, so that other scenes can be drawn in
//! between ([`PartialFrame`]). For the same reason, the textures and programs of a scene can be prepared one by one
//! ([`ScenePreparation`]).
//!
//! Two outputs are drawn only on request, with programs and buffers that are created on first use. Picking finds the
//! triangles at a few pixels ([`PendingPick`]). AOV (arbitrary output variable) readbacks deliver numbers instead of
//! colors ([`AovImage`]).
//!
//! Shading is deferred: the rasterizer writes only ids, and each visible triangle is shaded once per pixel.
//! Multisampled id images are not cleared; an id is valid where the depth is above 0, the value of the far plane. A
//! frame draws only into the screen region that the bounds of the vertices can cover, and clears only the region that
//! earlier frames wrote.

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

#[cfg(test)]
#[path = "../../tests/common/hang_guard.rs"]
mod hang_guard;

mod device;
mod layout;
mod pass;
mod passes;
mod pieces;
mod plan;
mod region;
mod renderer;
mod resources;
mod scene_data;
mod shaders;
mod types;
mod uniforms;
pub mod view_data;

pub use self::device::readback_ring::MAX_FRAMES_IN_FLIGHT;
pub use self::device::{EglDevice, devices};
pub use self::pass::{FrameTimes, Pass, RenderStage, TimeKey};
pub use self::passes::aov::{Aov, AovImage, PartialAov};
pub use self::passes::picking::{PendingPick, PickHit};
pub use self::plan::{Allocation, OmittedFeature, RenderPlan, plan};
pub use self::renderer::{
    EncodedPng, FramePixels, HeldPixels, MappedPixels, PartialFrame, PendingFrame, Renderer, ScenePreparation,
    TrialScene,
};
pub use self::resources::scene_buffers::SceneBuffers;
pub use self::types::{
    BlurMethod, CullStats, DevicePreference, FrameCullStats, FrameImage, FrameInfo, FrameLook, FrameParams, FrameStats,
    OitStats, PixelReadback, RasterBackend, RasterBackends, RendererInfo, SharedFrame, VisibilityId,
};
pub use self::uniforms::frame::{shadow_clip_from_world, shadow_texel_axes};
