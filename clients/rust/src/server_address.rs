//! Finds the way to a server: its address, and the credential for it.

use std::net::IpAddr;
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};

use tonic::codegen::http::{HeaderValue, Uri};

use crate::error::{Error, Result};

/// The environment variable with the path of a file that contains a token.
const TOKEN_FILE_VARIABLE: &str = "MODALCAST_TOKEN_FILE";

/// Port of a server, unless its address has another one.
const DEFAULT_PORT: u16 = 50051;

/// How a client connects.
#[derive(Clone, Default)]
pub struct ConnectOptions {
    token: Option<String>,
}

impl ConnectOptions {
    /// Sends a token with every call. It is readable on the network unless the connection is encrypted or stays on this
    /// machine.
    #[must_use]
    pub fn with_token(self, token: impl Into<String>) -> Self {
        Self { token: Some(token.into()) }
    }
}

/// The token is a secret.
impl std::fmt::Debug for ConnectOptions {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_struct("ConnectOptions").field("has_token", &self.token.is_some()).finish()
    }
}

/// Where a server is, and the credential of its calls.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct ServerAddress {
    /// `http://HOST:PORT` or `unix:PATH`.
    pub(crate) url: String,
    pub(crate) authorization: Option<HeaderValue>,
}

impl ServerAddress {
    /// The address for a URL: `http://HOST:PORT`, `HOST:PORT` or `unix:PATH`. Without a token, a server on this machine
    /// is reached at its Unix socket, where the user of this process is its own credential.
    ///
    /// # Errors
    /// `Connect` when the token is malformed or its file cannot be read.
    pub(crate) fn find(url: &str, options: &ConnectOptions) -> Result<Self> {
        let connect_error = |reason: String| Error::Connect { url: url.to_owned(), reason };
        let has_scheme = url.contains("://") || url.starts_with("unix:");
        let url_with_scheme = if has_scheme { url.to_owned() } else { format!("http://{url}") };
        let token = match &options.token {
            Some(token) => Some(token.clone()),
            None if url.starts_with("unix:") => None,
            None => match std::env::var_os(TOKEN_FILE_VARIABLE).filter(|path| !path.is_empty()) {
                Some(path) => Some(read_token(Path::new(&path)).map_err(connect_error)?),
                None => None,
            },
        };
        let Some(token) = token else {
            let socket = local_port(&url_with_scheme).and_then(|port| find_socket(&local_sockets()?, port));
            let url = socket.map_or(url_with_scheme, |path| format!("unix:{}", path.display()));
            return Ok(Self { url, authorization: None });
        };
        let mut authorization = HeaderValue::try_from(format!("Bearer {}", token.trim()))
            .map_err(|_| connect_error("expected a token of visible ASCII letters, got another text".into()))?;
        authorization.set_sensitive(true);
        Ok(Self { url: url_with_scheme, authorization: Some(authorization) })
    }
}

fn read_token(path: &Path) -> Result<String, String> {
    std::fs::read_to_string(path).map_err(|error| format!("{TOKEN_FILE_VARIABLE}: {}: {error}", path.display()))
}

/// The port of a URL that leads to this machine.
fn local_port(url: &str) -> Option<u16> {
    let uri: Uri = url.parse().ok()?;
    let host = uri.host()?.trim_start_matches('[').trim_end_matches(']');
    let is_local = host.eq_ignore_ascii_case("localhost") || host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback());
    (is_local && uri.scheme_str() == Some("http")).then(|| uri.port_u16().unwrap_or(DEFAULT_PORT))
}

/// The folder of the sockets of this user's servers. The server uses the same rule.
fn local_sockets() -> Option<PathBuf> {
    let folder = |name: &str| std::env::var_os(name).filter(|path| !path.is_empty()).map(PathBuf::from);
    match folder("XDG_RUNTIME_DIR") {
        Some(runtime) => Some(runtime.join("modalcast")),
        None => {
            let state = folder("XDG_STATE_HOME").or_else(|| Some(folder("HOME")?.join(".local/state")))?;
            Some(state.join("modalcast").join("run"))
        }
    }
}

/// The socket of a running server of this user. Other users cannot create one in a folder of this user.
fn find_socket(folder: &Path, port: u16) -> Option<PathBuf> {
    let folder_metadata = std::fs::symlink_metadata(folder).ok()?;
    let path = folder.join(format!("{port}.sock"));
    let metadata = std::fs::symlink_metadata(&path).ok()?;
    let is_private = folder_metadata.is_dir() && folder_metadata.mode() & 0o022 == 0;
    let is_own = is_private && folder_metadata.uid() == metadata.uid() && metadata.file_type().is_socket();
    // A killed server leaves its socket.
    (is_own && std::os::unix::net::UnixStream::connect(&path).is_ok()).then_some(path)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    #[test]
    fn only_urls_of_this_machine_have_a_local_port() {
        for (url, port) in [
            ("http://127.0.0.1:50051", Some(50051)),
            ("http://localhost:7", Some(7)),
            ("http://[::1]:7/", Some(7)),
            ("http://127.0.0.1", Some(DEFAULT_PORT)),
            ("https://127.0.0.1:7", None),
            ("http://192.0.2.1:50051", None),
            ("http://localhost.example:7", None),
            ("unix:/run/modalcast.sock", None),
        ] {
            assert_eq!(local_port(url), port, "{url}");
        }
    }

    #[test]
    fn socket_is_used_while_its_server_runs_in_a_private_folder() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let find = |port| find_socket(folder.path(), port);
        assert_eq!(find(7), None);
        let path = folder.path().join("7.sock");
        let listener = std::os::unix::net::UnixListener::bind(&path).expect("expected a socket");
        assert_eq!(find(7).as_deref(), Some(path.as_path()));
        assert_eq!(find(8), None);
        let set_mode = |mode| {
            std::fs::set_permissions(folder.path(), std::fs::Permissions::from_mode(mode))
                .expect("expected permissions");
        };
        set_mode(0o777);
        assert_eq!(find(7), None, "expected no socket that another user could have created");
        set_mode(0o700);
        drop(listener);
        assert_eq!(find(7), None, "expected no socket of a killed server");
    }

    #[test]
    fn token_is_sent_and_not_shown() {
        let options = ConnectOptions::default().with_token("secret");
        let address = ServerAddress::find("192.0.2.1:50051", &options).expect("expected an address");
        assert_eq!(address.url, "http://192.0.2.1:50051");
        assert_eq!(address.authorization.as_ref().map(HeaderValue::as_bytes), Some(&b"Bearer secret"[..]));
        assert!(!format!("{address:?} {options:?}").contains("secret"));
        assert!(ServerAddress::find("192.0.2.1:1", &ConnectOptions::default().with_token("a\nb")).is_err());
    }
}
