//! gRPC calls over a WebSocket: replies and errors are those of gRPC, both directions have flow control, and clients
//! that break the rules are disconnected with a code.

use std::time::Duration;

use futures_util::SinkExt as _;
use modalcast::config::Config;
use modalcast_proto::v1;
use prost::Message as _;
use tokio::net::{TcpSocket, TcpStream};
use tokio_tungstenite::tungstenite::Message;
use tokio_tungstenite::tungstenite::protocol::frame::Frame;
use tokio_tungstenite::tungstenite::protocol::frame::coding::{Data, OpCode};
use tonic::Code;
use v1::drive_scene_request::Kind as RequestKind;
use v1::drive_scene_response::Kind as ResponseKind;

use crate::service_harness::{SILENCE_LIMIT, Server, minimum_step, step, with_timeout};
use crate::websocket_client::{CANCEL, CREDIT, CallResult, END, MESSAGE, START, WebSocketClient, authority, call_grpc};

const DRIVE: &str = "/modalcast.v1.StepService/DriveScene";
const LIST: &str = "/modalcast.v1.SceneService/ListScenes";
const OPEN: &str = "/modalcast.v1.SceneService/OpenScene";
const DESCRIBE: &str = "/modalcast.v1.SceneService/DescribeScene";
const GET_VERTICES: &str = "/modalcast.v1.VertexService/GetVertices";
const GET_STATE: &str = "/modalcast.v1.StateService/GetState";
const STREAM_VERTICES: &str = "/modalcast.v1.VertexService/StreamVertices";

/// Credit of a call for messages of the server and of the client, in bytes.
const SERVER_CREDIT: usize = 4 << 20;
const CLIENT_CREDIT: usize = 1 << 20;

async fn default_server() -> Server {
    Server::start_with(|config| config).await
}

fn describe(scene: &str) -> v1::DescribeSceneRequest {
    let arrays = [v1::Array::RestPositions, v1::Array::Indices, v1::Array::Modes].map(Into::into).to_vec();
    v1::DescribeSceneRequest { scene: scene.into(), arrays, ..Default::default() }
}

fn open(source: &str) -> v1::OpenSceneRequest {
    v1::OpenSceneRequest { source: source.into(), scene: String::new() }
}

/// The message of a step stream.
fn drive_request(kind: RequestKind) -> Vec<u8> {
    v1::DriveSceneRequest { kind: Some(kind) }.encode_to_vec()
}

fn open_drive(scene: &str) -> Vec<u8> {
    let delivery = v1::Delivery::Lossless.into();
    drive_request(RequestKind::Open(v1::OpenDrive { scene: scene.into(), delivery, ..Default::default() }))
}

/// Removes the times from the heads of vertices and states, because they differ between two calls.
fn without_stage_times(path: &str, mut result: CallResult) -> CallResult {
    use v1::get_vertices_response::Part;
    for message in &mut result.messages {
        if path == GET_VERTICES {
            let mut reply = v1::GetVerticesResponse::decode(&message[..]).expect("expected a reply");
            if let Some(Part::Chunk(v1::VertexChunk { head: Some(head), .. })) = &mut reply.part {
                head.stages.clear();
                *message = reply.encode_to_vec();
            }
        } else if path == GET_STATE {
            let mut reply = v1::GetStateResponse::decode(&message[..]).expect("expected a reply");
            if let Some(v1::StateChunk { head: Some(head), .. }) = &mut reply.chunk {
                head.stages.clear();
                *message = reply.encode_to_vec();
            }
        }
    }
    result
}

