//! Launches `kernels/plain_update.cu`: x = T (x0 + u) for a u that cuBLAS computed.

use bytemuck::{Pod, Zeroable};
use cudarc::driver::{DeviceRepr, LaunchConfig, PushKernelArg as _};

use super::kernel_benchmark::{ArrayTraffic, BenchmarkSource, CompiledKernel, KernelAttributes};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::Scene;

pub(super) const SOURCE: BenchmarkSource = BenchmarkSource {
    text: include_str!("../../kernels/plain_update.cu"),
    functions: &["plain_update"],
    define_sets: &[&[], &["SINGLE"]],
};

/// Threads per block. A thread computes one vertex.
const BLOCK: u32 = 256;

/// Value of `first_u` for a domain without modes.
const RIGID: u64 = u64::MAX;

/// Where the data of one domain begins: the index of its first float in u, and of its first vertex among those of all
/// domains.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
struct PlainDomain {
    first_u: u64,
    first_vertex: u32,
    reserved: u32,
}

/// Arguments of `plain_update`; pointers are device addresses. The kernel file describes the arrays.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct PlainArgs {
    domains: u64,
    vertex_domains: u64,
    rest: u64,
    transforms: u64,
    u: u64,
    positions: u64,
    vertices: u32,
    reserved: u32,
}

const _: () = assert!(size_of::<PlainDomain>() == 16, "PlainDomain differs from kernels/plain_update.cu");
const _: () = assert!(size_of::<PlainArgs>() == 56, "PlainArgs differs from kernels/plain_update.cu");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in the kernel.
unsafe impl DeviceRepr for PlainArgs {}

/// The kernel with its inputs and outputs.
#[derive(Debug)]
pub(super) struct PlainUpdate {
    compiled: CompiledKernel,
    domains: DeviceBuffer,
    /// The domain of each vertex; `None` for a scene of one domain.
    vertex_domains: Option<DeviceBuffer>,
    rest: DeviceBuffer,
    positions: DeviceBuffer,
    vertices: usize,
    transform_bytes: u64,
    /// Bytes of u that the kernel reads.
    u_bytes: u64,
}

impl PlainUpdate {
    /// `first_u` holds the index of each domain's first float in u; `None` for domains without modes.
    pub(super) fn new(device: &Device, scene: &Scene, first_u: &[Option<u64>]) -> Result<Self> {
        let (is_single, vertices) = (scene.domains.len() == 1, scene.layout.vertices);
        let defines: &[&str] = if is_single { &["SINGLE"] } else { &[] };
        let u_bytes = scene
            .layout
            .domains
            .iter()
            .filter(|domain_layout| domain_layout.rank > 0)
            .map(|domain_layout| 12 * domain_layout.vertices as u64)
            .sum();
        Ok(Self {
            compiled: CompiledKernel::new(device, &SOURCE, defines)?,
            domains: DeviceBuffer::upload(device, &pack_domains(scene, first_u))?,
            vertex_domains: (!is_single)
                .then(|| DeviceBuffer::upload(device, &domain_of_vertices(scene)))
                .transpose()?,
            rest: DeviceBuffer::upload(device, &packed_rest(scene))?,
            positions: DeviceBuffer::zeroed(device, 12 * vertices as u64)?,
            vertices,
            transform_bytes: 48 * scene.domains.len() as u64,
            u_bytes,
        })
    }

    pub(super) fn launch(&self, device: &Device, transforms: u64, u: u64) -> Result<()> {
        let args = PlainArgs {
            domains: self.domains.address(),
            vertex_domains: self.vertex_domains.as_ref().map_or(0, |domains| domains.address()),
            rest: self.rest.address(),
            transforms,
            u,
            positions: self.positions.address(),
            vertices: self.vertices as u32,
            reserved: 0,
        };
        let blocks = args.vertices.div_ceil(BLOCK);
        let config = LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK, 1, 1), shared_mem_bytes: 0 };
        let mut launch = device.stream().launch_builder(&self.compiled.function);
        // SAFETY: `PlainArgs` is the kernel's only argument. Its tables belong to one scene. The caller provides three
        // floats of u for each vertex of a domain with modes.
        unsafe { launch.arg(&args).launch(config) }.map_err(fault_in("plain_update"))?;
        Ok(())
    }

    pub(super) fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        let mut positions = vec![0.0_f32; 3 * self.vertices];
        self.positions.read(device, 0, &mut positions)?;
        Ok(positions)
    }

    pub(super) fn traffic(&self) -> Vec<ArrayTraffic> {
        let vertices = self.vertices as u64;
        let domain_bytes = if self.vertex_domains.is_some() { 4 * vertices } else { 0 };
        vec![
            ArrayTraffic::new("x0", 12 * vertices),
            ArrayTraffic::new("domains of vertices", domain_bytes),
            ArrayTraffic::new("T", self.transform_bytes),
            ArrayTraffic::new("u read", self.u_bytes),
            ArrayTraffic::new("x written", 12 * vertices),
        ]
    }

    pub(super) fn attributes(&self) -> &KernelAttributes {
        &self.compiled.attributes
    }
}

