//! What Vega keeps beside a model (`NAME.config`, `NAME.cub`) to notes that are handed on to physics processes.

use std::collections::BTreeMap;

use super::files::{Files, Kind, TEXT_BYTES};
use crate::error::{Result, invalid};

/// Entries of a configuration that describe the dynamics; each is a number.
const KEYS: [&str; 4] = ["baseFrequency", "deformableObjectCompliance", "dampingMassCoef", "dampingStiffnessCoef"];

/// Notes on the OBJ file `name`: `vega.baseFrequency` and the like, and `vega.cubic`, the name of the file of cubic forces.
///
/// # Errors
/// `Invalid` naming file and entry when one of them is no number.
pub(super) fn notes(files: &Files, name: &str) -> Result<BTreeMap<String, String>> {
    let stem = name.strip_suffix(".obj").unwrap_or(name);
    let mut notes = BTreeMap::new();
    let cubic = format!("{stem}.cub");
    if files.kind(&cubic)? == Some(Kind::File) {
        notes.insert("vega.cubic".to_owned(), cubic);
    }
    let config = format!("{stem}.config");
    if files.kind(&config)? != Some(Kind::File) {
        return Ok(notes);
    }
    let bytes = files.read(&config, TEXT_BYTES)?;
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

/// A line `*key`, then a line with its value.
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
        let files = Files::anywhere(folder.path());
        assert!(notes(&files, "a.obj").expect("nothing there").is_empty());
        let config = folder.path().join("a.config");
        std::fs::write(&config, "*baseFrequency\r\n0.25\n\n*windowWidth\n800\n*dampingMassCoef\n").expect("written");
        let refusal = notes(&files, "a.obj").expect_err("no value").to_string();
        assert_eq!(refusal, "file 'a.config': dampingMassCoef: expected a finite number, given ");
        std::fs::write(&config, "*baseFrequency\n0.25\n*windowWidth\n800\n").expect("written");
        std::fs::write(folder.path().join("a.cub"), "").expect("written");
        let found: Vec<_> = notes(&files, "a.obj").expect("good").into_iter().collect();
        let pair = |key: &str, value: &str| (key.to_owned(), value.to_owned());
        assert_eq!(found, [pair("vega.baseFrequency", "0.25"), pair("vega.cubic", "a.cub")]);
    }
}
