//! Parser of NumPy's `.npy` files to arrays of f32.
//!
//! The parser of the header only searches for known keys. A general parser of Python literals would recurse as deep as
//! brackets nest, so that a header with many brackets could overflow the stack.

use std::borrow::Cow;

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

/// The header of a file: type, shape and order of its numbers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(in crate::load) struct NpyHeader {
    dtype: String,
    pub(in crate::load) shape: Vec<usize>,
    pub(in crate::load) fortran_order: bool,
    /// Bytes of the data, computed from type and shape.
    pub(in crate::load) data_bytes: usize,
}

/// The largest length of a header with its magic, version and length.
pub(in crate::load) const MAX_PREFIX_BYTES: usize = MAX_HEADER_BYTES + 12;

/// Parses an array of whole or floating-point numbers (rounded to f32) in either byte order.
///
/// # Errors
/// `Invalid` if the header or the type is not supported, or if the size of the data does not match the shape.
pub fn parse(bytes: &[u8]) -> Result<NpyArray> {
    let (header, body) = parse_header(bytes)?;
    header.check_size(body)?;
    let (kind, body) = in_little_endian(&header.dtype, body);
    let entries = match kind {
        "f4" => super::vega::read_f32_le(&body),
        "f8" => super::vega::read_f64_le_as_f32(&body),
        _ => entries_of_kind(kind, &body, |entry| entry as f32).ok_or_else(|| unknown_type(&header.dtype))?,
    };
    Ok(NpyArray { shape: header.shape, fortran_order: header.fortran_order, entries })
}

/// Parses an array of numbers to f64. The returned entries are in C order. An array in Fortran order, in which NumPy
/// writes a transposed array, must have at most two axes.
///
/// # Errors
/// As for [`parse`].
pub(in crate::load) fn parse_f64(bytes: &[u8]) -> Result<(Vec<usize>, Vec<f64>)> {
    let (header, body) = parse_header(bytes)?;
    header.check_size(body)?;
    if header.fortran_order && header.shape.len() > 2 {
        return Err(invalid("fortran_order", "False for more than two axes", "True"));
    }
    let (kind, body) = in_little_endian(&header.dtype, body);
    let entries = entries_of_kind(kind, &body, |entry| entry).ok_or_else(|| unknown_type(&header.dtype))?;
    let entries = match header.shape[..] {
        [rows, columns] if header.fortran_order => {
            (0..rows * columns).map(|index| entries[index % columns * rows + index / columns]).collect()
        }
        _ => entries,
    };
    Ok((header.shape, entries))
}

fn unknown_type(dtype: &str) -> Error {
    invalid("descr", "i1, u1, i2, u2, i4, u4, i8, u8, f2, f4 or f8", dtype)
}

/// Converts little-endian entries of a type such as `f4`. `None` for an unknown type.
pub(super) fn entries_of_kind<T>(kind: &str, body: &[u8], convert: impl Fn(f64) -> T) -> Option<Vec<T>> {
    Some(match kind {
        "u1" | "b1" => body.iter().map(|entry| convert(f64::from(*entry))).collect(),
        "i1" => body.iter().map(|entry| convert(f64::from(i8::from_le_bytes([*entry])))).collect(),
        "i2" => body.as_chunks().0.iter().map(|entry| convert(f64::from(i16::from_le_bytes(*entry)))).collect(),
        "u2" => body.as_chunks().0.iter().map(|entry| convert(f64::from(u16::from_le_bytes(*entry)))).collect(),
        "i4" => body.as_chunks().0.iter().map(|entry| convert(f64::from(i32::from_le_bytes(*entry)))).collect(),
        "u4" => body.as_chunks().0.iter().map(|entry| convert(f64::from(u32::from_le_bytes(*entry)))).collect(),
        // Whole numbers above 2^53 are rounded. No valid index is as large.
        "i8" => body.as_chunks().0.iter().map(|entry| convert(i64::from_le_bytes(*entry) as f64)).collect(),
        "u8" => body.as_chunks().0.iter().map(|entry| convert(u64::from_le_bytes(*entry) as f64)).collect(),
        "f2" => {
            let entries = body.as_chunks().0.iter();
            entries.map(|entry| convert(f64::from(f16_to_f32(u16::from_le_bytes(*entry))))).collect()
        }
        "f4" => body.as_chunks().0.iter().map(|entry| convert(f64::from(f32::from_le_bytes(*entry)))).collect(),
        "f8" => body.as_chunks().0.iter().map(|entry| convert(f64::from_le_bytes(*entry))).collect(),
        _ => return None,
    })
}

