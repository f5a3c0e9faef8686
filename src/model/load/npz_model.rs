//! Loader of NumPy archives with a mesh: the arrays `vertices` (n x 3) and `faces` (m x 3 or m x 4), and optionally
//! `U`, `eigenvalues`, `normals` (n x 3), `corner_normals` (m x 3 x 3 or m x 4 x 3), `uvs` (n x 2, with (0, 0) at the top
//! left), `colors` (n x 3 or n x 4, sRGB, 0 to 1, or 0 to 255 if any value is above 1), `face_materials` (m) with
//! `material_colors` (k x 3 or k x 4, sRGB, 0 to 1, with alpha), and `notes` (a JSON object of texts, as bytes).

use std::collections::{BTreeMap, HashMap};

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, stem_of};
use super::modes::{LoadedModes, NpzArchive, has_arrays, parse_f64, read_npz_modes, read_npz_notes};
use super::polygons::{Corner, NO_INDEX, PolygonMesh, linear_from_srgb};
use super::surface::{self, ModelOptions};
use crate::domain::{AlphaMode, Material};
use crate::error::{Result, invalid};
use crate::scene::{SceneParts, UpAxis};

/// The arrays that are read. Other arrays are named in a remark.
const ARRAY_NAMES: [&str; 12] = [
    "vertices",
    "faces",
    "U",
    "modes",
    "eigenvalues",
    "normals",
    "corner_normals",
    "uvs",
    "colors",
    "face_materials",
    "material_colors",
    "notes",
];

/// The largest number of materials.
const MAX_MATERIALS: usize = 65_536;

/// The content of an archive.
struct ParsedModel {
    polygons: PolygonMesh,
    /// In the order of [`PolygonMesh::materials`].
    materials: Vec<Material>,
    modes: Option<LoadedModes>,
    notes: BTreeMap<String, String>,
}

/// Whether the file `name` is an archive with a mesh.
pub(super) fn is_model(files: &AssetDir, name: &str) -> bool {
    has_arrays(files, name, &["vertices", "faces"])
}

/// Reads the archive `name` in the folder `files` as one domain. Z is up.
///
/// # Errors
/// `Invalid` with the file, the array, and the expected and given value.
pub(super) fn read(files: &AssetDir, name: &str, options: ModelOptions) -> Result<SceneParts> {
    let mut parts = SceneParts { up: UpAxis::Z, ..SceneParts::named(stem_of(name)) };
    let content = files.read(name, MAX_MODEL_BYTES)?;
    let model =
        parse(files, &content, &mut parts.remarks).map_err(|error| error.prefix_field(&format!("file '{name}'")))?;
    parts.materials = model.materials;
    surface::add_domain(files, name, &model.polygons, options, model.modes, &mut parts)?;
    for domain in &mut parts.domains {
        let notes = model.notes.clone();
        // The notes on the files beside the archive win.
        domain.metadata.notes = notes.into_iter().chain(std::mem::take(&mut domain.metadata.notes)).collect();
    }
    Ok(parts)
}

fn parse(files: &AssetDir, bytes: &[u8], remarks: &mut Vec<String>) -> Result<ParsedModel> {
    let mut archive = NpzArchive::open(bytes, files.memory())?;
    let missing = |archive: &NpzArchive<'_>| {
        invalid("archive", "the arrays vertices and faces, and optionally U", archive.list_names())
    };
    let Some(positions) = read_vectors::<3>(&mut archive, "vertices", None)? else { return Err(missing(&archive)) };
    let count = positions.len();
    let Some((sides, faces)) = read_rows(&mut archive, "faces", &[3, 4], None)? else { return Err(missing(&archive)) };
    let face_count = faces.len() / sides;
    let mut polygons = PolygonMesh::with_one_material(positions);
    polygons.memory = files.reserve_polygons("faces", 0)?;
    polygons.normals = read_vectors::<3>(&mut archive, "normals", Some(count))?.unwrap_or_default();
    polygons.uvs = read_vectors::<2>(&mut archive, "uvs", Some(count))?.unwrap_or_default();
    polygons.colors = read_colors(&mut archive, count)?;
    let has_normals = !polygons.normals.is_empty();
    let normals = match read_corner_normals(&mut archive, [face_count, sides])? {
        Some(_) if has_normals => {
            return Err(invalid("archive", "the array normals or corner_normals", "both"));
        }
        Some(corner_normals) => {
            polygons.normals = corner_normals.values;
            FaceNormals::OfCorners(corner_normals.indices)
        }
        None if has_normals => FaceNormals::OfVertices,
        None => FaceNormals::Missing,
    };
    let (materials, face_materials) = read_materials(&mut archive, face_count)?;
    polygons.materials = materials.iter().map(|material| material.name.clone()).collect();
    add_faces(&mut polygons, sides, &faces, &normals, &face_materials)?;
    polygons.check(|face| format!("array 'faces': row {face}"), 0)?;
    let has_modes = archive.names().iter().any(|name| name == "U" || name == "modes");
    let modes = if has_modes { Some(read_npz_modes(&mut archive)?) } else { None };
    let notes = read_npz_notes(&mut archive)?;
    let unused: Vec<&str> =
        archive.names().iter().map(String::as_str).filter(|name| !ARRAY_NAMES.contains(name)).take(16).collect();
    if !unused.is_empty() {
        remarks.push(format!("arrays that are not used: {}", unused.join(", ")));
    }
    Ok(ParsedModel { polygons, materials, modes, notes })
}

