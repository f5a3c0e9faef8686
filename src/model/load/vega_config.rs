//! Reads notes (named values that clients can query) from Vega's files next to a model: `NAME.config`, `NAME.cub`.

use std::collections::BTreeMap;

use super::asset_dir::{AssetDir, EntryKind, MAX_TEXT_BYTES, stem_of};
use crate::error::{Result, invalid};

/// Numeric entries of a configuration that describe the dynamics.
const DYNAMICS_KEYS: [&str; 4] =
    ["baseFrequency", "deformableObjectCompliance", "dampingMassCoef", "dampingStiffnessCoef"];

/// Reads the notes on the OBJ file `name`: entries such as `vega.baseFrequency`, and the entry `vega.cubic`, which is
/// the name of the file with the cubic polynomials of the reduced internal forces.
///
/// # Errors
/// `Invalid` with the file and the entry that is not a finite number.
pub(super) fn read_notes(files: &AssetDir, name: &str) -> Result<BTreeMap<String, String>> {
    let stem = stem_of(name);
    let mut notes = BTreeMap::new();
    let cubic_file = format!("{stem}.cub");
    if files.kind(&cubic_file)? == Some(EntryKind::File) {
        notes.insert("vega.cubic".to_owned(), cubic_file);
    }
    let config_file = format!("{stem}.config");
    if files.kind(&config_file)? != Some(EntryKind::File) {
        return Ok(notes);
    }
    let bytes = files.read(&config_file, MAX_TEXT_BYTES)?;
    for (key, value) in parse_entries(&String::from_utf8_lossy(&bytes)) {
        if DYNAMICS_KEYS.contains(&key) {
            if !value.parse::<f64>().is_ok_and(f64::is_finite) {
                return Err(invalid(format!("file '{config_file}': {key}"), "a finite number", value));
            }
            notes.insert(format!("vega.{key}"), value.to_owned());
        }
    }
    Ok(notes)
}

/// The entries of a configuration: a line `*key`, then a line with its value.
fn parse_entries(text: &str) -> impl Iterator<Item = (&str, &str)> {
    let lines: Vec<&str> =
        text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#')).collect();
    (0..lines.len())
        .filter_map(move |index| Some((lines[index].strip_prefix('*')?, lines.get(index + 1).copied().unwrap_or(""))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dynamics_entries_and_cubic_file_become_notes() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let files = AssetDir::unrestricted(folder.path());
        assert!(read_notes(&files, "a.obj").expect("no notes").is_empty());
        let config = folder.path().join("a.config");
        // The last entry has no value.
        std::fs::write(&config, "*baseFrequency\r\n0.25\n\n*windowWidth\n800\n*dampingMassCoef\n")
            .expect("a writable file");
        let message = read_notes(&files, "a.obj").expect_err("a missing value").to_string();
        assert_eq!(message, "file 'a.config': dampingMassCoef: expected a finite number, got ");
        std::fs::write(&config, "*baseFrequency\n0.25\n*windowWidth\n800\n").expect("a writable file");
        std::fs::write(folder.path().join("a.cub"), "").expect("a writable file");
        let notes: Vec<_> = read_notes(&files, "a.obj").expect("valid notes").into_iter().collect();
        let pair = |key: &str, value: &str| (key.to_owned(), value.to_owned());
        assert_eq!(notes, [pair("vega.baseFrequency", "0.25"), pair("vega.cubic", "a.cub")]);
    }
}
