//! Unix sockets: the same service and limits as on TCP, for the user of the server only.

use std::os::unix::fs::PermissionsExt as _;

use modalcast::config::{Config, ListenAddress};
use modalcast_client::{Client, Delivery, DriveRequest, Step};
use tokio::io::AsyncReadExt as _;
use tokio::net::UnixStream;

use crate::service_harness::{SILENCE_LIMIT, Server, with_timeout};

/// Starts a server that listens on a free port and on a socket in `folder`.
async fn start_on_both(folder: &std::path::Path, change: impl FnOnce(Config) -> Config) -> (Server, String) {
    let path = folder.join("modalcast.sock");
    let url = format!("unix:{}", path.display());
    let add_socket = |mut config: Config| {
        config.listen.push(ListenAddress::Unix(path));
        change(config)
    };
    (Server::start_with(add_socket).await, url)
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_of_both_sockets_use_the_same_server() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (server, url) = start_on_both(folder.path(), |config| config).await;
    let path = folder.path().join("modalcast.sock");
    assert_eq!(std::fs::metadata(&path).expect("expected the socket").permissions().mode() & 0o777, 0o600);
    let (local, remote) = (
        Client::connect(&url).await.expect("expected a connection to the Unix socket"),
        Client::connect(&server.address).await.expect("expected a connection over TCP"),
    );
    local.open_scene("strips", "").await.expect("expected the scene to open");
    assert_eq!(remote.list_scenes().await.expect("expected a list").scenes[0].scene, "strips");
    let mut steps = local.drive(&DriveRequest::new("strips", Delivery::Lossless)).await.expect("expected a stream");
    for number in 1..=20 {
        steps.step(&Step::new(number, 0.0).q(0, &[0.1, 0.2])).await.expect("expected a sent step");
    }
    with_timeout(steps.flush()).await.expect("expected acknowledgments");
    drop(steps);
    server.stop().await.expect("expected the server to stop");
    assert!(!path.exists(), "expected the server to remove its socket");
}

#[tokio::test(flavor = "multi_thread")]
async fn silent_unix_connection_is_closed() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let limits = |config| Config { handshake_timeout: SILENCE_LIMIT, ..config };
    let (_server, _) = start_on_both(folder.path(), limits).await;
    let mut silent = UnixStream::connect(folder.path().join("modalcast.sock")).await.expect("expected a connection");
    let result = with_timeout(silent.read(&mut [0; 1])).await;
    assert!(matches!(result, Ok(0) | Err(_)), "{result:?}");
}
