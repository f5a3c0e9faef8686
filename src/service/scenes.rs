//! `SceneService`: opens, uploads, lists, deletes and describes scenes, and reads rows of U.

use std::time::{Duration, Instant};

use modalcast_proto::v1;
use modalcast_proto::v1::upload_scene_request::Part;
use prost::Message as _;
use tonic::{Request, Response, Status, Streaming};

use super::convert::{scene_info, upload_header};
use super::describe;
use super::status::{status, transport_status};
use super::stream::{ReplyStream, catch_panic};
use crate::engine::{Engine, Upload};
use modalcast_model::error::{Error, Result, fault_in, invalid};

/// Limit in bytes on the source names in one list.
const MAX_SOURCE_BYTES: usize = 512 << 10;

/// The lowest sustained upload rate that the server accepts, in bytes per second.
const MIN_UPLOAD_RATE: f64 = 32768.0;

/// Implementation of `SceneService`.
pub(super) struct SceneServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::scene_service_server::SceneService for SceneServiceImpl {
    async fn open_scene(
        &self,
        request: Request<v1::OpenSceneRequest>,
    ) -> Result<Response<v1::OpenSceneResponse>, Status> {
        let engine = self.0.clone();
        let v1::OpenSceneRequest { source, scene } = request.into_inner();
        catch_panic(async move {
            let scene_handle = engine.open(&source, &scene).await?;
            Ok(v1::OpenSceneResponse { scene: Some(scene_info(&scene_handle, true)) })
        })
        .await
    }

    async fn upload_scene(
        &self,
        request: Request<Streaming<v1::UploadSceneRequest>>,
    ) -> Result<Response<v1::UploadSceneResponse>, Status> {
        let mut upload = None;
        if let Err(status) = receive_parts(&self.0, request.into_inner(), &mut upload).await {
            if let Some(upload) = upload {
                tokio::task::spawn_blocking(move || upload.discard()).await.ok(); // The next start removes leftovers.
            }
            return Err(status);
        }
        let upload = upload.ok_or_else(|| status(invalid("part", "a header first", "nothing")))?;
        let engine = self.0.clone();
        catch_panic(async move {
            let scene_handle = engine.finish_upload(upload).await?;
            Ok(v1::UploadSceneResponse { scene: Some(scene_info(&scene_handle, true)) })
        })
        .await
    }

    async fn list_scenes(&self, _: Request<v1::ListScenesRequest>) -> Result<Response<v1::ListScenesResponse>, Status> {
        let engine = self.0.clone();
        catch_panic(async move {
            let scenes = engine.list().iter().map(|scene_handle| scene_info(scene_handle, false)).collect();
            let mut left = MAX_SOURCE_BYTES;
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
        catch_panic(async move { engine.close(&name).await.map(|()| v1::DeleteSceneResponse {}) }).await
    }

    type DescribeSceneStream = ReplyStream<v1::DescribeSceneResponse>;

    async fn describe_scene(
        &self,
        request: Request<v1::DescribeSceneRequest>,
    ) -> Result<Response<Self::DescribeSceneStream>, Status> {
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(status)?;
        describe::scene(scene_handle, request, self.0.config().chunk_bytes).map_err(status)
    }

    type ReadModesStream = ReplyStream<v1::ReadModesResponse>;

    async fn read_modes(
        &self,
        request: Request<v1::ReadModesRequest>,
    ) -> Result<Response<Self::ReadModesStream>, Status> {
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(status)?;
        describe::modes(scene_handle, request, self.0.config().chunk_bytes).map_err(status)
    }
}

/// Time budget for waiting on an upload (a token bucket). Waiting consumes it and received bytes refill it, so that a
/// client that stalls or trickles bytes does not hold its upload permit and disk space forever.
struct UploadTimeBudget {
    most: Duration,
    left: Duration,
}

impl UploadTimeBudget {
    const fn new(most: Duration) -> Self {
        Self { most, left: most }
    }

    /// Waits for the client. Only this wait consumes the budget; processing the received data does not.
    ///
    /// # Errors
    /// `DEADLINE_EXCEEDED` when the budget is used up.
    async fn wait<T>(&mut self, part: impl Future<Output = T>) -> Result<T, Status> {
        let begin = Instant::now();
        let late = |_| Error::Deadline { what: "enough of the upload".into(), ms: self.most.as_millis() as u64 };
        let part = tokio::time::timeout(self.left, part).await.map_err(|end| status(late(end)))?;
        self.left = self.left.saturating_sub(begin.elapsed());
        Ok(part)
    }

    fn refill(&mut self, bytes: usize) {
        let earned = Duration::from_secs_f64(bytes as f64 / MIN_UPLOAD_RATE);
        self.left = self.most.min(self.left + earned);
    }
}

/// Receives the parts of an upload until the client closes its side. After an error `upload` is what is to be discarded.
async fn receive_parts(
    engine: &Engine,
    mut parts: Streaming<v1::UploadSceneRequest>,
    upload: &mut Option<Upload>,
) -> Result<(), Status> {
    let limit = engine.config().message_bytes;
    let mut budget = UploadTimeBudget::new(engine.config().stall_timeout);
    while let Some(request) = budget.wait(parts.message()).await?.map_err(|fault| transport_status(fault, limit))? {
        budget.refill(request.encoded_len());
        let part = request.part.ok_or_else(|| status(invalid("part", "header, file or chunk", "none")))?;
        *upload = Some(receive(engine, upload.take(), part).await.map_err(status)?);
    }
    Ok(())
}

/// Processes one part of an upload, and discards the upload if that fails. Disk access runs on a blocking thread.
async fn receive(engine: &Engine, upload: Option<Upload>, part: Part) -> Result<Upload> {
    let (mut upload, part) = match (upload, part) {
        (None, Part::Header(header)) => return engine.begin_upload(upload_header(header)).await,
        (None, _) => return Err(invalid("part", "a header first", "a file or chunk")),
        (Some(upload), part) => (upload, part),
    };
    let work = move || {
        let received = match part {
            Part::File(file) => upload.begin_file(&file.path, file.bytes, &file.sha256),
            Part::Chunk(bytes) => upload.write_chunk(&bytes),
            Part::Header(_) => Err(invalid("part", "one header", "a second")),
        };
        match received {
            Ok(()) => Ok(upload),
            Err(error) => {
                upload.discard();
                Err(error)
            }
        }
    };
    tokio::task::spawn_blocking(work).await.map_err(fault_in("upload"))?
}
