//! The page of the browser viewer, and the HTTP headers that restrict what it may load.

use std::fmt::Write as _;
use std::io::Read as _;

use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use bytes::Bytes;
use sha2::{Digest as _, Sha256};

use crate::config::{Authentication, ViewerRecording};
use modalcast_model::error::{Result, fault, fault_in};

/// The viewer: one HTML file with all scripts and styles, compressed with gzip. `clients/web` builds it.
const VIEWER: &[u8] = include_bytes!("../../../clients/web/dist/index.html.gz");

/// Limit on the uncompressed page, in bytes.
const MAX_PAGE_BYTES: u64 = 64 << 20;

/// The place of a recording in the page.
const RECORDING_PLACE: &str = "<!--RECORDING-->";

/// The page and its content security policy.
#[derive(Debug)]
pub(super) struct Page {
    pub(super) body: Bytes,
    /// Whether `body` is compressed with gzip.
    pub(super) is_compressed: bool,
    /// The hashes of the inline scripts, as sources of the policy.
    script_sources: String,
}

impl Page {
    /// The viewer that this program contains.
    ///
    /// # Errors
    /// `Fault` when it is damaged.
    pub(super) fn viewer() -> Result<Self> {
        let script_sources = script_sources(&viewer_html()?)?;
        Ok(Self { body: Bytes::from_static(VIEWER), is_compressed: true, script_sources })
    }

    /// The viewer, which plays the recording of this server. The recording is not in the page, because the page is public.
    ///
    /// # Errors
    /// As for [`Self::viewer`].
    pub(super) fn playing(recording: &ViewerRecording) -> Result<Self> {
        let html = viewer_html()?;
        let (start, end) =
            html.split_once(RECORDING_PLACE).ok_or_else(|| fault("viewer page", "expected a place for a recording"))?;
        let slow = recording.slow;
        // A script of this type is data, which the policy does not concern.
        let element = format!(
            "<script id=\"recording\" type=\"text/plain\" data-path=\"recording\" data-slow=\"{slow}\"></script>"
        );
        let body = [start, &element, end].concat();
        Ok(Self { body: body.into(), is_compressed: false, script_sources: script_sources(&html)? })
    }

    /// The content security policy of a page that connects to `websocket_origins`, such as `ws://localhost:50051`. Only the
    /// scripts of the page may run, and only this server may be connected to. Any page may embed the viewer, as notebooks do:
    /// a frame has no session until its own link gives it one. A server without authentication needs no session, so only
    /// pages of this machine may embed its viewer.
    pub(super) fn policy(&self, websocket_origins: &str, authentication: Authentication) -> String {
        let ancestors = match authentication {
            Authentication::Off => "; frame-ancestors 'self' http://localhost:* http://127.0.0.1:*",
            Authentication::UsersAndTokens | Authentication::Tokens => "",
        };
        format!(
            "default-src 'none'; script-src{}; style-src 'unsafe-inline'; img-src 'self' data: blob:; font-src data:; \
             worker-src blob:; connect-src 'self' {websocket_origins}; base-uri 'none'; form-action 'none'{ancestors}",
            self.script_sources
        )
    }
}

/// The text of the viewer's page.
fn viewer_html() -> Result<String> {
    let mut html = String::new();
    let limited = flate2::read::GzDecoder::new(VIEWER).take(MAX_PAGE_BYTES);
    std::io::BufReader::new(limited).read_to_string(&mut html).map_err(fault_in("viewer page"))?;
    Ok(html)
}

/// The sources of a policy that permit the inline scripts of a page: their SHA-256.
fn script_sources(html: &str) -> Result<String> {
    let mut sources = String::new();
    let mut rest = html;
    while let Some(start) = find_tag(rest, "<script") {
        let invalid = || fault("viewer page", "expected scripts with an end");
        let (_, after_name) = rest.split_at(start);
        let content = after_name.find('>').map(|end| &after_name[end + 1..]).ok_or_else(invalid)?;
        let end = find_tag(content, "</script").ok_or_else(invalid)?;
        let hash = STANDARD.encode(Sha256::digest(&content[..end]));
        write!(sources, " 'sha256-{hash}'").map_err(fault_in("viewer page"))?;
        rest = &content[end..];
    }
    Ok(if sources.is_empty() { " 'none'".into() } else { sources })
}

/// The position of a tag in any letter case.
fn find_tag(html: &str, tag: &str) -> Option<usize> {
    html.as_bytes().windows(tag.len()).position(|window| window.eq_ignore_ascii_case(tag.as_bytes()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn policy_permits_the_scripts_of_the_page_only() {
        let html = "<html><SCRIPT type=module>alert(1)</SCRIPT><p><script></script>";
        let sources = script_sources(html).expect("expected valid scripts");
        // echo -n 'alert(1)' | openssl dgst -sha256 -binary | base64
        let hashes = "'sha256-bhHHL3z2vDgxUt0W3dWQOrprscmda2Y5pLsLg4GF+pI=' \
                      'sha256-47DEQpj8HBSa+/TImW+5JCeuQeRkm5NMpJWZG3hSuFU='";
        assert_eq!(sources.trim(), hashes);
        assert_eq!(script_sources("<p>").expect("expected a page"), " 'none'");
        assert!(script_sources("<script>a").is_err() && script_sources("<script").is_err());
    }

    #[test]
    fn viewer_is_intact() {
        let page = Page::viewer().expect("expected the viewer");
        assert!(page.body.starts_with(&[0x1f, 0x8b]));
        let policy = page.policy("ws://localhost:8000", Authentication::UsersAndTokens);
        assert!(policy.contains("connect-src 'self' ws://localhost:8000;"), "{policy}");
        assert!(!policy.contains("script-src 'unsafe") && !policy.contains("frame-ancestors"), "{policy}");
        let policy = page.policy("ws://localhost:8000", Authentication::Off);
        assert!(policy.contains("frame-ancestors 'self' http://localhost:*"), "{policy}");
    }

    #[test]
    fn recording_is_named_by_the_page_under_the_same_policy() {
        let viewer = Page::viewer().expect("expected the viewer");
        let recording = ViewerRecording { file: Bytes::from_static(b"\x89MCAP"), slow: 100.0 };
        let page = Page::playing(&recording).expect("expected a page");
        let html = std::str::from_utf8(&page.body).expect("expected text");
        let element =
            "<script id=\"recording\" type=\"text/plain\" data-path=\"recording\" data-slow=\"100\"></script>";
        assert_eq!(html.replace(element, RECORDING_PLACE), viewer_html().expect("expected the viewer"));
        assert!(!page.is_compressed && viewer.is_compressed);
        let policy = |page: &Page| page.policy("ws://localhost", Authentication::Tokens);
        assert_eq!(policy(&page), policy(&viewer));
    }
}
