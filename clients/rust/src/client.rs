//! The connection to a server. Unary calls return values, and streaming calls return handles of streams. Clones of a
//! `Client` share the connection.

use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, Instant};

use modalcast_proto::v1;
use prost::Message;
use tonic::transport::Endpoint;
use tonic::{Response, Status, Streaming};

use crate::assemble::Replies;
use crate::error::{Error, Result, malformed_reply};
use crate::message_stream::{MessageStream, UndecodedChannel};
use crate::request::Delivery;
use crate::server_address::{ConnectOptions, ServerAddress};
use crate::server_channel::ServerChannel;
use crate::shared_memory::{CallMemory, SharedMemory};

/// The default limit of one reply that is assembled from chunks, in bytes.
pub const REPLY_LIMIT: u64 = 1 << 30;

/// HTTP/2 flow-control window of a stream, in bytes. A stream that is not read fills its own window only. A full window
/// delays a slow reader of the latest steps by the steps in the window, so the window is small.
const STREAM_WINDOW: u32 = 4 << 20;

/// Window of a stream of every step, in bytes. At a round trip of 50 ms it permits 1.3 GB/s.
const LOSSLESS_STREAM_WINDOW: u32 = 64 << 20;

/// Number of unread streams that fill the window of their connection and block all other calls on it.
const STREAMS_PER_CONNECTION_WINDOW: u32 = 16;

/// The largest HTTP/2 frame that the server may send, in bytes: one chunk of a reply. With the default of 16 KiB, large
/// replies arrive at half the rate.
const MAX_FRAME_SIZE: u32 = 1 << 20;

/// Time limit of a connection attempt.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// Interval of HTTP/2 pings, and the time after which a ping without an answer closes the connection.
const KEEP_ALIVE: Duration = Duration::from_secs(20);

/// Pause between two connection attempts.
const RETRY_INTERVAL: Duration = Duration::from_millis(100);

/// A connection to a modalcast server. Streams of every step use a second connection with larger flow-control windows.
#[derive(Debug, Clone)]
pub struct Client {
    pub(crate) channel: ServerChannel,
    /// A connection with larger windows, which opens with its first stream.
    lossless_channel: ServerChannel,
    pub(crate) max_reply_bytes: u64,
    shared_memory: Option<Arc<SharedMemory>>,
    /// The URL of the server, as the caller passed it, for errors.
    url: Arc<str>,
}

/// Version, features, devices and limits of a server.
#[derive(Debug, Clone, PartialEq)]
pub struct ServerInfo {
    pub version: String,
    /// The features of the server. Features that this client does not know are left out.
    pub features: Vec<v1::Feature>,
    /// The deformer in use: `cpu`, `cuda` or `reference`.
    pub backend: String,
    /// The CUDA device, or the reason why there is none.
    pub device: String,
    /// The name that the OpenGL renderer reports.
    pub renderer: String,
    /// Whether the OpenGL renderer runs on the CPU.
    pub is_software_renderer: bool,
    pub limits: v1::Limits,
}

/// The open scenes and the available sources of a server.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneList {
    pub scenes: Vec<v1::SceneInfo>,
    /// Sources that [`Client::open_scene`] accepts.
    pub sources: Vec<String>,
}

impl ServerInfo {
    /// Whether the server has a feature.
    pub fn has_feature(&self, feature: v1::Feature) -> bool {
        self.features.contains(&feature)
    }
}

impl Client {
    /// Connects, with a timeout of five seconds, and checks that the server has the protocol version of this client.
    /// `url` is `https://host:port`, `http://host:port`, `host:port` (plain), or `unix:path` for a Unix socket. A plain
    /// server of this user on this machine is reached at its Unix socket, which needs no token. For others, set a token
    /// by [`Self::connect_with`], or the environment variable `MODALCAST_TOKEN_FILE` to the path of a file with a token.
    ///
    /// # Errors
    /// `Connect` if the URL is invalid or no server answers; `Certificate` if that of the server is not accepted;
    /// `ProtocolVersion` if the server has another version; `Status` if the server is not a modalcast server, or does not
    /// know the caller.
    pub async fn connect(url: &str) -> Result<Self> {
        Self::connect_with(url, &ConnectOptions::default()).await
    }

