//! Byte budgets: half-sent messages and unread replies hold a bounded number of bytes, and clients that read and send
//! are served meanwhile.

use std::io::BufRead as _;
use std::pin::Pin;
use std::process::{Child, Command, Stdio};
use std::task::{Context, Poll};
use std::time::Duration;

use bytes::Bytes;
use http_body::Frame;
use modalcast::config::Config;
use modalcast_proto::v1;
use tonic::codegen::{Service as _, http};
use tonic::transport::{Channel, Endpoint};
use tonic::{Code, Status, Streaming};
use v1::scene_service_client::SceneServiceClient;
use v1::state_service_client::StateServiceClient;
use v1::{Delivery, Reason};

use crate::service_harness::{LONG_LIMITS, SILENCE_LIMIT, Server, StepWriter, rejection_details, step, with_timeout};

/// All arrays of a shape.
const ARRAYS: [v1::Array; 6] = [
    v1::Array::Indices,
    v1::Array::CornerVertices,
    v1::Array::RestPositions,
    v1::Array::Uvs,
    v1::Array::RestNormals,
    v1::Array::Modes,
];

fn describe(scene: &str) -> v1::DescribeSceneRequest {
    describe_arrays(scene, &ARRAYS)
}

fn describe_arrays(scene: &str, arrays: &[v1::Array]) -> v1::DescribeSceneRequest {
    let arrays = arrays.iter().map(|array| (*array).into()).collect();
    v1::DescribeSceneRequest { scene: scene.into(), arrays, ..Default::default() }
}

/// A connection that receives at most 64 KiB of each stream while the stream is not read.
async fn small_windows(address: &str) -> Channel {
    let endpoint = Endpoint::from_shared(address.to_owned()).expect("expected a URL");
    let endpoint = endpoint.initial_stream_window_size(1 << 16).initial_connection_window_size(1 << 26);
    endpoint.connect().await.expect("expected a connection")
}

/// Opens calls and reads nothing.
async fn open_unread_calls(channel: &Channel, scene: &str, count: usize) -> Vec<Streaming<v1::DescribeSceneResponse>> {
    let mut client = SceneServiceClient::new(channel.clone());
    let mut calls = Vec::new();
    for _ in 0..count {
        calls.push(with_timeout(client.describe_scene(describe(scene))).await.expect("expected a reply").into_inner());
    }
    calls
}

/// Reads a whole description and returns its number of bytes.
async fn read_description(channel: Channel, scene: &str, pause: Duration) -> Result<usize, Status> {
    use prost::Message as _;
    let mut replies = SceneServiceClient::new(channel).describe_scene(describe(scene)).await?.into_inner();
    let mut bytes = 0;
    while let Some(reply) = replies.message().await? {
        bytes += reply.encoded_len();
        tokio::time::sleep(pause).await;
    }
    Ok(bytes)
}

/// A request body: the header of a message, all but one of its bytes, and no end.
struct HalfSentMessage {
    data: Option<Bytes>,
}

impl HalfSentMessage {
    fn new(bytes: usize) -> Self {
        let header = [&[0], &(bytes as u32).to_be_bytes()[..]].concat();
        Self { data: Some([header, vec![1; bytes - 1]].concat().into()) }
    }
}

impl http_body::Body for HalfSentMessage {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(mut self: Pin<&mut Self>, _: &mut Context<'_>) -> Poll<Option<Result<Frame<Bytes>, Status>>> {
        match self.data.take() {
            Some(data) => Poll::Ready(Some(Ok(Frame::data(data)))),
            None => Poll::Pending,
        }
    }
}

/// Sends all but one byte of a request, and returns the status with which the server ends the call.
async fn send_half(mut channel: Channel, bytes: usize) -> Status {
    let request = http::Request::post("http://server/modalcast.v1.SceneService/OpenScene")
        .header("content-type", "application/grpc")
        .header("te", "trailers")
        .body(tonic::body::Body::new(HalfSentMessage::new(bytes)))
        .expect("expected a valid request");
    std::future::poll_fn(|cx| channel.poll_ready(cx)).await.expect("expected an open connection");
    let response = channel.call(request).await.expect("expected a response");
    Status::from_header_map(response.headers()).expect("expected a response with a status and no message")
}

