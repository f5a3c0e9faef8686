//! Records a scene of a server.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io::BufWriter;
use std::path::Path;
use std::sync::Arc;
use std::time::{Duration, SystemTime};

use bytes::Bytes;
use modalcast_client::{
    Client, ContentHash, Delivery, DrawnBy, Error as ClientError, FrameRequest, FrameStreamRequest, PROTOCOL_VERSION,
    Picture, Replies, SceneInfo, v1,
};
use prost::Message as _;
use sha2::{Digest as _, Sha256};
use tokio::sync::{OwnedSemaphorePermit, Semaphore, mpsc};
use v1::describe_scene_response::Part as DescriptionPart;
use v1::stream_states_response::Part as StatePart;

use crate::error::{Error, Result};
use crate::format::{MAX_CONTENT_BYTES, VERSION, metadata};
use crate::reader::ContentItem;
use crate::writer::{MetadataEntry, RecordingWriter, WriteSummary};

/// Longest time after which the open chunk is written.
const FLUSH_INTERVAL: Duration = Duration::from_secs(1);

/// Limit in bytes on the messages that wait to be written, so that a disk that is busy for some seconds neither makes the
/// writer of the scene wait nor ends the recording. When the queue is full, the server waits within the stall budget of
/// the writer ([`Delivery::Lossless`]) or skips steps ([`Delivery::Latest`]).
const QUEUED_BYTES: usize = 256 << 20;

/// Bytes for which a queued message counts in addition to its own: at least what it takes in memory.
const MESSAGE_OVERHEAD: usize = 512;

/// Number of hashes in one request: the limit of the server.
const HASHES_PER_REQUEST: usize = 4096;

/// A scene to record, and the limits of the recording.
#[derive(Debug, Clone, PartialEq)]
pub struct RecordRequest {
    /// Name of an open scene, or a source, which the server opens under its default name.
    pub scene: String,
    pub delivery: Delivery,
    /// Time from the subscription on after which the recording ends.
    pub duration: Option<Duration>,
    /// Number of states after which the recording ends; 0 for no limit.
    pub max_states: u64,
    /// Whether only the hashes of arrays and textures are recorded.
    pub by_hash: bool,
}

impl RecordRequest {
    /// A lossless recording without a limit, with all contents.
    pub fn new(scene: &str) -> Self {
        Self { scene: scene.to_owned(), delivery: Delivery::Lossless, duration: None, max_states: 0, by_hash: false }
    }
}

/// The result of [`record`].
#[derive(Debug)]
pub struct Recorded {
    pub summary: WriteSummary,
    /// Size of the file in bytes.
    pub file_bytes: u64,
    /// Why the recording ended, if the server has ended it. The file is complete up to there.
    pub error: Option<Error>,
}

/// Records states and forces of a scene until a limit of the request, `stop`, or the end of the server's streams.
/// `on_ready` is called when the server has accepted the subscriptions: later steps are recorded.
///
/// # Errors
/// `Client` if the scene does not exist or the server rejects the subscriptions; `File` if the file cannot be written.
pub async fn record(
    client: &Client,
    request: &RecordRequest,
    path: &Path,
    on_ready: impl FnOnce(),
    stop: impl Future<Output = ()>,
) -> Result<Recorded> {
    let scene = find_scene(client, &request.scene).await?;
    let description = describe(client, &scene.scene).await?;
    let contents = list_contents(&description)?;
    let total = contents.iter().map(|item| item.bytes).fold(0, u64::saturating_add);
    if !request.by_hash && total > MAX_CONTENT_BYTES {
        let expected = format!("at most {MAX_CONTENT_BYTES} bytes of meshes, modes and textures, or --by-hash");
        return Err(Error::invalid(format!("scene '{}'", scene.scene), expected, total));
    }
    let metadata = [recording_metadata(&scene, request), server_metadata(client).await?, content_metadata(&contents)];
    let view = view_metadata(client, &scene.scene).await?;
    let metadata: Vec<MetadataEntry> = metadata.into_iter().chain(view).collect();

    let file = File::create(path).map_err(|error| Error::open(path, &error))?;
    let mut writer = RecordingWriter::new(BufWriter::new(file), &metadata).map_err(|error| error.at(path))?;
    for message in description {
        writer.scene_message(message).map_err(|error| error.at(path))?;
    }
    if !request.by_hash {
        record_contents(client, &scene.scene, &contents, &mut writer).await.map_err(|error| error.at(path))?;
    }
    writer.flush().map_err(|error| error.at(path))?;

    let subscriptions = Subscriptions::open(client, &scene.scene, request).await?;
    on_ready();
    let (sender, queue) = write_queue();
    let write_task = tokio::task::spawn_blocking(move || write_messages(writer, queue));
    let error = subscriptions.forward(request.duration, &sender, stop).await;
    drop(sender);
    let written = write_task.await.map_err(|error| Error::file(path, error))?;
    let (file, summary) = written.map_err(|error| error.at(path))?;
    let file_bytes = file.metadata().map_err(|error| Error::file(path, error))?.len();
    Ok(Recorded { summary, file_bytes, error: error.map(Into::into) })
}

