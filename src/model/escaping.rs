//! Text from files and clients, made safe for terminals, logs and pages.

use std::borrow::Cow;

/// Replaces control characters and characters that change the direction of text by escapes such as `\u{202e}`: they can
/// control a terminal, or show a text in another order than it is read.
pub fn escape_controls(text: &str) -> Cow<'_, str> {
    if !text.contains(is_unsafe) {
        return Cow::Borrowed(text);
    }
    let mut escaped = String::with_capacity(text.len() + 16);
    for character in text.chars() {
        match is_unsafe(character) {
            true => escaped.extend(character.escape_debug()),
            false => escaped.push(character),
        }
    }
    Cow::Owned(escaped)
}

/// Whether a character is a control character, a line or paragraph separator, or one of the marks, embeddings, overrides
/// and isolates of the bidirectional algorithm (Unicode Standard Annex #9).
fn is_unsafe(character: char) -> bool {
    character.is_control()
        || matches!(character, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}'..='\u{202e}' | '\u{2066}'..='\u{2069}')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn controls_and_directions_are_escaped() {
        let text = "a\u{1b}[31m\nb\0\u{202e}c\u{2066}d\u{200f}\u{9b}";
        assert_eq!(escape_controls(text), r"a\u{1b}[31m\nb\0\u{202e}c\u{2066}d\u{200f}\u{9b}");
        for text in ["", "Größe 'a\\b'", "模型 👩‍🔧", "é\u{301}"] {
            assert!(matches!(escape_controls(text), Cow::Borrowed(same) if same == text));
        }
    }
}
