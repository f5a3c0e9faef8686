//! Begins a pass: binds its framebuffer, restricts drawing to a region and clears what earlier frames wrote.

use glow::HasContext as _;

use super::super::region::{Region, Touched};
use super::{Framebuffer, Gl};

/// Dirty regions of an id image and its depth image.
#[derive(Debug, Default)]
pub(crate) struct Traces {
    pub(crate) ids: Touched,
    pub(crate) depth: Touched,
}

/// How a pass initializes its framebuffer. With a known dirty region only that is cleared, else the whole image.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Clear<'a> {
    /// Depth to 1.
    Depth(Option<&'a Touched>),
    /// Depth to 1 and ids to 0.
    DepthAndIds(Option<&'a Traces>),
    Colour([f32; 4], &'a Touched),
    /// Integer words to 0; there is no depth.
    Words(&'a Touched),
    /// The content is kept.
    Nothing,
}

/// The value that pixels are cleared to.
#[derive(Debug, Clone, Copy)]
enum Fill {
    /// Depth of 1.
    Far,
    /// Words of 0.
    Zero,
    Colour([f32; 4]),
}

impl Gl {
    /// Binds a framebuffer, clears it and sets the scissor: later draws reach only `part`.
    pub(crate) fn begin(&self, into: &Framebuffer, part: Region, clear: Clear<'_>) {
        let gl = self.on();
        let [width, height] = part.frame().map(|side| side as i32);
        // SAFETY: sets state with a complete framebuffer.
        unsafe {
            gl.bind_framebuffer(glow::FRAMEBUFFER, Some(into.name));
            gl.viewport(0, 0, width, height);
            gl.enable(glow::SCISSOR_TEST);
            gl.depth_mask(true);
        }
        match clear {
            Clear::Depth(touched) => self.fill(part, touched, Fill::Far),
            Clear::DepthAndIds(touched) => {
                self.fill(part, touched.map(|both| &both.depth), Fill::Far);
                self.fill(part, touched.map(|both| &both.ids), Fill::Zero);
            }
            Clear::Words(touched) => self.fill(part, Some(touched), Fill::Zero),
            Clear::Colour(colour, touched) => self.fill(part, Some(touched), Fill::Colour(colour)),
            Clear::Nothing => {}
        }
        self.cut(part);
    }

    /// Clears the dirty region of an attachment and marks `part` as dirty.
    fn fill(&self, part: Region, touched: Option<&Touched>, with: Fill) {
        let last = touched.and_then(|touched| touched.replace(part));
        self.cut(last.unwrap_or_else(|| Region::whole(part.frame())));
        let gl = self.on();
        // SAFETY: a clear of a complete framebuffer.
        unsafe {
            match with {
                Fill::Far => gl.clear_buffer_f32_slice(glow::DEPTH, 0, &[1.0]),
                Fill::Zero => gl.clear_buffer_u32_slice(glow::COLOR, 0, &[0; 4]),
                Fill::Colour(colour) => gl.clear_buffer_f32_slice(glow::COLOR, 0, &colour),
            }
        }
    }

    fn cut(&self, to: Region) {
        let [x, y, width, height] = to.part().map(|number| number as i32);
        // SAFETY: sets state; no memory is accessed.
        unsafe { self.on().scissor(x, y, width, height) };
    }
}
