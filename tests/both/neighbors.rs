//! A domain has the same bits alone, among a thousand others, and in a scene large enough for other kernel variants.

use std::sync::Arc;

use modalcast_compute::gpu::{KernelKind, plan};
use modalcast_model::deform::Deformer;
use modalcast_model::domain::{Domain, Shape};
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::{StepResult, run, strip};
use crate::scenes::{self, NORMAL_MAPPED, Random};

/// Shapes under test: with vertex counts that are no multiple of a quad, in shared tiles and in tiles of their own.
fn looked_at() -> Vec<Shape> {
    let mut random = Random(61);
    vec![
        strip(&mut random, 7, 5),
        scenes::shape(&mut random, 33, 3),
        strip(&mut random, 129, 33),
        scenes::shape(&mut random, 9, 0),
    ]
}

/// A scene with one domain of each shape under test between `before` and `after` domains of other shapes, and
/// `instances` domains of a shape of four tiles. Also returns the index of the first domain under test.
fn among(deformation: DeformationSettings, (before, after): (usize, usize), instances: usize) -> (Arc<Scene>, usize) {
    let mut random = Random(62);
    let mut shapes: Vec<Shape> = (0..before + after).map(|at| strip(&mut random, 3 + at % 6, at % 6)).collect();
    let own = looked_at();
    let count = own.len();
    shapes.splice(before..before, own);
    shapes.push(strip(&mut random, 500, 2));
    let many = shapes.len() - 1;
    let mut parts = scenes::parts(shapes);
    parts.deformation = deformation;
    let name = |(at, shape): (usize, usize)| Domain { name: format!("{at}"), ..scenes::domain(shape, NORMAL_MAPPED) };
    parts.domains = (0..many).chain(std::iter::repeat_n(many, instances)).enumerate().map(name).collect();
    assert!(before + count <= parts.domains.len());
    (Scene::new(parts).expect("a scene"), before)
}

/// A state with the values `own` for the domains under test and random values for the others.
fn state_of(scene: &Scene, first: usize, own: &SceneState) -> SceneState {
    let mut state = scenes::state(scene, 63);
    let mut q = own.q.iter();
    for at in 0..own.transforms.len() {
        state.transforms[first + at] = own.transforms[at];
        let slot = scene.layout.slots[first + at];
        state.q[slot.first_q..][..slot.rank].iter_mut().zip(q.by_ref()).for_each(|(to, from)| *to = *from);
    }
    state
}

/// Positions, normals and tangents of a domain, as bits.
fn bits_of(shown: &StepResult, scene: &Scene, domain: usize) -> [Vec<u32>; 3] {
    let (slot, surface) = (scene.layout.slots[domain], &shown.surface);
    [
        &surface.positions[3 * slot.first_vertex..][..3 * slot.vertices],
        &surface.normals[3 * slot.first_corner..][..3 * slot.corners],
        &surface.tangents[4 * slot.first_corner..][..4 * slot.corners],
    ]
    .map(|numbers| numbers.iter().map(|number| number.to_bits()).collect())
}

/// Whether the GPU plan has so few tiles that each lane computes one vertex instead of four.
pub(crate) fn has_one_item_per_lane(scene: &Scene) -> bool {
    plan(scene).kernel(KernelKind::Deform).expect("every scene has it").defines.contains(&"ONE_ITEM_PER_LANE")
}

/// Compares the bits of domains alone, among a thousand others, and with 270 instances more, also after another state.
pub(crate) fn alone_and_among_others<D: Deformer>(make: impl Fn(&Arc<Scene>) -> D) {
    for (storage, compensated) in StorageType::ALL.map(|storage| (storage, storage == StorageType::Bf16)) {
        let deformation = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
        let (alone, _) = among(deformation, (0, 0), 0);
        let own = scenes::state(&alone, 64);
        let want = run(&mut make(&alone), &own);
        let name = storage.name();
        for (others, instances, narrow) in [((500, 500), 0, true), ((501, 499), 270, false)] {
            let (scene, first) = among(deformation, others, instances);
            assert_eq!((has_one_item_per_lane(&alone), has_one_item_per_lane(&scene)), (true, narrow));
            let (mut deformer, state) = (make(&scene), state_of(&scene, first, &own));
            let got = run(&mut deformer, &state);
            for at in 0..own.transforms.len() {
                let (got, want) = (bits_of(&got, &scene, first + at), bits_of(&want, &alone, at));
                assert!(got == want, "{name}, shape {at} among {} others", scene.domains.len());
            }
            // Control: another state gives other bits. It does not affect later steps.
            let other = run(&mut deformer, &scenes::state(&scene, 65));
            assert!(bits_of(&other, &scene, first) != bits_of(&want, &alone, 0));
            assert_eq!(run(&mut deformer, &state).difference(&got), None, "{name}: again");
            assert_eq!(run(&mut make(&scene), &state).difference(&got), None, "{name}: anew");
            eprintln!("{name}: alone and among {} domains the bits are the same", scene.domains.len());
        }
    }
}
