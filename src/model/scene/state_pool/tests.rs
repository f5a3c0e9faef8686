//! Tests of the pool, with states that readers hold and steps that the device rejects.

use fastrand::Rng;

use super::*;
use crate::domain::{Domain, FollowConstraint, Material, Mesh, Modes, Shape, Transform};
use crate::scene::{RawStepUpdate, SceneParts, TransformFormat};

const DOMAINS: u32 = 40;

/// Domains of one vertex and two modes. Domain 2 shares the coordinates of domain 1, and domain 4 follows domain 3.
fn scene() -> Arc<Scene> {
    let mesh = Mesh::from_indexed(vec![[0.5, 0.25, 1.0]], vec![[0.0, 0.0, 1.0]], vec![], vec![[0, 0, 0]]);
    let modes = Modes::from_columns(3, 2, vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0]).expect("3 x 2");
    let mut parts = SceneParts::named("points");
    parts.shapes = vec![Shape::new(mesh.expect("a point"), modes).expect("a valid shape")];
    parts.materials = vec![Material::default()];
    parts.domains = (0..DOMAINS).map(|index| Domain::new(format!("point {index}"), 0)).collect();
    parts.domains[2].shares_q_with = Some(1);
    parts.domains[4].follows = Some(FollowConstraint { parent: 3, frame: Transform::IDENTITY });
    Scene::new(parts).expect("a scene")
}

/// A step that changes the coordinates and the transform of a few domains.
fn random_step(scene: &Scene, random: &mut Rng, number: u64, transform_format: TransformFormat) -> StepUpdate {
    let mut choose = |forbidden: u32| {
        let mut domains: Vec<u32> = (0..random.u32(0..4)).map(|_| random.u32(0..DOMAINS)).collect();
        domains.retain(|domain| *domain != forbidden);
        domains.sort_unstable();
        domains.dedup();
        domains
    };
    let (q_domains, transform_domains) = (choose(2), choose(4));
    let q = (0..2 * q_domains.len()).flat_map(|_| random.f32().to_le_bytes()).collect();
    let mut transforms = Vec::new();
    for _ in &transform_domains {
        let rotation = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        match transform_format {
            TransformFormat::QuaternionXyzwF64 => {
                transforms.extend(rotation);
                transforms.extend((0..3).flat_map(|_| (10.0 * random.f64()).to_le_bytes()));
            }
            _ => transforms.extend((0..12).flat_map(|_| random.f32().to_le_bytes())),
        }
    }
    let transforms = transforms.into();
    let raw =
        RawStepUpdate { number, q_domains, q, transform_domains, transforms, transform_format, ..Default::default() };
    StepUpdate::parse(scene, &raw).expect("a valid step")
}

#[test]
fn pooled_states_equal_states_that_are_copied() {
    let scene = scene();
    for transform_format in [TransformFormat::default(), TransformFormat::QuaternionXyzwF64] {
        let mut random = Rng::with_seed(7);
        let (mut pool, mut base) = (StatePool::default(), Arc::new(SceneState::rest(&scene)));
        let mut held = Vec::new();
        for number in 1..2000 {
            let update = random_step(&scene, &mut random, number, transform_format);
            let mut expected = SceneState::clone(&base);
            expected.apply(&scene, &update);
            expected.run = 3;
            let state = pool.apply(&scene, &base, 3, &update);
            assert!(*state == expected, "step {number}");
            assert_eq!((state.serial, &state.dirty_domains), (expected.serial, &expected.dirty_domains));
            // A reader holds some states, which must not change.
            if random.u32(0..5) == 0 {
                held.push((Arc::clone(&state), expected));
            }
            if held.len() > random.usize(0..12) {
                let (state, expected) = held.remove(0);
                assert!(*state == expected, "a state that a reader held until step {number}");
            }
            // The device rejects some states.
            if random.u32(0..7) > 0 {
                base = state;
            }
        }
    }
}

#[test]
fn memory_of_free_states_is_used_again() {
    let scene = scene();
    // Negative control: the memory of states that readers hold is not.
    for holds_states in [false, true] {
        let mut random = Rng::with_seed(7);
        let (mut pool, mut state) = (StatePool::default(), Arc::new(SceneState::rest(&scene)));
        let mut addresses = std::collections::HashSet::new();
        let mut held = Vec::new();
        for number in 1..50 {
            let update = random_step(&scene, &mut random, number, TransformFormat::default());
            state = pool.apply(&scene, &state, 1, &update);
            addresses.insert(state.q.as_ptr());
            held.extend(holds_states.then(|| Arc::clone(&state)));
        }
        assert_eq!(addresses.len() > 3, holds_states, "{} allocations", addresses.len());
    }
}
