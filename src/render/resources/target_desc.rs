//! Description of a render target, and creation of its images.

use std::ops::Range;
use std::rc::Rc;

use crate::device::gl::{self, Gl, Texture, TextureDesc};
use crate::layout::cull::CULL_COUNTER_BYTES;
use crate::layout::oit::OIT_HEADER_BYTES;
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, RenderSettings};

/// Maximum number of pixels of a multisampled frame. Larger frames have one sample per pixel. A sample takes 16 bytes:
/// 4 of depth, 4 of ids and 8 of a blend layer. With four samples, these pixels take 704 MiB of device memory.
const MAX_MULTISAMPLED_PIXELS: u64 = 11 << 20;

/// Properties of a frame that determine its images and buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TargetDesc {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) samples: u32,
    pub(crate) blend_storage: BlendStorage,
    /// Levels of the bloom pyramid that are smaller than the frame.
    pub(crate) bloom_levels: u32,
    /// Culling method; never `Auto`.
    pub(crate) culling: Culling,
}

/// Resources that a frame needs for blended triangles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BlendStorage {
    None,
    /// A layer for blending in draw order.
    SingleLayer,
    /// Fragment lists with this budget in fragments.
    FragmentLists(u32),
}

impl TargetDesc {
    /// No pixels and no optional features.
    pub(crate) const EMPTY: Self = Self {
        width: 0,
        height: 0,
        samples: 1,
        blend_storage: BlendStorage::None,
        bloom_levels: 0,
        culling: Culling::None,
    };

    /// Target of a frame of a look, with at most `samples` samples per pixel.
    pub(crate) fn new(
        gl: &Gl,
        size: [u32; 2],
        look: &RenderSettings,
        samples: u32,
        blend_storage: BlendStorage,
    ) -> Self {
        let bloom_levels = look.bloom.map_or(0, |bloom| bloom.levels);
        Self { blend_storage, bloom_levels, ..Self::ids_and_depth(gl, size, samples) }
    }

    /// Target with ids and depth only. It has `samples` samples per pixel if the device and the frame size allow it,
    /// else one.
    pub(crate) fn ids_and_depth(gl: &Gl, [width, height]: [u32; 2], samples: u32) -> Self {
        let is_supported =
            u64::from(width) * u64::from(height) <= MAX_MULTISAMPLED_PIXELS && samples <= gl.limits.max_samples;
        Self { width, height, samples: if is_supported { samples } else { 1 }, ..Self::EMPTY }
    }

    /// Bytes of a frame with one 32-bit word per pixel: encoded colors, or ids.
    pub(crate) fn frame_bytes(&self) -> u64 {
        4 * u64::from(self.width) * u64::from(self.height)
    }

    /// Byte ranges of the fragment counters and of the culling counters, which follow the encoded frame in the staging
    /// buffer. They are empty without fragment lists or culling.
    pub(crate) fn readback_ranges(&self) -> [Range<u64>; 2] {
        let list_bytes =
            if matches!(self.blend_storage, BlendStorage::FragmentLists(_)) { OIT_HEADER_BYTES as u64 } else { 0 };
        let cull_bytes = if self.culling == Culling::None { 0 } else { CULL_COUNTER_BYTES as u64 };
        let (list_begin, cull_begin) = (self.frame_bytes(), self.frame_bytes() + list_bytes);
        [list_begin..cull_begin, cull_begin..cull_begin + cull_bytes]
    }
}

/// Sample positions within a pixel with four samples; empty on a device without 4x multisampling.
pub(crate) fn sample_positions(gl: &Rc<Gl>) -> Result<Vec<[f32; 2]>> {
    let desc = TargetDesc { width: 1, height: 1, samples: 4, ..TargetDesc::EMPTY };
    if gl.limits.max_samples < desc.samples {
        return Ok(Vec::new());
    }
    let (ids, depth) = (create_image(gl, desc, gl::R32UI)?, create_image(gl, desc, gl::DEPTH_COMPONENT32F)?);
    gl.sample_positions(&gl.framebuffer(Some(&ids), &depth)?, desc.samples)
}

/// An image of a frame, multisampled if the frame is.
pub(crate) fn create_image(gl: &Rc<Gl>, desc: TargetDesc, format: u32) -> Result<Texture> {
    let TargetDesc { width, height, samples, .. } = desc;
    let target = if samples > 1 { gl::TEXTURE_2D_MULTISAMPLE } else { gl::TEXTURE_2D };
    let desc = TextureDesc { target, format, width, height, depth: samples, levels: 1 };
    // Multisampled textures have no sampler parameters.
    if samples > 1 { gl.texture(desc) } else { create_nearest_texture(gl, desc) }
}

/// A texture that is read texel by texel.
pub(crate) fn create_nearest_texture(gl: &Rc<Gl>, desc: TextureDesc) -> Result<Texture> {
    let texture = gl.texture(desc)?;
    texture.set_sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
    Ok(texture)
}
