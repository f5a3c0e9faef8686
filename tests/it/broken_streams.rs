//! Calls that break off in the middle: the client cancels them, or its connection is closed as by `kill -9` of the
//! client. The server releases everything that the calls held.

use std::fmt::Debug;
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use modalcast::config::{BackendChoice, Config, RendererChoice};
use modalcast::engine::ShapeArray;
use modalcast::identity::Principal;
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::{mpsc, watch};
use tokio_stream::StreamExt as _;
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use tonic::transport::Channel;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::scene_service_client::SceneServiceClient;
use v1::vertex_service_client::VertexServiceClient;
use v1::{Delivery, Reason};

use crate::message_streams::{MessageSizes, StreamKind, message_sizes};
use crate::service_harness::{
    DEFAULT_WINDOW, Server, StepWriter, config, get_vertices, minimum_step, reference_vertices, rejection_details,
    step, strips, with_timeout,
};

/// Pause between two attempts of a poll.
const POLL_INTERVAL: Duration = Duration::from_millis(5);

/// How a call breaks off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Break {
    /// The client cancels the call. Its connection remains.
    Cancel,
    /// The connection is closed while data are in flight.
    Close,
}

const BREAKS: [Break; 2] = [Break::Cancel, Break::Close];

/// Forwards connections to a server until all of them are closed at once.
struct Proxy {
    address: String,
    close_sender: watch::Sender<bool>,
}

impl Proxy {
    async fn start(server: &Server) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("expected a free port");
        let address = format!("http://{}", listener.local_addr().expect("expected a socket address"));
        let server_address = server.address.trim_start_matches("http://").to_owned();
        let close_sender = watch::Sender::new(false);
        let close_receiver = close_sender.subscribe();
        tokio::spawn(async move {
            while let Ok((mut client, _)) = listener.accept().await {
                let mut upstream = TcpStream::connect(&server_address).await.expect("expected a server");
                let mut close_receiver = close_receiver.clone();
                tokio::spawn(async move {
                    tokio::select! {
                        _ = tokio::io::copy_bidirectional(&mut client, &mut upstream) => {}
                        _ = close_receiver.wait_for(|is_closed| *is_closed) => {}
                    }
                });
            }
        });
        Self { address, close_sender }
    }

    async fn channel(&self) -> Channel {
        let endpoint = Channel::from_shared(self.address.clone()).expect("expected a URL");
        endpoint.connect().await.expect("expected a connection")
    }

    /// Breaks calls off. `calls` are dropped afterwards in both cases.
    fn break_off<T>(&self, how: Break, calls: T) {
        if how == Break::Close {
            self.close_sender.send_replace(true);
        }
        drop(calls);
    }
}

/// Polls until `attempt` returns a value.
async fn poll<T>(mut attempt: impl AsyncFnMut() -> Option<T>) -> T {
    let attempts = async {
        loop {
            if let Some(value) = attempt().await {
                return value;
            }
            tokio::time::sleep(POLL_INTERVAL).await;
        }
    };
    with_timeout(attempts).await
}

fn reason_of<T>(result: Result<T, Status>) -> Reason {
    rejection_details(&result.err().expect("expected an error")).reason()
}

