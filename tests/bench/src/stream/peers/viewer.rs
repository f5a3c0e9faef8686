//! A client in its own process that receives frames or vertices and measures their rate.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::time::Instant;

use modalcast_client::{
    Attribute, Camera, Client, Encoding, FrameFormat, FrameStreamRequest, Lens, Picture, StageSamples, StageTimes,
    StepId, VertexRequest, VertexSelection, VertexStreamRequest, View,
};
use serde::{Deserialize, Serialize};

use modalcast::cli::print_line;
use modalcast_model::error::{Result, fault, fault_in};

/// What a viewer receives, and how often.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewerJob {
    /// URL of the server.
    pub(in crate::stream) server: String,
    /// The server's socket for shared memory, if the viewer uses it.
    pub(in crate::stream) shared_memory: Option<PathBuf>,
    pub(in crate::stream) scene: String,
    pub(in crate::stream) replies: u64,
    pub(in crate::stream) content: Content,
    /// The direction to look from: view v is turned about the up axis by v quarters of a turn. View 0 is the camera
    /// that the server selects.
    pub(in crate::stream) view: u32,
}

/// Content and encoding of the replies.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub(in crate::stream) enum Content {
    Png {
        width: u32,
        height: u32,
    },
    Rgba {
        width: u32,
        height: u32,
    },
    /// A stream of positions as f32.
    Positions,
    /// A stream of positions as 16-bit numbers in boxes.
    CompactPositions,
    /// Positions as f32, requested again and again without a subscription.
    RequestedPositions,
}

impl Content {
    /// Name in tables.
    pub(in crate::stream) fn name(self) -> String {
        match self {
            Self::Png { width, height } => format!("PNG {width}x{height}"),
            Self::Rgba { width, height } => format!("raw {width}x{height}"),
            Self::Positions => "positions f32".into(),
            Self::CompactPositions => "positions u16 in boxes".into(),
            Self::RequestedPositions => "positions f32 by single requests".into(),
        }
    }

    /// Whether the server draws pictures for this content.
    pub(in crate::stream) const fn is_picture(self) -> bool {
        matches!(self, Self::Png { .. } | Self::Rgba { .. })
    }

    fn vertex_selection(self) -> VertexSelection {
        let encoding = if self == Self::CompactPositions { Encoding::U16Box } else { Encoding::F32 };
        VertexSelection::default().encoded_attribute(Attribute::Positions, encoding)
    }
}

/// The replies of one viewer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(crate) struct ViewerSummary {
    pub(in crate::stream) replies: u64,
    /// (n - 1) / t for n replies, where t is the time from the first to the last reply. 0 for fewer than two replies.
    pub(in crate::stream) per_second: f64,
    /// Bytes of all replies.
    pub(in crate::stream) bytes: u64,
    /// Steps that the server skipped.
    pub(in crate::stream) skipped: u64,
    /// Median of each stage in milliseconds.
    pub(in crate::stream) stages_ms: BTreeMap<String, f32>,
}

/// Collects the replies of a viewer.
#[derive(Default)]
struct Collector {
    /// Arrival of the first and of the last reply.
    times: Option<(Instant, Instant)>,
    replies: u64,
    bytes: u64,
    skipped: u64,
    stages: StageSamples,
    last_step: Option<u64>,
}

impl Collector {
    /// Adds a reply.
    ///
    /// # Errors
    /// `Fault` when the step of a lossless stream is not the one after the previous step.
    fn add(&mut self, step: StepId, bytes: u64, skipped: u64, stages: &StageTimes) -> Result<()> {
        if let Some(last_step) = self.last_step.replace(step.number).filter(|last_step| last_step + 1 != step.number) {
            return Err(fault("report", format!("expected step {}, got {}", last_step + 1, step.number)));
        }
        self.add_any_step(bytes, skipped, stages);
        Ok(())
    }

    /// Adds a reply whose step need not follow the previous one.
    fn add_any_step(&mut self, bytes: u64, skipped: u64, stages: &StageTimes) {
        let now = Instant::now();
        self.times = Some((self.times.map_or(now, |(first, _)| first), now));
        self.replies += 1;
        self.bytes += bytes;
        self.skipped += skipped;
        self.stages.add(stages);
    }

    fn summary(self) -> ViewerSummary {
        let seconds = self.times.map_or(0.0, |(first, last)| (last - first).as_secs_f64());
        ViewerSummary {
            replies: self.replies,
            per_second: rate(self.replies, seconds),
            bytes: self.bytes,
            skipped: self.skipped,
            stages_ms: self.stages.medians(),
        }
    }
}

/// (n - 1) / t for n replies and the time from the first to the last one; 0 without a time.
pub(in crate::stream) fn rate(replies: u64, seconds: f64) -> f64 {
    if seconds > 0.0 { replies.saturating_sub(1) as f64 / seconds } else { 0.0 }
}

