//! Loaders reserve memory before they allocate it: at every moment of a load, the bytes that are allocated are at most
//! those that are reserved, plus a constant. An allocator compares both at each allocation. The program has one test,
//! because other tests would allocate, too.

use std::alloc::{GlobalAlloc, Layout, System};
use std::fmt::Write as _;
use std::fs;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicI64, Ordering};
use std::sync::{Arc, OnceLock};

use modalcast_model::load::SceneRepository;
use modalcast_model::memory::{MemoryBudget, MemoryKind, MemoryReservation};
use ndarray::Array2;
use ndarray_npy::WriteNpyExt as _;

/// Bytes that a load may allocate without a reservation: strings, tables, the state of decoders, and a copy of the
/// positions while a glTF file is decoded.
const SLACK: i64 = 1 << 19;

/// Vertices per side of the grids. Each large array then has more bytes than [`SLACK`].
const SIDE: usize = 180;

static BUDGET: OnceLock<Arc<MemoryBudget>> = OnceLock::new();
static IS_COUNTING: AtomicBool = AtomicBool::new(false);
/// Bytes allocated since counting began. Negative if more is freed that was allocated before.
static ALLOCATED: AtomicI64 = AtomicI64::new(0);
/// Largest difference of allocated and reserved bytes.
static MAX_UNRESERVED: AtomicI64 = AtomicI64::new(0);
static MAX_ALLOCATED: AtomicI64 = AtomicI64::new(0);

/// The allocator of the system, which counts bytes.
struct CountingAllocator;

fn count(bytes: i64) {
    if !IS_COUNTING.load(Ordering::Relaxed) {
        return;
    }
    let allocated = ALLOCATED.fetch_add(bytes, Ordering::Relaxed) + bytes;
    let reserved = BUDGET.get().map_or(0, |budget| budget.reserved() as i64);
    MAX_UNRESERVED.fetch_max(allocated - reserved, Ordering::Relaxed);
    MAX_ALLOCATED.fetch_max(allocated, Ordering::Relaxed);
}

// SAFETY: all calls are forwarded to the allocator of the system. Counting allocates nothing.
unsafe impl GlobalAlloc for CountingAllocator {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        count(layout.size() as i64);
        // SAFETY: the caller keeps the contract of `GlobalAlloc::alloc`.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        count(-(layout.size() as i64));
        // SAFETY: the pointer was allocated by `System` with this layout.
        unsafe { System.dealloc(pointer, layout) }
    }

    unsafe fn realloc(&self, pointer: *mut u8, layout: Layout, new_size: usize) -> *mut u8 {
        // Large blocks are moved by the page table and not copied, so old and new block do not exist at the same time.
        count(new_size as i64 - layout.size() as i64);
        // SAFETY: the pointer was allocated by `System` with this layout.
        unsafe { System.realloc(pointer, layout, new_size) }
    }
}

#[global_allocator]
static ALLOCATOR: CountingAllocator = CountingAllocator;

/// Memory of a load in bytes.
struct LoadMemory {
    max_allocated: i64,
    /// Largest difference of allocated and reserved bytes.
    max_unreserved: i64,
}

/// Opens a model, and measures until the scene is complete.
fn measure(repository: &SceneRepository, source: &str, budget: &Arc<MemoryBudget>) -> LoadMemory {
    for counter in [&ALLOCATED, &MAX_UNRESERVED, &MAX_ALLOCATED] {
        counter.store(0, Ordering::Relaxed);
    }
    let memory = MemoryReservation::new(budget);
    IS_COUNTING.store(true, Ordering::Relaxed);
    let scene = repository.open(source, &memory);
    IS_COUNTING.store(false, Ordering::Relaxed);
    if let Err(error) = scene {
        panic!("{source}: {error}");
    }
    LoadMemory {
        max_allocated: MAX_ALLOCATED.load(Ordering::Relaxed),
        max_unreserved: MAX_UNRESERVED.load(Ordering::Relaxed),
    }
}

/// The vertices of a grid. Its surface is smooth, or has a crease at each edge.
fn grid(has_creases: bool) -> Vec<[f32; 3]> {
    let height = |index: usize| if has_creases { ((index * 7919) % 13) as f32 } else { 0.0 };
    (0..SIDE * SIDE).map(|index| [(index % SIDE) as f32, (index / SIDE) as f32, height(index)]).collect()
}

/// The triangles of a grid.
fn grid_triangles() -> Vec<[usize; 3]> {
    let cells = (0..(SIDE - 1) * (SIDE - 1)).map(|cell| cell / (SIDE - 1) * SIDE + cell % (SIDE - 1));
    cells
        .flat_map(|corner| [[corner, corner + 1, corner + SIDE], [corner + 1, corner + SIDE + 1, corner + SIDE]])
        .collect()
}

