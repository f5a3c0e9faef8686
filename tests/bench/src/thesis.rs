//! Results printed in tables 4.4 to 4.7 of the thesis, for comparison with ours.
//!
//! The GPU was a GeForce GTX 680. The CPU code used `OpenMP` with 16 threads.

use serde::Serialize;

/// Binary logarithms of the vertex counts of table 4.4, in the order of its columns.
pub const POWERS: [u32; 5] = [14, 16, 18, 20, 22];

/// Modes of table 4.4, in the order of its rows.
pub const RANKS: [usize; 3] = [10, 20, 30];

/// Table 4.4: CPU time over GPU time of u = U q of one domain; a row per entry of [`RANKS`], a column per entry of
/// [`POWERS`].
pub const CPU_OVER_GPU: [[f64; 5]; 3] =
    [[2.53, 0.68, 1.44, 1.6, 1.77], [6.47, 2.76, 5.01, 6.54, 7.04], [5.32, 3.67, 6.60, 8.02, 9.69]];

/// One plant of tables 4.5 to 4.7. Times are in milliseconds; `t_uq` is the time of u = U q. An occupation is the
/// fraction of the frame time that a computation takes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ThesisPlant {
    pub name: &'static str,
    /// Table 4.5, v: render vertices.
    pub vertices: usize,
    /// Table 4.5, f: triangles.
    pub faces: usize,
    /// Table 4.5, v': vertices after unfolding the triangles.
    pub unfolded: usize,
    /// Table 4.5, d: domains.
    pub domains: usize,
    /// Table 4.5, d': domains with modes.
    pub deformable: usize,
    /// Table 4.5, r: modes of all domains.
    pub modes: usize,
    /// Table 4.5, u: rows of all matrices U. This is not 3 v.
    pub rows: usize,
    /// Table 4.6, `t_uq` of the CPU.
    pub cpu_uq_ms: f64,
    /// Table 4.6, `t_uq` of the GPU.
    pub gpu_uq_ms: f64,
    /// Table 4.6, `t_vb` of the GPU: vertex updating without rendering.
    pub gpu_update_ms: f64,
    /// Table 4.6, `n_uqk`: kernels of the Uq computation.
    pub kernels: usize,
    /// Table 4.7, `k_uq`: `t_uq` of the CPU over that of the GPU.
    pub speedup_uq: f64,
    /// Table 4.7, `O_uq` of the CPU: occupation by Uq.
    pub cpu_occupation: f64,
    /// Table 4.7, `O_uq` of the GPU.
    pub gpu_occupation: f64,
    /// Times with rendering.
    pub drawn: ThesisRenderTimes,
}

/// The rendering columns of tables 4.6 and 4.7.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ThesisRenderTimes {
    /// Table 4.6, FPS of the CPU.
    pub cpu_fps: f64,
    /// Table 4.6, `t_vbr` of the CPU: vertex updating with rendering.
    pub cpu_vbr_ms: f64,
    /// Table 4.6, FPS of the GPU.
    pub gpu_fps: f64,
    /// Table 4.6, `t_vbr` of the GPU.
    pub gpu_vbr_ms: f64,
    /// Table 4.6, s: GPU memory in megabytes.
    pub gpu_mb: f64,
    /// Table 4.7, `O_vbr` of the CPU: occupation by vertex updating with rendering.
    pub cpu_vbr_occupation: f64,
    /// Table 4.7, `O_vbr` of the GPU.
    pub gpu_vbr_occupation: f64,
}

/// The columns v, f, v', d, d', r and u of table 4.5.
type SizeColumns = [usize; 7];
/// `t_uq` of CPU and GPU, `t_vb` (table 4.6), `k_uq`, `O_uq` of CPU and GPU in per cent (table 4.7).
type TimeColumns = [f64; 6];

/// FPS and `t_vbr` of the CPU, FPS, `t_vbr` and s of the GPU (table 4.6), `O_vbr` of CPU and GPU in per cent (table
/// 4.7).
type RenderColumns = [f64; 7];

/// A plant from its rows of the three tables. `kernels` is `n_uqk` of table 4.6.
const fn plant(
    name: &'static str,
    counts: SizeColumns,
    kernels: usize,
    times: TimeColumns,
    rendering: RenderColumns,
) -> ThesisPlant {
    let [vertices, faces, unfolded, domains, deformable, modes, rows] = counts;
    let [cpu_uq_ms, gpu_uq_ms, gpu_update_ms, speedup_uq, cpu_percent, gpu_percent] = times;
    let [cpu_fps, cpu_vbr_ms, gpu_fps, gpu_vbr_ms, gpu_mb, cpu_vbr_percent, gpu_vbr_percent] = rendering;
    ThesisPlant {
        name,
        vertices,
        faces,
        unfolded,
        domains,
        deformable,
        modes,
        rows,
        cpu_uq_ms,
        gpu_uq_ms,
        gpu_update_ms,
        kernels,
        speedup_uq,
        cpu_occupation: cpu_percent / 100.0,
        gpu_occupation: gpu_percent / 100.0,
        drawn: ThesisRenderTimes {
            cpu_fps,
            cpu_vbr_ms,
            gpu_fps,
            gpu_vbr_ms,
            gpu_mb,
            cpu_vbr_occupation: cpu_vbr_percent / 100.0,
            gpu_vbr_occupation: gpu_vbr_percent / 100.0,
        },
    }
}

