//! The state folder: the catalog of open scenes, the checkpoints of their steps, the counter of runs, and uploaded
//! files.

pub(super) mod array_upload;
mod atomic_file;
pub(super) mod checkpoint_store;
pub(super) mod run_counter;
pub(super) mod scene_catalog;
pub(super) mod upload;
mod upload_folder;
pub(super) mod uploaded_files;
