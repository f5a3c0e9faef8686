//! Links to the viewer, and the sessions for which pages exchange their codes.

use modalcast::config::{Config, ViewerRecording};
use modalcast::identity::Role;
use modalcast_client::{Client, ConnectOptions, Error};
use modalcast_proto::v1;
use tonic::Code;

use crate::identity::{GuardedServer, token_of, write_principals};
use crate::service_harness::Server;
use crate::viewer_port::{Answer, exchange};
use crate::websocket_client::{SESSION, WebSocketClient};

async fn client(guarded: &GuardedServer, role: Role) -> Client {
    let options = ConnectOptions::default().with_token(token_of(role));
    Client::connect_with(&guarded.server.address, &options).await.expect("expected a connection")
}

/// The code of a link.
fn code_of(url_path: &str) -> &str {
    url_path.strip_prefix("/#code=").expect("expected a code")
}

async fn post_code(server: &Server, code: &str) -> Answer {
    let length = code.len();
    let request = format!("POST /session HTTP/1.1\r\nHost: localhost\r\nContent-Length: {length}\r\n\r\n{code}");
    exchange(server, &request).await.expect("expected an answer")
}

/// The token of a session with the rights of a role.
async fn new_session(guarded: &GuardedServer, role: Role) -> String {
    let link = client(guarded, role).await.create_viewer_link("").await.expect("expected a link");
    let answer = post_code(&guarded.server, code_of(&link.url_path)).await;
    assert_eq!(answer.status, 200, "{answer:?}");
    String::from_utf8(answer.body).expect("expected a token")
}

/// The code of the status of a call on a WebSocket with a session.
async fn call(websocket: &mut WebSocketClient, method: &str) -> Code {
    Code::from(websocket.call(method, &v1::ListScenesRequest {}).await.status.code)
}

const LIST: &str = "/modalcast.v1.SceneService/ListScenes";
const UPLOAD: &str = "/modalcast.v1.SceneService/FindUploadedFiles";

