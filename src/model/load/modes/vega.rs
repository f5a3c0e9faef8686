//! Parser of Vega's matrix files: int32 rows, int32 columns (little-endian), then f32 or f64 entries, column-major.

use crate::domain::Modes;
use crate::error::{Result, invalid};

/// Parses U. The file size distinguishes f32 from f64.
///
/// # Errors
/// `Invalid` if the header is truncated or negative, or the size matches neither type; otherwise as for
/// [`Modes::from_columns`].
pub(super) fn parse(bytes: &[u8]) -> Result<Modes> {
    let Some((header, body)) = bytes.split_first_chunk::<8>() else {
        return Err(invalid("header", "8 bytes", bytes.len()));
    };
    let [a, b, c, d, e, f, g, h] = *header;
    let dimension = |field: &str, bytes: [u8; 4]| {
        let value = i32::from_le_bytes(bytes);
        usize::try_from(value).map_err(|_| invalid(field, "no negative number", value))
    };
    let (rows, rank) = (dimension("rows", [a, b, c, d])?, dimension("columns", [e, f, g, h])?);
    // The product of two 31-bit numbers and eight can exceed 64 bits.
    let entries = rows as u128 * rank as u128;
    let columns = match body.len() as u128 {
        size if size == 4 * entries => read_f32_le(body),
        size if size == 8 * entries => read_f64_le_as_f32(body),
        size => {
            let expected = format!("{} bytes (f32) or {} (f64) for {rows} x {rank}", 8 + 4 * entries, 8 + 8 * entries);
            return Err(invalid("size", expected, 8 + size));
        }
    };
    Modes::from_columns(rows, rank, columns)
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

    fn file(rows: i32, columns: i32, body: &[u8]) -> Vec<u8> {
        [&rows.to_le_bytes()[..], &columns.to_le_bytes(), body].concat()
    }

    #[test]
    fn both_widths_are_told_apart_by_size_and_read_column_by_column() {
        let single: Vec<u8> = (0..6u8).flat_map(|entry| f32::from(entry).to_le_bytes()).collect();
        let double: Vec<u8> = (0..6u8).flat_map(|entry| f64::from(entry).to_le_bytes()).collect();
        for body in [single, double] {
            let modes = parse(&file(3, 2, &body)).expect("good");
            assert_eq!((modes.rank(), modes.entry(0, 1, 0), modes.entry(0, 1, 1)), (2, 1.0, 4.0));
        }
        assert_eq!(parse(&file(3, 0, &[])).expect("no modes").rank(), 0);
    }

    #[test]
    fn hostile_headers_and_cut_off_bodies_are_refused_before_anything_is_allocated() {
        for (bytes, refusal) in [
            (vec![1, 2, 3], "header: expected 8 bytes, got 3"),
            (file(-3, 1, &[]), "rows: expected no negative number, got -3"),
            (file(3, i32::MIN, &[]), "columns: expected no negative number, got -2147483648"),
            (
                file(i32::MAX, i32::MAX, &[0; 12]),
                "size: expected 18446744056529682444 bytes (f32) or 36893488113059364880 (f64) for 2147483647 x \
                 2147483647, got 20",
            ),
            (file(3, 2, &[0; 20]), "size: expected 32 bytes (f32) or 56 (f64) for 3 x 2, got 28"),
            (file(3, 2, &[0; 25]), "size: expected 32 bytes (f32) or 56 (f64) for 3 x 2, got 33"),
            (file(4, 1, &[0; 16]), "modes.rows: expected a positive multiple of 3, got 4"),
            (file(3, 600, &[0; 7200]), "modes.columns: expected 0 to 512, got 600"),
            (file(3, 1, &[255; 12]), "modes[0, 0]: expected a finite number, got NaN"),
        ] {
            assert_eq!(parse(&bytes).expect_err(refusal).to_string(), refusal);
        }
    }
}
