//! Reader of NumPy archives (`numpy.savez`, `numpy.savez_compressed`): arrays by name.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, Cursor, Read, Seek};
use std::sync::Arc;

use zip::ZipArchive;
use zip::read::ZipFile;

use super::npy::{self, NpyArray};
use super::{LoadedModes, matrix};
use crate::domain::MAX_RANK;
use crate::error::{Error, Result, invalid};
use crate::load::asset_dir::{AssetDir, MAX_MODEL_BYTES};
use crate::memory::{MemoryReservation, TemporaryReservation};

/// The name of the array of notes.
const NOTES: &str = "notes";
/// The largest number of arrays in an archive.
const MAX_ARRAYS: usize = 1024;
/// The largest array of notes in bytes.
const MAX_NOTES_BYTES: usize = 256 << 10;
/// The largest length of an error of the JSON parser in an error message.
const MAX_QUOTED_CHARS: usize = 160;
/// The largest number of names in an error message.
const MAX_LISTED_NAMES: usize = 16;
/// Bytes of an entry while it is parsed: as f64, and as f32 in two orders.
const PARSED_BYTES_PER_ENTRY: u64 = 16;
/// DEFLATE reduces data by a factor of at most 1032.
const MAX_COMPRESSION: u64 = 1032;

/// An archive of arrays. [`Self::declare`] reserves the memory of an array from its header. Declare all arrays before the
/// first one is read, so that an archive that needs too much memory is rejected before any data are decompressed.
#[derive(Debug)]
pub(in crate::load) struct NpzArchive<'a> {
    archive: ZipArchive<Cursor<&'a [u8]>>,
    memory: Arc<MemoryReservation>,
    /// By name, the arrays to read.
    declared: BTreeMap<String, DeclaredArray>,
    /// Names of the arrays, without `.npy`.
    names: Vec<String>,
}

/// An array whose header is valid.
#[derive(Debug)]
struct DeclaredArray {
    /// Size of the `.npy` file in bytes.
    size: u64,
    memory: TemporaryReservation,
}

impl<'a> NpzArchive<'a> {
    /// Reads the directory of the archive. Declared arrays reserve their memory in `memory` until the archive is dropped.
    ///
    /// # Errors
    /// `Invalid` if the bytes are not a ZIP archive, or the archive has too many members.
    pub(in crate::load) fn open(bytes: &'a [u8], memory: &Arc<MemoryReservation>) -> Result<Self> {
        let archive = ZipArchive::new(Cursor::new(bytes))
            .map_err(|error| invalid("archive", "a NumPy archive (numpy.savez)", error))?;
        if archive.len() > MAX_ARRAYS {
            return Err(invalid("archive", format!("at most {MAX_ARRAYS} arrays"), archive.len()));
        }
        let names = array_names(&archive);
        Ok(Self { archive, memory: Arc::clone(memory), declared: BTreeMap::new(), names })
    }

    /// Names of the arrays, sorted.
    pub(in crate::load) fn names(&self) -> &[String] {
        &self.names
    }

    /// The names for an error message.
    pub(in crate::load) fn list_names(&self) -> String {
        self.names.iter().take(MAX_LISTED_NAMES).map(String::as_str).collect::<Vec<_>>().join(", ")
    }

    /// Reads the header of an array, and reserves memory for its bytes and its parsed entries. Returns the shape, or `None`
    /// if the archive has no array of this name.
    ///
    /// # Errors
    /// `Invalid` with the name of the array, if the header cannot be read, `check_shape` fails, the sizes in the headers
    /// contradict each other, or the array is too large; `OutOfMemory`.
    pub(in crate::load) fn declare(
        &mut self,
        name: &str,
        check_shape: impl Fn(&[usize]) -> Result<()>,
    ) -> Result<Option<Vec<usize>>> {
        if !self.names.iter().any(|other| other == name) {
            return Ok(None);
        }
        self.declare_member(name, check_shape).map(Some).map_err(|error| in_array(error, name))
    }

