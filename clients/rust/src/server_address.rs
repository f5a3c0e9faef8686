//! Finds the way to a server: its address, and the credential for it.

use std::net::IpAddr;
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _};
use std::path::{Path, PathBuf};

use tonic::codegen::http::{HeaderMap, HeaderName, HeaderValue, Uri, header};
use tonic::transport::{Certificate, ClientTlsConfig, Identity};

use crate::error::{Error, Result};

/// The environment variable with the path of a file that contains a token.
pub const TOKEN_FILE_VARIABLE: &str = "MODALCAST_TOKEN_FILE";

/// The environment variable with the path of a file that contains the certificates of authorities.
const CA_FILE_VARIABLE: &str = "MODALCAST_CA_FILE";

/// Port of a server, unless its address has another one.
const DEFAULT_PORT: u16 = 50051;

/// How a client connects.
#[derive(Clone, Default)]
pub struct ConnectOptions {
    token: Option<String>,
    ca_file: Option<PathBuf>,
    client_certificate: Option<ClientCertificate>,
    metadata: Vec<(String, String)>,
}

/// The files of a client certificate.
#[derive(Debug, Clone)]
struct ClientCertificate {
    certificate: PathBuf,
    key: PathBuf,
}

impl ConnectOptions {
    /// Sends a token with every call. It is readable on the network unless the connection is encrypted or stays on this
    /// machine.
    #[must_use]
    pub fn with_token(self, token: impl Into<String>) -> Self {
        Self { token: Some(token.into()), ..self }
    }

    /// Accepts only servers with a certificate of an authority in a PEM file, for `https`. A self-signed certificate is its
    /// own authority. Without this option, the environment variable `MODALCAST_CA_FILE` names the file; without both, the
    /// authorities of the system are accepted.
    #[must_use]
    pub fn with_ca_file(self, path: impl Into<PathBuf>) -> Self {
        Self { ca_file: Some(path.into()), ..self }
    }

    /// Identifies the client by a certificate, for `https`. Both files are PEM.
    #[must_use]
    pub fn with_client_certificate(self, certificate: impl Into<PathBuf>, key: impl Into<PathBuf>) -> Self {
        let files = ClientCertificate { certificate: certificate.into(), key: key.into() };
        Self { client_certificate: Some(files), ..self }
    }

    /// Sends metadata with every call, for a proxy in front of the server.
    #[must_use]
    pub fn with_metadata(mut self, name: impl Into<String>, value: impl Into<String>) -> Self {
        self.metadata.push((name.into(), value.into()));
        self
    }
}

/// The token and the values of the metadata are secrets.
impl std::fmt::Debug for ConnectOptions {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let names: Vec<&String> = self.metadata.iter().map(|(name, _)| name).collect();
        out.debug_struct("ConnectOptions")
            .field("has_token", &self.token.is_some())
            .field("ca_file", &self.ca_file)
            .field("client_certificate", &self.client_certificate)
            .field("metadata", &names)
            .finish()
    }
}

/// Where a server is, and what its calls and connections need.
#[derive(Debug, Clone)]
pub(crate) struct ServerAddress {
    /// `http://HOST:PORT`, `https://HOST:PORT` or `unix:PATH`.
    pub(crate) url: String,
    /// Sent with every call.
    pub(crate) metadata: HeaderMap,
    /// `None` without encryption.
    pub(crate) tls: Option<ClientTlsConfig>,
}

impl ServerAddress {
    /// The address for a URL: `http://HOST:PORT`, `https://HOST:PORT`, `HOST:PORT` (plain) or `unix:PATH`. Without a token,
    /// a plain server on this machine is reached at its Unix socket, where the user of this process is its own credential.
    ///
    /// # Errors
    /// `Connect` when an option is malformed, a file cannot be read, or files of certificates are given without `https`.
    pub(crate) fn find(url: &str, options: &ConnectOptions) -> Result<Self> {
        let connect_error = |reason: String| Error::Connect { url: url.to_owned(), reason };
        let has_scheme = url.contains("://") || url.starts_with("unix:");
        let url_with_scheme = if has_scheme { url.to_owned() } else { format!("http://{url}") };
        let tls = find_tls(&url_with_scheme, options).map_err(connect_error)?;
        let mut metadata = metadata_of(options).map_err(connect_error)?;
        let token = match &options.token {
            Some(token) => Some(token.clone()),
            None if url.starts_with("unix:") => None,
            None => match environment_path(TOKEN_FILE_VARIABLE) {
                Some(path) => Some(read_text(TOKEN_FILE_VARIABLE, &path).map_err(connect_error)?),
                None => None,
            },
        };
        let Some(token) = token else {
            let socket = local_port(&url_with_scheme).and_then(|port| find_socket(&local_sockets()?, port));
            let url = socket.map_or(url_with_scheme, |path| format!("unix:{}", path.display()));
            return Ok(Self { url, metadata, tls });
        };
        let mut authorization = HeaderValue::try_from(format!("Bearer {}", token.trim()))
            .map_err(|_| connect_error("expected a token of visible ASCII letters, got another text".into()))?;
        authorization.set_sensitive(true);
        metadata.insert(header::AUTHORIZATION, authorization);
        Ok(Self { url: url_with_scheme, metadata, tls })
    }
}

