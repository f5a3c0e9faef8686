//! Receives meshes and modes as arrays and writes them as files that the loaders read: an OBJ file and a `.npy` file
//! per mesh, and one `scene.toml`. The scene therefore survives a restart of the server like any other upload.
//!
//! Every number is written so that the loaders read the same bits.

use std::collections::{BTreeMap, HashSet};
use std::fmt::Write as _;
use std::io::{self, BufWriter, Write};
use std::path::Path;
use std::sync::Arc;

use sha2::{Digest as _, Sha256};

use super::file_system::{FileSystem, StateFile};
use super::upload::CompleteUpload;
use super::upload_folder::UploadFolder;
use crate::admission::PermitHandle;
use crate::engine::content::ContentHash;
use crate::engine::upload_permits::UploadPermit;
use modalcast_model::domain::{Corners, CreaseAngle, MAX_RANK, Mesh, Modes, RestOrigin, Shape};
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::memory::MemoryReservation;
use modalcast_model::scene::UpAxis;

/// Limit on the domains of one upload. Each domain can have two files.
const MAX_DOMAINS: u32 = 4096;

/// Limit on the size of a domain's name in bytes.
const MAX_NAME_BYTES: usize = 256;

/// The material library of all meshes. An entry of `scene.toml` overrides the color.
const MATERIAL_LIBRARY: &str = "newmtl surface\nKd 1 1 1\n";

/// The header of an upload of arrays.
#[derive(Debug, Clone)]
pub struct ArrayUploadHeader {
    /// Name of the scene.
    pub scene: String,
    /// Number of domains.
    pub domains: u32,
    /// Sum of the sizes of all arrays.
    pub total_bytes: u64,
    /// Meters per scene unit.
    pub unit: f64,
    pub up: UpAxis,
}

/// The mesh and the modes of a domain.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum UploadedShape {
    /// Arrays of these sizes follow.
    Arrays {
        vertices: u32,
        triangles: u32,
        rank: u32,
        /// Whether the rest positions are f64 instead of f32.
        f64_positions: bool,
        /// The point that the rest positions are relative to.
        origin: [f64; 3],
    },
    /// The arrays of an earlier domain, given by its index.
    OfDomain(u32),
}

/// A domain of an upload of arrays.
#[derive(Debug, Clone)]
pub struct UploadedDomain {
    pub name: String,
    pub shape: UploadedShape,
    /// `world_from_domain` at rest: 3x4, row-major, in the range of f32.
    pub placement: [f64; 12],
    /// Linear red, green and blue.
    pub color: [f32; 3],
    /// Empty, or one eigenvalue (omega^2) per mode.
    pub eigenvalues: Vec<f64>,
    /// For arrays only: the crease angle. `None` is the default.
    pub crease_angle: Option<CreaseAngle>,
}

/// An upload of arrays in progress. Its methods block on the disk.
#[derive(Debug)]
pub struct ArrayUpload {
    header: ArrayUploadHeader,
    folder: UploadFolder,
    /// The text of `scene.toml` so far.
    manifest: String,
    /// Per domain so far, the index of the domain whose arrays it uses.
    shapes: Vec<u32>,
    /// Per domain so far, its number of modes.
    ranks: Vec<u32>,
    /// Per domain so far, the crease angle of its mesh.
    crease_angles: Vec<CreaseAngle>,
    /// Names of the domains so far.
    names: HashSet<String>,
    /// Sum of the sizes of the arrays of all domains so far, in bytes.
    declared_bytes: u64,
    open_arrays: Option<OpenArrays>,
    /// The memory of the arrays that are being received.
    memory: Arc<MemoryReservation>,
    /// Hashes of the files so far, by their names.
    hashes: BTreeMap<String, ContentHash>,
}

/// Copies of the arrays of a domain that are made when they are validated: as numbers (positions in f64), in a mesh,
/// and in columns.
const VALIDATED_COPIES: u64 = 4;

/// A new file of the upload that is hashed while it is written.
#[derive(Debug)]
struct HashedFile {
    name: String,
    file: Box<dyn StateFile>,
    hasher: Sha256,
}

impl Write for HashedFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let length = self.file.write(bytes)?;
        self.hasher.update(&bytes[..length]);
        Ok(length)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// The arrays that are being received.
