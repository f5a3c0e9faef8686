//! Render target of a frame: ids, depth and blended layer of each sample, the picture, and the buffers for its
//! readback.

use std::cell::Cell;
use std::ops::Range;
use std::rc::Rc;

use super::cull::{COUNTER_BYTES, DepthPyramid};
use super::oit::{COUNTERS_HEADER_BYTES, OitTarget};
use super::region::{DirtyRegion, Region};
use super::shaders::TILE;
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Texture, TextureDesc, VisibilityDirty};
use crate::device::readback_ring::ReadbackRing;
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

/// The images and buffers of frames of one form.
#[derive(Debug)]
pub(crate) struct RenderTarget {
    pub(crate) desc: TargetDesc,
    /// Id of each sample; kept until the next frame, like depth.
    pub(crate) ids: Texture,
    pub(crate) visibility_fbo: Framebuffer,
    pub(crate) dirty: VisibilityDirty,
    /// Region of the current frame that may show triangles or rasterized ground.
    pub(crate) draw_region: Cell<Region>,
    pub(crate) layer: Option<BlendLayer>,
    pub(crate) oit: Option<OitTarget>,
    /// Indirect dispatch arguments, then the tiles that see triangles.
    pub(crate) tiles: Buffer,
    /// Linear light, one value per pixel.
    pub(crate) scene_color: Texture,
    /// Bright light of each pixel, then levels of half the size; empty without bloom.
    pub(crate) bloom_mips: Vec<Texture>,
    /// RGBA8, top row first, as the encoder writes it.
    pub(crate) readback_source: Buffer,
    /// Staging buffers for the readback of `readback_source`.
    pub(crate) readback_ring: Rc<ReadbackRing>,
    /// Depth pyramid of occlusion culling.
    pub(crate) pyramid: Option<DepthPyramid>,
    pub(crate) depth: Texture,
}

/// Blended light of the translucent triangles per sample, and their transmittance in alpha.
#[derive(Debug)]
pub(crate) struct BlendLayer {
    pub(crate) framebuffer: Framebuffer,
    pub(crate) color: Texture,
    pub(crate) dirty: DirtyRegion,
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

impl RenderTarget {
    pub(crate) fn new(gl: &Rc<Gl>, desc: TargetDesc) -> Result<Self> {
        let TargetDesc { width, height, samples, blended, .. } = desc;
        let (ids, depth) = (create_image(gl, desc, gl::R32UI)?, create_image(gl, desc, gl::DEPTH_COMPONENT32F)?);
        let layer = |color: Texture| {
            Ok(BlendLayer { framebuffer: gl.framebuffer(Some(&color), &depth)?, color, dirty: DirtyRegion::default() })
        };
        let layer = if blended == BlendStorage::SingleLayer {
            Some(layer(create_image(gl, desc, gl::RGBA16F)?)?)
        } else {
            None
        };
        let oit = match blended {
            BlendStorage::FragmentLists(budget) => Some(OitTarget::new(gl, desc, budget, &depth)?),
            BlendStorage::None | BlendStorage::SingleLayer => None,
        };
        let bytes = desc.bytes();
        Ok(Self {
            desc: TargetDesc { samples, ..desc },
            visibility_fbo: gl.framebuffer(Some(&ids), &depth)?,
            dirty: VisibilityDirty::default(),
            draw_region: Cell::new(Region::whole([width, height])),
            ids,
            layer,
            oit,
            tiles: gl.buffer(
                16 + 4 * u64::from(width.div_ceil(TILE)) * u64::from(height.div_ceil(TILE)),
                gl::STREAM_COPY,
                None,
            )?,
            scene_color: create_image(gl, TargetDesc { samples: 1, ..desc }, gl::RGBA16F)?,
            bloom_mips: super::post::bloom_mips(gl, desc)?,
            readback_source: gl.buffer(bytes, gl::STREAM_COPY, None)?,
            readback_ring: ReadbackRing::new(gl, desc.readback_ranges()[1].end),
            pyramid: if desc.culling == Culling::Occlusion { Some(DepthPyramid::new(gl, desc, &depth)?) } else { None },
            depth,
        })
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

pub(crate) fn create_image(gl: &Rc<Gl>, desc: TargetDesc, format: u32) -> Result<Texture> {
    let TargetDesc { width, height, samples, .. } = desc;
    let target = if samples > 1 { gl::TEXTURE_2D_MULTISAMPLE } else { gl::TEXTURE_2D };
    let texture = gl.texture(TextureDesc { target, format, width, height, depth: samples, levels: 1 })?;
    if samples == 1 {
        texture.set_sampling(&[(gl::TEXTURE_MIN_FILTER, gl::NEAREST), (gl::TEXTURE_MAG_FILTER, gl::NEAREST)], 1.0);
    }
    Ok(texture)
}
