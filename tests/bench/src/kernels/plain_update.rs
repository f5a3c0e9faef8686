//! Launches `kernels/plain_update.cu`: x = T (x0 + u) after a library computed u. Only benchmarks use it.

use bytemuck::{Pod, Zeroable};
use cudarc::driver::{DeviceRepr, LaunchConfig, PushKernelArg as _};

use super::kernel_benchmark::{BenchmarkSource, CompiledKernel, KernelAttributes};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::Scene;

pub(super) const CODE: BenchmarkSource = BenchmarkSource {
    source: include_str!("../../kernels/plain_update.cu"),
    functions: &["plain_update"],
    variants: &[&[], &["SINGLE"]],
};

const BLOCK: u32 = 256;

/// Value of `first_u` for a domain without modes.
const RIGID: u64 = u64::MAX;

/// First float of a domain's u and its first packed vertex.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
struct PlainDomain {
    first_u: u64,
    first: u32,
    reserved: u32,
}

/// Arguments of `plain_update`; pointers are device addresses.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct PlainArgs {
    slots: u64,
    domains: u64,
    rest: u64,
    transforms: u64,
    u: u64,
    positions: u64,
    vertices: u32,
    reserved: u32,
}

const _: () = assert!(size_of::<PlainDomain>() == 16, "PlainSlot differs from kernels/plain_update.cu");
const _: () = assert!(size_of::<PlainArgs>() == 56, "PlainArgs differs from kernels/plain_update.cu");

// SAFETY: repr(C) without padding or Rust references, laid out as the struct of the same name in the kernel.
unsafe impl DeviceRepr for PlainArgs {}

/// The kernel with its inputs and outputs.
#[derive(Debug)]
pub(super) struct PlainUpdate {
    compiled: CompiledKernel,
    slots: DeviceBuffer,
    domains: Option<DeviceBuffer>,
    rest: DeviceBuffer,
    positions: DeviceBuffer,
    vertices: usize,
    /// Bytes of the transforms, and of u.
    read: [u64; 2],
}

impl PlainUpdate {
    /// `first_u` holds the first float of each domain's u; `None` for domains without modes.
    pub(super) fn new(device: &Device, scene: &Scene, first_u: &[Option<u64>]) -> Result<Self> {
        let (single, vertices) = (scene.domains.len() == 1, scene.layout.vertices);
        let defines: &[&str] = if single { &["SINGLE"] } else { &[] };
        let moving = scene.layout.slots.iter().filter(|slot| slot.rank > 0).map(|slot| 12 * slot.vertices as u64);
        Ok(Self {
            compiled: CompiledKernel::new(device, &CODE, defines)?,
            slots: DeviceBuffer::upload(device, &slots(scene, first_u))?,
            domains: (!single).then(|| DeviceBuffer::upload(device, &domains(scene))).transpose()?,
            rest: DeviceBuffer::upload(device, &rest(scene))?,
            positions: DeviceBuffer::zeroed(device, 12 * vertices as u64)?,
            vertices,
            read: [48 * scene.domains.len() as u64, moving.sum()],
        })
    }

