//! The wire contract of modalcast, generated from `modalcast/v1/*.proto`. `tests/generated.rs` writes the code.
//! `websocket.md` specifies the WebSocket that carries the same messages for browsers.

#![allow(clippy::all, clippy::pedantic, reason = "generated code")]

/// Package `modalcast.v1`.
pub mod v1 {
    include!("generated/modalcast.v1.rs");

    /// Encoded file descriptors, for the reflection service.
    pub const DESCRIPTORS: &[u8] = include_bytes!("generated/descriptors.bin");

    /// `GetServerInfoResponse.protocol_version` of this contract. Increase it with every change after which a client of
    /// the previous contract no longer works.
    pub const PROTOCOL_VERSION: u32 = 2;
}
