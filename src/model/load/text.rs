//! Lines of text files of any system.

use crate::error::{Result, invalid};

/// A text without the byte-order mark that some programs write at its start.
///
/// # Errors
/// `Invalid` for the mark of UTF-16.
pub(super) fn without_byte_order_mark(text: &[u8]) -> Result<&[u8]> {
    match text {
        [0xef, 0xbb, 0xbf, rest @ ..] => Ok(rest),
        [0xff, 0xfe, ..] | [0xfe, 0xff, ..] => Err(invalid("text", "UTF-8", "UTF-16")),
        _ => Ok(text),
    }
}

/// The lines of a text without their ends: `\n`, `\r\n` or, in old files, `\r`.
pub(super) fn lines(text: &[u8]) -> impl Iterator<Item = &[u8]> {
    let mut rest = Some(text);
    std::iter::from_fn(move || {
        let text = rest?;
        let Some(length) = text.iter().position(|byte| matches!(byte, b'\n' | b'\r')) else {
            return rest.take();
        };
        let end_length = if text[length..].starts_with(b"\r\n") { 2 } else { 1 };
        rest = Some(&text[length + end_length..]);
        Some(&text[..length])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_end_with_any_line_end() {
        let expected: [&[u8]; 5] = [b"a", b"", b"b c", b"d", b""];
        for text in ["a\n\nb c\nd\n", "a\r\n\r\nb c\r\nd\r\n", "a\r\rb c\rd\r", "a\n\r\nb c\rd\n"] {
            assert_eq!(lines(text.as_bytes()).collect::<Vec<_>>(), expected, "{text:?}");
        }
        assert_eq!(lines(b"a").count(), 1);
    }

    #[test]
    fn byte_order_marks_are_removed_or_rejected() {
        assert_eq!(without_byte_order_mark(b"\xef\xbb\xbfa"), Ok(&b"a"[..]));
        assert!(without_byte_order_mark(b"\xff\xfea\0").is_err());
    }
}
