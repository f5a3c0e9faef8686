//! Rectangular patches of vertices with random modes, and scenes that consist of them. All synthetic workloads are such
//! scenes.

use fastrand::Rng;
use nalgebra::{Rotation3, Vector3};
use rayon::prelude::*;

use modalcast_model::domain::{Corners, Domain, Material, Mesh, Modes, Shape, Texture, Transform, smooth_normals};
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, SceneParts};

/// Divisor of sizes in a quick run: of the vertices of a workload with one domain, else of the domains.
pub(super) const QUICK_DIVISOR: usize = 50;

/// Parameters of one domain.
#[derive(Debug, Clone, Copy)]
pub(super) struct PatchSpec {
    /// Mesh vertices. U has three rows per vertex.
    pub(super) vertices: usize,
    pub(super) rank: usize,
    /// Render vertices; each refers to one of `vertices`.
    pub(super) corners: usize,
    pub(super) triangles: PatchTopology,
    /// Edge length of the patch, scene units.
    pub(super) size: f32,
    /// Seed of the positions and modes.
    pub(super) seed: u64,
}

/// Triangles of a patch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PatchTopology {
    /// One triangle with three corners, the minimum of a mesh.
    SingleTriangle,
    /// Two triangles per grid cell; one corner per vertex.
    Cells,
    /// A strip with this number of triangles. It starts again at the first corner when it reaches the last one.
    Strip(usize),
}

/// A seed for part `index` of the workload with this name: an FNV-1a hash, mixed by fastrand.
pub(super) fn part_seed(name: &str, index: usize) -> u64 {
    let hash_byte = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3);
    let hash = name.bytes().chain(index.to_le_bytes()).fold(0xCBF2_9CE4_8422_2325, hash_byte);
    Rng::with_seed(hash).u64(..)
}

/// Builds the mesh and the modes of a patch. `has_cancelling_mode_pairs`: see [`random_modes`]; almost all vertices then
/// rest at the origin, because the rounding error of x0 + u would otherwise hide that of u.
pub(super) fn build_shape(patch: &PatchSpec, has_cancelling_mode_pairs: bool) -> Result<Shape> {
    let mut rng = Rng::with_seed(patch.seed);
    let grid_columns = (patch.vertices as f64).sqrt().ceil().max(1.0) as usize;
    let spacing = patch.size / grid_columns as f32;
    let mut positions: Vec<[f32; 3]> = (0..patch.vertices)
        .map(|vertex| {
            let height = 0.1 * patch.size * (rng.f32() - 0.5);
            [(vertex % grid_columns) as f32 * spacing, (vertex / grid_columns) as f32 * spacing, height]
        })
        .collect();
    if has_cancelling_mode_pairs {
        // The three corners of the triangle and the last vertex keep their places, and with them the size of the scene.
        let first = 3.min(patch.vertices - 1);
        positions[first..patch.vertices - 1].fill([0.0; 3]);
    }
    // Corners are distributed evenly over the vertices.
    let vertex_of_corner =
        |corner: usize| (corner * patch.vertices / patch.corners.max(1)).min(patch.vertices - 1) as u32;
    let vertices: Vec<u32> = (0..patch.corners).map(vertex_of_corner).collect();
    let triangles = patch_triangles(patch, grid_columns);
    let (normals, uvs) = match patch.triangles {
        PatchTopology::SingleTriangle => (vec![[0.0, 0.0, 1.0]; patch.corners], Vec::new()),
        _ => {
            let uv = |vertex: &u32| {
                [positions[*vertex as usize][0] / patch.size, positions[*vertex as usize][1] / patch.size]
            };
            (smooth_normals(&positions, &vertices, &triangles), vertices.iter().map(uv).collect())
        }
    };
    let mesh = Mesh::new(positions, Corners { vertices, normals, uvs }, triangles)?;
    Shape::new(mesh, random_modes(patch, has_cancelling_mode_pairs)?)
}