fn obj_vertices(vertices: &[[f32; 3]]) -> String {
    vertices.iter().fold(String::new(), |mut text, [x, y, z]| {
        writeln!(text, "v {x} {y} {z}").expect("a string");
        text
    })
}

fn obj_grid(has_creases: bool) -> String {
    let mut text = obj_vertices(&grid(has_creases));
    for [a, b, c] in grid_triangles() {
        writeln!(text, "f {} {} {}", a + 1, b + 1, c + 1).expect("a string");
    }
    text
}

/// Triangles without common vertices, each with a name of its own.
fn obj_separate_triangles() -> String {
    let vertices = grid(true);
    let mut text = String::new();
    for triangle in grid_triangles() {
        text += &obj_vertices(&triangle.map(|index| vertices[index]));
        text += "f -3 -2 -1\n";
    }
    text
}

/// Polygons with this number of corners, of which every second one is reflex.
fn obj_stars(corners: usize, count: usize) -> String {
    let mut text = String::new();
    for star in 0..count {
        for corner in 0..corners {
            let angle = std::f32::consts::TAU * corner as f32 / corners as f32;
            let radius = if corner % 2 == 0 { 1.0 } else { 0.5 };
            writeln!(text, "v {} {} {star}", radius * angle.cos(), radius * angle.sin()).expect("a string");
        }
        text += "f";
        for corner in 0..corners {
            write!(text, " {}", star * corners + corner + 1).expect("a string");
        }
        text += "\n";
    }
    text
}

/// A grid whose triangles have texture coordinates and normals of their own.
fn obj_with_attributes() -> String {
    let mut text = obj_vertices(&grid(true));
    for (index, [a, b, c]) in grid_triangles().into_iter().enumerate() {
        for corner in 0..3 {
            writeln!(text, "vt 0.{index} 0.{corner}\nvn 0 0 1").expect("a string");
        }
        writeln!(text, "f {}/-3/-3 {}/-2/-2 {}/-1/-1", a + 1, b + 1, c + 1).expect("a string");
    }
    text
}

/// A grid whose vertices have different colors.
fn obj_with_colors() -> String {
    let mut text = String::new();
    for (index, [x, y, z]) in grid(false).into_iter().enumerate() {
        writeln!(text, "v {x} {y} {z} 0.{} 0.{} 0.5", index % 10, index % 7).expect("a string");
    }
    for [a, b, c] in grid_triangles() {
        writeln!(text, "f {} {} {}", a + 1, b + 1, c + 1).expect("a string");
    }
    text
}

fn ply_grid() -> Vec<u8> {
    let (vertices, triangles) = (grid(true), grid_triangles());
    let mut bytes = format!(
        "ply\nformat binary_little_endian 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {}\nproperty list uchar int vertex_indices\nend_header\n",
        vertices.len(),
        triangles.len()
    )
    .into_bytes();
    bytes.extend(vertices.iter().flatten().flat_map(|coordinate| coordinate.to_le_bytes()));
    for triangle in triangles {
        bytes.push(3);
        bytes.extend(triangle.iter().flat_map(|index| (*index as i32).to_le_bytes()));
    }
    bytes
}

fn stl_grid() -> Vec<u8> {
    let (vertices, triangles) = (grid(true), grid_triangles());
    let mut bytes = vec![0; 80];
    bytes.extend((triangles.len() as u32).to_le_bytes());
    for triangle in triangles {
        bytes.extend([0; 12]);
        bytes.extend(triangle.iter().flat_map(|index| vertices[*index]).flat_map(f32::to_le_bytes));
        bytes.extend([0; 2]);
    }
    bytes
}

/// Writes a model with four modes.
fn write_npz(path: &Path) {
    let vertices = grid(true);
    let flat = vertices.iter().flatten().map(|coordinate| f64::from(*coordinate)).collect();
    let vertices = Array2::from_shape_vec((vertices.len(), 3), flat).expect("3 columns");
    let flat: Vec<i64> = grid_triangles().into_iter().flatten().map(|index| index as i64).collect();
    let faces = Array2::from_shape_vec((flat.len() / 3, 3), flat).expect("3 columns");
    let modes = Array2::from_elem((3 * vertices.nrows(), 4), 0.5_f32);
    let mut archive = zip::ZipWriter::new(fs::File::create(path).expect("a new file"));
    let options = zip::write::SimpleFileOptions::default();
    archive.start_file("vertices.npy", options).expect("a new member");
    vertices.write_npy(&mut archive).expect("a written array");
    archive.start_file("faces.npy", options).expect("a new member");
    faces.write_npy(&mut archive).expect("a written array");
    archive.start_file("U.npy", options).expect("a new member");
    modes.write_npy(&mut archive).expect("a written array");
    archive.finish().expect("a written archive");
}

