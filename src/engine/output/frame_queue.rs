//! Frames on their way to a client: drawn and encoded concurrently, and delivered in order.

use futures_util::future::{BoxFuture, FutureExt as _};
use futures_util::stream::{FuturesOrdered, StreamExt as _};

use bytes::Bytes;

use super::frame_encoder::{EncodedPicture, FrameEncoder};
use super::frame_format::FrameFormat;
use super::step_output::{OutputBody, SharedPicture, StepFrames, StepId, StepOutput};
use crate::telemetry::StageTimes;
use modalcast_model::error::{Result, fault};
use modalcast_render::FrameInfo;

/// An encoded picture of a step.
#[derive(Debug, Clone)]
pub struct EncodedFrame {
    pub step: StepId,
    /// Steps that the subscriber skipped since its last output; 0 for all pictures of a step but the first.
    pub skipped: u64,
    /// Stage times of the step and of the picture.
    pub stages: StageTimes,
    /// How a color frame was drawn; default for other frames.
    pub info: FrameInfo,
    /// Index of the picture in the request.
    pub picture: u32,
    /// Number of camera updates that the frame includes.
    pub camera_version: u64,
    pub bytes: Bytes,
}

/// Waits for the pictures of steps and encodes them. Only [`Self::next`] makes progress.
pub struct FrameQueue {
    encoder: FrameEncoder,
    /// The format of each picture of a step.
    formats: Vec<FrameFormat>,
    frames: FuturesOrdered<BoxFuture<'static, Result<EncodedFrame>>>,
}

impl FrameQueue {
    /// A queue of steps with one picture per format.
    pub fn new(encoder: FrameEncoder, formats: Vec<FrameFormat>) -> Self {
        Self { encoder, formats, frames: FuturesOrdered::new() }
    }

    /// Adds the pictures of a step.
    ///
    /// # Errors
    /// `Fault` when `output` has no frames.
    pub fn push(&mut self, output: StepOutput) -> Result<()> {
        let StepOutput { step, skipped, stages, body: OutputBody::Frames(frames), .. } = output else {
            return Err(fault("encode", "expected frames, got another output"));
        };
        let StepFrames { pictures, camera_version } = frames;
        for ((index, picture), format) in (0..).zip(pictures).zip(&self.formats) {
            let frame = EncodedFrame {
                step,
                skipped: if index == 0 { skipped } else { 0 },
                stages: stages.clone(),
                info: FrameInfo::default(),
                picture: index,
                camera_version,
                bytes: Bytes::new(),
            };
            self.frames.push_back(encode(self.encoder.clone(), picture, *format, frame).boxed());
        }
        Ok(())
    }

    /// Waits for the oldest frame; `None` if there is none. Meanwhile the other frames are encoded, too. Cancel-safe.
    pub async fn next(&mut self) -> Option<Result<EncodedFrame>> {
        self.frames.next().await
    }

    pub(in crate::engine) fn is_empty(&self) -> bool {
        self.frames.is_empty()
    }

    /// Number of frames that are not encoded yet.
    pub(in crate::engine) fn len(&self) -> usize {
        self.frames.len()
    }

    /// Number of pictures of a step.
    pub(in crate::engine) fn pictures_per_step(&self) -> usize {
        self.formats.len().max(1)
    }

    pub(in crate::engine) fn encoder(&self) -> &FrameEncoder {
        &self.encoder
    }
}

/// Waits for a picture and encodes it. `frame` lacks what the picture adds.
async fn encode(
    encoder: FrameEncoder,
    picture: SharedPicture,
    format: FrameFormat,
    mut frame: EncodedFrame,
) -> Result<EncodedFrame> {
    let picture = picture.wait().await?;
    let EncodedPicture { bytes, stages } = encoder.encode(&picture, format).await?;
    frame.stages.extend(stages);
    Ok(EncodedFrame { info: picture.info, bytes, ..frame })
}
