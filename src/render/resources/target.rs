//! Render target of a frame: ids, depth and blended light of each sample, the scene color, and the buffers for the
//! readback of the frame.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::Arc;
use std::time::Instant;

use super::depth_pyramid::DepthPyramid;
use super::oit::OitTarget;
use super::target_desc::{BlendStorage, TargetDesc, create_image, create_nearest_texture};
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Texture, TextureDesc, VisibilityDirtyRegions};
use crate::device::readback_ring::ReadbackRing;
use crate::layout::ambient::AmbientSampling;
use crate::layout::tile_list_bytes;
use crate::region::{DirtyRegion, Region};
use modalcast_model::error::Result;
use modalcast_model::memory::MemoryReservation;
use modalcast_model::scene::Culling;
use modalcast_model::shared_memory::PictureMemory;

/// Images and buffers of a frame. Consecutive frames with the same [`TargetDesc`] share them.
#[derive(Debug)]
pub(crate) struct RenderTarget {
    pub(crate) desc: TargetDesc,
    pub(crate) last_use: Instant,
    /// Id of each sample; valid until the next frame, like `depth`.
    pub(crate) ids: Texture,
    pub(crate) visibility_fbo: Framebuffer,
    pub(crate) dirty_regions: VisibilityDirtyRegions,
    /// Region of the current frame that may show triangles.
    pub(crate) draw_region: Cell<Region>,
    pub(crate) blend_layer: Option<BlendLayer>,
    pub(crate) oit: Option<OitTarget>,
    /// Tiles in which triangles are visible, for an indirect dispatch.
    pub(crate) tile_list: Buffer,
    /// Shaded image: linear light per pixel.
    pub(crate) scene_color: Texture,
    /// Bloom pyramid; empty without bloom. Level 0 has the size of the frame.
    pub(crate) bloom_mips: Vec<Texture>,
    /// Output of the encode pass unless the frame has a shared picture: RGBA8, top row first.
    pub(crate) readback_source: Buffer,
    /// Memory in which the pixels leave the device: staging buffers for `readback_source`, or shared pictures.
    pub(crate) readback_ring: Rc<ReadbackRing>,
    pub(crate) ambient: Option<AmbientImages>,
    /// Present with occlusion culling.
    pub(crate) depth_pyramid: Option<DepthPyramid>,
    pub(crate) depth: Texture,
    _memory: Arc<MemoryReservation>,
}

/// Images of the ambient occlusion.
#[derive(Debug)]
pub(crate) struct AmbientImages {
    /// Depth and normal of each texel.
    pub(crate) surface: Texture,
    /// Visibility and depth of each texel, before and after the noise is removed.
    pub(crate) noisy_visibility: Texture,
    pub(crate) visibility: Texture,
}

/// Light of the blended triangles per sample, and their transmittance in alpha.
#[derive(Debug)]
pub(crate) struct BlendLayer {
    pub(crate) framebuffer: Framebuffer,
    pub(crate) color: Texture,
    pub(crate) dirty_region: DirtyRegion,
}

impl RenderTarget {
    /// Creates the images and buffers in memory that is reserved for them. `picture_memory`: allocates shared pictures, if
    /// there are any.
    pub(crate) fn new(
        gl: &Rc<Gl>,
        desc: TargetDesc,
        memory: Arc<MemoryReservation>,
        picture_memory: Option<Rc<dyn PictureMemory>>,
    ) -> Result<Self> {
        let TargetDesc { width, height, blend_storage, .. } = desc;
        let (ids, depth) = (create_image(gl, desc, gl::R32UI)?, create_image(gl, desc, gl::DEPTH_COMPONENT32F)?);
        let [_, cull_range] = desc.readback_ranges();
        let create_layer = |color: Texture| {
            Ok(BlendLayer {
                framebuffer: gl.framebuffer(Some(&color), &depth)?,
                color,
                dirty_region: DirtyRegion::default(),
            })
        };
        let blend_layer = if blend_storage == BlendStorage::SingleLayer {
            Some(create_layer(create_image(gl, desc, gl::RGBA16F)?)?)
        } else {
            None
        };
        let oit = match blend_storage {
            BlendStorage::FragmentLists(budget) => Some(OitTarget::new(gl, desc, budget, &depth)?),
            BlendStorage::None | BlendStorage::SingleLayer => None,
        };
        Ok(Self {
            desc,
            last_use: Instant::now(),
            visibility_fbo: gl.framebuffer(Some(&ids), &depth)?,
            dirty_regions: VisibilityDirtyRegions::default(),
            draw_region: Cell::new(Region::whole([width, height])),
            ids,
            blend_layer,
            oit,
            tile_list: gl.buffer(tile_list_bytes([width, height]), gl::STREAM_COPY, None)?,
            scene_color: create_image(gl, TargetDesc { samples: 1, ..desc }, gl::RGBA16F)?,
            bloom_mips: create_bloom_mips(gl, desc)?,
            readback_source: gl.buffer(desc.frame_bytes(), gl::STREAM_COPY, None)?,
            readback_ring: ReadbackRing::new(gl, cull_range.end, picture_memory),
            ambient: desc.ambient_sampling.map(|sampling| create_ambient_images(gl, desc, sampling)).transpose()?,
            depth_pyramid: if desc.culling == Culling::Occlusion {
                Some(DepthPyramid::new(gl, desc, &depth)?)
            } else {
                None
            },
            depth,
            _memory: memory,
        })
    }
}

fn create_ambient_images(gl: &Rc<Gl>, desc: TargetDesc, sampling: AmbientSampling) -> Result<AmbientImages> {
    let [width, height] = sampling.image_size([desc.width, desc.height]);
    let desc = TargetDesc { width, height, ..TargetDesc::EMPTY };
    Ok(AmbientImages {
        surface: create_image(gl, desc, gl::RG32UI)?,
        noisy_visibility: create_image(gl, desc, gl::RG32F)?,
        visibility: create_image(gl, desc, gl::RG32F)?,
    })
}

/// Creates the bloom pyramid: level 0 with the size of the frame, then levels of half the size, rounded up.
fn create_bloom_mips(gl: &Rc<Gl>, desc: TargetDesc) -> Result<Vec<Texture>> {
    if desc.bloom_levels == 0 {
        return Ok(Vec::new());
    }
    let create_level = |level: u32| {
        let [width, height] = [desc.width, desc.height].map(|side| side.div_ceil(1 << level));
        let desc = TextureDesc { target: gl::TEXTURE_2D, format: gl::RGBA16F, width, height, depth: 1, levels: 1 };
        create_nearest_texture(gl, desc)
    };
    (0..=desc.bloom_levels).map(create_level).collect()
}