fn pack_domains(scene: &Scene, first_u: &[Option<u64>]) -> Vec<PlainDomain> {
    let pack_domain = |(domain_layout, first_u): (&modalcast_model::scene::DomainLayout, &Option<u64>)| PlainDomain {
        first_u: first_u.unwrap_or(RIGID),
        first_vertex: domain_layout.first_vertex as u32,
        reserved: 0,
    };
    scene.layout.domains.iter().zip(first_u).map(pack_domain).collect()
}

/// The domain of each vertex.
fn domain_of_vertices(scene: &Scene) -> Vec<u32> {
    let domain_layouts = scene.layout.domains.iter().enumerate();
    domain_layouts
        .flat_map(|(domain, domain_layout)| std::iter::repeat_n(domain as u32, domain_layout.vertices))
        .collect()
}

/// Rest positions of all domains, one domain after the other.
fn packed_rest(scene: &Scene) -> Vec<f32> {
    let shapes = (0..scene.domains.len()).map(|domain| scene.shape_of(domain));
    shapes.flat_map(|shape| shape.mesh.rest_positions().as_flattened()).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::super::kernel_benchmark::tests::compile_all;
    use super::*;
    use modalcast_compute::testing::{displacement_of, position_of, scene_and_state};

    /// The kernel's tables.
    struct Tables {
        domains: Vec<PlainDomain>,
        vertex_domains: Vec<u32>,
        rest: Vec<f32>,
    }

    /// CPU twin of `plain_update`: the same algorithm in Rust, for one vertex.
    fn twin_of_plain_update(tables: &Tables, transforms: &[f32], u: &[f32], vertex: usize) -> [f32; 3] {
        let domain = tables.vertex_domains[vertex] as usize;
        let plain_domain = tables.domains[domain];
        let mut deformed: [f32; 3] = std::array::from_fn(|axis| tables.rest[3 * vertex + axis]);
        if plain_domain.first_u != RIGID {
            let u = &u[plain_domain.first_u as usize + 3 * (vertex - plain_domain.first_vertex as usize)..];
            deformed.iter_mut().zip(u).for_each(|(coordinate, u)| *coordinate += u);
        }
        std::array::from_fn(|axis| {
            let row = &transforms[12 * domain + 4 * axis..][..4];
            row[0].mul_add(deformed[0], row[1].mul_add(deformed[1], row[2].mul_add(deformed[2], row[3])))
        })
    }

    #[test]
    fn twin_computes_positions_wherever_u_is_stored() {
        // Vertices, modes and triangles of each domain.
        let (scene, state) = scene_and_state(&[(5, 2, 1), (9, 0, 2), (40, 7, 30)]);
        // u of the first domain follows that of the last one, with unused floats before and between them.
        let first_u = [Some(200), None, Some(3)];
        let mut u = vec![f32::NAN; 200 + 3 * 5];
        for (domain, first) in first_u.iter().enumerate().filter_map(|(domain, first)| Some((domain, (*first)?))) {
            for vertex in 0..scene.layout.domains[domain].vertices {
                let displacement = displacement_of(&scene, &state, domain, vertex).map(|number| number as f32);
                u[first as usize + 3 * vertex..][..3].copy_from_slice(&displacement);
            }
        }
        let tables = Tables {
            domains: pack_domains(&scene, &first_u),
            vertex_domains: domain_of_vertices(&scene),
            rest: packed_rest(&scene),
        };
        let transforms: &[f32] = bytemuck::cast_slice(&state.transforms);
        for (domain, domain_layout) in scene.layout.domains.iter().enumerate() {
            for vertex in 0..domain_layout.vertices {
                let packed_vertex = domain_layout.first_vertex + vertex;
                let got = twin_of_plain_update(&tables, transforms, &u, packed_vertex);
                let want = position_of(&scene, &state, domain, vertex);
                for (want, got) in want.iter().zip(got) {
                    // The tolerance covers f32 rounding.
                    assert!(
                        (want - f64::from(got)).abs() < 1e-5,
                        "domain {domain}, vertex {vertex}: expected {want}, got {got}"
                    );
                }
                // Negative control: the next vertex has another position.
                let next_vertex = (packed_vertex + 1) % scene.layout.vertices;
                let next = twin_of_plain_update(&tables, transforms, &u, next_vertex);
                assert_ne!(next, want.map(|number| number as f32));
            }
        }
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_plain_update() {
        compile_all(&SOURCE);
    }
}
