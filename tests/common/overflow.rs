//! A step that overflows is rejected with the name of the domain, and does not affect later steps.

use std::sync::Arc;

use modalcast::config::{BackendChoice, Config, RendererChoice};
use modalcast::engine::DeviceContext;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::Deformer;
use modalcast_model::domain::Transform;
use modalcast_model::scene::{DeformationSettings, Scene, SceneState, StorageType};

use super::{partial_steps, run_step, scene_of_shapes, strip_shape};
use crate::scenes::{self, Random};

/// A scene with eight domains, so that a step that changes two of them is a partial step.
fn test_scene(storage: StorageType) -> Arc<Scene> {
    let mut random = Random(71);
    let shapes = vec![
        strip_shape(&mut random, 7, 2),
        scenes::random_shape(&mut random, 300, 2),
        strip_shape(&mut random, 9, 3),
        scenes::random_shape(&mut random, 30, 0),
    ];
    let (instances, normal_maps) = (2, true);
    let deformation = DeformationSettings { storage, ..DeformationSettings::default() };
    scene_of_shapes(shapes, instances, deformation, normal_maps)
}

/// A transform so large that T (x0 + U q) overflows f32 even if x0 + U q does not.
const LARGE_SHEAR: Transform = Transform([1e3, -2e3, 1e3, 0.0, 1e3, 1e3, -3e3, 0.0, -1e3, 1e3, 1e3, 0.0]);

/// A step that overflows gives bounds that are not finite. The next valid step equals that of a new deformer.
pub(crate) fn check_overflow_affects_one_step<D: Deformer>(create_deformer: impl Fn(&Arc<Scene>) -> D) {
    for storage in StorageType::ALL {
        let scene = test_scene(storage);
        let (mut deformer, mut random) = (create_deformer(&scene), Random(72));
        let mut valid_state = scenes::random_state(&scene, 73);
        let previous_result = run_step(&mut deformer, &valid_state);
        assert!(previous_result.bounds.is_finite());
        for coordinate in [f32::MAX, -f32::MAX] {
            let mut overflowing_state = valid_state.clone();
            // A partial step that sets q and the transform of domain 1.
            partial_steps::randomize_q_and_transforms(&scene, &mut overflowing_state, &mut random, &[1], &[1]);
            let first_q = scene.layout.domains[1].first_q;
            overflowing_state.q[first_q..first_q + 2].fill(coordinate);
            overflowing_state.transforms[1] = LARGE_SHEAR;
            assert!(
                !deformer.deform(&overflowing_state).expect("expected the step to succeed").bounds.is_finite(),
                "{}: {coordinate:e}",
                storage.name()
            );
            // `overflowing_state` was a copy, so `valid_state` does not contain the overflowing step. The next step of
            // `valid_state` sets q of domain 2.
            partial_steps::randomize_q_and_transforms(&scene, &mut valid_state, &mut random, &[2], &[]);
            let result = run_step(&mut deformer, &valid_state);
            assert!(result.bounds.is_finite() && result.difference(&previous_result).is_some());
            assert_eq!(
                result.difference(&run_step(&mut create_deformer(&scene), &valid_state)),
                None,
                "{}: {coordinate:e}",
                storage.name()
            );
        }
    }
}

/// A step that overflows is rejected with the name of its domain, and the vertices remain those of the last valid step.
pub(crate) fn check_overflow_rejection(backend: BackendChoice) {
    let config = Config { backend, renderer: RendererChoice::Off, ..Config::default() };
    let mut context = DeviceContext::open(&config).expect("expected a device context");
    let scene = test_scene(StorageType::F32);
    let (mut loaded_scene, mut random) =
        (context.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load"), Random(74));
    let mut valid_state = SceneState::rest(&scene);
    let (q_domains, transform_domains) = ([0, 5], [5]);
    partial_steps::randomize_q_and_transforms(&scene, &mut valid_state, &mut random, &q_domains, &transform_domains);
    loaded_scene.deform(&valid_state).expect("expected a valid step");
    let valid_surface = loaded_scene.surface().expect("expected a surface").clone();
    // The engine rejects coordinates of vertices beyond 1e18, so 1e30 is rejected although it does not overflow.
    for (domain, coordinate) in [(5, f32::MAX), (2, -f32::MAX), (5, 1e30)] {
        let mut overflowing_state = valid_state.clone();
        partial_steps::randomize_q_and_transforms(&scene, &mut overflowing_state, &mut random, &[domain], &[]);
        overflowing_state.q[scene.layout.domains[domain as usize].first_q] = coordinate;
        let error = loaded_scene.deform(&overflowing_state).expect_err("expected an overflow error").to_string();
        eprintln!("{error}");
        assert!(error.starts_with("step.q: ") && error.contains(&format!("of domain 'domain {domain}'")), "{error}");
        assert_eq!(loaded_scene.surface().expect("expected a surface"), &valid_surface);
        assert!(loaded_scene.bounds().is_finite());
    }
    // The next step applies to the last valid state. It sets q of domain 6 only.
    partial_steps::randomize_q_and_transforms(&scene, &mut valid_state, &mut random, &[6], &[]);
    loaded_scene.deform(&valid_state).expect("expected a valid step");
    let next_surface = loaded_scene.surface().expect("expected a surface").clone();
    assert_ne!(next_surface, valid_surface, "expected the step to change vertices");
    let mut new_scene = context.load_scene(&scene, BackendSettings::default()).expect("expected the scene to load");
    new_scene.deform(&valid_state).expect("expected a valid step");
    assert_eq!(new_scene.surface().expect("expected a surface"), &next_surface);
    context.unload_scene(loaded_scene);
    context.unload_scene(new_scene);
}