    /// Connects as [`Self::connect`], with options.
    ///
    /// # Errors
    /// As for [`Self::connect`].
    pub async fn connect_with(url: &str, options: &ConnectOptions) -> Result<Self> {
        let connect_error = |error: tonic::transport::Error| Error::of_connection(url, &error);
        let ServerAddress { url: server_url, metadata, tls } = ServerAddress::find(url, options)?;
        let mut endpoint = Endpoint::from_shared(server_url)
            .map_err(connect_error)?
            .connect_timeout(CONNECT_TIMEOUT)
            .max_frame_size(MAX_FRAME_SIZE)
            .http2_keep_alive_interval(KEEP_ALIVE)
            .keep_alive_timeout(KEEP_ALIVE);
        if let Some(tls) = tls {
            endpoint = endpoint.tls_config(tls.timeout(CONNECT_TIMEOUT)).map_err(connect_error)?;
        }
        let with_window = |stream_window: u32| {
            let endpoint = endpoint.clone().initial_stream_window_size(stream_window);
            endpoint.initial_connection_window_size(STREAMS_PER_CONNECTION_WINDOW * stream_window)
        };
        let with_metadata = |channel| ServerChannel { channel, metadata: metadata.clone() };
        let client = Self {
            channel: with_metadata(with_window(STREAM_WINDOW).connect().await.map_err(connect_error)?),
            lossless_channel: with_metadata(with_window(LOSSLESS_STREAM_WINDOW).connect_lazy()),
            max_reply_bytes: REPLY_LIMIT,
            shared_memory: None,
            url: url.into(),
        };
        let no_answer = |_| Error::Connect { url: url.to_owned(), reason: "the server does not answer calls".into() };
        // A server rejects a client certificate, and a plain connection, after the client's end of the handshake.
        let mut service = v1::server_service_client::ServerServiceClient::new(client.channel.clone());
        let first_call = tokio::time::timeout(CONNECT_TIMEOUT, service.get_server_info(v1::GetServerInfoRequest {}));
        let first_reply = first_call.await.map_err(no_answer)?.map_err(|status| Error::of_first_call(status, url))?;
        let info = first_reply.into_inner();
        match info.protocol_version {
            v1::PROTOCOL_VERSION => Ok(client),
            server => Err(Error::ProtocolVersion { url: url.to_owned(), client: v1::PROTOCOL_VERSION, server }),
        }
    }

    /// Connects, and retries until a server answers or `timeout` has passed. Another protocol version, and a certificate that
    /// is not accepted, end the attempts.
    ///
    /// # Errors
    /// As for [`Self::connect`], with the reason of the last attempt.
    pub async fn connect_with_retry(url: &str, timeout: Duration) -> Result<Self> {
        let start = Instant::now();
        loop {
            match Self::connect(url).await {
                Err(Error::Connect { .. } | Error::Status { .. }) if start.elapsed() < timeout => {
                    tokio::time::sleep(RETRY_INTERVAL).await;
                }
                result => return result,
            }
        }
    }

    /// Sets the limit of one reply, in bytes, on the same connection.
    #[must_use]
    pub fn with_reply_limit(mut self, bytes: u64) -> Self {
        self.max_reply_bytes = bytes;
        self
    }

    /// Sends steps and receives vertices and frames in shared memory. The server runs on this machine as the same user,
    /// and `path` is the Unix socket of its option `--shared-memory`. The calls themselves use the same connection as
    /// before.
    ///
    /// # Errors
    /// `Connect` if the server does not offer shared memory at this path.
    pub async fn with_shared_memory(mut self, path: impl AsRef<Path>) -> Result<Self> {
        self.shared_memory = Some(SharedMemory::connect(path.as_ref()).await?);
        Ok(self)
    }

