//! Receives the streams of `UploadScene` and `UploadArrays`. Both begin with a header and share one time budget.

use std::time::{Duration, Instant};

use modalcast_proto::v1;
use modalcast_proto::v1::upload_arrays_request::Part as ArraysPart;
use modalcast_proto::v1::upload_scene_request::Part as FilesPart;
use tonic::{Request, Status, Streaming};

use super::caller::Caller;
use super::convert::{parse_array_upload_header, parse_upload_header, parse_uploaded_domain};
use super::status::{to_status, transport_status};
use crate::admission::PermitHandle;
use crate::engine::{ArrayUpload, Engine, Upload};
use modalcast_model::error::{Error, Result, fault_in};

/// The lowest sustained upload rate that the server accepts, in bytes per second: 32 KiB/s.
const MIN_UPLOAD_RATE: f64 = 32768.0;

/// An upload makes progress with each so many bytes. A slow one does so rarely, and ends first for a new client.
const PROGRESS_BYTES: usize = 1 << 20;

/// An upload whose parts arrive in a stream.
pub(super) trait StreamedUpload: Sized + Send + 'static {
    type Request: prost::Message + Default + 'static;
    type Part: Send + 'static;

    /// The part that a message contains.
    fn part_of(request: Self::Request) -> Option<Self::Part>;

    /// Begins an upload with its first part, which must be a header.
    fn begin(engine: &Engine, caller: &Caller, part: Self::Part) -> impl Future<Output = Result<Self>> + Send;

    /// Adds a later part. Blocks on the disk.
    fn add_part(&mut self, part: Self::Part) -> Result<()>;

    /// The permit of the upload.
    fn permit(&self) -> Option<&PermitHandle>;

    /// Removes the files. Blocks on the disk.
    fn discard(self);
}

const fn missing_header() -> Error {
    Error::UnexpectedMessage { expected: "a header as the first part", given: "another part" }
}

const fn second_header() -> Error {
    Error::UnexpectedMessage { expected: "one header per upload", given: "a second header" }
}

impl StreamedUpload for Upload {
    type Request = v1::UploadSceneRequest;
    type Part = FilesPart;

    fn part_of(request: Self::Request) -> Option<FilesPart> {
        request.part
    }

    async fn begin(engine: &Engine, caller: &Caller, part: FilesPart) -> Result<Self> {
        let (principal, client) = (&caller.principal, caller.account.client);
        match part {
            FilesPart::Header(header) => engine.begin_upload(parse_upload_header(header), principal, client).await,
            _ => Err(missing_header()),
        }
    }

    fn add_part(&mut self, part: FilesPart) -> Result<()> {
        match part {
            FilesPart::File(file) if file.reuse => self.reuse_file(&file.path, file.bytes, &file.sha256),
            FilesPart::File(file) => self.begin_file(&file.path, file.bytes, &file.sha256),
            FilesPart::Chunk(bytes) => self.write_chunk(&bytes),
            FilesPart::Header(_) => Err(second_header()),
        }
    }

    fn permit(&self) -> Option<&PermitHandle> {
        self.permit()
    }

    fn discard(self) {
        Self::discard(self);
    }
}

impl StreamedUpload for ArrayUpload {
    type Request = v1::UploadArraysRequest;
    type Part = ArraysPart;

    fn part_of(request: Self::Request) -> Option<ArraysPart> {
        request.part
    }

    async fn begin(engine: &Engine, caller: &Caller, part: ArraysPart) -> Result<Self> {
        let (principal, client) = (&caller.principal, caller.account.client);
        match part {
            ArraysPart::Header(header) => {
                engine.begin_array_upload(parse_array_upload_header(header)?, principal, client).await
            }
            _ => Err(missing_header()),
        }
    }

    fn add_part(&mut self, part: ArraysPart) -> Result<()> {
        match part {
            ArraysPart::Domain(domain) => {
                let path = format!("domains[{}]", self.domain_count());
                let domain = parse_uploaded_domain(domain).map_err(|error| error.in_message(&path))?;
                self.begin_domain(&domain)
            }
            ArraysPart::Chunk(bytes) => self.write_chunk(&bytes),
            ArraysPart::Header(_) => Err(second_header()),
        }
    }

    fn permit(&self) -> Option<&PermitHandle> {
        self.permit()
    }

    fn discard(self) {
        Self::discard(self);
    }
}

/// Receives all parts of an upload of `caller` until the client closes its side. On failure, removes the files of the
/// upload.
pub(super) async fn receive_upload<U: StreamedUpload>(
    engine: &Engine,
    caller: &Caller,
    request: Request<Streaming<U::Request>>,
) -> Result<U, Status> {
    let mut upload = None;
    if let Err(error_status) = receive_parts(engine, caller, request.into_inner(), &mut upload).await {
        if let Some(upload) = upload {
            // If the removal fails, the next start of the server removes the files.
            tokio::task::spawn_blocking(move || U::discard(upload)).await.ok();
        }
        return Err(error_status);
    }
    upload.ok_or_else(|| {
        to_status(Error::UnexpectedMessage { expected: "a header as the first part", given: "the end of the stream" })
    })
}

/// Receives the parts of an upload. After an error the caller discards `upload`.
async fn receive_parts<U: StreamedUpload>(
    engine: &Engine,
    caller: &Caller,
    mut parts: Streaming<U::Request>,
    upload: &mut Option<U>,
) -> Result<(), Status> {
    use prost::Message as _;
    let max_message_bytes = engine.config().message_bytes;
    let mut budget = UploadTimeBudget::new(engine.config().upload_stall_budget);
    let mut received_bytes = 0;
    loop {
        let permit = upload.as_ref().and_then(U::permit).cloned();
        let message = unless_preempted(permit.as_ref(), budget.wait(parts.message())).await?;
        let Some(request) = message.map_err(|status| transport_status(status, max_message_bytes))? else { break };
        let bytes = request.encoded_len();
        budget.refill(bytes);
        received_bytes += bytes;
        if let Some(permit) = permit.filter(|_| received_bytes >= PROGRESS_BYTES) {
            permit.mark_progress();
            received_bytes = 0;
        }
        let part = U::part_of(request)
            .ok_or_else(|| to_status(Error::UnexpectedMessage { expected: "a part", given: "an empty message" }))?;
        *upload = Some(receive_part(engine, caller, upload.take(), part).await.map_err(to_status)?);
    }
    Ok(())
}

/// Waits for a part of an upload, unless the upload ends for another client.
async fn unless_preempted<T>(
    permit: Option<&PermitHandle>,
    part: impl Future<Output = Result<T, Status>>,
) -> Result<T, Status> {
    let Some(permit) = permit else { return part.await };
    tokio::select! {
        biased;
        error = permit.preempted() => Err(to_status(error)),
        part = part => part,
    }
}

/// Processes one part of an upload. Discards the upload if that fails. Disk access runs on the blocking pool.
async fn receive_part<U: StreamedUpload>(
    engine: &Engine,
    caller: &Caller,
    upload: Option<U>,
    part: U::Part,
) -> Result<U> {
    let Some(mut upload) = upload else { return U::begin(engine, caller, part).await };
    let process_part = move || match upload.add_part(part) {
        Ok(()) => Ok(upload),
        Err(error) => {
            U::discard(upload);
            Err(error)
        }
    };
    tokio::task::spawn_blocking(process_part).await.map_err(fault_in("upload"))?
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
