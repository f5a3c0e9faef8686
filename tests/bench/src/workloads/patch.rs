//! Rectangular patches of vertices with random modes, and scenes of them: what all synthetic loads consist of.

use fastrand::Rng;
use nalgebra::{Rotation3, Vector3};
use rayon::prelude::*;

use modalcast_model::domain::{
    Corners, Domain, Material, Mesh, Metadata, Modes, Shape, Texture, Transform, smooth_normals,
};
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, SceneParts};

/// Divisor of the vertices (of one domain) or of the domains (of many) in a quick run.
pub(super) const QUICK: usize = 50;

/// Parameters of one domain.
#[derive(Debug, Clone, Copy)]
pub(super) struct PatchSpec {
    /// Vertices with modes: rows of U divided by three.
    pub(super) vertices: usize,
    pub(super) rank: usize,
    /// Render vertices; each refers to one of `vertices`.
    pub(super) corners: usize,
    pub(super) triangles: PatchTopology,
    /// Edge length of the sheet, scene units.
    pub(super) size: f32,
    pub(super) seed: u64,
}

/// Triangles of a patch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum PatchTopology {
    /// The minimum of a mesh: one triangle with three corners.
    One,
    /// Two per cell of the sheet; one corner per vertex.
    Cells,
    /// A strip with this number of triangles, over all corners and again from the start.
    Strip(usize),
}

/// A seed for part `index` of the load with this name (FNV-1a, then fastrand's mixing).
pub(super) fn seed_of(name: &str, index: usize) -> u64 {
    let word = |hash: u64, byte: u8| (hash ^ u64::from(byte)).wrapping_mul(0x0100_0000_01B3);
    let hash = name.bytes().chain(index.to_le_bytes()).fold(0xCBF2_9CE4_8422_2325, word);
    Rng::with_seed(hash).u64(..)
}

/// The mesh and the modes of a patch.
pub(super) fn shape(patch: &PatchSpec, paired: bool) -> Result<Shape> {
    let mut rng = Rng::with_seed(patch.seed);
    let columns = (patch.vertices as f64).sqrt().ceil().max(1.0) as usize;
    let step = patch.size / columns as f32;
    let rest: Vec<[f32; 3]> = (0..patch.vertices)
        .map(|at| {
            let relief = 0.1 * patch.size * (rng.f32() - 0.5);
            [(at % columns) as f32 * step, (at / columns) as f32 * step, relief]
        })
        .collect();
    // Corners are distributed evenly over the vertices.
    let row = |corner: usize| (corner * patch.vertices / patch.corners.max(1)).min(patch.vertices - 1) as u32;
    let vertices: Vec<u32> = (0..patch.corners).map(row).collect();
    let triangles = triangles(patch, columns);
    let (normals, uvs) = match patch.triangles {
        PatchTopology::One => (vec![[0.0, 0.0, 1.0]; patch.corners], Vec::new()),
        _ => {
            let uv = |vertex: &u32| [rest[*vertex as usize][0] / patch.size, rest[*vertex as usize][1] / patch.size];
            (smooth_normals(&rest, &vertices, &triangles), vertices.iter().map(uv).collect())
        }
    };
    let mesh = Mesh::new(rest, Corners { vertices, normals, uvs }, triangles)?;
    Shape::new(mesh, modes(patch, paired)?)
}

fn triangles(patch: &PatchSpec, columns: usize) -> Vec<[u32; 3]> {
    let count = patch.corners as u32;
    match patch.triangles {
        PatchTopology::One => vec![[0, 1 % count, 2 % count]],
        PatchTopology::Cells if patch.vertices < 3 || columns < 2 => vec![[0, 1 % count, 2 % count]],
        PatchTopology::Cells => {
            let width = columns as u32;
            let cell = |at: u32| {
                let inside = at % width != width - 1;
                let lower = (inside && at + width < count).then_some([at, at + 1, at + width]);
                let upper = (inside && at + width + 1 < count).then_some([at + 1, at + width + 1, at + width]);
                lower.into_iter().chain(upper)
            };
            (0..count).flat_map(cell).collect()
        }
        PatchTopology::Strip(wanted) => {
            let wound = |at: u32| if at.is_multiple_of(2) { [at, at + 1, at + 2] } else { [at + 1, at, at + 2] };
            (0..wanted as u32).map(|at| wound(at % count).map(|corner| corner % count)).collect()
        }
    }
}

