//! Drives a scene of a server with a recording.

use std::collections::HashMap;
use std::time::Duration;

use modalcast_client::{
    ArrayUpload, Client, Delivery, DescriptionRequest, DriveRequest, Error as ClientError, Frame, FrameStream,
    FrameStreamRequest, MAX_STALL_BUDGET, Picture, Reason, SceneDescription, SceneInfo, Shape, StepStream,
    UploadDomain, UploadShape,
};
use tokio::sync::mpsc;
use tokio::time::Instant;

use crate::error::{Error, Result};
use crate::format::metadata;
use crate::reader::{Recording, SURFACE_ARRAYS};
use crate::step_source::{StepSource, TimeRange, TimedStep};
use crate::steps::StepTarget;

/// Maximum number of steps that are read ahead of their time. When the queue is full, the reader waits.
const QUEUED_STEPS: usize = 16;

/// Maximum number of sent steps whose frames were not received yet. When the queue is full, no step is sent.
const SENT_STEPS: usize = 1024;

/// How to replay a recording.
#[derive(Debug, Clone, PartialEq)]
pub struct ReplayRequest {
    pub range: TimeRange,
    /// Seconds of the recording per second of real time; `None`: as fast as the server accepts steps.
    pub speed: Option<f64>,
    /// Whether the replay begins again at its end.
    pub repeats: bool,
    /// Pictures of each step that are passed to the caller; at most 16, the server's limit.
    pub pictures: Vec<Picture>,
    /// Plays only the states that are current at the times of this number of frames per second of the recording, 0.001 to
    /// 1e9; `None`: every state.
    pub frame_rate: Option<f64>,
}

impl Default for ReplayRequest {
    /// The whole recording at the recorded speed, without pictures.
    fn default() -> Self {
        Self { range: TimeRange::ALL, speed: Some(1.0), repeats: false, pictures: Vec::new(), frame_rate: None }
    }
}

/// The scene that a replay drives.
#[derive(Debug, Clone, PartialEq)]
pub struct OpenedScene {
    pub info: SceneInfo,
    pub target: StepTarget,
}

/// A frame of a replay.
#[derive(Debug)]
pub struct ReplayedFrame {
    pub frame: Frame,
    /// Index of the step in the replay, from 0.
    pub step_index: u64,
    /// Number of frames of a video that show the step: 1, unless [`ReplayRequest::frame_rate`] selects states.
    pub repeats: u64,
}

/// Totals of a replay.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Replayed {
    /// Number of steps, all of which the server has completed.
    pub steps: u64,
    /// The run of the steps.
    pub run: u64,
    /// Time from the first step to the acknowledgment of the last one.
    pub duration: Duration,
}

/// Opens the recorded scene on a server.
///
/// Uses an open scene with the name and the recorded contents. Otherwise opens the recorded source. If the server does
/// not have the source, or has it with other contents, uploads the recorded meshes and modes.
///
/// # Errors
/// `Invalid` if an open scene with the name has other contents; `Unavailable` if contents are needed and the recording
/// has only their hashes; `Client` if the server rejects a call.
pub async fn open_recorded_scene(client: &Client, recording: &Recording, name: &str) -> Result<OpenedScene> {
    let recorded = &recording.description().info;
    let name = if name.is_empty() { recorded.scene.as_str() } else { name };
    let open_scenes = client.list_scenes().await?.scenes;
    let target = StepTarget::RecordedScene;
    if let Some(info) = open_scenes.into_iter().find(|scene| scene.scene == name) {
        return match has_recorded_contents(client, recording, name).await? {
            true => Ok(OpenedScene { info, target }),
            false => {
                let expected = "a name without an open scene, or the recorded scene";
                Err(Error::invalid("--scene", expected, format!("'{name}', an open scene with other contents")))
            }
        };
    }
    let source = recording.metadata(metadata::RECORDING, "source").unwrap_or(&recorded.source);
    match client.open_scene(source, name).await {
        Ok(info) if has_recorded_contents(client, recording, name).await? => return Ok(OpenedScene { info, target }),
        Ok(_) => client.delete_scene(name).await?,
        Err(error) if is_missing_source(&error) => {}
        Err(error) => return Err(error.into()),
    }
    let info = client.upload_arrays(array_upload(recording, name)?).await?;
    Ok(OpenedScene { info, target: StepTarget::UploadedArrays })
}

