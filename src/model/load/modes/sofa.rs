//! Parser of SOFA's text modes: rows and columns in the first line, then the values, one line per row of U.

use crate::domain::Modes;
use crate::error::{Result, invalid};

/// Parses U and compares the declared with the actual number of values.
///
/// # Errors
/// `Invalid` with the declared and actual sizes, or with the line of a value that is not a number.
pub(super) fn parse(bytes: &[u8]) -> Result<Modes> {
    let text = std::str::from_utf8(bytes).map_err(|error| invalid("text", "ASCII numbers", error))?;
    let mut lines = text.lines().enumerate().filter(|(_, line)| !line.trim().is_empty());
    let (_, header) = lines.next().ok_or_else(|| invalid("header", "rows and columns", "an empty file"))?;
    let (rows, rank) = sizes(header)?;
    let mut entries = Vec::new();
    let mut widths = Vec::new();
    for (index, line) in lines {
        let before = entries.len();
        for word in line.split_ascii_whitespace() {
            let entry: f32 = word.parse().map_err(|_| invalid(format!("line {}", index + 1), "a number", word))?;
            entries.push(entry);
        }
        widths.push(entries.len() - before);
    }
    compare(rows, rank, &widths)?;
    Modes::from_rows(rows, rank, &entries)
}

/// Parses the two whole numbers of the header; some tools write them as `684. 32.`.
fn sizes(header: &str) -> Result<(usize, usize)> {
    let words: Vec<&str> = header.split_ascii_whitespace().collect();
    let whole = |word: &str| word.strip_suffix('.').unwrap_or(word).parse::<usize>().ok();
    match words[..] {
        [rows, rank] => whole(rows).zip(whole(rank)),
        _ => None,
    }
    .ok_or_else(|| {
        invalid("header", "rows and columns, two whole numbers", header.chars().take(80).collect::<String>())
    })
}

fn compare(rows: usize, rank: usize, widths: &[usize]) -> Result<()> {
    let delivered: usize = widths.iter().sum();
    let declared = rows.checked_mul(rank);
    let one_line_each = widths.len() == rows && widths.iter().all(|width| *width == rank);
    // Values may be wrapped at other places; then only their total number can be checked.
    if declared == Some(delivered) && (one_line_each || widths.len() != rows) {
        return Ok(());
    }
    let expected = format!("{rows} x {rank} values as the header declares");
    let given = match widths {
        [width, others @ ..] if others.iter().all(|other| other == width) => format!("{} x {width}", widths.len()),
        _ => format!("{delivered} values in {} lines", widths.len()),
    };
    Err(invalid("values", expected, given))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_stand_one_per_line_or_wrapped() {
        for text in ["3 2\n1 2\n3 4\n5 6\n", "3. 2.\n1 2 3 4\n5 6\n", "\n3 2\n\n  1e0 2 3 4 5 6"] {
            let modes = parse(text.as_bytes()).expect(text);
            assert_eq!((modes.entry(0, 2, 0), modes.entry(0, 2, 1)), (5.0, 6.0));
        }
    }

    #[test]
    fn what_is_delivered_is_compared_with_what_is_declared() {
        for (text, refusal) in [
            ("", "header: expected rows and columns, got an empty file"),
            ("3\n1\n", "header: expected rows and columns, two whole numbers, got 3"),
            ("3 -1\n1\n", "header: expected rows and columns, two whole numbers, got 3 -1"),
            ("3 1\n1 2\n3 4\n5 6\n", "values: expected 3 x 1 values as the header declares, got 3 x 2"),
            ("3 2\n1 2\n3 4 5\n6\n", "values: expected 3 x 2 values as the header declares, got 6 values in 3 lines"),
            ("3 2\n1 2\n3 4\n", "values: expected 3 x 2 values as the header declares, got 2 x 2"),
            (
                "9223372036854775807 9223372036854775807\n1\n",
                "values: expected 9223372036854775807 x 9223372036854775807 values as the header declares, got 1 x 1",
            ),
            ("3 1\n1\nx\n3\n", "line 3: expected a number, got x"),
            ("3 1\n1\nnan\n3\n", "modes[1, 0]: expected a finite number, got NaN"),
            ("4 1\n1 2 3 4\n", "modes.rows: expected a positive multiple of 3, got 4"),
        ] {
            assert_eq!(parse(text.as_bytes()).expect_err(text).to_string(), refusal);
        }
        assert!(parse(b"3 1\n\xff").is_err());
    }
}
