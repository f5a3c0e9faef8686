//! Loader of NumPy archives with a mesh: the arrays `vertices` (n x 3) and `faces` (m x 3 or m x 4), and optionally
//! `U`, `eigenvalues`, `normals` (n x 3), `uvs` (n x 2, with (0, 0) at the top left) and `colors` (n x 3 or n x 4,
//! sRGB, 0 to 1, or 0 to 255 if any value is above 1).

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, stem_of};
use super::modes::{LoadedModes, NpzArchive, has_arrays, parse_f64, read_npz_modes};
use super::polygons::{Corner, NO_INDEX, PolygonMesh};
use super::surface::{self, ModelOptions};
use crate::domain::Material;
use crate::error::{Result, invalid};
use crate::scene::{SceneParts, UpAxis};

/// The arrays that are read. Other arrays are named in a remark.
const ARRAY_NAMES: [&str; 8] = ["vertices", "faces", "U", "modes", "eigenvalues", "normals", "uvs", "colors"];

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
    let (polygons, own_modes) =
        parse(files, &content, &mut parts.remarks).map_err(|error| error.prefix_field(&format!("file '{name}'")))?;
    parts.materials.push(Material::unspecified(""));
    surface::add_domain(files, name, &polygons, options, own_modes, &mut parts)?;
    Ok(parts)
}

fn parse(files: &AssetDir, bytes: &[u8], remarks: &mut Vec<String>) -> Result<(PolygonMesh, Option<LoadedModes>)> {
    let mut archive = NpzArchive::open(bytes, files.memory())?;
    let missing = |archive: &NpzArchive<'_>| {
        invalid("archive", "the arrays vertices and faces, and optionally U", archive.list_names())
    };
    let Some(positions) = read_vectors::<3>(&mut archive, "vertices", None)? else { return Err(missing(&archive)) };
    let count = positions.len();
    let Some((sides, faces)) = read_rows(&mut archive, "faces", &[3, 4], None)? else { return Err(missing(&archive)) };
    let mut polygons = PolygonMesh::with_one_material(positions);
    polygons.memory = files.reserve_polygons("faces", 0)?;
    polygons.normals = read_vectors::<3>(&mut archive, "normals", Some(count))?.unwrap_or_default();
    polygons.uvs = read_vectors::<2>(&mut archive, "uvs", Some(count))?.unwrap_or_default();
    polygons.colors = read_colors(&mut archive, count)?;
    let (has_normals, has_uvs) = (!polygons.normals.is_empty(), !polygons.uvs.is_empty());
    for (index, face) in faces.chunks_exact(sides).enumerate() {
        let wrong = face.iter().find(|vertex| !(vertex.fract() == 0.0 && (0.0..count as f64).contains(*vertex)));
        if let Some(vertex) = wrong {
            return Err(invalid(format!("array 'faces': row {index}"), format!("0 to {}", count - 1), vertex));
        }
        let corner = |vertex: &f64| {
            let vertex = *vertex as u32;
            let index_if = |exists: bool| if exists { vertex } else { NO_INDEX };
            Corner { vertex, uv: index_if(has_uvs), normal: index_if(has_normals) }
        };
        polygons.add_face(face.iter().map(corner), 0, index)?;
    }
    polygons.check(|face| format!("array 'faces': row {face}"), 0)?;
    let has_modes = archive.names().iter().any(|name| name == "U" || name == "modes");
    let modes = if has_modes { Some(read_npz_modes(&mut archive)?) } else { None };
    let unused: Vec<&str> =
        archive.names().iter().map(String::as_str).filter(|name| !ARRAY_NAMES.contains(name)).take(16).collect();
    if !unused.is_empty() {
        remarks.push(format!("arrays that are not used: {}", unused.join(", ")));
    }
    Ok((polygons, modes))
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
    let Some(bytes) = archive.read(name, check_shape)? else { return Ok(None) };
    let (shape, entries) = parse_f64(&bytes).map_err(|error| error.prefix_field(&format!("array '{name}'")))?;
    Ok(Some((shape[1], entries)))
}

/// Reads an array of finite vectors.
fn read_vectors<const N: usize>(
    archive: &mut NpzArchive<'_>,
    name: &str,
    count: Option<usize>,
) -> Result<Option<Vec<[f32; N]>>> {
    let Some((_, entries)) = read_rows(archive, name, &[N], count)? else { return Ok(None) };
    let vectors: Vec<[f32; N]> = entries.as_chunks::<N>().0.iter().map(|row| row.map(|entry| entry as f32)).collect();
    match vectors.iter().position(|vector| vector.iter().any(|number| !number.is_finite())) {
        None => Ok(Some(vectors)),
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
    fn invalid_arrays_are_rejected_with_their_name() {
        let faces = |faces: &[[f64; 3]]| vec![square().remove(0), ("faces", npy(&arr2(faces)))];
        let with = |name: &'static str, bytes: Vec<u8>| [square(), vec![(name, bytes)]].concat();
        for (arrays, start) in [
            (faces(&[[0.0, 1.0, 4.0]]), "array 'faces': row 0: expected 0 to 3, got 4"),
            (faces(&[[0.0, 1.0, -1.0]]), "array 'faces': row 0: expected 0 to 3, got -1"),
            (faces(&[[0.0, 1.0, f64::NAN]]), "array 'faces': row 0: expected 0 to 3, got NaN"),
            (faces(&[]), "array 'faces': shape: expected n x 3 or 4, got [0, 3]"),
            (square()[..1].to_vec(), "archive: expected the arrays vertices and faces"),
            (with("normals", npy(&arr2(&[[0.0, 0.0, 1.0]]))), "array 'normals': shape: expected 4 x 3, got [1, 3]"),
            (with("colors", npy(&arr2(&[[-1.0; 3]; 4]))), "array 'colors': expected 0 to 1, or 0 to 255"),
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
        let mut vertices = square();
        vertices[0].1 = npy(&arr2(&[[0.0, f64::INFINITY, 0.0]]));
        let message = read_arrays(&vertices).expect_err("an infinite coordinate").to_string();
        assert!(message.contains("array 'vertices': row 0: expected finite numbers"), "{message}");
    }
}
