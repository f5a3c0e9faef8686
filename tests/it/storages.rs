//! The errors of the CPU deformer are within their a-priori bounds for every storage type of U. Its results do not
//! depend on threads, tiles or earlier steps. A quad is four consecutive vertices; a tile has up to 32 quads of one
//! shape.

use std::sync::Arc;

use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference;
use modalcast_compute::storage::bound::{ErrorBoundInput, ShapeErrorModel};
use modalcast_compute::storage::{QUAD, TILE_QUADS, TiledModes};
use modalcast_model::deform::{DeformSummary, Deformer};
use modalcast_model::domain::{Domain, Material, Mesh, Modes, Shape};
use modalcast_model::scene::{DeformationSettings, Scene, SceneParts, SceneState, StorageType};

use crate::deformers::{TestRng, random_state, random_strip};

/// Number of vertices and rank of each shape.
const SIZES: [(usize, usize); 9] =
    [(1, 1), (1, 0), (7, 3), (129, 31), (1500, 33), (7, 512), (129, 0), (128, 6), (1500, 1)];

/// A scene of one strip per entry of [`SIZES`], and of two further domains of shapes 0 and 3. The last domain uses the
/// coordinates q of domain 3.
fn random_scene(deformation: DeformationSettings) -> Arc<Scene> {
    let mut random = TestRng(42);
    let mut parts = SceneParts::named("storages");
    parts.deformation = deformation;
    parts.materials = vec![Material::default()];
    for (index, (vertices, rank)) in SIZES.iter().enumerate() {
        parts.shapes.push(random_strip(*vertices, *rank, &mut random));
        parts.domains.push(Domain::new(format!("strip {index}"), index));
    }
    parts.domains.push(Domain::new("instance of 0", 0));
    let mut sharing_domain = Domain::new("instance of 3", 3);
    sharing_domain.shares_q_with = Some(3);
    parts.domains.push(sharing_domain);
    Scene::new(parts).expect("expected a valid scene")
}

/// A scene of one domain with the given columns of U and rest positions of zero.
fn scene_from_columns(vertices: usize, columns: Vec<f32>, deformation: DeformationSettings) -> Arc<Scene> {
    let mut parts = SceneParts::named("columns");
    parts.deformation = deformation;
    parts.materials = vec![Material::default()];
    let template = random_strip(vertices, 0, &mut TestRng(1)).mesh;
    let mesh = Mesh::new(vec![[0.0; 3]; vertices], template.corners().clone(), template.triangles().to_vec());
    let rank = columns.len() / (3 * vertices);
    let modes = Modes::from_columns(3 * vertices, rank, columns).expect("expected valid modes");
    parts.shapes = vec![Shape::new(mesh.expect("expected a valid mesh"), modes).expect("expected a valid shape")];
    parts.domains = vec![Domain::new("columns", 0)];
    Scene::new(parts).expect("expected a valid scene")
}

fn deform(deformer: &mut CpuDeformer, state: &SceneState) -> (DeformSummary, Vec<f32>) {
    let summary = deformer.deform(state).expect("expected the step to succeed");
    (summary, deformer.surface().expect("expected a surface").positions.clone())
}

/// Error bound of each tile of a domain.
fn tile_bounds(scene: &Scene, state: &SceneState, domain: usize) -> Vec<f64> {
    let shape = scene.shape_of(domain);
    let tiles = TiledModes::new(shape, scene.deformation.storage);
    let input = ErrorBoundInput {
        q: state.q_of(scene, domain),
        transform: state.composed_transform(scene, domain),
        compensated: scene.deformation.compensated,
    };
    let model = ShapeErrorModel::new(shape, &tiles);
    (0..tiles.count()).map(|tile| model.tile_bound(tile, &input).total()).collect()
}

