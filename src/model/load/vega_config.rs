//! Converts Vega's files next to a model (`NAME.config`, `NAME.cub`) to notes for simulations.

use std::collections::BTreeMap;

use super::asset_dir::{AssetDir, EntryKind, MAX_TEXT_BYTES};
use crate::error::{Result, invalid};

/// Numeric entries of a configuration that describe the dynamics.
const KEYS: [&str; 4] = ["baseFrequency", "deformableObjectCompliance", "dampingMassCoef", "dampingStiffnessCoef"];

/// Notes on the OBJ file `name`: entries such as `vega.baseFrequency`, and `vega.cubic`, the name of the file with the
/// cubic force polynomials.
///
/// # Errors
/// `Invalid` with the file and the entry that is not a finite number.
pub(super) fn notes(files: &AssetDir, name: &str) -> Result<BTreeMap<String, String>> {
    let stem = name.strip_suffix(".obj").unwrap_or(name);
    let mut notes = BTreeMap::new();
    let cubic = format!("{stem}.cub");
    if files.kind(&cubic)? == Some(EntryKind::File) {
        notes.insert("vega.cubic".to_owned(), cubic);
    }
    let config = format!("{stem}.config");
    if files.kind(&config)? != Some(EntryKind::File) {
        return Ok(notes);
    }
    let bytes = files.read(&config, MAX_TEXT_BYTES)?;
    for (key, value) in entries(&String::from_utf8_lossy(&bytes)) {
        if KEYS.contains(&key) {
            if !value.parse::<f64>().is_ok_and(f64::is_finite) {
                return Err(invalid(format!("file '{config}': {key}"), "a finite number", value));
            }
            notes.insert(format!("vega.{key}"), value.to_owned());
        }
    }
    Ok(notes)
}

/// Pairs of a line `*key` and the line after it, which is its value.
fn entries(text: &str) -> impl Iterator<Item = (&str, &str)> {
    let lines: Vec<&str> =
        text.lines().map(str::trim).filter(|line| !line.is_empty() && !line.starts_with('#')).collect();
    (0..lines.len())
        .filter_map(move |index| Some((lines[index].strip_prefix('*')?, lines.get(index + 1).copied().unwrap_or(""))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_numbers_of_the_dynamics_and_the_cubic_file_become_notes() {
        let folder = tempfile::tempdir().expect("a folder");
        let files = AssetDir::unrestricted(folder.path());
        assert!(notes(&files, "a.obj").expect("nothing there").is_empty());
        let config = folder.path().join("a.config");
        std::fs::write(&config, "*baseFrequency\r\n0.25\n\n*windowWidth\n800\n*dampingMassCoef\n").expect("written");
        let refusal = notes(&files, "a.obj").expect_err("no value").to_string();
        assert_eq!(refusal, "file 'a.config': dampingMassCoef: expected a finite number, got ");
        std::fs::write(&config, "*baseFrequency\n0.25\n*windowWidth\n800\n").expect("written");
        std::fs::write(folder.path().join("a.cub"), "").expect("written");
        let found: Vec<_> = notes(&files, "a.obj").expect("good").into_iter().collect();
        let pair = |key: &str, value: &str| (key.to_owned(), value.to_owned());
        assert_eq!(found, [pair("vega.baseFrequency", "0.25"), pair("vega.cubic", "a.cub")]);
    }
}
