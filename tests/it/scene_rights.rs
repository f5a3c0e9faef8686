//! Who may use a scene: its owner, those with whom it is shared, and strangers.

use std::collections::BTreeSet;

use modalcast::identity::Role;
use modalcast_client::{Client, ConnectOptions, Error};
use modalcast_proto::v1;
use prost::Message as _;
use tonic::transport::Channel;
use tonic::{Code, Status};
use v1::drive_scene_response::Kind as ResponseKind;
use v1::scene_service_client::SceneServiceClient;
use v1::state_service_client::StateServiceClient;
use v1::step_service_client::StepServiceClient;

use crate::identity::{GuardedServer, call, token_of_name, with_token, write_named_principals};
use crate::service_harness::with_timeout;

const SCENE: &str = "strips";
const ABSENT: &str = "absent";

/// `anna` owns the scene, which is shared with `ben` and not with `zoe`. `root` has the role `admin`.
const PRINCIPALS: [(&str, Role); 4] =
    [("anna", Role::Upload), ("ben", Role::Upload), ("zoe", Role::Upload), ("root", Role::Admin)];

async fn start() -> GuardedServer {
    let guarded = GuardedServer::start_with(|config| {
        let path = config.principals.as_deref().expect("expected a file of principals");
        write_named_principals(path, &PRINCIPALS);
        config
    })
    .await;
    let anna = client(&guarded, "anna").await;
    anna.open_scene(SCENE, "").await.expect("expected a scene");
    anna.share_scene(SCENE, &["ben"]).await.expect("expected a shared scene");
    guarded
}

async fn client(guarded: &GuardedServer, name: &str) -> Client {
    let options = ConnectOptions::default().with_token(token_of_name(name));
    let url = format!("http://{}", guarded.server.address.trim_start_matches("http://"));
    Client::connect_with(&url, &options).await.expect("expected a connection")
}

/// What a call needs.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Right {
    Use,
    Control,
}

/// Calls of all methods that name a scene, except `DriveScene`, whose errors are messages. The last ones end the sharing
/// or the scene.
fn calls() -> Vec<(&'static str, Vec<u8>, Right)> {
    use Right::{Control, Use};
    let scene = || SCENE.to_owned();
    let [latest, lossless] = [v1::Delivery::Latest, v1::Delivery::Lossless].map(i32::from);
    // The field `scene` of the other requests has the number 1, too.
    let named = v1::GetStateRequest { scene: scene(), ..Default::default() }.encode_to_vec();
    let frames = |delivery| v1::StreamFramesRequest { scene: scene(), delivery, ..Default::default() }.encode_to_vec();
    let vertices =
        |delivery| v1::StreamVerticesRequest { scene: scene(), delivery, ..Default::default() }.encode_to_vec();
    let views = v1::OpenViews { scene: scene(), ..Default::default() };
    let kind = Some(v1::draw_views_request::Kind::Open(views));
    let views = v1::DrawViewsRequest { kind }.encode_to_vec();
    let states = |delivery| v1::StreamStatesRequest { scene: scene(), delivery, ..Default::default() }.encode_to_vec();
    vec![
        ("modalcast.v1.FrameService/RenderFrame", named.clone(), Use),
        ("modalcast.v1.FrameService/StreamFrames", frames(latest), Use),
        ("modalcast.v1.FrameService/StreamFrames", frames(lossless), Control),
        ("modalcast.v1.FrameService/Pick", named.clone(), Use),
        ("modalcast.v1.SceneService/DescribeScene", named.clone(), Use),
        ("modalcast.v1.SceneService/ReadContent", named.clone(), Use),
        ("modalcast.v1.SceneService/ReadModes", named.clone(), Use),
        ("modalcast.v1.VertexService/GetVertices", named.clone(), Use),
        ("modalcast.v1.VertexService/StreamVertices", vertices(latest), Use),
        ("modalcast.v1.VertexService/StreamVertices", vertices(lossless), Control),
        ("modalcast.v1.StateService/GetState", named.clone(), Use),
        ("modalcast.v1.StateService/StreamStates", states(latest), Use),
        ("modalcast.v1.StateService/StreamStates", states(lossless), Control),
        ("modalcast.v1.ViewService/DrawViews", views, Use),
        ("modalcast.v1.ForceService/StreamForces", named.clone(), Use),
        ("modalcast.v1.ForceService/ApplyForces", named.clone(), Use),
        ("modalcast.v1.StepService/ResetScene", named.clone(), Control),
        ("modalcast.v1.SceneService/ShareScene", named.clone(), Control),
        ("modalcast.v1.SceneService/DeleteScene", named, Control),
    ]
}

/// Methods without the name of an existing scene.
const WITHOUT_SCENE: [&str; 13] = [
    "grpc.health.v1.Health/Check",
    "grpc.health.v1.Health/Watch",
    "grpc.reflection.v1.ServerReflection/ServerReflectionInfo",
    "grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo",
    "modalcast.v1.ServerService/GetServerInfo",
    "modalcast.v1.ServerService/CreateViewerLink",
    "modalcast.v1.ServerService/ListClients",
    "modalcast.v1.ServerService/EndClient",
    "modalcast.v1.SceneService/ListScenes",
    "modalcast.v1.SceneService/OpenScene",
    "modalcast.v1.SceneService/FindUploadedFiles",
    "modalcast.v1.SceneService/UploadScene",
    "modalcast.v1.SceneService/UploadArrays",
];

