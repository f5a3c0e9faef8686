//! Begins a pass: binds its framebuffer, restricts drawing to a region and clears the pixels that earlier frames wrote.

use glow::HasContext as _;

use super::{Framebuffer, Gl};
use crate::region::{Band, DirtyRegion, Region};

/// Dirty regions of an id image and its depth image.
#[derive(Debug, Default)]
pub(crate) struct VisibilityDirtyRegions {
    pub(crate) ids: DirtyRegion,
    pub(crate) depth: DirtyRegion,
}

/// How a pass initializes its framebuffer. With a dirty region, only this region of the image is cleared; without one,
/// the complete image.
#[derive(Debug, Clone, Copy)]
pub(crate) enum ClearOp<'a> {
    /// Depth to 0, the far plane.
    Depth(Option<&'a DirtyRegion>),
    /// Depth and ids to 0.
    DepthAndIds(Option<&'a VisibilityDirtyRegions>),
    /// Color to a value.
    Color([f32; 4], &'a DirtyRegion),
    /// Integer words to 0; the depth is not cleared.
    Uint(&'a DirtyRegion),
    /// The content is kept.
    Load,
}

/// The value that pixels are cleared to.
#[derive(Debug, Clone, Copy)]
enum ClearValue {
    /// Depth of 0.
    FarDepth,
    /// Words of 0.
    Zero,
    Color([f32; 4]),
}

impl Gl {
    /// Binds a framebuffer, clears the band of it as `clear` states and sets the scissor, so that later draws affect
    /// only the part of `region` in the band.
    pub(crate) fn begin_pass(&self, framebuffer: &Framebuffer, region: Region, band: Band, clear: ClearOp<'_>) {
        let Some(gl) = self.functions_or_skip() else { return };
        let [width, height] = region.frame_size().map(|side| side as i32);
        // SAFETY: sets state with a complete framebuffer.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(framebuffer.name));
            gl.viewport(0, 0, width, height);
            gl.enable(glow::SCISSOR_TEST);
            gl.depth_mask(true);
        }
        match clear {
            ClearOp::Depth(dirty) => self.clear_region(region, band, dirty, ClearValue::FarDepth),
            ClearOp::DepthAndIds(dirty) => {
                self.clear_region(region, band, dirty.map(|regions| &regions.depth), ClearValue::FarDepth);
                self.clear_region(region, band, dirty.map(|regions| &regions.ids), ClearValue::Zero);
            }
            ClearOp::Uint(dirty) => self.clear_region(region, band, Some(dirty), ClearValue::Zero),
            ClearOp::Color(color, dirty) => self.clear_region(region, band, Some(dirty), ClearValue::Color(color)),
            ClearOp::Load => {}
        }
        self.set_scissor(region.within(band));
    }

    /// Clears the dirty region of an attachment in a band. `region` becomes the dirty region with the last band.
    fn clear_region(&self, region: Region, band: Band, dirty: Option<&DirtyRegion>, value: ClearValue) {
        let previous_region = dirty.and_then(|dirty| dirty.replace(region, band));
        self.set_scissor(previous_region.unwrap_or_else(|| Region::whole(region.frame_size())).within(band));
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: a clear of a complete framebuffer.
        unsafe {
            match value {
                ClearValue::FarDepth => gl.clear_buffer_f32_slice(glow::DEPTH, 0, &[0.0]),
                ClearValue::Zero => gl.clear_buffer_u32_slice(glow::COLOR, 0, &[0; 4]),
                ClearValue::Color(color) => gl.clear_buffer_f32_slice(glow::COLOR, 0, &color),
            }
        }
    }

    fn set_scissor(&self, region: Region) {
        let [x, y, width, height] = region.rect().map(|number| number as i32);
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: sets state; no memory is accessed.
        unsafe { gl.scissor(x, y, width, height) };
    }
}
