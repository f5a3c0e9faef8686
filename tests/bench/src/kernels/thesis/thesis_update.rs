//! BASELINE. Launches `kernels/thesis_update.cu`: the vertex update of unfolded triangles, which share no vertices
//! (chapter 3.2.3).

use bytemuck::{Pod, Zeroable};
use cudarc::driver::{DeviceRepr, LaunchConfig, PushKernelArg as _};

use super::super::kernel_benchmark::{ArrayTraffic, BenchmarkSource, CompiledKernel, KernelAttributes};
use super::group::{BLOCK, DisplacementLayout};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{Scene, SceneState};

pub(super) const SOURCE: BenchmarkSource = BenchmarkSource {
    text: include_str!("../../../kernels/thesis_update.cu"),
    functions: &["thesis_update"],
    define_sets: &[&[], &["TANGENTS"]],
};

/// Vertices per warp. Four threads compute one vertex.
const VERTICES_PER_WARP: usize = 8;
/// Vertices per block.
const VERTICES_PER_BLOCK: usize = 64;

/// Value of `sources` for a vertex without u.
const RIGID: u32 = u32::MAX;

/// Minimum number of triangles per domain that the thesis assumes. Three triangles have nine vertices, so the eight
/// consecutive vertices of a warp belong to at most two domains.
const MIN_TRIANGLES: usize = 3;

/// Arguments of `thesis_update`; pointers are device addresses. The kernel file describes the arrays.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct UpdateArgs {
    warps: u64,
    sources: u64,
    rest_positions: u64,
    rest_normals: u64,
    rest_tangents: u64,
    transforms: u64,
    u: u64,
    positions: u64,
    normals: u64,
    tangents: u64,
    vertices: u32,
    reserved: u32,
}

const _: () = assert!(size_of::<UpdateArgs>() == 88, "UpdateArgs differs from kernels/thesis_update.cu");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in the kernel.
unsafe impl DeviceRepr for UpdateArgs {}

/// The vertices of unfolded triangles: three per triangle, without sharing.
#[derive(Debug, Default)]
struct UnfoldedTriangles {
    /// Per warp: its first domain, its second domain, the index (0 to 7) of the warp's first vertex that is one of the
    /// second domain (8 if there is none), and 0.
    warps: Vec<[u32; 4]>,
    /// Index into u of each vertex, or [`RIGID`].
    sources: Vec<u32>,
    /// The packed vertex (in the scene's layout) that each unfolded vertex is a copy of.
    targets: Vec<u32>,
    positions: Vec<[f32; 4]>,
    normals: Vec<[f32; 4]>,
    tangents: Vec<[f32; 4]>,
}

impl UnfoldedTriangles {
    /// Unfolds all triangles. A domain with fewer than three triangles repeats its last triangle.
    fn of(scene: &Scene) -> Self {
        let displacements = DisplacementLayout::of(scene);
        let mut unfolded = Self::default();
        let mut domains = Vec::new();
        for (domain, domain_layout) in scene.layout.domains.iter().enumerate() {
            let shape = scene.shape_of(domain);
            // A triangle lists corners. A corner is a vertex with one normal.
            let (corners, triangles) = (shape.mesh.corners(), shape.mesh.triangles());
            let triangle_count = triangles.len().max(MIN_TRIANGLES);
            let corner_of = |index: usize| triangles[(index / 3).min(triangles.len() - 1)][index % 3] as usize;
            for corner in (0..3 * triangle_count).map(corner_of) {
                let vertex = corners.vertices[corner];
                unfolded.sources.push(displacements.first_vertices[domain].map_or(RIGID, |first| first + vertex));
                unfolded.targets.push(domain_layout.first_vertex as u32 + vertex);
                unfolded.positions.push(float4(shape.mesh.rest_positions()[vertex as usize], 1.0));
                unfolded.normals.push(float4(corners.normals[corner], 0.0));
                if scene.features.normal_maps {
                    let [x, y, z, _] = shape.tangents().get(corner).copied().unwrap_or_default();
                    unfolded.tangents.push([x, y, z, 0.0]);
                }
                domains.push(domain as u32);
            }
        }
        unfolded.warps = domains.chunks(VERTICES_PER_WARP).map(warp_entry).collect();
        // The warps of the last block that have no vertices.
        unfolded.warps.resize(
            domains.len().div_ceil(VERTICES_PER_BLOCK) * VERTICES_PER_BLOCK / VERTICES_PER_WARP,
            [0, 0, VERTICES_PER_WARP as u32, 0],
        );
        unfolded
    }
}

/// The entry of [`UnfoldedTriangles::warps`] for a warp, from the domains of its vertices.
fn warp_entry(domains: &[u32]) -> [u32; 4] {
    let first_domain = domains[0];
    let boundary = domains.iter().position(|domain| *domain != first_domain);
    boundary.map_or([first_domain, first_domain, VERTICES_PER_WARP as u32, 0], |vertex| {
        [first_domain, domains[vertex], vertex as u32, 0]
    })
}

const fn float4([x, y, z]: [f32; 3], w: f32) -> [f32; 4] {
    [x, y, z, w]
}

