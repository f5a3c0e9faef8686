//! Tests on real inputs (models of other projects) in the folder `MODALCAST_DATA`, by default `../shared/data`. On
//! every input with modes U, deformers agree with the f64 reference. The tests call deformers directly and over gRPC.

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

/// Largest displacement of the test states, relative to the scene's diagonal. It is slightly above
/// [`MIN_DISPLACEMENT`], because q is rounded to f32 after it is scaled.
const DISPLACEMENT: f64 = 0.0501;
/// Required displacement of the test states, relative to the scene's diagonal. 5 % make errors of U q visible.
const MIN_DISPLACEMENT: f64 = 0.05;

pub(crate) fn input_path(path: &str) -> String {
    let root = std::env::var_os("MODALCAST_DATA").map_or_else(|| PathBuf::from("../shared/data"), PathBuf::from);
    root.join(path).to_string_lossy().into_owned()
}

/// A state with random coordinates, scaled so that the largest displacement is [`DISPLACEMENT`] times the scene's
/// diagonal.
fn deformed_state(scene: &Scene) -> SceneState {
    let mut random = TestRng(11);
    let mut state = SceneState::rest(scene);
    let rest_positions = reference::deform(scene, &state);
    for coordinate in &mut state.q {
        *coordinate = random.next();
    }
    let max_displacement = |state: &SceneState| {
        let positions = reference::deform(scene, state);
        let vertex_distance = |(position, rest_position): (&[f64; 3], &[f64; 3])| {
            position.iter().zip(rest_position).map(|(x, rest_x)| (x - rest_x).powi(2)).sum::<f64>().sqrt()
        };
        positions.iter().zip(&rest_positions).map(vertex_distance).fold(0.0, f64::max)
    };
    let scale = DISPLACEMENT * scene.rest_bounds.diagonal() / max_displacement(&state);
    state.q.iter_mut().for_each(|coordinate| *coordinate *= scale as f32);
    assert!(max_displacement(&state) >= MIN_DISPLACEMENT * scene.rest_bounds.diagonal());
    state
}