fn write_gltf(folder: &Path) {
    let vertices = grid(true);
    let triangles = grid_triangles();
    let mut buffer: Vec<u8> = vertices.iter().flatten().flat_map(|coordinate| coordinate.to_le_bytes()).collect();
    let position_bytes = buffer.len();
    buffer.extend(triangles.iter().flatten().flat_map(|index| (*index as u32).to_le_bytes()));
    let text = format!(
        r#"{{"asset": {{"version": "2.0"}}, "scene": 0, "scenes": [{{"nodes": [0]}}], "nodes": [{{"mesh": 0}}],
        "meshes": [{{"primitives": [{{"attributes": {{"POSITION": 0}}, "indices": 1}}]}}],
        "buffers": [{{"uri": "grid.bin", "byteLength": {total}}}],
        "bufferViews": [{{"buffer": 0, "byteLength": {position_bytes}}},
            {{"buffer": 0, "byteOffset": {position_bytes}, "byteLength": {index_bytes}}}],
        "accessors": [{{"bufferView": 0, "componentType": 5126, "count": {count}, "type": "VEC3",
                "min": [0, 0, 0], "max": [{side}, {side}, 12]}},
            {{"bufferView": 1, "componentType": 5125, "count": {indices}, "type": "SCALAR"}}]}}"#,
        total = buffer.len(),
        index_bytes = buffer.len() - position_bytes,
        count = vertices.len(),
        side = SIDE - 1,
        indices = 3 * triangles.len(),
    );
    fs::write(folder.join("grid.gltf"), text).expect("a written file");
    fs::write(folder.join("grid.bin"), buffer).expect("a written file");
}

/// Writes a model with an image of 1024 x 1024 pixels.
fn write_textured(folder: &Path) {
    const SIDE: u32 = 1024;
    let image = image::RgbaImage::from_pixel(SIDE, SIDE, image::Rgba([1, 2, 3, 255]));
    image.save(folder.join("image.png")).expect("a written image");
    fs::write(folder.join("textured.mtl"), "newmtl a\nmap_Kd image.png\n").expect("a written file");
    let model = "mtllib textured.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nusemtl a\nf 1/1 2/1 3/1\n";
    fs::write(folder.join("textured.obj"), model).expect("a written file");
}

#[test]
fn loaders_allocate_no_more_than_they_have_reserved() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let write = |name: &str, bytes: &[u8]| fs::write(folder.path().join(name), bytes).expect("a written file");
    write("smooth.obj", obj_grid(false).as_bytes());
    write("creases.obj", obj_grid(true).as_bytes());
    write("separate.obj", obj_separate_triangles().as_bytes());
    write("stars.obj", obj_stars(256, 250).as_bytes());
    write("large_stars.obj", obj_stars(5000, 12).as_bytes());
    write("pentagons.obj", obj_stars(6, 10_000).as_bytes());
    write("attributes.obj", obj_with_attributes().as_bytes());
    write("colors.obj", obj_with_colors().as_bytes());
    write("grid.ply", &ply_grid());
    write("grid.stl", &stl_grid());
    write_npz(&folder.path().join("grid.npz"));
    write_gltf(folder.path());
    write_textured(folder.path());
    let budget = BUDGET.get_or_init(|| MemoryBudget::new(MemoryKind::Host, u64::MAX, u64::MAX));
    let repository = SceneRepository::new(Some(folder.path())).expect("an existing folder");
    let mut failures = Vec::new();
    for source in [
        "smooth.obj",
        "creases.obj",
        "separate.obj",
        "stars.obj",
        "large_stars.obj",
        "pentagons.obj",
        "attributes.obj",
        "colors.obj",
        "grid.ply",
        "grid.stl",
        "grid.npz",
        "grid.gltf",
        "textured.obj",
    ] {
        let LoadMemory { max_allocated, max_unreserved } = measure(&repository, source, budget);
        println!("{source}: at most {max_allocated} bytes allocated, at most {max_unreserved} more than reserved");
        assert!(max_allocated > 2 * SLACK, "{source}: expected a model that takes memory, got {max_allocated} bytes");
        if max_unreserved > SLACK {
            failures.push(format!("{source}: {max_unreserved}"));
        }
    }
    assert!(failures.is_empty(), "expected at most {SLACK} bytes without a reservation, got {failures:?}");
}
