//! Scene files over the wire: paths cannot leave the scene repository (the server's folder of scenes), an uploaded
//! `scene.toml` opens, and the rejection of an invalid file names the invalid value.

use std::path::Path;
use std::sync::Arc;

use modalcast::identity::Principal;
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use tonic::{Code, Status};
use v1::upload_scene_request::Part;

use crate::service_harness::{Server, config, get_vertices, rejection_details, step};

/// An OBJ file of one square with texture coordinates.
const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3 4/4\n";

/// Bytes of a NumPy file of f32 in row-major order.
fn encode_npy(rows: usize, columns: usize, entries: &[f32]) -> Vec<u8> {
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    // The header has 118 (0x76) bytes, so that the numbers begin at byte 128.
    let padded = format!("{header:<117}\n");
    let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
    bytes.extend_from_slice(padded.as_bytes());
    bytes.extend(entries.iter().flat_map(|entry| entry.to_le_bytes()));
    bytes
}

/// A NumPy file of U for [`SQUARE`]: one mode that moves the last of the four vertices by 2 along z.
fn lift_mode() -> Vec<u8> {
    let mut entries = [0.0; 12];
    entries[11] = 2.0;
    encode_npy(12, 1, &entries)
}

async fn start_server(state_folder: &Path, repository_folder: &Path) -> Server {
    let repository = SceneRepository::new(Some(repository_folder)).expect("expected a repository");
    Server::start_from(config(state_folder), Arc::new(repository)).await
}

async fn open(server: &Server, source: &str) -> Result<v1::SceneInfo, Status> {
    let request = v1::OpenSceneRequest { source: source.into(), scene: String::new() };
    Ok(server.scenes().await.open_scene(request).await?.into_inner().scene.expect("expected the scene info"))
}

/// Uploads files in chunks of 100 bytes as the scene `sent`. An empty `entry` lets the server choose the file to open.
async fn upload(server: &Server, entry: &str, files: &[(&str, &[u8])]) -> Result<v1::SceneInfo, Status> {
    let total_bytes = files.iter().map(|(_, bytes)| bytes.len() as u64).sum();
    let header = v1::UploadHeader { scene: "sent".into(), entry: entry.into(), files: files.len() as u32, total_bytes };
    let mut parts = vec![Part::Header(header)];
    for (path, bytes) in files {
        let sha256 = Sha256::digest(bytes).to_vec().into();
        parts.push(Part::File(v1::UploadFile {
            path: (*path).into(),
            bytes: bytes.len() as u64,
            sha256,
            reuse: false,
        }));
        parts.extend(bytes.chunks(100).map(|chunk| Part::Chunk(chunk.to_vec().into())));
    }
    let requests = parts.into_iter().map(|part| v1::UploadSceneRequest { part: Some(part) }).collect::<Vec<_>>();
    let response = server.scenes().await.upload_scene(tokio_stream::iter(requests)).await?;
    Ok(response.into_inner().scene.expect("expected the scene info"))
}

/// Sets the single coordinate of a scene of [`SQUARE`] to 1.5 and returns the position of the last vertex. Its rest
/// position is (0, 1, 0), and [`lift_mode`] moves it by 1.5 * 2 = 3 along z.
async fn deform_last_vertex(server: &Server, scene: &str) -> [f32; 3] {
    let mut writer = server.drive_lossless(scene).await;
    writer.send_step_and_wait(step(1, &[0], &[1.5])).await;
    let request = v1::GetVerticesRequest { scene: scene.into(), ..v1::GetVerticesRequest::default() };
    let reply = get_vertices(server, request).await.expect("expected vertices");
    [9, 10, 11].map(|index| reply.positions[index])
}

