//! The targets of calls. They send the messages of one call to a server in this process, which has no renderer. The
//! fuzzer and `tests/it/kept_calls.rs` run them.

#[path = "input.rs"]
pub(crate) mod input;
#[path = "raw_codec.rs"]
mod raw_codec;
#[path = "../temporary_folder.rs"]
mod temporary_folder;

use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use bytes::Bytes;
use modalcast::config::{Authentication, BackendChoice, Config, ListenAddress, RendererChoice};
use modalcast::engine::Engine;
use modalcast::identity::Principal;
use modalcast::service;
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use prost::Message as _;
use tokio::runtime::{Builder, Runtime};
use tonic::client::Grpc;
use tonic::codegen::http::uri::PathAndQuery;
use tonic::transport::Channel;
use tonic::{Request, Status};
use tonic_types::StatusExt as _;
use v1::drive_scene_response::Kind as DriveReply;

use super::seeds::two_domains;
use input::{declare_arrays, declare_files, messages_of};
use raw_codec::RawCodec;
use temporary_folder::temporary_folder;

/// The names of all targets.
pub(crate) const TARGETS: [&str; 3] = ["drive_scene", "upload_arrays", "upload_scene"];

/// An uploaded scene that remains open.
pub(crate) const STORED_SCENE: &str = "stored";

/// The memory in bytes that all scenes may take.
const MAX_MEMORY: u64 = 256 << 20;

/// A time limit of the server that no input reaches.
const NO_LIMIT: Duration = Duration::from_secs(3600);

/// The longest wait for the removal of files. It only turns a leftover into a failure.
const MAX_WAIT: Duration = Duration::from_secs(600);

/// The call that receives the messages.
#[derive(Clone, Copy)]
enum Call {
    DriveScene,
    UploadArrays,
    UploadScene,
}

impl Call {
    const fn path(self) -> &'static str {
        match self {
            Self::DriveScene => "/modalcast.v1.StepService/DriveScene",
            Self::UploadArrays => "/modalcast.v1.SceneService/UploadArrays",
            Self::UploadScene => "/modalcast.v1.SceneService/UploadScene",
        }
    }

    /// The messages of an input with the declarations that it leaves out.
    fn messages_of(self, input: &[u8]) -> Vec<Bytes> {
        let mut messages = messages_of(input);
        match self {
            Self::DriveScene => {}
            Self::UploadArrays => declare_arrays(&mut messages),
            Self::UploadScene => declare_files(&mut messages),
        }
        messages
    }

    /// The rejection of a step in a reply.
    fn rejection_in(self, reply: Bytes) -> Option<v1::Rejection> {
        match self {
            Self::DriveScene => match v1::DriveSceneResponse::decode(reply).expect("expected a valid reply").kind {
                Some(DriveReply::Rejection(rejection)) => Some(rejection),
                _ => None,
            },
            Self::UploadArrays | Self::UploadScene => None,
        }
    }
}

/// A server and a connection to it.
pub(crate) struct CallTarget {
    call: Call,
    /// Never dropped, because a runtime cannot be dropped while the thread ends.
    runtime: &'static Runtime,
    engine: Engine,
    channel: Channel,
    /// The folder of uploads of the server.
    uploads: PathBuf,
    _folder: tempfile::TempDir,
}

impl CallTarget {
    /// Starts the server and opens the stored scene.
    ///
    /// # Panics
    /// If there is no target of this name, or the server does not start.
    pub(crate) fn new(name: &str) -> Self {
        let call = match name {
            "drive_scene" => Call::DriveScene,
            "upload_arrays" => Call::UploadArrays,
            "upload_scene" => Call::UploadScene,
            _ => panic!("MODALCAST_FUZZ_TARGET: expected one of {TARGETS:?}, got {name:?}"),
        };
        let runtime = Builder::new_multi_thread().worker_threads(2).enable_all().build();
        let runtime: &Runtime = Box::leak(Box::new(runtime.expect("expected a runtime")));
        let folder = temporary_folder();
        let (engine, channel) = runtime.block_on(start_server(folder.path()));
        let target = Self { call, runtime, engine, channel, uploads: folder.path().join("uploads"), _folder: folder };
        let messages = Call::UploadArrays.messages_of(&two_domains(STORED_SCENE));
        let rejection = target.runtime.block_on(target.send(Call::UploadArrays, messages));
        assert_eq!(rejection, None, "expected the stored scene to open");
        target
    }

