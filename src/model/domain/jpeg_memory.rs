//! The memory of a JPEG decoder, from the headers of a file.

/// The first two bytes of a JPEG file.
const START_OF_IMAGE: [u8; 2] = [0xff, 0xd8];

const START_OF_SCAN: u8 = 0xda;

/// Bytes of a coefficient.
const COEFFICIENT_BYTES: u64 = 2;

/// The largest number of components.
const MAX_COMPONENTS: u8 = 4;

/// Bytes of the coefficients that a decoder keeps for the whole image: if the image is progressive, or its first scan
/// does not have all components. 0 for other JPEG files, whose rows are decoded one after another. The largest number for
/// a file that is not understood.
pub(super) fn coefficient_bytes(bytes: &[u8], width: u32, height: u32) -> u64 {
    let kept_components = find_kept_components(bytes).unwrap_or(MAX_COMPONENTS).min(MAX_COMPONENTS);
    COEFFICIENT_BYTES * u64::from(kept_components) * padded_samples(width, height)
}

/// The number of components whose coefficients are kept, from the segments before the first scan.
fn find_kept_components(bytes: &[u8]) -> Option<u8> {
    let mut segments = bytes.strip_prefix(&START_OF_IMAGE)?;
    let mut frame = None;
    loop {
        let (marker, content, remainder) = next_segment(segments)?;
        segments = remainder;
        match marker {
            // Start of a frame: precision, height, width, and the number of components. The markers between are tables.
            0xc0..=0xcf if !matches!(marker, 0xc4 | 0xc8 | 0xcc) => frame = Some((marker, *content.get(5)?)),
            START_OF_SCAN => {
                let (frame_marker, components) = frame?;
                let is_sequential = matches!(frame_marker, 0xc0 | 0xc1) && components == *content.first()?;
                return Some(if is_sequential { 0 } else { components });
            }
            _ => {}
        }
    }
}

/// Samples of a component. The largest block of an image has 32 x 32 samples.
fn padded_samples(width: u32, height: u32) -> u64 {
    [width, height].map(|side| u64::from(side).next_multiple_of(32)).iter().product()
}

/// Splits the next segment off: its marker, its content, and the bytes after it. `None` at the end or for bytes that are
/// no segment.
fn next_segment(bytes: &[u8]) -> Option<(u8, &[u8], &[u8])> {
    let bytes = bytes.strip_prefix(&[0xff])?;
    // Any number of fill bytes precedes a marker.
    let marker_index = bytes.iter().position(|byte| *byte != 0xff)?;
    let (marker, bytes) = bytes[marker_index..].split_first()?;
    // The length includes its own two bytes.
    let length = usize::from(u16::from_be_bytes(*bytes.first_chunk()?));
    Some((*marker, bytes.get(2..length)?, &bytes[length..]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file with a frame of three components and a scan of so many components.
    fn jpeg(frame_marker: u8, scan_components: u8) -> Vec<u8> {
        let frame = [8, 0, 16, 0, 16, 3, 1, 0x11, 0, 2, 0x11, 0, 3, 0x11, 0];
        let segment = |marker: u8, content: &[u8]| {
            let length = (content.len() as u16 + 2).to_be_bytes();
            [&[0xff, 0xff, marker], &length[..], content].concat()
        };
        let segments = [segment(0xe0, b"JFIF"), segment(frame_marker, &frame), segment(0xda, &[scan_components, 1, 0])];
        [&START_OF_IMAGE[..], &segments.concat()].concat()
    }

    #[test]
    fn only_progressive_and_separate_scans_keep_coefficients() {
        assert_eq!(coefficient_bytes(&jpeg(0xc0, 3), 16, 16), 0);
        assert_eq!(coefficient_bytes(&jpeg(0xc0, 1), 16, 16), 2 * 3 * 32 * 32);
        assert_eq!(coefficient_bytes(&jpeg(0xc2, 3), 33, 1), 2 * 3 * 64 * 32);
        let sequential = jpeg(0xc0, 3);
        for length in 0..sequential.len() - 3 {
            let bytes = coefficient_bytes(&sequential[..length], 16, 16);
            assert_eq!(bytes, 2 * 4 * 32 * 32, "expected the largest number for {length} bytes");
        }
    }
}