/// Where the normals of the corners of faces come from.
enum FaceNormals {
    Missing,
    /// The normal of a corner has the index of its vertex.
    OfVertices,
    /// Indices of normals, by corner in the order of the faces.
    OfCorners(Vec<u32>),
}

/// Adds the faces with `sides` corners each. `face_materials` has the material of each face, or is empty.
///
/// # Errors
/// `Invalid` with the row of an index that is not a vertex; `OutOfMemory`.
fn add_faces(
    polygons: &mut PolygonMesh,
    sides: usize,
    faces: &[f64],
    normals: &FaceNormals,
    face_materials: &[usize],
) -> Result<()> {
    let (count, has_uvs) = (polygons.positions.len(), !polygons.uvs.is_empty());
    for (index, face) in faces.chunks_exact(sides).enumerate() {
        let wrong = face.iter().find(|vertex| !(vertex.fract() == 0.0 && (0.0..count as f64).contains(*vertex)));
        if let Some(vertex) = wrong {
            return Err(invalid(format!("array 'faces': row {index}"), format!("0 to {}", count - 1), vertex));
        }
        let corner = |(corner, vertex): (usize, &f64)| {
            let vertex = *vertex as u32;
            let normal = match normals {
                FaceNormals::Missing => NO_INDEX,
                FaceNormals::OfVertices => vertex,
                FaceNormals::OfCorners(indices) => indices[sides * index + corner],
            };
            Corner { vertex, uv: if has_uvs { vertex } else { NO_INDEX }, normal }
        };
        let material = face_materials.get(index).copied().unwrap_or(0);
        polygons.add_face(face.iter().enumerate().map(corner), material, index)?;
    }
    Ok(())
}

/// Normals of the corners of faces.
struct CornerNormals {
    /// Different normals.
    values: Vec<[f32; 3]>,
    /// Indices into `values`, by corner in the order of the faces.
    indices: Vec<u32>,
}

/// Reads the normals of the corners of `faces` faces with `sides` corners each. Equal normals become one, because corners
/// of a vertex with one normal are one corner of the mesh.
fn read_corner_normals(archive: &mut NpzArchive<'_>, [faces, sides]: [usize; 2]) -> Result<Option<CornerNormals>> {
    let check_shape = |shape: &[usize]| match shape == [faces, sides, 3] {
        true => Ok(()),
        false => Err(invalid("shape", format!("{faces} x {sides} x 3"), format!("{shape:?}"))),
    };
    let Some((_, entries)) = read_entries(archive, "corner_normals", check_shape)? else { return Ok(None) };
    let vectors = finite_vectors::<3>("corner_normals", &entries)?;
    let (mut values, mut index_by_bits) = (Vec::new(), HashMap::new());
    let indices = vectors.into_iter().map(|normal| {
        *index_by_bits.entry(normal.map(f32::to_bits)).or_insert_with(|| {
            values.push(normal);
            values.len() as u32 - 1
        })
    });
    let indices = indices.collect();
    Ok(Some(CornerNormals { values, indices }))
}

