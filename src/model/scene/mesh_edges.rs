//! Lines along the edges of the faces of a mesh, drawn over its shaded surface.

use crate::error::{Result, invalid};

/// Lines along the edges of the faces that a frame shows. Edges that a surface hides are not drawn, nor are the edges
/// with which a loader has triangulated a polygon (see [`crate::domain::Mesh::inner_edges`]). Each face draws the half
/// of a line that is on its own side of the edge, so at a silhouette a line has half of its width. Lines fade out on
/// triangles that are narrower than four widths. Blended surfaces have no lines.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MeshEdges {
    /// Width in pixels, above 0 and at most 32.
    pub width: f32,
    /// Linear color, 0 to 1. It is not lit.
    pub color: [f32; 3],
}

impl Default for MeshEdges {
    fn default() -> Self {
        Self { width: 1.25, color: [0.02; 3] }
    }
}

impl MeshEdges {
    /// The largest width of a line in pixels.
    pub const MAX_WIDTH: f32 = 32.0;

    /// Lines of this width and of the color of `self`.
    #[must_use]
    pub const fn with_width(self, width: f32) -> Self {
        Self { width, ..self }
    }

    /// Whether the width is in its range.
    pub fn has_valid_width(&self) -> bool {
        self.width > 0.0 && self.width <= Self::MAX_WIDTH
    }

    /// Checks the width and the color. `field` is the field of an error without its last part.
    ///
    /// # Errors
    /// `Invalid` with the field and the valid range.
    pub fn check(&self, field: &str) -> Result<()> {
        if !self.has_valid_width() {
            let expected = format!("above 0, to {} pixels", Self::MAX_WIDTH);
            return Err(invalid(format!("{field}.width"), expected, self.width));
        }
        if !self.color.iter().all(|channel| (0.0..=1.0).contains(channel)) {
            return Err(invalid(format!("{field}.color"), "numbers from 0 to 1", format!("{:?}", self.color)));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn width_and_color_out_of_range_are_rejected() {
        MeshEdges::default().check("look.edges").expect("valid edges");
        MeshEdges { width: MeshEdges::MAX_WIDTH, color: [1.0; 3] }.check("look.edges").expect("valid edges");
        for width in [0.0, -1.0, 32.5, f32::NAN, f32::INFINITY] {
            let message = MeshEdges::default().with_width(width).check("look.edges").expect_err("a width").to_string();
            assert_eq!(message, format!("look.edges.width: expected above 0, to 32 pixels, got {width}"));
        }
        for channel in [-0.1, 1.5, f32::NAN] {
            let edges = MeshEdges { color: [0.0, channel, 0.0], ..MeshEdges::default() };
            let message = edges.check("edges").expect_err("a color").to_string();
            assert!(message.starts_with("edges.color: expected numbers from 0 to 1"), "{message}");
        }
    }
}
