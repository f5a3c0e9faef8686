//! Loaders of the modal matrix U: 3n rows for n vertices, r columns for r modes, f32.

mod computed;
mod npy;
mod npz;
mod safetensors;
mod sidecar;
mod sofa;
mod vega;

pub(super) use computed::computed_modes_remark;
pub(super) use npy::parse_f64;
pub use npy::{NpyArray, parse as parse_numpy};
pub(super) use npz::{
    NpzArchive, declare_modes as declare_npz_modes, declare_notes as declare_npz_notes, has_arrays,
    read_modes as read_npz_modes, read_notes as read_npz_notes,
};
pub(super) use sidecar::find_sidecar;

#[cfg(test)]
pub(super) use npz::tests as test_archives;

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, extension_of};
use super::conversion::modes_hint;
use crate::domain::Modes;
use crate::error::{Result, invalid};

/// Bytes of parsed entries per byte of a file, at most: two bytes, an f16 number or a digit and a space, become f32 in two
/// orders.
const PARSED_BYTES_PER_BYTE: u64 = 4;

/// The note of a domain that names the file of its modes.
pub(super) const FILE_NOTE: &str = "modes.file";

/// The modes of a file, and the eigenvalues if the file has them.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct LoadedModes {
    pub(super) modes: Modes,
    /// (rad/s)^2, one per mode; empty if the file has none.
    pub(super) eigenvalues: Vec<f64>,
}

impl LoadedModes {
    /// Modes with eigenvalues.
    ///
    /// # Errors
    /// `Invalid` if `eigenvalues` is not empty and does not have one finite number per mode.
    pub(super) fn new(modes: Modes, eigenvalues: Vec<f64>) -> Result<Self> {
        check_eigenvalues(&eigenvalues, modes.rank())?;
        Ok(Self { modes, eigenvalues })
    }
}

impl From<Modes> for LoadedModes {
    fn from(modes: Modes) -> Self {
        Self { modes, eigenvalues: Vec::new() }
    }
}

/// Checks that there are no eigenvalues, or one finite number per mode.
///
/// # Errors
/// `Invalid` with the numbers of modes and eigenvalues, or the number that is not finite.
pub(super) fn check_eigenvalues(eigenvalues: &[f64], rank: usize) -> Result<()> {
    if !eigenvalues.is_empty() && eigenvalues.len() != rank {
        return Err(invalid("eigenvalues", format!("one per mode ({rank})"), eigenvalues.len()));
    }
    match eigenvalues.iter().position(|value| !value.is_finite()) {
        None => Ok(()),
        Some(index) => Err(invalid(format!("eigenvalues[{index}]"), "a finite number", eigenvalues[index])),
    }
}

/// Reads the modes in the file `name`. The extension determines the format.
///
/// # Errors
/// `Invalid` with the file, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str) -> Result<LoadedModes> {
    let location = format!("file '{name}'");
    let parse: fn(&[u8], &AssetDir) -> Result<LoadedModes> = match extension_of(name).as_str() {
        "float" | "double" | "u" => |bytes, _| vega::parse(bytes).map(LoadedModes::from),
        "npy" => |bytes, _| matrix(npy::parse(bytes)?).map(LoadedModes::from),
        "npz" => |bytes, files| {
            let mut archive = npz::NpzArchive::open(bytes, files.memory())?;
            let name = npz::declare_modes(&mut archive)?;
            npz::read_modes(&mut archive, &name)
        },
        "safetensors" => |bytes, _| safetensors::parse(bytes),
        "txt" => |bytes, _| sofa::parse(bytes).map(LoadedModes::from),
        _ => return Err(unknown_format(name)),
    };
    let content = files.read(name, MAX_MODEL_BYTES)?;
    let _parsed = files.reserve_temporary(&location, PARSED_BYTES_PER_BYTE * content.len() as u64)?;
    let loaded = parse(&content, files).map_err(|error| error.prefix_field(&location))?;
    files.reserve(&location, size_of_val(loaded.modes.columns()) as u64)?;
    Ok(loaded)
}

fn unknown_format(name: &str) -> crate::error::Error {
    let given = format!("{name}{}", modes_hint(name));
    invalid("modes", "a file ending in .float, .double, .U, .npy, .npz, .safetensors or .txt", given)
}

/// U from an array of 3n x r or n x 3 x r.
pub(super) fn matrix(array: NpyArray) -> Result<Modes> {
    let NpyArray { shape, fortran_order, entries } = array;
    match (&shape[..], fortran_order) {
        ([rows, rank], true) => Modes::from_columns(*rows, *rank, entries),
        ([rows, rank], false) => Modes::from_rows(*rows, *rank, &entries),
        // In C order, row 3i + c of the matrix is the row (i, c) of the array.
        ([vertices, 3, rank], false) => Modes::from_rows(3 * vertices, *rank, &entries),
        ([vertices, 3, rank], true) => {
            // In Fortran order, the vertex varies fastest, then the component.
            let column = |mode: usize| &entries[3 * vertices * mode..][..3 * vertices];
            let row = |mode: usize, row: usize| column(mode)[row % 3 * vertices + row / 3];
            let columns = (0..*rank).flat_map(|mode| (0..3 * vertices).map(move |index| row(mode, index)));
            Modes::from_columns(3 * vertices, *rank, columns.collect())
        }
        _ => Err(invalid("shape", "3n x r or n x 3 x r", format!("{shape:?}"))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_ending_is_rejected_before_reading() {
        let message = read(&AssetDir::unrestricted(std::path::Path::new(".")), "u.mat")
            .expect_err("an unknown ending")
            .to_string();
        assert!(
            message.contains(".npy, .npz, .safetensors or .txt, got u.mat (convert it in its folder with `python3 -c"),
            "{message}"
        );
    }
}
