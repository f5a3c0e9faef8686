//! Principals, credentials and roles, as clients of a server see them.

use std::path::{Path, PathBuf};

use modalcast::config::{Authentication, Config};
use modalcast::identity::{Role, TokenHash};
use modalcast_client::{Client, ConnectOptions, Error};
use modalcast_proto::v1;
use tonic::transport::Channel;
use tonic::{Code, Request, Status};
use v1::scene_service_client::SceneServiceClient;
use v1::server_service_client::ServerServiceClient;
use v1::state_service_client::StateServiceClient;

use crate::service_harness::{Server, rejection_details, with_timeout};

/// The token of the principal with this name.
pub(crate) fn token_of_name(name: &str) -> String {
    format!("token-of-{name}")
}

/// The token of the principal with each role.
pub(crate) fn token_of(role: Role) -> String {
    token_of_name(role.name())
}

/// Writes a file with one principal per role.
pub(crate) fn write_principals(path: &Path, roles: &[Role]) {
    write_named_principals(path, &roles.iter().map(|role| (role.name(), *role)).collect::<Vec<_>>());
}

/// Writes a file of principals with these names and roles.
pub(crate) fn write_named_principals(path: &Path, principals: &[(&str, Role)]) {
    let entry = |(name, role): &(&str, Role)| {
        let (role, hash) = (role.name(), TokenHash::of(&token_of_name(name)).expect("expected a token"));
        format!("[[principal]]\nname = '{name}'\nrole = '{role}'\n[[principal.token]]\nsha256 = '{hash}'\n")
    };
    // Replaced at once, so that the server never reads a part of it.
    let new = path.with_extension("new");
    std::fs::write(&new, principals.iter().map(entry).collect::<String>()).expect("expected a writable folder");
    std::fs::rename(&new, path).expect("expected a writable folder");
}

/// A server that identifies its callers.
pub(crate) struct GuardedServer {
    pub(crate) server: Server,
    folder: tempfile::TempDir,
}

impl GuardedServer {
    /// A server with one principal per role.
    pub(crate) async fn start() -> Self {
        Self::start_with(|config| config).await
    }

    pub(crate) async fn start_with(change: impl FnOnce(Config) -> Config) -> Self {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let principals = folder.path().join("principals.toml");
        write_principals(&principals, &Role::ALL);
        let guard = |config: Config| Config {
            authentication: Authentication::UsersAndTokens,
            local_sockets: Some(folder.path().join("sockets")),
            principals: Some(principals.clone()),
            ..config
        };
        let server = Server::start_with(|config| change(guard(config))).await;
        Self { server, folder }
    }

    pub(crate) fn principals(&self) -> PathBuf {
        self.folder.path().join("principals.toml")
    }

    pub(crate) fn socket(&self) -> PathBuf {
        let port = self.server.address.rsplit(':').next().expect("expected a port");
        self.folder.path().join("sockets").join(format!("{port}.sock"))
    }

    pub(crate) async fn channel(&self) -> Channel {
        self.server.channel().await
    }
}

pub(crate) fn with_token<T>(message: T, token: Option<&str>) -> Request<T> {
    let mut request = Request::new(message);
    if let Some(token) = token {
        let value = format!("Bearer {token}").parse().expect("expected a metadata value");
        request.metadata_mut().insert("authorization", value);
    }
    request
}

async fn server_info(channel: Channel, token: Option<&str>) -> Result<v1::GetServerInfoResponse, Status> {
    let request = with_token(v1::GetServerInfoRequest {}, token);
    with_timeout(ServerServiceClient::new(channel).get_server_info(request)).await.map(tonic::Response::into_inner)
}

#[tokio::test]
async fn calls_without_a_known_token_are_unauthenticated() {
    let guarded = GuardedServer::start().await;
    for token in [None, Some("token-of-nobody"), Some(""), Some("token-of-admin ")] {
        let result = server_info(guarded.channel().await, token).await;
        if token == Some("token-of-admin ") {
            // Spaces around a token are no part of it (RFC 9110, 5.5).
            assert!(result.is_ok());
            continue;
        }
        let status = result.expect_err("expected a rejection");
        assert_eq!(
            (status.code(), rejection_details(&status).reason()),
            (Code::Unauthenticated, v1::Reason::Unauthenticated)
        );
        assert!(!status.message().contains("nobody"), "expected no token in the message");
    }
    assert!(server_info(guarded.channel().await, Some("token-of-pixels")).await.is_ok());
}

/// Every method of the contract, by every role. The message is empty, so a permitted call fails later, or succeeds.
#[tokio::test]
async fn every_method_is_permitted_from_its_role_on() {
    let guarded = GuardedServer::start().await;
    let page = include_str!("../../deploy/identity.md");
    let rows = page.lines().filter_map(|line| {
        let (method, role) = line.strip_prefix("| `")?.strip_suffix(" |")?.split_once("` | ")?;
        (method.contains('/') && !method.contains("Reflection")).then(|| (method, role.trim_matches('`')))
    });
    let rows: Vec<_> = rows.collect();
    assert!(rows.len() > 20, "expected the table of methods");
    let channel = guarded.channel().await;
    for (method, required) in rows {
        let minimum = Role::ALL.iter().position(|role| role.name() == required);
        assert_eq!(minimum.is_none(), required == "nothing", "{method}: {required}");
        for (index, role) in Role::ALL.iter().enumerate() {
            let status = call(&channel, method, &[], Some(&token_of(*role))).await;
            let is_denied = status.code() == Code::PermissionDenied;
            assert_eq!(is_denied, minimum.is_some_and(|minimum| index < minimum), "{method} as {role:?}: {status:?}");
        }
        let status = call(&channel, method, &[], None).await;
        assert_eq!(status.code() == Code::Unauthenticated, minimum.is_some(), "{method}: {status:?}");
    }
}

