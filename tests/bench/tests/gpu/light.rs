//! Measures what the light-space bounds of a shadow map add to the time of a step.

use modalcast_bench::kernels::{BenchmarkStep, DeformerBenchmark, KernelBenchmark, StepOutputs, time_steps};
use modalcast_bench::timing::CacheState;
use modalcast_compute::gpu::Device;
use modalcast_model::scene::Scene;

use crate::scenes::{self, Random};

/// Median times of a step in microseconds: with light-space bounds, which a scene with a shadow has, and without.
fn measure_step_us(name: &str, (vertices, rank): (usize, usize), instances: usize) -> [f64; 2] {
    let device = Device::open(0).expect("expected a CUDA device");
    let times_us = [true, false].map(|has_shadow| {
        let mut parts = scenes::parts_of_shapes(vec![scenes::random_shape(&mut Random(9), vertices, rank)]);
        parts.domains = vec![scenes::new_domain(0, scenes::PLAIN_MATERIAL); instances];
        parts.look.shadow = parts.look.shadow.filter(|_| has_shadow);
        let scene = Scene::new(parts).expect("expected a valid scene");
        let benchmark = DeformerBenchmark::new(
            &device,
            &scene,
            &[scenes::random_state(&scene, 1)],
            BenchmarkStep::full(StepOutputs::Whole),
        )
        .expect("expected a benchmark");
        benchmark
            .kernel_attributes()
            .iter()
            .for_each(|attributes| eprintln!("{name}, shadow {has_shadow}: {attributes:?}"));
        time_steps(&device, &benchmark, CacheState::Warm, 300).expect("a timing").median_us
    });
    eprintln!("{name}: {:.2} us per step with light-space bounds, {:.2} us without", times_us[0], times_us[1]);
    times_us
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_space_bounds_add_at_most_10_percent_and_5_us() {
    // Shapes are (vertices, rank).
    for (name, shape, instances) in [
        ("one domain of 16,085", (16_085, 20), 1),
        ("a million vertices", (1_000_000, 32), 1),
        ("20,000 domains of 7", (7, 3), 20_000),
        ("200,000 domains of 60", (60, 0), 200_000),
    ] {
        let [with_us, without_us] = measure_step_us(name, shape, instances);
        assert!(
            with_us > 0.0 && with_us < 1.1 * without_us + 5.0,
            "{name}: expected at most 10 % and 5 us more than {without_us} us, got {with_us} us"
        );
    }
}
