//! Loader of OBJ files, with their MTL libraries, images, modes and Vega configuration, as scenes of one domain.

mod build;
mod material;
mod mtl;
mod parse;
mod triangulate;

use std::collections::BTreeMap;

pub(super) use build::build_faces;
pub(super) use material::DEFAULT_ALPHA_CUTOFF;
pub(super) use parse::ObjFile;

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, MAX_TEXT_BYTES, parent_of};
use super::modes;
use super::texture_cache::TextureCache;
use crate::domain::{Domain, Material, Metadata, Modes, Shape};
use crate::error::{Result, invalid};
use crate::scene::SceneParts;

/// The largest number of material names in an error message.
const MAX_LISTED_NAMES: usize = 16;
/// The largest number of names of undefined materials in a remark.
const MAX_LISTED_UNDEFINED: usize = 8;

/// Where the modes of an OBJ file come from.
#[derive(Debug, Clone, Copy)]
pub(super) enum ModesSource {
    /// A file in the same folder, if any (see [`modes::find_sidecar`]).
    Sidecar,
    /// No modes: the caller provides them.
    None,
}

/// Reads the OBJ file `name` in the folder `files` as one domain. Each material becomes a range of triangles.
///
/// # Errors
/// `Invalid` with the file, the line or material, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, source: ModesSource) -> Result<SceneParts> {
    let obj = parse_file(files, name)?;
    let mut parts = SceneParts::named(name.strip_suffix(".obj").unwrap_or(name));
    add_materials(&obj, files, &mut parts)?;
    let obj_mesh = build::build_all_faces(&obj).map_err(|error| error.prefix_field(&format!("file '{name}'")))?;
    let modes_file = match source {
        ModesSource::Sidecar => modes::find_sidecar(files, name)?,
        ModesSource::None => None,
    };
    let modes = modes_file.as_deref().map_or(Ok(Modes::rigid()), |file| modes::read(files, file))?;
    let shape = Shape::new(obj_mesh.mesh, modes);
    let location = || format!("file '{}'", modes_file.as_deref().unwrap_or(name));
    parts.shapes.push(shape.map_err(|error| error.prefix_field(&location()))?);
    parts.domains.push(Domain {
        material: obj_mesh.material,
        material_ranges: obj_mesh.material_ranges,
        metadata: Metadata { eigenvalues: Vec::new(), notes: super::vega_config::read_notes(files, name)? },
        ..Domain::new(parts.name.clone(), 0)
    });
    Ok(parts)
}

/// Parses the OBJ file `name`.
///
/// # Errors
/// `Invalid` with the file, the line and the statement.
pub(super) fn parse_file(files: &AssetDir, name: &str) -> Result<ObjFile> {
    ObjFile::parse(&files.read(name, MAX_MODEL_BYTES)?).map_err(|error| error.prefix_field(&format!("file '{name}'")))
}

/// Adds the materials that the faces use, in the order of [`ObjFile::materials`], and their textures.
///
/// # Errors
/// `Invalid` with the material and the statement.
pub(super) fn add_materials(obj: &ObjFile, files: &AssetDir, parts: &mut SceneParts) -> Result<()> {
    let mut texture_cache = TextureCache::default();
    let mut statements_by_name = BTreeMap::new();
    for library in &obj.libraries {
        for path in library_paths(files, library)? {
            let library_statements = mtl::parse(&files.read(&path, MAX_TEXT_BYTES)?);
            let library_statements =
                library_statements.map_err(|error| error.prefix_field(&format!("file '{path}'")))?;
            // Image names are relative to the library.
            let folder = files.within(parent_of(&path))?;
            statements_by_name
                .extend(library_statements.into_iter().map(|(name, statements)| (name, (statements, folder.clone()))));
        }
    }
    parts.remarks.extend(obj.remarks.iter().cloned());
    let mut undefined_names = Vec::new();
    for name in &obj.materials {
        let material = match statements_by_name.get(name) {
            Some((statements, folder)) => {
                material::create_material(name, statements, folder, &mut texture_cache, &mut parts.remarks)?
            }
            None if obj.libraries.is_empty() || name.is_empty() => {
                undefined_names.push(format!("'{name}'"));
                white_material(name)
            }
            None => {
                let names = statements_by_name.keys().take(MAX_LISTED_NAMES).map(String::as_str);
                let names = names.collect::<Vec<_>>().join(", ");
                return Err(invalid("usemtl", format!("a material of the libraries ({names})"), name));
            }
        };
        parts.materials.push(material);
    }
    if !undefined_names.is_empty() {
        let undefined_count = undefined_names.len();
        undefined_names.truncate(MAX_LISTED_UNDEFINED);
        parts
            .remarks
            .push(format!("undefined materials are white ({undefined_count}): {}", undefined_names.join(", ")));
    }
    parts.textures.append(&mut texture_cache.into_textures());
    Ok(())
}

