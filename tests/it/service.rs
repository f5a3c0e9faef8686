//! Scenes over the wire: open, describe, list and delete; health, reflection and limits.

use std::sync::Arc;

use modalcast::admission::Client;
use modalcast::engine::{SceneSource, StoredUpload};
use modalcast::identity::Principal;
use modalcast_model::error::Result;
use modalcast_model::load::OpenedScene;
use modalcast_model::memory::MemoryReservation;
use modalcast_proto::v1;
use prost::Message as _;
use tokio_stream::StreamExt as _;
use v1::Array;
use v1::describe_scene_response::Part;

use crate::service_harness::{
    MAX_MESSAGE_BYTES, Server, get_vertices, next_vertices, reference_vertices, rejection_details, sheet, strips,
    with_timeout,
};

/// A source of scenes. The first opening waits for a signal and then fails. Later openings take 100 ms and succeed.
struct FailingOnceSource {
    open_count: std::sync::atomic::AtomicUsize,
    fail_signal: std::sync::Mutex<std::sync::mpsc::Receiver<()>>,
}

impl SceneSource for FailingOnceSource {
    fn open(&self, source: &str, _: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        if self.open_count.fetch_add(1, std::sync::atomic::Ordering::SeqCst) == 0 {
            self.fail_signal.lock().expect("expected an unpoisoned mutex").recv().expect("expected a signal");
            return Err(modalcast_model::error::invalid("source", "a second try", source));
        }
        std::thread::sleep(std::time::Duration::from_millis(100));
        Ok(strips().into())
    }

    fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        self.open(&upload.entry, memory)
    }

    fn list(&self) -> Vec<String> {
        vec![]
    }
}

/// Two calls that open the same name overlap. The first call fails. The second call succeeds and registers the scene.
#[tokio::test(flavor = "multi_thread")]
async fn opening_after_a_concurrent_failure_is_registered() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (fail_sender, fail_receiver) = std::sync::mpsc::sync_channel(1);
    let source = std::sync::Arc::new(FailingOnceSource { open_count: 0.into(), fail_signal: fail_receiver.into() });
    let server = Server::start_from(crate::service_harness::config(folder.path()), source.clone()).await;
    let open = || {
        let engine = server.engine.clone();
        tokio::spawn(async move { engine.open("strips", "", &Principal::owner(), Client::Server).await })
    };
    let first_opening = open();
    // The second opening starts while the first one is in the loader. It has 50 ms to arrive before the first one
    // fails.
    while source.open_count.load(std::sync::atomic::Ordering::SeqCst) == 0 {
        tokio::time::sleep(std::time::Duration::from_millis(1)).await;
    }
    let second_opening = open();
    tokio::time::sleep(std::time::Duration::from_millis(50)).await;
    fail_sender.send(()).expect("expected a waiting source");
    assert!(with_timeout(first_opening).await.expect("expected the task not to panic").is_err());
    with_timeout(second_opening).await.expect("expected the task not to panic").expect("expected the scene to open");
    server.engine.find("strips").expect("expected an open scene");
    server.engine.close("strips", &Principal::owner()).await.expect("expected the scene to close");
    server
        .engine
        .open("other", "strips", &Principal::owner(), Client::Server)
        .await
        .expect("expected the name to be free after closing");
}

/// A description of all domains of a scene.
#[derive(Default)]
struct Description {
    shapes: Vec<v1::ShapeDescription>,
    domains: Vec<v1::DomainDescription>,
    /// The bytes of every requested array of every shape.
    array_bytes: Vec<Vec<u8>>,
}

