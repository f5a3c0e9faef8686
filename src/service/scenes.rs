//! `SceneService`: opens, uploads, lists, deletes and describes scenes, and reads rows of U.

use std::time::{Duration, Instant};

use modalcast_proto::v1;
use modalcast_proto::v1::upload_scene_request::Part;
use prost::Message as _;
use tonic::{Request, Response, Status, Streaming};

use super::convert::{ByteBudget, parse_upload_header, wire_scene_info, wire_scene_summary};
use super::describe;
use super::status::{to_status, transport_status};
use super::stream::{ReplyStream, catch_panic};
use crate::engine::{Engine, Upload};
use modalcast_model::error::{Error, Result, fault_in};

/// Limit in bytes on the source names in one list.
const MAX_SOURCE_BYTES: usize = 512 << 10;

/// The lowest sustained upload rate that the server accepts, in bytes per second: 32 KiB/s.
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
            Ok(v1::OpenSceneResponse { scene: Some(wire_scene_info(&scene_handle)) })
        })
        .await
    }

    async fn upload_scene(
        &self,
        request: Request<Streaming<v1::UploadSceneRequest>>,
    ) -> Result<Response<v1::UploadSceneResponse>, Status> {
        let mut upload = None;
        if let Err(error_status) = receive_parts(&self.0, request.into_inner(), &mut upload).await {
            if let Some(upload) = upload {
                // If the removal fails, the next start of the server removes the files.
                tokio::task::spawn_blocking(move || upload.discard()).await.ok();
            }
            return Err(error_status);
        }
        let upload = upload.ok_or_else(|| {
            to_status(Error::UnexpectedMessage {
                expected: "a header as the first part",
                given: "the end of the stream",
            })
        })?;
        let engine = self.0.clone();
        catch_panic(async move {
            let scene_handle = engine.finish_upload(upload).await?;
            Ok(v1::UploadSceneResponse { scene: Some(wire_scene_info(&scene_handle)) })
        })
        .await
    }

    async fn list_scenes(&self, _: Request<v1::ListScenesRequest>) -> Result<Response<v1::ListScenesResponse>, Status> {
        let engine = self.0.clone();
        catch_panic(async move {
            let scenes = engine.list().iter().map(|scene_handle| wire_scene_summary(scene_handle)).collect();
            let mut budget = ByteBudget::new(MAX_SOURCE_BYTES);
            let sources = engine.sources().await?.into_iter().take_while(|source| budget.take_string(source)).collect();
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
        let scene_handle = self.0.find(&request.scene).map_err(to_status)?;
        describe::respond_with_description(scene_handle, request, self.0.config().chunk_bytes).map_err(to_status)
    }

    type ReadContentStream = ReplyStream<v1::ReadContentResponse>;

    async fn read_content(
        &self,
        request: Request<v1::ReadContentRequest>,
    ) -> Result<Response<Self::ReadContentStream>, Status> {
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(to_status)?;
        describe::respond_with_content(scene_handle, request, self.0.config().chunk_bytes).await.map_err(to_status)
    }

    type ReadModesStream = ReplyStream<v1::ReadModesResponse>;

    async fn read_modes(
        &self,
        request: Request<v1::ReadModesRequest>,
    ) -> Result<Response<Self::ReadModesStream>, Status> {
        let request = request.into_inner();
        let scene_handle = self.0.find(&request.scene).map_err(to_status)?;
        describe::respond_with_modes(scene_handle, request, self.0.config().chunk_bytes).map_err(to_status)
    }
}

/// Time budget for waiting on an upload (a token bucket). Waiting consumes it, and received bytes refill it. A client
/// that sends nothing or too slowly therefore cannot hold its upload permit and disk space forever.
struct UploadTimeBudget {
    /// The full budget.
    max_wait: Duration,
    remaining: Duration,
}

impl UploadTimeBudget {
    const fn new(max_wait: Duration) -> Self {
        Self { max_wait, remaining: max_wait }
    }

    /// Waits for the client. Only this wait consumes the budget; processing the received data does not.
    ///
    /// # Errors
    /// `DEADLINE_EXCEEDED` when the budget is used up.
    async fn wait<T>(&mut self, part: impl Future<Output = T>) -> Result<T, Status> {
        let begin = Instant::now();
        let ms = self.max_wait.as_millis() as u64;
        let deadline_status = |_| to_status(Error::Deadline { what: "the upload".into(), ms });
        let part = tokio::time::timeout(self.remaining, part).await.map_err(deadline_status)?;
        self.remaining = self.remaining.saturating_sub(begin.elapsed());
        Ok(part)
    }

    /// Adds the time in which a client with the rate [`MIN_UPLOAD_RATE`] sends `bytes` bytes.
    fn refill(&mut self, bytes: usize) {
        let refill_time = Duration::from_secs_f64(bytes as f64 / MIN_UPLOAD_RATE);
        self.remaining = self.max_wait.min(self.remaining + refill_time);
    }
}

/// Receives the parts of an upload until the client closes its side. After an error the caller discards `upload`.
async fn receive_parts(
    engine: &Engine,
    mut parts: Streaming<v1::UploadSceneRequest>,
    upload: &mut Option<Upload>,
) -> Result<(), Status> {
    let max_message_bytes = engine.config().message_bytes;
    let mut budget = UploadTimeBudget::new(engine.config().stall_timeout);
    while let Some(request) =
        budget.wait(parts.message()).await?.map_err(|status| transport_status(status, max_message_bytes))?
    {
        budget.refill(request.encoded_len());
        let part = request.part.ok_or_else(|| {
            to_status(Error::UnexpectedMessage { expected: "header, file or chunk", given: "an empty message" })
        })?;
        *upload = Some(receive_part(engine, upload.take(), part).await.map_err(to_status)?);
    }
    Ok(())
}

/// Processes one part of an upload. Discards the upload if that fails. Disk access runs on the blocking pool.
async fn receive_part(engine: &Engine, upload: Option<Upload>, part: Part) -> Result<Upload> {
    let (mut upload, part) = match (upload, part) {
        (None, Part::Header(header)) => return engine.begin_upload(parse_upload_header(header)).await,
        (None, _) => {
            return Err(Error::UnexpectedMessage { expected: "a header as the first part", given: "a file or chunk" });
        }
        (Some(upload), part) => (upload, part),
    };
    let process_part = move || {
        let result = match part {
            Part::File(file) => upload.begin_file(&file.path, file.bytes, &file.sha256),
            Part::Chunk(bytes) => upload.write_chunk(&bytes),
            Part::Header(_) => {
                Err(Error::UnexpectedMessage { expected: "one header per upload", given: "a second header" })
            }
        };
        match result {
            Ok(()) => Ok(upload),
            Err(error) => {
                upload.discard();
                Err(error)
            }
        }
    };
    tokio::task::spawn_blocking(process_part).await.map_err(fault_in("upload"))?
}
