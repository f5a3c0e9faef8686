//! The connection to a server. Unary calls return values, streams return handles; clones share the connection.

use std::sync::Arc;
use std::time::{Duration, Instant};

use modalcast_proto::v1;
use tonic::transport::{Channel, Endpoint};
use tonic::{Response, Status, Streaming};

use crate::assemble::Replies;
use crate::error::{Error, Result, describe_causes, malformed_reply};

/// The default limit of one reply assembled from chunks, in bytes.
pub const REPLY_LIMIT: u64 = 1 << 30;

/// HTTP/2 flow-control windows in bytes. A stream that is not read fills its own window. Sixteen such streams fill the
/// window of the connection, and every other call then waits.
const STREAM_WINDOW: u32 = 4 << 20;
const CONNECTION_WINDOW: u32 = 16 * STREAM_WINDOW;
/// The largest HTTP/2 frame that the server may send, in bytes: one chunk of a reply. The default of 16 KiB halves the
/// rate of large replies.
const FRAME_SIZE: u32 = 1 << 20;

/// A connection to a modalcast server.
#[derive(Debug, Clone)]
pub struct Client {
    pub(crate) channel: Channel,
    pub(crate) reply_limit: u64,
    /// The URL of the server, as the caller wrote it; errors name it.
    server: Arc<str>,
}

/// Version, devices and limits of a server.
#[derive(Debug, Clone, PartialEq)]
pub struct ServerInfo {
    pub version: String,
    /// The deformer in use: `cpu`, `cuda` or `reference`.
    pub backend: String,
    /// The CUDA device, or the reason why there is none.
    pub device: String,
    /// The name that the OpenGL renderer reports.
    pub renderer: String,
    /// Whether that renderer runs on the CPU.
    pub software: bool,
    pub limits: v1::Limits,
}

impl Client {
    /// Connects, with a timeout of five seconds. `url` is `http://host:port` or `host:port`.
    ///
    /// # Errors
    /// `Connect` if the URL is invalid or no server answers.
    pub async fn connect(url: &str) -> Result<Self> {
        let refused =
            |fault: tonic::transport::Error| Error::Connect { url: url.to_owned(), reason: describe_causes(&fault) };
        let whole = if url.contains("://") { url.to_owned() } else { format!("http://{url}") };
        let endpoint = Endpoint::from_shared(whole)
            .map_err(refused)?
            .connect_timeout(Duration::from_secs(5))
            .initial_stream_window_size(STREAM_WINDOW)
            .initial_connection_window_size(CONNECTION_WINDOW)
            .max_frame_size(FRAME_SIZE)
            .http2_keep_alive_interval(Duration::from_secs(20))
            .keep_alive_timeout(Duration::from_secs(20));
        let channel = endpoint.connect().await.map_err(refused)?;
        Ok(Self { channel, reply_limit: REPLY_LIMIT, server: url.into() })
    }

    /// Connects, and retries until a server answers or `timeout` has passed.
    ///
    /// # Errors
    /// `Connect` with the reason of the last attempt.
    pub async fn connect_with_retry(url: &str, timeout: Duration) -> Result<Self> {
        let start = Instant::now();
        loop {
            match Self::connect(url).await {
                Err(_) if start.elapsed() < timeout => tokio::time::sleep(Duration::from_millis(100)).await,
                answer => return answer,
            }
        }
    }

    /// Sets the limit of one reply, in bytes, on the same connection.
    #[must_use]
    pub fn with_reply_limit(mut self, bytes: u64) -> Self {
        self.reply_limit = bytes;
        self
    }

    /// Backend, renderer and limits of the server.
    ///
    /// # Errors
    /// `Status`, `Connect` or `Malformed`, as for every call.
    pub async fn server_info(&self) -> Result<ServerInfo> {
        let mut service = v1::server_service_client::ServerServiceClient::new(self.channel.clone());
        let wire = self.reply(service.get_server_info(v1::GetServerInfoRequest {}).await)?;
        Ok(ServerInfo {
            version: wire.version,
            backend: wire.backend,
            device: wire.device,
            renderer: wire.renderer,
            software: wire.software,
            limits: wire.limits.unwrap_or_default(),
        })
    }

    /// Opens a scene of the server's repository, or returns the scene that is already open under that name. With an
    /// empty `name`, the scene has the name of its source.
    ///
    /// # Errors
    /// `Status` if the source does not exist; `Connect`; `Malformed`.
    pub async fn open_scene(&self, source: &str, name: &str) -> Result<v1::SceneInfo> {
        let request = v1::OpenSceneRequest { source: source.to_owned(), scene: name.to_owned() };
        let reply = self.reply(self.scenes().open_scene(request).await)?;
        reply.scene.ok_or_else(|| malformed_reply("open_scene.scene", "a scene", "none"))
    }

    /// The open scenes, and the sources that [`Self::open_scene`] accepts.
    ///
    /// # Errors
    /// `Status` or `Connect`.
    pub async fn list_scenes(&self) -> Result<(Vec<v1::SceneInfo>, Vec<String>)> {
        let reply = self.reply(self.scenes().list_scenes(v1::ListScenesRequest {}).await)?;
        Ok((reply.scenes, reply.sources))
    }

    /// Closes a scene. The server deletes the files of an uploaded scene.
    ///
    /// # Errors
    /// `Status` if the scene does not exist; `Connect`.
    pub async fn delete_scene(&self, scene: &str) -> Result<()> {
        let request = v1::DeleteSceneRequest { scene: scene.to_owned() };
        self.reply(self.scenes().delete_scene(request).await).map(drop)
    }

    pub(crate) fn scenes(&self) -> v1::scene_service_client::SceneServiceClient<Channel> {
        v1::scene_service_client::SceneServiceClient::new(self.channel.clone())
    }

    /// The reply of a call; an error names the server.
    pub(crate) fn reply<M>(&self, response: Result<Response<M>, Status>) -> Result<M> {
        response.map(Response::into_inner).map_err(|status| Error::from_status(status, &self.server))
    }

    /// The reply messages of a call; errors name the server.
    pub(crate) fn replies<M>(&self, response: Result<Response<Streaming<M>>, Status>) -> Result<Replies<M>> {
        Ok(Replies::new(self.reply(response)?, Arc::clone(&self.server)))
    }
}
