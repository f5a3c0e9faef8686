//! What is measured beside the deformer: the roofs of the device, and the trials, each judged by the f64 twin.

use modalcast::gpu::{Device, empty_replay, roofs};

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_the_roofs_are_of_one_size_and_an_empty_replay_takes_time() {
    let device = Device::open(0).expect("a CUDA device");
    let roofs = roofs(&device).expect("roofs");
    eprintln!("{}: {roofs:?}", device.name());
    assert!(roofs.copy_gbs > 20.0 && roofs.pinned_h2d_gbs > 1.0 && roofs.pinned_d2h_gbs > 1.0, "{roofs:?}");
    assert!((0.8..1.6).contains(&(roofs.read_gbs / roofs.copy_gbs)), "reading is about as fast as copying: {roofs:?}");
    assert!(roofs.pinned_h2d_gbs < roofs.copy_gbs, "{roofs:?}");
    let empty = empty_replay(&device, 100).expect("replays");
    assert!(empty.replays == 100 && empty.q1_us <= empty.median_us && empty.median_us <= empty.q3_us, "{empty:?}");
    assert!((0.1..100.0).contains(&empty.median_us), "{empty:?}");
    assert!(empty_replay(&device, 0).is_err());
}
