//! Parser of Vega's matrix files: int32 rows, int32 columns (little-endian), then f32 or f64 entries, column-major.

use crate::domain::Modes;
use crate::error::{Result, invalid};

/// Parses U. The file size distinguishes f32 from f64.
///
/// # Errors
/// `Invalid` if the header is truncated or negative, if the size matches neither type, and as for
/// [`Modes::from_columns`].
pub(super) fn parse(bytes: &[u8]) -> Result<Modes> {
    let Some((header, body)) = bytes.split_first_chunk::<8>() else {
        return Err(invalid("header", "8 bytes", bytes.len()));
    };
    let [a, b, c, d, e, f, g, h] = *header;
    let dimension = |field: &str, bytes: [u8; 4]| {
        let value = i32::from_le_bytes(bytes);
        usize::try_from(value).map_err(|_| invalid(field, "at least 0", value))
    };
    let (rows, rank) = (dimension("rows", [a, b, c, d])?, dimension("columns", [e, f, g, h])?);
    // The product of two 31-bit numbers and eight can exceed 64 bits.
    let count = rows as u128 * rank as u128;
    let entries = match body.len() as u128 {
        size if size == 4 * count => read_f32_le(body),
        size if size == 8 * count => read_f64_le_as_f32(body),
        size => {
            let expected = format!("{} bytes (f32) or {} (f64) for {rows} x {rank}", 8 + 4 * count, 8 + 8 * count);
            return Err(invalid("size", expected, 8 + size));
        }
    };
    Modes::from_columns(rows, rank, entries)
}

/// Decodes little-endian f32 entries.
pub(super) fn read_f32_le(body: &[u8]) -> Vec<f32> {
    body.as_chunks().0.iter().map(|entry| f32::from_le_bytes(*entry)).collect()
}

/// Decodes little-endian f64 entries, rounded to f32.
pub(super) fn read_f64_le_as_f32(body: &[u8]) -> Vec<f32> {
    body.as_chunks().0.iter().map(|entry| f64::from_le_bytes(*entry) as f32).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn vega_file(rows: i32, columns: i32, body: &[u8]) -> Vec<u8> {
        [&rows.to_le_bytes()[..], &columns.to_le_bytes(), body].concat()
    }

    #[test]
    fn file_size_selects_f32_or_f64() {
        let f32s: Vec<u8> = (0..6u8).flat_map(|entry| f32::from(entry).to_le_bytes()).collect();
        let f64s: Vec<u8> = (0..6u8).flat_map(|entry| f64::from(entry).to_le_bytes()).collect();
        for body in [f32s, f64s] {
            let modes = parse(&vega_file(3, 2, &body)).expect("a valid file");
            assert_eq!((modes.rank(), modes.entry(0, 1, 0), modes.entry(0, 1, 1)), (2, 1.0, 4.0));
        }
        assert_eq!(parse(&vega_file(3, 0, &[])).expect("a file without modes").rank(), 0);
    }

    #[test]
    fn invalid_headers_and_sizes_are_rejected_before_allocation() {
        for (bytes, message) in [
            (vec![1, 2, 3], "header: expected 8 bytes, got 3"),
            (vega_file(-3, 1, &[]), "rows: expected at least 0, got -3"),
            (vega_file(3, i32::MIN, &[]), "columns: expected at least 0, got -2147483648"),
            (
                vega_file(i32::MAX, i32::MAX, &[0; 12]),
                "size: expected 18446744056529682444 bytes (f32) or 36893488113059364880 (f64) for 2147483647 x \
                 2147483647, got 20",
            ),
            (vega_file(3, 2, &[0; 20]), "size: expected 32 bytes (f32) or 56 (f64) for 3 x 2, got 28"),
            (vega_file(3, 2, &[0; 25]), "size: expected 32 bytes (f32) or 56 (f64) for 3 x 2, got 33"),
            (vega_file(4, 1, &[0; 16]), "modes.rows: expected a positive multiple of 3, got 4"),
            (vega_file(3, 600, &[0; 7200]), "modes.columns: expected 0 to 512, got 600"),
            (vega_file(3, 1, &[255; 12]), "modes[0, 0]: expected a finite number, got NaN"),
        ] {
            assert_eq!(parse(&bytes).expect_err(message).to_string(), message);
        }
    }
}