/// For each domain, the largest ratio of a vertex error to the bound of the tile of the vertex; infinite for NaN.
fn error_ratios(scene: &Scene, state: &SceneState, positions: &[f32]) -> Vec<f64> {
    let expected = reference::deform(scene, state);
    let domain_ratio = |domain: usize| {
        let layout = scene.layout.domains[domain];
        let bounds = tile_bounds(scene, state, domain);
        let vertex_ratio = |vertex: usize| {
            let scene_vertex = layout.first_vertex + vertex;
            let squared_error =
                |axis: usize| (f64::from(positions[3 * scene_vertex + axis]) - expected[scene_vertex][axis]).powi(2);
            let ratio = (0..3).map(squared_error).sum::<f64>().sqrt() / bounds[vertex / (QUAD * TILE_QUADS)];
            if ratio.is_nan() { f64::INFINITY } else { ratio }
        };
        (0..layout.vertices).map(vertex_ratio).fold(0.0, f64::max)
    };
    (0..scene.domains.len()).map(domain_ratio).collect()
}

/// Negative control: compared with the reference at -q, the errors exceed the bound.
#[test]
fn errors_stay_within_bounds_in_every_storage() {
    for storage in StorageType::ALL {
        for compensated in [false, true] {
            let scene = random_scene(DeformationSettings { storage, compensated, ..DeformationSettings::default() });
            let mut state = random_state(&scene);
            // Amplitudes decrease from 1 to 2^-12 over all coordinates, as for a vibrating body.
            let coordinate_count = state.q.len() as f32;
            state
                .q
                .iter_mut()
                .enumerate()
                .for_each(|(mode, number)| *number *= f32::exp2(-12.0 * mode as f32 / coordinate_count));
            let (_, positions) = deform(&mut CpuDeformer::new(&scene), &state);
            for (domain, ratio) in error_ratios(&scene, &state, &positions).into_iter().enumerate() {
                assert!(ratio <= 1.0, "{storage:?}, domain {domain}: {ratio} of the bound");
            }
            let mut negated_state = state.clone();
            negated_state.q.iter_mut().for_each(|number| *number = -*number);
            let ratios = error_ratios(&scene, &negated_state, &positions);
            // The sign of q has no effect on a domain without modes.
            for domain in (0..ratios.len()).filter(|domain| scene.rank_of(*domain) > 0) {
                assert!(
                    ratios[domain] > 1.0,
                    "{storage:?}, domain {domain}: expected a wrong sign to exceed the bound, got {} of it",
                    ratios[domain]
                );
            }
        }
    }
}

#[test]
fn positions_do_not_depend_on_threads_or_earlier_steps() {
    for storage in StorageType::ALL {
        let scene = random_scene(DeformationSettings { storage, ..DeformationSettings::default() });
        let mut state = random_state(&scene);
        let mut reused_deformer = CpuDeformer::new(&scene);
        deform(&mut reused_deformer, &state);
        let mut random = TestRng(5);
        for step in 0..6 {
            // Steps 0 to 3 change q of one domain and one transform. Step 4 changes all of q and one transform, and
            // step 5 changes nothing.
            let deformed_domain = [0, 4, 8, 3, 0, 0][step];
            let layout = scene.layout.domains[deformed_domain];
            let changed_q = if step == 4 { 0..state.q.len() } else { layout.first_q..layout.first_q + layout.rank };
            if step < 5 {
                let moved_domain = [1, 6, 10, 3, 5][step];
                state.q[changed_q].iter_mut().for_each(|number| *number = random.next());
                state.transforms[moved_domain].0[3] += 0.5;
            }
            let (summary, positions) = deform(&mut reused_deformer, &state);
            for threads in [1, 2, 5] {
                let pool =
                    rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("expected a thread pool");
                let mut new_deformer = CpuDeformer::new(&scene);
                let (new_summary, new_positions) = pool.install(|| deform(&mut new_deformer, &state));
                assert_eq!(
                    f32_bits(&positions),
                    f32_bits(&new_positions),
                    "{storage:?}, step {step}, {threads} threads"
                );
                assert_eq!(summary.bounds, new_summary.bounds);
                let (surface, new_surface) = (
                    reused_deformer.surface().expect("expected a surface"),
                    new_deformer.surface().expect("expected a surface"),
                );
                assert_eq!(surface.normals, new_surface.normals);
            }
        }
    }
}

