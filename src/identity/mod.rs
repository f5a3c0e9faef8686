//! Who may do what: principals, their credentials and their roles.
//!
//! # Threat model
//! Trusted are the user of the server, root, and users of the GPU device, who can read its memory. Not trusted are other
//! accounts of the machine, web pages, the network, and other principals of the server beyond their roles.

mod certificate_name;
mod directory;
mod file_version;
mod principal;
mod principals_file;
mod role;
mod token;
mod viewer_sessions;

pub use certificate_name::CertificateName;
pub use directory::Directory;
pub use file_version::{FileVersion, REFRESH_INTERVAL};
pub use principal::{ANONYMOUS, Credential, OWNER, Principal};
pub use principals_file::check_principal_name;
pub use role::Role;
pub use token::{TokenHash, new_token};
pub use viewer_sessions::ViewerSessions;
