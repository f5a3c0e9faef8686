//! A generated scene with many vertices and few modes, whose vertex streams are large: a square grid that waves.

use std::fmt::Write as _;
use std::path::Path;

use modalcast_client::npy::Writer as NpyWriter;

use crate::workloads::Size;
use modalcast_model::error::{Result, fault_in};

/// Name of the scene in its folder.
pub(super) const NAME: &str = "grid";

/// Modes of the grid.
const RANK: usize = 2;

/// Vertices of each side of the grid. The full size has 1,500,625 vertices; their positions take 18 MB as f32.
pub(super) const fn side(size: Size) -> usize {
    match size {
        Size::Full => 1225,
        Size::Quick => 300,
    }
}

/// Writes the grid as OBJ with a `.npy` file of modes into the folder `grid` of a repository.
///
/// # Errors
/// `Fault` when a file cannot be written.
pub(super) fn write(repository: &Path, side: usize) -> Result<()> {
    let folder = repository.join(NAME);
    std::fs::create_dir_all(&folder).map_err(fault_in("report"))?;
    std::fs::write(folder.join("grid.obj"), obj(side)).map_err(fault_in("report"))?;
    let mut modes = NpyWriter::create(&folder.join("grid.npy"), &[RANK]).map_err(fault_in("report"))?;
    for vertex in 0..side * side {
        let [x, y] = position(vertex, side).map(|coordinate| 10.0 * coordinate);
        // Rows of x, y and z: a vertex moves in z only, by at most 5 % of the side.
        for row in [[0.0; RANK], [0.0; RANK], [0.05 * x.sin(), 0.05 * y.cos()]] {
            modes.write_row(&row).map_err(fault_in("report"))?;
        }
    }
    modes.finish().map_err(fault_in("report"))?;
    Ok(())
}

/// Position of a vertex in the unit square.
fn position(vertex: usize, side: usize) -> [f32; 2] {
    [vertex % side, vertex / side].map(|index| index as f32 / (side - 1) as f32)
}

fn obj(side: usize) -> String {
    let mut text = String::with_capacity(64 * side * side);
    for vertex in 0..side * side {
        let [x, y] = position(vertex, side);
        // Writing into a string cannot fail.
        let _ = writeln!(text, "v {x} {y} 0");
    }
    for row in 0..side - 1 {
        for column in 0..side - 1 {
            // Indices count from 1.
            let corner = row * side + column + 1;
            let _ = writeln!(text, "f {corner} {} {} {}", corner + 1, corner + side + 1, corner + side);
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn written_grid_is_a_scene_with_all_vertices_and_modes() {
        let folder = tempfile::tempdir().expect("expected a folder");
        write(folder.path(), 5).expect("expected the files");
        let source = folder.path().join(NAME);
        let scene = modalcast_model::load::open(&source.to_string_lossy()).expect("expected a scene").scene;
        assert_eq!((scene.layout.vertices, scene.layout.triangles, scene.layout.coordinates), (25, 32, RANK));
        assert_eq!(scene.rest_bounds.diagonal(), 2.0_f64.sqrt());
    }

    #[test]
    fn full_size_has_18_megabytes_of_positions() {
        assert_eq!(side(Size::Full).pow(2) * 12, 18_007_500);
    }
}
