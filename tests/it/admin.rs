//! Health, readiness and metrics on a listener of their own.

use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};

use modalcast::config::{Authentication, Config, ListenAddress};
use modalcast_proto::v1;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpStream, UnixStream};
use v1::Delivery;
use v1::scene_service_client::SceneServiceClient;
use v1::state_service_client::StateServiceClient;

use crate::service_harness::{DEFAULT_WINDOW, Server, StepWriter, step, with_timeout};

fn socket_in(folder: &Path) -> PathBuf {
    folder.join("admin.sock")
}

/// A server with an administrative socket in a folder.
async fn start(folder: &Path, change: impl FnOnce(Config) -> Config) -> Server {
    let admin = Some(ListenAddress::Unix(socket_in(folder)));
    Server::start_with(|config| change(Config { admin, ..config })).await
}

/// Status, head and text of the answer to a request.
async fn request(folder: &Path, method: &str, path: &str) -> (u16, String, String) {
    let mut socket = UnixStream::connect(socket_in(folder)).await.expect("expected a connection");
    let request = format!("{method} {path} HTTP/1.1\r\nHost: localhost\r\n\r\n");
    socket.write_all(request.as_bytes()).await.expect("expected an open connection");
    let mut answer = String::new();
    with_timeout(socket.read_to_string(&mut answer)).await.expect("expected an answer");
    let (head, text) = answer.split_once("\r\n\r\n").expect("expected a head");
    let status = head.split(' ').nth(1).and_then(|code| code.parse().ok()).expect("expected a status");
    (status, head.to_ascii_lowercase(), text.to_owned())
}

/// The samples of the metrics: name with labels, and value.
async fn samples(folder: &Path) -> Vec<(String, f64)> {
    let (status, head, text) = request(folder, "GET", "/metrics").await;
    assert_eq!(status, 200);
    assert!(head.contains("content-type: text/plain; version=0.0.4; charset=utf-8"), "{head}");
    let sample = |line: &str| {
        let (name, value) = line.rsplit_once(' ').expect("expected a sample");
        (name.to_owned(), value.parse().expect("expected a number"))
    };
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let samples: Vec<_> = lines.map(sample).collect();
    // Every sample follows the type of its metric.
    for (name, _) in &samples {
        let family = name.split('{').next().unwrap_or_default();
        assert!(text.contains(&format!("# TYPE {family} ")), "{name}");
        assert!(name.starts_with("modalcast_"), "{name}");
    }
    samples
}

async fn sample(folder: &Path, name: &str) -> Option<f64> {
    samples(folder).await.into_iter().find(|(sample, _)| sample.starts_with(name)).map(|(_, value)| value)
}

#[tokio::test(flavor = "multi_thread")]
async fn health_readiness_and_metrics_are_answered() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = start(folder.path(), |config| config).await;
    let mode = std::fs::metadata(socket_in(folder.path())).expect("expected a socket").permissions().mode();
    assert_eq!(mode & 0o777, 0o600);
    for (method, path, status, text) in [
        ("GET", "/healthz", 200, "alive\n"),
        ("GET", "/readyz", 200, "ready\n"),
        ("POST", "/healthz", 405, "expected GET\n"),
        ("GET", "/", 404, "expected the path /healthz, /readyz or /metrics\n"),
        ("GET", "/websocket", 404, "expected the path /healthz, /readyz or /metrics\n"),
    ] {
        let answer = request(folder.path(), method, path).await;
        assert_eq!((answer.0, answer.2.as_str()), (status, text), "{method} {path}");
    }
    assert_eq!(sample(folder.path(), "modalcast_build_info{").await, Some(1.0));
    assert_eq!(sample(folder.path(), "modalcast_open_scenes").await, Some(0.0));
    let limit = sample(folder.path(), "modalcast_memory_limit_bytes{kind=\"host\"}").await;
    let memory = "modalcast_memory_bytes{kind=\"host\",use=\"scenes\"}";
    assert_eq!(sample(folder.path(), memory).await, Some(0.0));
    server.open("strips").await;
    let used = sample(folder.path(), memory).await.expect("expected a sample");
    assert!(used > 0.0 && Some(used) < limit, "{used} of {limit:?}");
    assert_eq!(sample(folder.path(), "modalcast_open_scenes").await, Some(1.0));
    let _connection = server.scenes().await.list_scenes(v1::ListScenesRequest {}).await.expect("expected a list");
    // Connections that were opened before are closed asynchronously.
    let grpc = sample(folder.path(), "modalcast_connections{protocol=\"grpc\"}").await;
    assert!(grpc.is_some(), "expected the connections");
    server.stop().await.expect("expected an orderly end");
    assert!(!socket_in(folder.path()).exists());
}