fn white_material(name: &str) -> Material {
    Material { name: if name.is_empty() { "white" } else { name }.into(), double_sided: true, ..Material::default() }
}

/// The paths in an `mtllib` statement. The statement is one path if a file of this name exists, because file names may
/// contain spaces. Otherwise, spaces separate several paths.
fn library_paths(files: &AssetDir, statement: &str) -> Result<Vec<String>> {
    let path = statement.replace('\\', "/");
    if files.kind(&path)?.is_some() || !path.contains(' ') {
        return Ok(vec![path]);
    }
    Ok(path.split_ascii_whitespace().map(str::to_owned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn create_folder(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (name, text) in files {
            std::fs::write(folder.path().join(name), text).expect("a writable file");
        }
        folder
    }

    const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

    #[test]
    fn several_materials_form_one_domain_with_modes() {
        let obj = format!("mtllib a.mtl\n{TRIANGLE}usemtl red\nf 1 2 3\nusemtl blue\nf 3 2 1\n");
        let folder = create_folder(&[
            ("a.obj", obj.as_str()),
            ("a.mtl", "newmtl blue\nKd 0 0 1\nnewmtl red\nKd 1 0 0\nnewmtl unused\nmap_Kd absent.png\n"),
            ("modes.txt", "9 1\n1 0 0 0 0 0 0 0 2\n"),
        ]);
        let parts =
            read(&AssetDir::unrestricted(folder.path()), "a.obj", ModesSource::Sidecar).expect("a valid OBJ file");
        assert_eq!(parts.materials.iter().map(|material| material.name.as_str()).collect::<Vec<_>>(), ["red", "blue"]);
        assert_eq!(parts.domains.len(), 1);
        assert_eq!(parts.domains[0].material_ranges.len(), 2);
        assert_eq!(parts.shapes[0].modes.entry(2, 2, 0), 2.0);
        let parts_without_modes =
            read(&AssetDir::unrestricted(folder.path()), "a.obj", ModesSource::None).expect("a valid OBJ file");
        assert_eq!(parts_without_modes.shapes[0].modes.rank(), 0);
    }

    #[test]
    fn invalid_references_are_rejected_with_the_file() {
        let folder = create_folder(&[
            ("lib.obj", &format!("mtllib no.mtl\n{TRIANGLE}f 1 2 3\n")),
            ("use.obj", &format!("mtllib a.mtl\n{TRIANGLE}usemtl green\nf 1 2 3\n")),
            ("bad.obj", &format!("{TRIANGLE}f 1 2 9\n")),
            ("rows.obj", &format!("{TRIANGLE}f 1 2 3\n")),
            ("a.mtl", "newmtl red\n"),
        ]);
        let modes: Vec<u8> = [6i32, 1].iter().flat_map(|size| size.to_le_bytes()).chain([0; 24]).collect();
        std::fs::write(folder.path().join("rows.U.float"), modes).expect("a writable file");
        let files = AssetDir::unrestricted(folder.path());
        for (name, message) in [
            ("lib.obj", "file 'no.mtl': expected an existing file, got entity not found"),
            ("use.obj", "usemtl: expected a material of the libraries (red), got green"),
            ("bad.obj", "file 'bad.obj': line 4: f: index of v: expected 1 to 3, got 9"),
            ("rows.obj", "file 'rows.U.float': modes.rows: expected 9 (3 x 3 vertices), got 6"),
        ] {
            assert_eq!(read(&files, name, ModesSource::Sidecar).expect_err(name).to_string(), message);
        }
        let parts = read(&files, "rows.obj", ModesSource::None).expect("a valid OBJ file");
        assert_eq!(parts.materials[0].diffuse, [1.0; 3]);
        assert_eq!(parts.remarks, ["undefined materials are white (1): ''"]);
    }
}
