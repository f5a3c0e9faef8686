//! Host memory that receives vertices from the device.

use std::sync::Arc;

use crate::gpu::launch::{Device, PageLock};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::BoundingBox;

/// Lengths of the lists of a surface, in f32; 0 for a list that is not requested.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) struct SurfaceLengths {
    pub positions: usize,
    pub normals: usize,
    pub tangents: usize,
    pub displacements: usize,
}

/// A surface whose large lists are page-locked. The lists keep their lengths, because a page lock covers a fixed range.
pub(super) struct PinnedSurface {
    surface: Arc<DeformedSurface>,
    /// The page locks of the lists of `surface`.
    locks: Vec<PageLock>,
}

/// Mutable lists of a surface. Their lengths are fixed, except that of `boxes`, which is never page-locked.
#[derive(Debug)]
pub(super) struct SurfaceLists<'a> {
    pub positions: &'a mut [f32],
    pub normals: &'a mut [f32],
    pub tangents: &'a mut [f32],
    pub displacements: &'a mut [f32],
    pub boxes: &'a mut Vec<BoundingBox>,
}

impl PinnedSurface {
    /// A surface without lists.
    pub(super) fn empty() -> Self {
        Self { surface: Arc::new(DeformedSurface::default()), locks: Vec::new() }
    }

    /// Allocates lists of these lengths and page-locks them. Lists that are not empty remain unchanged.
    ///
    /// # Errors
    /// `Fault` when a reader has a reference to the surface.
    pub(super) fn allocate(&mut self, device: &Device, lengths: SurfaceLengths) -> Result<()> {
        let surface = Self::exclusive(&mut self.surface)?;
        let DeformedSurface { positions, normals, tangents, displacements, .. } = surface;
        let lists_and_lengths = [
            (positions, lengths.positions),
            (normals, lengths.normals),
            (tangents, lengths.tangents),
            (displacements, lengths.displacements),
        ];
        for (list, length) in lists_and_lengths {
            if list.is_empty() && length > 0 {
                list.resize(length, 0.0);
                // SAFETY: nothing else changes the length of the list, so it is not moved. `drop` drops the lock before
                // `surface`, and the memory is freed after that: with `surface`, or with the last reference to it.
                self.locks.extend(unsafe { PageLock::new(device, list) });
            }
        }
        Ok(())
    }

    /// The lists to write. The caller has waited for the last copy into them.
    ///
    /// # Errors
    /// `Fault` when a reader has a reference to the surface.
    pub(super) fn lists(&mut self) -> Result<SurfaceLists<'_>> {
        let DeformedSurface { positions, normals, tangents, displacements, boxes } =
            Self::exclusive(&mut self.surface)?;
        Ok(SurfaceLists { positions, normals, tangents, displacements, boxes })
    }

    /// The surface. The caller has waited for the last copy into it before it reads the lists.
    pub(super) const fn surface(&self) -> &Arc<DeformedSurface> {
        &self.surface
    }

    /// Whether this is the only reference to the surface.
    pub(super) fn is_unused(&self) -> bool {
        Arc::strong_count(&self.surface) == 1
    }

    /// A mutable reference to the surface, if there is no other reference.
    fn exclusive(surface: &mut Arc<DeformedSurface>) -> Result<&mut DeformedSurface> {
        let in_use = || Error::Fault { stage: "fetch", reason: "expected no reader of the surface".into() };
        Arc::get_mut(surface).ok_or_else(in_use)
    }
}

impl std::fmt::Debug for PinnedSurface {
    /// Does not print the lists, because the device may write them.
    fn fmt(&self, formatter: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        formatter.debug_struct("PinnedSurface").field("locks", &self.locks).finish_non_exhaustive()
    }
}

impl Drop for PinnedSurface {
    fn drop(&mut self) {
        // The locks cover memory of `surface`, so they end first.
        self.locks.clear();
    }
}
