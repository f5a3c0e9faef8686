//! Begins a pass: binds its framebuffer, restricts drawing to a region and clears what earlier frames wrote.

use glow::HasContext as _;

use super::{Framebuffer, Gl};
use crate::region::{DirtyRegion, Region};

/// Dirty regions of an id image and its depth image.
#[derive(Debug, Default)]
pub(crate) struct VisibilityDirty {
    pub(crate) ids: DirtyRegion,
    pub(crate) depth: DirtyRegion,
}

/// How a pass initializes its framebuffer. With a known dirty region only that is cleared, else the whole image.
#[derive(Debug, Clone, Copy)]
pub(crate) enum ClearOp<'a> {
    /// Depth to 1.
    Depth(Option<&'a DirtyRegion>),
    /// Depth to 1 and ids to 0.
    DepthAndIds(Option<&'a VisibilityDirty>),
    Color([f32; 4], &'a DirtyRegion),
    /// Integer words to 0; there is no depth.
    Uint(&'a DirtyRegion),
    /// The content is kept.
    Load,
}

/// The value that pixels are cleared to.
#[derive(Debug, Clone, Copy)]
enum ClearValue {
    /// Depth of 1.
    FarDepth,
    /// Words of 0.
    Zero,
    Color([f32; 4]),
}

impl Gl {
    /// Binds a framebuffer, clears it and sets the scissor: later draws reach only `part`.
    pub(crate) fn begin_pass(&self, into: &Framebuffer, part: Region, clear: ClearOp<'_>) {
        let Some(gl) = self.functions_or_skip() else { return };
        let [width, height] = part.frame().map(|side| side as i32);
        // SAFETY: sets state with a complete framebuffer.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(into.name));
            gl.viewport(0, 0, width, height);
            gl.enable(glow::SCISSOR_TEST);
            gl.depth_mask(true);
        }
        match clear {
            ClearOp::Depth(dirty) => self.fill(part, dirty, ClearValue::FarDepth),
            ClearOp::DepthAndIds(dirty) => {
                self.fill(part, dirty.map(|both| &both.depth), ClearValue::FarDepth);
                self.fill(part, dirty.map(|both| &both.ids), ClearValue::Zero);
            }
            ClearOp::Uint(dirty) => self.fill(part, Some(dirty), ClearValue::Zero),
            ClearOp::Color(color, dirty) => self.fill(part, Some(dirty), ClearValue::Color(color)),
            ClearOp::Load => {}
        }
        self.set_scissor(part);
    }

    /// Clears the dirty region of an attachment and marks `part` as dirty.
    fn fill(&self, part: Region, dirty: Option<&DirtyRegion>, with: ClearValue) {
        let last = dirty.and_then(|dirty| dirty.replace(part));
        self.set_scissor(last.unwrap_or_else(|| Region::whole(part.frame())));
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: a clear of a complete framebuffer.
        unsafe {
            match with {
                ClearValue::FarDepth => gl.clear_buffer_f32_slice(glow::DEPTH, 0, &[1.0]),
                ClearValue::Zero => gl.clear_buffer_u32_slice(glow::COLOR, 0, &[0; 4]),
                ClearValue::Color(color) => gl.clear_buffer_f32_slice(glow::COLOR, 0, &color),
            }
        }
    }

    fn set_scissor(&self, to: Region) {
        let [x, y, width, height] = to.rect().map(|number| number as i32);
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: sets state; no memory is accessed.
        unsafe { gl.scissor(x, y, width, height) };
    }
}