/// The CPU deformer has an error of at most 1e-5 of the diagonal. Vertices whose rows of U are zero do not move.
fn assert_cpu_equals_reference(scene: &Arc<Scene>) {
    let state = deformed_state(scene);
    let mut cpu = CpuDeformer::new(scene);
    cpu.deform(&state).expect("expected the step to succeed");
    let deformed_positions = cpu.surface().expect("expected a surface").positions.clone();
    let error = max_distance(&deformed_positions, &reference::deform(scene, &state)) / scene.rest_bounds.diagonal();
    println!("{}: error of the CPU deformer: {error:.2e} of the diagonal", scene.name);
    assert!(error <= 1e-5, "{}: expected an error of at most 1e-5 of the diagonal, got {error}", scene.name);
    cpu.deform(&SceneState { q: vec![0.0; state.q.len()], ..state.clone() }).expect("expected the step to succeed");
    let rest_positions = cpu.surface().expect("expected a surface").positions.clone();
    let (mut zero_row_vertices, mut moved_vertices) = (0, 0);
    for (domain, layout) in scene.layout.domains.iter().enumerate() {
        let modes = &scene.shape_of(domain).modes;
        for vertex in 0..layout.vertices {
            let first_number = 3 * (layout.first_vertex + vertex);
            let range = first_number..first_number + 3;
            let has_zero_rows = (0..3).all(|axis| (0..layout.rank).all(|mode| modes.entry(vertex, axis, mode) == 0.0));
            let is_moved = deformed_positions[range.clone()] != rest_positions[range];
            assert!(!has_zero_rows || !is_moved, "expected vertex {vertex} of domain {domain} not to move");
            moved_vertices += usize::from(is_moved);
            zero_row_vertices += usize::from(has_zero_rows);
        }
    }
    println!("{}: {zero_row_vertices} vertices with zero rows of U, {moved_vertices} moved vertices", scene.name);
    assert!(moved_vertices > 0);
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

/// Opens every modal input and the built-in tree on a server with this backend, sends one step over gRPC, and compares
/// the received vertices with the reference.
async fn assert_received_vertices_equal_reference(backend: BackendChoice) {
    let state_folder = tempfile::tempdir().expect("expected a temporary folder");
    let repository = Arc::new(
        load::SceneRepository::new(Some(Path::new(&input_path("")))).expect("expected the folder of real inputs"),
    );
    let server = Server::start_from(Config { backend, ..config(state_folder.path()) }, repository).await;
    for source in MODAL_INPUTS.iter().chain(&["tree"]) {
        let path = if *source == "tree" { (*source).to_owned() } else { input_path(source) };
        let scene = load::open(&path).unwrap_or_else(|error| panic!("{path}: {error}")).scene;
        let name = server.open(source).await.scene;
        let deformed_state = deformed_state(&scene);
        let q: Vec<u8> = deformed_state.q.iter().flat_map(|number| number.to_le_bytes()).collect();
        let mut writer = server.drive_lossless(&name).await;
        writer.send_step_and_wait(v1::Step { number: 1, q: q.into(), ..v1::Step::default() }).await;
        let request = v1::GetVerticesRequest { scene: name.clone(), ..v1::GetVerticesRequest::default() };
        let reply = get_vertices(&server, request).await.expect("expected vertices");
        assert_eq!(reply.step().number, 1);
        let reference_positions = reference::deform(&scene, &deformed_state);
        let error = max_distance(&reply.positions, &reference_positions) / scene.rest_bounds.diagonal();
        println!("{source}: error of vertices received from {backend:?}: {error:.2e} of the diagonal");
        assert!(error <= 1e-5, "{source}: expected an error of at most 1e-5 of the diagonal, got {error}");
        let rest_positions = reference::deform(&scene, &SceneState::rest(&scene));
        assert!(
            max_distance(&reply.positions, &rest_positions) >= MIN_DISPLACEMENT * scene.rest_bounds.diagonal(),
            "negative control: expected a large distance from the rest positions"
        );
        writer.finish().await;
    }
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn cpu_vertices_of_real_inputs_equal_the_reference() {
    assert_received_vertices_equal_reference(BackendChoice::Cpu).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs an NVIDIA GPU and the real inputs"]
async fn gpu_vertices_of_real_inputs_equal_the_reference() {
    assert_received_vertices_equal_reference(BackendChoice::Cuda).await;
}

#[tokio::test(flavor = "multi_thread")]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
async fn real_malformed_modes_are_rejected_and_the_server_continues() {
    let (state_folder, repository_folder) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    std::fs::copy(input_path("sofa/ball/modes.txt"), repository_folder.path().join("modes.txt"))
        .expect("expected to copy a file");
    std::fs::copy(input_path("sofa/hexaBeam/hexaBeam.derived.obj"), repository_folder.path().join("ball.obj"))
        .expect("expected to copy a file");
    let repository =
        Arc::new(load::SceneRepository::new(Some(repository_folder.path())).expect("expected a repository"));
    let server = Server::start_from(config(state_folder.path()), repository).await;
    // The loader reads `modes.txt` beside the OBJ file. Its header declares 684 x 32 numbers, but its lines have 35.
    let open_request = |source: &str| v1::OpenSceneRequest { source: source.into(), scene: String::new() };
    let status = server
        .scenes()
        .await
        .open_scene(open_request("ball.obj"))
        .await
        .expect_err("expected an error of malformed modes");
    let rejection = rejection_details(&status);
    assert!(rejection.expected.contains("684 x 32") && rejection.given.contains("684 x 35"), "{rejection:?}");
    server.scenes().await.open_scene(open_request("tree")).await.expect("expected the server to open another scene");
}
