//! Encryption: certificates of the server and of clients, as clients see them.

use std::path::PathBuf;
use std::sync::Arc;

use modalcast::config::{Authentication, Config, ListenAddress, PublicUrl, ServerCertificate, TlsSettings};
use modalcast::identity::TokenHash;
use modalcast::service;
use modalcast_client::{Client, Code, ConnectOptions, Delivery, DriveRequest, Error, Step};
use rcgen::{BasicConstraints, CertificateParams, DnType, IsCa, Issuer, KeyPair};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::TcpStream;
use tokio::task::JoinSet;
use tokio_rustls::TlsConnector;
use tokio_rustls::client::TlsStream;
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{ClientConfig, RootCertStore};

use crate::service_harness::{SILENCE_LIMIT, Server, with_timeout};
use crate::websocket_client::{authority, handshake};

/// The token of the principal `ben`.
const TOKEN_OF_BEN: &str = "token-of-ben";

/// An authority that signs certificates.
struct Authority {
    pem: String,
    issuer: Issuer<'static, KeyPair>,
}

impl Authority {
    fn new(name: &str) -> Self {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, name);
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        let key = KeyPair::generate().expect("expected a key");
        let pem = params.self_signed(&key).expect("expected a certificate").pem();
        Self { pem, issuer: Issuer::new(params, key) }
    }

    /// A new certificate and its key, in PEM.
    fn sign(&self, names: &[&str]) -> (String, String) {
        let names: Vec<String> = names.iter().map(|name| (*name).to_owned()).collect();
        let params = CertificateParams::new(names).expect("expected valid names");
        let key = KeyPair::generate().expect("expected a key");
        let certificate = params.signed_by(&key, &self.issuer).expect("expected a certificate");
        (certificate.pem(), key.serialize_pem())
    }
}

/// Files of certificates, keys and principals.
struct Files(tempfile::TempDir);

