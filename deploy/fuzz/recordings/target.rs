//! The target of recordings: reads, repairs and exports a file with the content of the input. The fuzzer and
//! `clients/recording/tests/files.rs` run it.

#[path = "../temporary_folder.rs"]
mod temporary_folder;

use std::fs;

use modalcast_recording::{Error, Recording, Result, Topic, export_gltf, export_html, export_npz, recover};
use temporary_folder::temporary_folder;

/// A temporary folder for the recording and its exports.
pub(crate) struct RecordingTarget {
    folder: tempfile::TempDir,
}

impl RecordingTarget {
    /// # Panics
    /// If there is no writable folder.
    pub(crate) fn new() -> Self {
        Self { folder: temporary_folder() }
    }

    /// Uses the input in every way. An invalid file is an error, which has no effect here.
    ///
    /// # Panics
    /// If the file cannot be written, or the recording code panics.
    pub(crate) fn run(&self, input: &[u8]) {
        let [path, repaired, out] = ["in.mcap", "repaired.mcap", "out"].map(|name| self.folder.path().join(name));
        fs::write(&path, input).expect("expected a writable folder");
        if let Ok(recording) = Recording::open(&path) {
            read_all(&recording).ok();
            export_npz(&recording, &out).ok();
            export_gltf(&recording, 1.0, &out).ok();
            export_html(&recording, "<head></head>", 1.0, &out).ok();
        }
        if recover(&path, &repaired).is_ok() {
            let recording = Recording::open(&repaired);
            // The repaired file has an index. Its content may still be invalid.
            let is_cut_off = |error: &Error| error.to_string().contains("end of the file");
            assert!(!recording.is_err_and(|error| is_cut_off(&error)), "expected a file with an index");
        }
    }
}

/// Reads all messages, states and contents.
fn read_all(recording: &Recording) -> Result<()> {
    let mut messages = recording.messages(&Topic::ALL);
    while messages.next()?.is_some() {}
    for from in [0, recording.end_time() / 2] {
        let mut states = recording.states(from, u64::MAX)?;
        while states.next()?.is_some() {}
    }
    recording.read_contents(|_, _| Ok(()))
}
