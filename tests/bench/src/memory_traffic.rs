//! Minimum memory traffic of a step, by formula.

use serde::Serialize;

use modalcast_compute::storage::{QUAD, TILE_QUADS, modes_per_chunk};
use modalcast_model::scene::{Scene, StorageType};

/// One operand of a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Operand {
    pub name: &'static str,
    /// The formula: n vertices, f triangles, c corners, r modes, d domains; C chunks of K modes, Q quads of vertices.
    pub formula: &'static str,
    pub bytes: u64,
}

/// Minimum of bytes that a step moves, for the scene's storage type and normals. Every operand counts once, shared
/// shapes count once, and all modes count even with truncation.
pub fn of_scene(scene: &Scene) -> Vec<Operand> {
    let layout = &scene.layout;
    let [mut entries, mut stored, mut scales, mut vertices, mut corners, mut triangles, mut tangents] = [0; 7];
    let mut seen = vec![false; scene.shapes.len()];
    for domain in &scene.domains {
        if std::mem::replace(&mut seen[domain.shape], true) {
            continue;
        }
        let (shape, per_chunk) = (&scene.shapes[domain.shape], modes_per_chunk(scene.deformation.storage));
        let (rest, chunks) = (shape.mesh.rest_positions().len(), shape.modes.rank().div_ceil(per_chunk));
        entries += shape.modes.columns().len();
        stored += 48 * chunks * rest.div_ceil(QUAD);
        scales += 4 * chunks * per_chunk * rest.div_ceil(QUAD * TILE_QUADS);
        vertices += rest;
        corners += shape.mesh.corners().normals.len();
        triangles += shape.mesh.triangles().len();
        tangents += shape.tangents().len();
    }
    let mapped = if scene.features.normal_maps { layout.corners } else { 0 };
    let (exact, storage) = (scene.features.exact_normals, scene.deformation.storage);
    let only = |wanted: bool, bytes: usize| if wanted { bytes } else { 0 };
    let part = |name, formula, bytes: usize| Operand { name, formula, bytes: bytes as u64 };
    let parts = [
        part("U", "4 x sum 3 n r", only(storage == StorageType::F32, 4 * entries)),
        part("U", "48 x sum C Q", only(storage != StorageType::F32, stored)),
        part("scales", "4 x sum C K tiles", only(storage == StorageType::Int8, scales)),
        part("x0", "12 x sum n", 12 * vertices),
        part("q", "4 x sum r", 4 * layout.coordinates),
        part("T", "48 x d", 48 * layout.domains.len()),
        part("x", "12 x sum n", 12 * layout.vertices),
        part("x in", "12 x sum n", only(exact, 12 * layout.vertices)),
        part("triangles", "12 x sum f + 4 x sum c", only(exact, 12 * triangles + 4 * corners)),
        part("normals in", "12 x sum c", only(!exact, 12 * corners)),
        part("normals out", "12 x sum c", 12 * layout.corners),
        part("tangents in", "16 x sum c", 16 * tangents),
        part("tangents out", "16 x sum c", 16 * mapped),
    ];
    parts.into_iter().filter(|part| part.bytes > 0).collect()
}

/// The formulas as one line of text: name: formula = bytes, for each part.
pub fn line(parts: &[Operand]) -> String {
    let part = |part: &Operand| format!("{}: {} = {}", part.name, part.formula, part.bytes);
    parts.iter().map(part).collect::<Vec<_>>().join("; ")
}

/// Sum of all parts.
pub fn total(parts: &[Operand]) -> u64 {
    parts.iter().map(|part| part.bytes).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workloads::{Size, WorkloadKind, with_deformation};
    use modalcast_model::scene::{DeformationSettings, NormalMethod};

    #[test]
    fn bytes_of_load_a_match_the_formulas() {
        let scene = WorkloadKind::OneDomain { has_normal_map: true }.build(Size::Quick).expect("built").scene;
        let (n, r) = (30_000, 32);
        let want = 4 * 3 * n * r + 12 * n + 4 * r + 48 + 12 * n + 2 * 12 * n + 2 * 16 * n;
        assert_eq!(total(&of_scene(&scene)), want);
        let bare = WorkloadKind::OneDomain { has_normal_map: false }.build(Size::Quick).expect("built").scene;
        assert_eq!(total(&of_scene(&bare)), 4 * 3 * n * r + 24 * n + 4 * r + 48 + 2 * 12 * 3);
        let stored = |storage| {
            let scene = with_deformation(&bare, DeformationSettings { storage, ..DeformationSettings::default() })
                .expect("restated");
            of_scene(&scene)[0].bytes
        };
        assert_eq!([StorageType::F16, StorageType::Int8].map(stored), [6 * n * r, 3 * n * r]);
        let exact = DeformationSettings { normals: NormalMethod::Exact, ..DeformationSettings::default() };
        let exact = of_scene(&with_deformation(&bare, exact).expect("restated"));
        assert_eq!(total(&exact), total(&of_scene(&bare)) + 12 * n + 12 + 4 * 3 - 12 * 3);
        assert!(line(&of_scene(&bare)).starts_with("U: 4 x sum 3 n r = 11520000; x0: 12 x sum n = 360000; "));
    }
}
