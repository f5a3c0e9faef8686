//! Reads `records.toml`.

use serde::Deserialize;

use crate::figure_table::FigureTable;

/// The content of `records.toml`.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RecordIndex {
    #[serde(rename = "record")]
    pub(crate) records: Vec<RecordEntry>,
    #[serde(rename = "table")]
    pub(crate) tables: Vec<FigureTable>,
}

/// A recorded measurement.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RecordEntry {
    /// Name of the file in `records`.
    pub(crate) file: String,
    /// The command that makes it.
    pub(crate) command: String,
    /// The files and folders that it measures, relative to the root of the working tree.
    pub(crate) sources: Vec<String>,
    /// Hash of the sources when it was made; empty if that is not known. `tests/bench/record` reads it.
    #[serde(rename = "hash")]
    _hash: String,
}

impl RecordIndex {
    pub(crate) fn read() -> Self {
        let text = crate::read("tests/bench/records/records.toml");
        toml::from_str(&text).unwrap_or_else(|error| panic!("expected a valid index: {error}"))
    }
}