    /// Sends the messages, waits for the end of the call, and closes the scenes that it has opened. Returns whether the
    /// server has accepted all messages.
    ///
    /// # Panics
    /// If the server panics, answers with an internal error, cannot close a scene, or leaves files of an upload.
    pub(crate) fn run(&self, input: &[u8]) -> bool {
        let messages = self.call.messages_of(input);
        self.runtime.block_on(async {
            let rejection = self.send(self.call, messages).await;
            let reason = rejection.as_ref().map(v1::Rejection::reason);
            assert_ne!(reason, Some(v1::Reason::Internal), "{rejection:?}");
            for scene in self.engine.list(&Principal::owner()).open.iter().filter(|scene| scene.name != STORED_SCENE) {
                self.engine.close(&scene.name, &Principal::owner()).await.expect("expected a scene that closes");
            }
            self.wait_for_removal().await;
            rejection.is_none()
        })
    }

    /// Makes a call. Returns the rejection of the call, or of the first rejected step.
    async fn send(&self, call: Call, messages: Vec<Bytes>) -> Option<v1::Rejection> {
        let mut client = Grpc::new(self.channel.clone());
        client.ready().await.expect("expected a server that accepts calls");
        let request = Request::new(tokio_stream::iter(messages));
        let path = PathAndQuery::from_static(call.path());
        let mut replies = match client.streaming(request, path, RawCodec).await {
            Ok(response) => response.into_inner(),
            Err(status) => return Some(rejection_of(&status)),
        };
        let mut rejection = None;
        loop {
            match replies.message().await {
                Ok(Some(reply)) => rejection = rejection.or_else(|| call.rejection_in(reply)),
                Ok(None) => return rejection,
                Err(status) => return Some(rejection_of(&status)),
            }
        }
    }

    /// Waits until the server has removed all uploads but the stored scene.
    async fn wait_for_removal(&self) {
        let begin = Instant::now();
        loop {
            let entries = fs::read_dir(&self.uploads).expect("expected the folder of uploads").flatten();
            let leftovers: Vec<_> =
                entries.map(|entry| entry.file_name()).filter(|name| name != STORED_SCENE).collect();
            if leftovers.is_empty() {
                return;
            }
            assert!(begin.elapsed() < MAX_WAIT, "expected removed uploads, got {leftovers:?}");
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
    }
}

/// The reason and the text of a status. Errors of gRPC itself, such as malformed messages, have no reason.
fn rejection_of(status: &Status) -> v1::Rejection {
    let info = status.get_details_error_info();
    let reason = info.and_then(|info| v1::Reason::from_str_name(&info.reason)).unwrap_or_default();
    v1::Rejection { reason: reason.into(), given: status.to_string(), ..Default::default() }
}

async fn start_server(state: &Path) -> (Engine, Channel) {
    let config = Config {
        listen: vec![ListenAddress::Tcp(([127, 0, 0, 1], 0).into())],
        authentication: Authentication::Off,
        viewer: false,
        state: state.to_owned(),
        backend: BackendChoice::Cpu,
        renderer: RendererChoice::Off,
        scenes_host_bytes: Some(MAX_MEMORY),
        message_timeout: NO_LIMIT,
        reply_timeout: NO_LIMIT,
        deadline: NO_LIMIT,
        max_deadline: NO_LIMIT,
        stall_budget: NO_LIMIT,
        upload_stall_budget: NO_LIMIT,
        handshake_timeout: NO_LIMIT,
        first_request_timeout: NO_LIMIT,
        keepalive_interval: NO_LIMIT,
        keepalive_timeout: NO_LIMIT,
        ..Config::default()
    };
    let config = config.validated().expect("expected valid settings");
    let listener = service::bind(&config).await.expect("expected a free port");
    let address = listener.urls()[0].clone();
    let repository = SceneRepository::new(None).expect("expected the built-in scenes");
    let engine = Engine::start(config, Arc::new(repository)).await.expect("expected an engine");
    tokio::spawn(service::serve(engine.clone(), listener, std::future::pending()));
    let endpoint = Channel::from_shared(address).expect("expected a socket address");
    (engine, endpoint.connect().await.expect("expected a connection"))
}
