//! The recorded measurements: each has an entry in `records.toml` and the reverse, the figures in tables of the documents
//! are those of the records, and `tests/bench/record` finds records whose sources have changed.

mod figure_table;
mod record_index;
mod record_program;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use figure_table::Records;
use record_index::RecordIndex;

/// The root of the working tree.
fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../..")
}

fn read(path: &str) -> String {
    std::fs::read_to_string(root().join(path)).unwrap_or_else(|error| panic!("{path}: {error}"))
}

fn read_records(index: &RecordIndex) -> Records {
    let read_record = |file: &String| {
        (file.clone(), serde_json::from_str(&read(&format!("tests/bench/records/{file}"))).expect("expected JSON"))
    };
    index.records.iter().map(|record| read_record(&record.file)).collect()
}

#[test]
fn every_record_has_an_entry_and_every_entry_a_file() {
    let folder = std::fs::read_dir(root().join("tests/bench/records")).expect("expected a folder");
    let names = folder.map(|entry| entry.expect("readable").file_name().into_string().expect("UTF-8"));
    let files: BTreeSet<String> = names.filter(|name| name.ends_with(".json")).collect();
    let index = RecordIndex::read();
    let entries: BTreeSet<String> = index.records.iter().map(|record| record.file.clone()).collect();
    assert_eq!(files, entries);
    assert_eq!(entries.len(), index.records.len(), "expected one entry per record");
    for record in &index.records {
        assert!(!record.command.is_empty(), "{}: expected a command", record.file);
        for source in &record.sources {
            assert!(root().join(source).exists(), "{}: expected the source {source}", record.file);
        }
    }
}

/// With the environment variable `UPDATE_FIGURES`, the figures of the records are written into the tables. The control
/// below may then read a document while it is written; run this test alone.
#[test]
fn figures_of_tables_are_those_of_the_records() {
    let index = RecordIndex::read();
    let records = read_records(&index);
    if std::env::var_os("UPDATE_FIGURES").is_some() {
        for table in &index.tables {
            let updated = table.update(&read(&table.document), &records).expect("expected a table and its values");
            std::fs::write(root().join(&table.document), updated).expect("expected a writable document");
        }
        return;
    }
    let mismatches: Vec<String> =
        index.tables.iter().flat_map(|table| table.mismatches(&read(&table.document), &records)).collect();
    assert!(mismatches.is_empty(), "{}", mismatches.join("\n"));
}

/// The control of the test above: each figure of each table is changed, one at a time.
#[test]
fn a_changed_figure_is_a_mismatch() {
    let index = RecordIndex::read();
    let records = read_records(&index);
    for table in index.tables {
        let document = read(&table.document);
        let positions = table.digit_positions(&document);
        assert!(!positions.is_empty(), "{}: expected figures", table.document);
        for position in positions {
            let mut changed = document.clone().into_bytes();
            // A change by 5 units, because a value in the middle of two figures may be rounded to either.
            changed[position] = b'0' + (changed[position] - b'0' + 5) % 10;
            let changed = String::from_utf8(changed).expect("a digit is replaced by a digit");
            let mismatches = table.mismatches(&changed, &records);
            assert_eq!(mismatches.len(), 1, "{}: byte {position}: {mismatches:?}", table.document);
            let updated = table.update(&changed, &records).expect("expected a table and its values");
            assert!(table.mismatches(&updated, &records).is_empty(), "{}: byte {position}", table.document);
        }
    }
}
