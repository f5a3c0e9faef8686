//! Memory of scenes: files that decode to more than the limits are rejected from their headers, and other scenes remain
//! open.

use std::path::Path;
use std::sync::Arc;

use modalcast::config::Config;
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use tonic::{Code, Status};
use tonic_types::StatusExt as _;

use crate::service_harness::{Server, config, get_vertices, rejection_details};

/// Side of the image in pixels. Its file has a few kilobytes.
const SIDE: u32 = 2048;

/// Memory of the pixels, which is needed twice while they are decoded.
const PIXEL_BYTES: u64 = 4 * SIDE as u64 * SIDE as u64;

/// Writes a model with an image of one color to the folder `name`.
fn write_model(scenes: &Path, name: &str) {
    let folder = scenes.join(name);
    std::fs::create_dir(&folder).expect("expected a new folder");
    let obj = "mtllib m.mtl\nusemtl m\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nf 1/1 2/1 3/1\n";
    std::fs::write(folder.join("m.obj"), obj).expect("expected a written file");
    std::fs::write(folder.join("m.mtl"), "newmtl m\nmap_Kd m.png\n").expect("expected a written file");
    image::RgbaImage::new(SIDE, SIDE).save(folder.join("m.png")).expect("expected a written image");
}

async fn open(server: &Server, source: &str) -> Result<v1::SceneInfo, Status> {
    let request = v1::OpenSceneRequest { source: source.into(), scene: String::new() };
    Ok(server.scenes().await.open_scene(request).await?.into_inner().scene.expect("expected the scene info"))
}

/// The metadata of an error that names the memory: object, limit, and the bytes asked, available and in total.
fn memory_metadata(status: &Status) -> (String, String, [u64; 3]) {
    assert_eq!((status.code(), rejection_details(status).reason()), (Code::ResourceExhausted, v1::Reason::OutOfMemory));
    let metadata = status.get_details_error_info().expect("expected an ErrorInfo").metadata;
    let bytes = ["asked", "available", "total"].map(|key| metadata[key].parse().expect("expected a number"));
    (metadata["object"].clone(), metadata["memory"].clone(), bytes)
}

async fn start_server(folder: &Path, change: impl FnOnce(Config) -> Config) -> Server {
    let scenes = folder.join("scenes");
    std::fs::create_dir(&scenes).expect("expected a new folder");
    for name in ["a", "b"] {
        write_model(&scenes, name);
    }
    let repository = SceneRepository::new(Some(&scenes)).expect("expected a repository");
    Server::start_from(change(config(&folder.join("state"))), Arc::new(repository)).await
}

#[tokio::test(flavor = "multi_thread")]
async fn scene_beyond_the_memory_of_its_principal_is_rejected() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let total = 2 * PIXEL_BYTES + PIXEL_BYTES / 2;
    let limits = |config| Config { scenes_host_bytes: Some(total), scene_host_bytes: Some(total), ..config };
    let server = start_server(folder.path(), limits).await;
    open(&server, "a").await.expect("expected enough memory for one scene");
    let (object, memory, [asked, available, limit]) =
        memory_metadata(&open(&server, "b").await.expect_err("expected too little memory for two scenes"));
    assert_eq!(object, format!("texture 'm.png' of {SIDE} x {SIDE} pixels"));
    // A principal leaves an eighth for others.
    let expected = ("host memory of the scenes of one principal", PIXEL_BYTES, total - total / 8);
    assert_eq!((memory.as_str(), asked, limit), expected);
    assert!(available < PIXEL_BYTES, "{available}");
    let request = v1::GetVerticesRequest { scene: "a".into(), ..v1::GetVerticesRequest::default() };
    get_vertices(&server, request).await.expect("expected the first scene to remain open");
    let request = v1::DeleteSceneRequest { scene: "a".into() };
    server.scenes().await.delete_scene(request).await.expect("expected a deleted scene");
    open(&server, "b").await.expect("expected the memory of the deleted scene to be available");
}

#[tokio::test(flavor = "multi_thread")]
async fn scene_beyond_its_own_memory_is_rejected() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let limits = |config| Config { scene_host_bytes: Some(PIXEL_BYTES), ..config };
    let server = start_server(folder.path(), limits).await;
    let status = open(&server, "a").await.expect_err("expected too little memory");
    let (_, memory, [_, _, limit]) = memory_metadata(&status);
    assert_eq!((memory.as_str(), limit), ("host memory of one scene", PIXEL_BYTES));
    let limits = server.engine.info().memory;
    assert_eq!(limits.scene_host, PIXEL_BYTES);
}
