//! Saves frames as `frame_00000.png` (or another extension) in the order of their arrival.

use std::path::Path;
use std::time::Duration;

use modalcast_client::{Client, Error, Frame, FrameFormat, FrameRequest, FrameStreamRequest, Result};

use crate::cli::{FrameStreamOptions, SingleFrameOptions};
use crate::output::{ReceivedReply, Summary, create_progress_bar, open_scene};

/// Saves one frame per step.
pub(crate) async fn fetch_stream(client: &Client, options: &FrameStreamOptions, as_json: bool) -> Result<()> {
    let scene = open_scene(client, &options.scene).await?;
    std::fs::create_dir_all(&options.out).map_err(|error| Error::file(&options.out, error))?;
    let request = FrameStreamRequest::new(&scene, options.picture.picture());
    let request = request.delivery(options.delivery.into()).max_steps(options.count);
    let mut frames = client.stream_frames(&request).await?;
    println!("ready");
    let timeout = Duration::from_secs_f64(options.timeout);
    let (mut summary, progress_bar) = (Summary::new(), create_progress_bar(options.count, "frames"));
    for index in 0..options.count {
        let deadline_error = Error::Deadline { awaited_reply: "the next frame", ms: timeout.as_millis() as u64 };
        let result = tokio::time::timeout(timeout, frames.next()).await.map_err(|_| deadline_error)?;
        let frame = result.unwrap_or(Err(Error::StreamEnded { awaited_reply: "the last frame" }))?;
        write_file(&options.out.join(format!("frame_{index:05}.{}", extension(frame.format))), &frame)?;
        summary.add(&received_reply(&frame));
        progress_bar.inc(1);
    }
    progress_bar.finish_and_clear();
    summary.print("frames", &options.out, None, as_json);
    Ok(())
}

/// Saves one frame.
pub(crate) async fn fetch_single(client: &Client, options: &SingleFrameOptions, as_json: bool) -> Result<()> {
    let scene = open_scene(client, &options.scene).await?;
    let request = FrameRequest::new(&scene, options.picture.picture());
    let request = request.step(options.step.selector()).deadline_ms(options.step.deadline_ms);
    let mut summary = Summary::new();
    let frame = client.render_frame(&request).await?;
    write_file(&options.out, &frame)?;
    summary.add(&received_reply(&frame));
    summary.print("frames", &options.out, None, as_json);
    Ok(())
}

fn received_reply(frame: &Frame) -> ReceivedReply<'_> {
    ReceivedReply {
        step_id: frame.step,
        bytes: frame.bytes.len() as u64,
        skipped: frame.skipped,
        stages: &frame.stages,
    }
}

fn write_file(path: &Path, frame: &Frame) -> Result<()> {
    std::fs::write(path, &frame.bytes).map_err(|error| Error::file(path, error))
}

const fn extension(format: FrameFormat) -> &'static str {
    match format {
        FrameFormat::Png => "png",
        FrameFormat::Rgba => "rgba",
        FrameFormat::F32 => "f32",
        FrameFormat::U32 => "u32",
        FrameFormat::F32x3 => "f32x3",
    }
}