    fn declare_member(&mut self, name: &str, check_shape: impl Fn(&[usize]) -> Result<()>) -> Result<Vec<usize>> {
        let member = member_of(&mut self.archive, name)?;
        let (size, compressed) = (member.size(), member.compressed_size());
        // A small file cannot claim much memory.
        let limit = MAX_MODEL_BYTES.min(compressed.saturating_mul(MAX_COMPRESSION));
        if size > limit {
            return Err(invalid("size", format!("at most {limit} bytes"), size));
        }
        let mut bytes = Vec::new();
        member.take(npy::MAX_PREFIX_BYTES as u64).read_to_end(&mut bytes).map_err(unreadable_member)?;
        let (header, body) = npy::parse_header(&bytes)?;
        let header_bytes = (bytes.len() - body.len()) as u64;
        if Some(size) != header_bytes.checked_add(header.data_bytes as u64) {
            let expected = format!("{} bytes for the shape {:?}", header.data_bytes, header.shape);
            return Err(invalid("data", expected, size.saturating_sub(header_bytes)));
        }
        check_shape(&header.shape)?;
        let entries = header.shape.iter().product::<usize>() as u64;
        let object = format!("array '{name}' of {:?}", header.shape);
        let memory = self.memory.reserve_temporary(&object, size + PARSED_BYTES_PER_ENTRY * entries)?;
        self.declared.insert(name.to_owned(), DeclaredArray { size, memory });
        Ok(header.shape)
    }

    /// Memory in bytes that all declared arrays have reserved.
    pub(in crate::load) fn reserved_bytes(&self) -> u64 {
        self.declared.values().map(|array| array.memory.bytes()).sum()
    }

    /// The bytes of a declared array's `.npy` file; `None` if the array was not declared.
    ///
    /// # Errors
    /// `Invalid` with the name of the array, if the member cannot be read or has another size than its header.
    pub(in crate::load) fn read(&mut self, name: &str) -> Result<Option<Vec<u8>>> {
        let Some(size) = self.declared.get(name).map(|array| array.size) else { return Ok(None) };
        self.read_member(name, size).map(Some).map_err(|error| in_array(error, name))
    }

    fn read_member(&mut self, name: &str, size: u64) -> Result<Vec<u8>> {
        // One byte more than declared, so that a longer member is noticed.
        let limit = size.saturating_add(1);
        let mut bytes = Vec::with_capacity(limit as usize);
        member_of(&mut self.archive, name)?.take(limit).read_to_end(&mut bytes).map_err(unreadable_member)?;
        match bytes.len() as u64 == size {
            true => Ok(bytes),
            false => Err(invalid("data", format!("{size} bytes"), bytes.len())),
        }
    }
}

/// Opens the member of an array.
fn member_of<'a, R: Read + Seek>(archive: &'a mut ZipArchive<R>, name: &str) -> Result<ZipFile<'a, R>> {
    archive.by_name(&format!("{name}.npy")).map_err(unreadable_member)
}

fn unreadable_member(error: impl std::fmt::Display) -> Error {
    invalid("data", "a readable member of the archive", error)
}

/// Whether the file `name` is an archive with arrays of all these names. Reads only the directory of the archive.
pub(in crate::load) fn has_arrays(files: &AssetDir, name: &str, arrays: &[&str]) -> bool {
    let names = open_file(files, name).map_or_else(Vec::new, |archive| array_names(&archive));
    arrays.iter().all(|array| names.iter().any(|name| name == array))
}

/// Whether the file `name` is an archive in which [`declare_modes`] finds no array of U. Reads only the directory of the
/// archive.
pub(in crate::load) fn lacks_modes(files: &AssetDir, name: &str) -> bool {
    open_file(files, name).is_some_and(|archive| modes_array(&array_names(&archive)).is_none())
}

/// Reads the directory of the archive in the file `name`. `None` if the file is not an archive.
fn open_file(files: &AssetDir, name: &str) -> Option<ZipArchive<BufReader<File>>> {
    let (file, _) = files.open(name).ok().filter(|(_, file_bytes)| *file_bytes <= MAX_MODEL_BYTES)?;
    ZipArchive::new(BufReader::new(file)).ok()
}

/// Names of the arrays in an archive, sorted.
fn array_names<R: Read + Seek>(archive: &ZipArchive<R>) -> Vec<String> {
    let members = archive.file_names().filter_map(Result::ok);
    let mut names: Vec<String> = members.filter_map(|name| Some(name.strip_suffix(".npy")?.to_owned())).collect();
    names.sort();
    names
}

fn in_array(error: Error, name: &str) -> Error {
    error.prefix_field(&format!("array '{name}'"))
}

/// The array of U among the arrays of an archive: `U`, `modes` or the only array.
fn modes_array(names: &[String]) -> Option<&str> {
    let only_array = match names {
        [name] => Some(name.as_str()),
        _ => None,
    };
    ["U", "modes"].into_iter().find(|name| names.iter().any(|other| other == name)).or(only_array)
}

