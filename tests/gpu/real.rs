//! The built-in tree and modal models from files, deformed by at least 5 % of their diagonal, equal the f64 reference.

use std::path::Path;
use std::sync::Arc;

use modalcast_model::scene::{Scene, SceneState};

use crate::accuracy::assert_equals_reference;
use crate::reference_comparison::cuda_deformer;
use crate::scenes::Random;

/// A state with random coordinates, scaled so that the largest displacement is 6 % of the rest diagonal. Rounding to
/// f32 may reduce it, so the assertion requires 5 %.
fn deformed_state(scene: &Scene) -> SceneState {
    let mut random = Random(8);
    let mut state = SceneState::rest(scene);
    state.q.fill(0.0);
    let rest = modalcast_compute::reference::deform(scene, &state);
    state.q.iter_mut().for_each(|coordinate| *coordinate = random.next_number());
    let max_displacement = |state: &SceneState| {
        let deformed = modalcast_compute::reference::deform(scene, state);
        let distance = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum::<f64>();
        deformed.iter().zip(&rest).map(distance).fold(0.0, f64::max).sqrt()
    };
    let scale = 0.06 * scene.rest_bounds.diagonal() / max_displacement(&state);
    state.q.iter_mut().for_each(|coordinate| *coordinate = (f64::from(*coordinate) * scale) as f32);
    assert!(
        max_displacement(&state) >= 0.05 * scene.rest_bounds.diagonal(),
        "expected displacements of at least 5 % of the diagonal"
    );
    state
}

fn assert_scene_equals_reference(name: &str, scene: &Arc<Scene>) {
    assert!(scene.features.modes, "{name}: expected a scene with modes");
    let mut deformer = cuda_deformer(scene);
    let state = deformed_state(scene);
    assert_equals_reference(name, scene, &state, &mut deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_tree_equals_the_reference() {
    assert_scene_equals_reference(
        "tree",
        &modalcast_model::load::open("tree").expect("expected the built-in scene").scene,
    );
}

#[test]
#[ignore = "needs an NVIDIA GPU and the real inputs: MODALCAST_DATA or ../shared/data"]
fn gpu_real_modal_inputs_equal_the_reference() {
    let root = std::env::var("MODALCAST_DATA").unwrap_or_else(|_| "../shared/data".into());
    for name in ["vega/simpleBridge", "vega/A", "gltf/MorphStressTest", "sofa/hexaBeam", "sofa/finger"] {
        let path = Path::new(&root).join(name);
        let scene = modalcast_model::load::open(&path.to_string_lossy());
        assert_scene_equals_reference(name, &scene.unwrap_or_else(|error| panic!("{name}: {error}")).scene);
    }
}
