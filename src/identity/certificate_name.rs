//! Names of client certificates.

/// A name in a client certificate that identifies a principal: a DNS name, an email address or a URI of the extension for
/// alternative names or, without them, the common name.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct CertificateName(String);

impl CertificateName {
    /// Names are equal if their letters are. Only letters of DNS names have no case (RFC 4343); they contain neither `@`,
    /// as email addresses do, nor `:`, as URIs do.
    pub fn new(name: &str) -> Self {
        Self(if name.contains(['@', ':']) { name.to_owned() } else { name.to_ascii_lowercase() })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_dns_names_ignore_the_case_of_letters() {
        let is_equal = |a, b| CertificateName::new(a) == CertificateName::new(b);
        assert!(is_equal("Anna.Lab.example", "anna.lab.example"));
        assert!(!is_equal("anna.lab.example", "anna.lab.example."));
        assert!(!is_equal("spiffe://lab.example/Anna", "spiffe://lab.example/anna"));
        assert!(!is_equal("Anna@lab.example", "anna@lab.example"));
    }
}
