//! Loader of OBJ files, with their MTL libraries, images, modes and Vega configuration, as scenes of one domain.

mod material;
mod mtl;
mod parse;

use std::collections::{BTreeMap, HashSet};

pub(super) use material::DEFAULT_ALPHA_CUTOFF;
use parse::ObjFile;

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, MAX_TEXT_BYTES, ReferencedFile, parent_of, stem_of};
use super::surface::{self, ModelOptions};
use super::texture_cache::TextureCache;
use crate::domain::Material;
use crate::error::{Result, invalid};
use crate::scene::{Lighting, SceneParts};

/// The largest number of material names in an error message.
const MAX_LISTED_NAMES: usize = 16;
/// The stand-in for a missing material library, for a remark.
const MISSING_LIBRARY: &str = "the default color is drawn for its materials";
/// The largest number of names of undefined materials in a remark.
const MAX_LISTED_UNDEFINED: usize = 8;

/// Reads the OBJ file `name` in the folder `files` as one domain. Each material becomes a range of triangles.
///
/// # Errors
/// `Invalid` with the file, the line or material, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, options: ModelOptions) -> Result<SceneParts> {
    let obj = parse_file(files, name)?;
    let mut parts = SceneParts::named(stem_of(name));
    if !add_materials(&obj, files, &mut parts)? {
        parts.look = Lighting::Studio.settings();
    }
    surface::add_domain(files, name, &obj.polygons, options, None, &mut parts)?;
    Ok(parts)
}

/// Parses the OBJ file `name`.
///
/// # Errors
/// `Invalid` with the file, the line and the statement.
pub(super) fn parse_file(files: &AssetDir, name: &str) -> Result<ObjFile> {
    let content = files.read(name, MAX_MODEL_BYTES)?;
    let memory = files.reserve_polygons(name, content.len())?;
    let in_file = |error: crate::error::Error| error.prefix_field(&format!("file '{name}'"));
    let mut obj = ObjFile::parse(&content, memory).map_err(in_file)?;
    obj.remarks.extend(obj.polygons.corrections.remarks(files.is_strict()).map_err(in_file)?);
    Ok(obj)
}

/// Parses the text of a test, without materials.
#[cfg(test)]
pub(super) fn parse_obj(text: &str) -> super::polygons::PolygonMesh {
    ObjFile::parse(text.as_bytes(), None).expect("a valid OBJ file").polygons
}

/// Adds the materials that the faces use, in the order of [`super::polygons::PolygonMesh::materials`], and their
/// textures.
///
/// A material without definition is [`Material::unspecified`], and a library or image that is not found is left out.
/// In strict mode, each of these cases is an error. Returns whether the libraries define materials.
///
/// # Errors
/// `Invalid` with the material and the statement.
pub(super) fn add_materials(obj: &ObjFile, files: &AssetDir, parts: &mut SceneParts) -> Result<bool> {
    let mut texture_cache = TextureCache::default();
    let mut statements_by_name = BTreeMap::new();
    let mut has_all_libraries = true;
    let (mut references, mut read_paths) = (HashSet::new(), HashSet::new());
    for library in &obj.libraries {
        for reference in library_references(files, library) {
            if !references.insert(reference) {
                continue;
            }
            let subject = format!("material library '{reference}'");
            let path = files.find_referenced(reference, &subject, MISSING_LIBRARY, &mut parts.remarks)?;
            let Some(path) = path else {
                has_all_libraries = false;
                continue;
            };
            if !read_paths.insert(path.clone()) {
                continue;
            }
            let library_statements = mtl::parse(&files.read(&path, MAX_TEXT_BYTES)?);
            let library_statements =
                library_statements.map_err(|error| error.prefix_field(&format!("file '{path}'")))?;
            // Image names are relative to the library.
            let folder = files.within_scene(parent_of(&path))?;
            statements_by_name
                .extend(library_statements.into_iter().map(|(name, statements)| (name, (statements, folder.clone()))));
        }
    }
    parts.remarks.extend(obj.remarks.iter().cloned());
    let mut undefined_names = Vec::new();
    for name in &obj.polygons.materials {
        let material = match statements_by_name.get(name) {
            Some((statements, folder)) => {
                material::create_material(name, statements, folder, &mut texture_cache, &mut parts.remarks)?
            }
            None if !files.is_strict() || obj.libraries.is_empty() || name.is_empty() => {
                // Faces before any `usemtl` have a material without a name.
                if !name.is_empty() {
                    undefined_names.push(format!("'{name}'"));
                }
                Material::unspecified(name)
            }
            None => {
                let names = statements_by_name.keys().take(MAX_LISTED_NAMES).map(String::as_str);
                let names = names.collect::<Vec<_>>().join(", ");
                return Err(invalid("usemtl", format!("a material of the libraries ({names})"), name));
            }
        };
        parts.materials.push(material);
    }
    // The remark on a missing library says enough.
    if has_all_libraries && !undefined_names.is_empty() {
        let undefined_count = undefined_names.len();
        undefined_names.truncate(MAX_LISTED_UNDEFINED);
        parts.remarks.push(format!(
            "undefined materials have the default color ({undefined_count}): {}",
            undefined_names.join(", ")
        ));
    }
    parts.textures.append(&mut texture_cache.into_textures());
    Ok(!statements_by_name.is_empty())
}

