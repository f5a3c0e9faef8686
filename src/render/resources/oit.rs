//! Fragment lists of exact order-independent transparency, in bounded memory.
//!
//! The memory budget is a number of fragments. When a frame has more, each pixel keeps only its nearest fragments, up
//! to a limit that all pixels share. It is the largest limit for which all lists fit, at most 256 (the number of bins
//! of the histogram over fragments per pixel). Dropped fragments are counted.

use std::rc::Rc;

use super::target_desc::{BlendStorage, TargetDesc, create_nearest_texture};
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Limits, Texture, TextureDesc};
use crate::layout::oit::{
    COUNTERS_BYTES, CURSORS_IMAGE, FRAGMENT_COUNTS_IMAGE, OIT_COUNTERS_BINDING, RECORD_BYTES, RECORDS_BINDING,
};
use crate::layout::{TILES_BINDING, tile_list_bytes};
use crate::region::DirtyRegion;
use modalcast_model::error::Result;
use modalcast_model::scene::{MAX_FRAGMENTS, RenderSettings, Scene, Transparency};

/// Default budget of a frame, in fragments per pixel.
const DEFAULT_FRAGMENTS_PER_PIXEL: u64 = 8;
/// Minimum of the default budget of a frame, in fragments.
const MIN_FRAGMENTS: u64 = 1 << 20;

/// Images and buffers of exact transparency for one [`TargetDesc`].
#[derive(Debug)]
pub(crate) struct OitTarget {
    /// Number of blended fragments of each pixel.
    pub(crate) fragment_counts: Texture,
    /// Index of the next record of each pixel.
    pub(crate) cursors: Texture,
    /// Light and transmittance of the blended triangles; one array layer per sample.
    pub(crate) blend_layers: Texture,
    /// Framebuffer to clear `fragment_counts`.
    pub(crate) counts_fbo: Framebuffer,
    /// Dirty region of `fragment_counts`.
    pub(crate) dirty_region: DirtyRegion,
    /// Framebuffer with the frame's depth only, for the depth test.
    pub(crate) depth_fbo: Framebuffer,
    /// Fragments of all lists, one record each.
    pub(crate) records: Buffer,
    /// [`crate::layout::oit::OitCounters`] and the histogram bins.
    pub(crate) counters: Buffer,
    /// Tiles with blended fragments, for an indirect dispatch.
    pub(crate) tile_list: Buffer,
}

/// Maximum number of fragment records of a frame.
///
/// # Errors
/// `Invalid` if the look asks for more records than fit into one buffer of the device.
fn budget(limits: &Limits, look: &RenderSettings, [width, height]: [u32; 2]) -> Result<u32> {
    let max_fragments = u64::from(MAX_FRAGMENTS).min(limits.max_storage_bytes / RECORD_BYTES);
    if let Some(fragments) = look.fragments {
        let is_allowed = u64::from(fragments) <= max_fragments;
        return if is_allowed {
            Ok(fragments)
        } else {
            Err(gl::too_large("look.fragments", max_fragments, fragments.into()))
        };
    }
    Ok((DEFAULT_FRAGMENTS_PER_PIXEL * u64::from(width) * u64::from(height)).max(MIN_FRAGMENTS).min(max_fragments)
        as u32)
}

impl OitTarget {
    pub(crate) fn new(gl: &Rc<Gl>, desc: TargetDesc, budget: u32, depth: &Texture) -> Result<Self> {
        let TargetDesc { width, height, samples, .. } = desc;
        let create_image = |target: u32, format: u32, depth: u32| {
            create_nearest_texture(gl, TextureDesc { target, format, width, height, depth, levels: 1 })
        };
        let fragment_counts = create_image(gl::TEXTURE_2D, gl::R32UI, 1)?;
        Ok(Self {
            counts_fbo: gl.color_framebuffer(&fragment_counts)?,
            dirty_region: DirtyRegion::default(),
            depth_fbo: gl.framebuffer(None, depth)?,
            fragment_counts,
            cursors: create_image(gl::TEXTURE_2D, gl::R32UI, 1)?,
            blend_layers: create_image(gl::TEXTURE_2D_ARRAY, gl::RGBA16F, samples)?,
            records: gl.buffer(RECORD_BYTES * u64::from(budget), gl::STREAM_COPY, None)?,
            counters: gl.buffer(COUNTERS_BYTES as u64, gl::STREAM_COPY, None)?,
            tile_list: gl.buffer(tile_list_bytes([width, height]), gl::STREAM_COPY, None)?,
        })
    }

    /// Binds the images and buffers, except `blend_layers`.
    pub(crate) fn bind(&self) {
        self.fragment_counts.bind_image_read_write(FRAGMENT_COUNTS_IMAGE);
        self.cursors.bind_image_read_write(CURSORS_IMAGE);
        self.records.bind_storage(RECORDS_BINDING);
        self.counters.bind_storage(OIT_COUNTERS_BINDING);
        self.tile_list.bind_storage(TILES_BINDING);
    }
}

/// Resources that a frame of a scene needs for blended triangles.
pub(crate) fn blend_storage(gl: &Gl, scene: &Scene, size: [u32; 2]) -> Result<BlendStorage> {
    match scene.look.transparency {
        _ if !scene.features.blend => Ok(BlendStorage::None),
        Transparency::TwoPass => Ok(BlendStorage::SingleLayer),
        Transparency::OrderIndependent => budget(&gl.limits, &scene.look, size).map(BlendStorage::FragmentLists),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn budget_is_bounded_by_the_buffer_size() {
        // A record has 8 bytes, so a buffer of 2^27 bytes has space for 2^24 records.
        let limits = |max_storage_bytes: u64| Limits { max_storage_bytes, ..Limits::default() };
        let budget_for = |fragments: Option<u32>, max_storage_bytes: u64, size: [u32; 2]| {
            budget(&limits(max_storage_bytes), &RenderSettings { fragments, ..RenderSettings::default() }, size)
        };
        assert_eq!(budget_for(None, 1 << 31, [640, 480]).expect("a valid budget"), 8 * 640 * 480);
        assert_eq!(budget_for(None, 1 << 31, [1, 1]).expect("a valid budget"), 1 << 20);
        assert_eq!(budget_for(None, 1 << 27, [8192, 8192]).expect("a valid budget"), 1 << 24);
        assert_eq!(budget_for(Some(100), 1 << 27, [8192, 8192]).expect("a valid budget"), 100);
        let error = budget_for(Some(1 << 25), 1 << 27, [64, 64]).expect_err("an error").to_string();
        assert_eq!(error, "look.fragments: expected at most 16777216 on this device, got 33554432");
    }
}
