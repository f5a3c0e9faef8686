//! Loaders of the modal matrix U: 3n rows for n vertices, r columns for r modes, f32.

mod npy;
mod safetensors;
mod sofa;
mod vega;

pub use npy::{NpyArray, parse as parse_numpy};

use super::asset_dir::{AssetDir, EntryKind, MAX_MODEL_BYTES};
use crate::domain::Modes;
use crate::error::{Result, invalid};

/// Name endings of mode files in order of preference: binary files before text files, which have fewer digits. The
/// first four can follow the name of an OBJ file; `modes.txt` is SOFA's name.
const NAME_ENDINGS: [&str; 5] = [".URendering.float", ".U.float", ".npy", ".safetensors", "modes.txt"];

/// Reads the modes in the file `name`. The extension determines the format.
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
/// A file belongs to the OBJ file if its name consists of the OBJ file's name (without `.obj` and `.derived`),
/// optionally `.U`, and one of the first four [`NAME_ENDINGS`]. If there is no such file and no other OBJ file in the
/// folder, any file with one of the [`NAME_ENDINGS`] is accepted. The order of the endings decides between several
/// files.
///
/// # Errors
/// `Invalid` with the candidates if several files have the same ending.
pub(super) fn find_sidecar(files: &AssetDir, name: &str) -> Result<Option<String>> {
    let stem = name.strip_suffix(".obj").unwrap_or(name);
    let stem = stem.strip_suffix(".derived").unwrap_or(stem);
    for ending in &NAME_ENDINGS[..4] {
        for infix in ["", ".U"] {
            let candidate = format!("{stem}{infix}{ending}");
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
    for ending in NAME_ENDINGS {
        // `q.npy` and `*.q.npy` contain coordinates, not modes.
        let is_candidate = |name: &&String| name.ends_with(ending) && *name != "q.npy" && !name.ends_with(".q.npy");
        let candidates: Vec<&String> = names.iter().filter(is_candidate).collect();
        match candidates[..] {
            [] => {}
            [candidate] => return Ok(Some(candidate.clone())),
            _ => {
                let given = candidates.iter().map(|name| name.as_str()).collect::<Vec<_>>().join(", ");
                return Err(invalid("modes", format!("one file ending in {ending}"), given));
            }
        }
    }
    Ok(None)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn find_sidecar_among(names: &[&str], obj_name: &str) -> Result<Option<String>> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for name in names {
            std::fs::write(folder.path().join(name), "").expect("a writable file");
        }
        find_sidecar(&AssetDir::unrestricted(folder.path()), obj_name)
    }

    #[test]
    fn find_sidecar_prefers_same_name_and_binary_files() {
        for (names, expected) in [
            (&["a.obj", "a.URendering.float", "a.U.float", "modes.txt"][..], Some("a.URendering.float")),
            (&["a.obj", "a.U.float", "modes.txt"], Some("a.U.float")),
            (&["a.obj", "b.obj", "a.U.npy", "b.npy"], Some("a.U.npy")),
            (&["a.obj", "modes.txt", "q.npy", "a.q.npy"], Some("modes.txt")),
            (&["a.obj", "other.safetensors", "modes.txt"], Some("other.safetensors")),
            (&["a.obj", "b.obj", "modes.txt"], None),
            (&["a.obj", "a.mtl"], None),
        ] {
            assert_eq!(
                find_sidecar_among(names, "a.obj").expect("at most one candidate").as_deref(),
                expected,
                "{names:?}"
            );
        }
        assert_eq!(
            find_sidecar_among(&["a.derived.obj", "a.U.float"], "a.derived.obj")
                .expect("at most one candidate")
                .as_deref(),
            Some("a.U.float")
        );
    }

    #[test]
    fn several_files_with_one_ending_are_rejected() {
        let message =
            find_sidecar_among(&["a.obj", "x.npy", "y.npy"], "a.obj").expect_err("two candidates").to_string();
        assert_eq!(message, "modes: expected one file ending in .npy, got x.npy, y.npy");
    }

    #[test]
    fn unknown_ending_is_rejected_before_reading() {
        let message = read(&AssetDir::unrestricted(std::path::Path::new(".")), "u.mat")
            .expect_err("an unknown ending")
            .to_string();
        assert!(message.ends_with(".npy, .safetensors or .txt, got u.mat"), "{message}");
    }
}
