//! Writes a model file: a NumPy archive with a mesh, U, eigenvalues and notes. The server's manual of model files
//! (`src/model/load/manifest/README.md`) describes the arrays.

use std::collections::BTreeMap;
use std::io::{Cursor, Write as _};
use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;

use modalcast_model::error::{Result, fault_in, invalid};
use nalgebra::Matrix3;
use ndarray::{Array1, Array2, Array3};
use ndarray_npy::WriteNpyExt as _;
use sha2::{Digest as _, Sha256};
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use crate::large_motion::SafeRange;
use crate::mass_properties::rotated;
use crate::materials::Material;
use crate::modeling::{Modeling, to_hertz};
use crate::parameters::ModelingParameters;
use crate::part_file::ModelSource;

/// Encodes the model. Z is up and lengths are in meters. Equal modes give equal bytes.
///
/// # Errors
/// `Fault` if an array has the wrong size.
pub fn encode(source: ModelSource<'_>, parameters: &ModelingParameters, modeling: &Modeling) -> Result<Vec<u8>> {
    let up_axis = source.up_axis;
    let mesh = &modeling.mesh;
    let (vertices, rank, faces) = (mesh.positions.len(), modeling.eigenvalues.len(), mesh.triangles.len());
    let mut archive = Archive::new();
    let positions = mesh.positions.iter().flat_map(|position| turn_up((*position).into(), up_axis)).collect();
    archive.add("vertices", &Array2::from_shape_vec((vertices, 3), positions).map_err(fault_in("model"))?)?;
    let triangles = mesh.triangles.as_flattened().to_vec();
    archive.add("faces", &Array2::from_shape_vec((faces, 3), triangles).map_err(fault_in("model"))?)?;
    let mut modes = vec![0.0; modeling.modes.len()];
    for vertex in 0..vertices {
        for mode in 0..rank {
            let entry = |axis: usize| (3 * vertex + axis) * rank + mode;
            let turned = turn_up([0, 1, 2].map(|axis| modeling.modes[entry(axis)]), up_axis);
            (0..3).for_each(|axis| modes[entry(axis)] = turned[axis]);
        }
    }
    archive.add("U", &Array3::from_shape_vec((vertices, 3, rank), modes).map_err(fault_in("model"))?)?;
    archive.add("eigenvalues", &Array1::from_vec(modeling.eigenvalues.clone()))?;
    if let Some(masses) = &modeling.mass_properties {
        let columns: [[f64; 3]; 3] =
            [0, 1, 2].map(|axis| turn_up([0, 1, 2].map(|row| f64::from(row == axis)), up_axis));
        let rotation = Matrix3::from_fn(|row, column| columns[column][row]);
        let turned = rotated(masses, &rotation);
        let size = turned.nrows();
        archive.add("inertia", &Array2::from_shape_fn((size, size), |(row, column)| turned[(row, column)]))?;
    }
    let normals = mesh.corner_normals.as_flattened().iter().flat_map(|normal| turn_up(*normal, up_axis)).collect();
    archive.add("corner_normals", &Array3::from_shape_vec((faces, 3, 3), normals).map_err(fault_in("model"))?)?;
    if !mesh.material_colors.is_empty() {
        archive.add("face_materials", &Array1::from_vec(mesh.triangle_materials.clone()))?;
        let colors = mesh.material_colors.as_flattened().to_vec();
        let count = mesh.material_colors.len();
        archive.add("material_colors", &Array2::from_shape_vec((count, 4), colors).map_err(fault_in("model"))?)?;
    }
    let notes = serde_json::to_vec(&notes(source, parameters, modeling)).map_err(fault_in("model"))?;
    archive.add("notes", &Array1::from_vec(notes))?;
    archive.finish()
}

/// Writes a file as a whole: under another name first, so that no half-written file remains.
///
/// # Errors
/// `Invalid` if the file exists and `replace` is not set, or it cannot be written.
pub fn write(path: &Path, bytes: &[u8], replace: bool) -> Result<()> {
    let field = format!("file '{}'", path.display());
    let unwritable = |error: std::io::Error| invalid(&field, "a file that can be written", error);
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    if replace && path.exists() && !path.is_file() {
        return Err(invalid(field, "a file", "a folder or a device"));
    }
    let mut temporary = tempfile::Builder::new()
        .prefix(".modalcast-")
        // The umask applies, as to every new file.
        .permissions(std::fs::Permissions::from_mode(0o666))
        .tempfile_in(folder)
        .map_err(unwritable)?;
    temporary.write_all(bytes).map_err(unwritable)?;
    temporary.as_file().sync_all().map_err(unwritable)?;
    let persisted = if replace { temporary.persist(path) } else { temporary.persist_noclobber(path) };
    match persisted {
        Ok(_) => Ok(()),
        Err(error) if error.error.kind() == std::io::ErrorKind::AlreadyExists => {
            Err(invalid(field, "a new file (--force replaces an existing one)", "an existing file"))
        }
        Err(error) => Err(unwritable(error.error)),
    }
}