/// Declares the array of U and the array `eigenvalues`, if there is one. Returns the name of the array of U: `U`, `modes`
/// or the only array.
///
/// # Errors
/// `Invalid` if U is missing, or a header is invalid; `OutOfMemory`.
pub(in crate::load) fn declare_modes(archive: &mut NpzArchive<'_>) -> Result<String> {
    let name = modes_array(archive.names());
    let name = name.ok_or_else(|| invalid("archive", "an array named U", archive.list_names()))?.to_owned();
    let check_rank = |shape: &[usize]| match shape {
        [.., rank] if *rank > MAX_RANK => Err(invalid("shape", format!("at most {MAX_RANK} columns"), rank)),
        _ => Ok(()),
    };
    archive.declare(&name, check_rank)?;
    let check_length = |shape: &[usize]| match shape.iter().try_fold(1_usize, |size, side| size.checked_mul(*side)) {
        Some(length) if length <= MAX_RANK => Ok(()),
        _ => Err(invalid("shape", format!("at most {MAX_RANK} entries"), format!("{shape:?}"))),
    };
    archive.declare("eigenvalues", check_length)?;
    Ok(name)
}

/// Reads U and the eigenvalues, which [`declare_modes`] has declared. `name` is the array of U.
///
/// # Errors
/// `Invalid` if an array is invalid.
pub(in crate::load) fn read_modes(archive: &mut NpzArchive<'_>, name: &str) -> Result<LoadedModes> {
    let bytes = archive.read(name)?.unwrap_or_default();
    let array: Result<NpyArray> = npy::parse(&bytes);
    drop(bytes);
    let modes = array.and_then(matrix).map_err(|error| in_array(error, name))?;
    let eigenvalues = match archive.read("eigenvalues")? {
        Some(bytes) => npy::parse_f64(&bytes).map_err(|error| in_array(error, "eigenvalues"))?.1,
        None => Vec::new(),
    };
    LoadedModes::new(modes, eigenvalues)
}

/// Declares the array `notes`, if there is one.
///
/// # Errors
/// `Invalid` if the array is too large; `OutOfMemory`.
pub(in crate::load) fn declare_notes(archive: &mut NpzArchive<'_>) -> Result<()> {
    archive.declare(NOTES, check_notes_shape).map(drop)
}

/// Reads the declared array `notes`: a JSON object of texts, in UTF-8, as an array of bytes. Without this array, there
/// are no notes.
///
/// # Errors
/// `Invalid` if the array contains other values.
pub(in crate::load) fn read_notes(archive: &mut NpzArchive<'_>) -> Result<BTreeMap<String, String>> {
    let Some(bytes) = archive.read(NOTES)? else { return Ok(BTreeMap::new()) };
    parse_notes(&bytes).map_err(|error| in_array(error, NOTES))
}

/// As [`read_notes`], without reading the other arrays of the file `name`. There are no notes if the file is not an
/// archive or has no valid notes.
pub(in crate::load) fn find_notes(files: &AssetDir, name: &str) -> BTreeMap<String, String> {
    let read = || {
        let mut archive = open_file(files, name)?;
        let member = archive.by_name(&format!("{NOTES}.npy")).ok()?;
        let limit = MAX_NOTES_BYTES + npy::MAX_PREFIX_BYTES;
        let mut bytes = Vec::new();
        member.take(limit as u64).read_to_end(&mut bytes).ok()?;
        parse_notes(&bytes).ok()
    };
    read().unwrap_or_default()
}

fn check_notes_shape(shape: &[usize]) -> Result<()> {
    match shape {
        [bytes] if *bytes <= MAX_NOTES_BYTES => Ok(()),
        _ => Err(invalid("shape", format!("at most {MAX_NOTES_BYTES} bytes"), format!("{shape:?}"))),
    }
}

fn parse_notes(bytes: &[u8]) -> Result<BTreeMap<String, String>> {
    let text = npy::parse_bytes(bytes)?;
    let invalid_text = |error: serde_json::Error| {
        // The error may quote the text.
        let given: String = error.to_string().chars().take(MAX_QUOTED_CHARS).collect();
        invalid("text", "a JSON object of texts in UTF-8", given)
    };
    serde_json::from_slice(text).map_err(invalid_text)
}

#[cfg(test)]
pub(in crate::load) mod tests {
    use std::io::Write as _;

    use ndarray_npy::WriteNpyExt;
    use zip::write::SimpleFileOptions;
    use zip::{CompressionMethod, ZipWriter};

    use super::*;

