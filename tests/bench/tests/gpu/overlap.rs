//! Steps with readback of the vertices: serial, and overlapped with the next steps.

use modalcast_bench::kernels::{measure_overlap, time_host_writes};
use modalcast_bench::workloads::Workload;
use modalcast_compute::gpu::Device;
use modalcast_model::scene::SceneState;

use crate::scenes;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overlapped_steps_have_the_vertices_of_serial_steps() {
    let device = Device::open(0).expect("expected a CUDA device");
    let scene = scenes::random_scene(
        &[(200_000, 8), (7, 0), (40, 3)],
        scenes::RandomSceneOptions { instances: 4, normal_maps: false, rigid_transforms: false },
    );
    let states: Vec<SceneState> = (0..4).map(|seed| scenes::random_state(&scene, seed)).collect();
    let workload = Workload::new("overlap".to_owned(), scene);
    let measurement = measure_overlap(&device, &workload, &states, 50).expect("a measurement");
    eprintln!("{measurement:#?}");
    assert_eq!(
        measurement.differing, 0,
        "expected the vertices of serial steps in every pipelined and overlapped step"
    );
    let times = [
        measurement.serial_us,
        measurement.pipelined_us,
        measurement.overlapped_us,
        measurement.graph_us,
        measurement.copy_out_us,
    ];
    assert!(
        times.iter().chain([&measurement.write_us, &measurement.step_us]).all(|time| time.is_finite() && *time > 0.0)
    );
    assert!(
        measure_overlap(&device, &workload, &[], 5).is_err()
            && measure_overlap(&device, &workload, &states, 0).is_err()
    );
    for write in time_host_writes(&device, 20).expect("measured writes") {
        eprintln!("{write:?}");
    }
}
