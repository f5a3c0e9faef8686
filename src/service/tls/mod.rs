//! TLS of the TCP sockets: handshakes, and a certificate that is read again when its files change.

mod certificate;
mod files;
mod plain_client;
mod self_signed;
mod socket;

use std::collections::BTreeSet;
use std::io;
use std::net::IpAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};

use tokio::net::TcpStream;
use tokio_rustls::TlsAcceptor;

pub(super) use self::socket::TlsSocket;

use self::certificate::{fingerprint, host_names};
use self::files::TlsFiles;
use crate::config::{Config, ServerCertificate, TlsSettings};
use crate::engine::lock;
use crate::identity::{FileVersion, REFRESH_INTERVAL};
use modalcast_model::error::Result;

/// The protocols of connections (RFC 7301), in the order of preference. Browsers offer both, and the viewer needs
/// HTTP/1.1. Clients of gRPC offer `h2` only.
const PROTOCOLS: &[&str] = &["http/1.1", "h2"];

/// The protocol of a server without the viewer.
const PROTOCOLS_WITHOUT_VIEWER: &[&str] = &["h2"];

/// Makes TLS connections of TCP connections.
#[derive(Debug)]
pub(super) struct TlsServer {
    files: TlsFiles,
    is_self_signed: bool,
    protocols: &'static [&'static str],
    state: Mutex<TlsState>,
}

#[derive(Debug)]
struct TlsState {
    endpoint: TlsEndpoint,
    /// Versions of the files of `endpoint`, or of later ones that are invalid.
    versions: Vec<Option<FileVersion>>,
}

/// The settings of new connections.
#[derive(Clone)]
struct TlsEndpoint {
    acceptor: TlsAcceptor,
    /// The names of the certificate.
    host_names: Arc<[String]>,
    fingerprint: Arc<str>,
}

impl std::fmt::Debug for TlsEndpoint {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        out.debug_struct("TlsEndpoint").field("host_names", &self.host_names).finish_non_exhaustive()
    }
}

impl TlsEndpoint {
    fn read(files: &TlsFiles, protocols: &[&str]) -> Result<Self> {
        let (config, certificate) = files.read(protocols)?;
        Ok(Self {
            acceptor: TlsAcceptor::from(Arc::new(config)),
            host_names: host_names(&certificate).into(),
            fingerprint: fingerprint(&certificate).into(),
        })
    }
}

impl TlsServer {
    /// Reads the files of the settings. Makes a self-signed certificate in the folder of the state, with the names of the
    /// settings and `own_names`.
    ///
    /// # Errors
    /// `InvalidFile` for a certificate or key that cannot be used, also for a key that other users can read; `Invalid` and
    /// `Unavailable` for a self-signed certificate that cannot be made.
    pub(super) fn open(settings: &TlsSettings, config: &Config, own_names: BTreeSet<String>) -> Result<Arc<Self>> {
        let (files, is_self_signed) = match &settings.certificate {
            ServerCertificate::Files { certificate, key } => {
                let (certificate, key) = (certificate.clone(), key.clone());
                (TlsFiles { certificate, key, client_ca: None }, false)
            }
            ServerCertificate::SelfSigned { names } => {
                let names = own_names.into_iter().chain(names.iter().map(|name| canonical_name(name))).collect();
                (self_signed::read_or_create(&config.state, &names)?, true)
            }
        };
        let files = TlsFiles { client_ca: settings.client_ca.clone(), ..files };
        let versions = versions(&files);
        let protocols = if config.viewer { PROTOCOLS } else { PROTOCOLS_WITHOUT_VIEWER };
        let endpoint = TlsEndpoint::read(&files, protocols)?;
        tracing::info!(sha256 = %endpoint.fingerprint, "certificate: {}", files.certificate.display());
        let state = Mutex::new(TlsState { endpoint, versions });
        Ok(Arc::new(Self { files, is_self_signed, protocols, state }))
    }

    /// The file and the SHA-256 of a self-signed certificate, by which clients can trust it. `None` for another one.
    pub(super) fn self_signed_certificate(&self) -> Option<(&Path, Arc<str>)> {
        let fingerprint = || Arc::clone(&lock(&self.state).endpoint.fingerprint);
        self.is_self_signed.then(|| (self.files.certificate.as_path(), fingerprint()))
    }

    /// Makes a TLS connection. Answers clients that do not speak TLS with an error in HTTP/1.1.
    ///
    /// # Errors
    /// An I/O error with the reason, also for an invalid certificate of the client, and for clients without TLS.
    pub(super) async fn accept(&self, stream: TcpStream) -> io::Result<TlsSocket> {
        if plain_client::is_plain(&stream).await? {
            plain_client::answer(stream).await?;
            return Err(io::Error::new(io::ErrorKind::InvalidData, "expected TLS, got a plain connection"));
        }
        let TlsEndpoint { acceptor, host_names, .. } = lock(&self.state).endpoint.clone();
        Ok(TlsSocket::new(acceptor.accept(stream).await?, host_names))
    }

    /// Keeps the certificate up to date until this future is dropped.
    pub(super) async fn keep_fresh(&self) {
        let mut interval = tokio::time::interval(REFRESH_INTERVAL);
        loop {
            interval.tick().await;
            self.refresh();
        }
    }

    /// Reads the files again if one has changed. New connections use the new certificate, and open ones continue. Invalid
    /// files, also a certificate without its key while the two are replaced, are logged and change nothing.
    fn refresh(&self) {
        let versions = versions(&self.files);
        if versions == lock(&self.state).versions {
            return;
        }
        let endpoint = TlsEndpoint::read(&self.files, self.protocols);
        let mut state = lock(&self.state);
        state.versions = versions;
        match endpoint {
            Ok(endpoint) => {
                tracing::info!(sha256 = %endpoint.fingerprint, "the certificate was read again");
                state.endpoint = endpoint;
            }
            Err(error) => tracing::error!(%error, "the changed certificate is not used"),
        }
    }
}

/// An IP address as certificates show it, or another name unchanged.
fn canonical_name(name: &str) -> String {
    name.parse::<IpAddr>().map_or_else(|_| name.to_owned(), |address| address.to_string())
}

fn versions(files: &TlsFiles) -> Vec<Option<FileVersion>> {
    files.paths().map(FileVersion::of).collect()
}