#[derive(Debug)]
struct OpenArrays {
    /// Index of the domain.
    domain: u32,
    vertices: usize,
    rank: usize,
    f64_positions: bool,
    /// The point that the positions are relative to.
    origin: [f64; 3],
    /// Sizes in bytes: positions, faces and modes.
    sizes: [u64; 3],
    /// Grows with the received chunks, so that a declared size alone takes no memory.
    bytes: Vec<u8>,
}

impl OpenArrays {
    /// The arrays of a domain. `None` if the domain uses those of another one.
    fn new(domain: u32, shape: UploadedShape) -> Result<Option<Self>> {
        let UploadedShape::Arrays { vertices, triangles, rank, f64_positions, origin } = shape else { return Ok(None) };
        if vertices == 0 || triangles == 0 {
            let given = format!("{vertices} vertices, {triangles} triangles");
            return Err(invalid("vertices", "at least one vertex and one triangle", given));
        }
        if rank as usize > MAX_RANK {
            return Err(invalid("rank", format!("0 to {MAX_RANK}"), rank));
        }
        if !origin.iter().all(|coordinate| (*coordinate as f32).is_finite()) {
            return Err(invalid("origin", "finite numbers in the range of f32", format!("{origin:?}")));
        }
        // At most 2^32 vertices x 3 x 4 bytes x 512 modes, which fits in 64 bits.
        let mut sizes =
            [u64::from(vertices), u64::from(triangles), u64::from(vertices) * u64::from(rank)].map(|n| 12 * n);
        sizes[0] *= if f64_positions { 2 } else { 1 };
        let (vertices, rank) = (vertices as usize, rank as usize);
        Ok(Some(Self { domain, vertices, rank, f64_positions, origin, sizes, bytes: Vec::new() }))
    }

    /// x0 of all vertices. `bytes` are the positions as they were received.
    fn rest_positions(&self, bytes: &[u8]) -> Vec<[f64; 3]> {
        let positions: Vec<[f64; 3]> = match self.f64_positions {
            true => bytemuck::pod_collect_to_vec(bytes),
            false => {
                let positions: Vec<[f32; 3]> = bytemuck::pod_collect_to_vec(bytes);
                positions.into_iter().map(|position| position.map(f64::from)).collect()
            }
        };
        let x0 = |position: [f64; 3]| std::array::from_fn(|axis| position[axis] + self.origin[axis]);
        positions.into_iter().map(x0).collect()
    }

    fn total(&self) -> u64 {
        self.sizes.iter().sum()
    }

    fn remaining_bytes(&self) -> u64 {
        self.total() - self.bytes.len() as u64
    }
}

impl ArrayUpload {
    /// The name of the scene.
    pub fn scene(&self) -> &str {
        &self.header.scene
    }

    /// Creates a temporary folder next to the finished uploads. The arrays of a domain are in `memory` until they are on
    /// disk.
    ///
    /// # Errors
    /// `Invalid` for a number of domains or a unit out of range, `Fault` of the disk.
    pub(in crate::engine) fn begin(
        uploads: &Path,
        file_system: &Arc<dyn FileSystem>,
        header: ArrayUploadHeader,
        permit: UploadPermit,
        memory: Arc<MemoryReservation>,
    ) -> Result<Self> {
        if !(1..=MAX_DOMAINS).contains(&header.domains) {
            return Err(invalid("header.domains", format!("1 to {MAX_DOMAINS} domains"), header.domains));
        }
        if !(header.unit.is_finite() && header.unit > 0.0) {
            return Err(invalid("header.unit", "a positive number of meters", header.unit));
        }
        let folder = UploadFolder::create(uploads, file_system, &header.scene, permit)?;
        let mut upload = Self {
            header,
            folder,
            manifest: String::new(),
            shapes: Vec::new(),
            ranks: Vec::new(),
            crease_angles: Vec::new(),
            names: HashSet::new(),
            declared_bytes: 0,
            open_arrays: None,
            memory,
            hashes: BTreeMap::new(),
        };
        upload.write_text("surface.mtl", MATERIAL_LIBRARY)?;
        let (name, up, unit) = (toml_string(&upload.header.scene), upload.up(), upload.header.unit);
        upload.manifest = format!("name = {name}\nup = \"{up}\"\nunit = {unit:?}\n");
        Ok(upload)
    }

