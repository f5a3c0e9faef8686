//! Roles of principals.

use serde::Deserialize;

/// What a principal may do. Each role includes the roles before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Role {
    /// Grants nothing: a connection that carries the calls of others, each with its own token.
    Proxy,
    /// Lists scenes and receives pictures.
    Pixels,
    /// Receives geometry: descriptions, vertices, states and picked points.
    View,
    /// Applies forces.
    Interact,
    /// Opens scenes of the server's folder, drives, resets and deletes scenes.
    Drive,
    /// Uploads scenes.
    Upload,
    /// Administers the scenes and the clients of all principals.
    Admin,
}

impl Role {
    pub const ALL: [Self; 7] =
        [Self::Proxy, Self::Pixels, Self::View, Self::Interact, Self::Drive, Self::Upload, Self::Admin];

    /// The name in the file of principals.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Proxy => "proxy",
            Self::Pixels => "pixels",
            Self::View => "view",
            Self::Interact => "interact",
            Self::Drive => "drive",
            Self::Upload => "upload",
            Self::Admin => "admin",
        }
    }
}
