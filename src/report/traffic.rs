//! The bytes that a step must move, by formula.

use serde::Serialize;

use crate::scene::Scene;

/// One operand of a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Part {
    pub name: &'static str,
    /// The formula, in the letters of the thesis: n vertices, c corners, r modes, d domains.
    pub formula: &'static str,
    pub bytes: u64,
}

/// What a deformer in f32 with normals by T moves at least: every operand once, shapes that instances share once.
pub fn of_scene(scene: &Scene) -> Vec<Part> {
    let layout = &scene.layout;
    let mut seen = vec![false; scene.shapes.len()];
    let (mut entries, mut vertices, mut corners, mut tangents) = (0, 0, 0, 0);
    for domain in &scene.domains {
        if !std::mem::replace(&mut seen[domain.shape], true) {
            let shape = &scene.shapes[domain.shape];
            entries += shape.modes.columns().len();
            vertices += shape.mesh.rest().len();
            corners += shape.mesh.corners().normals.len();
            tangents += shape.tangents().len();
        }
    }
    let mapped = if scene.needs.normal_maps { layout.corners } else { 0 };
    let part = |name, formula, bytes: usize| Part { name, formula, bytes: bytes as u64 };
    let parts = [
        part("U", "4 x sum 3 n r", 4 * entries),
        part("x0", "12 x sum n", 12 * vertices),
        part("q", "4 x sum r", 4 * layout.coordinates),
        part("T", "48 x d", 48 * layout.slots.len()),
        part("x", "12 x sum n", 12 * layout.vertices),
        part("normals in", "12 x sum c", 12 * corners),
        part("normals out", "12 x sum c", 12 * layout.corners),
        part("tangents in", "16 x sum c", 16 * tangents),
        part("tangents out", "16 x sum c", 16 * mapped),
    ];
    parts.into_iter().filter(|part| part.bytes > 0).collect()
}

/// The formulas as one line of text: name: formula = bytes, for each part.
pub fn line(parts: &[Part]) -> String {
    let part = |part: &Part| format!("{}: {} = {}", part.name, part.formula, part.bytes);
    parts.iter().map(part).collect::<Vec<_>>().join("; ")
}

/// All bytes.
pub fn total(parts: &[Part]) -> u64 {
    parts.iter().map(|part| part.bytes).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::report::loads::{Kind, Size};

    #[test]
    fn bytes_of_load_a_are_those_of_the_formulas() {
        let scene = Kind::A { dressed: true }.build(Size::Quick).expect("built").scene;
        let (n, r) = (30_000, 32);
        let want = 4 * 3 * n * r + 12 * n + 4 * r + 48 + 12 * n + 2 * 12 * n + 2 * 16 * n;
        assert_eq!(total(&of_scene(&scene)), want);
        let bare = Kind::A { dressed: false }.build(Size::Quick).expect("built").scene;
        assert_eq!(total(&of_scene(&bare)), 4 * 3 * n * r + 24 * n + 4 * r + 48 + 2 * 12 * 3);
        assert!(line(&of_scene(&bare)).starts_with("U: 4 x sum 3 n r = 11520000; x0: 12 x sum n = 360000; "));
    }
}