/// IEEE 754 binary16 to f32, exact. A binary16 has a sign bit, 5 exponent bits with bias 15, and 10 fraction bits. The
/// fraction is read as a whole number, so the exponent of 2 is `exponent` - 15 - 10.
pub(super) fn f16_to_f32(bits: u16) -> f32 {
    let sign = if bits & 0x8000 == 0 { 1.0 } else { -1.0 };
    let (exponent, fraction) = (i32::from(bits >> 10 & 0x1f), f32::from(bits & 0x3ff));
    let magnitude = match exponent {
        0 => fraction * 2f32.powi(-24),
        31 if fraction == 0.0 => f32::INFINITY,
        31 => f32::NAN,
        _ => (1024.0 + fraction) * 2f32.powi(exponent - 25),
    };
    sign * magnitude
}

/// The entries of an array of bytes.
///
/// # Errors
/// `Invalid` as for [`parse`], or if the entries are not bytes.
pub(in crate::load) fn parse_bytes(bytes: &[u8]) -> Result<&[u8]> {
    let (header, body) = parse_header(bytes)?;
    header.check_size(body)?;
    match header.dtype.get(1..) {
        Some("u1") => Ok(body),
        _ => Err(invalid("descr", "u1", header.dtype)),
    }
}

/// The type of the entries without its byte order, and the entries in little-endian order.
fn in_little_endian<'a, 'b>(dtype: &'a str, body: &'b [u8]) -> (&'a str, Cow<'b, [u8]>) {
    let kind = dtype.get(1..).unwrap_or_default();
    let entry_bytes = kind.get(1..).and_then(|digits| digits.parse().ok()).unwrap_or(1).max(1);
    match dtype.starts_with('>') {
        true => (kind, body.chunks_exact(entry_bytes).flat_map(|entry| entry.iter().rev().copied()).collect()),
        false => (kind, Cow::Borrowed(body)),
    }
}

/// Parses the header of a file. `bytes` contains at least the header. Returns the header and the bytes after it.
///
/// # Errors
/// `Invalid` if the header is not supported, or its shape has more bytes than memory can address.
pub(in crate::load) fn parse_header(bytes: &[u8]) -> Result<(NpyHeader, &[u8])> {
    let (header, body) = split_header(bytes)?;
    let dtype = find_value(header, "descr")?.trim_matches(['\'', '"']).to_owned();
    let fortran_order = match find_value(header, "fortran_order")? {
        "True" => true,
        "False" => false,
        other => return Err(invalid("fortran_order", "True or False", other)),
    };
    let shape = parse_shape(find_value(header, "shape")?)?;
    let entry_bytes: usize = match dtype.get(1..) {
        Some("u1" | "b1" | "i1") => 1,
        Some("i2" | "u2" | "f2") => 2,
        Some("f4" | "i4" | "u4") => 4,
        Some("f8" | "i8" | "u8") => 8,
        _ => return Err(unknown_type(&dtype)),
    };
    let data_bytes = shape.iter().try_fold(entry_bytes, |size: usize, extent| size.checked_mul(*extent));
    let data_bytes = data_bytes
        .ok_or_else(|| invalid("data", format!("{entry_bytes} bytes for each entry of {shape:?}"), body.len()))?;
    Ok((NpyHeader { dtype, shape, fortran_order, data_bytes }, body))
}

impl NpyHeader {
    fn check_size(&self, body: &[u8]) -> Result<()> {
        match body.len() == self.data_bytes {
            true => Ok(()),
            false => {
                let entries: usize = self.shape.iter().product();
                let entry_bytes = self.data_bytes.checked_div(entries).unwrap_or(0);
                Err(invalid("data", format!("{entry_bytes} bytes for each entry of {:?}", self.shape), body.len()))
            }
        }
    }
}

