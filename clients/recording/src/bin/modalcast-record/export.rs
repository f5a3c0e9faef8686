//! `modalcast export`.

use std::io::Read as _;
use std::path::PathBuf;

use clap::{Args, ValueEnum};
use flate2::read::GzDecoder;
use modalcast_client::program::PictureOptions;
use modalcast_client::{FrameFormat, Output, Picture};
use modalcast_recording::{
    Error, Recording, ReplayRequest, ReplayedFrame, Result, StepTarget, VideoEncoder, VideoSettings, export_gltf,
    export_html, export_npz, open_recorded_scene, replay,
};

use crate::frame_folder::FrameFolder;
use crate::options::{ServerOptions, parse_slow, termination_signal};
use crate::replay::print_difference;

/// The page of the viewer, compressed with gzip.
const VIEWER: &[u8] = include_bytes!("../../../../web/dist/index.html.gz");

/// The first bytes of a file that is compressed with gzip.
const GZIP_MAGIC: [u8; 2] = [0x1f, 0x8b];

/// Limit on the size of a page in bytes.
const MAX_PAGE_BYTES: u64 = 64 << 20;

/// Converts a recording to another format.
///
/// html: a web page that plays the recording without a server. gltf: a .glb file with a morph target per mode and an
/// animation of q and T; transforms with shear are rejected. npz: NumPy arrays of q, T, times, x0, faces and U. png: a
/// folder of frames, which a server renders. video: an MP4 or WebM file, which a server renders and an installed ffmpeg
/// encodes.
#[derive(Debug, Args)]
#[command(after_help = "Examples:
  modalcast export tree.mcap --to html --out tree.html
  modalcast export tree.mcap --to gltf --out tree.glb
  modalcast export tree.mcap --to npz --out tree.npz
  modalcast export tree.mcap --to png --out frames --size 640x360 --fps 24
  modalcast export tree.mcap --to video --out tree.mp4
  modalcast export fork.mcap --to video --slow 100 --out fork.mp4")]
pub(crate) struct ExportOptions {
    /// Recording to convert.
    file: PathBuf,
    /// Format to convert to.
    #[arg(long, value_enum)]
    to: ExportFormat,
    /// File to write, or folder for `--to png`.
    #[arg(long)]
    out: PathBuf,
    /// Page for `--to html`. Default: the viewer of this build.
    #[arg(long, value_name = "FILE")]
    page: Option<PathBuf>,
    #[command(flatten)]
    server: ServerOptions,
    /// Name of the scene on the server, for `--to png` and `--to video`. Default: the recorded name.
    #[arg(long, default_value = "")]
    scene: String,
    /// Frames per second, 0.001 to 1000. Default: 30 for `--to video`, and every state for `--to png`.
    #[arg(long, value_parser = parse_rate)]
    fps: Option<f64>,
    /// Slow motion: a second of the recording lasts FACTOR seconds in the video, in the frames of --fps, in the animation
    /// of glTF, and in the page until another speed is selected.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = parse_slow)]
    slow: f64,
    /// Path of ffmpeg, for `--to video`.
    #[arg(long, value_name = "PATH", default_value = "ffmpeg")]
    ffmpeg: PathBuf,
    #[command(flatten)]
    picture: PictureOptions,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum ExportFormat {
    Html,
    Gltf,
    Npz,
    Png,
    Video,
}

impl ExportOptions {
    pub(crate) async fn run(self) -> Result<()> {
        self.check_slow()?;
        let recording = Recording::open(&self.file)?;
        match self.to {
            ExportFormat::Html => export_html(&recording, &self.read_page()?, self.slow, &self.out)?,
            ExportFormat::Gltf => export_gltf(&recording, self.slow, &self.out)?,
            ExportFormat::Npz => export_npz(&recording, &self.out)?,
            ExportFormat::Png => self.export_frames(&recording).await?,
            ExportFormat::Video => self.export_video(&recording).await?,
        }
        println!("{}", self.out.display());
        Ok(())
    }

    /// Checks that the format has times that `--slow` can change.
    fn check_slow(&self) -> Result<()> {
        let expected = match self.to {
            ExportFormat::Npz => "1 with --to npz, whose times are those of the simulation",
            ExportFormat::Png if self.fps.is_none() => "1, or --fps, with --to png",
            _ => return Ok(()),
        };
        match self.slow {
            1.0 => Ok(()),
            slow => Err(Error::Invalid { field: "--slow".into(), expected: expected.into(), given: slow.to_string() }),
        }
    }

