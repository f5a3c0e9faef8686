//! Finds a file of modes that `modalcast model` computed from a surface and wrote beside it.

use std::io::Read;

use sha2::{Digest, Sha256};

use super::npz::{find_notes, has_arrays};
use crate::load::asset_dir::{AssetDir, stem_of};
use crate::load::file_hashes::hex;

/// The note with the SHA-256 hash of the file from which modes were computed, in hexadecimal digits.
const SOURCE_HASH_NOTE: &str = "modes.source_sha256";

/// A remark if `MODEL.npz` has modes that were computed from the surface `name`, which has none. Reads only the notes of
/// the archive, and the surface if the archive has the note [`SOURCE_HASH_NOTE`].
pub(in crate::load) fn computed_modes_remark(files: &AssetDir, name: &str) -> Option<String> {
    let archive = format!("{}.npz", stem_of(name));
    let noted_hash = find_notes(files, &archive).remove(SOURCE_HASH_NOTE)?;
    let is_made_from_this = has_arrays(files, &archive, &["vertices", "faces", "U"])
        && file_hash(files, name).is_some_and(|hash| hash.eq_ignore_ascii_case(&noted_hash));
    is_made_from_this
        .then(|| format!("{archive} was made from this file and has modes: open {archive} to see the part move"))
}

/// The SHA-256 hash of a file in hexadecimal digits. `None` if the file cannot be read.
fn file_hash(files: &AssetDir, name: &str) -> Option<String> {
    let (mut file, _) = files.open(name).ok()?;
    let (mut hash, mut buffer) = (Sha256::new(), vec![0; 1 << 16]);
    loop {
        match file.read(&mut buffer).ok()? {
            0 => return Some(hex(&hash.finalize())),
            count => hash.update(&buffer[..count]),
        }
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{arr1, arr2};

    use super::*;
    use crate::load::modes::test_archives::{archive, npy};

    #[test]
    fn only_modes_of_the_same_surface_are_named() {
        let surface = b"solid s\nfacet\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendsolid\n";
        let hash: String = Sha256::digest(surface).iter().map(|byte| format!("{byte:02X}")).collect();
        let notes = |hash: &str| npy(&arr1(format!("{{\"modes.source_sha256\": \"{hash}\"}}").as_bytes()));
        let mesh = [("vertices", npy(&arr2(&[[0.0; 3]; 3]))), ("faces", npy(&arr2(&[[0, 1, 2]])))];
        let open = |arrays: &[(&str, Vec<u8>)], method| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            std::fs::write(folder.path().join("part.stl"), surface).expect("a writable file");
            std::fs::write(folder.path().join("part.npz"), archive(arrays, method)).expect("a writable file");
            let path = folder.path().join("part.stl");
            crate::load::open(&path.to_string_lossy()).expect("a scene").scene.remarks.clone()
        };
        let u = ("U", npy(&ndarray::Array3::from_elem((3, 3, 1), 1.0_f32)));
        let with = |note: &str| [&mesh[..], &[u.clone(), ("notes", notes(note))]].concat();
        let expected = ["part.npz was made from this file and has modes: open part.npz to see the part move"];
        for method in [zip::CompressionMethod::Stored, zip::CompressionMethod::Deflated] {
            assert_eq!(open(&with(&hash), method), expected);
            assert_eq!(open(&with("00"), method), [""; 0], "control: another surface");
        }
        let without_modes = [&mesh[..], &[("notes", notes(&hash))]].concat();
        assert_eq!(open(&without_modes, zip::CompressionMethod::Stored), [""; 0]);
    }
}
