//! Loader of NumPy archives with a mesh: the arrays `vertices` (n x 3) and `faces` (m x 3 or m x 4), and optionally
//! `U`, `eigenvalues`, `normals` (n x 3), `corner_normals` (m x 3 x 3 or m x 4 x 3), `uvs` (n x 2, with (0, 0) at the top
//! left), `colors` (n x 3 or n x 4, sRGB, 0 to 1 or 0 to 255), `face_materials` (m) with
//! `material_colors` (k x 3 or k x 4, sRGB, 0 to 1, with alpha), `inertia` ((6 + r) x (6 + r), the masses of the six rigid
//! motions about the origin and of the modes), and `notes` (a JSON object of texts, as bytes).

use std::collections::{BTreeMap, HashMap};

use super::asset_dir::{AssetDir, MAX_MODEL_BYTES, stem_of};
use super::modes::{
    FILE_NOTE, LoadedModes, NpzArchive, declare_npz_modes, declare_npz_notes, has_arrays, parse_f64, read_npz_modes,
    read_npz_notes,
};
use super::polygons::{self, Corner, NO_INDEX, PolygonMesh, build_bytes, linear_from_srgb};
use super::surface::{self, ModelOptions};
use super::values::Corrections;
use crate::domain::{AlphaMode, Inertia, MAX_RANK, Material};
use crate::error::{Result, invalid};
use crate::scene::{Lighting, SceneParts, UpAxis};

/// The arrays that are read. Other arrays are named in a remark.
const ARRAY_NAMES: [&str; 13] = [
    "vertices",
    "faces",
    "U",
    "modes",
    "eigenvalues",
    "inertia",
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
    /// Mass properties with the modes.
    inertia: Option<Inertia>,
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
    let mut parts = SceneParts { up: UpAxis::Z, look: Lighting::Studio.settings(), ..SceneParts::named(stem_of(name)) };
    let content = files.read(name, MAX_MODEL_BYTES)?;
    let model =
        parse(files, &content, &mut parts.remarks).map_err(|error| error.prefix_field(&format!("file '{name}'")))?;
    parts.materials = model.materials;
    // The program that computes modes writes the unit of its surface as a note, and lengths in meters.
    parts.unit = model.notes.contains_key("modes.unit").then_some(1.0);
    surface::add_domain(files, name, &model.polygons, options, model.modes, &mut parts)?;
    for domain in &mut parts.domains {
        // Modes of another file, which replace those of the archive, have other masses.
        let has_own_modes = domain.metadata.notes.get(FILE_NOTE).is_some_and(|file| file == name);
        domain.metadata.inertia = model.inertia.clone().filter(|_| has_own_modes);
        let notes = model.notes.clone();
        // The notes on the files beside the archive win.
        domain.metadata.notes = notes.into_iter().chain(std::mem::take(&mut domain.metadata.notes)).collect();
        remove_foreign_forces(&mut domain.metadata.notes);
    }
    Ok(parts)
}

/// Removes the note on cubic forces beside a model whose modes `modalcast model` computed without such forces: they belong
/// to other modes.
fn remove_foreign_forces(notes: &mut BTreeMap<String, String>) {
    if notes.contains_key("modes.source") && !notes.contains_key("modes.cubic_sha256") {
        notes.remove("vega.cubic");
    }
}

