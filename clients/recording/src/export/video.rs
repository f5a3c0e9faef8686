//! Encodes frames as a video with an installed ffmpeg.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use crate::error::{Error, Result};

/// Size and rate of a video.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VideoSettings {
    pub width: u32,
    pub height: u32,
    pub frames_per_second: f64,
}

/// An ffmpeg process that receives RGBA frames. The extension of the file selects the format of the video.
pub struct VideoEncoder {
    process: Child,
    out: PathBuf,
    frame_bytes: u64,
}

impl VideoEncoder {
    /// Starts `program`, which is `ffmpeg` or a path of it.
    ///
    /// # Errors
    /// `Unavailable` if the program cannot be started.
    pub fn start(program: &Path, settings: VideoSettings, out: &Path) -> Result<Self> {
        let VideoSettings { width, height, frames_per_second } = settings;
        let process = Command::new(program)
            .args(["-y", "-loglevel", "error", "-f", "rawvideo", "-pix_fmt", "rgba"])
            .args(["-video_size", &format!("{width}x{height}"), "-framerate", &frames_per_second.to_string()])
            // The usual color format of videos needs even sides.
            .args(["-i", "-", "-vf", "pad=ceil(iw/2)*2:ceil(ih/2)*2", "-pix_fmt", "yuv420p"])
            .arg(out)
            .stdin(Stdio::piped())
            .stdout(Stdio::null())
            .spawn()
            .map_err(|error| Error::Unavailable {
                what: "ffmpeg".to_owned(),
                reason: format!("{} cannot be started: {error}", program.display()),
                remedy: "Install it, for example with: sudo apt-get install ffmpeg".to_owned(),
            })?;
        let frame_bytes = 4 * u64::from(width) * u64::from(height);
        Ok(Self { process, out: out.to_owned(), frame_bytes })
    }

    /// Adds a frame of RGBA pixels, top row first.
    ///
    /// # Errors
    /// `Invalid` if the frame has another size; `File` if ffmpeg has ended.
    pub fn add(&mut self, pixels: &[u8]) -> Result<()> {
        if pixels.len() as u64 != self.frame_bytes {
            return Err(Error::invalid("frame", format!("{} bytes", self.frame_bytes), pixels.len()));
        }
        let Some(input) = &mut self.process.stdin else { return Err(Error::file(&self.out, "ffmpeg has no input")) };
        input.write_all(pixels).map_err(|error| Error::file(&self.out, format!("ffmpeg: {error}")))
    }

    /// Waits until the file is complete.
    ///
    /// # Errors
    /// `File` if ffmpeg has failed. It prints the reason on standard error.
    pub fn finish(mut self) -> Result<()> {
        drop(self.process.stdin.take());
        let status = self.process.wait().map_err(|error| Error::file(&self.out, error))?;
        match status.success() {
            true => Ok(()),
            false => Err(Error::file(&self.out, format!("ffmpeg ended with {status}"))),
        }
    }
}

impl Drop for VideoEncoder {
    fn drop(&mut self) {
        // Both calls fail if the process has ended, as after `finish`.
        self.process.kill().ok();
        self.process.wait().ok();
    }
}
