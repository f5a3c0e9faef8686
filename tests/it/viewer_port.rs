//! HTTP/1.1 on the port of the server: the viewer's page, the health of the server, and the checks of Host and Origin.

use std::time::Duration;

use modalcast::config::{Config, ListenAddress};
use modalcast_proto::v1;
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::Error as WebSocketError;
use v1::scene_service_client::SceneServiceClient;
use v1::server_service_client::ServerServiceClient;

use crate::service_harness::{SILENCE_LIMIT, Server, with_timeout};
use crate::websocket_client::{WebSocketClient, authority, handshake};

/// An answer in HTTP/1.1.
#[derive(Debug)]
pub(crate) struct Answer {
    pub(crate) status: u16,
    /// Lower case.
    head: String,
    pub(crate) body: Vec<u8>,
}

impl Answer {
    fn has_header(&self, text: &str) -> bool {
        self.head.lines().any(|line| line == text)
    }
}

async fn connect(server: &Server) -> TcpStream {
    TcpStream::connect(authority(server)).await.expect("expected a connection")
}

/// Sends bytes and reads the answer up to the end of the connection. `None` if there is no answer.
pub(crate) async fn exchange(server: &Server, request: &str) -> Option<Answer> {
    let mut socket = connect(server).await;
    socket.write_all(request.as_bytes()).await.ok();
    let mut bytes = Vec::new();
    with_timeout(socket.read_to_end(&mut bytes)).await.ok();
    let end = bytes.windows(4).position(|window| window == b"\r\n\r\n")?;
    let head = String::from_utf8_lossy(&bytes[..end]).to_ascii_lowercase();
    let status = head.split(' ').nth(1)?.parse().ok()?;
    Some(Answer { status, head, body: bytes[end + 4..].to_vec() })
}

/// A GET request with further header lines.
async fn get(server: &Server, path: &str, host: &str, headers: &str) -> Answer {
    let request = format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n{headers}\r\n");
    exchange(server, &request).await.expect("expected an answer")
}

#[tokio::test(flavor = "multi_thread")]
async fn page_needs_own_host() {
    let server = Server::start_with(|config| config).await;
    let page = get(&server, "/", authority(&server), "").await;
    assert_eq!(page.status, 200, "{page:?}");
    assert!(page.body.starts_with(&[0x1f, 0x8b]), "expected gzip");
    for header in ["content-encoding: gzip", "cache-control: no-store", "referrer-policy: no-referrer"] {
        assert!(page.has_header(header), "{header}: {page:?}");
    }
    let connect_source = format!("connect-src 'self' ws://{};", authority(&server));
    assert!(page.head.contains("content-security-policy: default-src 'none';"), "{}", page.head);
    assert!(page.head.contains(&connect_source), "{}", page.head);
    // Through a tunnel, the page is requested with another port.
    assert_eq!(get(&server, "/", "localhost:7", "").await.status, 200);

    for (path, host, headers, status) in [
        ("/", "evil.example", "", 403),
        ("/", "localhost", "Origin: http://evil.example\r\n", 403),
        ("/", "localhost", "Host: localhost\r\n", 403),
        ("/websocket", "localhost", "", 400),
        ("/session", "localhost", "", 405),
        ("/recording", "localhost", "", 404),
        ("/favicon.ico", "localhost", "", 404),
        ("/index.html", "localhost", "", 404),
    ] {
        let answer = get(&server, path, host, headers).await;
        assert_eq!(answer.status, status, "{path} {host} {headers}");
        assert!(answer.has_header("connection: close") && answer.has_header("x-content-type-options: nosniff"));
        let text = String::from_utf8_lossy(&answer.body);
        assert_eq!(text.contains("modalcast serve"), status == 403, "{text}");
    }
    let post = "POST / HTTP/1.1\r\nHost: localhost\r\nContent-Length: 2\r\n\r\nab";
    assert_eq!(exchange(&server, post).await.expect("expected an answer").status, 405);
    let no_host = "GET / HTTP/1.0\r\n\r\n";
    assert_eq!(exchange(&server, no_host).await.expect("expected an answer").status, 403);
}