/// The open scene with this name, or else the scene that the server opens from the source `name`.
async fn find_scene(client: &Client, name: &str) -> Result<SceneInfo> {
    let open_scenes = client.list_scenes().await?.scenes;
    match open_scenes.into_iter().find(|scene| scene.scene == name) {
        Some(scene) => Ok(scene),
        None => Ok(client.open_scene(name, "").await?),
    }
}

async fn describe(client: &Client, scene: &str) -> Result<Vec<v1::DescribeSceneResponse>> {
    let request = v1::DescribeSceneRequest { scene: scene.to_owned(), hashes: true, ..Default::default() };
    let mut replies = client.description_messages(request).await?;
    let mut messages = Vec::new();
    while let Some(message) = replies.next().await? {
        messages.push(message);
    }
    Ok(messages)
}

/// All arrays and textures, each once.
fn list_contents(messages: &[v1::DescribeSceneResponse]) -> Result<Vec<ContentItem>> {
    let mut listed: Vec<(&Bytes, u64)> = Vec::new();
    for message in messages {
        match &message.part {
            Some(DescriptionPart::Shapes(list)) => {
                let arrays = list.shapes.iter().flat_map(|shape| &shape.arrays);
                listed.extend(arrays.map(|array| (&array.sha256, array.bytes)));
            }
            Some(DescriptionPart::Textures(list)) => {
                listed.extend(list.textures.iter().map(|texture| (&texture.sha256, texture.bytes)));
            }
            _ => {}
        }
    }
    let mut known = BTreeSet::new();
    let mut contents = Vec::new();
    for (hash, bytes) in listed {
        let Ok(hash) = ContentHash::try_from(&hash[..]) else {
            return Err(Error::invalid("describe.sha256", "32 bytes", hash.len()));
        };
        if known.insert(hash) {
            contents.push(ContentItem { hash, bytes });
        }
    }
    Ok(contents)
}

fn entry<const N: usize>(name: &'static str, values: [(&str, String); N]) -> MetadataEntry {
    MetadataEntry { name, values: values.into_iter().map(|(key, value)| (key.to_owned(), value)).collect() }
}

fn recording_metadata(scene: &SceneInfo, request: &RecordRequest) -> MetadataEntry {
    let delivery = match request.delivery {
        Delivery::Lossless => "lossless",
        Delivery::Latest => "latest",
    };
    let contents = if request.by_hash { "by-hash" } else { "embedded" };
    entry(
        metadata::RECORDING,
        [
            ("version", VERSION.to_owned()),
            ("created", humantime::format_rfc3339_seconds(SystemTime::now()).to_string()),
            ("scene", scene.scene.clone()),
            ("source", scene.source.clone()),
            ("delivery", delivery.to_owned()),
            ("contents", contents.to_owned()),
        ],
    )
}

async fn server_metadata(client: &Client) -> Result<MetadataEntry> {
    let info = client.server_info().await?;
    Ok(entry(
        metadata::SERVER,
        [
            ("version", info.version),
            ("protocol_version", PROTOCOL_VERSION.to_string()),
            ("backend", info.backend),
            ("device", info.device),
            ("renderer", info.renderer),
            ("software", info.is_software_renderer.to_string()),
        ],
    ))
}

fn content_metadata(contents: &[ContentItem]) -> MetadataEntry {
    let hex = |hash: &ContentHash| hash.iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    let hashes: Vec<String> = contents.iter().map(|item| hex(&item.hash)).collect();
    let sizes: Vec<String> = contents.iter().map(|item| item.bytes.to_string()).collect();
    entry(metadata::CONTENT, [("sha256", hashes.join(" ")), ("bytes", sizes.join(" "))])
}

