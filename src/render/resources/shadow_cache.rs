//! Reuse of the shadow map between the frames of a step. A map that does not depend on the camera is drawn once while
//! the vertices, their origin and the bounds stay the same. The look never changes.

use std::cell::Cell;

use crate::types::FrameParams;
use modalcast_model::error::Result;
use modalcast_model::scene::{BoundingBox, OrientedBounds};

/// Identity of the current vertices, and what the map was last drawn from.
#[derive(Debug, Default)]
pub(crate) struct ShadowCache {
    /// None while the vertices have no name; every frame then draws the map.
    step: Cell<Option<u64>>,
    drawn: Cell<Option<ShadowKey>>,
}

/// Everything that the content of a map depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ShadowKey {
    step: u64,
    bounds: BoundingBox,
    light: Option<OrientedBounds>,
    origin: [f64; 3],
}

impl ShadowCache {
    /// Forgets the name of the vertices because they were overwritten.
    pub(crate) fn invalidate(&self) {
        self.step.set(None);
    }

    /// Names the current vertices.
    pub(crate) fn set_step(&self, step: u64) {
        self.step.set(Some(step));
    }

    /// Content of a map that does not depend on the camera; none while the vertices have no name.
    pub(crate) fn key(&self, shot: &FrameParams, origin: [f64; 3]) -> Option<ShadowKey> {
        let step = self.step.get()?;
        Some(ShadowKey { step, bounds: shot.bounds, light: shot.light, origin })
    }

    /// Whether the map must be drawn to show this content.
    pub(crate) fn is_stale(&self, content: Option<ShadowKey>) -> bool {
        content.is_none() || content != self.drawn.get()
    }

    /// Calls `draw` unless the map already shows this content, and returns whether it did. A map whose drawing failed
    /// has no valid content.
    pub(crate) fn draw_if_stale(&self, content: Option<ShadowKey>, draw: impl FnOnce() -> Result<()>) -> Result<bool> {
        let wanted = self.is_stale(content);
        self.drawn.take();
        if wanted {
            draw()?;
        }
        self.drawn.set(content);
        Ok(wanted)
    }
}
