//! Benchmark: bytes per second that the CPU deformer reads and writes, as a fraction of the read bandwidth. Run with
//! `cargo test --release -p modalcast-compute cpu::bench -- --ignored --nocapture`.

use std::time::Instant;

use super::*;
use crate::testing::{TestRng, scene};
use modalcast_model::scene::{DeformationSettings, StorageType};

/// The median time in seconds of 15 steps with different coordinates, after 5 steps to warm up.
fn median_step(scene: &Arc<Scene>, deformer: &mut CpuDeformer) -> f64 {
    let mut rng = TestRng(3);
    let mut state = SceneState::rest(scene);
    let mut times: Vec<f64> = (0..20)
        .map(|_| {
            state.q.iter_mut().for_each(|number| *number = rng.next());
            deformer.changes.update(scene, &state);
            let start = Instant::now();
            deformer.deform_positions(&state);
            start.elapsed().as_secs_f64()
        })
        .skip(5)
        .collect();
    times.sort_by(f64::total_cmp);
    times[times.len() / 2]
}

#[test]
#[ignore = "a measurement"]
fn prints_fraction_of_read_bandwidth() {
    // U of the first size fits into the caches, so its time is that of the computation alone.
    for (vertices, rank) in [(1 << 11, 32), (1 << 20, 10), (1 << 20, 32)] {
        for storage in StorageType::ALL {
            for compensated in [false, true] {
                let deformation = DeformationSettings { storage, compensated, ..DeformationSettings::default() };
                let scene = scene(&[(vertices, rank)], deformation, &mut TestRng(1));
                let mut deformer = CpuDeformer::new(&scene);
                // The deformer reads U and x0, and writes a position of 12 bytes per vertex.
                let bytes = deformer.stored_bytes() + 12 * vertices;
                let bandwidth = bytes as f64 / median_step(&scene, &mut deformer) / 1e9;
                let read_limit = read_bandwidth(bytes, 10);
                let name = storage.name();
                println!(
                    "n {vertices} r {rank} {name} compensated {compensated}: {bandwidth:.1} of {read_limit:.1} GB/s, {:.2}",
                    bandwidth / read_limit
                );
                assert!(bandwidth > 0.0 && read_limit > 0.0);
            }
        }
    }
}