/// Four of 40 half-sent messages fit into the share of their client. The others are rejected. Those that fit end
/// when they make no progress.
#[tokio::test(flavor = "multi_thread")]
async fn half_sent_messages_are_rejected_or_time_out() {
    const MESSAGE_BYTES: usize = 1 << 20;
    // A single client leaves a quarter for others.
    let receive_bytes = (4 * MESSAGE_BYTES + 100) * 4 / 3;
    let limits = |config| Config { receive_bytes, message_timeout: SILENCE_LIMIT, ..config };
    let server = Server::start_with(limits).await;
    server.open("strips").await;
    let channel = server.channel().await;
    let mut calls = tokio::task::JoinSet::new();
    for _ in 0..40 {
        calls.spawn(send_half(channel.clone(), MESSAGE_BYTES));
    }
    let mut rejected = 0;
    while let Some(status) = with_timeout(calls.join_next()).await {
        let status = status.expect("expected no panic");
        match (status.code(), rejection_details(&status).reason()) {
            (Code::ResourceExhausted, Reason::LimitReached) => rejected += 1,
            (Code::DeadlineExceeded, Reason::DeadlineExpired) => {}
            other => panic!("{other:?}: {status:?}"),
        }
    }
    // Fewer than 36 calls are rejected if some of them begin only after admitted calls have timed out.
    assert!(rejected >= 30, "expected at least 30 rejected calls, got {rejected}");
    let mut writer = StepWriter::connect(channel).await;
    writer.open("strips", Delivery::Lossless, 0).await;
    writer.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
}

/// Two connections hold the whole budget. For a third one, the connection that holds the most loses its message.
#[tokio::test(flavor = "multi_thread")]
async fn half_sent_messages_do_not_lock_out_other_connections() {
    let limits = |config| Config { receive_bytes: 2 << 20, ..config };
    let server = Server::start_with(limits).await;
    let mut large = tokio::spawn(send_half(server.channel().await, 1 << 20));
    let medium = tokio::spawn(send_half(server.channel().await, 3 << 18));
    // Names of 300 KB. The server rejects them after it has received them.
    let open_scene = async || {
        let request = v1::OpenSceneRequest { source: "x".repeat(300 << 10), scene: String::new() };
        server.scenes().await.open_scene(request).await.expect_err("expected an unknown source").code()
    };
    let until_evicted = async {
        loop {
            assert_ne!(open_scene().await, Code::ResourceExhausted);
            if large.is_finished() {
                return (&mut large).await.expect("expected no panic");
            }
        }
    };
    let status = with_timeout(until_evicted).await;
    assert_eq!((status.code(), rejection_details(&status).reason()), (Code::ResourceExhausted, Reason::Preempted));
    assert!(!medium.is_finished());
    medium.abort();
}

/// Reads the replies of a call up to its end, and returns its error.
async fn end_of_call(mut call: Streaming<v1::DescribeSceneResponse>) -> Option<Status> {
    loop {
        match with_timeout(call.message()).await {
            Ok(Some(_)) => {}
            Ok(None) => return None,
            Err(status) => return Some(status),
        }
    }
}

/// Six connections read slowly and two read nothing. All replies together have many times the bytes of the budget.
#[tokio::test(flavor = "multi_thread")]
async fn slow_readers_share_the_reply_budget_without_deadlock() {
    let (reply_bytes, reply_timeout) = (6 << 20, SILENCE_LIMIT);
    let limits = |config| Config { reply_bytes, connection_reply_bytes: reply_bytes, reply_timeout, ..config };
    let server = Server::start_with(limits).await;
    server.open("sheet").await;
    let mut stalled_calls = Vec::new();
    for _ in 0..2 {
        stalled_calls.extend(open_unread_calls(&small_windows(&server.address).await, "sheet", 2).await);
    }
    let mut readers = tokio::task::JoinSet::new();
    for _ in 0..6 {
        let channel = small_windows(&server.address).await;
        readers.spawn(async move { read_description(channel, "sheet", Duration::from_millis(1)).await });
    }
    let mut sizes = Vec::new();
    while let Some(result) = with_timeout(readers.join_next()).await {
        sizes.push(result.expect("expected no panic").expect("expected a complete description"));
    }
    assert!(sizes.iter().all(|size| *size == sizes[0] && *size > 6 << 20), "{sizes:?}");
    // Some of the unread calls or their connections have ended to make room.
    let mut ended = 0;
    for call in stalled_calls {
        ended += usize::from(end_of_call(call).await.is_some());
    }
    assert!(ended > 0, "expected an unread call to end");
}

