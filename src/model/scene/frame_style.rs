//! What a color frame sets for itself in place of the look of its scene.

use super::MeshEdges;

/// Settings of one color frame. Equal styles give equal pixels.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct FrameStyle {
    /// Lines along mesh edges. `None`: no lines.
    pub edges: Option<MeshEdges>,
    /// Samples per pixel, 1 or 4. `None`: as the look, or the rule without a preset, chooses for the size of the frame.
    pub samples: Option<u32>,
}