/// T of every domain as a 4x4 row-major matrix.
pub(super) fn transform_matrices(scene: &Scene, state: &SceneState) -> Vec<f32> {
    let transforms = state.world_transforms(scene);
    transforms.iter().flat_map(|transform| transform.0.into_iter().chain([0.0, 0.0, 0.0, 1.0])).collect()
}

/// The kernel with its inputs and outputs.
#[derive(Debug)]
pub(super) struct UpdateKernel {
    compiled: CompiledKernel,
    /// Warps, sources, rest positions, normals and tangents.
    tables: [DeviceBuffer; 5],
    /// Positions, normals and tangents.
    outputs: [DeviceBuffer; 3],
    /// As [`UnfoldedTriangles::targets`].
    targets: Vec<u32>,
    has_tangents: bool,
    transform_bytes: u64,
    u_bytes: u64,
}

impl UpdateKernel {
    pub(super) fn new(device: &Device, scene: &Scene) -> Result<Self> {
        let unfolded = UnfoldedTriangles::of(scene);
        let (has_tangents, bytes) = (scene.features.normal_maps, 16 * unfolded.targets.len() as u64);
        let defines: &[&str] = if has_tangents { &["TANGENTS"] } else { &[] };
        Ok(Self {
            compiled: CompiledKernel::new(device, &SOURCE, defines)?,
            tables: [
                DeviceBuffer::upload(device, &unfolded.warps)?,
                DeviceBuffer::upload(device, &unfolded.sources)?,
                DeviceBuffer::upload(device, &unfolded.positions)?,
                DeviceBuffer::upload(device, &unfolded.normals)?,
                DeviceBuffer::upload(device, &unfolded.tangents)?,
            ],
            outputs: [
                DeviceBuffer::zeroed(device, bytes)?,
                DeviceBuffer::zeroed(device, bytes)?,
                DeviceBuffer::zeroed(device, if has_tangents { bytes } else { 0 })?,
            ],
            targets: unfolded.targets,
            has_tangents,
            transform_bytes: 64 * scene.domains.len() as u64,
            u_bytes: 16 * DisplacementLayout::of(scene).vertex_count as u64,
        })
    }

    pub(super) fn launch(&self, device: &Device, transforms: u64, u: u64) -> Result<()> {
        let [warps, sources, rest_positions, rest_normals, rest_tangents] =
            self.tables.each_ref().map(|table| table.address());
        let [positions, normals, tangents] = self.outputs.each_ref().map(|output| output.address());
        let vertices = self.targets.len();
        let args = UpdateArgs {
            warps,
            sources,
            rest_positions,
            rest_normals,
            rest_tangents,
            transforms,
            u,
            positions,
            normals,
            tangents,
            vertices: vertices as u32,
            reserved: 0,
        };
        let blocks = vertices.div_ceil(VERTICES_PER_BLOCK) as u32;
        let config = LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK as u32, 1, 1), shared_mem_bytes: 0 };
        let mut launch = device.stream().launch_builder(&self.compiled.function);
        // SAFETY: `UpdateArgs` is the kernel's only argument. `UnfoldedTriangles::of` built its tables from one scene:
        // sources are inside of `u`, and domains are inside of `transforms`. The outputs have a float4 for every
        // vertex.
        unsafe { launch.arg(&args).launch(config) }.map_err(fault_in("thesis_update"))?;
        Ok(())
    }

    /// The positions of the last launch, copied back to the scene's `vertices` packed vertices, three f32 each. A
    /// vertex that no triangle refers to was not computed and is NaN.
    pub(super) fn positions(&self, device: &Device, vertices: usize) -> Result<Vec<f32>> {
        let mut unfolded = vec![[0.0_f32; 4]; self.targets.len()];
        self.outputs[0].read(device, 0, &mut unfolded)?;
        Ok(fold(&unfolded, &self.targets, vertices))
    }

    pub(super) fn traffic(&self) -> Vec<ArrayTraffic> {
        let vertices = self.targets.len() as u64;
        let attribute_count = if self.has_tangents { 3 } else { 2 };
        vec![
            ArrayTraffic::new("unfolded rest state", 16 * attribute_count * vertices),
            // A vertex has a source of 4 bytes. A warp has 16 bytes for 8 vertices: 2 bytes per vertex.
            ArrayTraffic::new(
                "sources and domains of vertices",
                4 * vertices + 2 * vertices.next_multiple_of(VERTICES_PER_BLOCK as u64),
            ),
            ArrayTraffic::new("T", self.transform_bytes),
            ArrayTraffic::new("u read", self.u_bytes),
            ArrayTraffic::new("unfolded vertices written", 16 * attribute_count * vertices),
        ]
    }

    pub(super) fn attributes(&self) -> &KernelAttributes {
        &self.compiled.attributes
    }
}

/// Copies unfolded positions to the packed vertices of `targets`; other vertices are NaN.
fn fold(unfolded: &[[f32; 4]], targets: &[u32], vertices: usize) -> Vec<f32> {
    let mut positions = vec![f32::NAN; 3 * vertices];
    for (position, target) in unfolded.iter().zip(targets) {
        positions[3 * *target as usize..][..3].copy_from_slice(&position[..3]);
    }
    positions
}

