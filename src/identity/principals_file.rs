//! The file of principals: a TOML file that names the principals of a server besides its own user, and their
//! credentials.
//!
//! ```toml
//! [[principal]]
//! name = "anna"
//! role = "drive"
//! uids = [1001]
//! certificates = ["anna.lab.example"]
//!
//! [[principal]]
//! name = "dashboard"
//! role = "pixels"
//! [[principal.token]]
//! sha256 = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad"
//! expires = "2027-01-01T00:00:00Z"
//! ```

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::sync::Arc;
use std::time::SystemTime;

use serde::Deserialize;

use super::certificate_name::CertificateName;
use super::principal::{ANONYMOUS, Credential, OWNER, Principal};
use super::role::Role;
use super::token::TokenHash;
use modalcast_model::error::{Error, Result, invalid};

/// Limit on the principals of a file.
const MAX_PRINCIPALS: usize = 256;

/// Limit on the user ids, on the certificates, and on the tokens, of one principal.
const MAX_CREDENTIALS: usize = 256;

/// Limit on the bytes of a certificate's name.
const MAX_CERTIFICATE_NAME_BYTES: usize = 512;

/// Limit on the characters of a name.
const MAX_NAME_CHARS: usize = 64;

/// Limit on the size of a file in bytes.
const MAX_FILE_BYTES: u64 = 16 << 20;

/// Permission bits of a file that others can write.
const OTHERS_WRITE: u32 = 0o022;

