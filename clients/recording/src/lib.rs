#![doc = include_str!("../README.md")]
#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

mod error;
mod export;
mod format;
mod mcap_records;
mod reader;
mod record;
mod recover;
mod replay;
mod states;
mod step_source;
mod steps;
mod timeline;
mod writer;

pub use error::{Error, Result};
pub use export::{VideoEncoder, VideoSettings, export_gltf, export_html, export_npz};
pub use format::{PROFILE, Topic, VERSION};
pub use reader::{ContentItem, Messages, RecordedMessage, Recording};
pub use record::{RecordRequest, Recorded, record};
pub use recover::{Recovered, recover};
pub use replay::{OpenedScene, ReplayRequest, Replayed, ReplayedFrame, open_recorded_scene, replay};
pub use states::{RecordedState, RecordedStates};
pub use step_source::TimeRange;
pub use steps::{StepConverter, StepTarget};
pub use writer::{MetadataEntry, RecordingWriter, WriteSummary};
