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
    let (rows, rank) = parse_sizes(header)?;
    let mut entries = Vec::new();
    let mut entries_per_line = Vec::new();
    for (index, line) in lines {
        let previous_count = entries.len();
        for word in line.split_ascii_whitespace() {
            let entry: f32 = word.parse().map_err(|_| invalid(format!("line {}", index + 1), "a number", word))?;
            entries.push(entry);
        }
        entries_per_line.push(entries.len() - previous_count);
    }
    check_entry_count(rows, rank, &entries_per_line)?;
    Modes::from_rows(rows, rank, &entries)
}

/// Parses the header: two whole numbers, which some tools write as `684. 32.`.
fn parse_sizes(header: &str) -> Result<(usize, usize)> {
    let words: Vec<&str> = header.split_ascii_whitespace().collect();
    let parse_size = |word: &str| word.strip_suffix('.').unwrap_or(word).parse::<usize>().ok();
    match words[..] {
        [rows, rank] => parse_size(rows).zip(parse_size(rank)),
        _ => None,
    }
    .ok_or_else(|| {
        invalid("header", "two whole numbers, rows and columns", header.chars().take(80).collect::<String>())
    })
}

fn check_entry_count(rows: usize, rank: usize, entries_per_line: &[usize]) -> Result<()> {
    let actual_count: usize = entries_per_line.iter().sum();
    let expected_count = rows.checked_mul(rank);
    let has_one_row_per_line = entries_per_line.len() == rows && entries_per_line.iter().all(|count| *count == rank);
    // A file may wrap lines at other places. In this case, only the total number of entries can be checked.
    if expected_count == Some(actual_count) && (has_one_row_per_line || entries_per_line.len() != rows) {
        return Ok(());
    }
    let expected = format!("{rows} x {rank} values as the header declares");
    let given = match entries_per_line {
        [count, other_counts @ ..] if other_counts.iter().all(|other_count| other_count == count) => {
            format!("{} x {count}", entries_per_line.len())
        }
        _ => format!("{actual_count} values in {} lines", entries_per_line.len()),
    };
    Err(invalid("values", expected, given))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_may_be_wrapped_at_any_place() {
        for text in ["3 2\n1 2\n3 4\n5 6\n", "3. 2.\n1 2 3 4\n5 6\n", "\n3 2\n\n  1e0 2 3 4 5 6"] {
            let modes = parse(text.as_bytes()).expect(text);
            assert_eq!((modes.entry(0, 2, 0), modes.entry(0, 2, 1)), (5.0, 6.0));
        }
    }

    #[test]
    fn declared_and_actual_sizes_must_match() {
        for (text, message) in [
            ("", "header: expected rows and columns, got an empty file"),
            ("3\n1\n", "header: expected two whole numbers, rows and columns, got 3"),
            ("3 -1\n1\n", "header: expected two whole numbers, rows and columns, got 3 -1"),
            ("3 1\n1 2\n3 4\n5 6\n", "values: expected 3 x 1 values as the header declares, got 3 x 2"),
            ("3 2\n1 2\n3 4 5\n6\n", "values: expected 3 x 2 values as the header declares, got 6 values in 3 lines"),
            ("3 2\n1 2\n3 4\n", "values: expected 3 x 2 values as the header declares, got 2 x 2"),
            (
                "9223372036854775807 9223372036854775807\n1\n",
                "values: expected 9223372036854775807 x 9223372036854775807 values as the header declares, got 1 x 1",
            ),
            ("3 1\n1\nx\n3\n", "line 3: expected a number, got x"),
            ("3 1\n1\nnan\n3\n", "modes[1, 0]: expected a finite number, got NaN"),
            ("0 82022820221111090\n", "modes.rows: expected a positive multiple of 3, got 0"),
            ("4 1\n1 2 3 4\n", "modes.rows: expected a positive multiple of 3, got 4"),
        ] {
            assert_eq!(parse(text.as_bytes()).expect_err(text).to_string(), message);
        }
        assert!(parse(b"3 1\n\xff").is_err());
    }
}
