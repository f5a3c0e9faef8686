//! The device: struct layouts agree with the host, missing devices are refused, and memory is released.

use modalcast_compute::gpu::{CudaDeformer, Device, device_layout_values, layout_constants, probe};
use modalcast_model::deform::Deformer;
use modalcast_model::error::Error;

use crate::scenes;

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_host_and_device_agree_on_every_size_and_offset() {
    let device = Device::open(0).expect("a CUDA device");
    let values = device_layout_values(&device).expect("reports");
    for (agreement, device) in layout_constants().iter().zip(&values) {
        assert_eq!(agreement.host, *device, "{}", agreement.expression);
    }
    assert_eq!(values.len(), layout_constants().len());
    assert!(values.iter().any(|value| *value > 0), "the report was written");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_probe_names_the_opened_device() {
    let (probe, device) = (probe(), Device::open(0).expect("a CUDA device"));
    assert_eq!(probe.devices[0].name, device.name());
    assert_eq!(probe.devices[0].capability, format!("{}.{}", device.capability().0, device.capability().1));
    assert_eq!((probe.cuda_problem, probe.nvrtc_problem), (None, None));
    device.check_compiler().expect("NVRTC fits the driver");
    assert!(probe.driver.is_some() && probe.cuda.is_some() && probe.nvrtc.is_some());
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_ordinal_beyond_the_last_device_is_refused() {
    let refusal = Device::open(probe().devices.len()).expect_err("beyond the last");
    assert!(matches!(&refusal, Error::Unavailable { what: "CUDA device", .. }), "{refusal}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_dropped_deformers_release_their_memory() {
    let device = Device::open(0).expect("a CUDA device");
    let scene = scenes::scene(&[(20_000, 30)], 2, true, false);
    let state = scenes::state(&scene, 1);
    let once = || {
        let mut deformer = CudaDeformer::new(&device, &scene, None).expect("a deformer");
        deformer.deform(&state).expect("deforms");
        deformer.surface().expect("copies");
        deformer.plan().total_bytes()
    };
    let bytes = once();
    let (before, _) = device.memory().expect("memory");
    for _ in 0..200 {
        once();
    }
    let (after, _) = device.memory().expect("memory");
    assert!((before as u64) < after as u64 + 8 * bytes, "{before} bytes free before, {after} after 200 scenes");
}
