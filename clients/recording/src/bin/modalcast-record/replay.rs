//! `modalcast replay`.

use std::path::PathBuf;

use clap::Args;
use modalcast_client::program::PictureOptions;
use modalcast_recording::{
    OpenedScene, Recording, ReplayRequest, Replayed, ReplayedFrame, Result, StepTarget, TimeRange, open_recorded_scene,
    replay,
};

use crate::frame_folder::FrameFolder;
use crate::options::{ServerOptions, parse_seconds, termination_signal};

/// Drives a scene of a server with a recording, until its end or Ctrl-C.
///
/// Opens the recorded source. Frames of the replay are then equal to those of the recorded run on the same machine and
/// driver, bit for bit. If the server does not have the source, or has it with other contents, the recorded meshes and
/// modes are uploaded, and the look differs.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  modalcast replay tree.mcap
  modalcast replay tree.mcap --speed 0.25 --loop --from 2 --to 5
  modalcast replay tree.mcap --fast --frames out --size 640x360")]
pub(crate) struct ReplayOptions {
    /// Recording to replay.
    file: PathBuf,
    #[command(flatten)]
    server: ServerOptions,
    /// Name of the scene on the server. Default: the recorded name.
    #[arg(long, default_value = "")]
    scene: String,
    /// Speed: seconds of the recording per second of real time.
    #[arg(long, default_value_t = 1.0)]
    speed: f64,
    /// Send steps as fast as the server accepts them.
    #[arg(long, conflicts_with = "speed")]
    fast: bool,
    /// Begin again at the end.
    #[arg(long = "loop")]
    repeats: bool,
    /// Time of the first state, in seconds since the beginning of the recording.
    #[arg(long, default_value_t = 0.0, value_parser = parse_seconds)]
    from: f64,
    /// Time of the last state, in seconds since the beginning of the recording. Default: the end.
    #[arg(long, value_parser = parse_seconds)]
    to: Option<f64>,
    /// Save the frames of every step in this folder.
    #[arg(long, value_name = "DIR")]
    frames: Option<PathBuf>,
    #[command(flatten)]
    picture: PictureOptions,
}

impl ReplayOptions {
    pub(crate) async fn run(self) -> Result<()> {
        let recording = Recording::open(&self.file)?;
        let client = self.server.connect().await?;
        let scene = open_recorded_scene(&client, &recording, &self.scene).await?;
        print_difference(&scene);
        let to = self.to.map_or(TimeRange::ALL.to, nanoseconds);
        let request = ReplayRequest {
            range: TimeRange { from: nanoseconds(self.from), to },
            speed: (!self.fast).then_some(self.speed),
            repeats: self.repeats,
            pictures: if self.frames.is_some() { self.picture.pictures() } else { Vec::new() },
            frame_rate: None,
        };
        let folder = self.frames.as_ref().map(|folder| FrameFolder::create(folder, &self.picture)).transpose()?;
        let on_frame =
            |frame: ReplayedFrame| folder.as_ref().map_or(Ok(()), |folder| folder.save(frame.step_index, &frame));
        let replayed = replay(&client, &recording, &scene, &request, on_frame, termination_signal()?).await?;
        print_summary(&scene, &replayed);
        Ok(())
    }
}

/// Says how an uploaded scene differs from the recorded one.
pub(crate) fn print_difference(scene: &OpenedScene) {
    if scene.target == StepTarget::UploadedArrays {
        eprintln!(
            "modalcast: the server does not have the recorded scene, so its meshes and modes were uploaded as '{}'. They \
             have one diffuse color per domain. Textures, hard edges, lights, ground and the rest of the look are the \
             defaults, so frames differ from those of the recorded run.",
            scene.info.scene
        );
    }
}

fn print_summary(scene: &OpenedScene, replayed: &Replayed) {
    let seconds = replayed.duration.as_secs_f64();
    let rate = if seconds > 0.0 { replayed.steps as f64 / seconds } else { 0.0 };
    println!(
        "{}: {} steps in {seconds:.3} s, {rate:.1} steps/s, run {}",
        scene.info.scene, replayed.steps, replayed.run
    );
}

/// The argument is between 0 and 10^6 seconds.
fn nanoseconds(seconds: f64) -> u64 {
    (seconds * 1e9).round() as u64
}