    /// Gets features, backend, renderer and limits of the server.
    ///
    /// # Errors
    /// `Status` if the server rejects the call; `Connect` if the connection is lost.
    pub async fn server_info(&self) -> Result<ServerInfo> {
        let wire = self.get_server_info().await?;
        Ok(ServerInfo {
            features: wire.features().filter(|feature| *feature != v1::Feature::Unspecified).collect(),
            version: wire.version,
            backend: wire.backend,
            device: wire.device,
            renderer: wire.renderer,
            is_software_renderer: wire.software,
            limits: wire.limits.unwrap_or_default(),
        })
    }

    /// Opens a scene of the server's repository, or returns the scene that is already open under that name. With an
    /// empty `name`, the name is the last path component of the source without extension.
    ///
    /// # Errors
    /// `Status` if the source does not exist; `Connect` if the connection is lost; `Malformed` if the reply has no
    /// scene.
    pub async fn open_scene(&self, source: &str, name: &str) -> Result<v1::SceneInfo> {
        let request = v1::OpenSceneRequest { source: source.to_owned(), scene: name.to_owned() };
        let reply = self.reply(self.scenes().open_scene(request).await)?;
        reply.scene.ok_or_else(|| malformed_reply("open_scene.scene", "a scene", "none"))
    }

    /// Lists the open scenes, and the sources that [`Self::open_scene`] accepts.
    ///
    /// # Errors
    /// `Status` if the server rejects the call; `Connect` if the connection is lost.
    pub async fn list_scenes(&self) -> Result<SceneList> {
        let reply = self.reply(self.scenes().list_scenes(v1::ListScenesRequest {}).await)?;
        Ok(SceneList { scenes: reply.scenes, sources: reply.sources })
    }

    /// Closes a scene. The server deletes the files of an uploaded scene.
    ///
    /// # Errors
    /// `Status` if the scene does not exist; `Connect` if the connection is lost.
    pub async fn delete_scene(&self, scene: &str) -> Result<()> {
        let request = v1::DeleteSceneRequest { scene: scene.to_owned() };
        self.reply(self.scenes().delete_scene(request).await).map(drop)
    }

    /// Makes a link to the viewer, which is valid once. `principal` is the one whose rights the link gives; empty: the
    /// caller's own. Returns the path and fragment, and the URLs to which the caller may append them: scheme, host and port
    /// of the server as this client knows it do as well.
    ///
    /// # Errors
    /// `Status` if the server has no viewer, or the caller may not name this principal; `Connect` if the connection is
    /// lost.
    pub async fn create_viewer_link(&self, principal: &str) -> Result<v1::CreateViewerLinkResponse> {
        let mut service = v1::server_service_client::ServerServiceClient::new(self.channel.clone());
        let request = v1::CreateViewerLinkRequest { principal: principal.to_owned() };
        self.reply(service.create_viewer_link(request).await)
    }

    /// Lists the clients of the server with what they hold of limited resources. Those that hold the largest part of a
    /// limit come first. Needs the role `admin`.
    ///
    /// # Errors
    /// `Status` if the caller has another role; `Connect` if the connection is lost.
    pub async fn list_clients(&self) -> Result<v1::ListClientsResponse> {
        let mut service = v1::server_service_client::ServerServiceClient::new(self.channel.clone());
        self.reply(service.list_clients(v1::ListClientsRequest {}).await)
    }

    /// Ends the connections, streams and waiting requests of a client, by its id in [`Self::list_clients`], or of all clients
    /// of a principal except this one: `"anna/*"`. Their open scenes stay open. Needs the role `admin`.
    ///
    /// # Errors
    /// `Status` if no such client holds anything or the caller has another role; `Connect` if the connection is lost.
    pub async fn end_client(&self, id: &str) -> Result<v1::EndClientResponse> {
        let mut service = v1::server_service_client::ServerServiceClient::new(self.channel.clone());
        self.reply(service.end_client(v1::EndClientRequest { id: id.to_owned() }).await)
    }