/// Reads the materials, and the index of the material of each face. Without materials, there is one, and no indices.
fn read_materials(archive: &mut NpzArchive<'_>, face_count: usize) -> Result<(Vec<Material>, Vec<usize>)> {
    let colors = read_rows(archive, "material_colors", &[3, 4], None)?;
    let check_shape = |shape: &[usize]| match shape == [face_count] {
        true => Ok(()),
        false => Err(invalid("shape", format!("[{face_count}]"), format!("{shape:?}"))),
    };
    let indices = read_entries(archive, "face_materials", check_shape)?;
    let (width, colors, indices) = match (colors, indices) {
        (None, None) => return Ok((vec![Material::unspecified("")], Vec::new())),
        (Some((width, colors)), Some((_, indices))) => (width, colors, indices),
        (colors, _) => {
            let given = if colors.is_some() { "material_colors" } else { "face_materials" };
            return Err(invalid("archive", "both arrays face_materials and material_colors, or none", given));
        }
    };
    let material_count = colors.len() / width;
    if material_count > MAX_MATERIALS {
        let expected = format!("at most {MAX_MATERIALS} rows");
        return Err(invalid("array 'material_colors': shape", expected, material_count));
    }
    if let Some(entry) = colors.iter().find(|entry| !(0.0..=1.0).contains(*entry)) {
        return Err(invalid("array 'material_colors'", "0 to 1", entry));
    }
    let is_material = |index: &f64| index.fract() == 0.0 && (0.0..material_count as f64).contains(index);
    if let Some(row) = indices.iter().position(|index| !is_material(index)) {
        let expected = format!("0 to {}", material_count - 1);
        return Err(invalid(format!("array 'face_materials': row {row}"), expected, indices[row]));
    }
    let rows = colors.chunks_exact(width).enumerate();
    let materials = rows.map(|(index, color)| material_of_color(index, color)).collect();
    Ok((materials, indices.into_iter().map(|index| index as usize).collect()))
}

/// A material with an sRGB color, and alpha if the color has four channels.
fn material_of_color(index: usize, color: &[f64]) -> Material {
    let linear = [0, 1, 2].map(|channel| linear_from_srgb(color[channel] as f32));
    let alpha = color.get(3).map_or(1.0, |alpha| *alpha as f32);
    Material {
        ambient: linear,
        diffuse: linear,
        alpha,
        alpha_mode: if alpha < 1.0 { AlphaMode::Blend } else { AlphaMode::Opaque },
        ..Material::unspecified(&format!("material {index}"))
    }
}

/// Reads an array of rows. Returns the length of a row and the entries, or `None` if the archive has no such array.
/// `count` is the required number of rows.
fn read_rows(
    archive: &mut NpzArchive<'_>,
    name: &str,
    widths: &[usize],
    count: Option<usize>,
) -> Result<Option<(usize, Vec<f64>)>> {
    let check_shape = |shape: &[usize]| match shape {
        [rows, width] if widths.contains(width) && *rows > 0 && count.is_none_or(|count| count == *rows) => Ok(()),
        _ => {
            let rows = count.map_or_else(|| "n".to_owned(), |count| count.to_string());
            let widths = widths.iter().map(usize::to_string).collect::<Vec<_>>().join(" or ");
            Err(invalid("shape", format!("{rows} x {widths}"), format!("{shape:?}")))
        }
    };
    let array = read_entries(archive, name, check_shape)?;
    Ok(array.map(|(shape, entries)| (shape[1], entries)))
}

/// Reads an array of numbers. Returns its shape and the entries, or `None` if the archive has no such array.
fn read_entries(
    archive: &mut NpzArchive<'_>,
    name: &str,
    check_shape: impl Fn(&[usize]) -> Result<()>,
) -> Result<Option<(Vec<usize>, Vec<f64>)>> {
    let Some(bytes) = archive.read(name, check_shape)? else { return Ok(None) };
    parse_f64(&bytes).map(Some).map_err(|error| error.prefix_field(&format!("array '{name}'")))
}

/// Reads an array of finite vectors.
fn read_vectors<const N: usize>(
    archive: &mut NpzArchive<'_>,
    name: &str,
    count: Option<usize>,
) -> Result<Option<Vec<[f32; N]>>> {
    let Some((_, entries)) = read_rows(archive, name, &[N], count)? else { return Ok(None) };
    finite_vectors(name, &entries).map(Some)
}

