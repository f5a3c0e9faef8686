//! Colors of facets in the attribute words of binary STL files. A channel has five bits. In the format of VisCAM and
//! SolidView, bit 15 marks a word as a color, whose blue is in the lowest bits. In the format of Materialise Magics, the
//! header has the color of the body after `COLOR=`, bit 15 selects this color, and red is in the lowest bits. MeshLab
//! writes such a header with a color of its own, also for bodies without color, and sets bit 15 of all colors.

/// The text in the header before the four bytes of the body's color.
const BODY_COLOR_KEY: &[u8] = b"COLOR=";
/// The color of the body in every header of MeshLab, which means nothing.
const MESHLAB_BODY: [u8; 3] = [0x7f; 3];
/// The bit of an attribute word that is no part of a channel.
const FLAG: u16 = 0x8000;

/// The sRGB color of each facet that has one; empty if no facet has a color.
pub(super) fn decode(header: &[u8], attributes: impl Iterator<Item = u16> + Clone) -> Vec<Option<[u8; 3]>> {
    let has_words = attributes.clone().any(|attribute| attribute != 0);
    let colors: Vec<Option<[u8; 3]>> = match body_color(header) {
        Some(MESHLAB_BODY) if !has_words => Vec::new(),
        Some(body) if is_flagged_with_colors(body, attributes.clone()) => {
            attributes.map(|word| Some(rgb(word))).collect()
        }
        // Programs that color only the body write no words.
        Some(body) => {
            attributes.map(|word| Some(if word & FLAG == 0 && has_words { rgb(word) } else { body })).collect()
        }
        None => {
            let bgr = |word: u16| {
                let [blue, green, red] = rgb(word);
                [red, green, blue]
            };
            attributes.map(|word| (word & FLAG != 0).then(|| bgr(word))).collect()
        }
    };
    if colors.iter().any(Option::is_some) { colors } else { Vec::new() }
}

/// Whether the words are colors although bit 15 of all is set, with which Magics selects the color of the body: the words
/// differ, or MeshLab wrote the header.
fn is_flagged_with_colors(body: [u8; 3], mut attributes: impl Iterator<Item = u16> + Clone) -> bool {
    let Some(first) = attributes.next() else { return false };
    let has_flags = first & FLAG != 0 && attributes.clone().all(|word| word & FLAG != 0);
    has_flags && (body == MESHLAB_BODY || attributes.any(|word| word != first))
}

/// The color of the body in a header of Magics.
fn body_color(header: &[u8]) -> Option<[u8; 3]> {
    let key = header.windows(BODY_COLOR_KEY.len()).position(|window| window == BODY_COLOR_KEY)?;
    let [red, green, blue, _alpha] = header[key + BODY_COLOR_KEY.len()..].first_chunk::<4>()?;
    Some([*red, *green, *blue])
}

/// The channels of a word from the lowest bits on, 0 to 255.
fn rgb(word: u16) -> [u8; 3] {
    [0, 5, 10].map(|shift| ((((word >> shift) & 31) * 255 + 15) / 31) as u8)
}
