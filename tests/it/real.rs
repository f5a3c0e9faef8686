//! The real inputs, at `MODALCAST_DATA` or `../shared/data`: every modal one deforms as its reference says.

use std::path::PathBuf;
use std::sync::Arc;

use modalcast::cpu::CpuDeformer;
use modalcast::deform::Deformer;
use modalcast::scene::{Scene, State};
use modalcast::{load, reference};

use crate::deformers::Noise;
use crate::tolerance::largest_error;

fn data(path: &str) -> String {
    let root = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    root.join(path).to_string_lossy().into_owned()
}

/// Random coordinates, scaled so that the largest displacement is this fraction of the diagonal.
fn bent(scene: &Scene, fraction: f64) -> State {
    let mut noise = Noise(11);
    let mut state = State::rest(scene);
    let rest = reference::deform(scene, &state);
    for number in &mut state.q {
        *number = noise.next();
    }
    let largest = |state: &State| {
        let moved = reference::deform(scene, state);
        let distance =
            |(a, b): (&[f64; 3], &[f64; 3])| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        moved.iter().zip(&rest).map(distance).fold(0.0, f64::max)
    };
    let scale = fraction * scene.rest_bounds.diagonal() / largest(&state);
    state.q.iter_mut().for_each(|number| *number *= scale as f32);
    assert!(largest(&state) >= 0.05 * scene.rest_bounds.diagonal());
    state
}

fn agrees(scene: &Arc<Scene>) {
    let state = bent(scene, 0.0501);
    let mut cpu = CpuDeformer::new(scene);
    cpu.deform(&state).expect("deforms");
    let bent = cpu.surface().expect("a surface").positions.clone();
    let error = largest_error(&bent, &reference::deform(scene, &state)) / scene.rest_bounds.diagonal();
    println!("{}: cpu is off by {error:.2e} of the diagonal", scene.name);
    assert!(error <= 1e-5, "{}: {error}", scene.name);
    cpu.deform(&State { q: vec![0.0; state.q.len()], ..state.clone() }).expect("deforms");
    let still = cpu.surface().expect("a surface").positions.clone();
    let (mut clamped, mut moved) = (0, 0);
    for (domain, slot) in scene.layout.slots.iter().enumerate() {
        let modes = &scene.shape_of(domain).modes;
        for vertex in 0..slot.vertices {
            let place = 3 * (slot.first_vertex + vertex)..3 * (slot.first_vertex + vertex) + 3;
            let zero = (0..3).all(|axis| (0..slot.rank).all(|mode| modes.at(vertex, axis, mode) == 0.0));
            match zero {
                true => assert_eq!(bent[place.clone()], still[place], "vertex {vertex} of domain {domain}"),
                false => moved += usize::from(bent[place.clone()] != still[place]),
            }
            clamped += usize::from(zero);
        }
    }
    println!("{}: {clamped} vertices of zero rows, {moved} moved", scene.name);
    assert!(moved > 0);
}

#[test]
fn the_tree_agrees_with_its_reference() {
    agrees(&load::open("tree").expect("the tree"));
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_modal_inputs_agree_with_their_reference() {
    for path in ["vega/simpleBridge", "vega/A", "gltf/MorphStressTest", "sofa/hexaBeam", "sofa/finger"] {
        let scene = load::open(&data(path)).unwrap_or_else(|error| panic!("{path}: {error}"));
        assert!(scene.needs.modes, "{path} has modes");
        agrees(&scene);
    }
}
