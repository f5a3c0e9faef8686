//! Reads certificates and keys from PEM files.

use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use tokio_rustls::rustls::crypto::{CryptoProvider, ring};
use tokio_rustls::rustls::pki_types::pem::PemObject as _;
use tokio_rustls::rustls::pki_types::{CertificateDer, PrivateKeyDer};
use tokio_rustls::rustls::server::danger::ClientCertVerifier;
use tokio_rustls::rustls::server::{NoServerSessionStorage, WebPkiClientVerifier};
use tokio_rustls::rustls::sign::CertifiedKey;
use tokio_rustls::rustls::version::{TLS12, TLS13};
use tokio_rustls::rustls::{RootCertStore, ServerConfig};

use modalcast_model::error::{Error, Result};

/// Limit on the size of a file in bytes. A bundle of all public authorities has 0.2 MB.
const MAX_FILE_BYTES: u64 = 4 << 20;

/// Permission bits of a file that its group, or everybody else, can read, write or execute.
const GROUP: u32 = 0o070;
const OTHERS: u32 = 0o007;

/// The files of the certificate of a server.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct TlsFiles {
    pub(super) certificate: PathBuf,
    pub(super) key: PathBuf,
    /// The authorities of client certificates.
    pub(super) client_ca: Option<PathBuf>,
}

impl TlsFiles {
    pub(super) fn paths(&self) -> impl Iterator<Item = &Path> {
        [&self.certificate, &self.key].into_iter().chain(&self.client_ca).map(PathBuf::as_path)
    }

    /// Reads the files. Returns the settings of connections, and the certificate of the server itself in DER.
    ///
    /// # Errors
    /// `InvalidFile` also for a key that other users can read, and for one that is not that of the certificate.
    pub(super) fn read(&self, protocols: &[&str]) -> Result<(ServerConfig, CertificateDer<'static>)> {
        let provider = Arc::new(ring::default_provider());
        let certified_key = Arc::new(self.read_certified_key(&provider)?);
        let own = certified_key.cert.first().cloned();
        let own = own.ok_or_else(|| file_error(&self.certificate, "a certificate in PEM", "none"))?;
        let builder = ServerConfig::builder_with_provider(Arc::clone(&provider))
            .with_protocol_versions(&[&TLS13, &TLS12])
            .map_err(|error| file_error(&self.certificate, "a usable provider of ciphers", error))?;
        let builder = match &self.client_ca {
            Some(path) => builder.with_client_cert_verifier(read_client_verifier(path, &provider)?),
            None => builder.with_no_client_auth(),
        };
        let mut config =
            builder.with_cert_resolver(Arc::new(tokio_rustls::rustls::sign::SingleCertAndKey::from(certified_key)));
        config.alpn_protocols = protocols.iter().map(|name| name.as_bytes().to_vec()).collect();
        if self.client_ca.is_some() {
            // A resumed session would not check the certificate of its client again, which may have expired since.
            config.session_storage = Arc::new(NoServerSessionStorage {});
            config.send_tls13_tickets = 0;
        }
        Ok((config, own))
    }

    fn read_certified_key(&self, provider: &CryptoProvider) -> Result<CertifiedKey> {
        let chain = read_certificates(&self.certificate)?;
        check_private(&self.key)?;
        let pem = read_file(&self.key)?;
        let key = PrivateKeyDer::from_pem_slice(&pem);
        let key = key.map_err(|error| file_error(&self.key, "a private key in PEM", error))?;
        CertifiedKey::from_der(chain, key, provider)
            .map_err(|error| file_error(&self.key, &format!("the key of {}", self.certificate.display()), error))
    }
}

/// Checks that only the user of a key can read it. A key of root may be readable for a group, as distributions of Linux
/// have it.
fn check_private(path: &Path) -> Result<()> {
    let metadata = fs::metadata(path).map_err(|error| file_error(path, "a readable file", error))?;
    let forbidden = if metadata.uid() == 0 { OTHERS } else { GROUP | OTHERS };
    match metadata.mode() & forbidden {
        0 => Ok(()),
        _ => {
            let given = format!("mode {:o}; run: chmod 600 {}", metadata.mode() & 0o7777, path.display());
            Err(file_error(path, "a private key that other users cannot read", given))
        }
    }
}

/// Accepts clients without a certificate, and those with a valid one of an authority in a file.
fn read_client_verifier(path: &Path, provider: &Arc<CryptoProvider>) -> Result<Arc<dyn ClientCertVerifier>> {
    let mut roots = RootCertStore::empty();
    for certificate in read_certificates(path)? {
        roots.add(certificate).map_err(|error| file_error(path, "certificates of authorities", error))?;
    }
    WebPkiClientVerifier::builder_with_provider(Arc::new(roots), Arc::clone(provider))
        .allow_unauthenticated()
        .build()
        .map_err(|error| file_error(path, "certificates of authorities", error))
}

fn read_certificates(path: &Path) -> Result<Vec<CertificateDer<'static>>> {
    let pem = read_file(path)?;
    let certificates: Result<Vec<_>, _> = CertificateDer::pem_slice_iter(&pem).collect();
    let certificates = certificates.map_err(|error| file_error(path, "certificates in PEM", error))?;
    match certificates.is_empty() {
        true => Err(file_error(path, "certificates in PEM", "none")),
        false => Ok(certificates),
    }
}

fn read_file(path: &Path) -> Result<Vec<u8>> {
    let metadata = fs::metadata(path).map_err(|error| file_error(path, "a readable file", error))?;
    if metadata.len() > MAX_FILE_BYTES {
        let expected = format!("a file of at most {MAX_FILE_BYTES} bytes");
        return Err(file_error(path, &expected, format!("{} bytes", metadata.len())));
    }
    fs::read(path).map_err(|error| file_error(path, "a readable file", error))
}

fn file_error(path: &Path, expected: &str, given: impl ToString) -> Error {
    Error::InvalidFile { location: path.display().to_string(), expected: expected.into(), given: given.to_string() }
}
