//! Kernel launches for the light-space bounds of a shadow map.

use modalcast_bench::kernels::{BenchmarkStep, DeformerBenchmark, KernelBenchmark, StepOutputs};
use modalcast_compute::gpu::Device;
use modalcast_model::scene::Scene;

use crate::scenes::{self, Random};

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_light_space_bounds_add_no_launch() {
    let device = Device::open(0).expect("expected a CUDA device");
    // (vertices, rank) of the shape, and the number of its instances.
    for (shape, instances) in [((16_085, 20), 1), ((7, 3), 2000), ((60, 0), 2000)] {
        let kernels = [true, false].map(|has_shadow| {
            let mut parts = scenes::parts_of_shapes(vec![scenes::random_shape(&mut Random(9), shape.0, shape.1)]);
            parts.domains = vec![scenes::new_domain(0, scenes::PLAIN_MATERIAL); instances];
            parts.look.shadow = parts.look.shadow.filter(|_| has_shadow);
            let scene = Scene::new(parts).expect("expected a valid scene");
            let (state, step) = (scenes::random_state(&scene, 1), BenchmarkStep::full(StepOutputs::Whole));
            let benchmark = DeformerBenchmark::new(&device, &scene, &[state], step).expect("expected a benchmark");
            let names: Vec<String> =
                benchmark.kernel_attributes().into_iter().map(|attributes| attributes.name.to_string()).collect();
            (names, benchmark.launches_per_step())
        });
        assert_eq!(kernels[0], kernels[1], "{shape:?} x {instances}");
    }
}
