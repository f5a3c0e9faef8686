//! Minimum memory traffic of a step, by formula.

use serde::Serialize;

use modalcast_compute::storage::{QUAD, TILE_QUADS, modes_per_chunk};
use modalcast_model::scene::{Scene, StorageType};

/// One operand of a step.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Operand {
    pub name: &'static str,
    /// Formula of the bytes. The letters are counts: n of vertices, f of triangles, c of corners, r of modes, d of
    /// domains, Q of quads (four consecutive vertices), C of chunks of stored U, K of modes per chunk (as many as fit
    /// in 4 bytes per row of U) and `tiles` of tiles of stored U (up to 32 quads each).
    pub formula: &'static str,
    pub bytes: u64,
}

/// Minimum number of bytes that a step reads and writes, for the scene's storage type and normals. Every operand counts
/// once, and every shape once for all domains that use it.
pub fn minimum_traffic(scene: &Scene) -> Vec<Operand> {
    let layout = &scene.layout;
    let [
        mut mode_entries,
        mut stored_bytes,
        mut scale_bytes,
        mut rest_vertices,
        mut corners,
        mut triangles,
        mut tangents,
    ] = [0; 7];
    let mut is_shape_counted = vec![false; scene.shapes.len()];
    for domain in &scene.domains {
        if std::mem::replace(&mut is_shape_counted[domain.shape], true) {
            continue;
        }
        let (shape, chunk_modes) = (&scene.shapes[domain.shape], modes_per_chunk(scene.deformation.storage));
        let (shape_vertices, chunks) = (shape.mesh.rest_positions().len(), shape.modes.rank().div_ceil(chunk_modes));
        mode_entries += shape.modes.columns().len();
        // The K modes of a chunk take 4 bytes per row of U, or 48 bytes for the 12 rows of a quad.
        stored_bytes += 48 * chunks * shape_vertices.div_ceil(QUAD);
        // One f32 per tile and mode, including the padding modes of the last chunk.
        scale_bytes += 4 * chunks * chunk_modes * shape_vertices.div_ceil(QUAD * TILE_QUADS);
        rest_vertices += shape_vertices;
        corners += shape.mesh.corners().normals.len();
        triangles += shape.mesh.triangles().len();
        tangents += shape.tangents().len();
    }
    let tangent_corners = if scene.features.normal_maps { layout.corners } else { 0 };
    let (has_exact_normals, storage) = (scene.features.exact_normals, scene.deformation.storage);
    let bytes_if = |condition: bool, bytes: usize| if condition { bytes } else { 0 };
    let operand = |name, formula, bytes: usize| Operand { name, formula, bytes: bytes as u64 };
    let operands = [
        operand("U", "4 x sum 3 n r", bytes_if(storage == StorageType::F32, 4 * mode_entries)),
        operand("U", "48 x sum C Q", bytes_if(storage != StorageType::F32, stored_bytes)),
        operand("scales", "4 x sum C K tiles", bytes_if(storage == StorageType::Int8, scale_bytes)),
        operand("x0", "12 x sum n", 12 * rest_vertices),
        operand("q", "4 x sum r", 4 * layout.coordinates),
        operand("T", "48 x d", 48 * layout.domains.len()),
        operand("x", "12 x sum n", 12 * layout.vertices),
        operand("x in", "12 x sum n", bytes_if(has_exact_normals, 12 * layout.vertices)),
        operand("triangles", "12 x sum f + 4 x sum c", bytes_if(has_exact_normals, 12 * triangles + 4 * corners)),
        operand("normals in", "12 x sum c", bytes_if(!has_exact_normals, 12 * corners)),
        operand("normals out", "12 x sum c", 12 * layout.corners),
        operand("tangents in", "16 x sum c", 16 * tangents),
        operand("tangents out", "16 x sum c", 16 * tangent_corners),
    ];
    operands.into_iter().filter(|operand| operand.bytes > 0).collect()
}

/// The operands as one line of text; each is `name: formula = bytes`.
pub fn format_operands(operands: &[Operand]) -> String {
    let format_operand = |operand: &Operand| format!("{}: {} = {}", operand.name, operand.formula, operand.bytes);
    operands.iter().map(format_operand).collect::<Vec<_>>().join("; ")
}

/// Sum of the bytes of all operands.
pub fn total_bytes(operands: &[Operand]) -> u64 {
    operands.iter().map(|operand| operand.bytes).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::workloads::{Size, WorkloadKind, with_deformation};
    use modalcast_model::scene::{DeformationSettings, NormalMethod};

    #[test]
    fn bytes_of_load_a_match_the_formulas() {
        let scene =
            WorkloadKind::OneDomain { has_normal_map: true }.build(Size::Quick).expect("expected a workload").scene;
        // 1.5 M vertices, divided by 50 for the quick size, and 32 modes.
        let (n, r) = (30_000, 32);
        // U, x0, q, T and x; normals and tangents are read and written.
        let expected = 4 * 3 * n * r + 12 * n + 4 * r + 48 + 12 * n + 2 * 12 * n + 2 * 16 * n;
        assert_eq!(total_bytes(&minimum_traffic(&scene)), expected);
        let plain_scene =
            WorkloadKind::OneDomain { has_normal_map: false }.build(Size::Quick).expect("expected a workload").scene;
        // Without normal map, the scene has only three corners and no tangents. 24 n is x0 and x.
        assert_eq!(total_bytes(&minimum_traffic(&plain_scene)), 4 * 3 * n * r + 24 * n + 4 * r + 48 + 2 * 12 * 3);
        let bytes_of_u = |storage| {
            let scene =
                with_deformation(&plain_scene, DeformationSettings { storage, ..DeformationSettings::default() })
                    .expect("expected a scene");
            minimum_traffic(&scene)[0].bytes
        };
        // 3 n r entries of 2 bytes or 1 byte.
        assert_eq!([StorageType::F16, StorageType::Int8].map(bytes_of_u), [6 * n * r, 3 * n * r]);
        let exact_normals = DeformationSettings { normals: NormalMethod::Exact, ..DeformationSettings::default() };
        let exact_normals = minimum_traffic(&with_deformation(&plain_scene, exact_normals).expect("expected a scene"));
        // Exact normals read x (12 n bytes), one triangle (12) and the vertex indices of its three corners (4 x 3)
        // instead of three rest normals (12 x 3).
        assert_eq!(
            total_bytes(&exact_normals),
            total_bytes(&minimum_traffic(&plain_scene)) + 12 * n + 12 + 4 * 3 - 12 * 3
        );
        assert!(
            format_operands(&minimum_traffic(&plain_scene))
                .starts_with("U: 4 x sum 3 n r = 11520000; x0: 12 x sum n = 360000; ")
        );
    }
}
