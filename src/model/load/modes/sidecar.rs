//! Finds the modes of a mesh by file name. [`NAMES`] states the rule. Other files of the folder are never read as
//! modes.

use crate::error::Result;
use crate::load::asset_dir::{AssetDir, EntryKind, stem_of};
use crate::load::source::{find_model, find_models, recognize_model};

/// The rule in words, for remarks.
const NAMES: &str = "the modes of MODEL are in MODEL.U.npy, MODEL.npy, MODEL.U.float or another name of the reference \
                     of scene.toml, or in the file of the key `modes`";

/// Endings of the names of mode files, after the name of the model, in order of preference. Vega's files for the
/// rendered mesh come before its other files. Binary files come before text files, which have fewer digits.
const ENDINGS: [&str; 13] = [
    ".URendering.float",
    ".U.float",
    ".U",
    ".U.npy",
    ".modes.npy",
    ".npy",
    ".U.npz",
    ".modes.npz",
    ".npz",
    ".U.safetensors",
    ".modes.safetensors",
    ".safetensors",
    ".modes.txt",
];

/// Names of mode files in a folder with one model, in order of preference. `modes.txt` is SOFA's name.
const GENERIC_NAMES: [&str; 8] =
    ["U.float", "U.npy", "modes.npy", "U.npz", "modes.npz", "U.safetensors", "modes.safetensors", "modes.txt"];

/// The largest number of names in a remark.
const MAX_LISTED_NAMES: usize = 8;

/// The result of a search for modes.
#[derive(Debug, Default, PartialEq)]
pub(in crate::load) struct Sidecar {
    /// The name of the file; `None` if no name follows the rule.
    pub(in crate::load) file: Option<String>,
    /// Names the files of the folder that look like modes but are not used.
    pub(in crate::load) remark: Option<String>,
}

/// Finds the modes of the model `name` in its folder. A name consists of the name of the model, without extension and
/// without `.derived`, and one of [`ENDINGS`]. If no file has such a name and the folder has no other model, the
/// [`GENERIC_NAMES`] are tried. Letter case is ignored, unless a file has the exact name. A NumPy archive with a mesh is
/// not used, because it is a model, whose U has the rows of its own vertices.
///
/// # Errors
/// `Invalid` for a name that leaves the root of the repository.
pub(in crate::load) fn find_sidecar(files: &AssetDir, name: &str) -> Result<Sidecar> {
    let names = files.file_names();
    let stem = model_stem(name);
    let mut candidates: Vec<String> = ENDINGS.iter().map(|ending| format!("{stem}{ending}")).collect();
    let other_stems: Vec<&str> = names
        .iter()
        .filter(|other| *other != name && recognize_model(other).is_some())
        .map(|other| model_stem(other))
        .collect();
    if find_models(files).iter().all(|model| model.name() == name) {
        candidates.extend(GENERIC_NAMES.map(str::to_owned));
    }
    let is_model = |name: &str| find_model(files, name).is_some();
    let mut file = None;
    for candidate in candidates.iter().filter(|candidate| *candidate != name) {
        let found = match files.kind(candidate)? {
            Some(EntryKind::File) => Some(candidate.clone()),
            _ => names.iter().find(|other| other.eq_ignore_ascii_case(candidate) && *other != name).cloned(),
        };
        file = found.filter(|found| !is_model(found));
        if file.is_some() {
            break;
        }
    }
    let belongs_to_other = |candidate: &str| {
        other_stems.iter().any(|other| candidate.strip_prefix(other).is_some_and(|ending| ending.starts_with('.')))
    };
    let unused: Vec<&str> = names
        .iter()
        .map(String::as_str)
        .filter(|other| *other != name && Some(*other) != file.as_deref())
        .filter(|other| looks_like_modes(other) && !belongs_to_other(other) && !is_model(other))
        .collect();
    Ok(Sidecar { remark: unused_remark(&unused, file.is_some()), file })
}

/// The name of a model in the names of its mode files.
fn model_stem(name: &str) -> &str {
    let stem = stem_of(name);
    stem.strip_suffix(".derived").unwrap_or(stem)
}

/// Whether the name ends like that of a file with modes. Files of coordinates, `q.npy` and `*.q.npy`, are excluded.
fn looks_like_modes(name: &str) -> bool {
    let name = name.to_ascii_lowercase();
    let has_ending = [".npy", ".npz", ".safetensors", ".float", ".double", ".u"].iter().any(|end| name.ends_with(end));
    (has_ending || name.ends_with("modes.txt")) && name != "q.npy" && !name.ends_with(".q.npy")
}

