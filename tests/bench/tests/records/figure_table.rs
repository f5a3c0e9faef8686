//! A Markdown table whose numbers are values of records.

use std::collections::BTreeMap;
use std::ops::Range;

use serde::Deserialize;
use serde_json::Value;

/// The records by the names of their files.
pub(crate) type Records = BTreeMap<String, Value>;

/// A table of a document, and the values of records that its cells quote.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct FigureTable {
    /// Path of the document from the root of the working tree.
    pub(crate) document: String,
    /// The header line, which occurs once in the document.
    header: String,
    /// Path of a value: the file of its record, and segments after `/`: a key, an index, or `key=value` for the element
    /// of a list with this value, several separated by `&`. ` * FACTOR` at the end converts the unit. `{}` stands for the
    /// text of a cell below. A text that contains `.json/` is a whole path.
    #[serde(default = "whole_selector")]
    selector: String,
    /// The rows below the header, without their first cells.
    cells: Vec<Vec<Cell>>,
}

fn whole_selector() -> String {
    "{}".into()
}

/// The values that a cell quotes, one per number, in order. An empty text is a number that is not of the record, or no
/// number.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Cell {
    One(String),
    Several(Vec<String>),
}

impl Cell {
    fn names(&self) -> &[String] {
        match self {
            Self::One(name) if name.is_empty() => &[],
            Self::One(name) => std::slice::from_ref(name),
            Self::Several(names) => names,
        }
    }
}

/// A number in a document.
struct Figure<'a> {
    /// Its bytes in the document.
    range: Range<usize>,
    /// Name of its value in the table's list of cells.
    name: &'a str,
}

impl FigureTable {
    /// The figures of the table in `document` that differ from the values of the records, as messages.
    pub(crate) fn mismatches(&self, document: &str, records: &Records) -> Vec<String> {
        let figures = match self.figures(document) {
            Ok(figures) => figures,
            Err(message) => return vec![message],
        };
        let mismatch = |figure: &Figure<'_>| {
            let (printed, path) = (&document[figure.range.clone()], self.path_of(figure.name));
            let message = |expected: String| format!("{}: {path}: expected {expected}, got {printed}", self.document);
            match value_at(&path, records) {
                None => Some(format!("{}: {path}: expected a number at this path, got none", self.document)),
                Some(value) => (!is_rounded(printed, value)).then(|| message(value.to_string())),
            }
        };
        figures.iter().filter(|figure| !figure.name.is_empty()).filter_map(mismatch).collect()
    }

    /// The document with the values of the records in place of the figures of the table.
    pub(crate) fn update(&self, document: &str, records: &Records) -> Result<String, String> {
        let (mut updated, mut copied) = (String::new(), 0);
        for Figure { range, name } in self.figures(document)?.into_iter().filter(|figure| !figure.name.is_empty()) {
            let path = self.path_of(name);
            let Some(value) = value_at(&path, records) else {
                return Err(format!("{}: {path}: expected a number at this path, got none", self.document));
            };
            updated.push_str(&document[copied..range.start]);
            updated.push_str(&format_like(&document[range.clone()], value));
            copied = range.end;
        }
        Ok(updated + &document[copied..])
    }

    fn path_of(&self, name: &str) -> String {
        if name.contains(".json/") { name.to_owned() } else { self.selector.replace("{}", name) }
    }

    /// The byte of the last digit of each figure.
    pub(crate) fn digit_positions(&self, document: &str) -> Vec<usize> {
        let figures = self.figures(document).expect("expected the table");
        figures.iter().filter(|figure| !figure.name.is_empty()).map(|figure| figure.range.end - 1).collect()
    }

    /// The numbers of the table. The error says how the table differs from the list of cells.
    fn figures<'a>(&'a self, document: &str) -> Result<Vec<Figure<'a>>, String> {
        let lines = self.row_lines(document)?;
        let mut figures = Vec::new();
        for (line, cells) in lines.iter().zip(&self.cells) {
            let ranges = cell_ranges(document, line.clone());
            if ranges.len() != cells.len() + 1 {
                let row = &document[line.clone()];
                return Err(format!("{}: expected {} cells, got {row}", self.document, cells.len() + 1));
            }
            for (range, cell) in ranges[1..].iter().zip(cells) {
                let (numbers, names) = (number_ranges(document, range.clone()), cell.names());
                if numbers.len() != names.len() {
                    let text = &document[range.clone()];
                    return Err(format!("{}: expected {} numbers, got `{text}`", self.document, names.len()));
                }
                figures.extend(numbers.into_iter().zip(names).map(|(range, name)| Figure { range, name }));
            }
        }
        Ok(figures)
    }

    /// The bytes of each line below the header and its rule.
    fn row_lines(&self, document: &str) -> Result<Vec<Range<usize>>, String> {
        let error = |got: String| Err(format!("{}: expected one table `{}`, got {got}", self.document, self.header));
        let starts: Vec<usize> =
            document.match_indices(&format!("{}\n", self.header)).map(|(start, _)| start).collect();
        let [start] = starts[..] else { return error(format!("{}", starts.len())) };
        let mut lines = Vec::new();
        let mut position = start;
        for line in document[start..].split_inclusive('\n').take_while(|line| line.starts_with('|')) {
            lines.push(position..position + line.trim_end().len());
            position += line.len();
        }
        // The header and the rule are no rows.
        let rows = lines.split_off(2.min(lines.len()));
        if rows.len() == self.cells.len() { Ok(rows) } else { error(format!("{} rows", rows.len())) }
    }
}

/// The bytes of each cell of a line `| a | b |`.
fn cell_ranges(document: &str, line: Range<usize>) -> Vec<Range<usize>> {
    let bars: Vec<usize> = document[line.clone()].match_indices('|').map(|(bar, _)| line.start + bar).collect();
    bars.windows(2).map(|pair| pair[0] + 1..pair[1]).collect()
}