    /// An archive of `.npy` files, stored or compressed.
    pub(in crate::load) fn archive(arrays: &[(&str, Vec<u8>)], method: CompressionMethod) -> Vec<u8> {
        let mut writer = ZipWriter::new(Cursor::new(Vec::new()));
        for (name, bytes) in arrays {
            let options = SimpleFileOptions::default().compression_method(method);
            writer.start_file(format!("{name}.npy"), options).expect("a new member");
            writer.write_all(bytes).expect("a written member");
        }
        writer.finish().expect("a complete archive").into_inner()
    }

    pub(in crate::load) fn npy<A, D>(array: &ndarray::Array<A, D>) -> Vec<u8>
    where
        A: ndarray_npy::WritableElement,
        D: ndarray::Dimension,
    {
        let mut bytes = Vec::new();
        array.write_npy(&mut bytes).expect("an encoded array");
        bytes
    }

    fn read(bytes: &[u8]) -> Result<LoadedModes> {
        let mut archive = NpzArchive::open(bytes, &MemoryReservation::unlimited())?;
        let name = declare_modes(&mut archive)?;
        read_modes(&mut archive, &name)
    }

    #[test]
    fn named_arrays_are_read_from_stored_and_compressed_archives() {
        let u = npy(&ndarray::Array3::from_shape_fn((2, 3, 2), |(i, c, k)| (100 * i + 10 * c + k) as f64));
        let eigenvalues = npy(&ndarray::arr1(&[1.5, 2.5]));
        let stress = npy(&ndarray::arr1(&[1.0_f32; 7]));
        for method in [CompressionMethod::Stored, CompressionMethod::Deflated] {
            let arrays = [("stress", stress.clone()), ("U", u.clone()), ("eigenvalues", eigenvalues.clone())];
            let loaded = read(&archive(&arrays, method)).expect("a valid archive");
            assert_eq!((loaded.modes.entry(1, 2, 1), &loaded.eigenvalues[..]), (121.0, &[1.5, 2.5][..]));
        }
        let only = read(&archive(&[("arr_0", u.clone())], CompressionMethod::Stored)).expect("a single array");
        assert!(only.eigenvalues.is_empty() && only.modes.rank() == 2);
        let two = archive(&[("a", u.clone()), ("b", u)], CompressionMethod::Stored);
        assert_eq!(read(&two).expect_err("no array U").to_string(), "archive: expected an array named U, got a, b");
    }

    #[test]
    fn hostile_archives_are_rejected_before_their_data_are_read() {
        let typed_header = |dtype: &str, shape: &str| {
            let text = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}");
            let length = u16::try_from(text.len()).expect("a short header").to_le_bytes();
            [b"\x93NUMPY\x01\x00", &length[..], text.as_bytes()].concat()
        };
        let header = |shape: &str| typed_header("<f4", shape);
        let deflated = |bytes: Vec<u8>| archive(&[("U", bytes)], CompressionMethod::Deflated);
        let valid = deflated(npy(&ndarray::arr2(&[[1.0_f32], [2.0], [3.0]])));
        for length in 0..valid.len() {
            assert!(read(&valid[..length]).is_err(), "expected an error for {length} of {} bytes", valid.len());
        }
        for (bytes, start) in [
            (b"PK\x05\x06".to_vec(), "archive: expected a NumPy archive"),
            (deflated(header("(1000000000, 1)")), "array 'U': data: expected 4000000000 bytes for the shape"),
            (deflated(header("(9223372036854775807, 4)")), "array 'U': data: expected 4 bytes for each entry"),
            (deflated(vec![0; 30]), "array 'U': header: expected the magic"),
            (deflated([header("(3, 513)"), vec![0; 4 * 3 * 513]].concat()), "array 'U': shape: expected at most 512"),
            (deflated([header("(4, 1)"), vec![0; 16]].concat()), "array 'U': modes.rows"),
            (deflated(npy(&ndarray::arr2(&[[f32::NAN], [0.0], [0.0]]))), "array 'U': modes[0, 0]: expected a finite"),
            (deflated([typed_header("<c8", "(3, 1)"), vec![0; 24]].concat()), "array 'U': descr: expected i1, u1, i2"),
        ] {
            let message = read(&bytes).expect_err(start).to_string();
            assert!(message.starts_with(start), "{message}");
        }
        // A directory that declares 1 GiB for a member of a few bytes: offset 24 in the record after its signature.
        let mut bomb = valid.clone();
        let record = bomb.windows(4).position(|bytes| bytes == b"PK\x01\x02").expect("a central directory");
        bomb[record + 24..record + 28].copy_from_slice(&(1_u32 << 30).to_le_bytes());
        let message = read(&bomb).expect_err("a wrong size").to_string();
        assert!(message.starts_with("array 'U': size: expected at most"), "{message}");
    }
}
