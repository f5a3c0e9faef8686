//! State that survives a restart: open scenes, uploads and the last step, after a clean stop or a kill.

use std::ops::Range;
use std::path::Path;
use std::time::{Duration, Instant};

use modalcast::identity::Principal;
use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use v1::upload_scene_request::Part;

use crate::common::hang_guard::HANG_GUARD;
use crate::service_harness::{Server, config, get_vertices, reference_vertices, step, strips};

/// Byte range of the step number in a checkpoint file.
const CHECKPOINT_STEP_NUMBER: Range<usize> = 16..24;

/// Requests all vertices of a scene.
fn vertex_request(scene: &str) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), ..v1::GetVerticesRequest::default() }
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().enable_all().worker_threads(2).build().expect("expected a runtime")
}

/// The second step has the number 9 and the time 4.5.
fn steps() -> [v1::Step; 2] {
    [step(4, &[], &[0.1, 0.2, 0.3, 0.4]), step(9, &[1], &[0.5, -0.5])]
}

/// Opens `strips`, a scene of two domains, sends [`steps`] and returns the positions after the last step.
async fn send_steps(server: &Server) -> Vec<f32> {
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    for step in steps() {
        writer.send_step_and_wait(step).await;
    }
    writer.finish().await;
    get_vertices(server, vertex_request("strips")).await.expect("expected vertices").positions
}

/// Starts a server on a state folder and returns the restored step and positions of `strips`. Also asserts that a new
/// writer starts a new run (the steps of one writer).
fn restore_and_read(state_folder: &Path) -> (v1::StepId, Vec<f32>) {
    runtime().block_on(async {
        let server = Server::start(config(state_folder)).await;
        let reply =
            get_vertices(&server, vertex_request("strips")).await.expect("expected vertices of the restored scene");
        let restored = (reply.step(), reply.positions);
        // Step numbers need to increase only within a run, so step 0 is valid after step 9 of the previous run.
        let mut writer = server.drive_lossless("strips").await;
        writer.send_step_and_wait(step(0, &[0], &[0.0, 0.0])).await;
        let reply = get_vertices(&server, vertex_request("strips")).await.expect("expected vertices");
        assert!(reply.step().run > restored.0.run && reply.step().number == 0, "{:?}", reply.step());
        restored
    })
}

#[test]
fn stopped_server_restores_scenes_and_last_steps() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let stopped_positions = runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        let stopped_positions = send_steps(&server).await;
        server.stop().await.expect("expected the server to stop without an error");
        stopped_positions
    });
    assert_eq!(stopped_positions, reference_vertices(&strips(), &steps()).positions);
    let (step, restored_positions) = restore_and_read(folder.path());
    assert_eq!((step.run, step.number, step.time), (1, 9, 4.5));
    assert_eq!(restored_positions, stopped_positions);
}

/// Simulates a kill: copies the state folder while the server runs, and starts a server on the copy.
#[test]
fn killed_server_restores_the_last_checkpoint() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let copied_folder = tempfile::tempdir().expect("expected a temporary folder");
    let first_runtime = runtime();
    let positions = first_runtime.block_on(async {
        let server = Server::start(config(folder.path())).await;
        let positions = send_steps(&server).await;

        let start = Instant::now();
        let has_last_step = |bytes: Vec<u8>| bytes.get(CHECKPOINT_STEP_NUMBER) == Some(9_u64.to_le_bytes().as_slice());
        while !std::fs::read(folder.path().join("steps/strips.step")).is_ok_and(has_last_step) {
            assert!(start.elapsed() < HANG_GUARD, "expected a checkpoint of the last step");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        std::fs::create_dir(copied_folder.path().join("steps")).expect("expected to create a folder");
        for file in ["scenes.json", "steps/strips.step"] {
            std::fs::copy(folder.path().join(file), copied_folder.path().join(file)).expect("expected to copy a file");
        }
        positions
    });
    // Ends the tasks of the first server without a clean stop.
    drop(first_runtime);
    for state_folder in [copied_folder.path(), folder.path()] {
        let (step, restored_positions) = restore_and_read(state_folder);
        assert_eq!((step.run, step.number), (1, 9));
        assert_eq!(restored_positions, positions);
    }
}