/// Whether a source does not exist or cannot be read. The recorded source of an uploaded scene never exists.
fn is_missing_source(error: &ClientError) -> bool {
    let reasons = [Reason::SceneNotFound, Reason::InvalidField, Reason::InvalidFile];
    error.rejection().is_some_and(|rejection| reasons.contains(&rejection.reason))
}

/// Compares descriptions: hashes of meshes, modes and textures, materials and domains.
async fn has_recorded_contents(client: &Client, recording: &Recording, name: &str) -> Result<bool> {
    let mut description = client.describe_with(&DescriptionRequest::new(name).hashes()).await?;
    let recorded = recording.description();
    description.info = without_usage(description.info);
    Ok(description == SceneDescription { info: without_usage(recorded.info.clone()), ..recorded.clone() })
}

/// A scene without what says nothing about its contents: its name and source, its progress, and who uses it.
fn without_usage(info: SceneInfo) -> SceneInfo {
    SceneInfo {
        scene: String::new(),
        source: String::new(),
        last_step: None,
        durable_step: None,
        remarks: Vec::new(),
        owner: String::new(),
        shared_with: Vec::new(),
        writer: String::new(),
        streams: 0,
        ..info
    }
}

/// The recorded meshes, modes and colors of all domains.
fn array_upload(recording: &Recording, name: &str) -> Result<ArrayUpload> {
    let mut description = recording.read_description(&SURFACE_ARRAYS, false)?;
    let shapes = std::mem::take(&mut description.shapes);
    let SceneDescription { info, materials, domains, .. } = description;
    let mut shapes: Vec<Option<Shape>> = shapes.into_iter().map(Some).collect();
    let mut first_domains: HashMap<usize, u32> = HashMap::new();
    let mut upload = ArrayUpload::new(name).unit(info.unit).up(&info.up);
    for (index, domain) in domains.iter().enumerate() {
        let (shape, origin) = match (shapes[domain.shape].take(), first_domains.get(&domain.shape)) {
            (Some(shape), _) => {
                first_domains.insert(domain.shape, index as u32);
                let origin = shape.origin;
                (upload_shape(shape), origin)
            }
            (None, first) => (UploadShape::OfDomain(first.copied().unwrap_or_default()), [0.0; 3]),
        };
        let color = materials.get(domain.material).map_or([0.5; 3], |material| material.diffuse);
        let domain = UploadDomain::new(&domain.name, shape)
            .origin(origin)
            .exact_placement(domain.exact_placement)
            .color(color)
            .eigenvalues(&domain.eigenvalues);
        upload = upload.domain(domain);
    }
    Ok(upload)
}

fn upload_shape(shape: Shape) -> UploadShape {
    // `check_arrays` has checked the lengths and the indices.
    let vertices: Vec<u32> = shape.indices.iter().map(|corner| shape.corner_vertices[*corner as usize]).collect();
    UploadShape::Arrays {
        positions: shape.local_positions().as_chunks().0.to_vec(),
        triangles: vertices.as_chunks().0.to_vec(),
        rank: shape.rank as u32,
        modes: shape.modes,
    }
}

