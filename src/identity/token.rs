//! Bearer tokens. The server keeps the SHA-256 of a token, never the token, except for its own one, which is in a file
//! that only its user can read.

use std::fs::{self, OpenOptions, Permissions};
use std::io::{self, Write as _};
use std::os::unix::fs::{DirBuilderExt as _, OpenOptionsExt as _, PermissionsExt as _};
use std::path::Path;

use sha2::{Digest as _, Sha256};

use modalcast_model::error::{Error, Result, fault_in};

/// Random bytes of a token.
const TOKEN_BYTES: usize = 32;

/// Limit on the characters of a token in a request.
const MAX_TOKEN_CHARS: usize = 512;

/// The SHA-256 of a token. Tables of tokens are searched by it: the time of a search reveals nothing about a token,
/// because a token cannot be chosen by its hash.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct TokenHash([u8; 32]);

impl TokenHash {
    /// The hash of a token. `None` for a text that is not a token: empty, too long, or with other characters than
    /// visible ASCII.
    pub fn of(token: &str) -> Option<Self> {
        let is_token =
            (1..=MAX_TOKEN_CHARS).contains(&token.len()) && token.bytes().all(|byte| byte.is_ascii_graphic());
        is_token.then(|| Self(Sha256::digest(token).into()))
    }

    /// Parses 64 hexadecimal digits.
    pub fn parse(text: &str) -> Option<Self> {
        let digits = text.as_bytes();
        if digits.len() != 64 {
            return None;
        }
        let mut bytes = [0; 32];
        for (byte, pair) in bytes.iter_mut().zip(digits.chunks_exact(2)) {
            let digit = |digit: u8| char::from(digit).to_digit(16);
            *byte = (digit(pair[0])? * 16 + digit(pair[1])?) as u8;
        }
        Some(Self(bytes))
    }

    /// The first eight hexadecimal digits, which name the token in logs.
    pub fn short_name(&self) -> String {
        self.0[..4].iter().map(|byte| format!("{byte:02x}")).collect()
    }
}

impl std::fmt::Display for TokenHash {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        self.0.iter().try_for_each(|byte| write!(out, "{byte:02x}"))
    }
}

/// A new token: 64 hexadecimal digits.
///
/// # Errors
/// `Fault` when the system has no random numbers.
pub fn new_token() -> Result<String> {
    let mut bytes = [0; TOKEN_BYTES];
    getrandom::fill(&mut bytes).map_err(fault_in("random token"))?;
    Ok(bytes.iter().map(|byte| format!("{byte:02x}")).collect())
}

/// Reads the token in a file, or creates the file with a new token. Only the user of the server can read it.
///
/// # Errors
/// `Unavailable` when the file cannot be read or written, or has no token.
pub(super) fn read_or_create_token(path: &Path) -> Result<TokenHash> {
    let unavailable = |reason: String| Error::Unavailable {
        what: "token file",
        reason: format!("{}: {reason}", path.display()),
        remedy: "Make the folder writable, or delete the file for a new token".into(),
    };
    if let Some(folder) = path.parent() {
        fs::DirBuilder::new()
            .recursive(true)
            .mode(0o700)
            .create(folder)
            .map_err(|error| unavailable(error.to_string()))?;
    }
    let token = new_token()?;
    let created = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path);
    match created.and_then(|mut file| writeln!(file, "{token}")) {
        Ok(()) => {}
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
        Err(error) => return Err(unavailable(error.to_string())),
    }
    let read = || {
        fs::set_permissions(path, Permissions::from_mode(0o600))?;
        fs::read_to_string(path)
    };
    let text = read().map_err(|error| unavailable(error.to_string()))?;
    TokenHash::of(text.trim()).ok_or_else(|| unavailable("expected a token, got another text".into()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hash_is_printed_and_parsed() {
        let hash = TokenHash::of("abc").expect("expected a token");
        // FIPS 180-4, example of SHA-256.
        let digits = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
        assert_eq!(hash.to_string(), digits);
        assert_eq!(TokenHash::parse(digits), Some(hash));
        assert_eq!(hash.short_name(), "ba7816bf");
        for text in ["", "ba", &digits[1..], &digits.replace('a', "g"), &digits.replace("ba", "é")] {
            assert_eq!(TokenHash::parse(text), None, "{text}");
        }
        for token in ["", "a b", "ä", "a\n", &"x".repeat(513)] {
            assert_eq!(TokenHash::of(token), None, "{token}");
        }
    }

    #[test]
    fn token_file_is_private_and_read_again() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let path = folder.path().join("new").join("token");
        let hash = read_or_create_token(&path).expect("expected a token");
        let text = fs::read_to_string(&path).expect("expected a file");
        assert_eq!(TokenHash::of(text.trim()), Some(hash));
        assert_eq!(text.trim().len(), 64);
        // A file that others could read loses this permission.
        fs::set_permissions(&path, Permissions::from_mode(0o644)).expect("expected new permissions");
        assert_eq!(read_or_create_token(&path).expect("expected the same token"), hash);
        assert_eq!(fs::metadata(&path).expect("expected a file").permissions().mode() & 0o777, 0o600);
        fs::write(&path, " \n").expect("expected a writable file");
        assert!(read_or_create_token(&path).is_err(), "expected an error for an empty token");
    }
}