/// The bytes of each number of a cell: digits with commas, a decimal point and an exponent. Digits that follow a letter,
/// as in `f32`, are no number.
fn number_ranges(document: &str, cell: Range<usize>) -> Vec<Range<usize>> {
    let bytes = document.as_bytes();
    let is_digit = |position: usize| position < cell.end && bytes[position].is_ascii_digit();
    let (mut ranges, mut position) = (Vec::new(), cell.start);
    while position < cell.end {
        if !bytes[position].is_ascii_alphanumeric() {
            position += 1;
            continue;
        }
        let (start, is_number) = (position, is_digit(position));
        while position < cell.end {
            let byte = bytes[position];
            let joins_digits = is_number && matches!(byte, b',' | b'.') && is_digit(position + 1);
            let is_exponent_sign = byte == b'-' && is_number && bytes[position - 1] == b'e' && is_digit(position + 1);
            if !(byte.is_ascii_alphanumeric() || joins_digits || is_exponent_sign) {
                break;
            }
            position += 1;
        }
        if is_number && parse_number(&document[start..position]).is_some() {
            ranges.push(start..position);
        }
    }
    ranges
}

/// The value of a printed number, without commas.
fn parse_number(printed: &str) -> Option<f64> {
    printed.replace(',', "").parse().ok()
}

/// Number of digits after the decimal point of a printed number.
fn decimals(printed: &str) -> usize {
    let digits = printed.split_once('e').map_or(printed, |(digits, _)| digits);
    digits.split_once('.').map_or(0, |(_, decimals)| decimals.len())
}

/// `value` in the format of `printed`: with as many decimals, and with an exponent if it has one.
fn format_like(printed: &str, value: f64) -> String {
    let decimals = decimals(printed);
    if printed.contains('e') {
        return format!("{value:.decimals$e}");
    }
    let digits = format!("{value:.decimals$}");
    let integer_length = digits.find('.').unwrap_or(digits.len());
    let mut formatted = String::new();
    for (index, digit) in digits.char_indices() {
        let follows_digit = formatted.ends_with(|last: char| last.is_ascii_digit());
        if follows_digit && index < integer_length && (integer_length - index).is_multiple_of(3) {
            formatted.push(',');
        }
        formatted.push(digit);
    }
    formatted
}

/// Whether `printed` is `value`, rounded to the printed digits.
fn is_rounded(printed: &str, value: f64) -> bool {
    let exponent = printed.split_once('e').map_or("0", |(_, exponent)| exponent);
    let decimals = decimals(printed) as i32;
    let (Some(number), Ok(exponent)) = (parse_number(printed), exponent.parse::<i32>()) else { return false };
    let half_unit = 0.5 * 10_f64.powi(exponent - decimals);
    // A value in the middle may be rounded either way. The factor covers the rounding errors of this comparison.
    (number - value).abs() <= half_unit * (1.0 + 1e-6)
}

/// The number at a path, as [`FigureTable::selector`] describes it.
fn value_at(path: &str, records: &Records) -> Option<f64> {
    let (path, factor) = match path.split_once(" * ") {
        Some((path, factor)) => (path, factor.parse().ok()?),
        None => (path, 1.0),
    };
    let (file, path) = path.split_once('/')?;
    Some(factor * select(records.get(file)?, path)?.as_f64()?)
}

/// The value at a path within a record.
fn select<'a>(record: &'a Value, path: &str) -> Option<&'a Value> {
    path.split('/').try_fold(record, |value, segment| match value {
        Value::Array(elements) => match segment.parse::<usize>() {
            Ok(index) => elements.get(index),
            Err(_) => elements.iter().find(|element| {
                segment.split('&').all(|condition| {
                    condition.split_once('=').is_some_and(|(key, text)| element[key].as_str() == Some(text))
                })
            }),
        },
        value => value.get(segment),
    })
}

#[test]
fn finds_numbers_but_no_digits_of_words() {
    let cell = "f32 at 1,705.5 and 4.3e-5, 467, x2 12us 7";
    let numbers: Vec<&str> = number_ranges(cell, 0..cell.len()).into_iter().map(|range| &cell[range]).collect();
    assert_eq!(numbers, ["1,705.5", "4.3e-5", "467", "7"]);
}

#[test]
fn printed_number_must_be_the_rounded_value() {
    for (printed, value, expected) in [
        ("304", 303.8, true),
        ("304", 304.6, false),
        ("1,705", 1_705.2, true),
        ("1,705", 1_706.2, false),
        ("1.8e-7", 1.844e-7, true),
        ("1.8e-7", 1.86e-7, false),
        ("0.50", 0.5049, true),
        ("0.50", 0.52, false),
    ] {
        assert_eq!(is_rounded(printed, value), expected, "{printed} {value}");
    }
}

#[test]
fn selects_by_key_index_and_condition() {
    let record = serde_json::json!({"rows": [{"a": "x", "b": "y", "n": 1}, {"a": "x", "b": "z, 1 %", "n": [2, 3]}]});
    let records = Records::from([("a.json".to_owned(), record)]);
    let number = |path: &str| value_at(path, &records);
    assert_eq!(number("a.json/rows/a=x&b=z, 1 %/n/1"), Some(3.0));
    assert_eq!(number("a.json/rows/a=x/n * 1e-3"), Some(1e-3));
    assert_eq!((number("a.json/rows/a=q/n"), number("a.json/rows/2/n"), number("a.json/absent")), (None, None, None));
    assert_eq!((number("b.json/rows/a=x/n"), number("a.json/rows/a=x/n * x")), (None, None));
}
