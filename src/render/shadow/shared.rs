//! Reuse of the shadow map between the frames of a step. A map that does not depend on the camera is drawn once while
//! the vertices, their origin and the bounds stay the same. The look never changes.

use std::cell::Cell;

use super::super::Shot;
use super::super::scene_buffers::SceneBuffers;
use modalcast_model::error::Result;
use modalcast_model::scene::{Bounds, LightBounds};

/// Identity of the current vertices, and what the map was last drawn from.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    /// None while the vertices have no name; every frame then draws the map.
    step: Cell<Option<u64>>,
    drawn: Cell<Option<Content>>,
}

/// Everything that the content of a map depends on.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Content {
    step: u64,
    bounds: Bounds,
    light: Option<LightBounds>,
    origin: [f64; 3],
}

impl Shared {
    /// Forgets the name of the vertices because they were overwritten.
    pub(crate) fn forget(&self) {
        self.step.set(None);
    }

    /// Whether the map must be drawn to show this content.
    pub(crate) fn is_wanted(&self, content: Option<Content>) -> bool {
        content.is_none() || content != self.drawn.get()
    }

    /// Calls `draw` unless the map already shows this content, and returns whether it did. A map whose drawing failed
    /// has no valid content.
    pub(crate) fn draw_unless_there(
        &self,
        content: Option<Content>,
        draw: impl FnOnce() -> Result<()>,
    ) -> Result<bool> {
        let wanted = self.is_wanted(content);
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
    pub fn hold_step(&self, step: u64) {
        self.shared_shadow.step.set(Some(step));
    }

    /// Content of the shadow map for this frame; none when it cannot be shared with other frames.
    pub(crate) fn shadow_of(&self, shot: &Shot) -> Option<Content> {
        let splits = self.scene.look.shadow.map_or(1, |shadow| shadow.splits);
        let step = self.shared_shadow.step.get().filter(|_| splits == 1)?;
        Some(Content { step, bounds: shot.bounds, light: shot.light, origin: self.origin })
    }
}
