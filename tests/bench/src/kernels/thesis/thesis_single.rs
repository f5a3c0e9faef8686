//! BASELINE. Launches `kernels/thesis_single.cu`: u = U q of one domain (chapter 3.2.1).

use cudarc::driver::{LaunchConfig, PushKernelArg as _};

use super::super::kernel_benchmark::{ArrayTraffic, BenchmarkSource, CompiledKernel, KernelAttributes};
use super::group::{BLOCK, WARP, pack_row_vector, vectors_per_row};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::Scene;

pub(super) const SOURCE: BenchmarkSource = BenchmarkSource {
    text: include_str!("../../../kernels/thesis_single.cu"),
    functions: &["thesis_single"],
    define_sets: &[&[]],
};

/// Layout of U in lines (figure 3.3). A warp computes one line, which holds as many whole rows as fit into 32 lanes.
/// Rows of more than 32 float4 take several passes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
struct RowLines {
    /// Number of rows of U: three per vertex.
    rows: usize,
    rank: usize,
    /// Lanes per row: n_vr (float4 per row), at most 32.
    width: usize,
    /// Passes per line: n_vr / 32, rounded up.
    passes: usize,
    /// Number of lines; a line has 32 float4 per pass.
    lines: usize,
}

impl RowLines {
    fn new(vertices: usize, rank: usize) -> Self {
        let (rows, width) = (3 * vertices, vectors_per_row(rank).min(WARP));
        Self { rows, rank, width, passes: vectors_per_row(rank).div_ceil(WARP), lines: rows.div_ceil(WARP / width) }
    }

    /// The lines as the kernel reads them; idle lanes hold zeros.
    fn pack(self, scene: &Scene) -> Vec<[f32; 4]> {
        let rows_per_line = WARP / self.width;
        let mut lines = Vec::with_capacity(self.lines * self.passes * WARP);
        for line in 0..self.lines {
            for (pass, lane) in (0..self.passes).flat_map(|pass| (0..WARP).map(move |lane| (pass, lane))) {
                let (row, k) = (line * rows_per_line + lane / self.width, pass * WARP + lane % self.width);
                let is_busy = lane < rows_per_line * self.width && row < self.rows && k < vectors_per_row(self.rank);
                lines.push(if is_busy { pack_row_vector(scene, 0, row, k) } else { [0.0; 4] });
            }
        }
        lines
    }
}

/// The kernel and the uploaded lines of U.
#[derive(Debug)]
pub(super) struct SingleDomainKernel {
    compiled: CompiledKernel,
    packed_lines: DeviceBuffer,
    layout: RowLines,
}

impl SingleDomainKernel {
    /// # Errors
    /// `Invalid` when the scene is not one domain with modes.
    pub(super) fn new(device: &Device, scene: &Scene) -> Result<Self> {
        let [domain_layout] = scene.layout.domains[..] else {
            return Err(invalid("scene.domains", "1 for the single-domain kernel", scene.domains.len()));
        };
        if domain_layout.rank == 0 {
            return Err(invalid("modes", "at least 1 for the single-domain kernel", 0));
        }
        let layout = RowLines::new(domain_layout.vertices, domain_layout.rank);
        let compiled = CompiledKernel::new(device, &SOURCE, &[])?;
        Ok(Self { compiled, packed_lines: DeviceBuffer::upload(device, &layout.pack(scene))?, layout })
    }