/// Splits the file into the text of the header and the data after it.
fn split_header(bytes: &[u8]) -> Result<(&str, &[u8])> {
    let truncated = || invalid("header", "a complete .npy header", format!("{} bytes", bytes.len()));
    // Six bytes of magic, then the major and the minor version. Version 1 has a header length of 16 bits, later
    // versions have 32 bits.
    let magic = bytes.get(..8).ok_or_else(truncated)?;
    if &magic[..6] != b"\x93NUMPY" || !(1..=3).contains(&magic[6]) {
        return Err(invalid("header", "the magic of .npy version 1 to 3", format!("{magic:02x?}")));
    }
    let (length, remainder) = if magic[6] == 1 {
        let (length, remainder) = bytes[8..].split_first_chunk().ok_or_else(truncated)?;
        (usize::from(u16::from_le_bytes(*length)), remainder)
    } else {
        let (length, remainder) = bytes[8..].split_first_chunk().ok_or_else(truncated)?;
        (u32::from_le_bytes(*length) as usize, remainder)
    };
    if length > MAX_HEADER_BYTES {
        return Err(invalid("header", format!("at most {MAX_HEADER_BYTES} bytes"), length));
    }
    let (header, body) = remainder.split_at_checked(length).ok_or_else(truncated)?;
    let text = std::str::from_utf8(header).map_err(|error| invalid("header", "text", error))?;
    Ok((text, body))
}

/// The text of a key's value, which ends at the closing parenthesis of a tuple, or before the next comma or brace.
fn find_value<'a>(header: &'a str, key: &str) -> Result<&'a str> {
    let missing = || -> Error { invalid("header", format!("the key '{key}'"), header.trim()) };
    let value_text = [format!("'{key}'"), format!("\"{key}\"")]
        .iter()
        .find_map(|quoted| header.split_once(quoted.as_str()))
        .and_then(|(_, text_after_key)| text_after_key.trim_start().strip_prefix(':'))
        .ok_or_else(missing)?
        .trim_start();
    let end = match value_text.strip_prefix('(') {
        // Include both parentheses.
        Some(tuple) => tuple.find(')').map(|index| index + 2),
        None => value_text.find([',', '}']),
    };
    Ok(value_text[..end.ok_or_else(missing)?].trim())
}

fn parse_shape(text: &str) -> Result<Vec<usize>> {
    let invalid_shape = || invalid("shape", "a tuple of whole numbers", text);
    let extents_text = text.strip_prefix('(').and_then(|text| text.strip_suffix(')')).ok_or_else(invalid_shape)?;
    let extents = extents_text.split(',').map(str::trim).filter(|extent| !extent.is_empty());
    extents.map(|extent| extent.parse().map_err(|_| invalid_shape())).collect()
}

#[cfg(test)]
mod tests {
    use ndarray::ShapeBuilder;
    use ndarray_npy::WriteNpyExt;

    use super::*;

    fn to_npy<A: ndarray_npy::WritableElement>(array: &ndarray::Array2<A>) -> Vec<u8> {
        let mut bytes = Vec::new();
        array.write_npy(&mut bytes).expect("an encoded array");
        bytes
    }

    #[test]
    fn index_orders_and_entry_types_give_the_same_matrix() {
        let entry = |(row, column): (usize, usize)| (2 * row + column) as f32;
        let row_major = ndarray::Array2::from_shape_fn((3, 2), entry);
        let column_major = ndarray::Array2::from_shape_fn((3, 2).f(), entry);
        let f64_array = row_major.mapv(f64::from);
        // binary16 and big-endian entries, which the crate ndarray-npy does not write.
        let with_entries = |dtype: &str, entries: Vec<u8>| {
            let header = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': (3, 2)}}");
            let mut bytes = npy_file(&header, 0);
            bytes.extend(entries);
            bytes
        };
        let f16_bits = [0_u16, 0x3c00, 0x4000, 0x4200, 0x4400, 0x4500];
        let f16_file = with_entries("<f2", f16_bits.iter().flat_map(|bits| bits.to_le_bytes()).collect());
        let big_endian = with_entries(">f2", f16_bits.iter().flat_map(|bits| bits.to_be_bytes()).collect());
        let files = [
            to_npy(&row_major),
            to_npy(&column_major),
            to_npy(&f64_array),
            f16_file,
            big_endian,
            to_npy(&row_major.mapv(|entry| entry as i8)),
            to_npy(&row_major.mapv(|entry| entry as u16)),
            to_npy(&row_major.mapv(|entry| entry as i64)),
        ];
        for file in &files {
            assert_eq!(parse_f64(file).expect("a valid .npy file").1, [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]);
        }
        let modes: Vec<_> = files
            .iter()
            .map(|bytes| super::super::matrix(parse(bytes).expect("a valid .npy file")).expect("a matrix"))
            .collect();
        assert_eq!(modes[0].entry(0, 2, 1), 5.0);
        assert!(
            parse(&to_npy(&column_major)).expect("a valid .npy file").fortran_order,
            "control: expected a column-major file"
        );
        assert!(modes.iter().all(|other| *other == modes[0]), "{modes:?}");
    }