    pub(super) fn launch(&self, device: &Device, transforms: u64, u: u64) -> Result<()> {
        let args = PlainArgs {
            slots: self.slots.address(),
            domains: self.domains.as_ref().map_or(0, |domains| domains.address()),
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
        // SAFETY: `PlainArgs` is the kernel's only argument. Its tables belong to one scene, and the caller provides
        // three floats of u for each vertex of a domain that has a `first_u`.
        unsafe { launch.arg(&args).launch(config) }.map_err(fault_in("plain_update"))?;
        Ok(())
    }

    pub(super) fn positions(&self, device: &Device) -> Result<Vec<f32>> {
        let mut positions = vec![0.0_f32; 3 * self.vertices];
        self.positions.read(device, 0, &mut positions)?;
        Ok(positions)
    }

    pub(super) fn bytes(&self) -> Vec<(&'static str, u64)> {
        let vertices = self.vertices as u64;
        let domains = if self.domains.is_some() { 4 * vertices } else { 0 };
        vec![
            ("x0", 12 * vertices),
            ("domains of vertices", domains),
            ("T", self.read[0]),
            ("u read", self.read[1]),
            ("x written", 12 * vertices),
        ]
    }

    pub(super) fn facts(&self) -> &KernelAttributes {
        &self.compiled.facts
    }
}

fn slots(scene: &Scene, first_u: &[Option<u64>]) -> Vec<PlainDomain> {
    let slot = |(slot, first_u): (&modalcast_model::scene::DomainLayout, &Option<u64>)| PlainDomain {
        first_u: first_u.unwrap_or(RIGID),
        first: slot.first_vertex as u32,
        reserved: 0,
    };
    scene.layout.slots.iter().zip(first_u).map(slot).collect()
}

fn domains(scene: &Scene) -> Vec<u32> {
    let slots = scene.layout.slots.iter().enumerate();
    slots.flat_map(|(domain, slot)| std::iter::repeat_n(domain as u32, slot.vertices)).collect()
}

fn rest(scene: &Scene) -> Vec<f32> {
    let shapes = (0..scene.domains.len()).map(|domain| scene.shape_of(domain));
    shapes.flat_map(|shape| shape.mesh.rest().as_flattened()).copied().collect()
}

#[cfg(test)]
mod tests {
    use super::super::kernel_benchmark::tests::compile_all;
    use super::*;
    use modalcast_compute::testing::{displacement_of, position_of, scene_and_state};

    /// CPU twin of `plain_update`, for one vertex.
    fn twin_of_plain_update(tables: (&[PlainDomain], &[u32], &[f32]), t: &[f32], u: &[f32], vertex: usize) -> [f32; 3] {
        let (slots, domains, rest) = tables;
        let domain = domains[vertex] as usize;
        let slot = slots[domain];
        let mut bent: [f32; 3] = std::array::from_fn(|axis| rest[3 * vertex + axis]);
        if slot.first_u != RIGID {
            let u = &u[slot.first_u as usize + 3 * (vertex - slot.first as usize)..];
            bent.iter_mut().zip(u).for_each(|(bent, u)| *bent += u);
        }
        std::array::from_fn(|axis| {
            let row = &t[12 * domain + 4 * axis..][..4];
            row[0].mul_add(bent[0], row[1].mul_add(bent[1], row[2].mul_add(bent[2], row[3])))
        })
    }

    #[test]
    fn twin_computes_positions_wherever_u_is_stored() {
        let (scene, state) = scene_and_state(&[(5, 2, 1), (9, 0, 2), (40, 7, 30)]);
        let first_u = [Some(200), None, Some(3)];
        let mut u = vec![f32::NAN; 215];
        for (domain, first) in first_u.iter().enumerate().filter_map(|(domain, first)| Some((domain, (*first)?))) {
            for vertex in 0..scene.layout.slots[domain].vertices {
                let numbers = displacement_of(&scene, &state, domain, vertex).map(|number| number as f32);
                u[first as usize + 3 * vertex..][..3].copy_from_slice(&numbers);
            }
        }
        let (slots, domains, rest) = (slots(&scene, &first_u), domains(&scene), rest(&scene));
        let transforms: &[f32] = bytemuck::cast_slice(&state.transforms);
        for (domain, slot) in scene.layout.slots.iter().enumerate() {
            for vertex in 0..slot.vertices {
                let packed = slot.first_vertex + vertex;
                let got = twin_of_plain_update((&slots, &domains, &rest), transforms, &u, packed);
                for (want, got) in position_of(&scene, &state, domain, vertex).iter().zip(got) {
                    assert!((want - f64::from(got)).abs() < 1e-5, "domain {domain} vertex {vertex}: {got} not {want}");
                }
                let other = twin_of_plain_update((&slots, &domains, &rest), transforms, &u, (packed + 1) % 54);
                assert_ne!(other, got_of(&scene, &state, domain, vertex), "the judge can fail");
            }
        }
    }

    fn got_of(scene: &Scene, state: &modalcast_model::scene::SceneState, domain: usize, vertex: usize) -> [f32; 3] {
        position_of(scene, state, domain, vertex).map(|number| number as f32)
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_plain_update() {
        compile_all(&CODE);
    }
}