#[tokio::test(flavor = "multi_thread")]
async fn rejected_calls_are_counted() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let guard = |config| Config { authentication: Authentication::Tokens, ..config };
    let server = start(folder.path(), guard).await;
    for count in 0..3 {
        assert_eq!(sample(folder.path(), "modalcast_auth_failures_total").await, Some(f64::from(count)));
        let rejected = server.scenes().await.list_scenes(v1::ListScenesRequest {}).await;
        assert!(rejected.is_err());
    }
}

/// Supervisors are answered by a full server, and take no connection from its clients.
#[tokio::test(flavor = "multi_thread")]
async fn full_server_answers_on_the_admin_listener() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let server = start(folder.path(), |config| Config { connections: 2, ..config }).await;
    let channel = server.channel().await;
    let open = v1::OpenSceneRequest { source: "strips".into(), scene: String::new() };
    SceneServiceClient::new(channel.clone()).open_scene(open).await.expect("expected the scene to open");
    let mut writer = StepWriter::connect(channel).await;
    writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await;
    let mut states = StateServiceClient::new(server.channel().await);
    let delivery = Delivery::Latest.into();
    let request = v1::StreamStatesRequest { scene: "strips".into(), delivery, ..Default::default() };
    let mut stream = states.stream_states(request).await.expect("expected a stream").into_inner();
    writer.send_step_and_wait(step(1, &[], &[])).await;
    with_timeout(stream.message()).await.expect("expected a state");
    for _ in 0..20 {
        assert_eq!(self::request(folder.path(), "GET", "/healthz").await.0, 200);
        assert_eq!(self::request(folder.path(), "GET", "/readyz").await.0, 200);
    }
    writer.send_step_and_wait(step(2, &[], &[])).await;
    with_timeout(stream.message()).await.expect("expected an open connection");
    let preempted = "modalcast_preempted_total{resource=\"connections\"}";
    assert_eq!(sample(folder.path(), preempted).await, Some(0.0));
    // Control: a third client takes the connection with the least progress.
    let mut client = SceneServiceClient::new(server.channel().await);
    with_timeout(client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an answer");
    assert_eq!(sample(folder.path(), preempted).await, Some(1.0));
    drop(stream);
}

/// Connections that send nothing do not exhaust the listener.
#[tokio::test(flavor = "multi_thread")]
async fn silent_connections_to_the_admin_listener_are_closed() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let _server = start(folder.path(), |config| config).await;
    let mut silent = Vec::new();
    for _ in 0..40 {
        silent.push(UnixStream::connect(socket_in(folder.path())).await.expect("expected a connection"));
    }
    assert_eq!(request(folder.path(), "GET", "/healthz").await.0, 200);
    for mut socket in silent {
        with_timeout(socket.read_to_end(&mut Vec::new())).await.ok();
    }
}

#[tokio::test]
async fn server_has_no_admin_listener_by_default() {
    let server = Server::start_default().await;
    let address = server.address.trim_start_matches("http://");
    let mut socket = TcpStream::connect(address).await.expect("expected a connection");
    socket.write_all(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n").await.expect("expected an open connection");
    let mut answer = String::new();
    with_timeout(socket.read_to_string(&mut answer)).await.expect("expected an answer");
    assert!(answer.starts_with("HTTP/1.1 404 "), "{answer}");
}