    /// The up axis of the scene and of its meshes in `scene.toml`.
    const fn up(&self) -> &'static str {
        self.header.up.name()
    }

    /// The permit of the upload.
    pub fn permit(&self) -> Option<&PermitHandle> {
        self.folder.permit()
    }

    /// Number of domains so far.
    pub const fn domain_count(&self) -> usize {
        self.shapes.len()
    }

    /// Begins the next domain.
    ///
    /// # Errors
    /// `Invalid` with a path below `domains[i]` for counts, names and numbers out of range; `Invalid` with
    /// `header.domains` or `header.total_bytes` for more than the header declares; `Invalid` when the arrays of the
    /// previous domain are incomplete.
    pub fn begin_domain(&mut self, domain: &UploadedDomain) -> Result<()> {
        self.check_arrays_complete()?;
        let index = self.shapes.len() as u32;
        if index >= self.header.domains {
            return Err(invalid("header.domains", self.header.domains.to_string(), index + 1));
        }
        let path = format!("domains[{index}]");
        self.add_domain(index, domain).map_err(|error| error.in_message(&path))?;
        let arrays = OpenArrays::new(index, domain.shape).map_err(|error| error.in_message(&path))?;
        let Some(arrays) = arrays else { return Ok(()) };
        self.declared_bytes = self.declared_bytes.saturating_add(arrays.total());
        if self.declared_bytes > self.header.total_bytes {
            return Err(invalid("header.total_bytes", self.header.total_bytes.to_string(), self.declared_bytes));
        }
        self.open_arrays = Some(arrays);
        Ok(())
    }

    /// Validates a domain and adds its entry to the manifest.
    fn add_domain(&mut self, index: u32, domain: &UploadedDomain) -> Result<()> {
        let is_plain_name = !domain.name.is_empty() && !domain.name.contains(char::is_control);
        if !is_plain_name || domain.name.len() > MAX_NAME_BYTES {
            let expected = format!("1 to {MAX_NAME_BYTES} bytes without control characters");
            return Err(invalid("name", expected, format!("{:?}", domain.name)));
        }
        if !self.names.insert(domain.name.clone()) {
            return Err(invalid("name", "a name that no earlier domain has", &domain.name));
        }
        let (shape, rank, crease_angle) = match domain.shape {
            UploadedShape::Arrays { rank, .. } => (index, rank, domain.crease_angle.unwrap_or_default()),
            UploadedShape::OfDomain(earlier) if earlier < index => {
                if let Some(given) = domain.crease_angle {
                    return Err(invalid("crease_angle", "none with shares_shape_with", given.degrees()));
                }
                let earlier = earlier as usize;
                (self.shapes[earlier], self.ranks[earlier], self.crease_angles[earlier])
            }
            UploadedShape::OfDomain(earlier) => {
                return Err(invalid("shares_shape_with", format!("an index below {index}"), earlier));
            }
        };
        if !domain.color.iter().all(|channel| (0.0..=1.0).contains(channel)) {
            return Err(invalid("color", "numbers from 0 to 1", format!("{:?}", domain.color)));
        }
        let has_valid_eigenvalues = domain.eigenvalues.iter().all(|value| value.is_finite());
        let count = domain.eigenvalues.len();
        if !has_valid_eigenvalues || (count > 0 && count != rank as usize) {
            return Err(invalid("eigenvalues", format!("none or {rank} finite numbers"), format!("{count} numbers")));
        }
        self.shapes.push(shape);
        self.ranks.push(rank);
        self.crease_angles.push(crease_angle);
        self.write_entry(shape, rank, crease_angle, domain);
        Ok(())
    }

    /// Appends the entry of a domain to the manifest. `{:?}` prints f64 with all digits that they need. The crease
    /// angle is written also if it is the default, so that the scene keeps it when a later version has another default.
    fn write_entry(&mut self, shape: u32, rank: u32, crease_angle: CreaseAngle, domain: &UploadedDomain) {
        let modes = if rank > 0 { format!("{shape}.npy") } else { String::new() };
        let up = self.up();
        let text = format!(
            "\n[[domain]]\nname = {}\nmodel = \"{shape}.obj\"\nmodes = \"{modes}\"\nup = \"{up}\"\nplacement.matrix = {:?}\n\
             material.diffuse = {:?}\ncrease_angle = {:?}\n",
            toml_string(&domain.name),
            domain.placement,
            domain.color.map(f64::from),
            crease_angle.degrees(),
        );
        self.manifest.push_str(&text);
        if !domain.eigenvalues.is_empty() {
            writeln!(self.manifest, "eigenvalues = {:?}", domain.eigenvalues).ok(); // A `String` accepts all text.
        }
    }

    /// Appends bytes to the arrays of the current domain. The last chunk of the domain validates and writes the arrays.
    ///
    /// # Errors
    /// `Invalid` when the bytes exceed the declared size, or with a path below `domains[i]` for invalid arrays;
    /// `OutOfMemory`; `Fault` of the disk.
    pub fn write_chunk(&mut self, bytes: &[u8]) -> Result<()> {
        let chunk_bytes = bytes.len() as u64;
        let Some(arrays) = self.open_arrays.as_mut().filter(|arrays| chunk_bytes <= arrays.remaining_bytes()) else {
            let remaining_bytes = self.open_arrays.as_ref().map_or(0, OpenArrays::remaining_bytes);
            let expected = format!("at most {remaining_bytes} bytes (the rest of the arrays)");
            return Err(invalid("chunk", expected, format!("{chunk_bytes} bytes")));
        };
        let object = format!("arrays of domain {}", arrays.domain);
        self.memory.reserve(&object, chunk_bytes)?;
        arrays.bytes.extend_from_slice(bytes);
        match self.open_arrays.take_if(|arrays| arrays.remaining_bytes() == 0) {
            None => Ok(()),
            Some(arrays) => {
                let copies = self.memory.reserve_temporary(&object, VALIDATED_COPIES * arrays.total())?;
                let path = format!("domains[{}]", arrays.domain);
                self.write_arrays(&arrays).map_err(|error| error.in_message(&path))?;
                drop((arrays, copies));
                self.memory.resize(&object, 0)
            }
        }
    }

    /// Creates a file of the upload.
    fn create_file(&self, name: &str) -> io::Result<BufWriter<HashedFile>> {
        let file = self.folder.file_system().create_file(&self.folder.path().join(name), true)?;
        Ok(BufWriter::new(HashedFile { name: name.to_owned(), file, hasher: Sha256::new() }))
    }

    /// Records the hash of a complete file. All files are synced together when the upload is complete.
    fn finish_file(&mut self, file: BufWriter<HashedFile>) -> io::Result<()> {
        let HashedFile { name, hasher, .. } = file.into_inner().map_err(io::IntoInnerError::into_error)?;
        self.hashes.insert(name, hasher.finalize().into());
        Ok(())
    }

    fn write_text(&mut self, name: &str, text: &str) -> Result<()> {
        let mut write = || -> io::Result<()> {
            let mut file = self.create_file(name)?;
            file.write_all(text.as_bytes())?;
            self.finish_file(file)
        };
        write().map_err(fault_in("upload"))
    }

    /// Validates complete arrays and writes their files.
    fn write_arrays(&mut self, arrays: &OpenArrays) -> Result<()> {
        let (positions, remainder) = arrays.bytes.split_at(arrays.sizes[0] as usize);
        let (faces, modes) = remainder.split_at(arrays.sizes[1] as usize);
        let positions = arrays.rest_positions(positions);
        let faces: Vec<[u32; 3]> = bytemuck::pod_collect_to_vec(faces);
        let modes: Vec<f32> = bytemuck::pod_collect_to_vec(modes);
        check_arrays(arrays, &positions, &faces, &modes)?;
        let mut write_files = || -> io::Result<()> {
            let mut file = self.create_file(&format!("{}.obj", arrays.domain))?;
            write_obj(&mut file, &positions, &faces)?;
            self.finish_file(file)?;
            if arrays.rank == 0 {
                return Ok(());
            }
            let mut file = self.create_file(&format!("{}.npy", arrays.domain))?;
            write_npy(&mut file, arrays, &modes)?;
            self.finish_file(file)
        };
        write_files().map_err(fault_in("upload"))
    }

    /// Completes the upload. On failure, removes its files.
    ///
    /// # Errors
    /// `Invalid` when domains or arrays are missing, `Fault` of the disk.
    pub(in crate::engine) fn finish(mut self) -> Result<CompleteUpload> {
        let manifest = std::mem::take(&mut self.manifest);
        if let Err(error) = self.check_complete().and_then(|()| self.write_text("scene.toml", &manifest)) {
            self.discard();
            return Err(error);
        }
        let Self { header, folder, hashes, .. } = self;
        CompleteUpload::new(header.scene, String::new(), folder, &hashes)
    }

    fn check_complete(&self) -> Result<()> {
        self.check_arrays_complete()?;
        if self.shapes.len() != self.header.domains as usize {
            return Err(invalid("header.domains", self.header.domains.to_string(), self.shapes.len()));
        }
        if self.declared_bytes != self.header.total_bytes {
            return Err(invalid("header.total_bytes", self.header.total_bytes.to_string(), self.declared_bytes));
        }
        Ok(())
    }

    /// Fails if the arrays of the last domain are incomplete.
    fn check_arrays_complete(&self) -> Result<()> {
        match &self.open_arrays {
            None => Ok(()),
            Some(arrays) => {
                let field = format!("domains[{}]", arrays.domain);
                Err(invalid(field, format!("{} bytes", arrays.total()), format!("{} bytes", arrays.bytes.len())))
            }
        }
    }

    /// Removes the files. Blocks on the disk.
    pub fn discard(self) {
        self.folder.discard();
    }
}