async fn describe(server: &Server, scene: &str, arrays: &[Array]) -> Description {
    let arrays = arrays.iter().map(|array| (*array).into()).collect();
    let request = v1::DescribeSceneRequest { scene: scene.into(), arrays, ..Default::default() };
    let mut stream = server.scenes().await.describe_scene(request).await.expect("expected a description").into_inner();
    let mut description = Description::default();
    while let Some(response) = with_timeout(stream.message()).await.expect("expected another message") {
        assert!(response.encoded_len() <= MAX_MESSAGE_BYTES);
        match response.part.expect("expected a part") {
            Part::Scene(info) => assert_eq!(info.scene, scene),
            Part::Shapes(part) => description.shapes.extend(part.shapes),
            Part::Domains(part) => description.domains.extend(part.domains),
            Part::Materials(part) => assert_eq!(part.materials.len(), 1),
            Part::Textures(part) => panic!("expected no textures, got {part:?}"),
            Part::Chunk(chunk) => {
                if chunk.offset == 0 {
                    description.array_bytes.push(Vec::new());
                }
                let array = description.array_bytes.last_mut().expect("expected an array that starts at offset 0");
                assert_eq!(chunk.offset, array.len() as u64);
                array.extend_from_slice(&chunk.data);
                assert!(array.len() as u64 <= chunk.total);
            }
        }
    }
    description
}

/// Reads the rows of U of some vertices, or of all vertices if the list is empty. Numbers are ordered by vertex, axis
/// and mode.
async fn read_modes(server: &Server, scene: &str, domain: u32, vertices: &[u32]) -> Vec<f32> {
    let request = v1::ReadModesRequest { scene: scene.into(), domain, vertices: vertices.to_vec() };
    let mut stream = server.scenes().await.read_modes(request).await.expect("expected rows of U").into_inner();
    let mut bytes = Vec::new();
    let mut total = 0;
    while let Some(response) = with_timeout(stream.message()).await.expect("expected another message") {
        assert!(response.encoded_len() <= MAX_MESSAGE_BYTES);
        assert_eq!(response.offset, bytes.len() as u64);
        bytes.extend_from_slice(&response.data);
        total = response.total;
    }
    assert_eq!(total, bytes.len() as u64);
    bytemuck::pod_collect_to_vec(&bytes)
}

#[tokio::test(flavor = "multi_thread")]
async fn client_can_read_the_whole_scene() {
    let server = Server::start_default().await;
    let info = server.open("strips").await;
    assert_eq!((info.domains, info.vertices, info.corners, info.triangles, info.coordinates), (2, 8, 8, 4, 4));
    assert_eq!((info.up.as_str(), info.unit, info.last_step), ("y", 1.0, None));
    let arrays = [Array::Indices, Array::CornerVertices, Array::RestPositions, Array::Uvs, Array::RestNormals];
    let Description { shapes, domains, array_bytes } = describe(&server, "strips", &arrays).await;
    let scene = strips();
    let mesh = &scene.shapes[0].mesh;
    let expected_bytes: [Vec<u8>; 5] = [
        bytemuck::cast_slice(mesh.triangles()).to_vec(),
        bytemuck::cast_slice(&mesh.corners().vertices).to_vec(),
        bytemuck::cast_slice(mesh.rest_positions()).to_vec(),
        bytemuck::cast_slice(&mesh.corners().uvs).to_vec(),
        bytemuck::cast_slice(&mesh.corners().normals).to_vec(),
    ];
    // The two domains have the same shape.
    assert_eq!(array_bytes, expected_bytes);
    let [shape] = shapes.as_slice() else { panic!("{shapes:?}") };
    assert_eq!((shape.vertices, shape.rank, shape.eigenvalues.as_slice()), (4, 2, [1.0, 4.0].as_slice()));
    let [left, right] = domains.as_slice() else { panic!("{domains:?}") };
    assert_eq!((left.name.as_str(), left.parent, left.notes["species"].as_str()), ("left", None, "none"));
    assert_eq!(
        (right.name.as_str(), right.parent, right.attachment_vertices.as_slice()),
        ("right", Some(0), [1, 3].as_slice())
    );
    // A transform of 3 x 4 numbers in f32 has 48 bytes.
    assert_eq!((right.attachment_frame.len(), right.placement.len(), right.shape), (48, 48, 0));
    let modes = &scene.shapes[0].modes;
    let rows = |vertex: usize| (0..3).flat_map(move |axis| (0..2).map(move |mode| modes.entry(vertex, axis, mode)));
    assert_eq!(read_modes(&server, "strips", 1, &[3, 0]).await, rows(3).chain(rows(0)).collect::<Vec<_>>());
}

