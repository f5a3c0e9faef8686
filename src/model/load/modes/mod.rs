//! Loaders of the modal matrix U: 3n rows, r columns, f32.

mod npy;
mod safetensors;
mod sofa;
mod vega;

pub use npy::{NpyArray, parse as parse_numpy};

use super::asset_dir::{AssetDir, EntryKind, MAX_MODEL_BYTES};
use crate::domain::Modes;
use crate::error::{Result, invalid};

/// Endings of mode files in order of preference: binary files before text, which has fewer digits.
const EXTENSIONS: [&str; 5] = [".URendering.float", ".U.float", ".npy", ".safetensors", "modes.txt"];

/// Reads the modes in `name`. The extension determines the format.
///
/// # Errors
/// `Invalid` with the file, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str) -> Result<Modes> {
    let parse = match name.rsplit_once('.').map(|(_, ending)| ending) {
        Some("float" | "double" | "U") => vega::parse,
        Some("npy") => parse_npy,
        Some("safetensors") => safetensors::parse,
        Some("txt") => sofa::parse,
        _ => return Err(invalid("modes", "a file ending in .float, .double, .U, .npy, .safetensors or .txt", name)),
    };
    parse(&files.read(name, MAX_MODEL_BYTES)?).map_err(|error| error.prefix_field(&format!("file '{name}'")))
}

fn parse_npy(bytes: &[u8]) -> Result<Modes> {
    let array = npy::parse(bytes)?;
    let [rows, rank] = array.shape[..] else {
        return Err(invalid("shape", "two dimensions, 3n x r", format!("{:?}", array.shape)));
    };
    match array.fortran_order {
        true => Modes::from_columns(rows, rank, array.entries),
        false => Modes::from_rows(rows, rank, &array.entries),
    }
}

/// Finds the modes of the OBJ file `name` in its folder, if any.
///
/// The candidates have its name (without `.obj` and `.derived`), optionally `.U`, and one of the first four
/// [`EXTENSIONS`], in that order. If the folder has no other OBJ file, any file with one of the [`EXTENSIONS`] is accepted,
/// in that order too.
///
/// # Errors
/// `Invalid` with the candidates if two files have the same ending.
pub(super) fn find_sidecar(files: &AssetDir, name: &str) -> Result<Option<String>> {
    let stem = name.strip_suffix(".obj").unwrap_or(name);
    let stem = stem.strip_suffix(".derived").unwrap_or(stem);
    for ending in &EXTENSIONS[..4] {
        for middle in ["", ".U"] {
            let candidate = format!("{stem}{middle}{ending}");
            if files.kind(&candidate)? == Some(EntryKind::File) {
                return Ok(Some(candidate));
            }
        }
    }
    let names: Vec<_> =
        files.entries().into_iter().filter(|(_, kind)| *kind == EntryKind::File).map(|(name, _)| name).collect();
    if names.iter().filter(|name| name.ends_with(".obj")).count() != 1 {
        return Ok(None);
    }
    for ending in EXTENSIONS {
        // `q.npy` and `*.q.npy` contain coordinates, not modes.
        let fits = |name: &&String| name.ends_with(ending) && *name != "q.npy" && !name.ends_with(".q.npy");
        let found: Vec<&String> = names.iter().filter(fits).collect();
        match found[..] {
            [] => {}
            [one] => return Ok(Some(one.clone())),
            _ => {
                let given = found.iter().map(|name| name.as_str()).collect::<Vec<_>>().join(", ");
                return Err(invalid("modes", format!("one file ending in {ending}"), given));
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn found(names: &[&str], obj: &str) -> Result<Option<String>> {
        let folder = tempfile::tempdir().expect("a folder");
        for name in names {
            std::fs::write(folder.path().join(name), "").expect("written");
        }
        find_sidecar(&AssetDir::unrestricted(folder.path()), obj)
    }

    #[test]
    fn modes_of_a_files_own_name_come_first_and_binary_before_text() {
        for (names, expected) in [
            (&["a.obj", "a.URendering.float", "a.U.float", "modes.txt"][..], Some("a.URendering.float")),
            (&["a.obj", "a.U.float", "modes.txt"], Some("a.U.float")),
            (&["a.obj", "b.obj", "a.U.npy", "b.npy"], Some("a.U.npy")),
            (&["a.obj", "modes.txt", "q.npy", "a.q.npy"], Some("modes.txt")),
            (&["a.obj", "other.safetensors", "modes.txt"], Some("other.safetensors")),
            (&["a.obj", "b.obj", "modes.txt"], None),
            (&["a.obj", "a.mtl"], None),
        ] {
            assert_eq!(found(names, "a.obj").expect("clear").as_deref(), expected, "{names:?}");
        }
        assert_eq!(
            found(&["a.derived.obj", "a.U.float"], "a.derived.obj").expect("clear").as_deref(),
            Some("a.U.float")
        );
    }

    #[test]
    fn two_candidates_of_one_ending_are_refused_by_name() {
        let refusal = found(&["a.obj", "x.npy", "y.npy"], "a.obj").expect_err("ambiguous").to_string();
        assert_eq!(refusal, "modes: expected one file ending in .npy, got x.npy, y.npy");
    }

    #[test]
    fn an_unknown_ending_is_refused_before_anything_is_read() {
        let refusal =
            read(&AssetDir::unrestricted(std::path::Path::new(".")), "u.mat").expect_err("unknown").to_string();
        assert!(refusal.ends_with(".npy, .safetensors or .txt, got u.mat"), "{refusal}");
    }
}
