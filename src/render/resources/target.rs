//! Render target of a frame: ids, depth and blended layer of each sample, the picture, and the buffers for its
//! readback.

use std::cell::Cell;
use std::rc::Rc;

use super::depth_pyramid::DepthPyramid;
use super::oit::OitTarget;
use super::target_desc::{BlendStorage, TargetDesc, create_image, create_nearest_texture};
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Texture, TextureDesc, VisibilityDirty};
use crate::device::readback_ring::ReadbackRing;
use crate::layout::tile_list_bytes;
use crate::region::{DirtyRegion, Region};
use modalcast_model::error::Result;
use modalcast_model::scene::Culling;

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
            tiles: gl.buffer(tile_list_bytes([width, height]), gl::STREAM_COPY, None)?,
            scene_color: create_image(gl, TargetDesc { samples: 1, ..desc }, gl::RGBA16F)?,
            bloom_mips: bloom_mips(gl, desc)?,
            readback_source: gl.buffer(bytes, gl::STREAM_COPY, None)?,
            readback_ring: ReadbackRing::new(gl, desc.readback_ranges()[1].end),
            pyramid: if desc.culling == Culling::Occlusion { Some(DepthPyramid::new(gl, desc, &depth)?) } else { None },
            depth,
        })
    }
}

/// The bloom pyramid: the bright light of each pixel, then levels of half the size, rounded up.
fn bloom_mips(gl: &Rc<Gl>, desc: TargetDesc) -> Result<Vec<Texture>> {
    if desc.bloom_levels == 0 {
        return Ok(Vec::new());
    }
    let half = |level: u32| {
        let [width, height] = [desc.width, desc.height].map(|side| side.div_ceil(1 << level));
        let desc = TextureDesc { target: gl::TEXTURE_2D, format: gl::RGBA16F, width, height, depth: 1, levels: 1 };
        create_nearest_texture(gl, desc)
    };
    (0..=desc.bloom_levels).map(half).collect()
}