/// Two connections hold the whole budget and read nothing. The reply timeout is too long to help a third one, so one of
/// the two is closed.
#[tokio::test(flavor = "multi_thread")]
async fn connection_above_its_share_is_closed_when_others_wait() {
    let (connection_reply_bytes, reply_bytes) = (6 << 20, 12 << 20);
    let limits = |config| Config { reply_bytes, connection_reply_bytes, ..config };
    let server = Server::start_with(limits).await;
    server.open("sheet").await;
    let mut unread_calls = Vec::new();
    for _ in 0..2 {
        unread_calls.extend(open_unread_calls(&small_windows(&server.address).await, "sheet", 3).await);
    }
    let channel = small_windows(&server.address).await;
    with_timeout(read_description(channel, "sheet", Duration::ZERO)).await.expect("expected a description");
    drop(unread_calls);
}

/// Three unread calls, each with 4.3 MB of modes, exhaust the budget of their connection. Each can hold up to 4 MiB:
/// two messages of 1 MiB in its queue and two in HTTP/2. When a fourth call waits, unread calls end with a reason, and
/// the fourth call gets the bytes of their queues. It reserves 3 MiB for its first part, the limit of a message, and
/// HTTP/2 keeps 6 MiB of the unread calls.
#[tokio::test(flavor = "multi_thread")]
async fn unread_calls_end_with_a_reason_when_others_wait() {
    let limits = |config| Config { connection_reply_bytes: 10 << 20, reply_timeout: SILENCE_LIMIT, ..config };
    let server = Server::start_with(limits).await;
    server.open("sheet").await;
    let channel = small_windows(&server.address).await;
    let mut client = SceneServiceClient::new(channel.clone());
    let mut unread_calls = Vec::new();
    for _ in 0..3 {
        let request = describe_arrays("sheet", &[v1::Array::Modes]);
        unread_calls.push(with_timeout(client.describe_scene(request)).await.expect("expected a reply").into_inner());
    }
    with_timeout(read_description(channel, "sheet", Duration::ZERO)).await.expect("expected a description");
    let mut reasons = Vec::new();
    for call in unread_calls {
        reasons.extend(end_of_call(call).await.map(|status| (status.code(), rejection_details(&status).reason())));
    }
    assert!(!reasons.is_empty(), "expected an unread call to end");
    assert!(reasons.iter().all(|reason| *reason == (Code::ResourceExhausted, Reason::SlowReader)), "{reasons:?}");
}

/// A server in a process of its own.
struct ServerProcess {
    child: Child,
    url: String,
    /// Scenes and state.
    _folder: tempfile::TempDir,
}

impl ServerProcess {
    /// Starts a server that can open `scene.toml`, a scene of many domains.
    fn start(flags: &[&str]) -> Self {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text);
        write("triangle.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n").expect("expected a writable folder");
        write("scene.toml", &"[[domain]]\nmodel = 'triangle.obj'\n".repeat(DOMAINS))
            .expect("expected a writable folder");
        let mut child = Command::new(env!("CARGO_BIN_EXE_modalcast"))
            .args([
                "serve",
                "--no-auth",
                "--listen",
                "127.0.0.1:0",
                "--backend",
                "cpu",
                "--renderer",
                "off",
                "--scenes",
            ])
            .arg(folder.path())
            .arg("--state")
            .arg(folder.path().join("state"))
            .args(LONG_LIMITS)
            .args(flags)
            .stdout(Stdio::piped())
            .spawn()
            .expect("expected a server");
        let mut line = String::new();
        let stdout = child.stdout.take().expect("expected standard output");
        std::io::BufReader::new(stdout).read_line(&mut line).expect("expected a line");
        let url = line.trim().strip_prefix("listening on ").expect("expected the URL").to_owned();
        Self { child, url, _folder: folder }
    }

    /// A memory size from `/proc/PID/status`, in bytes.
    fn memory(&self, key: &str) -> u64 {
        let path = format!("/proc/{}/status", self.child.id());
        let status = std::fs::read_to_string(path).expect("expected a running server");
        let line = status.lines().find_map(|line| line.strip_prefix(key)).expect("expected the key");
        let kib = line.trim_start_matches(':').split_whitespace().next().expect("expected a number");
        1024 * kib.parse::<u64>().expect("expected a number")
    }

    async fn channel(&self) -> Channel {
        small_windows(&self.url).await
    }
}

impl Drop for ServerProcess {
    fn drop(&mut self) {
        self.child.kill().ok();
        self.child.wait().ok();
    }
}

/// Domains of the scene of a [`ServerProcess`]. Its description and its state have 1 MB or more, and are produced for each
/// call, unlike arrays, which replies share with the scene.
const DOMAINS: usize = 20_000;

/// Replies that a client does not read.
#[derive(Debug, Clone, Copy)]
enum UnreadReplies {
    Descriptions,
    States,
}