    pub(super) fn launch(&self, device: &Device, q: u64, u: u64) -> Result<()> {
        let blocks = self.layout.lines.div_ceil(BLOCK / WARP) as u32;
        let config = LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK as u32, 1, 1), shared_mem_bytes: 0 };
        let (lines, rank, rows) = (self.packed_lines.address(), self.layout.rank as u32, self.layout.rows as u32);
        let mut launch = device.stream().launch_builder(&self.compiled.function);
        launch.arg(&lines).arg(&q).arg(&u).arg(&rank).arg(&rows);
        // SAFETY: these are the kernel's arguments. `packed_lines` has every line of `layout`. `q` has as many floats
        // as the rank of the scene's only domain, and `u` has a float4 per vertex. Warps beyond the last line read no
        // line and write no u.
        unsafe { launch.launch(config) }.map_err(fault_in("thesis_single"))?;
        Ok(())
    }

    pub(super) fn traffic(&self) -> Vec<ArrayTraffic> {
        let rows = self.layout.rows as u64;
        vec![
            ArrayTraffic::new("U in fours of modes", 16 * rows * vectors_per_row(self.layout.rank) as u64),
            ArrayTraffic::new("q", 4 * self.layout.rank as u64),
            ArrayTraffic::new("u written", 4 * rows),
        ]
    }

    pub(super) fn attributes(&self) -> &KernelAttributes {
        &self.compiled.attributes
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::kernel_benchmark::tests::compile_all;
    use super::*;
    use modalcast_compute::testing::{displacement_of, scene_and_state};

    /// Index of q_i in shared memory, in floats (equation 3.3), for i below 128.
    const fn shared_index_of_q(i: usize) -> usize {
        i % 4 * 32 + i / 4
    }

    /// CPU twin of `thesis_single`: the same algorithm in Rust, thread by thread.
    fn twin_of_thesis_single(lines: &[[f32; 4]], q: &[f32], rows: usize) -> Vec<f32> {
        let (rank, width) = (q.len(), vectors_per_row(q.len()).min(WARP));
        let (rows_per_line, passes) = (WARP / width, vectors_per_row(rank).div_ceil(WARP));
        let mut shared_q = [f32::NAN; modalcast_model::domain::MAX_RANK];
        for (index, shared) in shared_q.iter_mut().enumerate().take(passes * 4 * WARP) {
            // A pass has 4 x 32 = 128 modes. Within a pass, this is the inverse of equation 3.3.
            let mode = index / 128 * 128 + 4 * (index % WARP) + index / WARP % 4;
            *shared = q.get(mode).copied().unwrap_or(0.0);
        }
        let mut u = vec![f32::NAN; 4 * rows.div_ceil(3)];
        for line in 0..lines.len() / (WARP * passes) {
            let mut sub_sums = [0.0_f32; WARP];
            let is_busy = |lane: usize| lane < rows_per_line * width && line * rows_per_line + lane / width < rows;
            for lane in (0..WARP).filter(|lane| is_busy(*lane)) {
                for pass in (0..passes).filter(|pass| pass * WARP + lane % width < vectors_per_row(rank)) {
                    let entries = lines[(line * passes + pass) * WARP + lane];
                    let q = &shared_q[pass * 4 * WARP + lane % width..];
                    sub_sums[lane] += (0..4).map(|index| entries[index] * q[index * WARP]).sum::<f32>();
                }
            }
            for lane in (0..WARP).filter(|lane| is_busy(*lane) && lane % width == 0) {
                let row = line * rows_per_line + lane / width;
                u[4 * (row / 3) + row % 3] = sub_sums[lane..lane + width].iter().sum();
            }
        }
        u
    }

    #[test]
    fn twin_sums_every_row_for_any_rank() {
        const VERTICES: usize = 23;
        const ROWS: usize = 3 * VERTICES;
        for rank in [1, 3, 4, 5, 9, 10, 20, 30, 31, 32, 33, 127, 128, 129, 300, 512] {
            let (scene, state) = scene_and_state(&[(VERTICES, rank, 1)]);
            let lines = RowLines::new(VERTICES, rank).pack(&scene);
            let max_error = |q: &[f32]| {
                let u = twin_of_thesis_single(&lines, q, ROWS);
                let error = |row: usize| {
                    let want = displacement_of(&scene, &state, 0, row / 3)[row % 3];
                    let error = (f64::from(u[4 * (row / 3) + row % 3]) - want).abs();
                    if error.is_nan() { f64::INFINITY } else { error }
                };
                (0..ROWS).map(error).fold(0.0, f64::max)
            };
            // f32 sums of up to 512 products of numbers from -1 to 1.
            assert!(max_error(&state.q) < 1e-4, "rank {rank}: {}", max_error(&state.q));
            // Negative control: another coordinate changes u.
            let mut changed_q = state.q.clone();
            changed_q[rank - 1] += 1.0;
            assert!(max_error(&changed_q) > 1e-3, "rank {rank}");
        }
    }

    #[test]
    fn equation_3_3_avoids_bank_conflicts_up_to_rank_128() {
        let distinct_indices =
            |rank: usize| (0..rank).map(shared_index_of_q).collect::<std::collections::BTreeSet<_>>().len();
        assert_eq!(distinct_indices(128), 128);
        // The 129th coordinate has the index of the second.
        assert!(distinct_indices(129) < 129);
        // The kernel stores q[4 j + i] at index i * 32 + j, as this function does.
        assert!((0..128).all(|index| shared_index_of_q(4 * (index % 32) + index / 32) == index));
        // The 32 lanes read one component of their float4 of q from 32 banks.
        for component in 0..4 {
            let banks: std::collections::BTreeSet<usize> =
                (0..32).map(|k| shared_index_of_q(4 * k + component) % 32).collect();
            assert_eq!(banks.len(), 32);
        }
    }

    #[test]
    fn line_holds_complete_rows_and_is_128_byte_aligned() {
        // A rank of 30 as in figure 3.2: eight lanes per row, four rows per line. Four vertices have 12 rows.
        let lines = RowLines::new(4, 30);
        assert_eq!((lines.width, lines.passes, lines.lines), (8, 1, 3));
        assert_eq!(WARP * size_of::<[f32; 4]>() % 128, 0);
        // A rank of 10: three lanes per row, ten rows per line.
        assert_eq!(RowLines::new(4, 10), RowLines { rows: 12, rank: 10, width: 3, passes: 1, lines: 2 });
        // A rank of 512: a row has 128 float4, four passes of 32 lanes.
        assert_eq!(RowLines::new(1, 512), RowLines { rows: 3, rank: 512, width: 32, passes: 4, lines: 3 });
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_thesis_single() {
        compile_all(&SOURCE);
    }
}
