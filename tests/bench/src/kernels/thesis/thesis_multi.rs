//! BASELINE. Launches `kernels/thesis_multi.cu`: u = U q of many domains in groups of lanes (chapter 3.2.2).
//!
//! The kernels of a split run one after the other. In the thesis, they run concurrently in streams (figure 3.5).

use cudarc::driver::{LaunchConfig, PushKernelArg as _};

use super::super::kernel_benchmark::{ArrayTraffic, BenchmarkSource, CompiledKernel, KernelAttributes};
use super::group::{BLOCK, KernelSplit, MAX_RANK, pack_groups};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::Scene;

pub(super) const SOURCE: BenchmarkSource = BenchmarkSource {
    text: include_str!("../../../kernels/thesis_multi.cu"),
    functions: &["thesis_multi"],
    define_sets: &[&["WIDTH=5"], &["WIDTH=6"], &["WIDTH=7"], &["WIDTH=8"]],
};

/// The kernel of one group width and its inputs.
#[derive(Debug)]
struct GroupKernel {
    compiled: CompiledKernel,
    entries: DeviceBuffer,
    meta: DeviceBuffer,
    lanes: usize,
    busy_lanes: u64,
}

/// The kernels of a split.
#[derive(Debug)]
pub(super) struct MultiDomainKernel {
    kernels: Vec<GroupKernel>,
    /// Number of rows of U, over all domains with modes.
    rows: u64,
}

impl MultiDomainKernel {
    /// # Errors
    /// `Invalid` when a domain has more than 32 modes; `Unavailable` when NVRTC is missing; `Fault` when the device
    /// fails.
    pub(super) fn new(device: &Device, scene: &Scene, split: KernelSplit) -> Result<Self> {
        let domain_layouts = &scene.layout.domains;
        if let Some(domain) = domain_layouts.iter().position(|domain_layout| domain_layout.rank > MAX_RANK) {
            let field = format!("domain {domain}: modes");
            return Err(invalid(field, format!("at most {MAX_RANK} for groups"), domain_layouts[domain].rank));
        }
        let rows = domain_layouts
            .iter()
            .filter(|domain_layout| domain_layout.rank > 0)
            .map(|domain_layout| 3 * domain_layout.vertices as u64)
            .sum();
        let mut kernels = Vec::new();
        for width in split.widths() {
            let packed = pack_groups(scene, split, *width);
            if packed.meta.is_empty() {
                continue;
            }
            let define = format!("WIDTH={width}");
            kernels.push(GroupKernel {
                compiled: CompiledKernel::new(device, &SOURCE, &[&define])?,
                entries: DeviceBuffer::upload(device, &packed.entries)?,
                meta: DeviceBuffer::upload(device, &packed.meta)?,
                lanes: packed.meta.len(),
                busy_lanes: packed.busy_lanes(),
            });
        }
        Ok(Self { kernels, rows })
    }