/// Camera and look of the scene's default picture; `None` if the server has no renderer.
async fn view_metadata(client: &Client, scene: &str) -> Result<Option<MetadataEntry>> {
    if !client.server_info().await?.has_feature(v1::Feature::Frames) {
        return Ok(None);
    }
    let picture = Picture::default();
    let stream = client.stream_frames(&FrameStreamRequest::new(scene, picture).delivery(Delivery::Latest)).await?;
    let settings = stream.settings().pictures.first().cloned().unwrap_or_default();
    drop(stream);
    let frame = client.render_frame(&FrameRequest::new(scene, picture)).await?;
    let drawn_by = |drawn_by: Option<DrawnBy>| match drawn_by {
        None => String::new(),
        Some(DrawnBy::OpenGl) => "opengl".to_owned(),
        Some(DrawnBy::Cuda) => "cuda".to_owned(),
    };
    let mut view = entry(
        metadata::VIEW,
        [
            ("width", frame.width.to_string()),
            ("height", frame.height.to_string()),
            ("shadow_drawn_by", drawn_by(frame.shadow_drawn_by)),
            ("visibility_drawn_by", drawn_by(frame.visibility_drawn_by)),
        ],
    );
    let camera = settings.camera.unwrap_or_default();
    let numbers = |list: &[f64]| list.iter().map(f64::to_string).collect::<Vec<_>>().join(" ");
    let mut set = |key: &str, value: String| view.values.insert(key.to_owned(), value);
    match &camera.view {
        Some(v1::camera::View::LookAt(look_at)) => {
            set("eye", numbers(&look_at.eye));
            set("target", numbers(&look_at.target));
            set("up", numbers(&look_at.up));
        }
        Some(v1::camera::View::Pose(pose)) => {
            set("world_from_camera", numbers(&pose.world_from_camera));
        }
        None => {}
    }
    if let Some(v1::camera::Lens::FieldOfView(degrees)) = camera.lens {
        set("field_of_view", degrees.to_string());
    }
    if let Some(look) = frame.look {
        set("look_preset", look.preset.to_owned());
        set("antialiasing", look.antialiasing.to_owned());
        set("samples", look.samples.to_string());
        set("shadow_method", look.shadow_method.to_owned());
        set("shadow_size", look.shadow_size.to_string());
    }
    Ok(Some(view))
}

/// Fetches the contents and adds them. Compares them with their hashes; no content is in memory as a whole.
async fn record_contents<W: std::io::Write>(
    client: &Client,
    scene: &str,
    contents: &[ContentItem],
    writer: &mut RecordingWriter<W>,
) -> Result<()> {
    for (batch, items) in contents.chunks(HASHES_PER_REQUEST).enumerate() {
        let sha256 = items.iter().map(|item| Bytes::copy_from_slice(&item.hash)).collect();
        let mut replies = client.content_messages(v1::ReadContentRequest { scene: scene.to_owned(), sha256 }).await?;
        let mut hashes: BTreeMap<usize, Sha256> = BTreeMap::new();
        while let Some(mut message) = replies.next().await? {
            let Some(item) = items.get(message.item as usize) else {
                return Err(Error::invalid("content.item", format!("below {}", items.len()), message.item));
            };
            let index = message.item as usize;
            let hash = hashes.entry(index).or_default();
            hash.update(&message.data);
            let is_last = message.offset + message.data.len() as u64 >= message.total;
            if is_last && ContentHash::from(hash.clone().finalize()) != item.hash {
                return Err(Error::invalid(format!("content {index}"), "bytes with the described SHA-256", "others"));
            }
            message.item += (batch * HASHES_PER_REQUEST) as u32;
            writer.content_message(&message)?;
            if is_last {
                hashes.remove(&index);
            }
        }
    }
    Ok(())
}

/// A message for the file.
enum WriteCommand {
    State(v1::StateChunk),
    Forces(v1::StreamForcesResponse),
    Flush,
}

impl WriteCommand {
    fn bytes(&self) -> usize {
        let message_bytes = match self {
            Self::State(chunk) => chunk.encoded_len(),
            Self::Forces(forces) => forces.encoded_len(),
            Self::Flush => 0,
        };
        (MESSAGE_OVERHEAD + message_bytes).min(QUEUED_BYTES)
    }
}

/// A command in the queue. Its bytes count until it is written.
struct QueuedCommand {
    command: WriteCommand,
    _bytes: OwnedSemaphorePermit,
}

/// The end of the queue that the task of the streams owns.
struct WriteSender {
    commands: mpsc::Sender<QueuedCommand>,
    free_bytes: Arc<Semaphore>,
}

