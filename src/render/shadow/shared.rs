//! One shadow for all frames of a step: a map that does not depend on the camera is drawn once while the vertices, their
//! origin and the bounds stay as they are. The look never changes.

use std::cell::Cell;

use super::super::Shot;
use super::super::scene_buffers::SceneBuffers;
use modalcast_model::error::Result;
use modalcast_model::scene::{Bounds, LightBounds};

/// What the vertices are, and what the map was last drawn of.
#[derive(Debug, Default)]
pub(crate) struct Shared {
    /// None: nobody says what the vertices are, and every frame draws the map.
    step: Cell<Option<u64>>,
    drawn: Cell<Option<Content>>,
}

/// All that a map shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Content {
    step: u64,
    bounds: Bounds,
    light: Option<LightBounds>,
    origin: [f64; 3],
}

impl Shared {
    /// Forgets what the vertices are, because they were written.
    pub(crate) fn forget(&self) {
        self.step.set(None);
    }

    /// Whether the map does not show this content yet.
    pub(crate) fn is_wanted(&self, content: Option<Content>) -> bool {
        content.is_none() || content != self.drawn.get()
    }

    /// Draws the map by `draw` unless it shows this content already; whether that was needed. A map whose drawing failed shows
    /// nothing.
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
    /// Names the step whose vertices the buffers hold: frames of the same step, bounds and origin share one shadow, unless
    /// it is split by the camera's view. Whoever writes the buffers in place of an upload must name another step then; an
    /// upload forgets the name. Without a name, every frame draws its shadow.
    pub fn hold_step(&self, step: u64) {
        self.shared_shadow.step.set(Some(step));
    }

    /// What the map would show in this frame; none when it is this frame's alone.
    pub(crate) fn shadow_of(&self, shot: &Shot) -> Option<Content> {
        let splits = self.scene.look.shadow.map_or(1, |shadow| shadow.splits);
        let step = self.shared_shadow.step.get().filter(|_| splits == 1)?;
        Some(Content { step, bounds: shot.bounds, light: shot.light, origin: self.origin })
    }
}