/// The encryption of a URL with the scheme `https`. `None` for another scheme.
fn find_tls(url: &str, options: &ConnectOptions) -> Result<Option<ClientTlsConfig>, String> {
    let uri: Option<Uri> = url.parse().ok();
    let Some(uri) = uri.filter(|uri| uri.scheme_str() == Some("https")) else {
        let needs_tls = options.ca_file.is_some() || options.client_certificate.is_some();
        return if needs_tls { Err("expected https:// with certificates, got another URL".into()) } else { Ok(None) };
    };
    let host = uri.host().unwrap_or_default().trim_start_matches('[').trim_end_matches(']');
    let mut tls = ClientTlsConfig::new().domain_name(host);
    let ca_file = options.ca_file.clone().map(|path| ("CA file", path));
    tls = match ca_file.or_else(|| Some((CA_FILE_VARIABLE, environment_path(CA_FILE_VARIABLE)?))) {
        Some((name, path)) => tls.ca_certificate(Certificate::from_pem(read_text(name, &path)?)),
        None => tls.with_native_roots(),
    };
    if let Some(ClientCertificate { certificate, key }) = &options.client_certificate {
        let (certificate, key) = (read_text("client certificate", certificate)?, read_text("key", key)?);
        tls = tls.identity(Identity::from_pem(certificate, key));
    }
    Ok(Some(tls))
}

fn metadata_of(options: &ConnectOptions) -> Result<HeaderMap, String> {
    let mut metadata = HeaderMap::new();
    for (name, value) in &options.metadata {
        let invalid =
            || format!("metadata '{name}': expected a name of lower-case letters and a value of ASCII letters");
        let header_name = HeaderName::from_lowercase(name.as_bytes()).map_err(|_| invalid())?;
        let mut value = HeaderValue::try_from(value).map_err(|_| invalid())?;
        value.set_sensitive(true);
        metadata.append(header_name, value);
    }
    Ok(metadata)
}

fn environment_path(variable: &str) -> Option<PathBuf> {
    std::env::var_os(variable).filter(|path| !path.is_empty()).map(PathBuf::from)
}

/// `name` is that of the file in errors.
fn read_text(name: &str, path: &Path) -> Result<String, String> {
    std::fs::read_to_string(path).map_err(|error| format!("{name}: {}: {error}", path.display()))
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
    let folder = environment_path;
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
        let authorization = address.metadata.get(header::AUTHORIZATION);
        assert_eq!(authorization.map(HeaderValue::as_bytes), Some(&b"Bearer secret"[..]));
        assert!(!format!("{address:?} {options:?}").contains("secret"));
        assert!(ServerAddress::find("192.0.2.1:1", &ConnectOptions::default().with_token("a\nb")).is_err());
    }

    #[test]
    fn metadata_are_sent_and_their_values_not_shown() {
        let options = ConnectOptions::default().with_metadata("x-scene", "secret").with_token("abc");
        let address = ServerAddress::find("192.0.2.1:50051", &options).expect("expected an address");
        assert_eq!(address.metadata["x-scene"].as_bytes(), b"secret");
        assert_eq!(address.metadata.len(), 2);
        assert!(!format!("{address:?} {options:?}").contains("secret"));
        for (name, value) in [("X-Scene", "a"), ("", "a"), ("x scene", "a"), ("x-scene", "a\n")] {
            let options = ConnectOptions::default().with_metadata(name, value);
            assert!(ServerAddress::find("192.0.2.1:1", &options).is_err(), "{name}: {value}");
        }
    }

    #[test]
    fn certificates_need_https() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("ca.pem");
        let options = ConnectOptions::default().with_ca_file(&path);
        let find = |url: &str| ServerAddress::find(url, &options).map(|address| address.tls.is_some());
        let error = find("https://192.0.2.1:1").expect_err("expected an error without the file").to_string();
        assert!(error.contains("ca.pem"), "{error}");
        std::fs::write(&path, "").expect("expected a writable folder");
        assert!(matches!(find("https://192.0.2.1:1"), Ok(true)));
        for url in ["http://192.0.2.1:1", "192.0.2.1:1", "unix:/run/modalcast.sock"] {
            let error = find(url).expect_err(url).to_string();
            assert!(error.contains("expected https://"), "{error}");
        }
        let plain = ServerAddress::find("192.0.2.1:1", &ConnectOptions::default().with_token("abc"));
        assert!(plain.expect("expected an address").tls.is_none());
    }
}
