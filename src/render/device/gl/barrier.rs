//! Memory barriers. They order shader writes to images and storage buffers before later accesses.

use std::ops::BitOr;

use glow::HasContext as _;

use super::Gl;

/// The kinds of later accesses that a barrier orders after all earlier shader writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct MemoryBarriers(u32);

impl MemoryBarriers {
    pub(crate) const NONE: Self = Self(0);
    /// Vertex attributes.
    pub(crate) const VERTEX_ATTRIBUTES: Self = Self(glow::VERTEX_ATTRIB_ARRAY_BARRIER_BIT);
    /// Index buffers.
    pub(crate) const ELEMENT_ARRAY: Self = Self(glow::ELEMENT_ARRAY_BARRIER_BIT);
    /// Texture lookups, including buffer textures.
    pub(crate) const TEXTURE_FETCH: Self = Self(glow::TEXTURE_FETCH_BARRIER_BIT);
    /// Loads, stores and atomics of images in shaders.
    pub(crate) const SHADER_IMAGE: Self = Self(glow::SHADER_IMAGE_ACCESS_BARRIER_BIT);
    /// Indirect draws and dispatches.
    pub(crate) const COMMAND: Self = Self(glow::COMMAND_BARRIER_BIT);
    /// Writes, copies and mappings of buffers by API calls.
    pub(crate) const BUFFER_UPDATE: Self = Self(glow::BUFFER_UPDATE_BARRIER_BIT);
    /// Draws into and clears of framebuffer attachments.
    pub(crate) const FRAMEBUFFER: Self = Self(glow::FRAMEBUFFER_BARRIER_BIT);
    /// Loads, stores and atomics of storage buffers in shaders.
    pub(crate) const SHADER_STORAGE: Self = Self(glow::SHADER_STORAGE_BARRIER_BIT);
}

impl BitOr for MemoryBarriers {
    type Output = Self;

    fn bitor(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }
}

impl Gl {
    /// Orders later accesses of the given kinds after all earlier shader writes, and later shader writes of the given
    /// kinds after all earlier accesses. Does nothing without kinds.
    pub(crate) fn barrier(&self, kinds: MemoryBarriers) {
        if kinds == MemoryBarriers::NONE {
            return;
        }
        let Some(gl) = self.functions_or_skip() else { return };
        // SAFETY: only orders memory accesses.
        unsafe { gl.memory_barrier(kinds.0) }
    }
}
