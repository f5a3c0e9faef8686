//! `SceneService`: opens, uploads, lists, deletes and describes scenes, and reads rows of U.

use std::time::{Duration, Instant};

use modalcast_proto::v1;
use modalcast_proto::v1::upload_scene_request::Part;
use prost::Message as _;
use tonic::{Request, Response, Status, Streaming};

use super::convert::{announcement, scene_info};
use super::describe;
use super::status::{status, transport};
use super::stream::{Replies, guarded};
use crate::engine::{Engine, Upload};
use modalcast_model::error::{Error, Result, during, invalid};

/// Limit in bytes on the source names in one list.
const MOST_SOURCES: usize = 512 << 10;

/// The lowest sustained upload rate that the server accepts, in bytes per second.
const SLOWEST_UPLOAD: f64 = 32768.0;

/// Implementation of `SceneService`.
pub(super) struct Scenes(pub(super) Engine);

#[tonic::async_trait]
impl v1::scene_service_server::SceneService for Scenes {
    async fn open_scene(
        &self,
        request: Request<v1::OpenSceneRequest>,
    ) -> Result<Response<v1::OpenSceneResponse>, Status> {
        let engine = self.0.clone();
        let v1::OpenSceneRequest { source, scene } = request.into_inner();
        guarded(async move {
            let host = engine.open(&source, &scene).await?;
            Ok(v1::OpenSceneResponse { scene: Some(scene_info(&host, true)) })
        })
        .await
    }

    async fn upload_scene(
        &self,
        request: Request<Streaming<v1::UploadSceneRequest>>,
    ) -> Result<Response<v1::UploadSceneResponse>, Status> {
        let mut parts = request.into_inner();
        let limit = self.0.config().message_bytes;
        let mut patience = Patience::new(self.0.config().stall);
        let mut upload = None;
        while let Some(request) = patience.hold(parts.message()).await?.map_err(|fault| transport(fault, limit))? {
            patience.regain(request.encoded_len());
            let part = request.part.ok_or_else(|| status(invalid("part", "header, file or chunk", "none")))?;
            upload = Some(receive(&self.0, upload, part).await.map_err(status)?);
        }
        let upload = upload.ok_or_else(|| status(invalid("part", "a header first", "nothing")))?;
        let engine = self.0.clone();
        guarded(async move {
            let host = engine.finish_upload(upload).await?;
            Ok(v1::UploadSceneResponse { scene: Some(scene_info(&host, true)) })
        })
        .await
    }

    async fn list_scenes(&self, _: Request<v1::ListScenesRequest>) -> Result<Response<v1::ListScenesResponse>, Status> {
        let engine = self.0.clone();
        guarded(async move {
            let scenes = engine.list().iter().map(|host| scene_info(host, false)).collect();
            let mut left = MOST_SOURCES;
            let fits = |source: &String| {
                left = left.saturating_sub(source.len() + 8);
                left > 0
            };
            let sources = engine.sources().await?.into_iter().take_while(fits).collect();
            Ok(v1::ListScenesResponse { scenes, sources })
        })
        .await
    }

    async fn delete_scene(
        &self,
        request: Request<v1::DeleteSceneRequest>,
    ) -> Result<Response<v1::DeleteSceneResponse>, Status> {
        let engine = self.0.clone();
        let name = request.into_inner().scene;
        guarded(async move { engine.close(&name).await.map(|()| v1::DeleteSceneResponse {}) }).await
    }

    type DescribeSceneStream = Replies<v1::DescribeSceneResponse>;

    async fn describe_scene(
        &self,
        request: Request<v1::DescribeSceneRequest>,
    ) -> Result<Response<Self::DescribeSceneStream>, Status> {
        let request = request.into_inner();
        let host = self.0.find(&request.scene).map_err(status)?;
        describe::scene(host, request, self.0.config().chunk_bytes).map_err(status)
    }

    type ReadModesStream = Replies<v1::ReadModesResponse>;

    async fn read_modes(
        &self,
        request: Request<v1::ReadModesRequest>,
    ) -> Result<Response<Self::ReadModesStream>, Status> {
        let request = request.into_inner();
        let host = self.0.find(&request.scene).map_err(status)?;
        describe::modes(host, request, self.0.config().chunk_bytes).map_err(status)
    }
}

/// Time budget for waiting on an upload (a token bucket). Waiting consumes it and received bytes refill it, so that a
/// client that stalls or trickles bytes does not hold its upload permit and disk space forever.
struct Patience {
    most: Duration,
    left: Duration,
}

impl Patience {
    const fn new(most: Duration) -> Self {
        Self { most, left: most }
    }

    /// Waits for the client. Only this wait consumes the budget; processing the received data does not.
    ///
    /// # Errors
    /// `DEADLINE_EXCEEDED` when the budget is used up.
    async fn hold<T>(&mut self, part: impl Future<Output = T>) -> Result<T, Status> {
        let begin = Instant::now();
        let late = |_| Error::Deadline { what: "enough of the upload".into(), ms: self.most.as_millis() as u64 };
        let part = tokio::time::timeout(self.left, part).await.map_err(|end| status(late(end)))?;
        self.left = self.left.saturating_sub(begin.elapsed());
        Ok(part)
    }

    fn regain(&mut self, bytes: usize) {
        let earned = Duration::from_secs_f64(bytes as f64 / SLOWEST_UPLOAD);
        self.left = self.most.min(self.left + earned);
    }
}

/// Processes one part of an upload. Disk access runs on a blocking thread.
async fn receive(engine: &Engine, upload: Option<Upload>, part: Part) -> Result<Upload> {
    let mut upload = match (upload, part) {
        (None, Part::Header(header)) => return engine.begin_upload(announcement(header)).await,
        (None, _) => return Err(invalid("part", "a header first", "a file or chunk")),
        (Some(_), Part::Header(_)) => return Err(invalid("part", "one header", "a second")),
        (Some(upload), part) => (upload, part),
    };
    let work = move || -> Result<Upload, Error> {
        match upload.1 {
            Part::File(file) => upload.0.file(&file.path, file.bytes, &file.sha256)?,
            Part::Chunk(bytes) => upload.0.chunk(&bytes)?,
            Part::Header(_) => {}
        }
        Ok(upload.0)
    };
    tokio::task::spawn_blocking(work).await.map_err(during("upload"))?
}
