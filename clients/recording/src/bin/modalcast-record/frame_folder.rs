//! Saves frames as `frame_00000.png` (or another extension). With several pictures per step, the name of the output is
//! part of the file name: `frame_00000_depth.f32`.

use std::path::{Path, PathBuf};

use modalcast_client::program::PictureOptions;
use modalcast_recording::{Error, ReplayedFrame, Result};

/// A folder of frames.
pub(crate) struct FrameFolder {
    folder: PathBuf,
    /// The end of the name of each picture's files.
    suffixes: Vec<String>,
}

impl FrameFolder {
    /// Creates the folder if it does not exist.
    pub(crate) fn create(folder: &Path, pictures: &PictureOptions) -> Result<Self> {
        std::fs::create_dir_all(folder).map_err(|error| file_error(folder, &error))?;
        Ok(Self { folder: folder.to_owned(), suffixes: pictures.file_suffixes() })
    }

    /// Saves a frame, once per repetition.
    pub(crate) fn save(&self, first_index: u64, replayed: &ReplayedFrame) -> Result<()> {
        let frame = &replayed.frame;
        let suffix = self.suffixes.get(frame.picture).map_or("", String::as_str);
        for index in first_index..first_index + replayed.repeats {
            let path = self.folder.join(format!("frame_{index:05}{suffix}.{}", frame.format.extension()));
            std::fs::write(&path, &frame.bytes).map_err(|error| file_error(&path, &error))?;
        }
        Ok(())
    }
}

fn file_error(path: &Path, error: &std::io::Error) -> Error {
    Error::File { path: path.display().to_string(), reason: error.to_string() }
}
