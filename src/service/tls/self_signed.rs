//! A certificate that the server makes itself. Clients trust it by its fingerprint, or by a copy of its file.

use std::collections::BTreeSet;
use std::fs::{self, OpenOptions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use rcgen::{CertificateParams, DistinguishedName, DnType, ExtendedKeyUsagePurpose, KeyPair};

use super::certificate::{end_of_validity, host_names};
use super::files::TlsFiles;
use modalcast_model::error::{Error, Result, invalid};

const DAY: Duration = Duration::from_secs(86_400);

/// Validity of a new certificate. Apple's platforms accept at most 825 days (support.apple.com/103769).
const VALIDITY: Duration = DAY.saturating_mul(820);

/// A certificate is replaced when less than this time remains.
const MIN_REMAINING_VALIDITY: Duration = DAY.saturating_mul(30);

/// Begin of the validity before now, for clients whose clocks are late.
const CLOCK_TOLERANCE: Duration = DAY;

/// The files of a self-signed certificate in the state folder. Makes them if there are none, if one of `names` is
/// missing, or if the certificate expires soon.
///
/// # Errors
/// `Invalid` for a name that is neither a DNS name nor an IP address; `Unavailable` when the folder cannot be written.
pub(super) fn read_or_create(folder: &Path, names: &BTreeSet<String>) -> Result<TlsFiles> {
    let files =
        TlsFiles { certificate: folder.join("tls-certificate.pem"), key: folder.join("tls-key.pem"), client_ca: None };
    if !is_usable(&files, names, SystemTime::now()) {
        let (certificate, key) = new_certificate(names)?;
        let write = || {
            fs::DirBuilder::new().recursive(true).mode(0o700).create(folder)?;
            replace(&files.key, &key)?;
            replace(&files.certificate, &certificate)
        };
        write().map_err(|error| Error::Unavailable {
            what: "self-signed certificate",
            reason: format!("{}: {error}", folder.display()),
            remedy: "Make the folder writable".into(),
        })?;
    }
    Ok(files)
}

/// Whether the certificate exists with its key, has these names, and is valid for some time.
fn is_usable(files: &TlsFiles, names: &BTreeSet<String>, now: SystemTime) -> bool {
    let Ok((_, certificate)) = files.read(&[]) else { return false };
    let own_names: BTreeSet<String> = host_names(&certificate).into_iter().collect();
    let is_valid = end_of_validity(&certificate).is_some_and(|end| end > now + MIN_REMAINING_VALIDITY);
    is_valid && names.is_subset(&own_names)
}

/// A new certificate and its key, in PEM.
fn new_certificate(names: &BTreeSet<String>) -> Result<(String, String)> {
    let names: Vec<String> = names.iter().cloned().collect();
    let field_error = |error| invalid("--tls-name", format!("DNS names or IP addresses ({error})"), names.join(", "));
    let mut params = CertificateParams::new(names.clone()).map_err(field_error)?;
    let now = SystemTime::now();
    params.not_before = (now - CLOCK_TOLERANCE).into();
    params.not_after = (now + VALIDITY).into();
    params.distinguished_name = DistinguishedName::new();
    params.distinguished_name.push(DnType::CommonName, "modalcast, self-signed");
    // It is not an authority: a client that trusts it trusts this server only.
    params.extended_key_usages = vec![ExtendedKeyUsagePurpose::ServerAuth];
    let key = KeyPair::generate().map_err(field_error)?;
    let certificate = params.self_signed(&key).map_err(field_error)?;
    Ok((certificate.pem(), key.serialize_pem()))
}

/// Writes a file that only its user can read.
fn replace(path: &Path, text: &str) -> io::Result<()> {
    let new: PathBuf = path.with_extension(format!("{}.new", std::process::id()));
    fs::remove_file(&new).ok(); // Of a killed process.
    let mut file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(&new)?;
    file.write_all(text.as_bytes())?;
    file.sync_all()?;
    fs::rename(&new, path)
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    fn names(names: &[&str]) -> BTreeSet<String> {
        names.iter().map(|name| (*name).to_owned()).collect()
    }

    #[test]
    fn certificate_is_kept_until_a_name_is_missing() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let folder = folder.path().join("state");
        let read = |list: &[&str]| {
            let files = read_or_create(&folder, &names(list)).expect("expected a certificate");
            fs::read(files.certificate).expect("expected a file")
        };
        let first = read(&["localhost", "127.0.0.1", "::1"]);
        assert_eq!(read(&["localhost", "127.0.0.1"]), first);
        let mode = fs::metadata(folder.join("tls-key.pem")).expect("expected a key").permissions().mode();
        assert_eq!(mode & 0o777, 0o600);
        let second = read(&["localhost", "a.example"]);
        assert_ne!(second, first);
        // A certificate without its key, and a damaged one.
        fs::remove_file(folder.join("tls-key.pem")).expect("expected a key");
        let third = read(&["localhost"]);
        assert_ne!(third, second);
        fs::write(folder.join("tls-certificate.pem"), "no certificate").expect("expected a writable folder");
        assert_ne!(read(&["localhost"]), third);
        let error = read_or_create(&folder, &names(&["ä"])).expect_err("expected a rejection").to_string();
        assert!(error.starts_with("--tls-name: expected"), "{error}");
    }

    #[test]
    fn certificate_is_replaced_before_it_expires() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let files = read_or_create(folder.path(), &names(&["localhost"])).expect("expected a certificate");
        let is_usable = |days| is_usable(&files, &names(&["localhost"]), SystemTime::now() + DAY * days);
        assert_eq!([0, 789, 791, 900].map(is_usable), [true, true, false, false]);
    }
}