/// The notes of a model: how it was made, and how accurate it is.
fn notes(
    source: ModelSource<'_>,
    parameters: &ModelingParameters,
    modeling: &Modeling,
) -> BTreeMap<&'static str, String> {
    let list = |values: &[f64]| values.iter().map(|value| format!("{value:.2e}")).collect::<Vec<_>>().join(" ");
    let describe = |material: &Material| {
        format!(
            "{}: E = {:e} Pa, nu = {}, rho = {} kg/m3",
            material.name, material.youngs_modulus, material.poissons_ratio, material.density
        )
    };
    let frequencies: Vec<String> =
        modeling.eigenvalues.iter().map(|eigenvalue| format!("{:.6}", to_hertz(*eigenvalue))).collect();
    let mut notes = BTreeMap::from([
        // The physics process reads these two notes. All columns of U are elastic.
        ("damping_ratio", modeling.damping_ratio.to_string()),
        ("rigid_modes", "0".into()),
        ("modes.source", source.name.to_owned()),
        ("modes.source_sha256", source.sha256.to_owned()),
        ("modes.unit", parameters.unit.to_string()),
        ("modes.material", describe(&parameters.material)),
        ("modes.mass", format!("{:.6e}", modeling.mass)),
        ("modes.free_rigid_modes", modeling.rigid_modes.to_string()),
        ("modes.parts", modeling.parts.to_string()),
        ("modes.freedoms", modeling.freedoms.to_string()),
        ("modes.cell_size", format!("{:.6e}", modeling.cell_size)),
        ("modes.frequencies", frequencies.join(" ")),
        ("modes.frequency_errors", list(&modeling.frequency_errors)),
        ("modes.residuals", list(&modeling.residuals)),
    ]);
    if let Some(count) = modeling.tetrahedra {
        notes.insert("modes.tetrahedra", count.to_string());
        // A file can have materials of its own.
        let materials =
            modeling.group_materials.iter().map(|(group, material)| format!("{group}: {}", describe(material)));
        notes.insert("modes.material", materials.collect::<Vec<_>>().join("; "));
    }
    if let Some(large_motion) = &modeling.large_motion {
        // The physics process checks the hash of the forces beside the model, and the coordinates.
        notes.insert("modes.cubic_sha256", hexadecimal(&Sha256::digest(large_motion.force.encode())));
        let list = |value: fn(&SafeRange) -> f64| {
            large_motion.safe_ranges.iter().map(|range| format!("{:.6e}", value(range))).collect::<Vec<_>>().join(" ")
        };
        notes.insert("modes.safe_coordinates", list(|range| range.coordinate));
        notes.insert("modes.safe_displacements", list(|range| range.displacement));
        notes.insert("modes.linear_modes", large_motion.linear_modes.to_string());
    }
    if !parameters.clamps.is_empty() {
        notes.insert("modes.clamps", parameters.clamps.join("; "));
    }
    for (name, group_material) in &parameters.group_materials {
        let text = notes.entry("modes.group_materials").or_default();
        text.push_str(&format!("{name}: {}; ", group_material.name));
    }
    notes
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Rotates a vector, so that the axis that points up becomes z.
fn turn_up<T: Copy + std::ops::Neg<Output = T>>([x, y, z]: [T; 3], up_axis: usize) -> [T; 3] {
    match up_axis {
        0 => [y, z, x],
        1 => [x, -z, y],
        _ => [x, y, z],
    }
}

/// A NumPy archive in memory.
struct Archive(ZipWriter<Cursor<Vec<u8>>>);

impl Archive {
    fn new() -> Self {
        Self(ZipWriter::new(Cursor::new(Vec::new())))
    }

    fn add<S, D>(&mut self, name: &str, array: &ndarray::ArrayBase<S, D>) -> Result<()>
    where
        S: ndarray::Data,
        S::Elem: ndarray_npy::WritableElement,
        D: ndarray::Dimension,
    {
        // The default time of an entry is constant.
        let options = SimpleFileOptions::default().compression_method(CompressionMethod::Stored).large_file(true);
        let options = options.last_modified_time(zip::DateTime::default());
        self.0.start_file(format!("{name}.npy"), options).map_err(fault_in("model"))?;
        array.write_npy(&mut self.0).map_err(fault_in("model"))
    }

    fn finish(self) -> Result<Vec<u8>> {
        Ok(self.0.finish().map_err(fault_in("model"))?.into_inner())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn existing_files_are_replaced_only_on_request() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("a.npz");
        write(&path, b"one", false).expect("a new file");
        let error = write(&path, b"two", false).expect_err("expected an error").to_string();
        assert!(error.contains("--force"), "{error}");
        assert_eq!(std::fs::read(&path).expect("a file"), b"one");
        write(&path, b"two", true).expect("a replaced file");
        assert_eq!(std::fs::read(&path).expect("a file"), b"two");
        assert_eq!(std::fs::read_dir(folder.path()).expect("a folder").count(), 1, "no temporary file remains");
        assert!(write(&folder.path().join("missing/a.npz"), b"one", false).is_err());
        assert!(write(folder.path(), b"one", true).is_err(), "a folder is not replaced");
    }

    #[test]
    fn up_axis_becomes_z() {
        assert_eq!(turn_up([0, 0, 1], 2), [0, 0, 1]);
        assert_eq!(turn_up([0, 1, 0], 1), [0, 0, 1]);
        assert_eq!(turn_up([1, 0, 0], 0), [0, 0, 1]);
        assert_eq!(turn_up([0, 0, 1], 1), [0, -1, 0], "a rotation without a reflection");
    }
}