/// Waits until the last step of a scene is on disk. A list of scenes that is read meanwhile lacks the durable step.
async fn wait_for_durable_step(server: &Server, name: &str) {
    loop {
        let list =
            server.scenes().await.list_scenes(v1::ListScenesRequest {}).await.expect("expected a list").into_inner();
        if list.scenes.iter().any(|scene| scene.scene == name && scene.durable_step.is_some()) {
            return;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

/// Makes the same call over both transports.
async fn call_both(
    server: &Server,
    client: &mut WebSocketClient,
    path: &str,
    request: &impl prost::Message,
) -> CallResult {
    let over_grpc = without_stage_times(path, call_grpc(server.channel().await, path, request).await);
    let over_websocket = without_stage_times(path, client.call(path, request).await);
    assert_eq!(over_websocket, over_grpc, "{path}");
    over_websocket
}

/// The replies of unary and server-streaming calls of all services are those of gRPC, byte by byte.
#[tokio::test(flavor = "multi_thread")]
async fn replies_and_errors_are_those_of_grpc() {
    let server = default_server().await;
    for source in ["strips", "sheet"] {
        server.open(source).await;
    }
    let mut writer = server.drive_lossless("strips").await;
    writer.send_step_and_wait(step(1, &[0], &[0.5, -0.25])).await;
    with_timeout(wait_for_durable_step(&server, "strips")).await;
    let mut client = WebSocketClient::connect(&server).await;
    let scene = || "strips".to_owned();
    macro_rules! both {
        ($path:expr, $request:expr) => {
            call_both(&server, &mut client, $path, &$request).await
        };
    }
    let infallible = [
        both!("/modalcast.v1.ServerService/GetServerInfo", v1::GetServerInfoRequest {}),
        both!(LIST, v1::ListScenesRequest {}),
        both!(DESCRIBE, describe("sheet")),
        both!(GET_VERTICES, v1::GetVerticesRequest { scene: scene(), ..Default::default() }),
        both!(GET_VERTICES, v1::GetVerticesRequest { scene: "sheet".into(), ..Default::default() }),
        both!(GET_STATE, v1::GetStateRequest { scene: scene(), ..Default::default() }),
        both!("/modalcast.v1.SceneService/ReadModes", v1::ReadModesRequest { scene: scene(), ..Default::default() }),
        both!("/grpc.health.v1.Health/Check", tonic_health::pb::HealthCheckRequest { service: String::new() }),
    ];
    for (index, result) in infallible.iter().enumerate() {
        assert_eq!((result.status.code, result.messages.is_empty()), (0, false), "call {index}: {:?}", result.status);
    }
    assert!(infallible[2].messages.len() > 5, "expected several chunks");

    let frames = "/modalcast.v1.FrameService/RenderFrame";
    let forces = "/modalcast.v1.ForceService/ApplyForces";
    let errors = [
        (both!(OPEN, open("unknown")), Code::NotFound),
        (both!(DESCRIBE, describe("unknown")), Code::NotFound),
        (both!(frames, v1::RenderFrameRequest { scene: scene(), ..Default::default() }), Code::Unavailable),
        (both!(forces, v1::ApplyForcesRequest { scene: scene(), ..Default::default() }), Code::InvalidArgument),
        (both!("/modalcast.v1.SceneService/Unknown", v1::ListScenesRequest {}), Code::Unimplemented),
        (both!("/unknown", v1::ListScenesRequest {}), Code::Unimplemented),
    ];
    for (result, code) in &errors {
        assert_eq!(result.status.code, *code as i32, "{:?}", result.status);
    }
    assert!(errors[..4].iter().all(|(result, _)| !result.status.details.is_empty()), "expected error details");
    drop(writer);
}

/// A step stream with acknowledgments, and a vertex stream of the same connection that shows its steps.
#[tokio::test(flavor = "multi_thread")]
async fn step_stream_is_acknowledged_and_seen_by_a_vertex_stream() {
    let server = default_server().await;
    server.open("strips").await;
    let mut client = WebSocketClient::connect(&server).await;
    let delivery = v1::Delivery::Lossless.into();
    let request = v1::StreamVerticesRequest { scene: "strips".into(), delivery, steps: 3, ..Default::default() };
    let vertices = client.start_with(STREAM_VERTICES, &request).await;
    let settings = client.receive(vertices).await;
    assert_eq!(settings.kind, MESSAGE);

    let drive = client.start(DRIVE).await;
    client.send(drive, MESSAGE, &open_drive("strips")).await;
    let kind_of = |payload: bytes::Bytes| v1::DriveSceneResponse::decode(payload).expect("expected a reply").kind;
    let opened = kind_of(client.receive(drive).await.payload);
    assert!(matches!(opened, Some(ResponseKind::Opened(_))), "{opened:?}");
    for number in 1..=3 {
        let step = step(number, &[0], &[0.1 * number as f32, 0.0]);
        client.send(drive, MESSAGE, &drive_request(RequestKind::Step(step))).await;
        match kind_of(client.receive(drive).await.payload) {
            Some(ResponseKind::Ack(ack)) => assert_eq!(ack.step, number),
            other => panic!("expected an acknowledgment, got {other:?}"),
        }
    }
    // A rejected step leaves the stream open.
    client.send(drive, MESSAGE, &drive_request(RequestKind::Step(step(4, &[9], &[0.0])))).await;
    let rejection = kind_of(client.receive(drive).await.payload);
    assert!(matches!(rejection, Some(ResponseKind::Rejection(_))), "{rejection:?}");
    client.send(drive, END, &[]).await;
    assert_eq!(client.finish(drive).await.status.code, 0);

    let result = client.finish(vertices).await;
    assert_eq!(result.status.code, 0);
    let numbers = result.messages.iter().filter_map(|message| {
        let part = v1::StreamVerticesResponse::decode(&message[..]).expect("expected a reply").part?;
        match part {
            v1::stream_vertices_response::Part::Chunk(chunk) => Some(chunk.head?.step?.number),
            _ => None,
        }
    });
    assert_eq!(numbers.collect::<Vec<_>>(), [1, 2, 3]);
}

/// A client stream of more than the initial credit: the client sends only while its credit is positive.
#[tokio::test(flavor = "multi_thread")]
async fn upload_above_the_credit_continues_when_credit_returns() {
    let server = default_server().await;
    let mut client = WebSocketClient::connect(&server).await;
    let drive = client.start(DRIVE).await;
    // The server answers even an invalid message, so it processes messages of any content.
    let large = vec![0; 300 << 10];
    let step = v1::Step { number: 1, q: large.into(), ..Default::default() };
    let message = drive_request(RequestKind::Step(step));
    let (mut credit, mut answers) = (CLIENT_CREDIT as i64, 0);
    for _ in 0..12 {
        while credit <= 0 {
            let reply = client.receive(drive).await;
            match reply.kind {
                CREDIT => {
                    credit += i64::from(u32::from_le_bytes(reply.payload[..].try_into().expect("expected 4 bytes")));
                }
                MESSAGE => answers += 1,
                _ => panic!("{:?}", reply.status()),
            }
        }
        client.send(drive, MESSAGE, &message).await;
        credit -= message.len() as i64;
    }
    client.send(drive, END, &[]).await;
    let result = client.finish(drive).await;
    assert_eq!((result.status.code, answers + result.messages.len()), (0, 12));
}

/// Without credit, the server stops sending, and other calls of the connection continue.
#[tokio::test(flavor = "multi_thread")]
async fn server_stops_without_credit_and_resumes() {
    let server = default_server().await;
    server.open("sheet").await;
    let expected = call_grpc(server.channel().await, DESCRIBE, &describe("sheet")).await;
    let total = expected.messages.iter().map(Vec::len).sum::<usize>();
    assert!(total > SERVER_CREDIT + (2 << 20), "expected a larger reply, got {total} bytes");
    let mut client = WebSocketClient::connect(&server).await;
    let id = client.start_with(DESCRIBE, &describe("sheet")).await;
    let (mut messages, mut bytes) = (Vec::new(), 0);
    while bytes < SERVER_CREDIT {
        let message = client.receive(id).await;
        assert_eq!(message.kind, MESSAGE);
        bytes += message.payload.len();
        messages.push(message.payload.to_vec());
    }
    // 30 further calls are answered, and no message of the stopped call arrives between their answers.
    for _ in 0..30 {
        assert_eq!(client.call(LIST, &v1::ListScenesRequest {}).await.status.code, 0);
    }
    assert!(!client.has_received(id), "expected no message without credit");
    client.send(id, CREDIT, &(bytes as u32).to_le_bytes()).await;
    let CallResult { messages: rest, status } = client.finish(id).await;
    messages.extend(rest);
    assert_eq!(CallResult { messages, status }, expected);
}

/// The 33rd call is rejected with the details of other errors. It succeeds when another call has ended.
#[tokio::test(flavor = "multi_thread")]
async fn number_of_calls_is_limited() {
    // A single client may have 56 of these streams.
    let server = Server::start_with(|config| Config { max_subscribers: 64, ..config }).await;
    server.open("strips").await;
    let mut client = WebSocketClient::connect(&server).await;
    let request = v1::StreamVerticesRequest {
        scene: "strips".into(),
        delivery: v1::Delivery::Latest.into(),
        ..Default::default()
    };
    let mut streams = Vec::new();
    for _ in 0..32 {
        let id = client.start_with(STREAM_VERTICES, &request).await;
        assert_eq!(client.receive(id).await.kind, MESSAGE);
        streams.push(id);
    }
    let rejected = client.call(LIST, &v1::ListScenesRequest {}).await;
    assert_eq!(rejected.status.code, Code::ResourceExhausted as i32);
    assert!(!rejected.status.details.is_empty());
    client.send(streams[7], CANCEL, &[]).await;
    let until_accepted = async { while client.call(LIST, &v1::ListScenesRequest {}).await.status.code != 0 {} };
    with_timeout(until_accepted).await;
}

/// A timeout in START is the deadline of the call.
#[tokio::test(flavor = "multi_thread")]
async fn timeout_ends_a_call() {
    let server = default_server().await;
    server.open("strips").await;
    let mut client = WebSocketClient::connect(&server).await;
    client.send(1, START, &[&50_u32.to_le_bytes()[..], GET_VERTICES.as_bytes()].concat()).await;
    let request = v1::GetVerticesRequest { scene: "strips".into(), step: minimum_step(7), ..Default::default() };
    client.send(1, MESSAGE, &request.encode_to_vec()).await;
    client.send(1, END, &[]).await;
    assert_eq!(client.finish(1).await.status.code, Code::DeadlineExceeded as i32);
}

/// A subscriber to the vertices of `sheet` that returns no credit.
async fn subscribe_without_credit(server: &Server) -> (WebSocketClient, u32) {
    let delivery = v1::Delivery::Lossless.into();
    let request = v1::StreamVerticesRequest { scene: "sheet".into(), delivery, ..Default::default() };
    let mut client = WebSocketClient::connect(server).await;
    let id = client.start_with(STREAM_VERTICES, &request).await;
    assert_eq!(client.receive(id).await.kind, MESSAGE);
    (client, id)
}

/// Time without an acknowledgment after which a test assumes that a step is blocked.
const BLOCKED: Duration = SILENCE_LIMIT;

/// A server without a time limit on a lossless subscriber that blocks the writer.
async fn patient_server() -> Server {
    let server = default_server().await;
    server.open("sheet").await;
    server
}

fn sheet_step(number: u64) -> v1::Step {
    step(number, &[0], &[0.0, 0.1, 0.0, 0.0])
}

/// A cancelled call and a closed connection release their subscriptions: a lossless writer is no longer blocked.
#[tokio::test(flavor = "multi_thread")]
async fn cancel_and_close_end_streams() {
    let server = patient_server().await;
    let mut writer = server.drive_lossless("sheet").await;
    let mut number = 0;
    for is_cancelled in [true, false] {
        let (mut client, id) = subscribe_without_credit(&server).await;
        let until_blocked = async {
            loop {
                number += 1;
                writer.send_step(sheet_step(number)).await;
                if tokio::time::timeout(BLOCKED, writer.receive_reply()).await.is_err() {
                    return;
                }
            }
        };
        with_timeout(until_blocked).await;
        if is_cancelled {
            client.send(id, CANCEL, &[]).await;
        } else {
            client = WebSocketClient::connect(&server).await;
        }
        let ResponseKind::Ack(_) = writer.receive_reply().await else { panic!("expected an acknowledgment") };
        // After CANCEL, the connection remains open, and no status follows.
        assert_eq!(client.call(LIST, &v1::ListScenesRequest {}).await.status.code, 0);
        assert!(!client.has_received_status(id));
    }
}

/// While the step window is full, the service reads no messages, so the server returns no credit.
#[tokio::test(flavor = "multi_thread")]
async fn message_without_credit_closes_the_connection() {
    let server = patient_server().await;
    let (_subscriber, _) = subscribe_without_credit(&server).await;
    let mut client = WebSocketClient::connect(&server).await;
    let drive = client.start(DRIVE).await;
    client.send(drive, MESSAGE, &open_drive("sheet")).await;
    assert_eq!(client.receive(drive).await.kind, MESSAGE);
    let until_blocked = async {
        for number in 1.. {
            client.send(drive, MESSAGE, &drive_request(RequestKind::Step(sheet_step(number)))).await;
            if tokio::time::timeout(BLOCKED, client.receive(drive)).await.is_err() {
                return;
            }
        }
    };
    with_timeout(until_blocked).await;
    // The window has room for some more steps, which the server accepts.
    for number in 1000..1020 {
        client.send(drive, MESSAGE, &drive_request(RequestKind::Step(sheet_step(number)))).await;
    }
    for _ in 0..3 {
        // The last of these three messages is sent without credit.
        client.send(drive, MESSAGE, &vec![0; CLIENT_CREDIT * 3 / 4]).await;
    }
    assert_eq!(client.closed().await, Some(4002));
}

/// Connects, sends messages and expects a close code.
async fn assert_closed(server: &Server, messages: &[Message], code: u16) {
    let mut client = WebSocketClient::connect(server).await;
    for message in messages {
        // The server may have closed the connection already.
        with_timeout(client.stream.send(message.clone())).await.ok();
    }
    assert_eq!(client.closed().await, Some(code), "{:.200}", format!("{messages:?}"));
}

fn binary(id: u32, kind: u8, payload: &[u8]) -> Message {
    Message::binary([&id.to_le_bytes()[..], &[kind], payload].concat())
}

fn start(id: u32, path: &str) -> Message {
    binary(id, START, &[&[0; 4], path.as_bytes()].concat())
}

fn fragment(opcode: Data, payload: &[u8], is_last: bool) -> Message {
    Message::Frame(Frame::message(payload.to_vec(), OpCode::Data(opcode), is_last))
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_that_break_the_rules_are_disconnected() {
    let server = default_server().await;
    let fragmented_text = [fragment(Data::Text, b"a", false), fragment(Data::Continue, b"b", true)];
    // Messages, and the close code that `proto/websocket.md` states for them.
    let attacks: [(&[Message], u16); 13] = [
        (&[Message::text("text")], 1003),
        (&fragmented_text, 1003),
        (&[fragment(Data::Continue, b"", true)], 1002),
        (&[fragment(Data::Binary, b"", false), Message::binary(vec![0; 5])], 1002),
        (&[Message::binary(vec![0; 4])], 4000),
        (&[binary(1, 9, b"")], 4000),
        (&[binary(1, START, b"\0\0\0\0no path")], 4000),
        (&[binary(1, MESSAGE, b"")], 4001),
        (&[binary(1, CANCEL, b"")], 4001),
        (&[start(5, LIST), start(5, LIST)], 4001),
        (&[start(5, LIST), start(4, LIST)], 4001),
        (&[start(1, DRIVE), binary(1, END, b""), binary(1, MESSAGE, b"")], 4001),
        (&[Message::binary(vec![0; (1 << 20) + 6])], 1009),
    ];
    for (messages, code) in attacks {
        assert_closed(&server, messages, code).await;
    }
    // Other clients are served.
    let mut client = WebSocketClient::connect(&server).await;
    assert_eq!(client.call(LIST, &v1::ListScenesRequest {}).await.status.code, 0);
}

/// Messages may have any number of fragments, with pings between them.
#[tokio::test(flavor = "multi_thread")]
async fn fragmented_messages_are_accepted() {
    let server = default_server().await;
    let mut client = WebSocketClient::connect(&server).await;
    let Message::Binary(head) = start(1, LIST) else { panic!("expected a binary message") };
    for (index, byte) in head.iter().enumerate() {
        let opcode = if index == 0 { Data::Binary } else { Data::Continue };
        let is_last = index == head.len() - 1;
        client.stream.send(fragment(opcode, &[*byte], is_last)).await.expect("expected an open connection");
        client.stream.send(Message::Ping(vec![1].into())).await.expect("expected an open connection");
    }
    client.send(1, MESSAGE, &[]).await;
    client.send(1, END, &[]).await;
    assert_eq!(client.finish(1).await.status.code, 0);
}

/// A message that does not arrive completely is ended, and a connection without a request is closed.
#[tokio::test(flavor = "multi_thread")]
async fn incomplete_messages_and_silent_clients_are_disconnected() {
    let short = Duration::from_millis(200);
    let server = Server::start_with(|config| Config { message_timeout: short, ..config }).await;
    assert_closed(&server, &[fragment(Data::Binary, &[0; 1000], false)], 1008).await;
    let server = Server::start_with(|config| Config { first_request_timeout: short, ..config }).await;
    assert_closed(&server, &[], 1008).await;
    // A client that does not answer pings.
    let keepalive_interval = Duration::from_millis(100);
    let server =
        Server::start_with(|config| Config { keepalive_interval, keepalive_timeout: keepalive_interval, ..config });
    let server = server.await;
    let client = WebSocketClient::connect(&server).await;
    let mut socket = client.stream.into_inner();
    let mut bytes = Vec::new();
    with_timeout(tokio::io::AsyncReadExt::read_to_end(&mut socket, &mut bytes)).await.ok();
    assert_eq!(bytes[..2], [0x89, 0], "expected a ping");
}

/// Half-sent messages of many connections are bounded by the budget of all connections.
#[tokio::test(flavor = "multi_thread")]
async fn half_sent_messages_count_against_the_receive_budget() {
    let limits = |config| Config { receive_bytes: 2 << 20, ..config };
    let server = Server::start_with(limits).await;
    let mut clients = Vec::new();
    for bytes in [1000 << 10, 760 << 10] {
        let mut client = WebSocketClient::connect(&server).await;
        client.stream.send(fragment(Data::Binary, &vec![0; bytes], false)).await.expect("expected an open connection");
        clients.push(client);
    }
    // The message of the third connection is accepted when the connection that holds the most has lost its message.
    let mut third = WebSocketClient::connect(&server).await;
    let until_evicted = async {
        loop {
            let result = third.call(OPEN, &open(&"x".repeat(300 << 10))).await;
            assert_ne!(result.status.code, Code::ResourceExhausted as i32);
            if let Ok(code) = tokio::time::timeout(Duration::from_millis(20), clients[0].closed()).await {
                return code;
            }
        }
    };
    assert_eq!(with_timeout(until_evicted).await, Some(1013));
}

/// A viewer that never reads from its socket is bounded by the reply budget and disconnected when others wait.
#[tokio::test(flavor = "multi_thread")]
async fn client_that_never_reads_is_cut_off() {
    let (reply_bytes, reply_timeout) = (6 << 20, SILENCE_LIMIT);
    let limits = |config| Config { reply_bytes, connection_reply_bytes: reply_bytes, reply_timeout, ..config };
    let server = Server::start_with(limits).await;
    server.open("sheet").await;
    let mut stalled = Vec::new();
    for _ in 0..3 {
        let socket = TcpSocket::new_v4().expect("expected a socket");
        socket.set_recv_buffer_size(16 << 10).expect("expected a smaller buffer");
        let address = authority(&server).parse().expect("expected an address");
        let socket: TcpStream = socket.connect(address).await.expect("expected a connection");
        let mut client = WebSocketClient::connect_on(socket, &server).await;
        for _ in 0..8 {
            client.start_with(DESCRIBE, &describe("sheet")).await;
        }
        stalled.push(client);
    }
    let expected = call_grpc(server.channel().await, DESCRIBE, &describe("sheet")).await;
    assert_eq!(expected.status.code, 0);
    let mut reader = WebSocketClient::connect(&server).await;
    for _ in 0..3 {
        assert_eq!(reader.call(DESCRIBE, &describe("sheet")).await, expected);
    }
    // Clients that were cut off have lost their connection or have a call with an error. The other clients finish now.
    let mut cut_off = 0;
    for client in &mut stalled {
        let mut statuses = Vec::new();
        while statuses.len() < 8 {
            match with_timeout(client.next_end()).await {
                Some(status) => statuses.push(status.code),
                None => break,
            }
        }
        cut_off += usize::from(statuses != [0; 8]);
    }
    assert!(cut_off > 0, "expected readers that were cut off");
}

/// At the end of the server, streams end with a status, and the connection is closed with a code.
#[tokio::test(flavor = "multi_thread")]
async fn shutdown_ends_calls_and_closes_the_connection() {
    let server = default_server().await;
    server.open("strips").await;
    let mut client = WebSocketClient::connect(&server).await;
    let request = v1::StreamVerticesRequest {
        scene: "strips".into(),
        delivery: v1::Delivery::Latest.into(),
        ..Default::default()
    };
    let id = client.start_with(STREAM_VERTICES, &request).await;
    assert_eq!(client.receive(id).await.kind, MESSAGE);
    let stopped = tokio::spawn(server.stop());
    let status = client.finish(id).await.status;
    assert_eq!(status.code, Code::Unavailable as i32, "{status:?}");
    assert_eq!(client.closed().await, Some(1001));
    stopped.await.expect("expected no panic").expect("expected a clean stop");
}
