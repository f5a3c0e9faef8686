//! A full server ends connections that do not work for new clients. Connections that send no request, and step streams
//! without a lease, end after a timeout.

use modalcast::config::{Config, ListenAddress};
use modalcast_proto::v1;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpStream, UnixStream};
use tonic::Code;
use tonic_health::pb::health_client::HealthClient;
use tonic_types::StatusExt as _;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::scene_service_client::SceneServiceClient;
use v1::{Delivery, Reason};

use crate::service_harness::{
    DEFAULT_WINDOW, SILENCE_LIMIT, Server, StepWriter, rejection_details, step, with_timeout,
};

/// The preface of HTTP/2 and an empty SETTINGS frame.
const HELLO: &[u8] = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\x00\x00\x00\x04\x00\x00\x00\x00\x00";

async fn connect(server: &Server, bytes: &[u8]) -> TcpStream {
    let address = server.address.trim_start_matches("http://").to_owned();
    let mut connection = TcpStream::connect(address).await.expect("expected a connection");
    connection.write_all(bytes).await.expect("expected an open connection");
    connection
}

/// Reads until the server closes the connection, and returns all bytes.
async fn read_to_end(mut connection: TcpStream) -> Vec<u8> {
    let mut bytes = Vec::new();
    let mut buffer = [0; 4096];
    // A reset is an end, too.
    while let Ok(count @ 1..) = with_timeout(connection.read(&mut buffer)).await {
        bytes.extend_from_slice(&buffer[..count]);
    }
    bytes
}

/// Whether the bytes contain a GOAWAY frame with NO_ERROR.
fn contains_goaway(bytes: &[u8]) -> bool {
    let mut rest = bytes;
    while let [a, b, c, kind, _, _, _, _, _, payload @ ..] = rest {
        let length = u32::from_be_bytes([0, *a, *b, *c]) as usize;
        if *kind == 7 && payload.get(4..8) == Some(&[0; 4]) {
            return true;
        }
        rest = payload.get(length..).unwrap_or_default();
    }
    false
}

/// Handshakes have no deadline here, so only the full server closes connections.
async fn small_server(connections: usize) -> Server {
    let limits = |config| Config { connections, ..config };
    Server::start_with(limits).await
}