/// Calls a method with one message. Returns the status with which the call ends within a short time, or `OK` for one that
/// goes on.
pub(crate) async fn call(channel: &Channel, method: &str, message: &[u8], token: Option<&str>) -> Status {
    use http_body::Body as _;
    use tonic::codegen::{Service as _, http};
    let mut request = http::Request::post(format!("http://server/{method}"))
        .header("content-type", "application/grpc")
        .header("te", "trailers");
    if let Some(token) = token {
        request = request.header("authorization", format!("Bearer {token}"));
    }
    let prefix = [&[0][..], &(message.len() as u32).to_be_bytes()].concat();
    let body = http_body_util::Full::new(bytes::Bytes::from([&prefix, message].concat()));
    let request = request.body(tonic::body::Body::new(body)).expect("expected a request");
    let mut channel = channel.clone();
    std::future::poll_fn(|cx| channel.poll_ready(cx)).await.expect("expected an open connection");
    let response = with_timeout(channel.call(request)).await.expect("expected a response");
    if let Some(status) = Status::from_header_map(response.headers()) {
        return status;
    }
    let mut body = std::pin::pin!(response.into_body());
    loop {
        let frame = std::future::poll_fn(|cx| body.as_mut().poll_frame(cx));
        // A stream of a Watch has no end.
        let Ok(frame) = tokio::time::timeout(std::time::Duration::from_secs(2), frame).await else {
            return Status::ok("");
        };
        let Some(frame) = frame else { return Status::ok("") };
        if let Ok(trailers) = frame.expect("expected a frame").into_trailers() {
            return Status::from_header_map(&trailers).unwrap_or_else(|| Status::ok(""));
        }
    }
}

#[tokio::test]
async fn own_user_needs_no_token_at_the_socket() {
    let guarded = GuardedServer::start().await;
    let url = format!("unix:{}", guarded.socket().display());
    let client = Client::connect(&url).await.expect("expected a connection");
    client.open_scene("strips", "").await.expect("expected the rights of the owner");
    // A bearer token outranks the identity of the connection.
    let options = ConnectOptions::default().with_token(token_of(Role::View));
    let client = Client::connect_with(&url, &options).await.expect("expected a connection");
    let error = client.open_scene("strips", "").await.expect_err("expected a denial");
    assert!(matches!(error, Error::Status { code: Code::PermissionDenied, .. }), "{error:?}");
    let options = ConnectOptions::default().with_token("wrong");
    let error = Client::connect_with(&url, &options).await.expect_err("expected a rejection");
    assert!(matches!(error, Error::Status { code: Code::Unauthenticated, .. }), "{error:?}");
}

#[tokio::test]
async fn shared_account_needs_a_token_at_the_socket() {
    let tokens = |config| Config { authentication: Authentication::Tokens, ..config };
    let guarded = GuardedServer::start_with(tokens).await;
    let url = format!("unix:{}", guarded.socket().display());
    assert!(Client::connect(&url).await.is_err());
    let options = ConnectOptions::default().with_token(token_of(Role::Pixels));
    Client::connect_with(&url, &options).await.expect("expected a connection");
}

/// Streams of a revoked token end; those of others continue.
#[tokio::test]
async fn revoked_token_ends_its_streams() {
    let guarded = GuardedServer::start().await;
    let owner = Client::connect(&format!("unix:{}", guarded.socket().display())).await.expect("expected a connection");
    owner.open_scene("strips", "").await.expect("expected a scene");
    owner.share_scene("strips", &["*"]).await.expect("expected a shared scene");
    let mut streams = Vec::new();
    for role in [Role::View, Role::Drive] {
        let delivery = v1::Delivery::Latest.into();
        let request = v1::StreamStatesRequest { scene: "strips".into(), delivery, ..Default::default() };
        let mut states = StateServiceClient::new(guarded.channel().await);
        let opened = states.stream_states(with_token(request, Some(&token_of(role)))).await;
        let mut stream = opened.expect("expected a stream").into_inner();
        with_timeout(stream.message()).await.expect("expected a state");
        streams.push(stream);
    }
    write_principals(&guarded.principals(), &[Role::Drive]);
    let mut revoked = streams.remove(0);
    let status = loop {
        match with_timeout(revoked.message()).await {
            Ok(Some(_)) => {}
            Ok(None) => panic!("expected a status"),
            Err(status) => break status,
        }
    };
    assert_eq!(
        (status.code(), rejection_details(&status).reason()),
        (Code::Unauthenticated, v1::Reason::Unauthenticated)
    );
    let mut scenes = SceneServiceClient::new(guarded.channel().await);
    scenes
        .list_scenes(with_token(v1::ListScenesRequest {}, Some(&token_of(Role::Drive))))
        .await
        .expect("expected the other token to be valid");
    let next = tokio::time::timeout(std::time::Duration::from_millis(200), streams[0].message()).await;
    assert!(next.is_err() || next.is_ok_and(|message| message.is_ok()), "expected the other stream to continue");
}