/// Converts the entries of the array `name` to vectors.
fn finite_vectors<const N: usize>(name: &str, entries: &[f64]) -> Result<Vec<[f32; N]>> {
    let vectors: Vec<[f32; N]> = entries.as_chunks::<N>().0.iter().map(|row| row.map(|entry| entry as f32)).collect();
    match vectors.iter().position(|vector| vector.iter().any(|number| !number.is_finite())) {
        None => Ok(vectors),
        Some(row) => {
            Err(invalid(format!("array '{name}': row {row}"), "finite numbers", format!("{:?}", vectors[row])))
        }
    }
}

/// Reads the colors. Divides them by 255 if any value is above 1. The fourth channel is not used.
fn read_colors(archive: &mut NpzArchive<'_>, count: usize) -> Result<Vec<[f32; 3]>> {
    let Some((width, entries)) = read_rows(archive, "colors", &[3, 4], Some(count))? else { return Ok(Vec::new()) };
    let largest = entries.iter().copied().fold(0.0, f64::max);
    if let Some(entry) = entries.iter().find(|entry| !(0.0..=255.0).contains(*entry)) {
        return Err(invalid("array 'colors'", "0 to 1, or 0 to 255", entry));
    }
    let scale = if largest > 1.0 { 255.0 } else { 1.0 };
    Ok(entries.chunks_exact(width).map(|row| [0, 1, 2].map(|channel| (row[channel] / scale) as f32)).collect())
}

#[cfg(test)]
mod tests {
    use ndarray::{arr1, arr2};
    use zip::CompressionMethod;

    use super::*;
    use crate::load::modes::test_archives::{archive, npy};