/// A proxy keeps the public host and path, or replaces them.
#[tokio::test(flavor = "multi_thread")]
async fn page_is_served_behind_a_proxy() {
    let public_url = || Some("https://lab.example/render".parse().expect("expected a URL"));
    let server = Server::start_with(|config| Config { public_url: public_url(), ..config }).await;
    let own = authority(&server);
    for (path, host) in
        [("/render/", "lab.example"), ("/", "lab.example"), ("/render/", own), ("/", own), ("/render", "lab.example")]
    {
        let page = get(&server, path, host, "Origin: https://lab.example\r\n").await;
        assert_eq!(page.status, 200, "{path} {host}");
        let own = if host == own { format!("ws://{own} ") } else { String::new() };
        assert!(page.head.contains(&format!("connect-src 'self' {own}wss://lab.example;")), "{}", page.head);
    }
    for (path, host) in [("/rendering/", "lab.example"), ("/render/render/", "lab.example")] {
        assert_eq!(get(&server, path, host, "").await.status, 404, "{path}");
    }
    let page_path = "/render/";
    assert_eq!(get(&server, page_path, "evil.example", "").await.status, 403);
    assert_eq!(get(&server, page_path, "lab.example", "Origin: http://lab.example\r\n").await.status, 403);
    // Control: the same requests without the option.
    let server = Server::start_with(|config| config).await;
    assert_eq!(get(&server, "/", "lab.example", "").await.status, 403);
    assert_eq!(get(&server, page_path, "localhost", "").await.status, 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn websocket_needs_origin_and_subprotocol() {
    let server = Server::start_with(|config| config).await;
    let own_origin = format!("http://{}", authority(&server));
    for (name, value, is_accepted) in [
        ("origin", own_origin.as_str(), true),
        ("x-other", "1", true),
        ("origin", "http://evil.example", false),
        ("origin", "null", false),
        ("host", "evil.example", false),
        ("sec-websocket-protocol", "modalcast.v2", false),
        ("sec-websocket-version", "8", false),
    ] {
        let result = handshake(connect(&server).await, &server, &[(name, value)]).await;
        assert_eq!(result.is_ok(), is_accepted, "{name}: {value}");
        if let Err(error) = result {
            let WebSocketError::Http(answer) = error else { panic!("expected an answer, got {error}") };
            assert!([400, 403].contains(&answer.status().as_u16()));
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn health_needs_no_credential() {
    let server = Server::start_with(|config| config).await;
    let answer = get(&server, "/healthz", authority(&server), "").await;
    assert_eq!((answer.status, &answer.body[..]), (200, &b"serving\n"[..]));
    assert_eq!(get(&server, "/healthz", "evil.example", "").await.status, 403);
}

#[tokio::test(flavor = "multi_thread")]
async fn viewer_can_be_turned_off() {
    let server = Server::start_with(|config| Config { viewer: false, ..config }).await;
    let request = "GET / HTTP/1.1\r\nHost: localhost\r\n\r\n";
    assert!(exchange(&server, request).await.is_none());
    let mut client = ServerServiceClient::new(server.channel().await);
    let info = with_timeout(client.get_server_info(v1::GetServerInfoRequest {})).await.expect("expected an answer");
    assert_eq!(info.get_ref().viewer_url_path, "");
    assert!(!info.get_ref().features().any(|feature| feature == v1::Feature::Viewer));
}

/// Connections with slow, unfinished or large heads are closed. Afterwards, another client is served.
#[tokio::test(flavor = "multi_thread")]
async fn slow_and_large_requests_are_closed() {
    let server = Server::start_with(|config| Config { handshake_timeout: SILENCE_LIMIT, ..config }).await;
    let trickle = async {
        let mut socket = connect(&server).await;
        let head = b"GET / HTTP/1.1\r\nHost: localhost\r\n";
        socket.write_all(head).await.expect("expected an open connection");
        // A byte at a time does not extend the deadline.
        while socket.write_all(b"X").await.is_ok() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    let send_start = async |bytes: &'static [u8]| {
        let mut socket = connect(&server).await;
        socket.write_all(bytes).await.expect("expected an open connection");
        let mut answer = Vec::new();
        with_timeout(socket.read_to_end(&mut answer)).await.ok();
        assert!(!answer.starts_with(b"HTTP/1.1 200"), "{bytes:?}");
    };
    tokio::join!(
        with_timeout(trickle),
        send_start(b"G"),
        send_start(b"PRI * HTTP/1.1\r\n"),
        send_start(b"\r\n"),
        send_start(b"\x16\x03\x01"),
    );
    let large = format!("GET / HTTP/1.1\r\nHost: localhost\r\nX-Large: {}\r\n\r\n", "x".repeat(64 << 10));
    let answer = exchange(&server, &large).await;
    assert!(answer.is_none_or(|answer| answer.status == 431));
    let many = format!("GET / HTTP/1.1\r\nHost: localhost\r\n{}\r\n", "X: 1\r\n".repeat(1000));
    assert!(exchange(&server, &many).await.is_none_or(|answer| answer.status == 431));
    assert_eq!(get(&server, "/healthz", "localhost", "").await.status, 200);
}

/// Connections of browsers without calls make room for new clients when the server is full.
#[tokio::test(flavor = "multi_thread")]
async fn full_server_closes_browsers_without_calls() {
    let limits = |config| Config { connections: 4, ..config };
    let server = Server::start_with(limits).await;
    let mut silent = connect(&server).await;
    silent.write_all(b"GET /").await.expect("expected an open connection");
    let mut websockets = Vec::new();
    for _ in 0..3 {
        websockets.push(WebSocketClient::connect(&server).await);
    }
    let mut clients = Vec::new();
    for _ in 0..4 {
        let mut client = SceneServiceClient::new(server.channel().await);
        with_timeout(client.list_scenes(v1::ListScenesRequest {})).await.expect("expected an answer");
        clients.push(client);
    }
    for mut websocket in websockets {
        websocket.closed().await;
    }
    with_timeout(silent.read_to_end(&mut Vec::new())).await.ok();
}

/// The viewer is also served at a Unix socket, for tunnels.
#[tokio::test(flavor = "multi_thread")]
async fn unix_socket_serves_the_viewer() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let path = folder.path().join("socket");
    let listen = ListenAddress::Unix(path.clone());
    let _server =
        Server::start_with(|config| Config { listen: [config.listen, vec![listen]].concat(), ..config }).await;
    let mut socket = tokio::net::UnixStream::connect(&path).await.expect("expected a connection");
    let request = b"GET / HTTP/1.1\r\nHost: localhost:8000\r\n\r\n";
    socket.write_all(request).await.expect("expected an open connection");
    let mut answer = Vec::new();
    with_timeout(socket.read_to_end(&mut answer)).await.expect("expected an answer");
    assert!(answer.starts_with(b"HTTP/1.1 200"));
}