/// Entries uniform in [-1, 1). With `paired`, each odd column equals its left neighbor up to a relative difference of
/// at most 5e-5.
fn modes(patch: &PatchSpec, paired: bool) -> Result<Modes> {
    let rows = 3 * patch.vertices;
    if patch.rank == 0 {
        return Ok(Modes::rigid());
    }
    let mut entries = vec![0.0_f32; rows * patch.rank];
    entries.par_chunks_mut(rows).enumerate().for_each(|(column, entries)| {
        let own = Rng::with_seed(patch.seed ^ (1 + column as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15));
        let mut rng = own;
        entries.iter_mut().for_each(|entry| *entry = 2.0 * rng.f32() - 1.0);
    });
    if paired {
        entries.par_chunks_mut(2 * rows).for_each(|pair| {
            let mut rng = Rng::with_seed(patch.seed);
            let (left, right) = pair.split_at_mut(rows);
            let twin = |(right, left): (&mut f32, &f32)| *right = left * (1.0 + 1e-4 * (rng.f32() - 0.5));
            right.iter_mut().zip(left.iter()).for_each(twin);
        });
    }
    Modes::from_columns(rows, patch.rank, entries)
}

/// A scene of `count` domains that cycle through the shapes, each randomly rotated on a cubic lattice; with a normal
/// map if `dressed`.
pub(super) fn scene(name: String, shapes: Vec<Shape>, count: usize, dressed: bool) -> Result<std::sync::Arc<Scene>> {
    let mut rng = Rng::with_seed(seed_of(&name, usize::MAX));
    let side = (count as f64).cbrt().ceil() as usize;
    let spacing = if count > 1 { 0.15 } else { 0.0 };
    let domain = |index: usize| {
        let place = [index % side, index / side % side, index / side / side].map(|cell| cell as f64 * spacing);
        let turn = if count > 1 { any_turn(&mut rng) } else { Rotation3::identity() };
        Domain {
            name: index.to_string(),
            shape: index % shapes.len(),
            material: 0,
            material_ranges: Vec::new(),
            placement: Transform::from_parts(&turn.into_inner(), &Vector3::from(place)),
            attachment: None,
            follows: None,
            rest_q: Vec::new(),
            shares_q_with: None,
            metadata: Metadata::default(),
        }
    };
    let domains = (0..count).map(domain).collect();
    let mut parts = SceneParts::named(name);
    if dressed {
        parts.textures = vec![Texture::new("flat", 1, 1, vec![128, 128, 255, 255])?];
    }
    parts.materials = vec![Material { normal_texture: dressed.then_some(0), ..Material::default() }];
    Scene::new(SceneParts { shapes, domains, rigid_transforms: true, ..parts })
}

fn any_turn(rng: &mut Rng) -> Rotation3<f64> {
    let angle = |rng: &mut Rng| std::f64::consts::TAU * rng.f64();
    Rotation3::from_euler_angles(angle(rng), angle(rng), angle(rng))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_paired_modes_are_nearly_equal() {
        let near = |paired: bool| {
            let modes = modes(
                &PatchSpec { vertices: 50, rank: 3, corners: 3, triangles: PatchTopology::One, size: 1.0, seed: 5 },
                paired,
            );
            let modes = modes.expect("modes");
            modes.column(0).iter().zip(modes.column(1)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
        };
        assert!(near(true) <= 1e-4 && near(true) > 0.0);
        assert!(near(false) > 0.1);
    }
}