/// Validates arrays with the constructors that the loaders also use.
fn check_arrays(arrays: &OpenArrays, positions: &[[f64; 3]], faces: &[[u32; 3]], modes: &[f32]) -> Result<()> {
    let vertices = (0..arrays.vertices as u32).collect();
    let corners = Corners { vertices, normals: vec![[0.0, 0.0, 1.0]; arrays.vertices], uvs: Vec::new() };
    // The loader accepts positions in the range of f32.
    let rounded_positions = positions.iter().map(|position| position.map(|number| number as f32)).collect();
    let mesh = Mesh::new(rounded_positions, corners, faces.to_vec())?;
    let modes = Modes::from_rows(3 * arrays.vertices, arrays.rank, modes)?;
    Shape::new(mesh, modes).map(drop)
}

/// Writes a triangle mesh. `{:?}` prints numbers with all digits that they need: those of f32, or of f64 if the loader
/// reads the positions relative to an origin. Indices of OBJ files begin at 1.
fn write_obj(file: &mut impl Write, positions: &[[f64; 3]], faces: &[[u32; 3]]) -> io::Result<()> {
    writeln!(file, "mtllib surface.mtl\nusemtl surface")?;
    let drawn = faces.as_flattened().iter().map(|vertex| *vertex as usize);
    let rest = RestOrigin::choose(positions, drawn);
    if rest.origin == [0.0; 3] {
        for [x, y, z] in rest.positions {
            writeln!(file, "v {x:?} {y:?} {z:?}")?;
        }
    } else {
        for [x, y, z] in positions {
            writeln!(file, "v {x:?} {y:?} {z:?}")?;
        }
    }
    for face in faces {
        let [a, b, c] = face.map(|vertex| u64::from(vertex) + 1);
        writeln!(file, "f {a} {b} {c}")?;
    }
    Ok(())
}

/// Writes U as a NumPy file of version 1: 3n x r f32, row-major.
fn write_npy(file: &mut impl Write, arrays: &OpenArrays, modes: &[f32]) -> io::Result<()> {
    let (rows, columns) = (3 * arrays.vertices, arrays.rank);
    let header = format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({rows}, {columns}), }}");
    // The magic and the length take 10 bytes. The header is padded so that the data begin at byte 128.
    file.write_all(b"\x93NUMPY\x01\x00\x76\x00")?;
    writeln!(file, "{header:<117}")?;
    file.write_all(bytemuck::cast_slice(modes))
}

/// A text without control characters as a TOML string.
fn toml_string(text: &str) -> String {
    format!("\"{}\"", text.replace('\\', "\\\\").replace('"', "\\\""))
}
