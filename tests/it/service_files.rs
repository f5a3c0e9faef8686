//! Real files over the wire: paths cannot leave the repository, uploads have the same grammar, and invalid files are
//! refused by name.

use std::path::Path;
use std::sync::Arc;

use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use tonic::{Code, Status};
use v1::upload_scene_request::Part;

use crate::service_harness::{Server, config, get_vertices, rejection_details, step};

const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n";

/// Bytes of a NumPy file of f32 in row-major order.
fn npy(rows: usize, columns: usize, entries: &[f32]) -> Vec<u8> {
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    let padded = format!("{header:<117}\n");
    let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    bytes.extend_from_slice(padded.as_bytes());
    bytes.extend(entries.iter().flat_map(|entry| entry.to_le_bytes()));
    bytes
}

/// One mode that moves the last vertex by 2 along z.
fn lift() -> Vec<u8> {
    let mut entries = [0.0; 12];
    entries[11] = 2.0;
    npy(12, 1, &entries)
}

async fn server(state: &Path, scenes: &Path) -> Server {
    let repository = SceneRepository::new(Some(scenes)).expect("expected a repository");
    Server::start_from(config(state), Arc::new(repository)).await
}

async fn open(server: &Server, source: &str) -> Result<v1::SceneInfo, Status> {
    let request = v1::OpenSceneRequest { source: source.into(), scene: String::new() };
    Ok(server.scenes().await.open_scene(request).await?.into_inner().scene.expect("expected the scene info"))
}

async fn upload(server: &Server, entry: &str, files: &[(&str, &[u8])]) -> Result<v1::SceneInfo, Status> {
    let total_bytes = files.iter().map(|(_, bytes)| bytes.len() as u64).sum();
    let header = v1::UploadHeader { scene: "sent".into(), entry: entry.into(), files: files.len() as u32, total_bytes };
    let mut parts = vec![Part::Header(header)];
    for (path, bytes) in files {
        let sha256 = Sha256::digest(bytes).to_vec().into();
        parts.push(Part::File(v1::UploadFile { path: (*path).into(), bytes: bytes.len() as u64, sha256 }));
        parts.extend(bytes.chunks(100).map(|chunk| Part::Chunk(chunk.to_vec().into())));
    }
    let requests = parts.into_iter().map(|part| v1::UploadSceneRequest { part: Some(part) }).collect::<Vec<_>>();
    let sent = server.scenes().await.upload_scene(tokio_stream::iter(requests)).await?;
    Ok(sent.into_inner().scene.expect("expected the scene info"))
}

/// Drives the single mode of a scene and returns the position of its last vertex.
async fn lifted(server: &Server, scene: &str) -> [f32; 3] {
    let mut driver = server.drive(scene, v1::Policy::Lossless, 0).await;
    driver.step_acknowledged(step(1, &[0], &[1.5])).await;
    let ask = v1::GetVerticesRequest { scene: scene.into(), ..v1::GetVerticesRequest::default() };
    let got = get_vertices(server, ask).await.expect("vertices");
    [9, 10, 11].map(|at| got.positions[at])
}