/// The credentials of a file.
#[derive(Debug, Default)]
pub(super) struct Credentials {
    pub(super) by_uid: BTreeMap<u32, Arc<Credential>>,
    pub(super) by_certificate: BTreeMap<CertificateName, Arc<Credential>>,
    pub(super) by_token: BTreeMap<TokenHash, Arc<Credential>>,
    /// For the viewer sessions that an administrator gives to principals, by their names.
    pub(super) by_name: BTreeMap<String, Arc<Credential>>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct FileEntries {
    #[serde(default)]
    principal: Vec<PrincipalEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct PrincipalEntry {
    name: String,
    role: Role,
    #[serde(default)]
    uids: Vec<u32>,
    #[serde(default)]
    certificates: Vec<String>,
    #[serde(default)]
    token: Vec<TokenEntry>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct TokenEntry {
    sha256: String,
    expires: Option<String>,
}

impl Credentials {
    /// Reads a file. `own_uid` is the user of the server, who is the owner and cannot be another principal.
    ///
    /// # Errors
    /// `InvalidFile` with the place of the fault, also when other users can write the file.
    pub(super) fn read(path: &Path, own_uid: u32) -> Result<Self> {
        let file_error = |expected: &str, given: String| Error::InvalidFile {
            location: path.display().to_string(),
            expected: expected.into(),
            given,
        };
        let metadata = fs::metadata(path).map_err(|error| file_error("a readable file", error.to_string()))?;
        if metadata.mode() & OTHERS_WRITE != 0 {
            let given = format!("mode {:o}; run: chmod go-w {}", metadata.mode() & 0o7777, path.display());
            return Err(file_error("a file that only its owner can write", given));
        }
        if metadata.len() > MAX_FILE_BYTES {
            let expected = format!("a file of at most {MAX_FILE_BYTES} bytes");
            return Err(file_error(&expected, format!("{} bytes", metadata.len())));
        }
        let text = fs::read_to_string(path).map_err(|error| file_error("a readable text file", error.to_string()))?;
        Self::parse(&text, own_uid).map_err(|error| error.prefix_field(&path.display().to_string()).into_file_error())
    }

    /// Parses the text of a file.
    ///
    /// # Errors
    /// `Invalid` with the field.
    fn parse(text: &str, own_uid: u32) -> Result<Self> {
        let entries: FileEntries = toml::from_str(text).map_err(|error| {
            let line = error.span().map_or(1, |span| 1 + text[..span.start].matches('\n').count());
            invalid(format!("line {line}"), "a table of principals", error.message())
        })?;
        if entries.principal.len() > MAX_PRINCIPALS {
            return Err(invalid("principal", format!("at most {MAX_PRINCIPALS} principals"), entries.principal.len()));
        }
        let (mut credentials, mut names) = (Self::default(), BTreeSet::new());
        for (index, entry) in entries.principal.into_iter().enumerate() {
            let in_entry = |error: Error| error.in_message(&format!("principal[{index}]"));
            check_principal_name(&entry.name).map_err(in_entry)?;
            if !names.insert(entry.name.clone()) {
                return Err(in_entry(invalid("name", "a name that occurs once", format!("'{}'", entry.name))));
            }
            credentials.add(entry, own_uid).map_err(in_entry)?;
        }
        Ok(credentials)
    }

    /// Adds the credentials of one principal.
    fn add(&mut self, entry: PrincipalEntry, own_uid: u32) -> Result<()> {
        let principal = Arc::new(Principal { name: entry.name, role: entry.role });
        self.by_name.insert(principal.name.clone(), Credential::new(Arc::clone(&principal), None));
        let counts =
            [("uids", entry.uids.len()), ("certificates", entry.certificates.len()), ("token", entry.token.len())];
        for (field, count) in counts {
            if count > MAX_CREDENTIALS {
                return Err(invalid(field, format!("at most {MAX_CREDENTIALS} entries"), count));
            }
        }
        for (index, uid) in entry.uids.into_iter().enumerate() {
            let field = || format!("uids[{index}]");
            if uid == own_uid {
                return Err(invalid(field(), "another user than that of the server", uid));
            }
            let credential = Credential::new(Arc::clone(&principal), None);
            if self.by_uid.insert(uid, credential).is_some() {
                return Err(invalid(field(), "a user id that occurs once in the file", uid));
            }
        }
        for (index, name) in entry.certificates.into_iter().enumerate() {
            let field = || format!("certificates[{index}]");
            if name.is_empty() || name.len() > MAX_CERTIFICATE_NAME_BYTES {
                let expected = format!("a name of 1 to {MAX_CERTIFICATE_NAME_BYTES} bytes");
                return Err(invalid(field(), expected, format!("{} bytes", name.len())));
            }
            let credential = Credential::new(Arc::clone(&principal), None);
            if self.by_certificate.insert(CertificateName::new(&name), credential).is_some() {
                let given = format!("'{}'", name.escape_debug());
                return Err(invalid(field(), "a name that occurs once in the file", given));
            }
        }
        for (index, TokenEntry { sha256, expires }) in entry.token.into_iter().enumerate() {
            let field = |name: &str| format!("token[{index}].{name}");
            let hash = TokenHash::parse(&sha256)
                .ok_or_else(|| invalid(field("sha256"), "64 hexadecimal digits", format!("'{sha256}'")))?;
            let parse_time = |text: &String| {
                let expected = "a time in UTC such as 2027-01-01T00:00:00Z";
                humantime::parse_rfc3339(text).map_err(|_| invalid(field("expires"), expected, format!("'{text}'")))
            };
            let expires: Option<SystemTime> = expires.as_ref().map(parse_time).transpose()?;
            let credential = Credential::new(Arc::clone(&principal), expires);
            if self.by_token.insert(hash, credential).is_some() {
                return Err(invalid(field("sha256"), "a token that occurs once in the file", hash.short_name()));
            }
        }
        Ok(())
    }

    /// All credentials.
    pub(super) fn all(&self) -> impl Iterator<Item = &Arc<Credential>> {
        let by_connection = self.by_uid.values().chain(self.by_certificate.values());
        by_connection.chain(self.by_token.values()).chain(self.by_name.values())
    }

    /// Replaces the credentials that have an equal one in `former` by it, so that these calls continue, and revokes the
    /// other ones of `former`.
    pub(super) fn take_over(&mut self, former: &Self) {
        take_over_equal(&mut self.by_uid, &former.by_uid);
        take_over_equal(&mut self.by_certificate, &former.by_certificate);
        take_over_equal(&mut self.by_token, &former.by_token);
        take_over_equal(&mut self.by_name, &former.by_name);
    }
}

fn take_over_equal<K: Ord>(credentials: &mut BTreeMap<K, Arc<Credential>>, former: &BTreeMap<K, Arc<Credential>>) {
    for (key, former) in former {
        match credentials.get_mut(key) {
            Some(credential) if credential.is_equal(former) => *credential = Arc::clone(former),
            _ => former.revoke(),
        }
    }
}

/// Checks the name of a principal besides the owner. Names occur in logs and in error messages.
///
/// # Errors
/// `Invalid` for a name with other characters than letters, digits, '-', '_', '.' and '@', of more than 64 characters, and
/// for the names of the owner and of clients without a principal.
pub fn check_principal_name(name: &str) -> Result<()> {
    let is_allowed = |letter: char| letter.is_ascii_alphanumeric() || "-_.@".contains(letter);
    if name.is_empty() || name.len() > MAX_NAME_CHARS || !name.chars().all(is_allowed) {
        let expected = format!("1 to {MAX_NAME_CHARS} letters, digits, '-', '_', '.' or '@'");
        return Err(invalid("name", expected, format!("'{}'", name.escape_debug())));
    }
    if name == OWNER {
        return Err(invalid("name", "another name, because the user of the server is the owner", "'owner'"));
    }
    if name == ANONYMOUS {
        return Err(invalid("name", "another name, because it stands for clients without a principal", "'anonymous'"));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const OWN_UID: u32 = 1000;
    const DIGITS: &str = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";

    fn parse(text: &str) -> Result<Credentials> {
        Credentials::parse(text, OWN_UID)
    }

    #[test]
    fn credentials_identify_their_principals() {
        let text = format!(
            "[[principal]]\nname = 'anna'\nrole = 'drive'\nuids = [1001, 0]\n\
             [[principal]]\nname = 'dashboard'\nrole = 'pixels'\n\
             [[principal.token]]\nsha256 = '{DIGITS}'\nexpires = '2027-01-01T00:00:00Z'\n"
        );
        let credentials = parse(&text).expect("expected valid principals");
        let anna = credentials.by_uid[&1001].principal();
        assert_eq!((anna.name.as_str(), anna.role), ("anna", Role::Drive));
        assert!(Arc::ptr_eq(anna, credentials.by_uid[&0].principal()));
        let dashboard = &credentials.by_token[&TokenHash::of("abc").expect("expected a token")];
        assert_eq!((dashboard.principal().name.as_str(), dashboard.principal().role), ("dashboard", Role::Pixels));
        let end = SystemTime::UNIX_EPOCH + std::time::Duration::from_secs(1_798_761_600);
        assert!(dashboard.has_expired(end));
        assert!(!dashboard.has_expired(end - std::time::Duration::from_secs(1)));
        // Each principal has one for viewer sessions, too.
        assert_eq!(credentials.all().count(), 3 + 2);
    }

    #[test]
    fn invalid_entries_are_rejected_with_their_place() {
        let anna = "[[principal]]\nname = 'anna'\nrole = 'view'\n";
        let token = |fields: &str| format!("{anna}[[principal.token]]\n{fields}\n");
        let cases = [
            ("principal = 1".into(), "line 1"),
            ("\n[[principal]]\nname = 'anna'\nrole = 'king'".into(), "line 4"),
            ("[[principal]]\nname = 'anna'\nrole = 'view'\npassword = 'x'".into(), "line 4"),
            ("[[principal]]\nname = 'a\\b'\nrole = 'view'".into(), "principal[0].name"),
            ("[[principal]]\nname = 'owner'\nrole = 'view'".into(), "principal[0].name"),
            ("[[principal]]\nname = 'anonymous'\nrole = 'view'".into(), "principal[0].name"),
            (anna.repeat(2), "principal[1].name"),
            (format!("{anna}uids = [1000]"), "principal[0].uids[0]"),
            (format!("{anna}uids = [7, 7]"), "principal[0].uids[1]"),
            (format!("{anna}uids = [-1]"), "line 4"),
            (format!("{anna}certificates = ['a.example', 'A.example']"), "principal[0].certificates[1]"),
            (format!("{anna}certificates = ['']"), "principal[0].certificates[0]"),
            (token("sha256 = 'abc'"), "principal[0].token[0].sha256"),
            (token(&format!("sha256 = '{DIGITS}'\nexpires = 'tomorrow'")), "principal[0].token[0].expires"),
            (token(&format!("sha256 = '{DIGITS}'\n[[principal.token]]\nsha256 = '{DIGITS}'")), "token[1].sha256"),
        ];
        for (text, place) in cases {
            let error = parse(&text).expect_err(&text).to_string();
            assert!(error.contains(place), "expected {place}, got {error}");
        }
        let many: String = (0..257).map(|index| format!("[[principal]]\nname = 'p{index}'\nrole = 'view'\n")).collect();
        assert!(parse(&many).is_err(), "expected a limit on principals");
    }

    #[test]
    fn file_that_others_can_write_is_rejected() {
        use std::os::unix::fs::PermissionsExt as _;
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("principals.toml");
        std::fs::write(&path, "").expect("expected a writable folder");
        let read = |mode: u32| {
            std::fs::set_permissions(&path, std::fs::Permissions::from_mode(mode)).expect("expected new permissions");
            Credentials::read(&path, OWN_UID).map(|credentials| credentials.all().count())
        };
        assert_eq!(read(0o644), Ok(0));
        let error = read(0o664).expect_err("expected a rejection").to_string();
        assert!(error.contains("664"), "{error}");
    }
}
