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
use crate::tolerance::max_distance;

/// Real inputs with modes.
const MODAL_INPUTS: [&str; 5] = ["vega/simpleBridge", "vega/A", "gltf/MorphStressTest", "sofa/hexaBeam", "sofa/finger"];

fn input_path(path: &str) -> String {
    let root = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    root.join(path).to_string_lossy().into_owned()
}

/// A state with random coordinates, scaled so that the largest displacement is this fraction of the diagonal.
fn deformed_state(scene: &Scene, fraction: f64) -> SceneState {
    let mut random = TestRng(11);
    let mut state = SceneState::rest(scene);
    let rest = reference::deform(scene, &state);
    for coordinate in &mut state.q {
        *coordinate = random.next();
    }
    let max_displacement = |state: &SceneState| {
        let deformed = reference::deform(scene, state);
        let distance =
            |(a, b): (&[f64; 3], &[f64; 3])| a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        deformed.iter().zip(&rest).map(distance).fold(0.0, f64::max)
    };
    let scale = fraction * scene.rest_bounds.diagonal() / max_displacement(&state);
    state.q.iter_mut().for_each(|coordinate| *coordinate *= scale as f32);
    assert!(max_displacement(&state) >= 0.05 * scene.rest_bounds.diagonal());
    state
}

fn assert_cpu_equals_reference(scene: &Arc<Scene>) {
    let state = deformed_state(scene, 0.0501);
    let mut cpu = CpuDeformer::new(scene);
    cpu.deform(&state).expect("expected the step to succeed");
    let deformed = cpu.surface().expect("expected a surface").positions.clone();
    let error = max_distance(&deformed, &reference::deform(scene, &state)) / scene.rest_bounds.diagonal();
    println!("{}: error of the CPU deformer: {error:.2e} of the diagonal", scene.name);
    assert!(error <= 1e-5, "{}: {error}", scene.name);
    cpu.deform(&SceneState { q: vec![0.0; state.q.len()], ..state.clone() }).expect("expected the step to succeed");
    let rest = cpu.surface().expect("expected a surface").positions.clone();
    let (mut zero_row_vertices, mut moved) = (0, 0);
    for (domain, slot) in scene.layout.domains.iter().enumerate() {
        let modes = &scene.shape_of(domain).modes;
        for vertex in 0..slot.vertices {
            let range = 3 * (slot.first_vertex + vertex)..3 * (slot.first_vertex + vertex) + 3;
            let has_zero_rows = (0..3).all(|axis| (0..slot.rank).all(|mode| modes.entry(vertex, axis, mode) == 0.0));
            match has_zero_rows {
                true => assert_eq!(deformed[range.clone()], rest[range], "vertex {vertex} of domain {domain}"),
                false => moved += usize::from(deformed[range.clone()] != rest[range]),
            }
            zero_row_vertices += usize::from(has_zero_rows);
        }
    }
    println!("{}: {zero_row_vertices} vertices of zero rows, {moved} moved", scene.name);
    assert!(moved > 0);
}

#[test]
fn tree_agrees_with_its_reference() {
    assert_cpu_equals_reference(&load::open("tree").expect("expected the built-in scene").scene);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_modal_inputs_agree_with_their_reference() {
    for path in MODAL_INPUTS {
        let scene = load::open(&input_path(path)).unwrap_or_else(|error| panic!("{path}: {error}")).scene;
        assert!(scene.features.modes, "{path}: expected a scene with modes");
        assert_cpu_equals_reference(&scene);
    }
}

/// Opens every modal input on a server with this backend, drives one step over gRPC and compares the streamed vertices
/// with the reference.
async fn assert_stream_equals_reference(backend: BackendChoice) {
    let state = tempfile::tempdir().expect("expected a temporary folder");
    let repository = Arc::new(load::SceneRepository::new(Some(Path::new(&input_path("")))).expect("the real inputs"));
    let server = Server::start_from(Config { backend, ..config(state.path()) }, repository).await;
    for source in MODAL_INPUTS.iter().chain(&["tree"]) {
        let path = if *source == "tree" { (*source).to_owned() } else { input_path(source) };
        let scene = load::open(&path).unwrap_or_else(|error| panic!("{path}: {error}")).scene;
        let name = server.open(source).await.scene;
        let deformed_state = deformed_state(&scene, 0.0501);
        let q: Vec<u8> = deformed_state.q.iter().flat_map(|number| number.to_le_bytes()).collect();
        let mut driver = server.drive(&name, v1::Policy::Lossless, 0).await;
        driver.step_acknowledged(v1::Step { number: 1, q: q.into(), ..v1::Step::default() }).await;
        let request = v1::GetVerticesRequest { scene: name.clone(), ..v1::GetVerticesRequest::default() };
        let got = get_vertices(&server, request).await.expect("vertices");
        assert_eq!(got.step().number, 1);
        let want = reference::deform(&scene, &deformed_state);
        let error = max_distance(&got.positions, &want) / scene.rest_bounds.diagonal();
        println!("{source}: error of vertices streamed by {backend:?}: {error:.2e} of the diagonal");
        assert!(error <= 1e-5, "{source}: {error}");
        let rest = reference::deform(&scene, &SceneState::rest(&scene));
        assert!(
            max_distance(&got.positions, &rest) >= 0.05 * scene.rest_bounds.diagonal(),
            "negative control: rest positions"
        );
        driver.finish().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_vertices_streamed_by_the_cpu_agree_with_the_reference() {
    assert_stream_equals_reference(BackendChoice::Cpu).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs an NVIDIA GPU and the real inputs"]
async fn gpu_streamed_vertices_of_real_inputs_equal_the_reference() {
    assert_stream_equals_reference(BackendChoice::Cuda).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_malformed_modes_are_refused_and_the_server_continues() {
    let (state, scenes) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    std::fs::copy(input_path("sofa/ball/modes.txt"), scenes.path().join("modes.txt")).expect("copied");
    std::fs::copy(input_path("sofa/hexaBeam/hexaBeam.derived.obj"), scenes.path().join("ball.obj")).expect("copied");
    let repository = Arc::new(load::SceneRepository::new(Some(scenes.path())).expect("expected a repository"));
    let server = Server::start_from(config(state.path()), repository).await;
    let open = |source: &str| v1::OpenSceneRequest { source: source.into(), scene: String::new() };
    let refusal = server.scenes().await.open_scene(open("ball.obj")).await.expect_err("malformed");
    let why = rejection_details(&refusal);
    assert!(why.expected.contains("684 x 32") && why.given.contains("684 x 35"), "{why:?}");
    server.scenes().await.open_scene(open("tree")).await.expect("the server lives");
}