    /// Shares a scene with the principals of these names (`"*"`: all), in place of those with whom it was shared. Others
    /// than its owner do not see a scene that is not shared.
    ///
    /// # Errors
    /// `Status` if the scene does not exist, belongs to another principal or a name is malformed; `Connect` if the
    /// connection is lost.
    pub async fn share_scene(&self, scene: &str, principals: &[&str]) -> Result<()> {
        let principals = principals.iter().map(|name| (*name).to_owned()).collect();
        let request = v1::ShareSceneRequest { scene: scene.to_owned(), principals };
        self.reply(self.scenes().share_scene(request).await).map(drop)
    }

    /// Returns a scene to its rest state. `take_over` replaces the writer that drives the scene. Returns the step that
    /// shows the rest state.
    ///
    /// # Errors
    /// `Status` if the scene does not exist or has a writer that is not replaced; `Connect` if the connection is lost;
    /// `Malformed` if the reply has no step.
    pub async fn reset_scene(&self, scene: &str, take_over: bool) -> Result<v1::StepId> {
        let mut service = v1::step_service_client::StepServiceClient::new(self.channel.clone());
        let request = v1::ResetSceneRequest { scene: scene.to_owned(), take_over };
        let reply = self.reply(service.reset_scene(request).await)?;
        reply.step.ok_or_else(|| malformed_reply("reset_scene.step", "a step", "none"))
    }

    async fn get_server_info(&self) -> Result<v1::GetServerInfoResponse> {
        let mut service = v1::server_service_client::ServerServiceClient::new(self.channel.clone());
        self.reply(service.get_server_info(v1::GetServerInfoRequest {}).await)
    }

    /// The shared memory of a new call, if this client uses it.
    pub(crate) async fn call_memory(&self) -> Result<CallMemory> {
        match &self.shared_memory {
            Some(shared_memory) => shared_memory.acquire().await,
            None => Ok(CallMemory::default()),
        }
    }

    /// The connection for calls with a stream of replies, see [`Self::replies`].
    pub(crate) fn undecoded_channel(&self) -> UndecodedChannel {
        UndecodedChannel(self.channel.clone())
    }

    /// The connection for a stream of replies, one per step, with this delivery.
    pub(crate) fn channel_for(&self, delivery: Delivery) -> UndecodedChannel {
        match delivery {
            Delivery::Lossless => UndecodedChannel(self.lossless_channel.clone()),
            Delivery::Latest => self.undecoded_channel(),
        }
    }

    /// The scene service for calls with a stream of replies.
    pub(crate) fn scene_streams(&self) -> v1::scene_service_client::SceneServiceClient<UndecodedChannel> {
        v1::scene_service_client::SceneServiceClient::new(self.undecoded_channel())
    }

    pub(crate) fn scenes(&self) -> v1::scene_service_client::SceneServiceClient<ServerChannel> {
        v1::scene_service_client::SceneServiceClient::new(self.channel.clone())
    }

    /// The reply of a call; an error contains the server's URL.
    pub(crate) fn reply<M>(&self, response: Result<Response<M>, Status>) -> Result<M> {
        response.map(Response::into_inner).map_err(|status| Error::from_status(status, &self.url))
    }

    /// The reply messages of a call on an [`UndecodedChannel`]; errors contain the server's URL.
    pub(crate) fn replies<M: Message + Default>(
        &self,
        response: Result<Response<Streaming<M>>, Status>,
    ) -> Result<Replies<M>> {
        let response = response.map_err(|status| Error::from_status(status, &self.url))?;
        let messages = MessageStream::of_response(response);
        let messages = messages.ok_or_else(|| malformed_reply("reply", "a body that was not decoded", "none"))?;
        Ok(Replies::new(messages, Arc::clone(&self.url)))
    }
}
