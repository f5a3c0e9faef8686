//! Parser of NumPy's `.npy` files to arrays of f32.
//!
//! It does not use a general parser of Python literals: a header may have up to 4 GiB, and such a parser would recurse
//! as deep as the header's brackets nest and could overflow the stack.

use crate::error::{Error, Result, invalid};

/// The longest accepted header in bytes.
const MAX_HEADER_BYTES: usize = 4096;

/// Array entries with their shape.
#[derive(Debug, Clone, PartialEq)]
pub struct NpyArray {
    pub shape: Vec<usize>,
    /// Whether the first index varies fastest (column-major) instead of the last.
    pub fortran_order: bool,
    pub entries: Vec<f32>,
}

/// Parses an array of f32 or f64 (rounded to f32) in either byte order.
///
/// # Errors
/// `Invalid` if the bytes are not such a file, or their number does not match the shape.
pub fn parse(bytes: &[u8]) -> Result<NpyArray> {
    let (header, body) = split(bytes)?;
    let description = value(header, "descr")?.trim_matches(['\'', '"']);
    let fortran_order = match value(header, "fortran_order")? {
        "True" => true,
        "False" => false,
        other => return Err(invalid("fortran_order", "True or False", other)),
    };
    let shape = shape(value(header, "shape")?)?;
    let width = match description {
        "<f4" | ">f4" => 4,
        "<f8" | ">f8" => 8,
        other => return Err(invalid("descr", "f4 or f8", other)),
    };
    let size = shape.iter().try_fold(width, |size: usize, side| size.checked_mul(*side));
    if size != Some(body.len()) {
        return Err(invalid("data", format!("{width} bytes for each entry of {shape:?}"), body.len()));
    }
    let entries = match description {
        "<f4" => super::vega::read_f32_le(body),
        "<f8" => super::vega::read_f64_le_as_f32(body),
        ">f4" => body.as_chunks().0.iter().map(|entry| f32::from_be_bytes(*entry)).collect(),
        _ => body.as_chunks().0.iter().map(|entry| f64::from_be_bytes(*entry) as f32).collect(),
    };
    Ok(NpyArray { shape, fortran_order, entries })
}

/// Splits the file into the text of the header and the data after it.
fn split(bytes: &[u8]) -> Result<(&str, &[u8])> {
    let cut = || invalid("header", "a whole .npy header", format!("{} bytes", bytes.len()));
    let start = bytes.get(..8).ok_or_else(cut)?;
    if &start[..6] != b"\x93NUMPY" || !(1..=3).contains(&start[6]) {
        return Err(invalid("header", "the magic of .npy version 1 to 3", format!("{start:02x?}")));
    }
    let (length, rest) = if start[6] == 1 {
        let (length, rest) = bytes[8..].split_first_chunk().ok_or_else(cut)?;
        (usize::from(u16::from_le_bytes(*length)), rest)
    } else {
        let (length, rest) = bytes[8..].split_first_chunk().ok_or_else(cut)?;
        (u32::from_le_bytes(*length) as usize, rest)
    };
    if length > MAX_HEADER_BYTES {
        return Err(invalid("header", format!("at most {MAX_HEADER_BYTES} bytes"), length));
    }
    let (header, body) = rest.split_at_checked(length).ok_or_else(cut)?;
    let text = std::str::from_utf8(header).map_err(|error| invalid("header", "text", error))?;
    Ok((text, body))
}

/// The value of a key: up to the closing parenthesis of a tuple, or the next comma or brace.
fn value<'a>(header: &'a str, key: &str) -> Result<&'a str> {
    let missing = || -> Error { invalid("header", format!("the key '{key}'"), header.trim()) };
    let after = [format!("'{key}'"), format!("\"{key}\"")]
        .iter()
        .find_map(|quoted| header.split_once(quoted.as_str()))
        .and_then(|(_, rest)| rest.trim_start().strip_prefix(':'))
        .ok_or_else(missing)?
        .trim_start();
    let end = match after.strip_prefix('(') {
        Some(inner) => inner.find(')').map(|at| at + 2),
        None => after.find([',', '}']),
    };
    Ok(after[..end.ok_or_else(missing)?].trim())
}

