//! Reuse of the shadow map between the frames of a step. A map that does not depend on the camera is drawn once while
//! the vertices, their origin and the bounds stay the same. The look never changes.

use std::cell::Cell;

use super::super::FrameParams;
use super::super::scene_buffers::SceneBuffers;
use modalcast_model::error::Result;
use modalcast_model::scene::{Bounds, LightSpaceBox};

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
    bounds: Bounds,
    light: Option<LightSpaceBox>,
    origin: [f64; 3],
}

impl ShadowCache {
    /// Forgets the name of the vertices because they were overwritten.
    pub(crate) fn invalidate(&self) {
        self.step.set(None);
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

impl SceneBuffers {
    /// Names the step whose vertices the buffers hold. Frames of the same step, bounds and origin share one shadow map,
    /// unless the map is split into cascades, which follow the camera. Code that writes the buffers directly must name
    /// another step afterwards; an upload clears the name. Without a name, every frame draws its shadow map.
    pub fn set_step(&self, step: u64) {
        self.shadow_cache.step.set(Some(step));
    }

    /// Content of the shadow map for this frame; none when it cannot be shared with other frames.
    pub(crate) fn shadow_key(&self, shot: &FrameParams) -> Option<ShadowKey> {
        let splits = self.scene.look.shadow.map_or(1, |shadow| shadow.splits);
        let step = self.shadow_cache.step.get().filter(|_| splits == 1)?;
        Some(ShadowKey { step, bounds: shot.bounds, light: shot.light, origin: self.origin })
    }
}
