//! Description of a render target, and creation of its images.

use std::ops::Range;
use std::rc::Rc;

use crate::device::gl::{self, Gl, Texture, TextureDesc};
use crate::device::readback_ring::MAX_FRAMES_IN_FLIGHT;
use crate::layout::ambient::AmbientSampling;
use crate::layout::cull::CULL_COUNTER_BYTES;
use crate::layout::oit::{OIT_HEADER_BYTES, RECORD_BYTES};
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
    /// The sampling of the ambient occlusion; none without it.
    pub(crate) ambient_sampling: Option<AmbientSampling>,
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
        ambient_sampling: None,
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

    /// Device memory in bytes of all images and buffers of a frame.
    pub(crate) fn bytes(&self) -> u64 {
        let pixels = u64::from(self.width) * u64::from(self.height);
        let samples = pixels * u64::from(self.samples);
        let blend_bytes = match self.blend_storage {
            BlendStorage::None => 0,
            // RGBA16F per sample.
            BlendStorage::SingleLayer => 8 * samples,
            // RGBA16F per sample, a counter and a cursor per pixel.
            BlendStorage::FragmentLists(fragments) => 8 * samples + 8 * pixels + RECORD_BYTES * u64::from(fragments),
        };
        // RGBA16F, or f32 depth, of all levels, which together have 4/3 of the pixels.
        let bloom_bytes = if self.bloom_levels > 0 { 32 * pixels / 3 } else { 0 };
        let pyramid_bytes = if self.culling == Culling::Occlusion { 16 * pixels / 3 } else { 0 };
        // RG32UI and twice RG32F.
        let ambient_bytes = self.ambient_sampling.map_or(0, |sampling| {
            let [width, height] = sampling.image_size([self.width, self.height]).map(u64::from);
            24 * width * height
        });
        let [_, readback_range] = self.readback_ranges();
        let staging_bytes = MAX_FRAMES_IN_FLIGHT as u64 * readback_range.end;
        // Ids and depth per sample, and RGBA16F and the encoded color per pixel.
        8 * samples
            + 8 * pixels
            + self.frame_bytes()
            + staging_bytes
            + blend_bytes
            + bloom_bytes
            + pyramid_bytes
            + ambient_bytes
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

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::RendererKind;

    #[test]
    fn bytes_of_a_target_grow_with_its_features() {
        let plain = TargetDesc { width: 100, height: 10, ..TargetDesc::EMPTY };
        // Ids, depth, scene color, encoded color, and three staging buffers.
        assert_eq!(plain.bytes(), (4 + 4 + 8 + 4 + 3 * 4) * 1000);
        let multisampled = TargetDesc { samples: 4, ..plain };
        assert_eq!(multisampled.bytes() - plain.bytes(), 3 * 8 * 1000);
        let layered = TargetDesc { blend_storage: BlendStorage::SingleLayer, ..multisampled };
        assert_eq!(layered.bytes() - multisampled.bytes(), 4 * 8 * 1000);
        let lists = TargetDesc { blend_storage: BlendStorage::FragmentLists(1 << 20), ..plain };
        assert!(lists.bytes() - plain.bytes() >= RECORD_BYTES << 20);
        let ambient = |renderer| TargetDesc { ambient_sampling: Some(AmbientSampling::of(renderer)), ..plain };
        assert_eq!(ambient(RendererKind::Hardware).bytes() - plain.bytes(), 24 * 1000);
        assert_eq!(ambient(RendererKind::Software).bytes() - plain.bytes(), 24 * 250);
        for larger in [TargetDesc { bloom_levels: 3, ..plain }, TargetDesc { culling: Culling::Occlusion, ..plain }] {
            assert!(larger.bytes() > plain.bytes(), "{larger:?}");
        }
    }
}
