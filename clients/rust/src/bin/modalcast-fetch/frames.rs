//! Saves frames as `frame_00000.png` (or another extension) in the order of their arrival.

use std::path::Path;
use std::time::Duration;

use modalcast_client::{Client, Error, Frame, FrameFormat, FrameRequest, FrameStreamRequest, Result};

use crate::cli::{FrameOptions, FramesOptions};
use crate::output::{ReceivedStep, Summary, bar, scene};

pub(crate) async fn stream(client: &Client, options: &FramesOptions, json: bool) -> Result<()> {
    let name = scene(client, &options.scene).await?;
    std::fs::create_dir_all(&options.out).map_err(|fault| Error::file(&options.out, fault))?;
    let request = FrameStreamRequest::new(&name, options.picture.picture());
    let request = request.delivery(options.delivery.into()).replies(options.count);
    let mut frames = client.stream_frames(&request).await?;
    println!("ready");
    let timeout = Duration::from_secs_f64(options.timeout);
    let (mut summary, bar) = (Summary::new(), bar(options.count, "frames"));
    for index in 0..options.count {
        let late = Error::Deadline { what: "the next frame", ms: timeout.as_millis() as u64 };
        let next = tokio::time::timeout(timeout, frames.next()).await.map_err(|_| late)?;
        let frame = next.unwrap_or(Err(Error::StreamEnded { what: "the last frame" }))?;
        write(&options.out.join(format!("frame_{index:05}.{}", extension(frame.format))), &frame)?;
        summary.add(&received(&frame));
        bar.inc(1);
    }
    bar.finish_and_clear();
    summary.print("frames", &options.out, None, json);
    Ok(())
}

pub(crate) async fn single(client: &Client, options: &FrameOptions, json: bool) -> Result<()> {
    let name = scene(client, &options.scene).await?;
    let request = FrameRequest::new(&name, options.picture.picture());
    let request = request.at(options.step.selector()).deadline_ms(options.step.deadline_ms);
    let mut summary = Summary::new();
    let frame = client.frame(&request).await?;
    write(&options.out, &frame)?;
    summary.add(&received(&frame));
    summary.print("frames", &options.out, None, json);
    Ok(())
}

fn received(frame: &Frame) -> ReceivedStep<'_> {
    ReceivedStep { step: frame.step, bytes: frame.bytes.len() as u64, skipped: frame.skipped, stages: &frame.stages }
}

fn write(path: &Path, frame: &Frame) -> Result<()> {
    std::fs::write(path, &frame.bytes).map_err(|fault| Error::file(path, fault))
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
