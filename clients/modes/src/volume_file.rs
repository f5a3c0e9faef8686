//! Reads a volume mesh: Gmsh (.msh), VTK (.vtk, .vtu) and Vega (.veg) files.

use std::path::Path;

use modalcast_model::error::{Result, invalid};
use modalcast_model::load::LoadOptions;
use modalcast_model::scene::UpAxis;

use crate::surface_file::hash_file;
use crate::volume_mesh::VolumeMesh;
use crate::{gmsh_file, vega_file, vtk_file, vtu_file};

/// A volume mesh and its file.
#[derive(Debug, Clone, Default)]
pub struct VolumeFile {
    /// The file name without its folder.
    pub name: String,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: String,
    /// The axis of the file that points up: 0 for x, 1 for y, 2 for z.
    pub up_axis: usize,
    pub mesh: VolumeMesh,
}

/// Reads a volume mesh.
///
/// # Errors
/// `Invalid` with the file and the place in it for wrong content, cells that are no tetrahedra, and elements that cannot be
/// computed (see [`VolumeMesh::new`]).
pub fn read(path: &str, options: &LoadOptions) -> Result<VolumeFile> {
    let file_path = Path::new(path);
    let field = format!("file '{path}'");
    if !file_path.is_file() {
        return Err(invalid(field, "an existing model file", "none of this name"));
    }
    let unreadable = |error: std::io::Error| invalid(&field, "a readable file", error);
    let name = file_path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let extension = file_path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    let bytes = std::fs::read(file_path).map_err(unreadable)?;
    let cells = match extension.as_str() {
        "msh" => gmsh_file::read(&bytes).and_then(|cells| cells.finish(&name)),
        "vtk" => vtk_file::read(&bytes).and_then(|cells| cells.finish(&name)),
        "vtu" => vtu_file::read(&bytes).and_then(|cells| cells.finish(&name)),
        _ => vega_file::read(file_path),
    };
    drop(bytes);
    let mut cells = cells.map_err(|error| error.prefix_field(&field))?;
    let unit = options.unit.map_or(1.0, |unit| unit.meters());
    cells.positions.iter_mut().for_each(|position| *position *= unit);
    // Vega's models have the axes of OBJ files.
    let default_up = if extension == "veg" { UpAxis::Y } else { UpAxis::Z };
    Ok(VolumeFile {
        name,
        sha256: hash_file(file_path).map_err(unreadable)?,
        up_axis: options.up.unwrap_or(default_up).index(),
        mesh: VolumeMesh::new(cells).map_err(|error| error.prefix_field(&field))?,
    })
}