/// The broken subscriptions use up the limit of the scene. They are lossless and unread, so they block the writer until
/// the server releases them.
#[tokio::test(flavor = "multi_thread")]
async fn broken_streams_release_their_subscriptions() {
    let limits =
        |config| Config { backend: BackendChoice::Cpu, renderer: RendererChoice::Auto, max_subscribers: 1, ..config };
    let server = Server::start_with(limits).await;
    server.open("sheet").await;
    let scene_handle = server.engine.find("sheet").expect("expected an open scene");
    let direct_channel = server.channel().await;
    let mut writer = server.drive("sheet", Delivery::Lossless, 16).await;
    let mut number = 0;
    for (kind, how) in StreamKind::ALL.iter().flat_map(|kind| BREAKS.map(|how| (*kind, how))) {
        let subscribe = async |channel: &Channel| kind.subscribe(channel, "sheet", Delivery::Lossless).await;
        let proxy = Proxy::start(&server).await;
        let channel = proxy.channel().await;
        // A scene admits 32 force streams. The limit of other streams is `max_subscribers`.
        let limit = if kind == StreamKind::Forces { 32 } else { 1 };
        let mut streams: Vec<MessageSizes> = Vec::new();
        while streams.len() < limit {
            streams.push(poll(async || subscribe(&channel).await.ok()).await);
        }
        let refused = subscribe(&channel).await;
        assert_eq!(reason_of(refused), Reason::LimitReached, "control: {kind:?}");
        for stream in &mut streams {
            with_timeout(stream.next()).await.expect("expected a first message").expect("expected no error");
        }
        let steps = number + 1..=number + 8;
        for number in steps.clone() {
            writer.send_step(step(number, &[0], &[number as f32, 0.5, 0.0, 0.0])).await;
        }
        number = *steps.end();
        proxy.break_off(how, streams);
        for number in steps {
            let reply = writer.receive_reply().await;
            assert!(matches!(&reply, ResponseKind::Ack(ack) if ack.step == number), "{kind:?} {how:?}: {reply:?}");
        }
        // Otherwise the next client would preempt a broken one.
        let is_free = async || (scene_handle.subscription_count() == 0).then_some(());
        poll(is_free).await;
        drop(poll(async || subscribe(&direct_channel).await.ok()).await);
        poll(is_free).await;
    }
    assert_eq!(server.preempted("subscriptions"), 0, "expected only free permits");
}

/// The scene admits one waiting request.
#[tokio::test(flavor = "multi_thread")]
async fn broken_requests_stop_waiting() {
    let server = Server::start_with(|config| Config { max_pending_requests: 1, ..config }).await;
    server.open("strips").await;
    let scene_handle = server.engine.find("strips").expect("expected an open scene");
    let request = || v1::GetVerticesRequest { scene: "strips".into(), step: minimum_step(99), ..Default::default() };
    // A request without a reply after 20 poll intervals counts as admitted.
    let try_wait = async |channel: &Channel| {
        let mut client = VertexServiceClient::new(channel.clone());
        let mut reply = client.get_vertices(request()).await.map(message_sizes)?;
        match tokio::time::timeout(20 * POLL_INTERVAL, reply.next()).await {
            Ok(message) => Err(message.expect("expected an error").expect_err("expected no vertices")),
            Err(_) => Ok(reply),
        }
    };
    let direct_channel = server.channel().await;
    for how in [Break::Cancel, Break::Close, Break::Cancel] {
        let proxy = Proxy::start(&server).await;
        let channel = proxy.channel().await;
        let waiting = poll(async || try_wait(&channel).await.ok()).await;
        assert_eq!(reason_of(try_wait(&channel).await), Reason::QueueFull, "control: {how:?}");
        proxy.break_off(how, waiting);
        poll(async || (scene_handle.waiting_request_count() == 0).then_some(())).await;
    }
    drop(poll(async || try_wait(&direct_channel).await.ok()).await);
    assert_eq!(server.preempted("waiting_requests"), 0, "expected only free permits");
}