    /// The page of `--page`, which may be compressed with gzip, or the viewer of this build.
    fn read_page(&self) -> Result<String> {
        let read = || {
            let bytes = match &self.page {
                Some(path) => std::fs::read(path)?,
                None => VIEWER.to_vec(),
            };
            let mut page = String::new();
            match bytes.starts_with(&GZIP_MAGIC) {
                true => GzDecoder::new(&bytes[..]).take(MAX_PAGE_BYTES).read_to_string(&mut page)?,
                false => (&bytes[..]).take(MAX_PAGE_BYTES).read_to_string(&mut page)?,
            };
            Ok(page)
        };
        let path = self.page.as_ref().map_or_else(|| "viewer".to_owned(), |path| path.display().to_string());
        read().map_err(|error: std::io::Error| Error::File { path, reason: error.to_string() })
    }

    async fn export_frames(&self, recording: &Recording) -> Result<()> {
        let folder = FrameFolder::create(&self.out, &self.picture)?;
        let mut indices = FrameIndices::default();
        let on_frame = |frame: ReplayedFrame| folder.save(indices.first_of(&frame), &frame);
        self.render(recording, self.picture.pictures(), self.fps, on_frame).await
    }

    async fn export_video(&self, recording: &Recording) -> Result<()> {
        let frames_per_second = self.fps.unwrap_or(30.0);
        let picture = match self.picture.pictures()[..] {
            [
                picture @ Picture {
                    output: Output::Color | Output::Displacement { .. } | Output::ModeShape { .. }, ..
                },
            ] => picture.format(FrameFormat::Rgba),
            _ => {
                let (field, expected) = ("--output".to_owned(), "one picture in color".to_owned());
                return Err(Error::Invalid { field, expected, given: "several or other outputs".to_owned() });
            }
        };
        let settings = VideoSettings { width: picture.width, height: picture.height, frames_per_second };
        let mut encoder = VideoEncoder::start(&self.ffmpeg, settings, &self.out)?;
        let on_frame =
            |replayed: ReplayedFrame| (0..replayed.repeats).try_for_each(|_| encoder.add(&replayed.frame.bytes));
        self.render(recording, vec![picture], Some(frames_per_second), on_frame).await?;
        encoder.finish()
    }

    /// Replays the recording as fast as possible and passes all frames to `on_frame`. `frame_rate` is in frames per second
    /// of the result.
    async fn render(
        &self,
        recording: &Recording,
        pictures: Vec<Picture>,
        frame_rate: Option<f64>,
        on_frame: impl FnMut(ReplayedFrame) -> Result<()>,
    ) -> Result<()> {
        let client = self.server.connect().await?;
        let scene = open_recorded_scene(&client, recording, &self.scene).await?;
        print_difference(&scene);
        let frame_rate = frame_rate.map(|rate| rate * self.slow);
        let request = ReplayRequest { speed: None, pictures, frame_rate, ..ReplayRequest::default() };
        let replayed = replay(&client, recording, &scene, &request, on_frame, termination_signal()?).await;
        if scene.target == StepTarget::UploadedArrays {
            client.delete_scene(&scene.info.scene).await?;
        }
        replayed.map(drop)
    }
}

/// Numbers frames. A state may be shown by several frames.
#[derive(Default)]
struct FrameIndices {
    /// Index of the last step.
    step_index: u64,
    /// Index of the first frame of the last step.
    first: u64,
    /// Index of the first frame of the next step.
    next: u64,
}

impl FrameIndices {
    /// The index of the first frame that shows a state. All pictures of a step have the same index.
    fn first_of(&mut self, replayed: &ReplayedFrame) -> u64 {
        if replayed.step_index != self.step_index || self.next == 0 {
            (self.step_index, self.first) = (replayed.step_index, self.next);
            self.next += replayed.repeats;
        }
        self.first
    }
}

fn parse_rate(text: &str) -> std::result::Result<f64, String> {
    let rate = text.parse().ok().filter(|rate| (1e-3..=1e3).contains(rate));
    rate.ok_or_else(|| "expected frames per second, 0.001 to 1000".into())
}
