//! The targets of credentials: the file of principals, and the messages of a browser without a session. The fuzzer and
//! `tests/it/kept_credentials.rs` run them.

use std::fs::{self, Permissions};
use std::io::{Read as _, Write as _};
use std::net::{SocketAddr, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use modalcast::config::{BackendChoice, Config, ListenAddress, RendererChoice};
use modalcast::engine::Engine;
use modalcast::identity::Directory;
use modalcast::service;
use modalcast_model::load::SceneRepository;
use tokio::runtime::{Builder, Runtime};

/// The names of all targets.
pub(crate) const TARGETS: [&str; 2] = ["principals", "websocket"];

/// Between the messages of an input of `websocket`.
const SEPARATOR: &[u8] = b"\xf7\xf8\xf9\xfa";

/// The longest wait for an answer. It only turns a server that hangs into a failure.
const MAX_WAIT: Duration = Duration::from_secs(600);

/// Limit on the bytes of a message whose length fits into 16 bits.
const MAX_SHORT_BYTES: usize = 65_535;

pub(crate) fn seeds(target: &str) -> Vec<Vec<u8>> {
    let hash = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
    let principals = format!(
        "[[principal]]\nname = \"anna\"\nrole = \"drive\"\nuids = [4294967294]\n[[principal]]\nname = 'b.c@d'\n\
         role = 'proxy'\n[[principal.token]]\nsha256 = '{hash}'\nexpires = '2999-01-01T00:00:00Z'\n"
    );
    let start = |path: &str| [&[1, 0, 0, 0, 0, 0, 0, 0, 0][..], path.as_bytes()].concat();
    let call = [start("/modalcast.v1.SceneService/ListScenes"), vec![1, 0, 0, 0, 1], vec![1, 0, 0, 0, 2]];
    let session = [vec![0, 0, 0, 0, 6, b'a'], start("/modalcast.v1.ServerService/GetServerInfo")];
    let credit = [start("/grpc.health.v1.Health/Check"), vec![1, 0, 0, 0, 4, 0, 1, 0, 0], vec![1, 0, 0, 0, 3]];
    match target {
        "principals" => vec![principals.into_bytes(), Vec::new()],
        "websocket" => vec![call.join(SEPARATOR), session.join(SEPARATOR), credit.join(SEPARATOR)],
        _ => Vec::new(),
    }
}

/// What reads the inputs.
pub(crate) enum CredentialTarget {
    Principals { folder: tempfile::TempDir },
    WebSocket(WebSocketTarget),
}

/// A server that identifies its callers.
pub(crate) struct WebSocketTarget {
    address: SocketAddr,
    /// Never dropped, because a runtime cannot be dropped while the thread ends.
    _runtime: &'static Runtime,
    _folder: tempfile::TempDir,
}

impl CredentialTarget {
    /// # Panics
    /// If there is no target of this name, or the server does not start.
    pub(crate) fn new(name: &str) -> Self {
        match name {
            "principals" => Self::Principals { folder: temporary_folder() },
            "websocket" => Self::WebSocket(WebSocketTarget::start()),
            _ => panic!("MODALCAST_FUZZ_TARGET: expected one of {TARGETS:?}, got {name:?}"),
        }
    }

    /// Reads an input. Returns whether it is accepted.
    ///
    /// # Panics
    /// If the server panics, or does not serve others afterwards.
    pub(crate) fn run(&self, input: &[u8]) -> bool {
        match self {
            Self::Principals { folder } => is_file_of_principals(folder.path(), input),
            Self::WebSocket(target) => target.run(input),
        }
    }
}

/// # Panics
/// If there is no writable folder.
fn temporary_folder() -> tempfile::TempDir {
    tempfile::tempdir().expect("expected a writable folder")
}

fn is_file_of_principals(folder: &Path, input: &[u8]) -> bool {
    let file: PathBuf = folder.join("principals.toml");
    fs::write(&file, input).expect("expected a writable folder");
    fs::set_permissions(&file, Permissions::from_mode(0o600)).expect("expected a file of this user");
    Directory::open(&folder.join("token"), Some(&file)).is_ok()
}

impl WebSocketTarget {
    fn start() -> Self {
        let runtime = Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime: &Runtime = Box::leak(Box::new(runtime.expect("expected a runtime")));
        let folder = temporary_folder();
        let config = Config {
            listen: vec![ListenAddress::Tcp(([127, 0, 0, 1], 0).into())],
            state: folder.path().to_owned(),
            backend: BackendChoice::Cpu,
            renderer: RendererChoice::Off,
            // Many inputs have a wrong token.
            wrong_token_delay: Duration::from_millis(1),
            ..Config::default()
        };
        let address = runtime.block_on(async {
            let config = config.validated().expect("expected valid settings");
            let listener = service::bind(&config).await.expect("expected a free port");
            let address = listener.viewer_addresses().next().expect("expected an address");
            let repository = SceneRepository::new(None).expect("expected the built-in scenes");
            let engine = Engine::start(config, Arc::new(repository)).await.expect("expected an engine");
            tokio::spawn(service::serve(engine, listener, std::future::pending()));
            address
        });
        Self { address, _runtime: runtime, _folder: folder }
    }

    /// Sends each part of the input in a binary message, and then a close frame. Returns whether the server closes the
    /// connection for no other reason than this frame.
    fn run(&self, input: &[u8]) -> bool {
        let handshake = format!(
            "GET /websocket HTTP/1.1\r\nHost: {}\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\
             Sec-WebSocket-Version: 13\r\nSec-WebSocket-Protocol: modalcast.v1\r\n\
             Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n",
            self.address
        );
        let mut request = handshake.into_bytes();
        let mut rest = Some(input);
        while let Some(bytes) = rest {
            let end = bytes.windows(SEPARATOR.len()).position(|window| window == SEPARATOR);
            rest = end.map(|end| &bytes[end + SEPARATOR.len()..]);
            request.extend(frame(2, &bytes[..end.unwrap_or(bytes.len()).min(MAX_SHORT_BYTES)]));
        }
        const CLOSE_NORMALLY: [u8; 2] = 1000_u16.to_be_bytes();
        request.extend(frame(8, &CLOSE_NORMALLY));
        let answer = self.exchange(&request);
        assert!(answer.starts_with(b"HTTP/1.1 101 "), "expected an upgrade, got {}", String::from_utf8_lossy(&answer));
        let health = self.exchange(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n");
        assert!(health.starts_with(b"HTTP/1.1 200 "), "expected a server that serves others");
        // Frames of the server are not masked; the last one is its close frame.
        answer.windows(4).any(|window| window == [0x88, window[1], CLOSE_NORMALLY[0], CLOSE_NORMALLY[1]])
    }

    /// Sends bytes and reads to the end of the connection.
    fn exchange(&self, request: &[u8]) -> Vec<u8> {
        let mut stream = TcpStream::connect(self.address).expect("expected a server that accepts connections");
        stream.set_read_timeout(Some(MAX_WAIT)).expect("expected a valid time");
        // The server may close the connection before it has read everything.
        stream.write_all(request).ok();
        let mut answer = Vec::new();
        let end = stream.read_to_end(&mut answer);
        assert!(end.is_ok() || !answer.is_empty(), "expected an answer, got {end:?}");
        answer
    }
}

/// A frame of a client with a mask of zeros.
fn frame(opcode: u8, payload: &[u8]) -> Vec<u8> {
    let head = [0x80 | opcode, 0x80 | 126];
    [&head[..], &(payload.len() as u16).to_be_bytes(), &[0; 4], payload].concat()
}