/// The references to files in an `mtllib` statement. The statement is one reference if a file has its name, because file
/// names may contain spaces. Otherwise, spaces separate several references, if there is a file for one of them.
fn library_references<'a>(files: &AssetDir, statement: &'a str) -> Vec<&'a str> {
    let is_exact = |reference: &str| matches!(files.locate(reference), ReferencedFile::Exact(_));
    let is_found = |reference: &str| !matches!(files.locate(reference), ReferencedFile::Missing { .. });
    let words: Vec<&str> = statement.split_ascii_whitespace().take(parse::MAX_LIBRARIES).collect();
    let is_whole = words.len() < 2 || is_exact(statement);
    let is_list = |words: &[&str]| {
        words.iter().any(|word| is_exact(word)) || (!is_found(statement) && words.iter().any(|word| is_found(word)))
    };
    if !is_whole && is_list(&words) { words } else { vec![statement] }
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
            read(&AssetDir::unrestricted(folder.path()), "a.obj", ModelOptions::default()).expect("a valid OBJ file");
        assert_eq!(parts.materials.iter().map(|material| material.name.as_str()).collect::<Vec<_>>(), ["red", "blue"]);
        assert_eq!(parts.domains.len(), 1);
        assert_eq!(parts.domains[0].material_ranges.len(), 2);
        assert_eq!(parts.shapes[0].modes.entry(2, 2, 0), 2.0);
        let parts_without_modes = read(&AssetDir::unrestricted(folder.path()), "a.obj", ModelOptions::without_modes())
            .expect("a valid OBJ file");
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
            ("lib.obj", "file 'no.mtl': expected an existing file, got none (strict mode)"),
            ("use.obj", "usemtl: expected a material of the libraries (red), got green"),
            ("bad.obj", "file 'bad.obj': line 4: f: index of v: expected 1 to 3, got 9"),
            ("rows.obj", "file 'rows.U.float': modes.rows: expected 9 (3 x 3 vertices), got 6"),
        ] {
            assert_eq!(read(&files.strict(), name, ModelOptions::default()).expect_err(name).to_string(), message);
        }
        let parts = read(&files, "rows.obj", ModelOptions::without_modes()).expect("a valid OBJ file");
        assert_eq!(parts.materials[0], Material::unspecified(""));
        assert!(parts.remarks.is_empty(), "{:?}", parts.remarks);
    }

    #[test]
    fn missing_libraries_and_images_are_remarks_with_their_stand_ins() {
        let folder = create_folder(&[
            ("lib.obj", &format!("mtllib no.mtl\n{TRIANGLE}usemtl bark\nf 1 2 3\n")),
            ("use.obj", &format!("mtllib a.mtl\n{TRIANGLE}usemtl green\nf 1 2 3\n")),
            ("map.obj", &format!("mtllib a.mtl\n{TRIANGLE}usemtl red\nf 1 2 3\n")),
            ("a.mtl", "newmtl red\nKd 1 0 0\nmap_Kd no.png\nmap_d no.png\nnorm no.png\n"),
        ]);
        let files = AssetDir::unrestricted(folder.path());
        let read = |name: &str| read(&files, name, ModelOptions::default()).expect("a mesh with stand-ins");
        let lib = read("lib.obj");
        let stand_in = "the default color is drawn for its materials";
        assert_eq!(lib.remarks, [format!("material library 'no.mtl' does not exist: {stand_in}")]);
        assert_eq!(lib.materials[0], Material::unspecified("bark"));
        assert_eq!(read("use.obj").remarks, ["undefined materials have the default color (1): 'green'"]);
        let map = read("map.obj");
        assert_eq!((map.materials[0].diffuse, map.materials[0].color_texture), ([1.0, 0.0, 0.0], None));
        assert_eq!(map.materials[0].alpha_mode, crate::domain::AlphaMode::Opaque);
        let remark = |statement: &str, stand_in: &str| {
            format!("material 'red': {statement} 'no.png' does not exist: {stand_in}")
        };
        let expected = [
            remark("map_Kd", "the color Kd is drawn"),
            remark("map_d", "the surface is opaque"),
            remark("normal map", "the normals of the mesh are used"),
        ];
        assert_eq!(map.remarks, expected);
    }

    /// Names with blanks, several names, and paths of another computer.
    #[test]
    fn libraries_are_found_by_their_statement_or_its_words() {
        let folder = create_folder(&[
            ("a.mtl", "newmtl a\nKd 1 0 0\n"),
            ("b.mtl", "newmtl b\nKd 0 1 0\n"),
            ("my library.mtl", "newmtl c\nKd 0 0 1\n"),
        ]);
        let files = AssetDir::unrestricted(folder.path());
        for (statement, remarks) in [
            ("a.mtl b.mtl", vec![]),
            ("my library.mtl", vec![]),
            ("a.mtl no.mtl", vec!["'no.mtl' does not exist: the default color is drawn for its materials"]),
            ("no library.mtl", vec!["'no library.mtl' does not exist: the default color is drawn for its materials"]),
            ("My Library.mtl", vec!["'My Library.mtl' does not exist: 'my library.mtl' is read"]),
            (
                "C:\\my files\\a.mtl",
                vec!["'C:\\my files\\a.mtl' is outside of the folder of the scene: 'a.mtl' is read"],
            ),
            ("../a.mtl", vec!["'../a.mtl' is outside of the folder of the scene: 'a.mtl' is read"]),
            (
                "../no.mtl",
                vec![
                    "'../no.mtl' is outside of the folder of the scene: the default color is drawn for its materials; copy the file into this folder",
                ],
            ),
        ] {
            let text = format!("mtllib {statement}\n{TRIANGLE}f 1 2 3\n");
            let obj = ObjFile::parse(text.as_bytes(), None).expect(statement);
            let mut parts = SceneParts::named("a");
            add_materials(&obj, &files, &mut parts).expect(statement);
            assert_eq!(
                parts.remarks,
                remarks.iter().map(|remark| format!("material library {remark}")).collect::<Vec<_>>()
            );
        }
    }

    /// Otherwise, lines of a few bytes could cause any number of remarks, and read a library as often.
    #[test]
    fn repeated_libraries_are_read_and_remarked_once() {
        let folder = create_folder(&[("a.mtl", "newmtl a\nKd 1 0 0\n")]);
        let files = AssetDir::unrestricted(folder.path());
        let words = "no.mtl a.mtl ".repeat(100_000);
        for statements in ["mtllib no.mtl a.mtl\n".repeat(1000), format!("mtllib {words}\n")] {
            let obj = ObjFile::parse(format!("{statements}{TRIANGLE}usemtl a\nf 1 2 3\n").as_bytes(), None);
            let mut parts = SceneParts::named("a");
            add_materials(&obj.expect("a valid file"), &files, &mut parts).expect("a library");
            assert_eq!(parts.materials[0].diffuse, [1.0, 0.0, 0.0]);
            assert_eq!(parts.remarks.len(), 1, "{:?}", parts.remarks);
        }
    }

    #[test]
    fn libraries_of_two_folders_have_images_of_their_own() {
        let folder = create_folder(&[(
            "a.obj",
            &format!("mtllib a/m.mtl b/m.mtl\n{TRIANGLE}usemtl a\nf 1 2 3\nusemtl b\nf 1 2 3\n"),
        )]);
        for (name, pixel) in [("a", [255, 0, 0]), ("b", [0, 0, 255])] {
            let library = folder.path().join(name);
            std::fs::create_dir(&library).expect("a new folder");
            std::fs::write(library.join("m.mtl"), format!("newmtl {name}\nmap_Kd skin.png\n")).expect("a library");
            image::RgbImage::from_pixel(1, 1, image::Rgb(pixel)).save(library.join("skin.png")).expect("an image");
        }
        let files = AssetDir::unrestricted(folder.path());
        let scene = read(&files, "a.obj", ModelOptions::default()).expect("a textured mesh");
        let color = |material: usize| {
            scene.materials[material].color_texture.map(|texture| scene.textures[texture].rgba()[..3].to_vec())
        };
        assert_eq!((color(0), color(1)), (Some(vec![255, 0, 0]), Some(vec![0, 0, 255])));
    }

    #[test]
    fn colors_of_vertices_are_drawn_unless_there_is_an_image() {
        let colored = "v 0 0 0 1 0 0\nv 1 0 0 0 1 0\nv 0 1 0\nusemtl red\nf 1 2 3\n";
        let folder = create_folder(&[
            ("a.obj", colored),
            ("b.obj", &format!("mtllib b.mtl\n{colored}")),
            ("c.obj", &colored.replace("0 1 0 0\n", "0 255 0 0\n").replace("0 1 0\nv 0 1", "0 255 0\nv 0 1")),
            ("b.mtl", "newmtl red\nmap_Kd b.png\n"),
        ]);
        image::RgbaImage::new(1, 1).save(folder.path().join("b.png")).expect("a writable file");
        let files = AssetDir::unrestricted(folder.path());
        let read = |name: &str| read(&files, name, ModelOptions::default()).expect("a valid file");
        let parts = read("a.obj");
        // One patch of 2 x 2 texels. A vertex without a color is white.
        assert_eq!((parts.textures[0].width(), parts.materials[0].color_texture), (2, Some(0)));
        assert_eq!(parts.materials[0].diffuse, [1.0; 3], "expected no factor of the colors");
        let texels: Vec<&[u8]> = parts.textures[0].rgba().chunks_exact(4).collect();
        for color in [[255, 0, 0, 255], [0, 255, 0, 255], [255; 4]] {
            assert!(texels.contains(&&color[..]), "{color:?} is not among {texels:?}");
        }
        let masked = read("b.obj");
        assert_eq!(masked.remarks, ["colors of vertices are not used, because a material has an image"]);
        let bytes = read("c.obj");
        assert_eq!(bytes.textures[0].rgba(), parts.textures[0].rgba(), "expected colors of 0 to 255 to be scaled");
    }
}