#[test]
fn every_method_with_a_scene_is_called() {
    let page = include_str!("../../deploy/identity.md");
    let method_of = |line: &'static str| line.strip_prefix("| `")?.split_once("` | ").map(|(method, _)| method);
    let documented: BTreeSet<_> = page.lines().filter_map(method_of).filter(|method| method.contains('/')).collect();
    let others = ["modalcast.v1.StepService/DriveScene", "modalcast.v1.FrameService/UpdateFrameStream"];
    let called = calls().into_iter().map(|(method, ..)| method);
    assert_eq!(documented, called.chain(WITHOUT_SCENE).chain(others).collect());
}

/// A stranger gets the answer of a scene that does not exist.
#[tokio::test]
async fn calls_follow_the_rights_of_their_principal() {
    let guarded = start().await;
    let channel = guarded.channel().await;
    let status_of = async |name: &str, method: &str, message: &[u8]| {
        call(&channel, method, message, Some(&token_of_name(name))).await
    };
    for (method, message, right) in calls() {
        let stranger = status_of("zoe", method, &message).await;
        assert_eq!(stranger.code(), Code::NotFound, "{method} as a stranger: {stranger:?}");
        let missing = status_of("zoe", method, &with_absent_scene(&message)).await;
        assert_eq!(missing.message().replace(ABSENT, SCENE), stranger.message(), "{method}");
        let shared = status_of("ben", method, &message).await;
        let is_denied = shared.code() == Code::PermissionDenied;
        assert_eq!(is_denied, right == Right::Control, "{method} of a shared scene: {shared:?}");
        assert_ne!(shared.code(), Code::NotFound, "{method} of a shared scene: {shared:?}");
        let owner = status_of("anna", method, &message).await;
        let is_refused = |status: &Status| matches!(status.code(), Code::NotFound | Code::PermissionDenied);
        assert!(!is_refused(&owner), "{method} as the owner: {owner:?}");
        if method.ends_with("ShareScene") {
            let former = status_of("ben", method, &message).await;
            assert_eq!(former.code(), Code::NotFound, "expected that the scene is no longer shared: {former:?}");
            client(&guarded, "root").await.share_scene(SCENE, &["ben"]).await.expect("expected the rights of an admin");
        }
    }
}

/// The message with the name of an absent scene of the same length.
fn with_absent_scene(message: &[u8]) -> Vec<u8> {
    let name = |bytes: &[u8]| bytes == SCENE.as_bytes();
    let start = message.windows(SCENE.len()).position(name).expect("expected the name of the scene");
    let mut message = message.to_vec();
    message[start..start + SCENE.len()].copy_from_slice(ABSENT.as_bytes());
    message
}

/// The rejection of a stream that asks for the lease, or `None` if it gets the lease. The stream ends.
async fn drive(channel: &Channel, name: &str, open: v1::OpenDrive) -> Option<v1::Reason> {
    let open = v1::DriveSceneRequest { kind: Some(v1::drive_scene_request::Kind::Open(open)) };
    let request = with_token(tokio_stream::iter([open]), Some(&token_of_name(name)));
    let stream = StepServiceClient::new(channel.clone()).drive_scene(request).await;
    let reply = with_timeout(stream.expect("expected a stream").into_inner().message()).await;
    match reply.expect("expected a reply").and_then(|reply| reply.kind) {
        Some(ResponseKind::Opened(_)) => None,
        Some(ResponseKind::Rejection(rejection)) => Some(rejection.reason()),
        other => panic!("expected an answer to the request, got {other:?}"),
    }
}

#[tokio::test]
async fn shared_scene_is_driven_but_not_taken_over() {
    let guarded = start().await;
    let channel = guarded.channel().await;
    let token = bytes::Bytes::from_static(b"a token of 16 bytes");
    let open = |take_over: bool| v1::OpenDrive {
        scene: SCENE.into(),
        delivery: v1::Delivery::Latest.into(),
        lease_token: token.clone(),
        take_over,
        ..Default::default()
    };
    assert_eq!(drive(&channel, "zoe", open(false)).await, Some(v1::Reason::SceneNotFound));
    assert_eq!(drive(&channel, "ben", open(true)).await, Some(v1::Reason::PermissionDenied));
    assert_eq!(drive(&channel, "ben", open(false)).await, None);
    // Anna drives. Her token does not identify another principal.
    let (sender, requests) = tokio::sync::mpsc::channel(1);
    let request = with_token(tokio_stream::wrappers::ReceiverStream::new(requests), Some(&token_of_name("anna")));
    let kind = Some(v1::drive_scene_request::Kind::Open(v1::OpenDrive { take_over: true, ..open(false) }));
    sender.send(v1::DriveSceneRequest { kind }).await.expect("expected an open channel");
    let stream = StepServiceClient::new(channel.clone()).drive_scene(request).await;
    let mut stream = stream.expect("expected a stream").into_inner();
    with_timeout(stream.message()).await.expect("expected the lease");
    assert_eq!(drive(&channel, "ben", open(false)).await, Some(v1::Reason::WriterLeaseTaken));
    assert_eq!(drive(&channel, "anna", open(false)).await, None, "control: expected the token to identify its writer");
    drop(sender);
}