/// Subscribes, prints the line `ready`, receives all replies, and prints a [`ViewerSummary`] as JSON.
///
/// # Errors
/// `Fault` when the server rejects the request, a stream ends early, or a step is missing.
pub(in crate::stream) async fn run(job: &ViewerJob) -> Result<()> {
    let mut client = Client::connect(&job.server).await.map_err(fault_in("viewer"))?;
    if let Some(path) = &job.shared_memory {
        client = client.with_shared_memory(path).await.map_err(fault_in("viewer"))?;
    }
    let mut collector = Collector::default();
    match job.content {
        Content::RequestedPositions => request_positions(&client, job, &mut collector).await?,
        Content::Positions | Content::CompactPositions => receive_positions(&client, job, &mut collector).await?,
        Content::Png { .. } | Content::Rgba { .. } => receive_frames(&client, job, &mut collector).await?,
    }
    print_line(serde_json::to_string(&collector.summary()).map_err(fault_in("viewer"))?);
    Ok(())
}

/// The picture of a job; `None` for vertices.
pub(in crate::stream) async fn picture(
    client: &Client,
    scene: &str,
    content: Content,
    view: u32,
) -> Result<Option<Picture>> {
    let (size, format) = match content {
        Content::Png { width, height } => ((width, height), FrameFormat::Png),
        Content::Rgba { width, height } => ((width, height), FrameFormat::Rgba),
        Content::Positions | Content::CompactPositions | Content::RequestedPositions => return Ok(None),
    };
    let camera = match view {
        0 => None,
        _ => Some(turned_camera(client, scene, view).await?),
    };
    Ok(Some(Picture { camera, ..Picture::default() }.size(size.0, size.1).format(format)))
}

/// A camera that shows the whole scene from the direction of a view.
async fn turned_camera(client: &Client, scene: &str, view: u32) -> Result<Camera> {
    let info = client.describe(scene, &[]).await.map_err(fault_in("viewer"))?.info;
    let bounds: [f64; 6] =
        info.bounds.as_slice().try_into().map_err(|_| fault("viewer", "expected six numbers of bounds"))?;
    let target: [f64; 3] = std::array::from_fn(|axis| (bounds[axis] + bounds[axis + 3]) / 2.0);
    let diagonal = (0..3).map(|axis| (bounds[axis + 3] - bounds[axis]).powi(2)).sum::<f64>().sqrt();
    let up_axis = match info.up.as_str() {
        "x" => 0,
        "y" => 1,
        _ => 2,
    };
    let (sine, cosine) = (f64::from(view) * std::f64::consts::FRAC_PI_2).sin_cos();
    // At 1.6 diagonals, a field of view of 35 degrees contains the sphere around the bounds.
    let (mut eye, mut up) = (target, [0.0; 3]);
    eye[(up_axis + 1) % 3] += 1.6 * diagonal * cosine;
    eye[(up_axis + 2) % 3] += 1.6 * diagonal * sine;
    up[up_axis] = 1.0;
    Ok(Camera { view: View::LookAt { eye, target, up: Some(up) }, lens: Lens::FieldOfView(35.0), clip: None })
}

async fn receive_frames(client: &Client, job: &ViewerJob, collector: &mut Collector) -> Result<()> {
    let picture = picture(client, &job.scene, job.content, job.view).await?;
    let picture = picture.ok_or_else(|| fault("viewer", "expected a picture"))?;
    let request = FrameStreamRequest::new(&job.scene, picture).max_steps(job.replies);
    let mut frames = client.stream_frames(&request).await.map_err(fault_in("viewer"))?;
    print_line("ready");
    while let Some(frame) = frames.next().await {
        let frame = frame.map_err(fault_in("viewer"))?;
        collector.add(frame.step, frame.bytes.len() as u64, frame.skipped, &frame.stages)?;
    }
    Ok(())
}

async fn receive_positions(client: &Client, job: &ViewerJob, collector: &mut Collector) -> Result<()> {
    let request = VertexStreamRequest::new(&job.scene, job.content.vertex_selection()).max_steps(job.replies);
    let mut vertices = client.stream_vertices(&request).await.map_err(fault_in("viewer"))?;
    print_line("ready");
    while let Some(set) = vertices.next().await {
        let set = set.map_err(fault_in("viewer"))?;
        collector.add(set.step, set.encoded_bytes, set.skipped, &set.stages)?;
    }
    Ok(())
}

async fn request_positions(client: &Client, job: &ViewerJob, collector: &mut Collector) -> Result<()> {
    print_line("ready");
    let request = VertexRequest::new(&job.scene, job.content.vertex_selection());
    for _ in 0..job.replies {
        let set = client.get_vertices(&request).await.map_err(fault_in("viewer"))?;
        collector.add_any_step(set.encoded_bytes, set.skipped, &set.stages);
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_excludes_the_wait_for_the_first_reply() {
        assert_eq!((rate(3, 4.0), rate(1, 4.0), rate(0, 1.0), rate(2, 0.0)), (0.5, 0.0, 0.0, 0.0));
    }

    #[test]
    fn missing_step_is_an_error() {
        let step = |number| StepId { run: 1, number, time: 0.0 };
        let mut collector = Collector::default();
        collector.add(step(4), 10, 0, &vec![("draw".into(), 2.0)]).expect("expected the first step");
        collector.add(step(5), 10, 0, &vec![("draw".into(), 2.0)]).expect("expected the next step");
        let error = collector.add(step(7), 10, 0, &vec![]).expect_err("expected a missing step").to_string();
        assert!(error.contains("expected step 6, got 7"), "{error}");
        let summary = collector.summary();
        assert_eq!((summary.replies, summary.bytes, summary.stages_ms["draw"]), (2, 20, 2.0));
    }
}