#[tokio::test(flavor = "multi_thread")]
async fn repository_paths_open_and_cannot_escape() {
    let (state, outer) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    let scenes = outer.path().join("scenes");
    std::fs::create_dir_all(scenes.join("deep")).expect("expected a temporary folder");
    std::fs::write(scenes.join("deep/square.obj"), SQUARE).expect("written");
    std::fs::write(scenes.join("deep/square.npy"), lift()).expect("written");
    std::fs::write(outer.path().join("secret.obj"), SQUARE).expect("written");
    std::os::unix::fs::symlink(outer.path().join("secret.obj"), scenes.join("link.obj")).expect("linked");
    let server = server(state.path(), &scenes).await;
    let info = open(&server, "deep/square.obj").await.expect("opens");
    assert_eq!((info.scene.as_str(), info.vertices, info.coordinates), ("square", 4, 1));
    assert_eq!(lifted(&server, "square").await, [0.0, 1.0, 3.0]);
    let outside = outer.path().join("secret.obj").to_string_lossy().into_owned();
    for path in ["../secret.obj", "deep/../../secret.obj", outside.as_str(), "link.obj"] {
        let status = open(&server, path).await.expect_err(path);
        assert_eq!(status.code(), Code::InvalidArgument, "{path}: {status:?}");
        let why = rejection_details(&status);
        assert!(!why.field.is_empty() && !why.expected.is_empty() && !why.given.is_empty(), "{path}: {why:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn upload_has_the_grammar_of_the_repository() {
    let (state, scenes) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    let server = server(state.path(), scenes.path()).await;
    let manifest = b"model = \"parts/square.obj\"\nmodes = \"parts/u.npy\"\nup = \"z\"\n";
    let files: [(&str, &[u8]); 3] =
        [("scene.toml", manifest), ("parts/square.obj", SQUARE.as_bytes()), ("parts/u.npy", &lift())];
    let info = upload(&server, "", &files).await.expect("expected the upload to succeed");
    assert_eq!((info.scene.as_str(), info.up.as_str(), info.coordinates), ("sent", "z", 1));
    assert_eq!(lifted(&server, "sent").await, [0.0, 1.0, 3.0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn bad_files_are_refused_and_leave_no_files() {
    let (state, scenes) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    let server = server(state.path(), scenes.path()).await;
    let square = SQUARE.as_bytes();
    let short = &lift()[..150];
    let with_image = b"model = \"a.obj\"\n[material.\"*\"]\ncolour_texture = \"nowhere.png\"\n";
    let seven = b"model = \"a.obj\"\n[material.\"*\"]\nalpha = 7\n";
    let outside = b"model = \"../../../scenes.json\"\n";
    let beyond = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n";
    type Files<'a> = Vec<(&'a str, &'a [u8])>;
    let wrong = npy(9, 1, &[0.0; 9]);
    let endless = npy(12, 1, &[f32::NAN; 12]);
    // Name of the case, files, and words that the refusal must contain.
    let table: Vec<(&str, Files<'_>, [&str; 2])> = vec![
        ("rows that are not 3n", vec![("a.obj", square), ("a.npy", &wrong)], ["rows", "12"]),
        ("truncated modes", vec![("a.obj", square), ("a.npy", short)], ["a.npy", ""]),
        ("modes that are not finite", vec![("a.obj", square), ("a.npy", &endless)], ["modes[0, 0]", "NaN"]),
        ("malformed SOFA modes", vec![("a.obj", square), ("modes.txt", b"12 1\n1 2 x")], ["modes.txt", ""]),
        ("an index out of range", vec![("a.obj", beyond)], ["a.obj", "9"]),
        ("a missing texture", vec![("scene.toml", with_image), ("a.obj", square)], ["nowhere.png", ""]),
        ("an alpha of 7", vec![("scene.toml", seven), ("a.obj", square)], ["alpha", "7"]),
        ("a path out of the upload", vec![("scene.toml", outside), ("a.obj", square)], ["..", ""]),
        ("no model at all", vec![("notes.txt", b"nothing")], ["", ""]),
    ];
    for (name, files, words) in table {
        let status = upload(&server, "", &files).await.expect_err(name);
        assert!(matches!(status.code(), Code::InvalidArgument | Code::NotFound), "{name}: {status:?}");
        let why = rejection_details(&status);
        assert!(!why.field.is_empty() && !why.expected.is_empty() && !why.given.is_empty(), "{name}: {why:?}");
        for word in words {
            assert!(status.message().contains(word), "{name}: {status:?} lacks {word}");
        }
        assert_eq!(
            std::fs::read_dir(state.path().join("uploads")).expect("expected a temporary folder").count(),
            0,
            "{name}"
        );
    }
    assert!(server.engine.list().is_empty());
    upload(&server, "", &[("a.obj", square)]).await.expect("a good one under the same name");
}