#[tokio::test]
async fn stream_ends_when_its_scene_is_no_longer_shared() {
    let guarded = start().await;
    let delivery = v1::Delivery::Latest.into();
    let request = v1::StreamStatesRequest { scene: SCENE.into(), delivery, ..Default::default() };
    let channel = guarded.channel().await;
    let open = async |name: &str| {
        let request = with_token(request.clone(), Some(&token_of_name(name)));
        let stream = StateServiceClient::new(channel.clone()).stream_states(request).await;
        let mut stream = stream.expect("expected a stream").into_inner();
        with_timeout(stream.message()).await.expect("expected the settings");
        stream
    };
    let (mut of_owner, mut shared) = (open("anna").await, open("ben").await);
    client(&guarded, "anna").await.share_scene(SCENE, &["zoe"]).await.expect("expected a shared scene");
    let status = loop {
        match with_timeout(shared.message()).await {
            Ok(message) => assert!(message.is_some(), "expected a status"),
            Err(status) => break status,
        }
    };
    assert_eq!(status.code(), Code::NotFound, "{status:?}");
    let next = tokio::time::timeout(std::time::Duration::from_millis(200), of_owner.message()).await;
    assert!(next.is_err() || next.is_ok_and(|message| message.is_ok()), "expected the stream of the owner to continue");
}

#[tokio::test]
async fn lists_and_names_hide_the_scenes_of_others() {
    let guarded = start().await;
    let names = async |name: &str| {
        let scenes = client(&guarded, name).await.list_scenes().await.expect("expected a list");
        scenes.scenes.into_iter().map(|scene| scene.scene).collect::<Vec<_>>()
    };
    assert_eq!(names("anna").await, [SCENE]);
    assert_eq!(names("ben").await, [SCENE]);
    assert_eq!(names("root").await, [SCENE]);
    assert!(names("zoe").await.is_empty());
    let error = client(&guarded, "zoe").await.open_scene(SCENE, "").await.expect_err("expected a taken name");
    assert!(matches!(&error, Error::Status { code: Code::AlreadyExists, .. }), "{error:?}");
    assert!(error.to_string().contains("a scene of another principal"), "{error}");
    let own = client(&guarded, "zoe").await.open_scene(SCENE, "strips-of-zoe").await.expect("expected a scene");
    assert_eq!(own.owner, "zoe");
    assert_eq!(names("zoe").await, ["strips-of-zoe"]);
    let shared = client(&guarded, "ben").await.open_scene(SCENE, "").await.expect("expected the shared scene");
    assert_eq!((shared.owner.as_str(), shared.shared_with), ("anna", vec!["ben".to_owned()]));
}

/// Contents of other principals are not found, so a hash alone neither tells of a file nor gives it.
#[tokio::test]
async fn uploaded_contents_are_found_only_by_their_principal() {
    let guarded = start().await;
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let file = folder.path().join("part.obj");
    // The server of the tests opens the source that the file names.
    let text = SCENE;
    std::fs::write(&file, text).expect("expected a writable folder");
    client(&guarded, "anna").await.upload_scene(&file, "part", "").await.expect("expected an uploaded scene");
    client(&guarded, "anna").await.share_scene("part", &["*"]).await.expect("expected a shared scene");
    let sha256: bytes::Bytes = {
        use sha2::Digest as _;
        sha2::Sha256::digest(text).to_vec().into()
    };
    let channel = guarded.channel().await;
    for (name, is_known) in [("anna", true), ("ben", false), ("root", false)] {
        let token = token_of_name(name);
        let mut scenes = SceneServiceClient::new(channel.clone());
        let request = v1::FindUploadedFilesRequest { sha256: vec![sha256.clone()] };
        let found = scenes.find_uploaded_files(with_token(request, Some(&token))).await.expect("expected an answer");
        assert_eq!(found.into_inner().found, [is_known], "{name}");
        let header = v1::UploadHeader {
            scene: format!("part-of-{name}"),
            entry: "part.obj".into(),
            files: 1,
            total_bytes: text.len() as u64,
        };
        let file =
            v1::UploadFile { path: "part.obj".into(), bytes: text.len() as u64, sha256: sha256.clone(), reuse: true };
        use v1::upload_scene_request::Part;
        let parts = [Part::Header(header), Part::File(file)].map(|part| v1::UploadSceneRequest { part: Some(part) });
        let uploaded = with_timeout(scenes.upload_scene(with_token(tokio_stream::iter(parts), Some(&token)))).await;
        assert_eq!(uploaded.is_ok(), is_known, "{name}: {uploaded:?}");
    }
}
