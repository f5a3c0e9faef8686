//! Real inputs from `MODALCAST_DATA` or `../shared/data`: every modal input deforms as its reference does.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use modalcast::config::{BackendChoice, Config};
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::reference;
use modalcast_model::deform::Deformer;
use modalcast_model::load;
use modalcast_model::scene::{Scene, SceneState};

use modalcast_proto::v1;

use crate::deformers::TestRng;
use crate::service_harness::{Server, config, get_vertices, rejection_details};
use crate::tolerance::largest_error;

/// Real inputs with modes.
const MODAL: [&str; 5] = ["vega/simpleBridge", "vega/A", "gltf/MorphStressTest", "sofa/hexaBeam", "sofa/finger"];

fn data(path: &str) -> String {
    let root = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    root.join(path).to_string_lossy().into_owned()
}

/// A state with random coordinates, scaled so that the largest displacement is this fraction of the diagonal.
fn bent(scene: &Scene, fraction: f64) -> SceneState {
    let mut noise = TestRng(11);
    let mut state = SceneState::rest(scene);
    let rest = reference::deform(scene, &state);
    for number in &mut state.q {
        *number = noise.next();
    }
    let largest = |state: &SceneState| {
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
    cpu.deform(&state).expect("expected the step to succeed");
    let bent = cpu.surface().expect("expected a surface").positions.clone();
    let error = largest_error(&bent, &reference::deform(scene, &state)) / scene.rest_bounds.diagonal();
    println!("{}: cpu is off by {error:.2e} of the diagonal", scene.name);
    assert!(error <= 1e-5, "{}: {error}", scene.name);
    cpu.deform(&SceneState { q: vec![0.0; state.q.len()], ..state.clone() }).expect("expected the step to succeed");
    let still = cpu.surface().expect("expected a surface").positions.clone();
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
fn tree_agrees_with_its_reference() {
    agrees(&load::open("tree").expect("expected the built-in scene").scene);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_modal_inputs_agree_with_their_reference() {
    for path in MODAL {
        let scene = load::open(&data(path)).unwrap_or_else(|error| panic!("{path}: {error}")).scene;
        assert!(scene.needs.modes, "{path} has modes");
        agrees(&scene);
    }
}

/// Opens every modal input on a server with this backend, drives one step over gRPC and compares the streamed vertices
/// with the reference.
async fn streamed_agrees(backend: BackendChoice) {
    let state = tempfile::tempdir().expect("expected a temporary folder");
    let repository = Arc::new(load::SceneRepository::new(Some(Path::new(&data("")))).expect("the real inputs"));
    let server = Server::start_from(Config { backend, ..config(state.path()) }, repository).await;
    for source in MODAL.iter().chain(&["tree"]) {
        let path = if *source == "tree" { (*source).to_owned() } else { data(source) };
        let scene = load::open(&path).unwrap_or_else(|error| panic!("{path}: {error}")).scene;
        let name = server.open(source).await.scene;
        let bent = bent(&scene, 0.0501);
        let q: Vec<u8> = bent.q.iter().flat_map(|number| number.to_le_bytes()).collect();
        let mut driver = server.drive(&name, v1::Policy::Lossless, 0).await;
        driver.step_acknowledged(v1::Step { number: 1, q: q.into(), ..v1::Step::default() }).await;
        let ask = v1::GetVerticesRequest { scene: name.clone(), ..v1::GetVerticesRequest::default() };
        let got = get_vertices(&server, ask).await.expect("vertices");
        assert_eq!(got.step().number, 1);
        let want = reference::deform(&scene, &bent);
        let error = largest_error(&got.positions, &want) / scene.rest_bounds.diagonal();
        println!("{source}: streamed by {backend:?}, off by {error:.2e} of the diagonal");
        assert!(error <= 1e-5, "{source}: {error}");
        let rest = reference::deform(&scene, &SceneState::rest(&scene));
        assert!(largest_error(&got.positions, &rest) >= 0.05 * scene.rest_bounds.diagonal(), "the control moved");
        driver.finish().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_vertices_streamed_by_the_cpu_agree_with_the_reference() {
    streamed_agrees(BackendChoice::Cpu).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs an NVIDIA GPU and the real inputs"]
async fn gpu_streamed_vertices_of_real_inputs_equal_the_reference() {
    streamed_agrees(BackendChoice::Cuda).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_malformed_modes_are_refused_and_the_server_continues() {
    let (state, scenes) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    std::fs::copy(data("sofa/ball/modes.txt"), scenes.path().join("modes.txt")).expect("copied");
    std::fs::copy(data("sofa/hexaBeam/hexaBeam.derived.obj"), scenes.path().join("ball.obj")).expect("copied");
    let repository = Arc::new(load::SceneRepository::new(Some(scenes.path())).expect("expected a repository"));
    let server = Server::start_from(config(state.path()), repository).await;
    let open = |source: &str| v1::OpenSceneRequest { source: source.into(), scene: String::new() };
    let refusal = server.scenes().await.open_scene(open("ball.obj")).await.expect_err("malformed");
    let why = rejection_details(&refusal);
    assert!(why.expected.contains("684 x 32") && why.given.contains("684 x 35"), "{why:?}");
    server.scenes().await.open_scene(open("tree")).await.expect("the server lives");
}
