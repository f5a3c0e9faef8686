//! Saves frames as `frame_00000.png` (or another extension) in the order of their arrival. With several outputs, the
//! name of the output is part of the file name: `frame_00000_depth.f32`.

use std::path::{Path, PathBuf};
use std::time::Duration;

use modalcast_client::{Client, Error, Frame, FrameFormat, FrameStreamRequest, FramesRequest, Result};

use crate::cli::{FrameStreamOptions, SingleFrameOptions};
use crate::output::{ReceivedReply, Summary, create_progress_bar, open_scene};

/// Saves one frame per step and output.
pub(crate) async fn fetch_stream(client: &Client, options: &FrameStreamOptions, as_json: bool) -> Result<()> {
    let scene = open_scene(client, &options.scene).await?;
    std::fs::create_dir_all(&options.out).map_err(|error| Error::file(&options.out, error))?;
    let suffixes = options.picture.file_suffixes();
    let request = FrameStreamRequest::new(&scene, options.picture.pictures());
    let request = request.delivery(options.delivery.into()).max_steps(options.count).max_hz(options.max_hz);
    let mut frames = client.stream_frames(&request).await?;
    println!("ready");
    let timeout = Duration::from_secs_f64(options.timeout);
    let (mut summary, progress_bar) = (Summary::new(), create_progress_bar(options.count, "steps"));
    for (index, suffix) in (0..options.count).flat_map(|index| suffixes.iter().map(move |suffix| (index, suffix))) {
        let deadline_error = Error::Deadline { awaited_reply: "the next frame", ms: timeout.as_millis() as u64 };
        let result = tokio::time::timeout(timeout, frames.next()).await.map_err(|_| deadline_error)?;
        let frame = result.unwrap_or(Err(Error::StreamEnded { awaited_reply: "the last frame" }))?;
        write_file(&options.out.join(format!("frame_{index:05}{suffix}.{}", frame.format.extension())), &frame)?;
        summary.add(&received_reply(&frame));
        summary.add_frame_info(&frame);
        progress_bar.set_position(index + 1);
    }
    progress_bar.finish_and_clear();
    summary.print("frames", &options.out, None, as_json);
    Ok(())
}

/// Saves one frame per output, all of the same step.
pub(crate) async fn fetch_single(client: &Client, options: &SingleFrameOptions, as_json: bool) -> Result<()> {
    let scene = open_scene(client, &options.scene).await?;
    let request = FramesRequest::new(&scene, options.picture.pictures_for_file(&options.out));
    let request = request.step(options.step.selector()).deadline_ms(options.step.deadline_ms);
    let mut summary = Summary::new();
    for (frame, suffix) in client.render_frames(&request).await?.iter().zip(options.picture.file_suffixes()) {
        write_file(&output_path(&options.out, &suffix, frame.format), frame)?;
        summary.add(&received_reply(frame));
        summary.add_frame_info(frame);
    }
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

/// The file of one of several frames: `tree.png` becomes `tree_depth.f32`. A single frame, which has no suffix, keeps
/// the path.
fn output_path(out: &Path, suffix: &str, format: FrameFormat) -> PathBuf {
    if suffix.is_empty() {
        return out.to_owned();
    }
    let stem = out.file_stem().unwrap_or_default().to_string_lossy();
    out.with_file_name(format!("{stem}{suffix}.{}", format.extension()))
}

fn write_file(path: &Path, frame: &Frame) -> Result<()> {
    std::fs::write(path, &frame.bytes).map_err(|error| Error::file(path, error))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_paths_of_several_frames_name_the_output() {
        let path = |suffix| output_path(Path::new("out/tree.png"), suffix, FrameFormat::F32);
        assert_eq!((path(""), path("_depth")), (PathBuf::from("out/tree.png"), PathBuf::from("out/tree_depth.f32")));
    }
}
