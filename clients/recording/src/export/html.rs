//! Writes a web page that plays a recording without a server.

use std::fs::File;
use std::io::{BufReader, BufWriter, Read as _, Write as _};
use std::path::Path;

use base64::engine::general_purpose::STANDARD;
use base64::write::EncoderWriter;

use super::check_slow;
use crate::error::{Error, Result};
use crate::reader::Recording;

/// The end of the part of the viewer's page that precedes the recording. The page's script is after it.
const HEAD_END: &str = "</head>";

/// Writes the viewer's page with the recording inside, as base64 in `<script id="recording">`. The file is copied in
/// pieces. The page first shows a second of the motion in `slow` seconds.
///
/// # Errors
/// `Unavailable` if the recording has only the hashes of its contents; `Invalid` if `slow` is no positive number or the
/// page has no end of its head; `File` if a file cannot be read or written.
pub fn export_html(recording: &Recording, page: &str, slow: f64, out: &Path) -> Result<()> {
    check_slow(slow)?;
    recording.require_contents()?;
    let Some(position) = page.find(HEAD_END) else {
        return Err(Error::invalid("--page", format!("a page with {HEAD_END}"), "another page"));
    };
    let (start, end) = page.split_at(position);
    let source = File::open(recording.path()).map_err(|error| Error::open(recording.path(), &error))?;
    // The file may grow while it is read, so only the bytes that were checked are copied.
    let mut source = BufReader::new(source).take(recording.file_bytes());
    let file = File::create(out).map_err(|error| Error::open(out, &error))?;
    let mut file = BufWriter::new(file);
    let mut write = || {
        file.write_all(start.as_bytes())?;
        write!(file, "<script id=\"recording\" type=\"application/octet-stream\" data-slow=\"{slow}\">")?;
        let mut encoder = EncoderWriter::new(&mut file, &STANDARD);
        std::io::copy(&mut source, &mut encoder)?;
        encoder.finish()?;
        drop(encoder);
        file.write_all(b"</script>\n")?;
        file.write_all(end.as_bytes())?;
        file.flush()
    };
    write().map_err(|error| Error::file(out, error))
}