/// While the arrays of a description are unread, its call holds a reference to the scene.
#[tokio::test(flavor = "multi_thread")]
async fn broken_replies_of_arrays_release_the_scene() {
    let server = Server::start_default().await;
    server.open("sheet").await;
    let scene_handle = server.engine.find("sheet").expect("expected an open scene");
    let hashes = scene_handle.content_hashes().await.expect("expected hashes");
    // The modes have 4 MB.
    let sha256 = vec![hashes.of_shape(0)[ShapeArray::Modes as usize].to_vec().into(); 8];
    let references = || Arc::strong_count(&scene_handle);
    let unused_references = references();
    let describe =
        v1::DescribeSceneRequest { scene: "sheet".into(), arrays: vec![1, 2, 3, 4, 5, 6], ..Default::default() };
    let content = v1::ReadContentRequest { scene: "sheet".into(), sha256 };
    let modes = v1::ReadModesRequest { scene: "sheet".into(), ..Default::default() };
    for how in BREAKS {
        let proxy = Proxy::start(&server).await;
        let channel = proxy.channel().await;
        let mut calls: Vec<MessageSizes> = Vec::new();
        for _ in 0..4 {
            let mut client = SceneServiceClient::new(channel.clone());
            let expected = "expected a reply";
            calls.push(message_sizes(client.describe_scene(describe.clone()).await.expect(expected)));
            calls.push(message_sizes(client.read_content(content.clone()).await.expect(expected)));
            calls.push(message_sizes(client.read_modes(modes.clone()).await.expect(expected)));
        }
        // Control: every call holds the scene.
        poll(async || (references() == unused_references + calls.len()).then_some(())).await;
        proxy.break_off(how, calls);
        poll(async || (references() == unused_references).then_some(())).await;
    }
}

/// The next writer needs no lease token, and finds the state after a complete step.
#[tokio::test(flavor = "multi_thread")]
async fn broken_writer_releases_its_lease_after_a_whole_step() {
    const STEPS: u64 = 200;
    let server = Server::start_default().await;
    server.open("strips").await;
    let steps: Vec<v1::Step> =
        (1..=STEPS).map(|number| step(number, &[], &[number as f32, 0.5, -(number as f32), 0.25])).collect();
    let mut last_run = 0;
    for how in [BREAKS, BREAKS].concat() {
        let proxy = Proxy::start(&server).await;
        let channel = proxy.channel().await;
        let (mut writer, _) = poll(async || open_writer(&channel).await).await;
        for step in &steps {
            writer.send_step(step.clone()).await;
        }
        let is_half_done = |reply| matches!(reply, ResponseKind::Ack(ack) if ack.step >= STEPS / 2);
        while !is_half_done(writer.receive_reply().await) {}
        proxy.break_off(how, writer);
        let (next_writer, opened) = poll(async || open_writer(&server.channel().await).await).await;
        let request = v1::GetVerticesRequest { scene: "strips".into(), ..Default::default() };
        let vertices = get_vertices(&server, request).await.expect("expected vertices");
        let last_step = opened.scene.and_then(|scene| scene.last_step).expect("expected a last step");
        assert_eq!(vertices.step(), last_step, "expected no step of the broken writer after the next writer opened");
        assert!(
            last_step.run < opened.run && last_step.run > last_run && last_step.number >= STEPS / 2,
            "{last_step:?}"
        );
        let expected = reference_vertices(&strips(), &steps[..last_step.number as usize]);
        assert_eq!(vertices.positions, expected.positions, "{how:?}");
        last_run = opened.run;
        next_writer.finish().await;
    }
}

/// Opens a lossless step stream; `None` if another writer has the lease.
async fn open_writer(channel: &Channel) -> Option<(StepWriter, v1::Opened)> {
    let mut writer = StepWriter::connect(channel.clone()).await;
    match writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await {
        ResponseKind::Opened(opened) => Some((writer, opened)),
        _ => None,
    }
}

const TRIANGLE: &[u8] = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

/// The messages of an upload of one OBJ file.
fn file_upload() -> Vec<v1::UploadSceneRequest> {
    use v1::upload_scene_request::Part;
    let bytes = TRIANGLE.len() as u64;
    let header = v1::UploadHeader { scene: "up".into(), entry: "mesh.obj".into(), files: 1, total_bytes: bytes };
    let sha256 = Sha256::digest(TRIANGLE).to_vec().into();
    let file = v1::UploadFile { path: "mesh.obj".into(), bytes, sha256, reuse: false };
    let (first_half, second_half) = TRIANGLE.split_at(TRIANGLE.len() / 2);
    let parts =
        [Part::Header(header), Part::File(file), Part::Chunk(first_half.into()), Part::Chunk(second_half.into())];
    parts.into_iter().map(|part| v1::UploadSceneRequest { part: Some(part) }).collect()
}