#[tokio::test(flavor = "multi_thread")]
async fn paths_within_the_repository_open_and_others_do_not() {
    let (state_folder, parent_folder) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    let repository_folder = parent_folder.path().join("scenes");
    std::fs::create_dir_all(repository_folder.join("deep")).expect("expected to create a folder");
    std::fs::write(repository_folder.join("deep/square.obj"), SQUARE).expect("expected to write a file");
    std::fs::write(repository_folder.join("deep/square.npy"), lift_mode()).expect("expected to write a file");
    std::fs::write(parent_folder.path().join("secret.obj"), SQUARE).expect("expected to write a file");
    std::os::unix::fs::symlink(parent_folder.path().join("secret.obj"), repository_folder.join("link.obj"))
        .expect("expected to create a link");
    let server = start_server(state_folder.path(), &repository_folder).await;
    let info = open(&server, "deep/square.obj").await.expect("expected the scene to open");
    assert_eq!((info.scene.as_str(), info.vertices, info.coordinates), ("square", 4, 1));
    assert_eq!(deform_last_vertex(&server, "square").await, [0.0, 1.0, 3.0]);
    let outside_path = parent_folder.path().join("secret.obj").to_string_lossy().into_owned();
    for path in ["../secret.obj", "deep/../../secret.obj", outside_path.as_str()] {
        let status = open(&server, path).await.expect_err(path);
        assert_eq!(status.code(), Code::InvalidArgument, "{path}: {status:?}");
        let rejection = rejection_details(&status);
        assert_eq!((rejection.reason(), rejection.field.as_str()), (v1::Reason::InvalidFile, ""), "{path}");
        assert!(!rejection.expected.is_empty() && !rejection.given.is_empty(), "{path}: {rejection:?}");
    }
    // A link to a file outside is not found, like a name that does not exist.
    for path in ["link.obj", "none.obj"] {
        let status = open(&server, path).await.expect_err(path);
        assert_eq!((status.code(), rejection_details(&status).reason()), (Code::NotFound, v1::Reason::SceneNotFound));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn uploaded_scene_toml_opens_and_deforms() {
    let (state_folder, repository_folder) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    let server = start_server(state_folder.path(), repository_folder.path()).await;
    let manifest = b"model = \"parts/square.obj\"\nmodes = \"parts/u.npy\"\nup = \"z\"\n";
    let files: [(&str, &[u8]); 3] =
        [("scene.toml", manifest), ("parts/square.obj", SQUARE.as_bytes()), ("parts/u.npy", &lift_mode())];
    let info = upload(&server, "", &files).await.expect("expected the upload to succeed");
    assert_eq!((info.scene.as_str(), info.up.as_str(), info.coordinates), ("sent", "z", 1));
    assert_eq!(deform_last_vertex(&server, "sent").await, [0.0, 1.0, 3.0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_files_are_rejected_and_leave_no_files() {
    let (state_folder, repository_folder) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    let server = start_server(state_folder.path(), repository_folder.path()).await;
    let square = SQUARE.as_bytes();
    let truncated_modes = &lift_mode()[..150];
    let missing_texture = b"model = \"a.obj\"\n[material.\"*\"]\ncolor_texture = \"nowhere.png\"\n";
    let invalid_alpha = b"model = \"a.obj\"\n[material.\"*\"]\nalpha = 7\n";
    let escaping_path = b"model = \"../../../scenes.json\"\n";
    let index_out_of_range = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n";
    type Files<'a> = Vec<(&'a str, &'a [u8])>;
    let too_few_rows = encode_npy(9, 1, &[0.0; 9]);
    let nan_modes = encode_npy(12, 1, &[f32::NAN; 12]);
    // Name of the case, files, and two words that the error must contain. An empty word is contained in every error.
    let cases: Vec<(&str, Files<'_>, [&str; 2])> = vec![
        ("rows that are not 3n", vec![("a.obj", square), ("a.npy", &too_few_rows)], ["rows", "12"]),
        ("truncated modes", vec![("a.obj", square), ("a.npy", truncated_modes)], ["a.npy", ""]),
        ("modes that are not finite", vec![("a.obj", square), ("a.npy", &nan_modes)], ["modes[0, 0]", "NaN"]),
        ("malformed SOFA modes", vec![("a.obj", square), ("modes.txt", b"12 1\n1 2 x")], ["modes.txt", ""]),
        ("an index out of range", vec![("a.obj", index_out_of_range)], ["a.obj", "9"]),
        ("a missing texture", vec![("scene.toml", missing_texture), ("a.obj", square)], ["nowhere.png", ""]),
        ("an alpha of 7", vec![("scene.toml", invalid_alpha), ("a.obj", square)], ["alpha", "7"]),
        ("a path outside of the upload", vec![("scene.toml", escaping_path), ("a.obj", square)], ["..", ""]),
        ("no model", vec![("notes.txt", b"nothing")], ["", ""]),
    ];
    for (name, files, words) in cases {
        let status = upload(&server, "", &files).await.expect_err(name);
        assert!(matches!(status.code(), Code::InvalidArgument | Code::NotFound), "{name}: {status:?}");
        let rejection = rejection_details(&status);
        assert!(
            matches!(rejection.reason(), v1::Reason::InvalidFile | v1::Reason::SceneNotFound),
            "{name}: {rejection:?}"
        );
        assert!(!rejection.expected.is_empty() && !rejection.given.is_empty(), "{name}: {rejection:?}");
        for word in words {
            assert!(status.message().contains(word), "{name}: expected '{word}' in {status:?}");
        }
        assert_eq!(
            std::fs::read_dir(state_folder.path().join("uploads")).expect("expected an uploads folder").count(),
            0,
            "{name}"
        );
    }
    assert!(server.engine.list(&Principal::owner()).open.is_empty());
    upload(&server, "", &[("a.obj", square)]).await.expect("expected the upload to succeed after rejected ones");
}

/// Uploads files as the scene `copy` without their content.
async fn upload_hashes(server: &Server, files: &[(&str, &[u8])]) -> Result<v1::SceneInfo, Status> {
    let total_bytes = files.iter().map(|(_, bytes)| bytes.len() as u64).sum();
    let header =
        v1::UploadHeader { scene: "copy".into(), files: files.len() as u32, total_bytes, ..Default::default() };
    let file = |(path, bytes): &(&str, &[u8])| v1::UploadFile {
        path: (*path).into(),
        bytes: bytes.len() as u64,
        sha256: Sha256::digest(bytes).to_vec().into(),
        reuse: true,
    };
    let parts = [Part::Header(header)].into_iter().chain(files.iter().map(|named| Part::File(file(named))));
    let requests = parts.map(|part| v1::UploadSceneRequest { part: Some(part) }).collect::<Vec<_>>();
    let response = server.scenes().await.upload_scene(tokio_stream::iter(requests)).await?;
    Ok(response.into_inner().scene.expect("expected the scene info"))
}

#[tokio::test(flavor = "multi_thread")]
async fn uploaded_files_are_reused_until_their_scene_is_deleted() {
    let (state_folder, repository_folder) = (
        tempfile::tempdir().expect("expected a temporary folder"),
        tempfile::tempdir().expect("expected a temporary folder"),
    );
    let modes = lift_mode();
    let files: [(&str, &[u8]); 2] = [("a.obj", SQUARE.as_bytes()), ("a.npy", &modes)];
    let first_server = start_server(state_folder.path(), repository_folder.path()).await;
    upload(&first_server, "", &files).await.expect("expected the upload to succeed");
    first_server.stop().await.expect("expected the server to stop");
    // The hashes survive a restart.
    let server = start_server(state_folder.path(), repository_folder.path()).await;
    let find = async |content: &[u8]| {
        let sha256 = vec![Sha256::digest(content).to_vec().into(), Sha256::digest("unknown").to_vec().into()];
        let request = v1::FindUploadedFilesRequest { sha256 };
        server.scenes().await.find_uploaded_files(request).await.expect("expected an answer").into_inner().found
    };
    assert_eq!(find(&modes).await, [true, false]);
    upload_hashes(&server, &files).await.expect("expected the upload to succeed without content");
    assert_eq!(deform_last_vertex(&server, "copy").await, [0.0, 1.0, 3.0]);
    let status = upload_hashes(&server, &[("b.obj", b"unknown")]).await.expect_err("expected a taken name");
    assert_eq!(status.code(), Code::AlreadyExists);
    for scene in ["sent", "copy"] {
        assert_eq!(find(&modes).await, [true, false], "expected the files of {scene}");
        let request = v1::DeleteSceneRequest { scene: scene.into() };
        server.scenes().await.delete_scene(request).await.expect("expected the scene to close");
    }
    assert_eq!(find(&modes).await, [false, false]);
    let status = upload_hashes(&server, &files).await.expect_err("expected an unknown content");
    let rejection = rejection_details(&status);
    assert_eq!((status.code(), rejection.reason()), (Code::NotFound, v1::Reason::ContentNotFound));
    assert_eq!(rejection.field, "file.sha256");
    let request = v1::FindUploadedFilesRequest { sha256: vec![] };
    let status = server.scenes().await.find_uploaded_files(request).await.expect_err("expected an empty list");
    assert_eq!(rejection_details(&status).field, "sha256");
}