fn shape(text: &str) -> Result<Vec<usize>> {
    let refuse = || invalid("shape", "a tuple of whole numbers", text);
    let inner = text.strip_prefix('(').and_then(|text| text.strip_suffix(')')).ok_or_else(refuse)?;
    let sides = inner.split(',').map(str::trim).filter(|side| !side.is_empty());
    sides.map(|side| side.parse().map_err(|_| refuse())).collect()
}

#[cfg(test)]
mod tests {
    use ndarray::ShapeBuilder;
    use ndarray_npy::WriteNpyExt;

    use super::*;

    fn written<A: ndarray_npy::WritableElement>(array: &ndarray::Array2<A>) -> Vec<u8> {
        let mut bytes = Vec::new();
        array.write_npy(&mut bytes).expect("written");
        bytes
    }

    #[test]
    fn both_orders_and_widths_give_the_same_matrix() {
        let entry = |(row, column): (usize, usize)| (2 * row + column) as f32;
        let c = ndarray::Array2::from_shape_fn((3, 2), entry);
        let fortran_order = ndarray::Array2::from_shape_fn((3, 2).f(), entry);
        let double = c.mapv(f64::from);
        let modes: Vec<_> = [written(&c), written(&fortran_order), written(&double)]
            .iter()
            .map(|bytes| super::super::parse_npy(bytes).expect("good"))
            .collect();
        assert_eq!(modes[0].entry(0, 2, 1), 5.0);
        assert!(parse(&written(&fortran_order)).expect("good").fortran_order, "the writer kept the order");
        assert_eq!(modes[0], modes[1]);
        assert_eq!(modes[0], modes[2]);
    }

    fn file(header: &str, body: usize) -> Vec<u8> {
        let length = u16::try_from(header.len()).expect("short");
        [b"\x93NUMPY\x01\x00", &length.to_le_bytes()[..], header.as_bytes(), &vec![0; body]].concat()
    }

    #[test]
    fn hostile_files_are_refused_before_anything_is_allocated() {
        let described =
            |text: &str| file(&format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {text}, }}"), 12);
        let brackets = "(".repeat(4000);
        for (bytes, start) in [
            (b"\x93NUMPY".to_vec(), "header: expected a whole .npy header, got 6 bytes"),
            (b"PK\x03\x04aaaa".to_vec(), "header: expected the magic"),
            (b"\x93NUMPY\x02\x00\xff\xff\xff\xff".to_vec(), "header: expected at most 4096 bytes, got 4294967295"),
            (b"\x93NUMPY\x01\x00\x40\x00ab".to_vec(), "header: expected a whole"),
            (described("(3, 2)"), "data: expected 4 bytes for each entry of [3, 2], got 12"),
            (described("(3, 0)"), "data: expected 4 bytes for each entry of [3, 0], got 12"),
            (described("(4294967296, 4294967296)"), "data: expected"),
            (described("(9223372036854775807, 3)"), "data: expected"),
            (described("(3, -1)"), "shape: expected a tuple of whole numbers"),
            (described(&brackets), "header: expected the key 'shape'"),
            (file("{'descr': '<i4', 'fortran_order': False, 'shape': (3,1)}", 12), "descr: expected f4 or f8, got <i4"),
            (file("{'descr': '<f4', 'fortran_order': No, 'shape': (3,1)}", 12), "fortran_order: expected"),
            (file("{}", 0), "header: expected the key 'descr'"),
        ] {
            let refusal = parse(&bytes).expect_err(start).to_string();
            assert!(refusal.starts_with(start), "{refusal}");
        }
        let flat = super::super::parse_npy(&described("(3,)")).expect_err("flat").to_string();
        assert_eq!(flat, "shape: expected two dimensions, 3n x r, got [3]");
    }
}