/// Creates the queue of messages to write. Its bytes bound it: the channel has capacity for all messages that they admit.
fn write_queue() -> (WriteSender, mpsc::Receiver<QueuedCommand>) {
    let (commands, queue) = mpsc::channel(QUEUED_BYTES / MESSAGE_OVERHEAD);
    (WriteSender { commands, free_bytes: Arc::new(Semaphore::new(QUEUED_BYTES)) }, queue)
}

impl WriteSender {
    /// Queues a command. Waits while the queue is full. Returns false if the task that writes has ended.
    async fn send(&self, command: WriteCommand) -> bool {
        let acquire = Arc::clone(&self.free_bytes).acquire_many_owned(command.bytes() as u32);
        tokio::select! {
            bytes = acquire => bytes.is_ok_and(|_bytes| self.commands.try_send(QueuedCommand { command, _bytes }).is_ok()),
            () = self.commands.closed() => false,
        }
    }
}

/// Writes messages until the queue is closed, then finishes the file.
fn write_messages(
    mut writer: RecordingWriter<BufWriter<File>>,
    mut queue: mpsc::Receiver<QueuedCommand>,
) -> Result<(File, WriteSummary)> {
    while let Some(QueuedCommand { command, _bytes }) = queue.blocking_recv() {
        match command {
            WriteCommand::State(chunk) => writer.state_chunk(chunk)?,
            WriteCommand::Forces(forces) => writer.forces(&forces)?,
            WriteCommand::Flush => writer.flush()?,
        }
    }
    let summary = writer.summary();
    let file = writer.finish()?.into_inner().map_err(|error| Error::file(Path::new("recording"), error.error()))?;
    Ok((file, summary))
}

struct Subscriptions {
    states: Replies<v1::StreamStatesResponse>,
    forces: Replies<v1::StreamForcesResponse>,
}

impl Subscriptions {
    async fn open(client: &Client, scene: &str, request: &RecordRequest) -> Result<Self> {
        let state_request = v1::StreamStatesRequest {
            scene: scene.to_owned(),
            delivery: v1::Delivery::from(request.delivery).into(),
            steps: request.max_states,
            max_hz: 0.0,
            stages_every: 0,
        };
        let force_request = v1::StreamForcesRequest { scene: scene.to_owned(), max_hz: 0.0, passive: true };
        let forces = client.force_messages(force_request).await?;
        Ok(Self { states: client.state_messages(state_request).await?, forces })
    }

    /// Sends messages to the task that writes, until a limit or the end of the stream of states. Returns the error that
    /// ended the stream.
    async fn forward(
        mut self,
        duration: Option<Duration>,
        sender: &WriteSender,
        stop: impl Future<Output = ()>,
    ) -> Option<ClientError> {
        let mut flushes = tokio::time::interval(FLUSH_INTERVAL);
        flushes.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
        let limit = async {
            match duration {
                Some(duration) => tokio::time::sleep(duration).await,
                None => std::future::pending().await,
            }
        };
        tokio::pin!(limit, stop);
        let mut has_forces = true;
        loop {
            let command = tokio::select! {
                message = self.states.next() => match message {
                    Ok(Some(v1::StreamStatesResponse { part: Some(StatePart::Chunk(chunk)) })) => WriteCommand::State(chunk),
                    Ok(Some(_)) => continue,
                    Ok(None) => return None,
                    Err(error) => return Some(error),
                },
                message = self.forces.next(), if has_forces => match message {
                    Ok(Some(forces)) => WriteCommand::Forces(forces),
                    // If the scene was deleted, the stream of states has ended too.
                    Ok(None) | Err(_) => {
                        has_forces = false;
                        continue;
                    }
                },
                _ = flushes.tick() => WriteCommand::Flush,
                () = &mut limit => return None,
                () = &mut stop => return None,
            };
            if !sender.send(command).await {
                // The task that writes has failed, and returns its error.
                return None;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn queue_is_bounded_in_bytes_and_ends_with_its_reader() {
        let (sender, mut queue) = write_queue();
        let send_quarter = || {
            let data = vec![0; QUEUED_BYTES / 4].into();
            sender.send(WriteCommand::State(v1::StateChunk { data, ..Default::default() }))
        };
        for _ in 0..3 {
            assert!(send_quarter().await);
        }
        tokio::time::timeout(Duration::ZERO, send_quarter()).await.expect_err("expected a full queue");
        drop(queue.recv().await);
        assert!(send_quarter().await, "expected capacity for a further message");
        drop(queue);
        assert!(!sender.send(WriteCommand::Flush).await, "expected the end of the queue");
    }
}