fn f32_bits(numbers: &[f32]) -> Vec<u32> {
    numbers.iter().map(|number| number.to_bits()).collect()
}

#[test]
fn vertices_do_not_depend_on_the_tiling() {
    // The small shape has the first 129 vertices of the large shape. A tile has up to 128 vertices. The second tile has
    // 128 vertices in the large shape and one vertex in the small shape.
    let (vertices, first_vertices, rank) = (1500, 129, 9);
    let mut random = TestRng(8);
    let columns: Vec<f32> = (0..3 * vertices * rank).map(|_| random.next()).collect();
    let first_columns: Vec<f32> =
        columns.chunks_exact(3 * vertices).flat_map(|column| column[..3 * first_vertices].to_vec()).collect();
    for storage in [StorageType::F32, StorageType::F16, StorageType::Bf16] {
        let deformation = DeformationSettings { storage, ..DeformationSettings::default() };
        let (large_scene, small_scene) = (
            scene_from_columns(vertices, columns.clone(), deformation),
            scene_from_columns(first_vertices, first_columns.clone(), deformation),
        );
        let state = random_state(&large_scene);
        let [large_positions, small_positions] =
            [&large_scene, &small_scene].map(|scene| deform(&mut CpuDeformer::new(scene), &state).1);
        assert_eq!(f32_bits(&large_positions[..3 * first_vertices]), f32_bits(&small_positions), "{storage:?}");
    }
}

#[test]
fn huge_tiny_and_denormal_q_stay_within_the_bound() {
    for storage in StorageType::ALL {
        for compensated in [false, true] {
            let scene = random_scene(DeformationSettings { storage, compensated, ..DeformationSettings::default() });
            let mut deformer = CpuDeformer::new(&scene);
            // Numbers below 1.2e-38 are denormal; 1e-45 rounds to the smallest one.
            for scale in [1e30, 1e-38, 1e-42, 1e-45, 0.0] {
                let mut state = random_state(&scene);
                state.q.iter_mut().for_each(|number| *number *= scale);
                let (summary, positions) = deform(&mut deformer, &state);
                assert!(summary.bounds.is_finite());
                for (domain, ratio) in error_ratios(&scene, &state, &positions).into_iter().enumerate() {
                    assert!(ratio <= 1.0, "{storage:?}, {scale}, domain {domain}: {ratio} of the bound");
                }
            }
        }
    }
}

/// A sum U q is correct if its terms overflow f32 but the sum does not. If the sum overflows, the bounds of the step
/// are not finite.
#[test]
fn finite_sums_survive_overflowing_terms() {
    // u = 2 q0 + 2 q1 + q2 on all axes of five vertices.
    let column = |entry: f32| vec![entry; 3 * 5];
    let columns = [column(2.0), column(2.0), column(1.0)].concat();
    for storage in StorageType::ALL {
        for compensated in [false, true] {
            let deformation = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
            let scene = scene_from_columns(5, columns.clone(), deformation);
            let mut deformer = CpuDeformer::new(&scene);
            let mut state = SceneState::rest(&scene);
            // Plain f32 summation gives infinity, and compensated summation gives infinity minus infinity.
            state.q = vec![3e38, -3e38, 0.75];
            assert!(2.0_f32.mul_add(state.q[1], 2.0_f32.mul_add(state.q[0], 0.0)).is_infinite());
            let (summary, positions) = deform(&mut deformer, &state);
            assert!(summary.bounds.is_finite());
            // The first two modes cancel, so u = 0.75. In int8, the entry 1 of the third mode is rounded by at most
            // half a quantization step of 1/127.
            assert!(positions.iter().all(|number| (number - 0.75).abs() <= 0.75 / 254.0), "{positions:?}");
            state.q = vec![3e38, 0.0, 1.0];
            assert!(!deform(&mut deformer, &state).0.bounds.is_finite());
            state.q = vec![1.0, 0.0, 1.0];
            assert!(
                deform(&mut deformer, &state).0.bounds.is_finite(),
                "expected no effect of the overflow on the next step"
            );
        }
    }
}
