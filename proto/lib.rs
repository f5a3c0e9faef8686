//! The wire contract of modalcast, generated from `modalcast/v1/*.proto`.

#![allow(clippy::all, clippy::pedantic, reason = "generated code")]

/// Package `modalcast.v1`.
pub mod v1 {
    tonic::include_proto!("modalcast.v1");

    /// Encoded file descriptors, for the reflection service.
    pub const DESCRIPTORS: &[u8] = include_bytes!(concat!(env!("OUT_DIR"), "/descriptors.bin"));
}