fn parse(files: &AssetDir, bytes: &[u8], remarks: &mut Vec<String>) -> Result<ParsedModel> {
    let mut archive = NpzArchive::open(bytes, files.memory())?;
    let sizes = ArraySizes::declare(&mut archive)?;
    let _parsing_memory = files.reserve_temporary("parsed arrays", sizes.parsing_bytes())?;
    // The arrays are freed before the mesh is built.
    let building_bytes = build_bytes(sizes.vertices, sizes.corners()).saturating_sub(archive.reserved_bytes());
    let _building_memory = files.reserve_temporary("mesh of the arrays", building_bytes)?;
    let mut polygons = PolygonMesh::with_one_material(Vec::new());
    polygons.memory = Some(files.reserve_temporary("lists of the mesh", sizes.list_bytes())?);
    polygons.positions = read_positions(&mut archive)?;
    polygons.normals = read_vectors::<3>(&mut archive, "normals")?;
    polygons.uvs = read_vectors::<2>(&mut archive, "uvs")?;
    polygons.colors = read_colors(&mut archive)?;
    let has_normals = !polygons.normals.is_empty();
    let normals = match read_corner_normals(&mut archive)? {
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
    let (materials, face_materials) = read_materials(&mut archive, &mut polygons.corrections)?;
    polygons.materials = materials.iter().map(|material| material.name.clone()).collect();
    let faces = read_entries(&mut archive, "faces")?.unwrap_or_default().1;
    add_faces(&mut polygons, sizes.sides, &faces, &normals, &face_materials)?;
    drop((faces, normals, face_materials));
    polygons.validate(|face| format!("array 'faces': row {face}"), 0)?;
    remarks.extend(polygons.corrections.remarks(files.is_strict())?);
    let modes = sizes.modes.as_ref().map(|name| read_npz_modes(&mut archive, name)).transpose()?;
    let inertia = modes.as_ref().map(|modes| read_inertia(&mut archive, modes.modes.rank())).transpose()?.flatten();
    let notes = read_npz_notes(&mut archive)?;
    let unused: Vec<&str> =
        archive.names().iter().map(String::as_str).filter(|name| !ARRAY_NAMES.contains(name)).take(16).collect();
    if !unused.is_empty() {
        remarks.push(format!("arrays that are not used: {}", unused.join(", ")));
    }
    Ok(ParsedModel { polygons, materials, modes, inertia, notes })
}

/// Sizes from the headers of all arrays that are read.
struct ArraySizes {
    vertices: usize,
    faces: usize,
    /// Corners of each face, 3 or 4.
    sides: usize,
    has_corner_normals: bool,
    materials: usize,
    /// Name of the array of U, if there is one.
    modes: Option<String>,
}

/// Bytes per corner while equal normals of corners are searched: the normals as vectors, a map from normal to index that
/// grows, the different normals, and their indices.
const SEARCH_BYTES_PER_CORNER: u64 = 100;

/// Bytes of a material with its name, also in the list of names.
const BYTES_PER_MATERIAL: u64 = 512;

impl ArraySizes {
    /// Declares all arrays, and checks that their shapes agree.
    ///
    /// # Errors
    /// `Invalid` with the array, or if `vertices` or `faces` is missing; `OutOfMemory`.
    fn declare(archive: &mut NpzArchive<'_>) -> Result<Self> {
        let missing = |archive: &NpzArchive<'_>| {
            invalid("archive", "the arrays vertices and faces, and optionally U", archive.list_names())
        };
        let vertices = archive.declare("vertices", check_rows(&[3], None))?.ok_or_else(|| missing(archive))?[0];
        let faces = archive.declare("faces", check_rows(&[3, 4], None))?.ok_or_else(|| missing(archive))?;
        let (faces, sides) = (faces[0], faces[1]);
        archive.declare("normals", check_rows(&[3], Some(vertices)))?;
        archive.declare("uvs", check_rows(&[2], Some(vertices)))?;
        archive.declare("colors", check_rows(&[3, 4], Some(vertices)))?;
        let check_corner_normals = |shape: &[usize]| match shape == [faces, sides, 3] {
            true => Ok(()),
            false => Err(invalid("shape", format!("{faces} x {sides} x 3"), format!("{shape:?}"))),
        };
        let has_corner_normals = archive.declare("corner_normals", check_corner_normals)?.is_some();
        let check_face_materials = |shape: &[usize]| match shape == [faces] {
            true => Ok(()),
            false => Err(invalid("shape", format!("[{faces}]"), format!("{shape:?}"))),
        };
        archive.declare("face_materials", check_face_materials)?;
        let check_materials = |shape: &[usize]| match shape {
            [rows, _] if *rows > MAX_MATERIALS => Err(invalid("shape", format!("at most {MAX_MATERIALS} rows"), rows)),
            _ => check_rows(&[3, 4], None)(shape),
        };
        let materials = archive.declare("material_colors", check_materials)?.map_or(0, |shape| shape[0]);
        let has_modes = archive.names().iter().any(|name| name == "U" || name == "modes");
        let modes = if has_modes { Some(declare_npz_modes(archive)?) } else { None };
        let check_masses = |shape: &[usize]| match shape {
            [rows, columns] if rows == columns && (RIGID_MOTIONS..=RIGID_MOTIONS + MAX_RANK).contains(rows) => Ok(()),
            _ => Err(invalid("shape", "(6 + r) x (6 + r)", format!("{shape:?}"))),
        };
        archive.declare("inertia", check_masses)?;
        declare_npz_notes(archive)?;
        Ok(Self { vertices, faces, sides, has_corner_normals, materials, modes })
    }

    const fn corners(&self) -> usize {
        self.faces.saturating_mul(self.sides)
    }

    /// Largest memory in bytes while arrays are parsed, beyond that of each array.
    const fn parsing_bytes(&self) -> u64 {
        let searched_corners = if self.has_corner_normals { self.corners() } else { 0 };
        SEARCH_BYTES_PER_CORNER * searched_corners as u64 + BYTES_PER_MATERIAL * self.materials as u64
    }

    /// Largest memory in bytes of the lists of a [`PolygonMesh`].
    fn list_bytes(&self) -> u64 {
        let normals = if self.has_corner_normals { self.corners() } else { self.vertices };
        polygons::list_bytes(self.vertices, self.vertices + normals, self.vertices, self.faces, self.corners())
    }
}