#[tokio::test(flavor = "multi_thread")]
async fn full_server_closes_connections_without_a_request() {
    let server = small_server(4).await;
    let mut idle_connections = Vec::new();
    for bytes in [&b""[..], b"P", HELLO, HELLO] {
        idle_connections.push(connect(&server, bytes).await);
    }
    let mut clients = Vec::new();
    for _ in 0..4 {
        let mut client = SceneServiceClient::new(server.channel().await);
        with_timeout(client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an answer");
        clients.push(client);
    }
    for connection in idle_connections {
        read_to_end(connection).await;
    }
    // The connections of clients that have sent a request stay open.
    for mut client in clients {
        with_timeout(client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an open connection");
    }
}

/// A client that sends steps is not closed. Idle connections get GOAWAY, and the writer continues.
#[tokio::test(flavor = "multi_thread")]
async fn full_server_keeps_clients_that_send_steps() {
    let server = small_server(2).await;
    let opener = SceneServiceClient::new(server.channel().await);
    let open = v1::OpenSceneRequest { source: "strips".into(), scene: String::new() };
    with_timeout(opener.clone().open_scene(open)).await.expect("expected the scene to open");
    let mut writer = StepWriter::connect(server.channel().await).await;
    writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await;
    writer.send_step_and_wait(step(0, &[0], &[0.1, 0.2])).await;
    for number in 1..=8 {
        let mut client = SceneServiceClient::new(server.channel().await);
        with_timeout(client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an answer");
        writer.send_step_and_wait(step(number, &[0], &[0.1, 0.2])).await;
    }
}

/// Calls that only wait do not protect their connections, and end with the reason.
#[tokio::test(flavor = "multi_thread")]
async fn full_server_ends_watches_and_rejected_drives_for_new_clients() {
    let server = small_server(6).await;
    server.open("strips").await;
    let mut worker = server.drive_lossless("strips").await;
    worker.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
    let mut watches = Vec::new();
    for _ in 0..2 {
        let request = tonic_health::pb::HealthCheckRequest { service: String::new() };
        let watch = HealthClient::new(server.channel().await).watch(request).await;
        watches.push(watch.expect("expected a stream").into_inner());
    }
    let mut drives = Vec::new();
    for _ in 0..2 {
        let mut drive = StepWriter::connect(server.channel().await).await;
        assert!(matches!(drive.open("none", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Rejection(_)));
        drives.push(drive);
    }
    let mut clients = Vec::new();
    for number in 2..=6 {
        let mut client = SceneServiceClient::new(server.channel().await);
        with_timeout(client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an answer");
        clients.push(client);
        worker.send_step_and_wait(step(number, &[0], &[0.1, 0.2])).await;
    }
    let mut ends = Vec::new();
    for mut watch in watches {
        ends.push(loop {
            match with_timeout(watch.message()).await {
                Ok(message) => assert!(message.is_some(), "expected an error at the end of the stream"),
                Err(status) => break status,
            }
        });
    }
    for mut drive in drives {
        ends.push(with_timeout(drive.replies.message()).await.expect_err("expected the end of the stream"));
    }
    for status in ends {
        assert_eq!((status.code(), rejection_details(&status).reason()), (Code::ResourceExhausted, Reason::Preempted));
        let metadata = status.get_details_error_info().expect("expected an ErrorInfo").metadata;
        let expected = [("object", "connections"), ("held", "1"), ("limit", "6")];
        assert!(expected.iter().all(|(key, text)| metadata[*key] == *text), "{metadata:?}");
    }
}

/// A process of a Unix socket is one client, so that its connections end before the only one of another client.
#[tokio::test(flavor = "multi_thread")]
async fn connections_of_one_process_are_one_client() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let path = folder.path().join("socket");
    let listen = ListenAddress::Unix(path.clone());
    let limits =
        |config: Config| Config { listen: [config.listen.clone(), vec![listen]].concat(), connections: 8, ..config };
    let server = Server::start_with(limits).await;
    // Idle, and therefore the first to end if connections alone counted.
    let mut idle_client = SceneServiceClient::new(server.channel().await);
    with_timeout(idle_client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an answer");
    let mut of_process = Vec::new();
    for _ in 0..7 {
        let mut connection = UnixStream::connect(&path).await.expect("expected a connection");
        connection.write_all(HELLO).await.expect("expected an open connection");
        of_process.push(connection);
    }
    let mut refused = UnixStream::connect(&path).await.expect("expected a connection");
    with_timeout(refused.read_to_end(&mut Vec::new())).await.ok();
    for _ in 0..4 {
        let mut client = SceneServiceClient::new(server.channel().await);
        with_timeout(client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an answer");
    }
    with_timeout(of_process[0].read_to_end(&mut Vec::new())).await.ok();
    with_timeout(idle_client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an open connection");
}

/// A stream whose `open` is rejected, or that sends none, does not stay open.
#[tokio::test(flavor = "multi_thread")]
async fn step_stream_without_a_lease_ends_in_time() {
    let server = Server::start_with(|config| Config { first_request_timeout: SILENCE_LIMIT, ..config }).await;
    server.open("strips").await;
    let mut worker = server.drive_lossless("strips").await;
    let silent = StepWriter::connect(server.channel().await).await;
    let mut rejected = StepWriter::connect(server.channel().await).await;
    assert!(matches!(rejected.open("strips", Delivery::Lossless, 0).await, ResponseKind::Rejection(_)));
    for mut drive in [silent, rejected] {
        let status = with_timeout(drive.replies.message()).await.expect_err("expected the end of the stream");
        let reason = rejection_details(&status).reason();
        assert_eq!((status.code(), reason), (Code::DeadlineExceeded, Reason::DeadlineExpired));
    }
    worker.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn connection_without_a_request_gets_goaway_in_time() {
    let server = Server::start_with(|config| Config { first_request_timeout: SILENCE_LIMIT, ..config }).await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    assert!(contains_goaway(&read_to_end(connect(&server, HELLO).await).await));
    writer.send_step_and_wait(step(1, &[0], &[0.1, 0.2])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn other_protocols_are_closed_at_once() {
    let server = Server::start_with(|config| Config { viewer: false, ..config }).await;
    assert_eq!(read_to_end(connect(&server, b"GET / HTTP/1.1\r\n\r\n").await).await, b"");
    // A server with the viewer answers HTTP/1.1, but no other protocol.
    let server = small_server(4).await;
    let answer = read_to_end(connect(&server, b"GET / HTTP/1.1\r\n\r\n").await).await;
    assert!(answer.starts_with(b"HTTP/1.1 403 "), "{answer:?}");
    let answer = read_to_end(connect(&server, b"\x16\x03\x01\x00\x05\x01\x00\r\n").await).await;
    assert!(!answer.starts_with(b"HTTP/1.1 200"), "{answer:?}");
}