fn unused_remark(unused: &[&str], has_modes: bool) -> Option<String> {
    if unused.is_empty() {
        return None;
    }
    let more = match unused.len().saturating_sub(MAX_LISTED_NAMES) {
        0 => String::new(),
        count => format!(" and {count} more"),
    };
    let listed = unused.iter().take(MAX_LISTED_NAMES).copied().collect::<Vec<_>>().join(", ");
    let hint = if has_modes { String::new() } else { format!(": {NAMES}") };
    Some(format!("not used as modes: {listed}{more}{hint}"))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn find_among(names: &[&str], model: &str) -> Sidecar {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for name in names {
            std::fs::write(folder.path().join(name), "").expect("a writable file");
        }
        find_sidecar(&AssetDir::unrestricted(folder.path()), model).expect("names in the folder")
    }

    #[test]
    fn modes_are_found_by_the_name_of_the_model() {
        for (names, model, expected) in [
            (&["a.obj", "a.URendering.float", "a.U.float", "modes.txt"][..], "a.obj", Some("a.URendering.float")),
            (&["a.obj", "a.U.float", "modes.txt"], "a.obj", Some("a.U.float")),
            (&["a.obj", "b.obj", "a.U.npy", "b.npy"], "a.obj", Some("a.U.npy")),
            (&["a.obj", "a.npy", "a.U.npy"], "a.obj", Some("a.U.npy")),
            (&["a.obj", "a.U"], "a.obj", Some("a.U")),
            (&["X.OBJ", "X.U.npy"], "X.OBJ", Some("X.U.npy")),
            (&["X.OBJ", "x.u.NPY"], "X.OBJ", Some("x.u.NPY")),
            (&["a.derived.obj", "a.U.float"], "a.derived.obj", Some("a.U.float")),
            (&["a.obj", "modes.txt", "q.npy", "a.q.npy"], "a.obj", Some("modes.txt")),
            (&["a.obj", "U.npy", "modes.txt"], "a.obj", Some("U.npy")),
            // With several models, a generic name does not say which model the modes belong to.
            (&["a.obj", "b.OBJ", "modes.txt"], "a.obj", None),
            (&["a.obj", "a.mtl"], "a.obj", None),
        ] {
            assert_eq!(find_among(names, model).file.as_deref(), expected, "{names:?}");
        }
    }

    #[test]
    fn archive_with_a_mesh_is_a_model_and_has_no_modes_for_others() {
        use crate::load::modes::test_archives::{archive, npy};
        let column = npy(&ndarray::arr2(&[[1.0_f32], [2.0], [3.0]]));
        let find = |arrays: &[&str], names: &[&str]| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            let arrays: Vec<_> = arrays.iter().map(|name| (*name, column.clone())).collect();
            let bytes = archive(&arrays, zip::CompressionMethod::Deflated);
            for name in names {
                let content = if name.ends_with(".npz") { &bytes[..] } else { &[] };
                std::fs::write(folder.path().join(name), content).expect("a writable file");
            }
            find_sidecar(&AssetDir::unrestricted(folder.path()), "a.stl").expect("names in the folder")
        };
        let mesh_and_modes = ["vertices", "faces", "U"];
        assert_eq!(find(&mesh_and_modes, &["a.stl", "a.npz", "modes.npz"]), Sidecar::default());
        let other = find(&mesh_and_modes, &["a.stl", "a.npz", "a.modes.txt"]);
        assert_eq!(other, Sidecar { file: Some("a.modes.txt".into()), remark: None });
        // Control: an archive without a mesh.
        assert_eq!(find(&["U", "vertices"], &["a.stl", "a.npz"]).file.as_deref(), Some("a.npz"));
        assert_eq!(find(&["U"], &["a.stl", "modes.npz"]).file.as_deref(), Some("modes.npz"));
    }

    #[test]
    fn unrelated_arrays_are_not_modes_and_are_named() {
        let one = find_among(&["a.obj", "pressure.npy"], "a.obj");
        assert_eq!(one.file, None, "expected no guess, even if the array has a fitting shape");
        assert!(
            one.remark.expect("a remark").starts_with("not used as modes: pressure.npy: the modes of MODEL are in")
        );
        let four = find_among(&["a.obj", "1.npy", "2.npy", "3.npy", "4.safetensors"], "a.obj");
        assert_eq!(four.file, None);
        assert!(four.remark.expect("a remark").contains("1.npy, 2.npy, 3.npy, 4.safetensors"));
        let beside = find_among(&["a.obj", "a.U.npy", "other.npy", "b.ply", "b.npy", "q.npy"], "a.obj");
        assert_eq!(beside.remark.as_deref(), Some("not used as modes: other.npy"), "expected no file of model b");
        let many: Vec<String> = (10..30).map(|index| format!("{index}.npy")).chain(["a.obj".into()]).collect();
        let many: Vec<&str> = many.iter().map(String::as_str).collect();
        assert!(find_among(&many, "a.obj").remark.expect("a remark").contains("17.npy and 12 more"));
    }
}