    fn npy_file(header: &str, data_bytes: usize) -> Vec<u8> {
        let length = u16::try_from(header.len()).expect("a header below 64 KiB");
        [b"\x93NUMPY\x01\x00", &length.to_le_bytes()[..], header.as_bytes(), &vec![0; data_bytes]].concat()
    }

    #[test]
    fn invalid_files_are_rejected_before_allocation() {
        let file_with_shape =
            |text: &str| npy_file(&format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {text}, }}"), 12);
        let brackets = "(".repeat(4000);
        for (bytes, start) in [
            (b"\x93NUMPY".to_vec(), "header: expected a complete .npy header, got 6 bytes"),
            (b"PK\x03\x04aaaa".to_vec(), "header: expected the magic"),
            (b"\x93NUMPY\x02\x00\xff\xff\xff\xff".to_vec(), "header: expected at most 4096 bytes, got 4294967295"),
            (b"\x93NUMPY\x01\x00\x40\x00ab".to_vec(), "header: expected a complete"),
            (file_with_shape("(3, 2)"), "data: expected 4 bytes for each entry of [3, 2], got 12"),
            (file_with_shape("(3, 0)"), "data: expected 0 bytes for each entry of [3, 0], got 12"),
            (file_with_shape("(4294967296, 4294967296)"), "data: expected"),
            (file_with_shape("(9223372036854775807, 3)"), "data: expected"),
            (file_with_shape("(3, -1)"), "shape: expected a tuple of whole numbers"),
            (file_with_shape(&brackets), "header: expected the key 'shape'"),
            (
                npy_file("{'descr': '<c8', 'fortran_order': False, 'shape': (3,1)}", 24),
                "descr: expected i1, u1, i2, u2, i4, u4, i8, u8, f2, f4 or f8, got <c8",
            ),
            (npy_file("{'descr': '<f4', 'fortran_order': No, 'shape': (3,1)}", 12), "fortran_order: expected"),
            (npy_file("{}", 0), "header: expected the key 'descr'"),
        ] {
            let message = parse(&bytes).expect_err(start).to_string();
            assert!(message.starts_with(start), "{message}");
        }
        let vector = parse(&file_with_shape("(3,)")).expect("a vector");
        let message = super::super::matrix(vector).expect_err("one dimension").to_string();
        assert_eq!(message, "shape: expected 3n x r or n x 3 x r, got [3]");
    }

    #[test]
    fn arrays_of_n_3_r_are_the_same_matrix_in_both_orders() {
        let entry = |(vertex, component, mode): (usize, usize, usize)| (100 * vertex + 10 * component + mode) as f32;
        let row_major = ndarray::Array3::from_shape_fn((2, 3, 4), entry);
        let column_major = ndarray::Array3::from_shape_fn((2, 3, 4).f(), entry);
        let [a, b] = [row_major, column_major].map(|array| {
            let mut bytes = Vec::new();
            array.write_npy(&mut bytes).expect("an encoded array");
            super::super::matrix(parse(&bytes).expect("a valid .npy file")).expect("a matrix")
        });
        assert_eq!((a.vertices(), a.rank(), a.entry(1, 2, 3)), (2, 4, 123.0));
        assert_eq!(a, b);
        let modes_first = NpyArray { shape: vec![4, 2, 3], fortran_order: false, entries: vec![0.0; 24] };
        let message = super::super::matrix(modes_first).expect_err("modes on the first axis").to_string();
        assert_eq!(message, "shape: expected 3n x r or n x 3 x r, got [4, 2, 3]");
    }
}
