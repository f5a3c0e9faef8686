//! Volume meshes of solids whose modes are known.

#![allow(dead_code, reason = "each test uses some of the meshes")]

use std::collections::HashMap;

use modalcast_modes::tet10::{NODES, straight_nodes};
use modalcast_modes::volume_file::VolumeFile;
use modalcast_modes::volume_mesh::{ElementGroup, NO_NODE, VolumeCells, VolumeMesh};
use nalgebra::Vector3;

/// A mesh as if it were read from a file.
pub(crate) fn file_of(cells: VolumeCells) -> VolumeFile {
    let mesh = VolumeMesh::new(cells).unwrap_or_else(|error| panic!("{error}"));
    VolumeFile { name: "part.msh".into(), up_axis: 2, mesh, ..VolumeFile::default() }
}

/// Quadratic tetrahedra with the given corners, which `place` maps to their positions. Edges are straight, except those
/// whose middle is on the surface: `place` maps it, too.
pub(crate) fn curved_cells(
    tetrahedra: &[[Vector3<f64>; 4]],
    place: impl Fn(Vector3<f64>) -> Vector3<f64>,
    is_on_surface: impl Fn(Vector3<f64>) -> bool,
) -> VolumeCells {
    let mut cells = VolumeCells {
        groups: vec![ElementGroup { name: "default".into(), material: None }],
        element_groups: vec![0; tetrahedra.len()],
        ..VolumeCells::default()
    };
    let mut numbers = HashMap::new();
    for corners in tetrahedra {
        let nodes = straight_nodes(*corners);
        let straight = straight_nodes(corners.map(&place));
        let element = std::array::from_fn(|index| {
            let node = nodes[index];
            // Rounded, because a middle is computed from either end.
            let key: [i64; 3] = [0, 1, 2].map(|axis| (node[axis] * 1e9).round() as i64);
            *numbers.entry(key).or_insert_with(|| {
                cells.positions.push(if is_on_surface(node) { place(node) } else { straight[index] });
                cells.positions.len() as u32 - 1
            })
        });
        cells.elements.push(element);
    }
    cells
}

/// Removes the middles of all elements.
pub(crate) fn linear(mut cells: VolumeCells) -> VolumeCells {
    cells.elements.iter_mut().for_each(|element| element[4..].fill(NO_NODE));
    let mut is_corner = vec![false; cells.positions.len()];
    cells.elements.iter().for_each(|element| element[..4].iter().for_each(|node| is_corner[*node as usize] = true));
    // Nodes without elements would give a remark.
    let mut numbers = vec![0; cells.positions.len()];
    let mut positions = Vec::new();
    for (node, position) in cells.positions.iter().enumerate().filter(|(node, _)| is_corner[*node]) {
        numbers[node] = positions.len() as u32;
        positions.push(*position);
    }
    cells.positions = positions;
    for element in &mut cells.elements {
        element[..4].iter_mut().for_each(|node| *node = numbers[*node as usize]);
    }
    debug_assert_eq!(NODES, 10);
    cells
}

/// A box around the origin with `counts` cubes of six tetrahedra each.
pub(crate) fn box_tetrahedra(size: [f64; 3], counts: [usize; 3]) -> Vec<[Vector3<f64>; 4]> {
    const PATHS: [[usize; 3]; 6] = [[0, 1, 2], [1, 0, 2], [1, 2, 0], [2, 1, 0], [2, 0, 1], [0, 2, 1]];
    let position =
        |index: [usize; 3]| Vector3::from_fn(|axis, _| size[axis] * (index[axis] as f64 / counts[axis] as f64 - 0.5));
    let mut tetrahedra = Vec::new();
    for cube in 0..counts.iter().product() {
        let first = [cube / (counts[1] * counts[2]), cube / counts[2] % counts[1], cube % counts[2]];
        for path in PATHS {
            let mut index = first;
            let mut corners = [position(index); 4];
            for (corner, axis) in path.into_iter().enumerate() {
                index[axis] += 1;
                corners[corner + 1] = position(index);
            }
            tetrahedra.push(corners);
        }
    }
    tetrahedra
}

