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
use crate::domain::{Domain, Material, Metadata, Modes, Shape, Transform};
use crate::error::{Result, invalid};
use crate::scene::SceneParts;

/// Where the modes of an OBJ file come from.
#[derive(Debug, Clone, Copy)]
pub(super) enum ModesSource {
    /// Files next to it, if any (see [`modes::find_sidecar`]).
    Sidecar,
    /// No modes: the caller provides them.
    None,
}

/// Reads the OBJ file `name` in the folder `files` as one domain. Several materials become runs.
///
/// # Errors
/// `Invalid` with the file, the line or material, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, source: ModesSource) -> Result<SceneParts> {
    let obj = parse_file(files, name)?;
    let mut parts = SceneParts::named(name.strip_suffix(".obj").unwrap_or(name));
    add_materials(&obj, files, &mut parts)?;
    let piece = build::build_all_faces(&obj).map_err(|error| error.prefix_field(&format!("file '{name}'")))?;
    let modes_file = match source {
        ModesSource::Sidecar => modes::find_sidecar(files, name)?,
        ModesSource::None => None,
    };
    let found = modes_file.as_deref().map_or(Ok(Modes::rigid()), |file| modes::read(files, file))?;
    let shape = Shape::new(piece.mesh, found);
    let place = || format!("file '{}'", modes_file.as_deref().unwrap_or(name));
    parts.shapes.push(shape.map_err(|error| error.prefix_field(&place()))?);
    parts.domains.push(Domain {
        name: parts.name.clone(),
        shape: 0,
        material: piece.material,
        material_ranges: piece.material_ranges,
        placement: Transform::IDENTITY,
        attachment: None,
        follows: None,
        rest_q: Vec::new(),
        shares_q_with: None,
        metadata: Metadata { eigenvalues: Vec::new(), notes: super::vega_config::notes(files, name)? },
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
    let mut known = BTreeMap::new();
    for library in &obj.libraries {
        for path in library_paths(files, library)? {
            let parsed = mtl::parse(&files.read(&path, MAX_TEXT_BYTES)?);
            let parsed = parsed.map_err(|error| error.prefix_field(&format!("file '{path}'")))?;
            // Image names are relative to the library.
            let folder = files.within(parent_of(&path))?;
            known.extend(parsed.into_iter().map(|(name, statements)| (name, (statements, folder.clone()))));
        }
    }
    parts.remarks.extend(obj.remarks.iter().cloned());
    let mut undefined = Vec::new();
    for name in &obj.materials {
        let made = match known.get(name) {
            Some((statements, folder)) => {
                material::material(name, statements, folder, &mut texture_cache, &mut parts.remarks)?
            }
            None if obj.libraries.is_empty() || name.is_empty() => {
                undefined.push(format!("'{name}'"));
                white_material(name)
            }
            None => {
                let names = known.keys().take(16).map(String::as_str).collect::<Vec<_>>().join(", ");
                return Err(invalid("usemtl", format!("a material of the libraries ({names})"), name));
            }
        };
        parts.materials.push(made);
    }
    if !undefined.is_empty() {
        let count = undefined.len();
        undefined.truncate(8);
        parts.remarks.push(format!("{count} materials are not defined and white: {}", undefined.join(", ")));
    }
    parts.textures.append(&mut texture_cache.into_textures());
    Ok(())
}

fn white_material(name: &str) -> Material {
    Material { name: if name.is_empty() { "white" } else { name }.into(), double_sided: true, ..Material::default() }
}

/// The files of an `mtllib` statement. It may list several files, and a file name may contain spaces.
fn library_paths(files: &AssetDir, statement: &str) -> Result<Vec<String>> {
    let build_all_faces = statement.replace('\\', "/");
    if files.kind(&build_all_faces)?.is_some() || !build_all_faces.contains(' ') {
        return Ok(vec![build_all_faces]);
    }
    Ok(build_all_faces.split_ascii_whitespace().map(str::to_owned).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn written(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().expect("a folder");
        for (name, text) in files {
            std::fs::write(folder.path().join(name), text).expect("written");
        }
        folder
    }

    const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\n";

    #[test]
    fn several_materials_stay_one_domain_with_runs_and_modes() {
        let obj = format!("mtllib a.mtl\n{TRIANGLE}usemtl red\nf 1 2 3\nusemtl blue\nf 3 2 1\n");
        let folder = written(&[
            ("a.obj", obj.as_str()),
            ("a.mtl", "newmtl blue\nKd 0 0 1\nnewmtl red\nKd 1 0 0\nnewmtl unused\nmap_Kd absent.png\n"),
            ("modes.txt", "9 1\n1 0 0 0 0 0 0 0 2\n"),
        ]);
        let parts = read(&AssetDir::unrestricted(folder.path()), "a.obj", ModesSource::Sidecar).expect("good");
        assert_eq!(parts.materials.iter().map(|material| material.name.as_str()).collect::<Vec<_>>(), ["red", "blue"]);
        assert_eq!(parts.domains.len(), 1);
        assert_eq!(parts.domains[0].material_ranges.len(), 2);
        assert_eq!(parts.shapes[0].modes.entry(2, 2, 0), 2.0);
        let rigid = read(&AssetDir::unrestricted(folder.path()), "a.obj", ModesSource::None).expect("good");
        assert_eq!(rigid.shapes[0].modes.rank(), 0);
    }

    #[test]
    fn wrong_modes_missing_libraries_and_unknown_materials_are_refused_by_name() {
        let folder = written(&[
            ("lib.obj", &format!("mtllib no.mtl\n{TRIANGLE}f 1 2 3\n")),
            ("use.obj", &format!("mtllib a.mtl\n{TRIANGLE}usemtl green\nf 1 2 3\n")),
            ("bad.obj", &format!("{TRIANGLE}f 1 2 9\n")),
            ("rows.obj", &format!("{TRIANGLE}f 1 2 3\n")),
            ("a.mtl", "newmtl red\n"),
        ]);
        let modes: Vec<u8> = [6i32, 1].iter().flat_map(|size| size.to_le_bytes()).chain([0; 24]).collect();
        std::fs::write(folder.path().join("rows.U.float"), modes).expect("written");
        let files = AssetDir::unrestricted(folder.path());
        for (name, refusal) in [
            ("lib.obj", "file 'no.mtl': expected a file that is there, got entity not found"),
            ("use.obj", "usemtl: expected a material of the libraries (red), got green"),
            ("bad.obj", "file 'bad.obj': line 4: f: index of v: expected 1 to 3, got 9"),
            ("rows.obj", "file 'rows.U.float': modes.rows: expected 9 (3 x 3 vertices), got 6"),
        ] {
            assert_eq!(read(&files, name, ModesSource::Sidecar).expect_err(name).to_string(), refusal);
        }
        let white_material = read(&files, "rows.obj", ModesSource::None).expect("good");
        assert_eq!(white_material.materials[0].diffuse, [1.0; 3]);
        assert_eq!(white_material.remarks, ["1 materials are not defined and white: ''"]);
    }
}