#[tokio::test(flavor = "multi_thread")]
async fn description_contains_followed_domains_and_frames() {
    let server = Server::start_default().await;
    server.open("twig").await;
    let Description { domains, .. } = describe(&server, "twig", &[]).await;
    assert_eq!(domains.iter().map(|domain| domain.follows).collect::<Vec<_>>(), [None, None, Some(1), Some(2)]);
    assert_eq!(domains.iter().map(|domain| domain.follow_frame.len()).collect::<Vec<_>>(), [0, 0, 48, 48]);
    assert_eq!(
        domains[2].placement, domains[2].follow_frame,
        "expected the placement to equal the follow frame, because the followed domain is at the world origin"
    );
    assert_ne!(
        domains[3].placement, domains[3].follow_frame,
        "expected the placement of the leaflet in the world, not relative to the leaf"
    );
}

#[tokio::test(flavor = "multi_thread")]
async fn large_replies_are_chunked_for_default_client_limits() {
    let server = Server::start_default().await;
    server.open("sheet").await;
    let scene = sheet();
    let Description { array_bytes, .. } = describe(&server, "sheet", &[Array::Indices, Array::RestPositions]).await;
    let mesh = &scene.shapes[0].mesh;
    assert_eq!(array_bytes[0], bytemuck::cast_slice::<_, u8>(mesh.triangles()));
    assert_eq!(array_bytes[1], bytemuck::cast_slice::<_, u8>(mesh.rest_positions()));
    let rows = read_modes(&server, "sheet", 0, &[]).await;
    let modes = &scene.shapes[0].modes;
    assert_eq!(rows.len(), modes.columns().len());
    // A vertex has three rows of four modes. Number 7 is mode 3 of axis 1.
    assert!((0..90_000).all(|vertex| rows[12 * vertex + 7] == modes.entry(vertex, 1, 3)));
    let request = v1::GetVerticesRequest { scene: "sheet".into(), ..v1::GetVerticesRequest::default() };
    let reply = get_vertices(&server, request).await.expect("expected vertices");
    assert_eq!(reply.step().run, 0, "expected run 0 before the first step");
    let expected = reference_vertices(&scene, &[]);
    assert_eq!((reply.positions, reply.normals), (expected.positions, expected.normals));
}

