//! State that survives a restart: open scenes, uploads and the last step, after a clean stop or a kill.

use std::path::Path;
use std::time::{Duration, Instant};

use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use v1::upload_scene_request::Part;

use crate::service_harness::{Server, TIMEOUT, config, get_vertices, reference_vertices, step, strips};

fn vertex_request(scene: &str) -> v1::GetVerticesRequest {
    v1::GetVerticesRequest { scene: scene.into(), ..v1::GetVerticesRequest::default() }
}

fn runtime() -> tokio::runtime::Runtime {
    tokio::runtime::Builder::new_multi_thread().enable_all().worker_threads(2).build().expect("a runtime")
}

fn steps() -> [v1::Step; 2] {
    [step(4, &[], &[0.1, 0.2, 0.3, 0.4]), step(9, &[1], &[0.5, -0.5])]
}

/// Opens `strips`, drives all steps and returns the vertices of the last step.
async fn drive_steps(server: &Server) -> Vec<f32> {
    server.open("strips").await;
    let mut driver = server.drive("strips", v1::Policy::Lossless, 0).await;
    for step in steps() {
        driver.step_acknowledged(step).await;
    }
    driver.finish().await;
    get_vertices(server, vertex_request("strips")).await.expect("expected vertices").positions
}

/// Starts a server on this state folder and returns the step and vertices of `strips`. Also checks that a new writer
/// can start a new run.
fn restore_and_read(state: &Path) -> (v1::StepId, Vec<f32>) {
    runtime().block_on(async {
        let begin = Instant::now();
        let server = Server::start(config(state)).await;
        assert!(begin.elapsed() < Duration::from_secs(2), "{:?}", begin.elapsed());
        let got =
            get_vertices(&server, vertex_request("strips")).await.expect("expected vertices of the restored scene");
        let restored = (got.step(), got.positions);
        // A writer starts a new run at any number.
        let mut driver = server.drive("strips", v1::Policy::Lossless, 0).await;
        driver.step_acknowledged(step(0, &[0], &[0.0, 0.0])).await;
        let got = get_vertices(&server, vertex_request("strips")).await.expect("expected vertices");
        assert_eq!((got.step().run, got.step().number), (restored.0.run + 1, 0));
        restored
    })
}

#[test]
fn stopped_server_restores_scenes_and_last_steps() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let before = runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        let before = drive_steps(&server).await;
        server.stop().await.expect("expected the server to stop without an error");
        before
    });
    assert_eq!(before, reference_vertices(&strips(), &steps()).0);
    let (step, after) = restore_and_read(folder.path());
    assert_eq!((step.run, step.number, step.time), (1, 9, 4.5));
    assert_eq!(after, before);
}

/// The files are copied once the checkpoint of the last step is written; a server on the copy restores that step.
#[test]
fn killed_server_restores_the_last_checkpoint() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let copy = tempfile::tempdir().expect("expected a temporary folder");
    let first_runtime = runtime();
    let before = first_runtime.block_on(async {
        let server = Server::start(config(folder.path())).await;
        let before = drive_steps(&server).await;
        // A kill leaves the files that are on disk at that moment, so copy the files while the server runs.
        let begin = Instant::now();
        let has_last_step = |bytes: Vec<u8>| bytes.get(16..24) == Some(9_u64.to_le_bytes().as_slice());
        while !std::fs::read(folder.path().join("steps/strips.step")).is_ok_and(has_last_step) {
            assert!(begin.elapsed() < TIMEOUT, "expected a checkpoint of the last step");
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
        std::fs::create_dir(copy.path().join("steps")).expect("expected to create a folder");
        for file in ["scenes.json", "steps/strips.step"] {
            std::fs::copy(folder.path().join(file), copy.path().join(file)).expect("expected to copy a file");
        }
        before
    });
    drop(first_runtime);
    for state in [copy.path(), folder.path()] {
        let (step, after) = restore_and_read(state);
        assert_eq!((step.run, step.number), (1, 9));
        assert_eq!(after, before);
    }
}

#[test]
fn scene_with_a_damaged_checkpoint_starts_at_rest() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        drive_steps(&server).await;
        server.stop().await.expect("expected the server to stop without an error");
    });
    let path = folder.path().join("steps/strips.step");
    let mut bytes = std::fs::read(&path).expect("expected a checkpoint file");
    bytes[60] ^= 0x40;
    std::fs::write(&path, bytes).expect("expected to write a file");
    let (step, after) = restore_and_read(folder.path());
    assert_eq!(step.run, 0);
    assert_eq!(after, reference_vertices(&strips(), &[]).0);
}

/// When the list of scenes cannot be written, opening and deleting fail, and the failed opening leaves its name free.
#[test]
fn catalog_write_failure_fails_the_call() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let open = |source: &str| v1::OpenSceneRequest { source: source.into(), scene: "name".into() };
    let delete = || v1::DeleteSceneRequest { scene: "name".into() };
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        let mut scenes = server.scenes().await;
        scenes.open_scene(open("strips")).await.expect("opens");
        let obstacle = folder.path().join("scenes.new");
        std::fs::create_dir(&obstacle).expect("in the way of every writing");
        let status = scenes.delete_scene(delete()).await.expect_err("it stays in the list");
        assert_eq!(status.code(), tonic::Code::Internal, "{status:?}");
        let status = scenes.open_scene(open("sheet")).await.expect_err("it does not come into the list");
        assert_eq!(status.code(), tonic::Code::Internal, "{status:?}");
        assert!(server.engine.list().is_empty());
        std::fs::remove_dir(&obstacle).expect("out of the way");
        // Deletion succeeds now, once. The failed opening did not reserve the name.
        scenes.delete_scene(delete()).await.expect("expected the deletion to succeed");
        let status = scenes.delete_scene(delete()).await.expect_err("expected an unknown-scene error");
        assert_eq!(status.code(), tonic::Code::NotFound, "{status:?}");
        scenes.open_scene(open("sheet")).await.expect("expected an unused name");
    });
}

#[test]
fn restart_restores_uploads_but_not_deleted_scenes() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        drive_steps(&server).await;
        let file = v1::UploadFile {
            path: "deep/scene.txt".into(),
            bytes: 6,
            sha256: Sha256::digest(b"strips").to_vec().into(),
        };
        let header =
            v1::UploadHeader { scene: "mine".into(), entry: "deep/scene.txt".into(), files: 1, total_bytes: 6 };
        let parts =
            [Part::Header(header), Part::File(file), Part::Chunk(b"str"[..].into()), Part::Chunk(b"ips"[..].into())];
        let requests = parts.map(|part| v1::UploadSceneRequest { part: Some(part) });
        server.scenes().await.upload_scene(tokio_stream::iter(requests)).await.expect("expected the upload to succeed");
        let delete = v1::DeleteSceneRequest { scene: "strips".into() };
        server.scenes().await.delete_scene(delete).await.expect("expected the deletion to succeed");
        server.stop().await.expect("expected the server to stop without an error");
    });
    runtime().block_on(async {
        let server = Server::start(config(folder.path())).await;
        let names: Vec<_> = server.engine.list().iter().map(|host| host.name.clone()).collect();
        assert_eq!(names, ["mine"]);
        assert!(!folder.path().join("steps/strips.step").exists());
        get_vertices(&server, vertex_request("mine")).await.expect("expected vertices");
    });
}
