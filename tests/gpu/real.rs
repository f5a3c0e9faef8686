//! The tree and the real modal inputs, deformed by at least 5 % of their diagonal, equal the f64 twin.

use std::path::Path;
use std::sync::Arc;

use modalcast_model::scene::{Scene, SceneState};

use crate::accuracy::check;
use crate::scenes::Random;
use crate::twins::deformer;

/// A state with random coordinates, scaled so that the largest displacement is 6 % of the rest diagonal.
fn bent(scene: &Scene) -> SceneState {
    let mut random = Random(8);
    let mut state = SceneState::rest(scene);
    state.q.fill(0.0);
    let still = modalcast_compute::reference::deform(scene, &state);
    state.q.iter_mut().for_each(|coordinate| *coordinate = random.number());
    let largest = |state: &SceneState| {
        let moved = modalcast_compute::reference::deform(scene, state);
        let distance = |(a, b): (&[f64; 3], &[f64; 3])| (0..3).map(|axis| (a[axis] - b[axis]).powi(2)).sum::<f64>();
        moved.iter().zip(&still).map(distance).fold(0.0, f64::max).sqrt()
    };
    let scale = 0.06 * scene.rest_bounds.diagonal() / largest(&state);
    state.q.iter_mut().for_each(|coordinate| *coordinate = (f64::from(*coordinate) * scale) as f32);
    assert!(largest(&state) >= 0.05 * scene.rest_bounds.diagonal(), "the deformation is no deformation");
    state
}

fn compare(name: &str, scene: &Arc<Scene>) {
    assert!(scene.needs.modes, "{name} has modes");
    let mut deformer = deformer(scene);
    let state = bent(scene);
    check(name, scene, &state, &mut deformer);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_tree_equals_the_twin() {
    compare("tree", &modalcast_model::load::open("tree").expect("the built-in scene").scene);
}

#[test]
#[ignore = "needs an NVIDIA GPU and the real inputs: MODALCAST_DATA or ../shared/data"]
fn gpu_real_modal_inputs_equal_the_twin() {
    let root = std::env::var("MODALCAST_DATA").unwrap_or_else(|_| "../shared/data".into());
    for name in ["vega/simpleBridge", "vega/A", "gltf/MorphStressTest", "sofa/hexaBeam", "sofa/finger"] {
        let path = Path::new(&root).join(name);
        let scene = modalcast_model::load::open(&path.to_string_lossy());
        compare(name, &scene.unwrap_or_else(|error| panic!("{name}: {error}")).scene);
    }
}
