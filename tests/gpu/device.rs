//! The CUDA device: struct layouts equal those of the host, unknown ordinals are rejected, and memory is released.

use modalcast_compute::gpu::{
    CudaDeformer, CudaDeformerOptions, Device, device_layout_values, layout_constants, probe,
};
use modalcast_model::deform::Deformer;
use modalcast_model::error::Error;

use crate::scenes;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_host_and_device_agree_on_every_size_and_offset() {
    let device = Device::open(0).expect("expected a CUDA device");
    let values = device_layout_values(&device).expect("expected the layout report");
    for (constant, device_value) in layout_constants().iter().zip(&values) {
        assert_eq!(constant.host, *device_value, "{}", constant.expression);
    }
    assert_eq!(values.len(), layout_constants().len());
    assert!(values.iter().any(|value| *value > 0), "expected nonzero values");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_probe_names_the_opened_device() {
    let (probe, device) = (probe(), Device::open(0).expect("expected a CUDA device"));
    assert_eq!(probe.devices[0].name, device.name());
    assert_eq!(probe.devices[0].capability, format!("{}.{}", device.capability().0, device.capability().1));
    assert_eq!((probe.cuda_problem, probe.nvrtc_problem), (None, None));
    device.check_compiler().expect("expected an NVRTC version that the driver supports");
    assert!(probe.driver.is_some() && probe.cuda.is_some() && probe.nvrtc.is_some());
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_ordinal_beyond_the_last_device_is_rejected() {
    let error = Device::open(probe().devices.len()).expect_err("expected an unknown-device error");
    assert!(matches!(&error, Error::Unavailable { what: "CUDA device", .. }), "{error}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_dropped_deformers_release_their_memory() {
    let device = Device::open(0).expect("expected a CUDA device");
    let scene = scenes::random_scene(
        &[(20_000, 30)],
        scenes::RandomSceneOptions { instances: 2, normal_maps: true, rigid_transforms: false },
    );
    let state = scenes::random_state(&scene, 1);
    let deform_once = || {
        let mut deformer =
            CudaDeformer::new(&device, &scene, None, CudaDeformerOptions::with_bounding_axes(scene.light_axes()))
                .expect("expected a CUDA deformer");
        deformer.deform(&state).expect("expected the step to succeed");
        deformer.surface().expect("expected a surface");
        deformer.plan().total_bytes()
    };
    let bytes = deform_once();
    // If deformers leaked, a round would lose the memory of 200 deformers. The tolerance, the memory of eight
    // deformers, is for memory that the driver keeps. Other programs of the device may lower its free memory in some
    // rounds.
    let tolerance = 8 * bytes;
    let mut lost_bytes = Vec::new();
    let releases_memory = (0..5).any(|_| {
        let (free_before, _) = device.memory().expect("expected the free memory");
        for _ in 0..200 {
            deform_once();
        }
        let (free_after, _) = device.memory().expect("expected the free memory");
        let lost = free_before.saturating_sub(free_after) as u64;
        lost_bytes.push(lost);
        lost < tolerance
    });
    assert!(releases_memory, "expected a round that loses less than {tolerance} bytes, got losses of {lost_bytes:?}");
}
