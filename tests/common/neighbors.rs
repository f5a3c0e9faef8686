//! The vertices of a domain have the same bits whatever other domains its scene has, even if the other domains change
//! the kernel variant.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformerOptions, KernelKind, plan};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Domain, Shape};
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::{StepResult, run_step, strip_shape};
use crate::scenes::{self, NORMAL_MAPPED_MATERIAL, Random};

/// Shapes under test. Their vertex counts are not multiples of four (a quad). Small shapes share a tile, and the large
/// shape has separate tiles.
fn tested_shapes() -> Vec<Shape> {
    let mut random = Random(61);
    vec![
        strip_shape(&mut random, 7, 5),
        scenes::random_shape(&mut random, 33, 3),
        strip_shape(&mut random, 129, 33),
        scenes::random_shape(&mut random, 9, 0),
    ]
}

/// Number of the other domains in the scene of the domains under test.
#[derive(Clone, Copy, Default)]
struct Neighbors {
    /// Domains before the domains under test, each with a shape of its own.
    preceding: usize,
    /// Domains after the domains under test, each with a shape of its own.
    following: usize,
    /// Domains at the end of the scene that share one shape of four tiles.
    instances: usize,
}

/// A scene with one domain of each shape under test, and its neighbors. The first domain under test has the index
/// `preceding`.
fn embedded_scene(deformation: DeformationSettings, neighbors: Neighbors) -> Arc<Scene> {
    let Neighbors { preceding, following, instances } = neighbors;
    let mut random = Random(62);
    let mut shapes: Vec<Shape> =
        (0..preceding + following).map(|index| strip_shape(&mut random, 3 + index % 6, index % 6)).collect();
    shapes.splice(preceding..preceding, tested_shapes());
    shapes.push(strip_shape(&mut random, 500, 2));
    let instanced_shape = shapes.len() - 1;
    let mut parts = scenes::parts_of_shapes(shapes);
    parts.deformation = deformation;
    let create_domain = |(index, shape): (usize, usize)| Domain {
        name: format!("{index}"),
        ..scenes::new_domain(shape, NORMAL_MAPPED_MATERIAL)
    };
    parts.domains = (0..instanced_shape)
        .chain(std::iter::repeat_n(instanced_shape, instances))
        .enumerate()
        .map(create_domain)
        .collect();
    Scene::new(parts).expect("expected a valid scene")
}

/// A state with the q and transforms of `tested_state` for the domains under test, and random values for the other
/// domains. `first_domain` is the index of the first domain under test.
fn state_of(scene: &Scene, first_domain: usize, tested_state: &SceneState) -> SceneState {
    let mut state = scenes::random_state(scene, 63);
    let mut q = tested_state.q.iter();
    for domain in 0..tested_state.transforms.len() {
        state.transforms[first_domain + domain] = tested_state.transforms[domain];
        let layout = scene.layout.domains[first_domain + domain];
        state.q[layout.first_q..][..layout.rank]
            .iter_mut()
            .zip(q.by_ref())
            .for_each(|(coordinate, tested_coordinate)| *coordinate = *tested_coordinate);
    }
    state
}

/// Positions, normals and tangents of a domain, as bits.
fn bits_of(result: &StepResult, scene: &Scene, domain: usize) -> [Vec<u32>; 3] {
    let (layout, surface) = (scene.layout.domains[domain], &result.surface);
    [
        &surface.positions[3 * layout.first_vertex..][..3 * layout.vertices],
        &surface.normals[3 * layout.first_corner..][..3 * layout.corners],
        &surface.tangents[4 * layout.first_corner..][..4 * layout.corners],
    ]
    .map(|numbers| numbers.iter().map(|number| number.to_bits()).collect())
}

/// Whether the CUDA kernel `deform` of a scene is compiled with this macro.
fn has_define(scene: &Scene, define: &str) -> bool {
    plan(scene, CudaDeformerOptions::default())
        .kernel(KernelKind::Deform)
        .expect("expected a deform kernel")
        .defines
        .contains(&define)
}

/// Whether the scene has so few tiles that each lane (a GPU thread) computes one vertex instead of four.
pub(crate) fn has_one_item_per_lane(scene: &Scene) -> bool {
    has_define(scene, "ONE_ITEM_PER_LANE")
}

/// Whether the scene has so few tiles that the axes of a vertex are summed by different warps.
fn has_axis_per_warp(scene: &Scene) -> bool {
    has_define(scene, "AXIS_PER_WARP")
}

/// The domains under test have the same bits alone, among a thousand other domains, and with 60 or 270 further instances
/// of a large shape. The instances change the kernel variant ([`has_axis_per_warp`], [`has_one_item_per_lane`]).
pub(crate) fn check_independence_of_neighbors<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    for (storage, compensated) in StorageType::ALL.map(|storage| (storage, storage == StorageType::Bf16)) {
        let deformation = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
        let small_scene = embedded_scene(deformation, Neighbors::default());
        let tested_state = scenes::random_state(&small_scene, 64);
        let expected = run_step(&mut create_deformer(&small_scene), &tested_state);
        let name = storage.name();
        assert!(has_one_item_per_lane(&small_scene));
        assert_eq!(has_axis_per_warp(&small_scene), storage == StorageType::F32, "{name}");
        for neighbors in [
            Neighbors { preceding: 500, following: 500, instances: 0 },
            Neighbors { preceding: 499, following: 501, instances: 60 },
            Neighbors { preceding: 501, following: 499, instances: 270 },
        ] {
            let (scene, first_domain) = (embedded_scene(deformation, neighbors), neighbors.preceding);
            assert_eq!(has_one_item_per_lane(&scene), neighbors.instances < 270, "{name}");
            assert!(neighbors.instances == 0 || !has_axis_per_warp(&scene), "{name}");
            let (mut deformer, state) = (create_deformer(&scene), state_of(&scene, first_domain, &tested_state));
            let actual = run_step(&mut deformer, &state);
            for index in 0..tested_state.transforms.len() {
                let actual_bits = bits_of(&actual, &scene, first_domain + index);
                let is_equal = actual_bits == bits_of(&expected, &small_scene, index);
                assert!(
                    is_equal,
                    "{name}, shape {index} among {} domains: expected the same bits",
                    scene.domains.len()
                );
            }
            // Negative control: another state gives other bits. That state does not affect the next step.
            let other_result = run_step(&mut deformer, &scenes::random_state(&scene, 65));
            assert!(bits_of(&other_result, &scene, first_domain) != bits_of(&expected, &small_scene, 0));
            assert_eq!(run_step(&mut deformer, &state).difference(&actual), None, "{name}: same state again");
            assert_eq!(
                run_step(&mut create_deformer(&scene), &state).difference(&actual),
                None,
                "{name}: new deformer"
            );
            eprintln!("{name}: same bits among {} domains", scene.domains.len());
        }
    }
}
