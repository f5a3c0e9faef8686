//! Reads the names and the validity of certificates.

use std::net::IpAddr;
use std::time::{Duration, SystemTime};

use sha2::{Digest as _, Sha256};
use x509_parser::prelude::{FromDer as _, GeneralName, X509Certificate};

use crate::identity::CertificateName;

/// The names of a client: DNS names, email addresses and URIs of the extension for alternative names or, without any of
/// them, the common names. Empty for a malformed certificate.
pub(super) fn client_names(der: &[u8]) -> Vec<CertificateName> {
    let Ok((_, certificate)) = X509Certificate::from_der(der) else { return Vec::new() };
    let to_name = |name: &GeneralName<'_>| match name {
        GeneralName::DNSName(name) | GeneralName::RFC822Name(name) | GeneralName::URI(name) => Some((*name).to_owned()),
        _ => None,
    };
    let alternative_names: Vec<String> = alternative_names(&certificate).iter().filter_map(to_name).collect();
    let common_names = || certificate.subject().iter_common_name().filter_map(|name| name.as_str().ok());
    match alternative_names.is_empty() {
        true => common_names().map(CertificateName::new).collect(),
        false => alternative_names.iter().map(|name| CertificateName::new(name)).collect(),
    }
}

/// The DNS names and IP addresses of a server. Empty for a malformed certificate.
pub(super) fn host_names(der: &[u8]) -> Vec<String> {
    let Ok((_, certificate)) = X509Certificate::from_der(der) else { return Vec::new() };
    let to_name = |name: &GeneralName<'_>| match name {
        GeneralName::DNSName(name) => Some((*name).to_owned()),
        GeneralName::IPAddress(bytes) => ip_address(bytes).map(|address| address.to_string()),
        _ => None,
    };
    alternative_names(&certificate).iter().filter_map(to_name).collect()
}

/// The end of the validity. `None` for a malformed certificate, or an end before 1970.
pub(super) fn end_of_validity(der: &[u8]) -> Option<SystemTime> {
    let (_, certificate) = X509Certificate::from_der(der).ok()?;
    let seconds = u64::try_from(certificate.validity().not_after.timestamp()).ok()?;
    SystemTime::UNIX_EPOCH.checked_add(Duration::from_secs(seconds))
}

/// The SHA-256 of a certificate as browsers and `openssl x509 -fingerprint -sha256` show it.
pub(super) fn fingerprint(der: &[u8]) -> String {
    let bytes: Vec<String> = Sha256::digest(der).iter().map(|byte| format!("{byte:02X}")).collect();
    bytes.join(":")
}

fn alternative_names<'a>(certificate: &'a X509Certificate<'a>) -> &'a [GeneralName<'a>] {
    let extension = certificate.subject_alternative_name().ok().flatten();
    extension.map_or(&[], |extension| extension.value.general_names.as_slice())
}

fn ip_address(bytes: &[u8]) -> Option<IpAddr> {
    let v4 = <[u8; 4]>::try_from(bytes).map(IpAddr::from);
    v4.or_else(|_| <[u8; 16]>::try_from(bytes).map(IpAddr::from)).ok()
}

#[cfg(test)]
mod tests {
    use rcgen::{CertificateParams, DnType, KeyPair, SanType};

    use super::*;

    fn certificate(common_name: &str, alternative_names: Vec<SanType>) -> Vec<u8> {
        let mut params = CertificateParams::default();
        params.distinguished_name.push(DnType::CommonName, common_name);
        params.subject_alt_names = alternative_names;
        let key = KeyPair::generate().expect("expected a key");
        params.self_signed(&key).expect("expected a certificate").der().to_vec()
    }

    #[test]
    fn alternative_names_replace_the_common_name_of_a_client() {
        let text = |text: &str| text.try_into().expect("expected ASCII letters");
        let names = |names: &[&str]| names.iter().map(|name| CertificateName::new(name)).collect::<Vec<_>>();
        assert_eq!(client_names(&certificate("anna", Vec::new())), names(&["anna"]));
        let address = SanType::IpAddress([192, 0, 2, 1].into());
        assert_eq!(client_names(&certificate("anna", vec![address.clone()])), names(&["anna"]));
        let listed = vec![
            address.clone(),
            SanType::DnsName(text("anna.lab.example")),
            SanType::URI(text("spiffe://lab.example/anna")),
            SanType::Rfc822Name(text("anna@lab.example")),
        ];
        let expected = names(&["anna.lab.example", "spiffe://lab.example/anna", "anna@lab.example"]);
        assert_eq!(client_names(&certificate("owner", listed)), expected);
        assert_eq!(client_names(b"no certificate"), []);
        let server =
            vec![SanType::DnsName(text("a.example")), address, SanType::IpAddress("::1".parse().expect("::1"))];
        assert_eq!(host_names(&certificate("anna", server)), ["a.example", "192.0.2.1", "::1"]);
        assert_eq!(end_of_validity(b"no certificate"), None);
    }

    #[test]
    fn fingerprint_is_a_list_of_hexadecimal_bytes() {
        // FIPS 180-4, example of SHA-256.
        let fingerprint = fingerprint(b"abc");
        assert!(fingerprint.starts_with("BA:78:16:BF:") && fingerprint.ends_with(":15:AD"), "{fingerprint}");
    }
}
