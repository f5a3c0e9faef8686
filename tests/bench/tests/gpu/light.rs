//! Cost of computing light-space bounds in a step.

use modalcast_bench::kernels::{BenchmarkStep, DeformerBenchmark, KernelBenchmark, StepOutputs, time};
use modalcast_bench::timing::CacheState;
use modalcast_compute::gpu::Device;
use modalcast_model::scene::Scene;

use crate::scenes::{self, Random};

/// Times of a whole step with and without a shadow, microseconds.
fn costs(name: &str, (vertices, rank): (usize, usize), instances: usize) -> [f64; 2] {
    let device = Device::open(0).expect("expected a CUDA device");
    let with = [true, false].map(|is_lit| {
        let mut parts = scenes::parts_of_shapes(vec![scenes::random_shape(&mut Random(9), vertices, rank)]);
        parts.domains = vec![scenes::new_domain(0, 0); instances];
        parts.look.shadow = parts.look.shadow.filter(|_| is_lit);
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
            .for_each(|attributes| eprintln!("{name}, shadow {is_lit}: {attributes:?}"));
        time(&device, &benchmark, CacheState::Warm, 300).expect("times").median_us
    });
    eprintln!("{name}: {:.2} us a step with light space, {:.2} us without", with[0], with[1]);
    with
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_space_bounds_add_at_most_10_percent_and_5_us() {
    // Shapes are (vertices, modes).
    for (name, shape, instances) in [
        ("one domain of 16,085", (16_085, 20), 1),
        ("a million vertices", (1_000_000, 32), 1),
        ("20,000 domains of 7", (7, 3), 20_000),
        ("200,000 domains of 60", (60, 0), 200_000),
    ] {
        let [with, without] = costs(name, shape, instances);
        assert!(with > 0.0 && with < 1.1 * without + 5.0, "{name}: {with} and {without} us");
    }
}