/// Triangles as indices of corners. `grid_columns`: vertices per row of the grid.
fn patch_triangles(patch: &PatchSpec, grid_columns: usize) -> Vec<[u32; 3]> {
    // Indices are taken modulo `corners`: a patch may have fewer than three corners, and a strip may start again.
    let corners = patch.corners as u32;
    match patch.triangles {
        PatchTopology::SingleTriangle => vec![[0, 1 % corners, 2 % corners]],
        PatchTopology::Cells if patch.vertices < 3 || grid_columns < 2 => vec![[0, 1 % corners, 2 % corners]],
        PatchTopology::Cells => {
            let width = grid_columns as u32;
            let cell_triangles = |corner: u32| {
                let is_inside = corner % width != width - 1;
                let lower_triangle =
                    (is_inside && corner + width < corners).then_some([corner, corner + 1, corner + width]);
                let upper_triangle = (is_inside && corner + width + 1 < corners).then_some([
                    corner + 1,
                    corner + width + 1,
                    corner + width,
                ]);
                lower_triangle.into_iter().chain(upper_triangle)
            };
            (0..corners).flat_map(cell_triangles).collect()
        }
        PatchTopology::Strip(triangle_count) => {
            // Odd triangles are reversed, so that all have the same winding.
            let strip_triangle = |first: u32| {
                if first.is_multiple_of(2) { [first, first + 1, first + 2] } else { [first + 1, first, first + 2] }
            };
            (0..triangle_count as u32)
                .map(|triangle| strip_triangle(triangle % corners).map(|corner| corner % corners))
                .collect()
        }
    }
}

/// Modes with entries uniform in [-1, 1); every column has its own seed. If `has_cancelling_mode_pairs`, columns 2k and
/// 2k + 1 are equal up to a relative difference of at most 5e-5.
fn random_modes(patch: &PatchSpec, has_cancelling_mode_pairs: bool) -> Result<Modes> {
    let rows = 3 * patch.vertices;
    if patch.rank == 0 {
        return Ok(Modes::rigid());
    }
    let mut entries = vec![0.0_f32; rows * patch.rank];
    entries.par_chunks_mut(rows).enumerate().for_each(|(column, entries)| {
        let mut rng = Rng::with_seed(patch.seed ^ (1 + column as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        entries.iter_mut().for_each(|entry| *entry = 2.0 * rng.f32() - 1.0);
    });
    if has_cancelling_mode_pairs {
        entries.par_chunks_mut(2 * rows).for_each(|pair| {
            let mut rng = Rng::with_seed(patch.seed);
            let (left, right) = pair.split_at_mut(rows);
            let copy_with_noise = |(right, left): (&mut f32, &f32)| *right = left * (1.0 + 1e-4 * (rng.f32() - 0.5));
            right.iter_mut().zip(left.iter()).for_each(copy_with_noise);
        });
    }
    Modes::from_columns(rows, patch.rank, entries)
}

/// Builds a scene of `count` domains, which use the shapes cyclically. Domains are on a cubic lattice with random
/// rotations.
pub(super) fn build_patch_scene(
    name: String,
    shapes: Vec<Shape>,
    count: usize,
    has_normal_map: bool,
) -> Result<std::sync::Arc<Scene>> {
    // usize::MAX is not the index of a patch, so no patch has the same seed.
    let mut rng = Rng::with_seed(part_seed(&name, usize::MAX));
    let side = (count as f64).cbrt().ceil() as usize;
    // Patches of several domains have edges of at most 0.1.
    let spacing = if count > 1 { 0.15 } else { 0.0 };
    let domain = |index: usize| {
        let position = [index % side, index / side % side, index / side / side].map(|cell| cell as f64 * spacing);
        let rotation = if count > 1 { random_rotation(&mut rng) } else { Rotation3::identity() };
        Domain {
            placement: Transform::from_parts(&rotation.into_inner(), &Vector3::from(position)),
            ..Domain::new(index.to_string(), index % shapes.len())
        }
    };
    let domains = (0..count).map(domain).collect();
    let mut parts = SceneParts::named(name);
    if has_normal_map {
        // RGBA of the undisturbed normal (0, 0, 1).
        parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255])?];
    }
    parts.materials = vec![Material { normal_texture: has_normal_map.then_some(0), ..Material::default() }];
    Scene::new(SceneParts { shapes, domains, rigid_transforms: true, ..parts })
}

/// A rotation by three random Euler angles.
fn random_rotation(rng: &mut Rng) -> Rotation3<f64> {
    let angle = |rng: &mut Rng| std::f64::consts::TAU * rng.f64();
    Rotation3::from_euler_angles(angle(rng), angle(rng), angle(rng))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn modes_are_nearly_equal_only_in_cancelling_pairs() {
        let max_difference = |has_cancelling_mode_pairs: bool| {
            let modes = random_modes(
                &PatchSpec {
                    vertices: 50,
                    rank: 3,
                    corners: 3,
                    triangles: PatchTopology::SingleTriangle,
                    size: 1.0,
                    seed: 5,
                },
                has_cancelling_mode_pairs,
            );
            let modes = modes.expect("modes");
            modes.column(0).iter().zip(modes.column(1)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(max_difference(true) <= 1e-4 && max_difference(true) > 0.0);
        assert!(max_difference(false) > 0.1);
    }
}