impl Files {
    fn new() -> Self {
        Self(tempfile::tempdir().expect("expected a temporary folder"))
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Replaces a file at once. Only its user can read it.
    fn write(&self, name: &str, text: &str) -> PathBuf {
        use std::os::unix::fs::PermissionsExt as _;
        let (path, new) = (self.path(name), self.path("new"));
        std::fs::write(&new, text).expect("expected a writable folder");
        std::fs::set_permissions(&new, std::fs::Permissions::from_mode(0o600)).expect("expected permissions");
        std::fs::rename(&new, &path).expect("expected a writable folder");
        path
    }

    /// Writes a certificate of the server at 127.0.0.1, and returns its settings.
    fn serve_with(&self, authority: &Authority) -> ServerCertificate {
        let (certificate, key) = authority.sign(&["127.0.0.1"]);
        ServerCertificate::Files {
            certificate: self.write("server.pem", &certificate),
            key: self.write("server.key", &key),
        }
    }

    /// The options of a client that trusts an authority.
    fn trusting(&self, authority: &Authority) -> ConnectOptions {
        ConnectOptions::default().with_ca_file(self.write("ca.pem", &authority.pem))
    }

    /// The options of a client that trusts `servers` and has a certificate of `clients`.
    fn identified(&self, servers: &Authority, clients: &Authority, name: &str) -> ConnectOptions {
        let (certificate, key) = clients.sign(&[name]);
        let (certificate, key) = (self.write("client.pem", &certificate), self.write("client.key", &key));
        self.trusting(servers).with_client_certificate(certificate, key)
    }

    /// Writes `anna` with a certificate and a role, and `ben`, who views, with a token.
    fn write_principals(&self, certificate: &str, role: &str) {
        let hash = TokenHash::of(TOKEN_OF_BEN).expect("expected a token");
        let text = format!(
            "[[principal]]\nname = 'anna'\nrole = '{role}'\ncertificates = ['{certificate}']\n\
             [[principal]]\nname = 'ben'\nrole = 'view'\n[[principal.token]]\nsha256 = '{hash}'\n"
        );
        self.write("principals.toml", &text);
    }

    async fn start(&self, certificate: ServerCertificate, client_ca: Option<PathBuf>) -> Server {
        self.start_with(certificate, client_ca, |config| config).await
    }

    async fn start_with(
        &self,
        certificate: ServerCertificate,
        client_ca: Option<PathBuf>,
        change: impl FnOnce(Config) -> Config,
    ) -> Server {
        self.write_principals("anna.lab.example", "drive");
        let encrypt = |config: Config| Config {
            tls: Some(TlsSettings { certificate, client_ca }),
            authentication: Authentication::UsersAndTokens,
            local_sockets: Some(self.path("sockets")),
            principals: Some(self.path("principals.toml")),
            state: self.path("state"),
            ..config
        };
        Server::start_with(|config| change(encrypt(config))).await
    }

    /// Token of the server's owner.
    fn owner_token(&self) -> String {
        std::fs::read_to_string(self.path("state").join("token")).expect("expected a token").trim().to_owned()
    }
}

async fn connect(server: &Server, options: &ConnectOptions) -> Result<Client, Error> {
    with_timeout(Client::connect_with(&server.address, options)).await
}

/// The code of the status of an error.
fn code_of<T>(result: Result<T, Error>) -> Option<Code> {
    match result {
        Err(Error::Status { code, .. }) => Some(code),
        Err(error) => panic!("expected a status, got {error:?}"),
        Ok(_) => None,
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn self_signed_certificate_encrypts_calls() {
    let files = Files::new();
    let server = files.start(ServerCertificate::SelfSigned { names: vec!["lab.example".into()] }, None).await;
    assert!(server.address.starts_with("https://127.0.0.1:"), "{}", server.address);
    let ca_file = files.path("state").join("tls-certificate.pem");
    let trusting = ConnectOptions::default().with_ca_file(&ca_file);
    assert_eq!(code_of(connect(&server, &trusting).await), Some(Code::Unauthenticated));
    let client = connect(&server, &trusting.clone().with_token(files.owner_token())).await;
    let client = client.expect("expected a connection");
    client.open_scene("strips", "").await.expect("expected a scene");
    let mut steps = client.drive(&DriveRequest::new("strips", Delivery::Lossless)).await.expect("expected a stream");
    for number in 1..=20 {
        steps.step(&Step::new(number, 0.0).q(0, &[0.1, 0.2])).await.expect("expected a sent step");
    }
    with_timeout(steps.flush()).await.expect("expected acknowledgments");
    // `localhost` is one of its names, too.
    let by_name = server.address.replace("127.0.0.1", "localhost");
    let options = trusting.with_token(files.owner_token());
    with_timeout(Client::connect_with(&by_name, &options)).await.expect("expected a connection");
    // The Unix socket of the same port is plain, and the user is known there.
    let port = server.address.rsplit(':').next().expect("expected a port");
    let socket = format!("unix:{}", files.path("sockets").join(format!("{port}.sock")).display());
    let scenes = Client::connect(&socket).await.expect("expected a connection").list_scenes().await;
    assert_eq!(scenes.expect("expected a list").scenes.len(), 1);
}

/// The error names the certificate, and retries end.
#[tokio::test(flavor = "multi_thread")]
async fn unknown_authority_and_other_host_are_rejected() {
    let (files, authority, stranger) = (Files::new(), Authority::new("lab"), Authority::new("stranger"));
    let server = files.start(files.serve_with(&authority), None).await;
    let rejected = connect(&server, &files.trusting(&stranger).with_token(TOKEN_OF_BEN)).await;
    assert!(
        matches!(&rejected, Err(Error::Certificate { reason, .. }) if reason.contains("authority")),
        "{rejected:?}"
    );
    let by_name = server.address.replace("127.0.0.1", "localhost");
    let trusting = files.trusting(&authority).with_token(TOKEN_OF_BEN);
    let rejected = with_timeout(Client::connect_with(&by_name, &trusting)).await;
    assert!(
        matches!(&rejected, Err(Error::Certificate { reason, .. }) if reason.contains("localhost")),
        "{rejected:?}"
    );
    connect(&server, &trusting).await.expect("expected the control to connect");
    // Options of https at a plain server.
    let plain = Server::start_default().await;
    let url = plain.address.replace("http://", "https://");
    let rejected = with_timeout(Client::connect_with(&url, &trusting)).await;
    assert!(matches!(&rejected, Err(Error::Connect { reason, .. }) if reason.contains("http://")), "{rejected:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn new_certificate_serves_new_connections_only() {
    let (files, old, new) = (Files::new(), Authority::new("old"), Authority::new("new"));
    let server = files.start(files.serve_with(&old), None).await;
    let options = files.trusting(&old).with_token(files.owner_token());
    let client = connect(&server, &options).await.expect("expected a connection");
    client.open_scene("strips", "").await.expect("expected a scene");
    let mut steps = client.drive(&DriveRequest::new("strips", Delivery::Lossless)).await.expect("expected a stream");
    steps.step(&Step::new(1, 0.0)).await.expect("expected a sent step");
    files.serve_with(&new);
    let options = files.trusting(&new).with_token(files.owner_token());
    let replaced = async {
        while let Err(error) = connect(&server, &options).await {
            assert!(matches!(error, Error::Certificate { .. }), "{error:?}");
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
        }
    };
    with_timeout(replaced).await;
    steps.step(&Step::new(2, 0.0)).await.expect("expected an open stream");
    with_timeout(steps.flush()).await.expect("expected acknowledgments");
    let rejected = connect(&server, &files.trusting(&old).with_token(files.owner_token())).await;
    assert!(matches!(rejected, Err(Error::Certificate { .. })), "{rejected:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn client_certificate_identifies_a_principal() {
    let (files, servers, clients) = (Files::new(), Authority::new("servers"), Authority::new("clients"));
    let client_ca = files.write("client_ca.pem", &clients.pem);
    let server = files.start(files.serve_with(&servers), Some(client_ca)).await;
    let anna = connect(&server, &files.identified(&servers, &clients, "anna.lab.example")).await;
    let anna = anna.expect("expected a principal");
    anna.open_scene("strips", "").await.expect("expected the role 'drive'");
    // Not a principal, and no certificate.
    let mallory = files.identified(&servers, &clients, "mallory.lab.example");
    assert_eq!(code_of(connect(&server, &mallory).await), Some(Code::Unauthenticated));
    assert_eq!(code_of(connect(&server, &files.trusting(&servers)).await), Some(Code::Unauthenticated));
    // A token outranks a certificate.
    let ben = files.identified(&servers, &clients, "anna.lab.example").with_token(TOKEN_OF_BEN);
    let ben = connect(&server, &ben).await.expect("expected a principal");
    assert_eq!(code_of(ben.open_scene("strips", "").await), Some(Code::PermissionDenied));
    connect(&server, &files.trusting(&servers).with_token(TOKEN_OF_BEN)).await.expect("expected a principal");
    // The right name, by another authority.
    let forged = connect(&server, &files.identified(&servers, &servers, "anna.lab.example")).await;
    assert!(matches!(forged, Err(Error::Connect { .. })), "{forged:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn client_certificate_has_no_effect_without_its_authority() {
    let (files, authority) = (Files::new(), Authority::new("lab"));
    let server = files.start(files.serve_with(&authority), None).await;
    let anna = files.identified(&authority, &authority, "anna.lab.example");
    assert_eq!(code_of(connect(&server, &anna).await), Some(Code::Unauthenticated));
}

#[tokio::test(flavor = "multi_thread")]
async fn revoked_certificate_ends_its_calls() {
    let (files, authority) = (Files::new(), Authority::new("lab"));
    let client_ca = files.write("client_ca.pem", &authority.pem);
    let server = files.start(files.serve_with(&authority), Some(client_ca)).await;
    let options = files.identified(&authority, &authority, "anna.lab.example");
    let anna = connect(&server, &options).await.expect("expected a principal");
    anna.open_scene("strips", "").await.expect("expected a scene");
    let mut steps = anna.drive(&DriveRequest::new("strips", Delivery::Lossless)).await.expect("expected a stream");
    steps.step(&Step::new(1, 0.0)).await.expect("expected a sent step");
    with_timeout(steps.flush()).await.expect("expected an acknowledgment");
    files.write_principals("other.lab.example", "drive");
    let mut number = 2;
    let error = with_timeout(async {
        loop {
            let sent = steps.step(&Step::new(number, 0.0)).await;
            match sent.and(steps.flush().await) {
                Ok(()) => number += 1,
                Err(error) => break error,
            }
        }
    })
    .await;
    assert_eq!(code_of::<()>(Err(error)), Some(Code::Unauthenticated));
    assert_eq!(code_of(anna.list_scenes().await), Some(Code::Unauthenticated));
    assert_eq!(code_of(connect(&server, &options).await), Some(Code::Unauthenticated));
}

/// Sends bytes over TCP and reads the answer up to the end of the connection.
async fn exchange(server: &Server, request: &[u8]) -> Vec<u8> {
    let mut socket = TcpStream::connect(authority(server)).await.expect("expected a connection");
    socket.write_all(request).await.expect("expected an open connection");
    let mut answer = Vec::new();
    with_timeout(socket.read_to_end(&mut answer)).await.ok();
    answer
}

#[tokio::test(flavor = "multi_thread")]
async fn plain_clients_learn_that_the_server_expects_tls() {
    let (files, authority) = (Files::new(), Authority::new("lab"));
    let server = files.start(files.serve_with(&authority), None).await;
    let answer = exchange(&server, b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n").await;
    let answer = String::from_utf8(answer).expect("expected text");
    assert!(answer.starts_with("HTTP/1.1 400 ") && answer.ends_with("use https:// in the URL of this server\n"));
    let url = server.address.replace("https://", "http://");
    let options = ConnectOptions::default().with_token(TOKEN_OF_BEN);
    let error = with_timeout(Client::connect_with(&url, &options)).await.expect_err("expected an error");
    assert!(error.to_string().contains("https:// in its URL"), "{error}");
    // A damaged handshake ends the connection, without text.
    let answer = exchange(&server, &[22, 3, 1, 0, 4, 1, 2, 3, 4]).await;
    assert!(!answer.starts_with(b"HTTP"), "{answer:?}");
    connect(&server, &files.trusting(&authority).with_token(TOKEN_OF_BEN)).await.expect("expected a connection");
}

/// Connections that begin a handshake and do not complete it are closed, and others are served meanwhile.
#[tokio::test(flavor = "multi_thread")]
async fn slow_handshakes_are_closed_and_block_nobody() {
    let (files, authority) = (Files::new(), Authority::new("lab"));
    let limits = |config| Config { handshake_timeout: SILENCE_LIMIT, ..config };
    let server = files.start_with(files.serve_with(&authority), None, limits).await;
    let mut slow = JoinSet::new();
    for index in 0..64 {
        let begin: &[u8] = if index % 2 == 0 { &[] } else { &[22, 3, 1, 2, 0, 1, 0] };
        let mut socket = TcpStream::connect(self::authority(&server)).await.expect("expected a connection");
        socket.write_all(begin).await.expect("expected an open connection");
        slow.spawn(async move {
            let mut answer = Vec::new();
            with_timeout(socket.read_to_end(&mut answer)).await.ok();
            answer
        });
    }
    let options = files.trusting(&authority).with_token(TOKEN_OF_BEN);
    for _ in 0..8 {
        connect(&server, &options).await.expect("expected a connection");
    }
    while let Some(answer) = slow.join_next().await {
        assert_eq!(answer.expect("expected no panic"), b"");
    }
}

/// A full server closes connections in a handshake first, as all that have sent no request.
#[tokio::test(flavor = "multi_thread")]
async fn full_server_closes_handshakes_first() {
    let (files, authority) = (Files::new(), Authority::new("lab"));
    let limits = |config| Config { connections: 4, ..config };
    let server = files.start_with(files.serve_with(&authority), None, limits).await;
    let mut slow = Vec::new();
    for _ in 0..4 {
        let mut socket = TcpStream::connect(self::authority(&server)).await.expect("expected a connection");
        socket.write_all(&[22, 3, 1]).await.expect("expected an open connection");
        slow.push(socket);
    }
    let options = files.trusting(&authority).with_token(TOKEN_OF_BEN);
    let mut clients = Vec::new();
    for _ in 0..4 {
        clients.push(connect(&server, &options).await.expect("expected a connection"));
    }
    for mut socket in slow {
        with_timeout(socket.read_to_end(&mut Vec::new())).await.ok();
    }
    for client in clients {
        client.list_scenes().await.expect("expected an open connection");
    }
}

/// A TLS connection of a client that offers these protocols.
async fn tls_connection(server: &Server, authority: &Authority, protocols: &[&str]) -> TlsStream<TcpStream> {
    let mut roots = RootCertStore::empty();
    let certificate = CertificateDer::from_pem_slice(authority.pem.as_bytes()).expect("expected a certificate");
    roots.add(certificate).expect("expected an authority");
    let mut config = ClientConfig::builder().with_root_certificates(roots).with_no_client_auth();
    config.alpn_protocols = protocols.iter().map(|name| name.as_bytes().to_vec()).collect();
    let socket = TcpStream::connect(self::authority(server)).await.expect("expected a connection");
    let name = ServerName::try_from("127.0.0.1").expect("expected a name");
    TlsConnector::from(Arc::new(config)).connect(name, socket).await.expect("expected a handshake")
}

/// Browsers offer HTTP/2 and HTTP/1.1, and the viewer needs the latter.
#[tokio::test(flavor = "multi_thread")]
async fn browsers_get_the_viewer_and_its_websocket_over_tls() {
    let (files, authority) = (Files::new(), Authority::new("lab"));
    let server = files.start(files.serve_with(&authority), None).await;
    let host = self::authority(&server);
    for (offered, chosen) in [(&["h2", "http/1.1"][..], Some("http/1.1")), (&["h2"], Some("h2")), (&[], None)] {
        let connection = tls_connection(&server, &authority, offered).await;
        let protocol = connection.get_ref().1.alpn_protocol().map(<[u8]>::to_vec);
        assert_eq!(protocol.as_deref(), chosen.map(str::as_bytes), "{offered:?}");
    }
    let grpc_only = |config| Config { viewer: false, state: files.path("second_state"), ..config };
    let without_viewer = files.start_with(files.serve_with(&authority), None, grpc_only).await;
    let connection = tls_connection(&without_viewer, &authority, &["http/1.1", "h2"]).await;
    assert_eq!(connection.get_ref().1.alpn_protocol(), Some(&b"h2"[..]));
    let get = async |headers: &str| {
        let mut connection = tls_connection(&server, &authority, &["http/1.1"]).await;
        let request = format!("GET / HTTP/1.1\r\nHost: {host}\r\n{headers}\r\n");
        connection.write_all(request.as_bytes()).await.expect("expected an open connection");
        let mut answer = Vec::new();
        with_timeout(connection.read_to_end(&mut answer)).await.expect("expected an orderly end");
        String::from_utf8_lossy(&answer).into_owned()
    };
    let page = get(&format!("Origin: https://{host}\r\n")).await;
    assert!(page.starts_with("HTTP/1.1 200 ") && page.contains(&format!("connect-src 'self' wss://{host};")));
    assert!(get(&format!("Origin: http://{host}\r\n")).await.starts_with("HTTP/1.1 403 "));
    for (scheme, is_accepted) in [("https", true), ("http", false)] {
        let connection = tls_connection(&server, &authority, &["http/1.1"]).await;
        let result = handshake(connection, &server, &[("origin", &format!("{scheme}://{host}"))]).await;
        assert_eq!(result.is_ok(), is_accepted, "{scheme}");
    }
}

#[tokio::test]
async fn public_url_begins_the_links_of_the_viewer() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let public_url: PublicUrl = "https://lab.example/render/".parse().expect("expected a URL");
    let config = Config {
        listen: vec![ListenAddress::Tcp(([127, 0, 0, 1], 0).into())],
        state: folder.path().join("state"),
        public_url: Some(public_url),
        ..Config::default()
    };
    let listener = service::bind(&config).await.expect("expected a free port");
    let urls = listener.viewer_urls();
    assert!(urls[0] == "https://lab.example/render" && urls[1].starts_with("http://127.0.0.1:"), "{urls:?}");
    let link = listener.viewer_link(&urls[0]).expect("expected a link");
    assert!(link.starts_with("https://lab.example/render/#code="), "{link}");
}

/// A key that others could read, that of another certificate, and files without a certificate.
#[tokio::test]
async fn unusable_certificates_are_rejected_at_the_start() {
    use std::os::unix::fs::PermissionsExt as _;
    let (files, authority) = (Files::new(), Authority::new("lab"));
    files.serve_with(&authority);
    let (_, other_key) = authority.sign(&["127.0.0.1"]);
    files.write("other.key", &other_key);
    let open_key = files.write("open.key", &std::fs::read_to_string(files.path("server.key")).expect("expected a key"));
    std::fs::set_permissions(&open_key, std::fs::Permissions::from_mode(0o644)).expect("expected permissions");
    files.write("empty.pem", "");
    let bind = async |certificate: &str, key: &str, client_ca: Option<&str>| {
        let (certificate, key) = (files.path(certificate), files.path(key));
        let certificate = ServerCertificate::Files { certificate, key };
        let tls = TlsSettings { certificate, client_ca: client_ca.map(|name| files.path(name)) };
        let listen = vec![ListenAddress::Tcp(([127, 0, 0, 1], 0).into())];
        let config = Config { listen, tls: Some(tls), state: files.path("state"), ..Config::default() };
        service::bind(&config).await.map(drop).map_err(|error| error.to_string())
    };
    assert_eq!(bind("server.pem", "server.key", None).await, Ok(()));
    for (certificate, key, client_ca, expected) in [
        ("server.pem", "open.key", None, "chmod 600"),
        ("server.pem", "other.key", None, "expected the key of"),
        ("server.pem", "server.pem", None, "expected a private key in PEM"),
        ("empty.pem", "server.key", None, "expected certificates in PEM, got none"),
        ("absent.pem", "server.key", None, "expected a readable file"),
        ("server.pem", "server.key", Some("empty.pem"), "expected certificates in PEM, got none"),
    ] {
        let error = bind(certificate, key, client_ca).await.expect_err(expected);
        assert!(error.contains(expected), "expected '{expected}', got: {error}");
    }
}

/// Invalid new files change nothing.
#[tokio::test(flavor = "multi_thread")]
async fn invalid_new_certificate_is_not_used() {
    let (files, old, new) = (Files::new(), Authority::new("old"), Authority::new("new"));
    let server = files.start(files.serve_with(&old), None).await;
    let is_served = async |authority: &Authority| {
        let options = files.trusting(authority).with_token(TOKEN_OF_BEN);
        connect(&server, &options).await.is_ok()
    };
    let (certificate, key) = new.sign(&["127.0.0.1"]);
    // The certificate first, without its key. The server looks at the files every second.
    files.write("server.pem", &certificate);
    tokio::time::sleep(std::time::Duration::from_millis(2500)).await;
    assert!(is_served(&old).await && !is_served(&new).await);
    files.write("server.key", &key);
    with_timeout(async { while !is_served(&new).await {} }).await;
}
