//! Reuse of the shadow map between the frames of a step, that is, of one state of the vertices. A map that does not
//! depend on the camera is drawn again only if the vertices, their origin or the bounds change. The look of a scene
//! never changes.

use std::cell::Cell;

use crate::types::FrameParams;
use modalcast_model::scene::{BoundingBox, OrientedBounds};

/// Step of the current vertices, and content of the map.
#[derive(Debug, Default)]
pub(crate) struct ShadowCache {
    /// Step of the vertices. If it is unknown, every frame draws the map.
    step: Cell<Option<u64>>,
    /// Key of the map's present content; none if it is invalid or depends on the camera.
    content: Cell<Option<ShadowKey>>,
}

/// All inputs that determine the content of a map.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct ShadowKey {
    step: u64,
    bounds: BoundingBox,
    light_bounds: Option<OrientedBounds>,
    origin: [f64; 3],
}

impl ShadowCache {
    /// Forgets the step because the vertices were overwritten.
    pub(crate) fn invalidate(&self) {
        self.step.set(None);
    }

    /// Sets the step of the current vertices.
    pub(crate) fn set_step(&self, step: u64) {
        self.step.set(Some(step));
    }

    /// Key of a map that does not depend on the camera; none if the step is unknown.
    pub(crate) fn key(&self, params: &FrameParams, origin: [f64; 3]) -> Option<ShadowKey> {
        let step = self.step.get()?;
        Some(ShadowKey { step, bounds: params.bounds, light_bounds: params.light_bounds, origin })
    }

    /// Whether the map must be drawn to get this content.
    pub(crate) fn is_stale(&self, key: Option<ShadowKey>) -> bool {
        key.is_none() || key != self.content.get()
    }

    /// Sets the content of the map; none before the map is drawn.
    pub(crate) fn set_content(&self, key: Option<ShadowKey>) {
        self.content.set(key);
    }
}