    fn square() -> Vec<(&'static str, Vec<u8>)> {
        let vertices = arr2(&[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]]);
        vec![("vertices", npy(&vertices)), ("faces", npy(&arr2(&[[0_i64, 1, 2], [0, 2, 3]])))]
    }

    fn read_arrays(arrays: &[(&str, Vec<u8>)]) -> Result<SceneParts> {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let bytes = archive(arrays, CompressionMethod::Deflated);
        std::fs::write(folder.path().join("a.npz"), bytes).expect("a writable file");
        read(&AssetDir::unrestricted(folder.path()), "a.npz", ModelOptions::default())
    }

    /// NumPy stores a transposed array in Fortran's order, for example the points of scikit-fem (`mesh.p.T`).
    #[test]
    fn transposed_arrays_are_read() {
        let vertices = arr2(&[[0.0, 1.0, 1.0, 0.0], [0.0, 0.0, 1.0, 1.0], [0.0; 4]]);
        let faces = arr2(&[[0_i64, 0], [1, 2], [2, 3]]);
        let transposed =
            read_arrays(&[("vertices", npy(&vertices.reversed_axes())), ("faces", npy(&faces.reversed_axes()))]);
        let (transposed, expected) = (transposed.expect("a mesh"), read_arrays(&square()).expect("a mesh"));
        assert_eq!(transposed.shapes[0].mesh, expected.shapes[0].mesh);
    }

    /// Solvers on other machines write big-endian numbers.
    #[test]
    fn big_endian_arrays_are_read() {
        let to_big_endian = |bytes: Vec<u8>, little: &str, big: &str| {
            let end = bytes.iter().position(|byte| *byte == b'\n').expect("the end of the header") + 1;
            let header = String::from_utf8_lossy(&bytes[10..end]).replace(little, big);
            assert!(header.contains(big), "control: {header}");
            let entries = bytes[end..].chunks_exact(8).flat_map(|entry| entry.iter().rev().copied());
            [&bytes[..10], header.as_bytes(), &entries.collect::<Vec<u8>>()[..]].concat()
        };
        let [(vertices, positions), (faces, triangles)]: [_; 2] = square().try_into().expect("two arrays");
        let big_endian =
            [(vertices, to_big_endian(positions, "<f8", ">f8")), (faces, to_big_endian(triangles, "<i8", ">i8"))];
        let (read, expected) = (read_arrays(&big_endian), read_arrays(&square()));
        assert_eq!(read.expect("a mesh").shapes[0].mesh, expected.expect("a mesh").shapes[0].mesh);
    }

    #[test]
    fn archive_with_mesh_modes_and_eigenvalues_is_one_domain() {
        let mut arrays = square();
        arrays.push(("U", npy(&ndarray::Array3::from_shape_fn((4, 3, 2), |(i, c, k)| (6 * i + 2 * c + k) as f32))));
        arrays.push(("eigenvalues", npy(&arr1(&[1.0, 4.0]))));
        arrays.push(("colors", npy(&arr2(&[[255_u8, 0, 0], [255, 0, 0], [0, 0, 255], [0, 255, 0]]))));
        arrays.push(("stress", npy(&arr1(&[1.0]))));
        let parts = read_arrays(&arrays).expect("a valid archive");
        assert_eq!(parts.shapes[0].modes.entry(1, 2, 1), 11.0);
        assert_eq!(parts.domains[0].metadata.eigenvalues, [1.0, 4.0]);
        assert_eq!(parts.domains[0].metadata.notes["modes.file"], "a.npz");
        assert_eq!((parts.up, parts.textures.len()), (UpAxis::Z, 1));
        assert_eq!(parts.remarks, ["arrays that are not used: stress"]);
        crate::scene::Scene::new(parts).expect("a valid scene");
        let quads = vec![square().remove(0), ("faces", npy(&arr2(&[[0_i32, 1, 2, 3]])))];
        assert_eq!(read_arrays(&quads).expect("a quadrilateral").shapes[0].mesh.triangles().len(), 2);
    }

    #[test]
    fn equal_normals_of_corners_share_a_corner_of_the_mesh() {
        // The two triangles have the edge from 0 to 2 in common. Their normals agree at vertex 0 and differ at vertex 2.
        let (up, tilted) = ([0.0, 0.0, 1.0], [0.0, 0.6, 0.8]);
        let normals = [[up, up, up], [up, tilted, tilted]];
        let normals = ndarray::Array3::from_shape_fn((2, 3, 3), |(face, corner, axis)| normals[face][corner][axis]);
        let arrays = [square(), vec![("corner_normals", npy(&normals))]].concat();
        let corners = read_arrays(&arrays).expect("a valid archive").shapes[0].mesh.corners().clone();
        assert_eq!(corners.vertices, [0, 1, 2, 2, 3]);
        assert_eq!(corners.normals.iter().map(|normal| normal[1]).collect::<Vec<f32>>(), [0.0, 0.0, 0.0, 0.6, 0.6]);
        let smooth = read_arrays(&square()).expect("a valid archive").shapes[0].mesh.corners().clone();
        assert_eq!(smooth.vertices.len(), 4, "control: without normals in the file, a flat square has no crease");
    }

    #[test]
    fn faces_have_the_colors_of_their_materials() {
        let colors = arr2(&[[1.0_f32, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 1.0], [0.0, 0.0, 0.5, 0.25]]);
        let arrays = [("face_materials", npy(&arr1(&[2_u32, 0]))), ("material_colors", npy(&colors))];
        let parts = read_arrays(&[square(), arrays.to_vec()].concat()).expect("a valid archive");
        let domain = &parts.domains[0];
        // Triangles are sorted by material.
        let ranges: Vec<_> =
            domain.material_ranges.iter().map(|range| (range.first_triangle, range.material)).collect();
        assert_eq!((domain.material, ranges), (0, vec![(0, 0), (1, 2)]));
        assert_eq!(parts.shapes[0].mesh.triangles()[0], [0, 1, 2], "expected corners in the order of their use");
        assert_eq!((parts.materials.len(), parts.materials[0].diffuse), (3, [1.0, 0.0, 0.0]));
        assert!((parts.materials[2].diffuse[2] - 0.214).abs() < 1e-3, "{:?}", parts.materials[2].diffuse);
        assert_eq!((parts.materials[2].alpha, parts.materials[2].alpha_mode), (0.25, AlphaMode::Blend));
        assert_eq!(parts.materials[0].alpha_mode, AlphaMode::Opaque);
        crate::scene::Scene::new(parts).expect("a valid scene");
    }

    #[test]
    fn notes_of_the_archive_become_notes_of_the_domain() {
        let notes = r#"{"modes.material": "steel, 7850 kg/m\u00b3", "modes.file": "other.npz"}"#;
        let notes = npy(&arr1(notes.as_bytes()));
        let u = npy(&ndarray::Array3::from_elem((4, 3, 1), 1.0_f32));
        let parts = read_arrays(&[square(), vec![("notes", notes), ("U", u)]].concat()).expect("a valid archive");
        let notes: Vec<_> = parts.domains[0].metadata.notes.clone().into_iter().collect();
        let note = |name: &str, text: &str| (name.to_owned(), text.to_owned());
        assert_eq!(notes, [note("modes.file", "a.npz"), note("modes.material", "steel, 7850 kg/m\u{b3}")]);
        assert_eq!(parts.remarks, [""; 0]);
    }

    #[test]
    fn invalid_arrays_are_rejected_with_their_name() {
        let faces = |faces: &[[f64; 3]]| vec![square().remove(0), ("faces", npy(&arr2(faces)))];
        let with = |name: &'static str, bytes: Vec<u8>| [square(), vec![(name, bytes)]].concat();
        let with_materials = |indices: &[f64], red: f64| {
            let arrays = [with("face_materials", npy(&arr1(indices)))];
            [&arrays.concat()[..], &[("material_colors", npy(&arr2(&[[0.0; 3], [red, 0.0, 0.0]])))]].concat()
        };
        let mut corner_normals = ndarray::Array3::zeros((2, 3, 3));
        corner_normals[[0, 1, 2]] = f64::NAN;
        for (arrays, start) in [
            (faces(&[[0.0, 1.0, 4.0]]), "array 'faces': row 0: expected 0 to 3, got 4"),
            (faces(&[[0.0, 1.0, -1.0]]), "array 'faces': row 0: expected 0 to 3, got -1"),
            (faces(&[[0.0, 1.0, f64::NAN]]), "array 'faces': row 0: expected 0 to 3, got NaN"),
            (faces(&[]), "array 'faces': shape: expected n x 3 or 4, got [0, 3]"),
            (square()[..1].to_vec(), "archive: expected the arrays vertices and faces"),
            (with("normals", npy(&arr2(&[[0.0, 0.0, 1.0]]))), "array 'normals': shape: expected 4 x 3, got [1, 3]"),
            (with("colors", npy(&arr2(&[[-1.0; 3]; 4]))), "array 'colors': expected 0 to 1, or 0 to 255"),
            (with("corner_normals", npy(&arr1(&[0.0; 18]))), "array 'corner_normals': shape: expected 2 x 3 x 3"),
            (with("corner_normals", npy(&corner_normals)), "array 'corner_normals': row 1: expected finite numbers"),
            (with("face_materials", npy(&arr1(&[0, 0]))), "archive: expected both arrays face_materials and"),
            (with_materials(&[0.0, 2.0], 1.0), "array 'face_materials': row 1: expected 0 to 1, got 2"),
            (with_materials(&[0.5, 0.0], 1.0), "array 'face_materials': row 0: expected 0 to 1, got 0.5"),
            (with_materials(&[0.0], 1.0), "array 'face_materials': shape: expected [2], got [1]"),
            (with_materials(&[0.0, 0.0], 1.5), "array 'material_colors': expected 0 to 1, got 1.5"),
            (with("notes", npy(&arr1(b"{\"a\": 1}"))), "array 'notes': text: expected a JSON object of texts in"),
            (with("notes", npy(&arr1(b"\xff"))), "array 'notes': text: expected a JSON object of texts in"),
            (with("notes", npy(&arr1(&[1.0]))), "array 'notes': descr: expected u1, got <f8"),
            (with("notes", npy(&arr1(&vec![b' '; 262_145]))), "array 'notes': shape: expected at most 262144 bytes"),
            (with("eigenvalues", npy(&arr1(&[1.0]))), ""),
        ] {
            match (read_arrays(&arrays), start) {
                (Err(error), start) => {
                    let message = error.to_string();
                    assert!(message.starts_with(&format!("file 'a.npz': {start}")), "{message}");
                }
                // Eigenvalues without modes have no meaning and are not read.
                (Ok(parts), "") => assert!(parts.domains[0].metadata.eigenvalues.is_empty()),
                (Ok(_), start) => panic!("expected an error: {start}"),
            }
        }
        let both =
            [with("normals", npy(&arr2(&[[0.0; 3]; 4]))), vec![("corner_normals", npy(&corner_normals))]].concat();
        assert!(read_arrays(&both).is_err(), "expected an error for two arrays of normals");
        let mut vertices = square();
        vertices[0].1 = npy(&arr2(&[[0.0, f64::INFINITY, 0.0]]));
        let message = read_arrays(&vertices).expect_err("an infinite coordinate").to_string();
        assert!(message.contains("array 'vertices': row 0: expected finite numbers"), "{message}");
    }
}
