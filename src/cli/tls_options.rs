//! Options of encryption, which `serve` and `view` share.

use std::path::PathBuf;

use crate::config::{ServerCertificate, TlsSettings};

/// Encryption of the TCP sockets. Unix sockets need none.
#[derive(Debug, Clone, Default, PartialEq, clap::Args)]
pub(crate) struct TlsOptions {
    /// PEM file with the certificate of the server, and those of the authorities between it and the root. It is read again
    /// when it changes.
    #[arg(
        long,
        env = "MODALCAST_TLS_CERTIFICATE",
        value_name = "FILE",
        requires = "tls_key",
        group = "server_certificate"
    )]
    tls_certificate: Option<PathBuf>,
    /// PEM file with the private key of the certificate, which other users cannot read.
    #[arg(long, env = "MODALCAST_TLS_KEY", value_name = "FILE", requires = "tls_certificate")]
    tls_key: Option<PathBuf>,
    /// Encrypt with a certificate that the server makes itself and keeps in the state folder. Its file and its SHA-256, by
    /// which clients trust it, are printed.
    #[arg(long, conflicts_with_all = ["tls_certificate", "tls_key"], group = "server_certificate")]
    tls_self_signed: bool,
    /// A further DNS name or IP address in the self-signed certificate, besides those of this machine. The option can be
    /// repeated.
    #[arg(
        long,
        value_name = "NAME",
        requires = "tls_self_signed",
        // clap drops the requirement of an option that conflicts with a given one.
        conflicts_with_all = ["tls_certificate", "tls_key"]
    )]
    tls_name: Vec<String>,
    /// PEM file with the authorities of client certificates, whose names identify principals (`certificates` in the file
    /// of --principals).
    #[arg(long, env = "MODALCAST_TLS_CLIENT_CA", value_name = "FILE", requires = "server_certificate")]
    tls_client_ca: Option<PathBuf>,
}

impl TlsOptions {
    /// The settings. `None` without a certificate.
    pub(crate) fn settings(&self) -> Option<TlsSettings> {
        let files = self.tls_certificate.clone().zip(self.tls_key.clone());
        let from_files = files.map(|(certificate, key)| ServerCertificate::Files { certificate, key });
        let self_signed = || ServerCertificate::SelfSigned { names: self.tls_name.clone() };
        let certificate = from_files.or_else(|| self.tls_self_signed.then(self_signed))?;
        Some(TlsSettings { certificate, client_ca: self.tls_client_ca.clone() })
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser as _;

    use super::*;

    #[derive(Debug, clap::Parser)]
    struct Options {
        #[command(flatten)]
        tls: TlsOptions,
    }

    fn parse(arguments: &[&str]) -> Result<Option<TlsSettings>, String> {
        let arguments = ["test"].iter().chain(arguments);
        Options::try_parse_from(arguments).map(|options| options.tls.settings()).map_err(|error| error.to_string())
    }

    /// No option is ignored: a server without a certificate would be plain.
    #[test]
    fn options_need_a_certificate() {
        assert_eq!(parse(&[]), Ok(None));
        let self_signed = |names: &[&str]| {
            let names = names.iter().map(|name| (*name).to_owned()).collect();
            TlsSettings { certificate: ServerCertificate::SelfSigned { names }, client_ca: None }
        };
        assert_eq!(parse(&["--tls-self-signed"]), Ok(Some(self_signed(&[]))));
        assert_eq!(
            parse(&["--tls-self-signed", "--tls-name", "a", "--tls-name", "b"]),
            Ok(Some(self_signed(&["a", "b"])))
        );
        let files = ["--tls-certificate", "a.pem", "--tls-key", "a.key", "--tls-client-ca", "ca.pem"];
        let certificate = ServerCertificate::Files { certificate: "a.pem".into(), key: "a.key".into() };
        assert_eq!(parse(&files), Ok(Some(TlsSettings { certificate, client_ca: Some("ca.pem".into()) })));
        for arguments in [
            &["--tls-client-ca", "ca.pem"][..],
            &["--tls-certificate", "a.pem"],
            &["--tls-key", "a.key"],
            &["--tls-name", "a"],
            &["--tls-certificate", "a.pem", "--tls-key", "a.key", "--tls-self-signed"],
            &["--tls-certificate", "a.pem", "--tls-key", "a.key", "--tls-name", "a"],
        ] {
            assert!(parse(arguments).is_err(), "{arguments:?}");
        }
    }
}
