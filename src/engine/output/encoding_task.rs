//! Pictures that are being encoded.

use tokio::task::JoinHandle;

use super::frame_encoder::{EncodedFrame, FrameEncoder, StepPicture};
use super::frame_format::FrameFormat;
use modalcast_model::error::{Result, fault_in};

/// A picture that is encoded in a task of its own, whether or not it is awaited. Dropping it cancels the encoding,
/// except for the parts that threads have already started.
#[derive(Debug)]
pub struct EncodingTask {
    task: JoinHandle<Result<EncodedFrame>>,
    pixel_bytes: usize,
}

impl EncodingTask {
    /// Starts to encode a picture. Must be called in an async runtime.
    pub fn start(encoder: &FrameEncoder, picture: StepPicture, format: FrameFormat) -> Self {
        let (encoder, pixel_bytes) = (encoder.clone(), picture.picture.pixel_bytes());
        Self { task: tokio::spawn(async move { encoder.encode(picture, format).await }), pixel_bytes }
    }

    /// Waits for the encoded picture. Cancel-safe. Must not be called again after it has returned.
    ///
    /// # Errors
    /// `Fault` when the encoder fails.
    pub async fn finish(&mut self) -> Result<EncodedFrame> {
        (&mut self.task).await.map_err(fault_in("encode"))?
    }

    /// Size of the pixels in bytes.
    pub(in crate::engine) const fn pixel_bytes(&self) -> usize {
        self.pixel_bytes
    }
}

impl Drop for EncodingTask {
    fn drop(&mut self) {
        self.task.abort();
    }
}

#[cfg(test)]
mod tests {
    use super::super::frame_encoder::tests::{noise_frame, paused_encoder};
    use super::*;

    #[tokio::test]
    async fn pictures_are_encoded_without_a_wait_for_earlier_ones() {
        let (encoder, picture_permits) = paused_encoder(2);
        let start = |number| {
            let picture = StepPicture::of_output(noise_frame(number, 8)).expect("expected frames").next();
            EncodingTask::start(&encoder, picture.expect("expected a picture"), FrameFormat::Png)
        };
        let (mut first, mut second) = (start(1), start(2));
        picture_permits.add_permits(2);
        let encoded = second.finish().await.expect("expected a PNG");
        assert_eq!(encoded.output.step.number, 2);
        assert_eq!(first.finish().await.expect("expected a PNG").output.step.number, 1);
    }
}
