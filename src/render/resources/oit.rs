//! Fragment lists of exact order-independent transparency, in bounded memory.
//!
//! The memory budget is a number of fragments. When a frame has more, every pixel keeps at most the same number of its
//! nearest fragments: the largest number for which all lists fit, up to 256. Dropped fragments are counted.

use std::rc::Rc;

use super::target_desc::{BlendStorage, TargetDesc, create_nearest_texture};
use crate::device::gl::{self, Buffer, Framebuffer, Gl, Limits, Texture, TextureDesc};
use crate::layout::oit::{
    COUNTERS_BINDING, COUNTERS_BYTES, COUNTS_IMAGE, CURSORS_IMAGE, RECORD_BYTES, RECORDS_BINDING,
};
use crate::layout::{TILES_BINDING, tile_list_bytes};
use crate::region::DirtyRegion;
use modalcast_model::error::Result;
use modalcast_model::scene::{MAX_FRAGMENTS, RenderSettings, Scene, Transparency};

/// Default budget in fragments per pixel, and its minimum per frame.
const DEFAULT_FRAGMENTS_PER_PIXEL: u64 = 8;
const MIN_FRAGMENTS: u64 = 1 << 20;

/// Images and buffers of exact transparency for frames of one form.
#[derive(Debug)]
pub(crate) struct OitTarget {
    /// Blended fragments of each pixel.
    pub(crate) counts: Texture,
    pub(crate) cursors: Texture,
    /// One array layer per sample.
    pub(crate) layers: Texture,
    /// Framebuffer that clears the counts.
    pub(crate) clear_framebuffer: Framebuffer,
    pub(crate) dirty: DirtyRegion,
    /// Framebuffer with depth only, for the depth test.
    pub(crate) depth_only: Framebuffer,
    pub(crate) records: Buffer,
    pub(crate) counters: Buffer,
    pub(crate) tiles: Buffer,
}

/// Number of fragment records that a frame may use.
///
/// # Errors
/// `Invalid` when the look asks for more records than fit into one buffer of the device.
fn budget(limits: &Limits, look: &RenderSettings, [width, height]: [u32; 2]) -> Result<u32> {
    let most = u64::from(MAX_FRAGMENTS).min(limits.max_storage_bytes / RECORD_BYTES);
    if let Some(fragments) = look.fragments {
        let fits = u64::from(fragments) <= most;
        return if fits { Ok(fragments) } else { Err(gl::too_large("look.fragments", most, fragments.into())) };
    }
    Ok((DEFAULT_FRAGMENTS_PER_PIXEL * u64::from(width) * u64::from(height)).max(MIN_FRAGMENTS).min(most) as u32)
}

impl OitTarget {
    pub(crate) fn new(gl: &Rc<Gl>, desc: TargetDesc, budget: u32, depth: &Texture) -> Result<Self> {
        let TargetDesc { width, height, samples, .. } = desc;
        let image = |target: u32, format: u32, depth: u32| {
            create_nearest_texture(gl, TextureDesc { target, format, width, height, depth, levels: 1 })
        };
        let counts = image(gl::TEXTURE_2D, gl::R32UI, 1)?;
        Ok(Self {
            clear_framebuffer: gl.color_framebuffer(&counts)?,
            dirty: DirtyRegion::default(),
            depth_only: gl.framebuffer(None, depth)?,
            counts,
            cursors: image(gl::TEXTURE_2D, gl::R32UI, 1)?,
            layers: image(gl::TEXTURE_2D_ARRAY, gl::RGBA16F, samples)?,
            records: gl.buffer(RECORD_BYTES * u64::from(budget), gl::STREAM_COPY, None)?,
            counters: gl.buffer(COUNTERS_BYTES as u64, gl::STREAM_COPY, None)?,
            tiles: gl.buffer(tile_list_bytes([width, height]), gl::STREAM_COPY, None)?,
        })
    }

    /// Binds the images and buffers for all passes but the last.
    pub(crate) fn bind(&self) {
        self.counts.bind_image_read_write(COUNTS_IMAGE);
        self.cursors.bind_image_read_write(CURSORS_IMAGE);
        self.records.bind_storage(RECORDS_BINDING);
        self.counters.bind_storage(COUNTERS_BINDING);
        self.tiles.bind_storage(TILES_BINDING);
    }
}

/// How a frame of this look draws blended triangles.
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
    fn the_budget_is_eight_a_pixel_or_what_the_look_says_as_far_as_one_buffer_reaches() {
        let limits = |max_storage_bytes: u64| Limits { max_storage_bytes, ..Limits::default() };
        let of = |fragments: Option<u32>, max_storage_bytes: u64, size: [u32; 2]| {
            budget(&limits(max_storage_bytes), &RenderSettings { fragments, ..RenderSettings::default() }, size)
        };
        assert_eq!(of(None, 1 << 31, [640, 480]).expect("fits"), 8 * 640 * 480);
        assert_eq!(of(None, 1 << 31, [1, 1]).expect("fits"), 1 << 20);
        assert_eq!(of(None, 1 << 27, [8192, 8192]).expect("less"), 1 << 24, "as many as fit");
        assert_eq!(of(Some(100), 1 << 27, [8192, 8192]).expect("fits"), 100);
        let refusal = of(Some(1 << 25), 1 << 27, [64, 64]).expect_err("refused").to_string();
        assert_eq!(refusal, "look.fragments: expected at most 16777216 on this device, got 33554432");
    }
}