/// The messages of an upload of one triangle as arrays.
fn array_upload() -> Vec<v1::UploadArraysRequest> {
    use v1::upload_arrays_request::Part;
    let header = v1::UploadArraysHeader { scene: "up".into(), domains: 1, total_bytes: 48, ..Default::default() };
    let domain = v1::UploadedDomain { name: "a".into(), vertices: 3, triangles: 1, ..Default::default() };
    let positions = [0.0_f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let (positions, indices) =
        (bytemuck::cast_slice(&positions).to_vec(), bytemuck::cast_slice(&[0_u32, 1, 2]).to_vec());
    let parts =
        [Part::Header(header), Part::Domain(domain), Part::Chunk(positions.into()), Part::Chunk(indices.into())];
    parts.into_iter().map(|part| v1::UploadArraysRequest { part: Some(part) }).collect()
}

/// Uploads without the last message, breaks off, and then uploads all messages under the same name.
async fn break_upload<T, F>(
    server: &Server,
    how: Break,
    messages: Vec<T>,
    upload: impl Fn(Channel, ReceiverStream<T>) -> F,
) where
    T: Clone + Debug + Send + 'static,
    F: Future<Output = Result<v1::SceneInfo, Status>> + Send + 'static,
{
    let uploads = server.engine.config().state.join("uploads");
    let folder_count = |path: &Path| std::fs::read_dir(path).expect("expected an uploads folder").count();
    let proxy = Proxy::start(server).await;
    let (sender, requests) = mpsc::channel(messages.len());
    let call = tokio::spawn(upload(proxy.channel().await, ReceiverStream::new(requests)));
    for message in &messages[..messages.len() - 1] {
        sender.send(message.clone()).await.expect("expected an open stream");
    }
    poll(async || (folder_count(&uploads) > 0).then_some(())).await;
    match how {
        Break::Cancel => call.abort(),
        Break::Close => proxy.break_off(how, ()),
    }
    match with_timeout(call).await {
        Ok(result) => assert!(result.is_err() && how == Break::Close, "expected a broken upload"),
        Err(error) => assert!(error.is_cancelled() && how == Break::Cancel, "{error}"),
    }
    // Dropped only now, because dropping the sender ends the call regularly.
    drop(sender);
    poll(async || (folder_count(&uploads) == 0).then_some(())).await;
    assert!(server.engine.find("up").is_err(), "expected no part of the scene");
    let (sender, requests) = mpsc::channel(messages.len());
    for message in messages {
        sender.send(message).await.expect("expected an open stream");
    }
    drop(sender);
    let info = with_timeout(upload(server.channel().await, ReceiverStream::new(requests))).await;
    assert_eq!(info.expect("expected the whole upload to succeed").vertices, 3);
    with_timeout(server.engine.close("up", &Principal::owner())).await.expect("expected the scene to close");
}

#[tokio::test(flavor = "multi_thread")]
async fn broken_uploads_leave_no_files_and_no_scene() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let repository = SceneRepository::new(None).expect("expected a repository");
    let config = config(folder.path());
    let server = Server::start_from(config, Arc::new(repository)).await;
    for how in BREAKS {
        break_upload(&server, how, file_upload(), |channel, requests| async {
            let reply = SceneServiceClient::new(channel).upload_scene(requests).await?;
            Ok(reply.into_inner().scene.expect("expected the scene info"))
        })
        .await;
        break_upload(&server, how, array_upload(), |channel, requests| async {
            let reply = SceneServiceClient::new(channel).upload_arrays(requests).await?;
            Ok(reply.into_inner().scene.expect("expected the scene info"))
        })
        .await;
    }
}