/// A check of the shape of an array of rows with one of the given lengths. `count` is the required number of rows.
fn check_rows<'a>(widths: &'a [usize], count: Option<usize>) -> impl Fn(&[usize]) -> Result<()> + 'a {
    move |shape| match shape {
        [rows, width] if widths.contains(width) && *rows > 0 && count.is_none_or(|count| count == *rows) => Ok(()),
        _ => {
            let rows = count.map_or_else(|| "n".to_owned(), |count| count.to_string());
            let widths = widths.iter().map(usize::to_string).collect::<Vec<_>>().join(" or ");
            Err(invalid("shape", format!("{rows} x {widths}"), format!("{shape:?}")))
        }
    }
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

/// Reads the normals of the corners of faces. Equal normals become one, because corners of a vertex with one normal are
/// one corner of the mesh.
fn read_corner_normals(archive: &mut NpzArchive<'_>) -> Result<Option<CornerNormals>> {
    let vectors = read_vectors::<3>(archive, "corner_normals")?;
    if vectors.is_empty() {
        return Ok(None);
    }
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
fn read_materials(archive: &mut NpzArchive<'_>, corrections: &mut Corrections) -> Result<(Vec<Material>, Vec<usize>)> {
    let (colors, indices) = (read_entries(archive, "material_colors")?, read_entries(archive, "face_materials")?);
    let (width, colors, indices) = match (colors, indices) {
        (None, None) => return Ok((vec![Material::unspecified("")], Vec::new())),
        (Some((shape, colors)), Some((_, indices))) => (shape[1], colors, indices),
        (colors, _) => {
            let given = if colors.is_some() { "material_colors" } else { "face_materials" };
            return Err(invalid("archive", "both arrays face_materials and material_colors, or none", given));
        }
    };
    let material_count = colors.len() / width;
    let mut correct = |channel: f64| {
        let channel = corrections.in_range("array 'material_colors'", channel as f32, [0.0, 1.0], "1 is used");
        channel.map_or(1.0, f64::from)
    };
    let colors: Vec<f64> = colors.into_iter().map(&mut correct).collect();
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

/// Reads a declared array of numbers. Returns its shape and the entries, or `None` if the archive has no such array.
fn read_entries(archive: &mut NpzArchive<'_>, name: &str) -> Result<Option<(Vec<usize>, Vec<f64>)>> {
    let Some(bytes) = archive.read(name)? else { return Ok(None) };
    parse_f64(&bytes).map(Some).map_err(|error| error.prefix_field(&format!("array '{name}'")))
}

/// The number of rigid motions of a body: translations along the axes, then rotations about them.
const RIGID_MOTIONS: usize = 6;

/// Largest difference of a mass from that of a rigid body, as a fraction of the mass.
const RIGID_TOLERANCE: f64 = 1e-6;

/// Reads the masses of a body with `rank` modes: [[R^T M R, R^T M U], [U^T M R, U^T M U]].
///
/// # Errors
/// `Invalid` unless the array has the size of the modes, and the masses of the rigid motions are those of a rigid body.
fn read_inertia(archive: &mut NpzArchive<'_>, rank: usize) -> Result<Option<Inertia>> {
    let Some((shape, masses)) = read_entries(archive, "inertia")? else { return Ok(None) };
    let (size, in_array) = (RIGID_MOTIONS + rank, |error: crate::error::Error| error.prefix_field("array 'inertia'"));
    if shape[0] != size {
        let expected = format!("{size} x {size}, with {rank} modes");
        return Err(in_array(invalid("shape", expected, format!("{shape:?}"))));
    }
    let entry = |row: usize, column: usize| masses[row * size + column];
    let mass = entry(0, 0);
    // The rows of the rotations are m c x, so that their columns have the center of mass.
    let moment = [entry(5, 1), entry(3, 2), entry(4, 0)];
    let expected = [
        [mass, 0.0, 0.0, 0.0, moment[2], -moment[1]],
        [0.0, mass, 0.0, -moment[2], 0.0, moment[0]],
        [0.0, 0.0, mass, moment[1], -moment[0], 0.0],
    ];
    let scale = mass + moment.iter().map(|moment| moment.abs()).fold(0.0, f64::max);
    // NaN equals nothing.
    let is_equal = |a: f64, b: f64| (a - b).abs() <= RIGID_TOLERANCE * scale;
    let differs = |(row, column): (usize, usize)| {
        let is_rigid =
            is_equal(entry(row, column), expected[row][column]) && is_equal(entry(column, row), entry(row, column));
        !is_rigid
    };
    let mut translations = (0..3).flat_map(|row| (0..RIGID_MOTIONS).map(move |column| (row, column)));
    if let Some((row, column)) = translations.find(|position| differs(*position)) {
        let expected = format!("{} as of a rigid body of {mass} kg", expected[row][column]);
        return Err(in_array(invalid(format!("row {row}, column {column}"), expected, entry(row, column))));
    }
    let center = moment.map(|moment| if mass > 0.0 { moment / mass } else { 0.0 });
    let moments = [entry(3, 3), entry(4, 4), entry(5, 5), entry(3, 4), entry(3, 5), entry(4, 5)];
    let momenta = (0..RIGID_MOTIONS).flat_map(|row| (0..rank).map(move |mode| entry(row, RIGID_MOTIONS + mode)));
    let modal_rows =
        (0..rank).flat_map(|row| (0..rank).map(move |mode| entry(RIGID_MOTIONS + row, RIGID_MOTIONS + mode)));
    Inertia::new(mass, center, moments, momenta.collect(), modal_rows.collect()).map(Some).map_err(in_array)
}

/// Reads a declared array of vectors. Empty if the archive has no such array.
fn read_vectors<const N: usize>(archive: &mut NpzArchive<'_>, name: &str) -> Result<Vec<[f32; N]>> {
    let Some((_, entries)) = read_entries(archive, name)? else { return Ok(Vec::new()) };
    Ok(entries.as_chunks::<N>().0.iter().map(|row| row.map(|entry| entry as f32)).collect())
}

/// Reads the rest positions. Empty if the archive has no vertices.
fn read_positions(archive: &mut NpzArchive<'_>) -> Result<Vec<[f64; 3]>> {
    let Some((_, entries)) = read_entries(archive, "vertices")? else { return Ok(Vec::new()) };
    Ok(entries.as_chunks::<3>().0.iter().map(|row| row.map(polygons::within_f32)).collect())
}

/// Reads the colors. The fourth channel is not used.
fn read_colors(archive: &mut NpzArchive<'_>) -> Result<Vec<[f32; 3]>> {
    let Some((shape, entries)) = read_entries(archive, "colors")? else { return Ok(Vec::new()) };
    Ok(entries.chunks_exact(shape[1]).map(|row| [0, 1, 2].map(|channel| row[channel] as f32)).collect())
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

    /// Each array alone is below the limit, but not the mesh that they describe. The checksum of the vertices is wrong,
    /// which is noticed when their data are read.
    #[test]
    fn archive_beyond_the_limit_is_rejected_before_data_are_read() {
        use crate::memory::{MemoryBudget, MemoryKind, MemoryReservation};
        let arrays = [
            ("vertices", npy(&ndarray::Array2::<f64>::zeros((5000, 3)))),
            ("faces", npy(&ndarray::Array2::<i64>::zeros((5000, 3)))),
        ];
        let mut bytes = archive(&arrays, CompressionMethod::Deflated);
        let record = bytes.windows(4).position(|bytes| bytes == b"PK\x01\x02").expect("a central directory");
        bytes[record + 16] ^= 1;
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(folder.path().join("a.npz"), bytes).expect("a writable file");
        let root = folder.path().canonicalize().expect("an existing folder");
        let read_within = |bytes: u64| {
            let budget = MemoryBudget::new(MemoryKind::Host, bytes, bytes);
            let files = AssetDir::confined_to(&root, &MemoryReservation::new(&budget));
            read(&files, "a.npz", ModelOptions::default()).expect_err("an invalid archive")
        };
        // 24 bytes of a row, and 16 bytes for each of its entries while it is parsed.
        let array_bytes = (24 + 3 * 16) * 5000;
        let error = read_within(2 * array_bytes + (1 << 12));
        assert!(matches!(error, crate::error::Error::OutOfMemory { .. }), "{error}");
        let message = read_within(u64::MAX).to_string();
        assert!(message.contains("array 'vertices': data: expected a readable member"), "control: {message}");
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
        let divided = "colors of vertices are divided by 255, because they exceed 1";
        assert_eq!(parts.remarks, [divided, "arrays that are not used: stress"]);
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

    /// Masses of a body of 2 kg with its center at (0.5, 0, 1) and one mode, about the origin.
    fn masses() -> ndarray::Array2<f64> {
        let (mass, [x, _, z]) = (2.0, [0.5, 0.0, 1.0]);
        let mut masses = ndarray::Array2::<f64>::eye(7);
        for (row, column, value) in [
            (0, 0, mass),
            (1, 1, mass),
            (2, 2, mass),
            (0, 4, mass * z),
            (1, 3, -mass * z),
            (1, 5, mass * x),
            (2, 4, -mass * x),
            (3, 3, 3.0),
            (4, 4, 4.0),
            (5, 5, 2.5),
            (3, 5, -1.0),
            (0, 6, 0.125),
        ] {
            masses[[row, column]] = value;
            masses[[column, row]] = value;
        }
        masses
    }

    #[test]
    fn masses_become_the_inertia_of_the_domain() {
        let u = npy(&ndarray::Array3::from_elem((4, 3, 1), 1.0_f32));
        let read = |masses: &ndarray::Array2<f64>| {
            read_arrays(&[square(), vec![("inertia", npy(masses)), ("U", u.clone())]].concat())
        };
        let parts = read(&masses()).expect("a valid archive");
        let inertia = parts.domains[0].metadata.inertia.clone().expect("an inertia");
        assert_eq!((inertia.mass(), inertia.center(), inertia.rank()), (2.0, [0.5, 0.0, 1.0], 1));
        assert_eq!(inertia.moments(), [3.0, 4.0, 2.5, 0.0, -1.0, 0.0]);
        assert_eq!(inertia.mass_matrix(), nalgebra::DMatrix::from_fn(7, 7, |row, column| masses()[[row, column]]));
        assert_eq!(parts.remarks, [""; 0]);
        let error = |change: &dyn Fn(&mut ndarray::Array2<f64>)| {
            let mut masses = masses();
            change(&mut masses);
            read(&masses).expect_err("invalid masses").to_string()
        };
        for (message, text) in [
            (error(&|masses| masses[[1, 1]] = 3.0), "array 'inertia': row 1, column 1: expected 2 as of a rigid body"),
            (error(&|masses| masses[[0, 4]] = f64::NAN), "array 'inertia': row 0, column 4"),
            (
                error(&|masses| masses[[6, 6]] = -1.0),
                "array 'inertia': inertia: expected masses and moments of at least 0",
            ),
            (
                error(&|masses| *masses = ndarray::Array2::eye(8)),
                "array 'inertia': shape: expected 7 x 7, with 1 modes",
            ),
            (error(&|masses| *masses = ndarray::Array2::eye(5)), "array 'inertia': shape: expected (6 + r) x (6 + r)"),
        ] {
            assert!(message.contains(text), "expected {text}, got {message}");
        }
        // Without modes, the masses belong to nothing.
        let parts = read_arrays(&[square(), vec![("inertia", npy(&masses()))]].concat()).expect("a valid archive");
        assert!(parts.domains[0].metadata.inertia.is_none());
    }

    #[test]
    fn forces_beside_the_archive_are_named_unless_they_belong_to_other_modes() {
        let named = |notes: &str| {
            let folder = tempfile::tempdir().expect("a temporary folder");
            let u = npy(&ndarray::Array3::from_elem((4, 3, 1), 1.0_f32));
            let arrays = [square(), vec![("notes", npy(&arr1(notes.as_bytes()))), ("U", u)]].concat();
            std::fs::write(folder.path().join("a.npz"), archive(&arrays, zip::CompressionMethod::Stored))
                .expect("a writable file");
            std::fs::write(folder.path().join("a.cub"), "").expect("a writable file");
            let parts = read(&AssetDir::unrestricted(folder.path()), "a.npz", ModelOptions::default());
            parts.expect("a valid archive").domains[0].metadata.notes.get("vega.cubic").cloned()
        };
        assert_eq!(named("{}"), Some("a.cub".into()));
        assert_eq!(named(r#"{"modes.source": "a.msh", "modes.cubic_sha256": "00"}"#), Some("a.cub".into()));
        assert_eq!(named(r#"{"modes.source": "a.msh"}"#), None);
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
            (with("corner_normals", npy(&arr1(&[0.0; 18]))), "array 'corner_normals': shape: expected 2 x 3 x 3"),
            (with("face_materials", npy(&arr1(&[0, 0]))), "archive: expected both arrays face_materials and"),
            (with_materials(&[0.0, 2.0], 1.0), "array 'face_materials': row 1: expected 0 to 1, got 2"),
            (with_materials(&[0.5, 0.0], 1.0), "array 'face_materials': row 0: expected 0 to 1, got 0.5"),
            (with_materials(&[0.0], 1.0), "array 'face_materials': shape: expected [2], got [1]"),
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
        vertices[0].1 = npy(&arr2(&[[0.0, f64::INFINITY, 0.0], [1.0; 3], [2.0; 3], [3.0; 3]]));
        let message = read_arrays(&vertices).expect_err("an infinite coordinate").to_string();
        let expected = "array 'faces': row 0: position of vertex 0: expected finite numbers, got [0.0, inf, 0.0]";
        assert!(message.contains(expected), "{message}");
    }

    #[test]
    fn values_without_effect_are_remarks() {
        let with = |name: &'static str, bytes: Vec<u8>| [square(), vec![(name, bytes)]].concat();
        let mut corner_normals = ndarray::Array3::from_elem((2, 3, 3), 1.0);
        corner_normals[[0, 1, 2]] = f64::NAN;
        let materials = [("face_materials", npy(&arr1(&[0, 0]))), ("material_colors", npy(&arr2(&[[1.5, 0.0, 0.0]])))];
        for (arrays, start) in [
            (with("colors", npy(&arr2(&[[-1.0; 3]; 4]))), "color of a vertex: expected 0 to 1, got [-1.0, -1.0, -1.0]"),
            (with("corner_normals", npy(&corner_normals)), "normal: expected finite numbers, got [1.0, 1.0, NaN]"),
            (with("uvs", npy(&arr2(&[[f64::NAN; 2]; 4]))), "texture coordinates: expected finite numbers"),
            ([square(), materials.to_vec()].concat(), "array 'material_colors': expected 0 to 1, got 1.5: 1 is used"),
        ] {
            let parts = read_arrays(&arrays).expect(start);
            assert!(parts.remarks[0].starts_with(start), "expected {start}, got {:?}", parts.remarks);
            crate::scene::Scene::new(parts).expect("a valid scene");
        }
    }
}