/// A box of quadratic tetrahedra.
pub(crate) fn solid_box(size: [f64; 3], counts: [usize; 3]) -> VolumeCells {
    curved_cells(&box_tetrahedra(size, counts), |position| position, |_| false)
}

/// An ellipsoid: a cube of `counts` smaller cubes with six tetrahedra each, mapped so that its surface becomes that of a
/// ball and its center remains a cube.
pub(crate) fn ellipsoid(semi_axes: [f64; 3], counts: [usize; 3]) -> VolumeCells {
    /// The size of the cube in the center.
    const CENTER: f64 = 0.75;
    let place = |position: Vector3<f64>| {
        let radius = position.amax();
        // Equal angles between the planes of the cube's edges.
        let direction = position.map(|coordinate| (std::f64::consts::FRAC_PI_4 * coordinate / radius.max(1e-9)).tan());
        let ball = direction.try_normalize(0.0).unwrap_or_default() * radius;
        let mixed = ball * radius.powi(2) + position * (CENTER * (1.0 - radius.powi(2)));
        Vector3::from_fn(|axis, _| semi_axes[axis] * mixed[axis])
    };
    curved_cells(&box_tetrahedra([2.0; 3], counts), place, |position| position.amax() > 1.0 - 1e-9)
}

/// A cylinder around z of prisms, which are divided into three tetrahedra each. Six sectors with `rings` squared triangles.
pub(crate) fn cylinder(radius: f64, height: f64, rings: usize, layers: usize) -> VolumeCells {
    let spoke = |sector: usize| {
        let angle = std::f64::consts::FRAC_PI_3 * sector as f64;
        Vector3::new(angle.cos(), angle.sin(), 0.0)
    };
    let mut tetrahedra = Vec::new();
    for sector in 0..6 {
        let at = |i: usize, j: usize| (spoke(sector) * i as f64 + spoke(sector + 1) * j as f64) / rings as f64;
        let mut triangles = Vec::new();
        for i in 0..rings {
            for j in 0..rings - i {
                triangles.push([at(i, j), at(i + 1, j), at(i, j + 1)]);
                if i + j + 1 < rings {
                    triangles.push([at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)]);
                }
            }
        }
        for mut triangle in triangles {
            // The same order in all prisms, so that the diagonals of their common faces agree.
            let key = |position: &Vector3<f64>| [0, 1].map(|axis| (position[axis] * 1e9).round() as i64);
            triangle.sort_by_key(key);
            for layer in 0..layers {
                let level = |layer: usize| Vector3::new(0.0, 0.0, layer as f64 / layers as f64 - 0.5);
                let [a, b, c] = triangle.map(|corner| corner + level(layer));
                let [d, e, f] = triangle.map(|corner| corner + level(layer + 1));
                tetrahedra.extend([[a, b, c, f], [a, b, e, f], [a, d, e, f]]);
            }
        }
    }
    let flat = |position: Vector3<f64>| Vector3::new(position.x, position.y, 0.0);
    // The distance from the axis in the norm whose unit circle is the hexagon.
    let norm = |position: Vector3<f64>| {
        let normal = |sector: usize| {
            let angle = std::f64::consts::FRAC_PI_3 * (sector as f64 + 0.5);
            Vector3::new(angle.cos(), angle.sin(), 0.0) / (std::f64::consts::PI / 6.0).cos()
        };
        (0..6).map(|sector| normal(sector).dot(&flat(position))).fold(0.0, f64::max)
    };
    let place = |position: Vector3<f64>| {
        let direction = flat(position).try_normalize(0.0).unwrap_or_default();
        direction * (radius * norm(position)) + Vector3::new(0.0, 0.0, height * position.z)
    };
    curved_cells(&tetrahedra, place, |position| norm(position) > 1.0 - 1e-9)
}

/// Turns a mesh by a rotation that is aligned with no axis.
pub(crate) fn rotated(mut cells: VolumeCells) -> VolumeCells {
    let rotation = nalgebra::Rotation3::from_euler_angles(0.4, -0.7, 1.1);
    cells.positions.iter_mut().for_each(|position| *position = rotation * *position);
    cells
}