#[test]
fn scene_with_a_damaged_checkpoint_starts_at_rest() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        send_steps(&server).await;
        server.stop().await.expect("expected the server to stop without an error");
    });
    let path = folder.path().join("steps/strips.step");
    let mut bytes = std::fs::read(&path).expect("expected a checkpoint file");
    // Flip one bit. The file contains a hash, so the server detects the change.
    bytes[60] ^= 0x40;
    std::fs::write(&path, bytes).expect("expected to write a file");
    let (step, restored_positions) = restore_and_read(folder.path());
    assert_eq!(step.run, 0, "expected the run before the first step");
    assert_eq!(restored_positions, reference_vertices(&strips(), &[]).positions);
}

/// If `scenes.json` cannot be written, open and delete calls fail. A failed open call does not reserve the name.
#[test]
fn catalog_write_failure_fails_the_call() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let open_request = |source: &str| v1::OpenSceneRequest { source: source.into(), scene: "name".into() };
    let delete_request = || v1::DeleteSceneRequest { scene: "name".into() };
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        let mut scenes = server.scenes().await;
        scenes.open_scene(open_request("strips")).await.expect("expected the scene to open");
        // The server writes the catalog to `scenes.new` and renames it to `scenes.json`. A folder named `scenes.new`
        // makes the writing fail.
        let obstacle = folder.path().join("scenes.new");
        std::fs::create_dir(&obstacle).expect("expected to create a folder");
        let status = scenes.delete_scene(delete_request()).await.expect_err("expected the deletion to fail");
        assert_eq!(status.code(), tonic::Code::Internal, "{status:?}");
        let status = scenes.open_scene(open_request("sheet")).await.expect_err("expected the opening to fail");
        assert_eq!(status.code(), tonic::Code::Internal, "{status:?}");
        assert!(server.engine.list(&Principal::owner()).open.is_empty());
        std::fs::remove_dir(&obstacle).expect("expected to remove the folder");
        scenes.delete_scene(delete_request()).await.expect("expected the deletion to succeed");
        let status = scenes.delete_scene(delete_request()).await.expect_err("expected an unknown-scene error");
        assert_eq!(status.code(), tonic::Code::NotFound, "{status:?}");
        scenes.open_scene(open_request("sheet")).await.expect("expected the name to be free after the deletion");
    });
}

#[test]
fn restart_restores_uploads_but_not_deleted_scenes() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        send_steps(&server).await;
        let file = v1::UploadFile {
            path: "deep/scene.txt".into(),
            bytes: 6,
            sha256: Sha256::digest(b"strips").to_vec().into(),
            reuse: false,
        };
        let header =
            v1::UploadHeader { scene: "mine".into(), entry: "deep/scene.txt".into(), files: 1, total_bytes: 6 };
        let parts =
            [Part::Header(header), Part::File(file), Part::Chunk(b"str"[..].into()), Part::Chunk(b"ips"[..].into())];
        let requests = parts.map(|part| v1::UploadSceneRequest { part: Some(part) });
        server.scenes().await.upload_scene(tokio_stream::iter(requests)).await.expect("expected the upload to succeed");
        let delete_request = v1::DeleteSceneRequest { scene: "strips".into() };
        server.scenes().await.delete_scene(delete_request).await.expect("expected the deletion to succeed");
        server.stop().await.expect("expected the server to stop without an error");
    });
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        let names: Vec<_> =
            server.engine.list(&Principal::owner()).open.iter().map(|scene| scene.name.clone()).collect();
        assert_eq!(names, ["mine"]);
        assert!(!folder.path().join("steps/strips.step").exists());
        get_vertices(&server, vertex_request("mine")).await.expect("expected vertices");
    });
}