impl UnreadReplies {
    /// Opens calls, which end when the result is dropped.
    async fn open(self, channel: &Channel, count: usize) -> Box<dyn std::any::Any> {
        match self {
            Self::Descriptions => Box::new(open_unread_calls(channel, "scene", count).await),
            Self::States => {
                let mut client = StateServiceClient::new(channel.clone());
                let mut calls = Vec::new();
                for _ in 0..count {
                    let request = v1::GetStateRequest { scene: "scene".into(), ..Default::default() };
                    calls.push(with_timeout(client.get_state(request)).await.expect("expected a reply").into_inner());
                }
                Box::new(calls)
            }
        }
    }
}

/// Peak of the memory growth of a server with 120 unread replies, in bytes, up to `enough` bytes.
async fn growth_by_unread_replies(replies: UnreadReplies, flags: &[&str], enough: u64) -> u64 {
    let server = ServerProcess::start(flags);
    let open = v1::OpenSceneRequest { source: "scene.toml".into(), scene: "scene".into() };
    let mut scenes = SceneServiceClient::new(server.channel().await);
    scenes.open_scene(open).await.expect("expected the scene to open");
    read_description(server.channel().await, "scene", Duration::ZERO).await.expect("expected a description");
    let idle_bytes = server.memory("VmHWM");
    let attacker = server.channel().await;
    let unread_calls = replies.open(&attacker, 120).await;
    let growth = || server.memory("VmHWM") - idle_bytes;
    // Clients on other connections are served. Meanwhile, the server has time to produce the unread replies.
    let read_descriptions = async {
        let mut count = 0;
        while count < 40 || growth() < enough {
            let description = read_description(server.channel().await, "scene", Duration::from_millis(1)).await;
            description.expect("expected a description");
            count += 1;
        }
    };
    with_timeout(read_descriptions).await;
    drop(unread_calls);
    growth()
}

#[tokio::test(flavor = "multi_thread")]
async fn unread_replies_use_bounded_memory() {
    const UNBOUNDED: u64 = 100 << 20;
    for replies in [UnreadReplies::Descriptions, UnreadReplies::States] {
        let (bounded, unbounded) = tokio::join!(
            growth_by_unread_replies(replies, &["--connection-reply-bytes", "16777216"], 0),
            growth_by_unread_replies(
                replies,
                &["--connection-reply-bytes", "4000000000", "--reply-bytes", "4000000000"],
                UNBOUNDED
            ),
        );
        println!("{replies:?}: {bounded} bytes with a budget of 16 MiB, {unbounded} bytes without");
        assert!(bounded < 64 << 20, "{replies:?}: {bounded}");
        assert!(unbounded >= UNBOUNDED, "control of {replies:?}: {unbounded}");
    }
}

/// Memory growth in bytes of a server to which a connection sends half of each of 40 messages of 8 MiB. With
/// `is_bounded`, the attack ends when the server has rejected all but four messages; otherwise when the memory has
/// grown by 200 MiB.
async fn growth_by_half_sent_messages(flags: &[&str], is_bounded: bool) -> u64 {
    let server = ServerProcess::start(flags);
    let idle_bytes = server.memory("VmRSS");
    let attacker = server.channel().await;
    let mut calls = tokio::task::JoinSet::new();
    for _ in 0..40 {
        calls.spawn(send_half(attacker.clone(), 8 << 20));
    }
    let mut scenes = SceneServiceClient::new(server.channel().await);
    let attack = async {
        loop {
            scenes.list_scenes(v1::ListScenesRequest {}).await.expect("expected service during the attack");
            let growth = server.memory("VmRSS").saturating_sub(idle_bytes);
            match is_bounded {
                // Four messages remain when all others are rejected.
                true if calls.len() <= 4 => return,
                true => drop(calls.try_join_next()),
                false if growth > 200 << 20 => return,
                false => {}
            }
            tokio::time::sleep(Duration::from_millis(5)).await;
        }
    };
    with_timeout(attack).await;
    server.memory("VmHWM") - idle_bytes
}

#[tokio::test(flavor = "multi_thread")]
async fn half_sent_messages_use_bounded_memory() {
    let unlimited = ["--receive-bytes", "4000000000"];
    // A single client may hold three quarters of 43 MiB.
    let bounded = growth_by_half_sent_messages(&["--receive-bytes", "45000000"], true).await;
    // This call is the negative control: it returns only after a growth of more than 200 MiB.
    let unbounded = growth_by_half_sent_messages(&unlimited, false).await;
    println!("half-sent messages: {bounded} bytes with a share of 32 MiB, {unbounded} bytes without");
    assert!(bounded < 100 << 20, "{bounded}");
}