    pub(super) fn launch(&self, device: &Device, q: u64, u: u64) -> Result<()> {
        for kernel in &self.kernels {
            let blocks = (kernel.lanes / BLOCK) as u32;
            let config =
                LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK as u32, 1, 1), shared_mem_bytes: 0 };
            let (entries, meta) = (kernel.entries.address(), kernel.meta.address());
            let mut launch = device.stream().launch_builder(&kernel.compiled.function);
            launch.arg(&entries).arg(&meta).arg(&q).arg(&u);
            // SAFETY: these are the kernel's arguments. Entries and metadata have a float4 and a uint4 for each thread,
            // because `pack_groups` fills whole blocks. All indices in the metadata are those of one scene, so they are
            // inside of `u` and `q`.
            unsafe { launch.launch(config) }.map_err(fault_in("thesis_multi"))?;
        }
        Ok(())
    }

    pub(super) fn launches_per_step(&self) -> usize {
        self.kernels.len()
    }

    pub(super) fn traffic(&self, q_bytes: u64) -> Vec<ArrayTraffic> {
        let busy_lanes: u64 = self.kernels.iter().map(|kernel| kernel.busy_lanes).sum();
        let lanes: u64 = self.kernels.iter().map(|kernel| kernel.lanes as u64).sum();
        vec![
            ArrayTraffic::new("U in fours of modes", 16 * busy_lanes),
            ArrayTraffic::new("meta data of lanes", 16 * lanes),
            ArrayTraffic::new("q", q_bytes),
            ArrayTraffic::new("u written", 4 * self.rows),
        ]
    }

    pub(super) fn attributes(&self) -> Vec<KernelAttributes> {
        self.kernels.iter().map(|kernel| kernel.compiled.attributes.clone()).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::kernel_benchmark::tests::compile_all;
    use super::super::group::{DisplacementLayout, IDLE, PackedGroups, WARP, pack_q};
    use super::*;
    use modalcast_compute::testing::{displacement_of, scene_and_state};

    /// CPU twin of `thesis_multi`: the same algorithm in Rust, thread by thread. It also counts the writes to each
    /// number of u.
    fn twin_of_thesis_multi(packed: &PackedGroups, q: &[f32], u: &mut [f32], write_counts: &mut [usize]) {
        for first_lane in (0..packed.meta.len()).step_by(WARP) {
            let is_busy = |lane: &usize| packed.meta[first_lane + lane][0] != IDLE;
            let mut sub_sums = [0.0_f32; WARP];
            for lane in (0..WARP).filter(is_busy) {
                let q = &q[4 * packed.meta[first_lane + lane][1] as usize..][..4];
                sub_sums[lane] = packed.entries[first_lane + lane].iter().zip(q).map(|(entry, q)| entry * q).sum();
            }
            for lane in (0..WARP).filter(is_busy) {
                let [output, _, n_vr, _] = packed.meta[first_lane + lane].map(|number| number as usize);
                if (lane % packed.width).is_multiple_of(n_vr) {
                    u[output] = sub_sums[lane..lane + n_vr].iter().sum();
                    write_counts[output] += 1;
                }
            }
        }
    }

    #[test]
    fn twin_writes_every_row_once_with_any_split() {
        // Vertices, modes and triangles of each domain.
        let shapes: Vec<_> = (0..70).map(|index| (1 + index * 11 % 40, index % 33, 1)).collect();
        let (scene, state) = scene_and_state(&shapes);
        let DisplacementLayout { first_vertices, vertex_count } = DisplacementLayout::of(&scene);
        let q = pack_q(&scene, &state);
        for split in KernelSplit::ALL {
            let (mut u, mut write_counts) = (vec![f32::NAN; 4 * vertex_count], vec![0; 4 * vertex_count]);
            for width in split.widths() {
                twin_of_thesis_multi(&pack_groups(&scene, split, *width), &q, &mut u, &mut write_counts);
            }
            assert!(
                write_counts.iter().enumerate().all(|(index, count)| *count == usize::from(index % 4 < 3)),
                "{split:?}: expected one write to x, y and z of each vertex, and none to the fourth number"
            );
            let mut max_error = 0.0_f64;
            for (domain, first_u) in
                first_vertices.iter().enumerate().filter_map(|(domain, first_u)| Some((domain, (*first_u)?)))
            {
                for vertex in 0..scene.layout.domains[domain].vertices {
                    let want = displacement_of(&scene, &state, domain, vertex);
                    let got = &u[4 * (first_u as usize + vertex)..][..3];
                    max_error = want
                        .iter()
                        .zip(got)
                        .map(|(want, got)| (want - f64::from(*got)).abs())
                        .fold(max_error, f64::max);
                }
            }
            // Sums of up to 32 products differ between f32 and f64. An error of 0 would mean that nothing was compared.
            assert!(max_error > 0.0 && max_error < 1e-5, "{split:?}: {max_error}");
        }
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_thesis_multi() {
        compile_all(&SOURCE);
    }
}
