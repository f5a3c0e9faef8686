//! Form of a frame: the properties that determine its images and buffers.

use std::ops::Range;
use std::rc::Rc;

use crate::device::gl::{self, Gl, Texture, TextureDesc};
use crate::layout::cull::COUNTER_BYTES;
use crate::layout::oit::COUNTERS_HEADER_BYTES;
use modalcast_model::error::Result;
use modalcast_model::scene::{Culling, RenderSettings};

/// Maximum number of pixels of a multisampled frame: with depth, ids and a blended layer they take 704 MiB of device
/// memory. Larger frames are drawn with one sample per pixel.
const MULTISAMPLED_PIXELS: u64 = 11 << 20;

/// Properties of a frame that determine its images and buffers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct TargetDesc {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) samples: u32,
    pub(crate) blended: BlendStorage,
    /// Levels of the bloom pyramid below the picture's size.
    pub(crate) bloom_levels: u32,
    /// Culling method; never the automatic choice.
    pub(crate) culling: Culling,
}

/// Resources that a frame needs for blended triangles.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum BlendStorage {
    None,
    /// A layer into which they are blended in draw order.
    SingleLayer,
    /// Lists with this budget of fragments.
    FragmentLists(u32),
}

impl TargetDesc {
    /// No pixels and no optional features.
    pub(crate) const EMPTY: Self =
        Self { width: 0, height: 0, samples: 1, blended: BlendStorage::None, bloom_levels: 0, culling: Culling::None };

    /// The form of a frame of a look.
    pub(crate) fn new(gl: &Gl, [width, height]: [u32; 2], look: &RenderSettings, blended: BlendStorage) -> Self {
        let bloom_levels = look.bloom.map_or(0, |bloom| bloom.levels);
        Self { blended, bloom_levels, ..Self::plain(gl, [width, height], look.samples_per_pixel()) }
    }

    /// The form of a frame with ids and depth only, with `wanted` samples per pixel if the device and the frame size
    /// allow it, else one.
    pub(crate) fn plain(gl: &Gl, [width, height]: [u32; 2], wanted: u32) -> Self {
        let fits = u64::from(width) * u64::from(height) <= MULTISAMPLED_PIXELS && wanted <= gl.limits.max_samples;
        Self { width, height, samples: if fits { wanted } else { 1 }, ..Self::EMPTY }
    }

    /// Bytes of the encoded picture.
    pub(crate) fn bytes(&self) -> u64 {
        4 * u64::from(self.width) * u64::from(self.height)
    }

    /// Byte ranges of the list and culling statistics, which follow the picture in the staging buffer; empty without
    /// lists or culling.
    pub(crate) fn readback_ranges(&self) -> [Range<u64>; 2] {
        let lists =
            if matches!(self.blended, BlendStorage::FragmentLists(_)) { COUNTERS_HEADER_BYTES as u64 } else { 0 };
        let culled = if self.culling == Culling::None { 0 } else { COUNTER_BYTES as u64 };
        let (first, second) = (self.bytes(), self.bytes() + lists);
        [first..second, second..second + culled]
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