#[tokio::test(flavor = "multi_thread")]
async fn openings_share_one_scene_and_deletion_ends_its_streams() {
    let server = Server::start_default().await;
    let infos = tokio::join!(server.open("strips"), server.open("strips"), server.open("strips"));
    assert!(infos.0 == infos.1 && infos.1 == infos.2, "expected the same scene three times, got {infos:?}");
    let list = server
        .scenes()
        .await
        .list_scenes(v1::ListScenesRequest {})
        .await
        .expect("expected a list of scenes")
        .into_inner();
    assert_eq!(list.scenes.iter().map(|scene| scene.scene.as_str()).collect::<Vec<_>>(), ["strips"]);
    assert_eq!(list.sources, ["panic", "sheet", "strips"]);
    let request = v1::StreamVerticesRequest {
        scene: "strips".into(),
        delivery: v1::Delivery::Latest.into(),
        ..v1::StreamVerticesRequest::default()
    };
    let mut stream =
        server.vertices().await.stream_vertices(request).await.expect("expected a subscription").into_inner();
    let mut writer = server.drive_lossless("strips").await;
    let delete_request = v1::DeleteSceneRequest { scene: "strips".into() };
    server.scenes().await.delete_scene(delete_request).await.expect("expected the deletion to succeed");
    let status = next_vertices(&mut stream).await.expect_err("expected a deleted-scene error");
    assert_eq!((status.code(), rejection_details(&status).given.as_str()), (tonic::Code::NotFound, "'strips'"));
    let status = with_timeout(writer.replies.message()).await.expect_err("expected a deleted-scene error");
    assert_eq!(status.code(), tonic::Code::NotFound);
    server.open("strips").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn scene_above_the_limit_opens_only_after_a_deletion() {
    let server = Server::start_with(|config| modalcast::config::Config { open_scenes: 1, ..config }).await;
    server.open("strips").await;
    let second_scene = v1::OpenSceneRequest { source: "sheet".into(), scene: String::new() };
    let status = server.scenes().await.open_scene(second_scene).await.expect_err("expected a scene-limit error");
    assert_eq!(
        (status.code(), rejection_details(&status).expected.as_str()),
        (tonic::Code::ResourceExhausted, "at most 1 open scenes")
    );
    server
        .scenes()
        .await
        .delete_scene(v1::DeleteSceneRequest { scene: "strips".into() })
        .await
        .expect("expected the deletion to succeed");
    server.open("sheet").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn server_without_renderer_rejects_only_frames() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut client = v1::server_service_client::ServerServiceClient::new(server.channel().await);
    let info =
        client.get_server_info(v1::GetServerInfoRequest {}).await.expect("expected the server info").into_inner();
    assert_eq!((info.backend.as_str(), info.software), ("reference", false));
    assert!(info.renderer.contains("switched off"), "{}", info.renderer);
    assert_eq!(info.protocol_version, v1::PROTOCOL_VERSION);
    assert!(!info.features.contains(&v1::Feature::Frames.into()), "{:?}", info.features);
    let limits = info.limits.expect("expected the limits");
    // 1 MiB is the setting of `config`, the others are defaults.
    assert_eq!((limits.message_bytes, limits.window, limits.scenes), (1 << 20, 256, 16));
    let request = v1::StreamFramesRequest {
        scene: "strips".into(),
        delivery: v1::Delivery::Latest.into(),
        ..v1::StreamFramesRequest::default()
    };
    let status = server.frames().await.stream_frames(request).await.expect_err("expected an error without a renderer");
    assert_eq!(status.code(), tonic::Code::Unavailable);
    assert!(rejection_details(&status).given.contains("switched off"));
}

#[tokio::test(flavor = "multi_thread")]
async fn health_and_reflection_answer_and_stop_ends_streams() {
    use tonic_health::pb::health_check_response::ServingStatus;
    use tonic_reflection::pb::v1::ServerReflectionRequest;
    use tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient;
    use tonic_reflection::pb::v1::server_reflection_request::MessageRequest;
    use tonic_reflection::pb::v1::server_reflection_response::MessageResponse;
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut health = tonic_health::pb::health_client::HealthClient::new(server.channel().await);
    for service in ["", "modalcast.v1.StepService"] {
        let request = tonic_health::pb::HealthCheckRequest { service: service.into() };
        let status = health.check(request).await.expect("expected a reply").into_inner();
        assert_eq!(status.status(), ServingStatus::Serving);
    }
    let request = ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut client = ServerReflectionClient::new(server.channel().await);
    let mut replies =
        client.server_reflection_info(tokio_stream::iter([request])).await.expect("expected a reply").into_inner();
    let reply = replies.next().await.expect("expected a reply").expect("expected a valid reply").message_response;
    let Some(MessageResponse::ListServicesResponse(list)) = reply else { panic!("{reply:?}") };
    let names: Vec<_> = list.service.into_iter().map(|service| service.name).collect();
    for service in ["modalcast.v1.SceneService", "modalcast.v1.FrameService", "grpc.health.v1.Health"] {
        assert!(names.iter().any(|name| name == service), "{service} is not in {names:?}");
    }
    let mut writer = server.drive_lossless("strips").await;
    writer.send_step_and_wait(crate::service_harness::step(1, &[0], &[0.0, 0.0])).await;
    let health_stream = health.watch(tonic_health::pb::HealthCheckRequest { service: String::new() }).await;
    let mut health_stream = health_stream.expect("expected a health stream").into_inner();
    let first_status = health_stream.message().await.expect("expected a reply").expect("expected a message");
    assert_eq!(first_status.status(), ServingStatus::Serving);
    // The health stream and the step stream end when the server stops.
    let read_until_stop = async {
        let last_status = with_timeout(health_stream.message()).await;
        let last_status = last_status.expect("expected a reply").expect("expected a message");
        assert_eq!(last_status.status(), ServingStatus::NotServing);
        let status = with_timeout(writer.replies.message()).await.expect_err("expected the stream to end");
        assert_eq!(status.code(), tonic::Code::Unavailable);
        // The server waits until its clients have disconnected.
        drop((health_stream, writer, health, client, replies));
    };
    let (result, ()) = tokio::join!(server.stop(), read_until_stop);
    result.expect("expected the server to stop without an error");
}
