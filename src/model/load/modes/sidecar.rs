//! Finds the modes of a mesh by file name. [`NAMES`] states the rule. Other files of the folder are never read as
//! modes.

use std::collections::HashMap;

use super::npz::lacks_modes;
use crate::error::Result;
use crate::load::asset_dir::{AssetDir, EntryKind, stem_of};
use crate::load::folder_listing::{FolderListing, ModesNames};
use crate::load::source::{find_model, find_models};

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
/// skipped, because its U belongs to that mesh. An archive without U is skipped unless its name says that it has modes,
/// because many programs write other data under the name of the model.
///
/// # Errors
/// `Invalid` for a name that leaves the root of the repository.
pub(in crate::load) fn find_sidecar(files: &AssetDir, name: &str) -> Result<Sidecar> {
    let listing = files.listing();
    let names = listing.modes_names(|| collect_names(files, &listing));
    let stem = model_stem(name);
    let mut candidates: Vec<String> = ENDINGS.iter().map(|ending| format!("{stem}{ending}")).collect();
    if names.models.iter().all(|model| model == name) {
        candidates.extend(GENERIC_NAMES.map(str::to_owned));
    }
    let mut file = None;
    for candidate in candidates.iter().filter(|candidate| *candidate != name) {
        let found = match files.kind(candidate)? {
            Some(EntryKind::File) => Some(candidate.as_str()),
            _ => listing.names_ignoring_case(candidate, EntryKind::File).find(|other| *other != name),
        };
        let is_used = |found: &&str| find_model(files, found).is_none() && !is_unrelated_archive(files, found);
        file = found.filter(is_used).map(str::to_owned);
        if file.is_some() {
            break;
        }
    }
    Ok(Sidecar { remark: unused_remark(names, name, file.as_deref()), file })
}

/// Whether a file is a NumPy archive without U whose name does not say that it has modes.
fn is_unrelated_archive(files: &AssetDir, name: &str) -> bool {
    let lower_case = name.to_ascii_lowercase();
    let stem = lower_case.strip_suffix(".npz");
    let says_modes = |stem: &str| matches!(stem.rsplit('.').next(), Some("u" | "modes"));
    stem.is_some_and(|stem| !says_modes(stem)) && lacks_modes(files, name)
}

/// Collects the names of a folder for the search for modes.
fn collect_names(files: &AssetDir, listing: &FolderListing) -> ModesNames {
    let models = find_models(files).into_iter().map(|model| model.name().to_owned()).collect();
    let mut names = ModesNames { models, ..ModesNames::default() };
    let mut models_by_stem: HashMap<&str, Vec<&str>> = HashMap::new();
    for name in listing.file_names() {
        if find_model(files, name).is_some() {
            models_by_stem.entry(model_stem(name)).or_default().push(name);
        }
    }
    for name in listing.file_names().filter(|name| looks_like_modes(name) && find_model(files, name).is_none()) {
        let stems = name.match_indices('.').map(|(dot, _)| &name[..dot]);
        let claims: Vec<&str> = stems.filter_map(|stem| models_by_stem.get(stem)).flatten().copied().collect();
        match claims[..] {
            [] => names.unclaimed.push(name.to_owned()),
            [model] => names.claimed.entry(model.to_owned()).or_default().push(name.to_owned()),
            _ => {}
        }
    }
    names
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

/// A remark on the files that look like modes of the model `name` but are not used. `file` has its modes.
fn unused_remark(names: &ModesNames, name: &str, file: Option<&str>) -> Option<String> {
    let lists = [&names.unclaimed[..], names.claimed.get(name).map_or(&[], Vec::as_slice)];
    let is_unused = |other: &&String| *other != name && Some(other.as_str()) != file;
    let mut listed: Vec<&str> = lists
        .iter()
        .flat_map(|list| list.iter().filter(is_unused).take(MAX_LISTED_NAMES).map(String::as_str))
        .collect();
    listed.sort_unstable();
    listed.truncate(MAX_LISTED_NAMES);
    let used = [Some(name), file].into_iter().flatten();
    let is_in_lists = |name: &&str| lists.iter().any(|list| list.binary_search_by(|other| (**other).cmp(name)).is_ok());
    let count = lists.iter().map(|list| list.len()).sum::<usize>() - used.filter(is_in_lists).count();
    if count == 0 {
        return None;
    }
    let more = match count - listed.len() {
        0 => String::new(),
        count => format!(" and {count} more"),
    };
    let hint = if file.is_some() { String::new() } else { format!(": {NAMES}") };
    Some(format!("not used as modes: {}{more}{hint}", listed.join(", ")))
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
        // Archives of other programs without U.
        let other = find(&["triangles", "vertex_colors"], &["a.stl", "a.npz"]);
        assert_eq!(other.file, None);
        assert!(other.remark.expect("a remark").starts_with("not used as modes: a.npz: the modes of MODEL are in"));
        for name in ["a.U.npz", "modes.npz"] {
            let named = find(&["triangles", "vertex_colors"], &["a.stl", name]);
            assert_eq!(
                named.file.as_deref(),
                Some(name),
                "its name says that it has modes, so that their lack is an error"
            );
        }
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