/// The twelve plants, in the order of the tables.
#[rustfmt::skip]
pub const PLANTS: [ThesisPlant; 12] = [
    plant("Pansy", [7_987, 15_372, 46_476, 22, 22, 324, 106_882], 2, [0.323, 0.189, 1.73, 1.71, 9.37, 1.42], [290.0, 2.606, 75.0, 2.248, 9.7, 75.57, 16.86]),
    plant("Conifer", [7_543, 7_517, 22_551, 644, 43, 360, 41_652], 1, [0.261, 0.165, 1.059, 1.58, 1.57, 0.91], [60.0, 5.886, 55.0, 1.693, 5.8, 35.32, 9.31]),
    plant("Weed willow", [291_914, 313_230, 939_690, 32_623, 98, 958, 362_084], 2, [8.066, 1.12, 5.766, 7.20, 2.42, 1.79], [3.0, 261.926, 16.0, 6.483, 129.8, 78.58, 10.37]),
    plant("Peach tree", [273_003, 299_707, 899_121, 22_659, 237, 2_950, 230_528], 2, [1.978, 0.713, 6.949, 2.77, 0.99, 0.71], [5.0, 150.619, 10.0, 9.692, 119.6, 75.31, 9.69]),
    plant("Broad-leaved tree", [288_542, 339_111, 1_017_333, 7_003, 402, 3_613, 443_022], 2, [3.341, 0.391, 6.417, 8.54, 3.34, 0.98], [10.0, 80.008, 25.0, 7.01, 150.9, 80.01, 17.52]),
    plant("Fir", [64_824, 75_953, 227_859, 9_077, 585, 4_912, 181_524], 2, [1.949, 0.329, 1.776, 5.92, 1.95, 0.92], [10.0, 63.729, 28.0, 2.335, 35.5, 63.73, 6.54]),
    plant("Western red cedar", [40_480, 55_810, 167_430, 4_408, 800, 5_987, 205_112], 2, [1.434, 0.283, 1.727, 5.07, 2.44, 0.91], [17.0, 42.368, 32.0, 2.611, 25.6, 72.03, 8.36]),
    plant("Incense cedar", [102_115, 133_545, 400_635, 11_938, 1_054, 6_853, 405_258], 1, [3.299, 0.476, 4.132, 6.93, 2.31, 0.95], [7.0, 120.238, 20.0, 4.817, 59.7, 84.17, 9.63]),
    plant("Quercus Garryana", [586_668, 224_926, 674_778, 120_871, 871, 9_520, 1_000_860], 2, [22.837, 4.768, 39.822, 4.79, 2.28, 1.43], [1.0, 784.792, 3.0, 40.575, 906.3, 78.48, 12.17]),
    plant("Blue spruce", [1_421_810, 1_070_963, 3_212_889, 219_476, 1_582, 10_680, 524_640], 1, [12.152, 6.997, 15.86, 1.74, 1.22, 1.40], [1.0, 1302.294, 2.0, 16.409, 424.3, 130.23, 3.28]),
    plant("Three firs", [194_472, 227_859, 683_577, 27_232, 1_755, 14_736, 544_572], 2, [3.268, 0.714, 4.978, 4.58, 0.98, 1.07], [3.0, 261.394, 15.0, 5.494, 103.6, 78.42, 8.24]),
    plant("Eastern hemlock", [190_466, 262_794, 788_382, 27_778, 2_537, 16_793, 1_051_414], 2, [8.703, 0.833, 11.457, 10.45, 2.61, 0.92], [3.0, 240.762, 11.0, 12.216, 165.2, 72.23, 13.44]),
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn printed_speedups_are_quotients_of_printed_times() {
        for plant in PLANTS {
            // One unit of the last printed digit is 0.01; 0.011 also allows for the rounding of the printed times.
            let quotient = plant.cpu_uq_ms / plant.gpu_uq_ms;
            assert!((quotient - plant.speedup_uq).abs() <= 0.011, "{}: {quotient}", plant.name);
        }
    }

    #[test]
    fn printed_speedups_and_occupations_follow_from_t_vbr() {
        // Printed quotients of `t_vbr` of the CPU and of the GPU, with two digits after the point. Printed occupations
        // are percentages with two digits after the point, so the fractions have four.
        let speedups = [1.16, 3.48, 40.40, 15.54, 11.41, 27.29, 16.23, 24.96, 19.34, 79.36, 47.58, 19.71];
        for (plant, speedup) in PLANTS.iter().zip(speedups) {
            let ThesisRenderTimes { cpu_vbr_ms, cpu_fps, cpu_vbr_occupation, .. } = plant.drawn;
            let ThesisRenderTimes { gpu_vbr_ms, gpu_fps, gpu_vbr_occupation, .. } = plant.drawn;
            assert!((cpu_vbr_ms / gpu_vbr_ms - speedup).abs() <= 0.006, "{}", plant.name);
            assert!((cpu_vbr_ms / 1e3 * cpu_fps - cpu_vbr_occupation).abs() <= 1e-4, "{}", plant.name);
            assert!((gpu_vbr_ms / 1e3 * gpu_fps - gpu_vbr_occupation).abs() <= 1e-4, "{}", plant.name);
        }
    }

    #[test]
    fn unfolding_gives_3_vertices_per_face_except_one_misprint() {
        let mismatched_plants: Vec<&str> =
            PLANTS.iter().filter(|plant| plant.unfolded != 3 * plant.faces).map(|plant| plant.name).collect();
        assert_eq!(mismatched_plants, ["Pansy"]);
        assert!(PLANTS.iter().all(|plant| plant.rows != 3 * plant.vertices), "u is not 3 v");
    }
}
