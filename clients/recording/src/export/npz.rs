//! Writes recordings as NumPy arrays.

use std::collections::HashSet;
use std::fs::File;
use std::io::{BufWriter, Write as _};
use std::path::Path;

use modalcast_client::SceneDescription;
use zip::write::SimpleFileOptions;
use zip::{CompressionMethod, ZipWriter};

use super::tracks::{StateTimes, for_each_track};
use crate::error::{Error, Result};
use crate::reader::{Recording, SURFACE_ARRAYS};

/// Writes a `.npz` file:
///
/// | array | shape | content |
/// |---|---|---|
/// | `time` | steps | seconds since the first state, f64 |
/// | `step`, `run` | steps | number and run of the step, u64 |
/// | `names` | domains | names of the domains, as in the names of their arrays |
/// | `shapes` | domains | index k of the shape of each domain, u32 |
/// | `shape_k/x0`, `shape_k/faces`, `shape_k/U` | n x 3, m x 3, 3n x r | rest positions, triangles of vertices, modes |
/// | `NAME/q`, `NAME/T` | steps x r, steps x 3 x 4 | coordinates (f32), and transforms (f64) in scene units relative to the scene's origin |
///
/// `x0` is f32, or f64 for a shape that is far from the origin of its frame. A vertex is at x = T (x0 + U q). The
/// second one of two domains with the same name has the name `NAME#INDEX`.
///
/// # Errors
/// `Unavailable` if the recording has only the hashes of its contents; `InvalidFile` if it is damaged; `File` if the
/// file cannot be written.
pub fn export_npz(recording: &Recording, out: &Path) -> Result<()> {
    let description = recording.read_description(&SURFACE_ARRAYS, false)?;
    let selected = StateTimes::read(recording)?;
    let file = File::create(out).map_err(|error| Error::open(out, &error))?;
    let mut archive = Archive { zip: ZipWriter::new(BufWriter::new(file)), path: out };
    let steps = selected.count();
    archive.add("time", "<f8", &[steps], bytemuck::cast_slice(&selected.times))?;
    archive.add("step", "<u8", &[steps], bytemuck::cast_slice(&selected.steps))?;
    archive.add("run", "<u8", &[steps], bytemuck::cast_slice(&selected.runs))?;
    let names = unique_names(&description);
    archive.add_names(&names)?;
    let shapes: Vec<u32> = description.domains.iter().map(|domain| domain.shape as u32).collect();
    archive.add("shapes", "<u4", &[shapes.len()], bytemuck::cast_slice(&shapes))?;
    for (index, shape) in description.shapes.iter().enumerate() {
        let faces: Vec<u32> = shape.indices.iter().map(|corner| shape.corner_vertices[*corner as usize]).collect();
        let name = |array: &str| format!("shape_{index}/{array}");
        let size = [shape.vertex_count, 3];
        if shape.has_origin() {
            let positions = shape.local_positions().iter().zip(shape.origin.iter().cycle());
            let exact_positions: Vec<f64> = positions.map(|(v, origin)| f64::from(*v) + origin).collect();
            archive.add(&name("x0"), "<f8", &size, bytemuck::cast_slice(&exact_positions))?;
        } else {
            archive.add(&name("x0"), "<f4", &size, bytemuck::cast_slice(&shape.rest_positions))?;
        }
        archive.add(&name("faces"), "<u4", &[shape.triangle_count, 3], bytemuck::cast_slice(&faces))?;
        let modes = bytemuck::cast_slice(&shape.modes);
        archive.add(&name("U"), "<f4", &[3 * shape.vertex_count, shape.rank], modes)?;
    }
    for_each_track(recording, &selected, |domain, track| {
        let (name, rank) = (&names[domain], description.domains[domain].rank);
        archive.add(&format!("{name}/q"), "<f4", &[steps, rank], bytemuck::cast_slice(&track.q))?;
        archive.add(&format!("{name}/T"), "<f8", &[steps, 3, 4], bytemuck::cast_slice(&track.transforms))
    })?;
    archive.finish()
}

/// The names of the domains. A name that an earlier domain has gets the index of the domain, as in `NAME#INDEX`.
fn unique_names(description: &SceneDescription) -> Vec<String> {
    let mut known = HashSet::new();
    let name = |domain: &modalcast_client::Domain| {
        let name = if known.insert(domain.name.clone()) {
            domain.name.clone()
        } else {
            format!("{}#{}", domain.name, domain.index)
        };
        known.insert(name.clone());
        name
    };
    description.domains.iter().map(name).collect()
}

/// A `.npz` file.
struct Archive<'a> {
    zip: ZipWriter<BufWriter<File>>,
    path: &'a Path,
}

impl Archive<'_> {
    /// Adds a little-endian array of NumPy's type `descr`.
    fn add(&mut self, name: &str, descr: &str, shape: &[usize], bytes: &[u8]) -> Result<()> {
        // Sizes above 4 GiB need another format of the archive.
        let options = SimpleFileOptions::default()
            .compression_method(CompressionMethod::Stored)
            .large_file(bytes.len() as u64 >= u64::from(u32::MAX >> 1));
        let error = |error: &dyn std::fmt::Display| Error::file(self.path, error);
        self.zip.start_file(format!("{name}.npy"), options).map_err(|cause| error(&cause))?;
        self.zip.write_all(&npy_header(descr, shape)).map_err(|cause| error(&cause))?;
        self.zip.write_all(bytes).map_err(|cause| error(&cause))
    }

    /// Adds the array `names` of UTF-32 texts of equal length.
    fn add_names(&mut self, names: &[String]) -> Result<()> {
        let length = names.iter().map(|name| name.chars().count()).max().unwrap_or(0).max(1);
        let padded =
            |name: &String| name.chars().map(u32::from).chain(std::iter::repeat(0)).take(length).collect::<Vec<_>>();
        let codes: Vec<u32> = names.iter().flat_map(padded).collect();
        self.add("names", &format!("<U{length}"), &[names.len()], bytemuck::cast_slice(&codes))
    }

    fn finish(self) -> Result<()> {
        let path = self.path;
        let mut file = self.zip.finish().map_err(|error| Error::file(path, error))?;
        file.flush().map_err(|error| Error::file(path, error))
    }
}

/// The header of a `.npy` file of format version 1.0: a dictionary, padded so that the data begin at a multiple of 64.
fn npy_header(descr: &str, shape: &[usize]) -> Vec<u8> {
    const PREFIX_BYTES: usize = 10;
    let shape: String = shape.iter().map(|size| format!("{size}, ")).collect();
    let dictionary = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}");
    let length = (PREFIX_BYTES + dictionary.len() + 1).next_multiple_of(64) - PREFIX_BYTES;
    let mut header = b"\x93NUMPY\x01\x00".to_vec();
    header.extend((length as u16).to_le_bytes());
    header.extend(dictionary.as_bytes());
    header.resize(PREFIX_BYTES + length - 1, b' ');
    header.push(b'\n');
    header
}