#[cfg(test)]
mod tests {
    use super::super::super::kernel_benchmark::tests::compile_all;
    use super::*;
    use modalcast_compute::testing::{displacement_of, position_of, scene_and_state};

    /// CPU twin of `thesis_update` for positions: the same algorithm in Rust, thread by thread.
    fn twin_of_thesis_update(unfolded: &UnfoldedTriangles, transforms: &[f32], u: &[[f32; 4]]) -> Vec<[f32; 4]> {
        let count = unfolded.targets.len();
        let mut positions = vec![[f32::NAN; 4]; count];
        for thread in 0..count.div_ceil(VERTICES_PER_BLOCK) * BLOCK {
            let (vertex, element, warp) = (thread / 4, thread % 4, thread / 32);
            let [first_domain, second_domain, first_of_second, _] = unfolded.warps[warp];
            let domain = if (thread % 32 / 4) < first_of_second as usize { first_domain } else { second_domain };
            if vertex < count {
                let mut rest = unfolded.positions[vertex];
                if unfolded.sources[vertex] != RIGID {
                    rest.iter_mut().zip(u[unfolded.sources[vertex] as usize]).for_each(|(rest, u)| *rest += u);
                }
                let row = &transforms[16 * domain as usize + 4 * element..][..4];
                positions[vertex][element] = row.iter().zip(rest).map(|(row, rest)| row * rest).sum();
            }
        }
        positions
    }

    #[test]
    fn twin_computes_all_vertices_of_triangles_and_no_others() {
        // Vertices, modes and triangles of each domain. Some domains have fewer triangles than the three that the
        // thesis assumes, and some have vertices that no triangle refers to.
        let shapes = [(5, 2, 1), (9, 0, 2), (40, 7, 30), (4, 0, 1), (6, 3, 2), (3, 1, 5)];
        let (scene, state) = scene_and_state(&shapes);
        let unfolded = UnfoldedTriangles::of(&scene);
        // Domains with one or two triangles are unfolded to three.
        assert_eq!(unfolded.targets.len(), 3 * (3 + 3 + 30 + 3 + 3 + 5));
        let DisplacementLayout { first_vertices, vertex_count } = DisplacementLayout::of(&scene);
        let mut u = vec![[0.0_f32; 4]; vertex_count];
        for (domain, first_u) in
            first_vertices.iter().enumerate().filter_map(|(domain, first_u)| Some((domain, (*first_u)?)))
        {
            for vertex in 0..scene.layout.domains[domain].vertices {
                u[first_u as usize + vertex] =
                    float4(displacement_of(&scene, &state, domain, vertex).map(|number| number as f32), 0.0);
            }
        }
        let positions = twin_of_thesis_update(&unfolded, &transform_matrices(&scene, &state), &u);
        let folded = fold(&positions, &unfolded.targets, scene.layout.vertices);
        let mut nan_count = 0;
        for (domain, domain_layout) in scene.layout.domains.iter().enumerate() {
            for vertex in 0..domain_layout.vertices {
                let got = &folded[3 * (domain_layout.first_vertex + vertex)..][..3];
                nan_count += usize::from(got[0].is_nan());
                for (want, got) in position_of(&scene, &state, domain, vertex).iter().zip(got) {
                    // The triangles of the test scene refer to consecutive vertices. Other vertices are NaN, which
                    // fails the comparison.
                    let is_corner = vertex < 3 * shapes[domain].2;
                    assert_eq!((want - f64::from(*got)).abs() < 1e-5, is_corner, "domain {domain} vertex {vertex}");
                }
            }
        }
        // No triangle refers to 5 - 3 vertices of the first domain, 9 - 6 of the second and 4 - 3 of the fourth.
        assert_eq!(nan_count, 2 + 3 + 1);
    }

    #[test]
    fn three_triangles_per_domain_fit_two_matrices_per_warp() {
        // 50 domains of one triangle, which is unfolded to three triangles with 9 vertices.
        const UNFOLDED_VERTICES: usize = 50 * 9;
        let (scene, _) = scene_and_state(&[(3, 0, 1); 50]);
        let unfolded = UnfoldedTriangles::of(&scene);
        // A domain has three packed vertices.
        let domain = |unfolded_vertex: usize| unfolded.targets[unfolded_vertex] / 3;
        for (index, [first_domain, second_domain, first_of_second, _]) in
            unfolded.warps.iter().enumerate().take(UNFOLDED_VERTICES / VERTICES_PER_WARP)
        {
            for vertex in 0..VERTICES_PER_WARP {
                let expected = if vertex < *first_of_second as usize { first_domain } else { second_domain };
                assert_eq!(domain(VERTICES_PER_WARP * index + vertex), *expected);
            }
        }
        let warps_per_block = VERTICES_PER_BLOCK / VERTICES_PER_WARP;
        assert_eq!(unfolded.warps.len(), UNFOLDED_VERTICES.div_ceil(VERTICES_PER_BLOCK) * warps_per_block);
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_thesis_update() {
        compile_all(&SOURCE);
    }
}