#[tokio::test(flavor = "multi_thread")]
async fn session_has_the_rights_of_the_principal_of_its_link() {
    let guarded = GuardedServer::start().await;
    let mut websocket = WebSocketClient::connect(&guarded.server).await;
    assert_eq!(call(&mut websocket, LIST).await, Code::Unauthenticated);
    // The request has no hash, so a permitted call fails later.
    for (role, upload) in [(Role::Pixels, Code::PermissionDenied), (Role::Upload, Code::InvalidArgument)] {
        let session = new_session(&guarded, role).await;
        websocket.send(0, SESSION, session.as_bytes()).await;
        assert_eq!(call(&mut websocket, LIST).await, Code::Ok, "{role:?}");
        assert_eq!(call(&mut websocket, UPLOAD).await, upload, "{role:?}");
        // A session is valid on further connections.
        let mut second = WebSocketClient::connect(&guarded.server).await;
        second.send(0, SESSION, session.as_bytes()).await;
        assert_eq!(call(&mut second, LIST).await, Code::Ok, "{role:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn code_is_valid_once_and_wrong_sessions_close_the_connection() {
    let guarded = GuardedServer::start().await;
    let link = client(&guarded, Role::View).await.create_viewer_link("").await.expect("expected a link");
    assert_eq!(link.urls, std::slice::from_ref(&guarded.server.address));
    let code = code_of(&link.url_path);
    assert_eq!(code.len(), 64);
    let other_site = format!(
        "POST /session HTTP/1.1\r\nHost: localhost\r\nOrigin: http://evil.example\r\nContent-Length: 64\r\n\r\n{code}"
    );
    assert_eq!(exchange(&guarded.server, &other_site).await.expect("expected an answer").status, 403);
    assert_eq!(post_code(&guarded.server, code).await.status, 200);
    for code in [code, "", "x", &"0".repeat(64), &"0".repeat(600)] {
        let answer = post_code(&guarded.server, code).await;
        assert_eq!(answer.status, 403, "{code}");
        assert!(code.is_empty() || !String::from_utf8_lossy(&answer.body).contains(&*code.repeat(2)));
    }
    for token in [code, "", &token_of(Role::View)] {
        let mut websocket = WebSocketClient::connect(&guarded.server).await;
        websocket.send(0, SESSION, token.as_bytes()).await;
        assert_eq!(websocket.closed().await, Some(4003), "{token}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn only_admins_make_links_for_others() {
    let guarded = GuardedServer::start().await;
    let admin = client(&guarded, Role::Admin).await;
    let link = admin.create_viewer_link("pixels").await.expect("expected a link");
    let answer = post_code(&guarded.server, code_of(&link.url_path)).await;
    let mut websocket = WebSocketClient::connect(&guarded.server).await;
    websocket.send(0, SESSION, &answer.body).await;
    assert_eq!(call(&mut websocket, UPLOAD).await, Code::PermissionDenied, "expected the rights of 'pixels'");
    let error = admin.create_viewer_link("nobody").await.expect_err("expected an unknown principal");
    assert!(matches!(error, Error::Status { code: Code::InvalidArgument, .. }), "{error:?}");
    let error = client(&guarded, Role::Upload).await.create_viewer_link("pixels").await.expect_err("expected a denial");
    assert!(matches!(error, Error::Status { code: Code::PermissionDenied, .. }), "{error:?}");
    let own = client(&guarded, Role::Upload).await.create_viewer_link("upload").await;
    own.expect("expected a link to the own principal");
}

/// Its page would connect again with the same session.
#[tokio::test(flavor = "multi_thread")]
async fn session_ends_when_an_administrator_ends_its_client() {
    let guarded = GuardedServer::start().await;
    let session = new_session(&guarded, Role::View).await;
    let mut websocket = WebSocketClient::connect(&guarded.server).await;
    websocket.send(0, SESSION, session.as_bytes()).await;
    assert_eq!(call(&mut websocket, LIST).await, Code::Ok);
    let admin = client(&guarded, Role::Admin).await;
    let clients = admin.list_clients().await.expect("expected the rights of an administrator").clients;
    let listed = clients.iter().find(|client| client.kind() == v1::ClientKind::Session).expect("expected a session");
    assert!(listed.id.starts_with("view/session-") && listed.address.starts_with("127.0.0.1:"), "{listed:?}");
    admin.end_client(&listed.id).await.expect("expected the end of the session");
    assert_eq!(websocket.closed().await, Some(1001));
    let mut second = WebSocketClient::connect(&guarded.server).await;
    second.send(0, SESSION, session.as_bytes()).await;
    assert_eq!(second.closed().await, Some(4003));
}

#[tokio::test(flavor = "multi_thread")]
async fn session_ends_with_the_credential_of_its_link() {
    let guarded = GuardedServer::start().await;
    let session = new_session(&guarded, Role::View).await;
    let mut websocket = WebSocketClient::connect(&guarded.server).await;
    websocket.send(0, SESSION, session.as_bytes()).await;
    assert_eq!(call(&mut websocket, LIST).await, Code::Ok);
    write_principals(&guarded.principals(), &[Role::Drive]);
    let is_revoked = async {
        while call(&mut websocket, LIST).await != Code::Unauthenticated {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    };
    crate::service_harness::with_timeout(is_revoked).await;
    let mut second = WebSocketClient::connect(&guarded.server).await;
    second.send(0, SESSION, session.as_bytes()).await;
    assert_eq!(second.closed().await, Some(4003));
}

/// The page is public; the recording is not.
#[tokio::test(flavor = "multi_thread")]
async fn recording_needs_a_session() {
    let file = bytes::Bytes::from_static(b"\x89MCAP0\r\ncontent of a test");
    let recording = Some(ViewerRecording { file: file.clone(), slow: 1.0 });
    let guarded = GuardedServer::start_with(|config| Config { viewer_recording: recording, ..config }).await;
    let get = async |path: &str, session: &str| {
        let request = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {session}\r\n\r\n");
        exchange(&guarded.server, &request).await.expect("expected an answer")
    };
    let page = get("/", "x").await;
    assert_eq!(page.status, 200);
    assert!(!page.body.windows(17).any(|window| window == b"content of a test"), "expected no recording in the page");
    assert_eq!(get("/recording", &"0".repeat(64)).await.status, 403);
    let session = new_session(&guarded, Role::Pixels).await;
    let answer = get("/recording", &session).await;
    assert_eq!((answer.status, answer.body), (200, file.to_vec()));
}
