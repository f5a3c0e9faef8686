//! The state folder: the catalog of open scenes, the checkpoints of their steps, the counter of runs, the crash log, and
//! uploaded files. A change is durable before it is acknowledged: files are synced, then renamed, then their folder is synced.

pub(super) mod array_upload;
pub(super) mod checkpoint_store;
pub(super) mod crash_log;
#[cfg(test)]
mod crash_tests;
pub(super) mod file_system;
pub(super) mod provenance;
mod recovery;
pub(super) mod run_counter;
pub(super) mod scene_catalog;
pub(super) mod scene_record;
pub(super) mod upload;
mod upload_folder;
pub(super) mod upload_record;
