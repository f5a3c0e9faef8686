//! How a pass begins: with a framebuffer, the part of it that is drawn into, and what it holds before.

use glow::HasContext as _;

use super::super::region::{Region, Touched};
use super::{Framebuffer, Gl};

/// What is known of ids and their depth.
#[derive(Debug, Default)]
pub(crate) struct Traces {
    pub(crate) ids: Touched,
    pub(crate) depth: Touched,
}

/// What a pass begins with. What is known of an image tells which pixels need it; without, all do.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Clear<'a> {
    /// Depth of 1.
    Depth(Option<&'a Touched>),
    /// Depth of 1 and ids of 0.
    DepthAndIds(Option<&'a Traces>),
    Colour([f32; 4], &'a Touched),
    /// Words of 0, without depth.
    Words(&'a Touched),
    /// All stays.
    Nothing,
}

/// What pixels are made to hold.
#[derive(Debug, Clone, Copy)]
enum Fill {
    /// Depth of 1.
    Far,
    /// Words of 0.
    Zero,
    Colour([f32; 4]),
}

impl Gl {
    /// Binds a framebuffer and clears; from then on draws reach this part of it alone.
    pub(crate) fn begin(&self, into: &Framebuffer, part: Region, clear: Clear<'_>) {
        let gl = self.on();
        let [width, height] = part.frame().map(|side| side as i32);
        // SAFETY: state with a complete framebuffer.
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

    /// Fills what was touched of an attachment, before `part` is.
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
        // SAFETY: plain state.
        unsafe { self.on().scissor(x, y, width, height) };
    }
}
