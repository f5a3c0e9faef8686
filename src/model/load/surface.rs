//! Builds a scene of one domain from a polygon mesh: triangles, colors of vertices, modes, and their remarks.

use super::asset_dir::AssetDir;
use super::modes::{self, LoadedModes};
use super::plant_materials::PlantMaterials;
use super::polygons::{self, PolygonMesh, VertexColors};
use crate::domain::{CreaseAngle, Domain, Material, Mesh, Metadata, Modes, Shape};
use crate::error::{Error, Result};
use crate::scene::SceneParts;

/// Where the modes of a mesh come from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(super) enum ModesSource {
    /// A file in the same folder, if any (see [`modes::find_sidecar`]).
    #[default]
    Sidecar,
    /// No modes: the caller provides them.
    None,
}

/// How a model is read.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct ModelOptions {
    pub(super) modes: ModesSource,
    /// For the normals that the file does not contain.
    pub(super) crease_angle: CreaseAngle,
    /// Elastic constants of plants.
    pub(super) plant: PlantMaterials,
}

#[cfg(test)]
impl ModelOptions {
    /// Options that ignore files with modes.
    pub(super) fn without_modes() -> Self {
        Self { modes: ModesSource::None, ..Self::default() }
    }
}

/// Adds the mesh of the file `name` as the only domain. Its materials must be in `parts` in the order of
/// [`PolygonMesh::materials`]. `own_modes` are modes in the file itself; they have precedence over files beside it.
///
/// # Errors
/// `Invalid` with the file, and the expected and given value; `OutOfMemory`.
pub(super) fn add_domain(
    files: &AssetDir,
    name: &str,
    polygons: &PolygonMesh,
    options: ModelOptions,
    own_modes: Option<LoadedModes>,
    parts: &mut SceneParts,
) -> Result<()> {
    let in_file = |file: &str| {
        let location = format!("file '{file}'");
        move |error: Error| error.prefix_field(&location)
    };
    files.reserve(&format!("mesh of '{name}'"), polygons.build_bytes())?;
    let triangles = polygons::build_all_faces(polygons, options.crease_angle).map_err(in_file(name))?;
    parts.remarks.extend(triangles.remark());
    let mesh = color_vertices(polygons, triangles.mesh, parts).map_err(in_file(name))?;
    let (loaded, modes_file) = match (options.modes, own_modes) {
        (ModesSource::None, _) => (Modes::rigid().into(), None),
        (ModesSource::Sidecar, Some(own_modes)) => (own_modes, Some(name.to_owned())),
        (ModesSource::Sidecar, None) => {
            let sidecar = modes::find_sidecar(files, name)?;
            parts.remarks.extend(sidecar.remark);
            match sidecar.file {
                Some(file) => (modes::read(files, &file)?, Some(file)),
                None => (Modes::rigid().into(), None),
            }
        }
    };
    let shape = Shape::new(mesh, loaded.modes).map_err(in_file(modes_file.as_deref().unwrap_or(name)))?;
    let shape = shape.with_origin(triangles.origin);
    let mut notes = super::vega_config::read_notes(files, name)?;
    notes.extend(modes_file.map(|file| (modes::FILE_NOTE.to_owned(), file)));
    parts.shapes.push(shape);
    parts.domains.push(Domain {
        material: triangles.material,
        material_ranges: triangles.material_ranges,
        metadata: Metadata { eigenvalues: loaded.eigenvalues, inertia: None, notes },
        ..Domain::new(parts.name.clone(), 0)
    });
    Ok(())
}

/// Applies the colors of the vertices, unless a material has an image, whose texture coordinates they would replace.
fn color_vertices(polygons: &PolygonMesh, mesh: Mesh, parts: &mut SceneParts) -> Result<Mesh> {
    if polygons.colors.is_empty() {
        return Ok(mesh);
    }
    let has_image = |material: &Material| material.color_texture.is_some() || material.normal_texture.is_some();
    if parts.materials.iter().any(has_image) {
        parts.remarks.push("colors of vertices are not used, because a material has an image".into());
        return Ok(mesh);
    }
    // The colors of the vertices are factors of a material, and the only colors of a material without a definition.
    for material in &mut parts.materials {
        if *material == Material::unspecified(&material.name) {
            (material.ambient, material.diffuse) = ([1.0; 3], [1.0; 3]);
        }
    }
    let linear_color = |color: &[f32; 3]| {
        let [red, green, blue] = color.map(polygons::linear_from_srgb);
        [red, green, blue, 1.0]
    };
    let linear_colors: Vec<[f32; 4]> = polygons.colors.iter().map(linear_color).collect();
    match polygons::paint(&mesh, &linear_colors)? {
        VertexColors::Uniform([red, green, blue, _]) => {
            parts.materials.iter_mut().for_each(|material| material.multiply_color([red, green, blue]));
            Ok(mesh)
        }
        VertexColors::Image(painted) => {
            let (mesh, texture) = *painted;
            parts.textures.push(texture);
            let index = parts.textures.len() - 1;
            parts.materials.iter_mut().for_each(|material| material.color_texture = Some(index));
            Ok(mesh)
        }
    }
}