/// Replays a recording on a scene that [`open_recorded_scene`] has opened, until its end or `stop`. Passes the frames
/// of all pictures to `on_frame`, in the order of the steps.
///
/// # Errors
/// `Invalid` if a picture or the speed is invalid; `InvalidFile` if the recording is damaged; `Client` if the server
/// rejects a step or the connection is lost; errors of `on_frame`.
pub async fn replay(
    client: &Client,
    recording: &Recording,
    scene: &OpenedScene,
    request: &ReplayRequest,
    on_frame: impl FnMut(ReplayedFrame) -> Result<()>,
    stop: impl Future<Output = ()>,
) -> Result<Replayed> {
    let speed = request.speed;
    if let Some(speed) = speed.filter(|speed| !(speed.is_finite() && *speed > 0.0)) {
        return Err(Error::invalid("speed", "a finite number above 0", speed));
    }
    if let Some(rate) = request.frame_rate.filter(|rate| !(1e-3..=1e9).contains(rate)) {
        return Err(Error::invalid("frame_rate", "0.001 to 1e9 frames per second of the recording", rate));
    }
    let name = &scene.info.scene;
    let frames = match request.pictures.as_slice() {
        [] => None,
        pictures => Some(client.stream_frames(&FrameStreamRequest::new(name, pictures.to_vec())).await?),
    };
    // The replay reads the pictures itself, and must not miss any while it writes to a slow disk.
    let drive_request = DriveRequest::new(name, Delivery::Lossless).reset().stall_budget(MAX_STALL_BUDGET);
    let mut step_stream = client.drive(&drive_request).await?;
    let run = step_stream.run;
    let (sender, queue) = mpsc::channel(QUEUED_STEPS);
    let (sent_sender, sent_steps) = mpsc::channel(SENT_STEPS);
    let source = StepSource::new(recording, scene.target, request.range, request.frame_rate)?;
    let (recording, range, repeats) = (recording.clone(), request.range, request.repeats);
    let reader = tokio::task::spawn_blocking(move || read_steps(&recording, source, range, repeats, &sender));

    let start = Instant::now();
    let drive = async {
        let steps = drive_steps(&mut step_stream, queue, speed, sent_sender, stop).await?;
        step_stream.finish().await?;
        Ok(Replayed { steps, run, duration: start.elapsed() })
    };
    let receive = receive_frames(frames, request.pictures.len(), sent_steps, on_frame);
    let (replayed, ()) = tokio::try_join!(drive, receive)?;
    // The reader has failed, or has ended because the queue was closed.
    reader.await.map_err(|error| Error::File { path: "replay".to_owned(), reason: error.to_string() })??;
    Ok(replayed)
}

/// Reads the steps until the end of the recording, or until the queue is closed.
fn read_steps(
    recording: &Recording,
    mut source: StepSource,
    range: TimeRange,
    repeats: bool,
    sender: &mpsc::Sender<TimedStep>,
) -> Result<()> {
    // Nanoseconds at which the present repetition begins.
    let mut pass_start = 0;
    loop {
        let (mut last_time, mut interval) = (0, 0);
        while let Some(mut step) = source.next()? {
            (interval, last_time) = (step.time - last_time, step.time);
            step.time += pass_start;
            if sender.blocking_send(step).is_err() {
                return Ok(());
            }
        }
        if !repeats {
            return Ok(());
        }
        // The next repetition begins one interval after the last state: the time between the last two states.
        pass_start += last_time + interval;
        source.rewind(recording, range)?;
    }
}

/// Sends steps when they are due. Returns their number.
async fn drive_steps(
    step_stream: &mut StepStream,
    mut queue: mpsc::Receiver<TimedStep>,
    speed: Option<f64>,
    sent: mpsc::Sender<u64>,
    stop: impl Future<Output = ()>,
) -> Result<u64> {
    let start = Instant::now();
    tokio::pin!(stop);
    let mut count = 0;
    loop {
        let step = tokio::select! {
            step = queue.recv() => step,
            () = &mut stop => None,
        };
        let Some(TimedStep { time, step, frames }) = step else { return Ok(count) };
        if let Some(speed) = speed {
            let due =
                Duration::try_from_secs_f64(time as f64 * 1e-9 / speed).ok().and_then(|delay| start.checked_add(delay));
            // A time that the clock cannot represent never comes.
            let wait = async {
                match due {
                    Some(due) => tokio::time::sleep_until(due).await,
                    None => std::future::pending().await,
                }
            };
            tokio::select! {
                () = wait => {}
                () = &mut stop => return Ok(count),
            }
        }
        step_stream.step(&step).await?;
        count += 1;
        // Without pictures, the channel has no receiver.
        sent.send(frames).await.ok();
    }
}

/// Receives the frames of all sent steps. `sent` has one number per step: how often its frames are shown.
async fn receive_frames(
    frames: Option<FrameStream>,
    picture_count: usize,
    mut sent: mpsc::Receiver<u64>,
    mut on_frame: impl FnMut(ReplayedFrame) -> Result<()>,
) -> Result<()> {
    let Some(mut frames) = frames else { return Ok(()) };
    let mut step_index = 0;
    while let Some(repeats) = sent.recv().await {
        for _ in 0..picture_count {
            let end = Err(ClientError::StreamEnded { awaited_reply: "the frames of a step" });
            let frame = frames.next().await.unwrap_or(end)?;
            on_frame(ReplayedFrame { frame, step_index, repeats })?;
        }
        step_index += 1;
    }
    Ok(())
}
