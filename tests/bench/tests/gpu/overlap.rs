//! Steps with readback of the vertices, serial and overlapped.

use modalcast_bench::kernels::{host_writes, overlap};
use modalcast_bench::workloads::Workload;
use modalcast_compute::gpu::Device;
use modalcast_model::scene::SceneState;

use crate::scenes;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_overlapped_steps_are_faster_with_identical_vertices() {
    let device = Device::open(0).expect("expected a CUDA device");
    let scene = scenes::random_scene(&[(200_000, 8), (7, 0), (40, 3)], 4, false, false);
    let states: Vec<SceneState> = (0..4).map(|seed| scenes::random_state(&scene, seed)).collect();
    let load = Workload::new("overlap".to_owned(), scene);
    let found = overlap(&device, &load, &states, 50).expect("measures");
    eprintln!("{found:#?}");
    assert_eq!(found.differing, 0);
    let times = [found.serial_us, found.fetched_us, found.overlapped_us, found.graph_us, found.copy_out_us];
    assert!(times.iter().chain([&found.write_us, &found.step_us]).all(|time| time.is_finite() && *time > 0.0));
    assert!(found.overlapped_us < found.serial_us, "what runs side by side takes less time");
    assert!(found.overlapped_us > 0.5 * found.ideal_us, "and no less than its longest part");
    assert!(overlap(&device, &load, &[], 5).is_err() && overlap(&device, &load, &states, 0).is_err());
    for write in host_writes(&device, 20).expect("writes") {
        eprintln!("{write:?}");
    }
}
