//! Tests on a real device: a panic leaves the device usable, and every call on a lost device returns an error.

use std::panic::{AssertUnwindSafe, catch_unwind};

use cudarc::driver::{LaunchConfig, result};

use super::launch::{Device, DeviceBuffer, LaunchOrder, capture, launch_kernel};
use super::{CudaDeformer, CudaDeformerOptions};
use crate::testing::scene_and_state;
use modalcast_model::deform::{Deformer as _, VertexAttributes};
use modalcast_model::error::Error;

/// Environment variable of the child process that loses its device.
const LOSE_DEVICE: &str = "MODALCAST_TEST_LOSES_DEVICE";

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_steps_run_after_a_panic_during_capture() {
    let device = Device::open(0).expect("a CUDA device");
    // One domain of 300 vertices, 5 modes and 10 triangles.
    let (scene, state) = scene_and_state(&[(300, 5, 10)]);
    let mut deformer = CudaDeformer::new(&device, &scene, None, CudaDeformerOptions::default()).expect("a deformer");
    let before = deformer.deform(&state).expect("a step").bounds;
    let memory = DeviceBuffer::zeroed(&device, 64).expect("device memory");
    let submit = || {
        // SAFETY: the buffer has 64 bytes, and the copy is captured in a graph that never runs.
        unsafe { result::memset_d8_async(memory.address(), 1, 64, device.stream().cu_stream()) }
            .expect("captured work");
        panic!("injected");
    };
    assert!(catch_unwind(AssertUnwindSafe(|| capture(&device, submit))).is_err());
    assert_eq!(deformer.deform(&state).expect("a step after the capture").bounds, before);
    let mut bytes = [9_u8; 64];
    memory.read(&device, 0, &mut bytes).expect("a readback");
    assert_eq!(bytes, [0; 64], "expected captured work not to run");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_panics_restore_the_current_context() {
    let device = Device::open(0).expect("a CUDA device");
    // A new thread has no current context.
    std::thread::scope(|scope| {
        let check = || {
            assert_eq!(result::ctx::get_current().expect("the current context"), None);
            let panicking = || {
                let _current = device.enter().expect("a current context");
                assert_eq!(result::ctx::get_current().expect("the current context"), Some(device.context().cu_ctx()));
                panic!("injected");
            };
            assert!(catch_unwind(AssertUnwindSafe(panicking)).is_err());
            assert_eq!(result::ctx::get_current().expect("the current context"), None);
        };
        scope.spawn(check).join().expect("a thread without a failure");
    });
}

/// A lost device is lost for the whole process, so the test runs itself in a child process, which loses the device.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_lost_device_is_an_error_of_every_call_and_no_panic() {
    if std::env::var_os(LOSE_DEVICE).is_some() {
        lose_device();
        return;
    }
    let name = "gpu::device_tests::gpu_lost_device_is_an_error_of_every_call_and_no_panic";
    let mut child = std::process::Command::new(std::env::current_exe().expect("the path of this program"));
    let output =
        child.args([name, "--exact", "--include-ignored"]).env(LOSE_DEVICE, "1").output().expect("a child process");
    let text = [output.stdout, output.stderr].map(|text| String::from_utf8_lossy(&text).into_owned()).concat();
    assert!(output.status.success() && text.contains("1 passed"), "{text}");
}

/// Loses the device by a kernel that traps, and calls the objects on it.
fn lose_device() {
    fn is_lost<T>(result: modalcast_model::error::Result<T>) -> bool {
        result.is_err_and(|error| matches!(error, Error::DeviceLost { .. }))
    }
    let device = Device::open(0).expect("a CUDA device");
    let (scene, state) = scene_and_state(&[(300, 5, 10)]);
    let mut first_deformer =
        CudaDeformer::new(&device, &scene, None, CudaDeformerOptions::default()).expect("a deformer");
    let mut second_deformer =
        CudaDeformer::new(&device, &scene, None, CudaDeformerOptions::default()).expect("a deformer");
    first_deformer.deform(&state).expect("a step");
    second_deformer.deform(&state).expect("a step");
    let pending = second_deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS).expect("a pending readback");
    let source = "extern \"C\" __global__ void trap(unsigned long long) { asm(\"trap;\"); }";
    let function = device.function("trap", source, &[]).expect("a compiled kernel");
    let config = LaunchConfig { grid_dim: (1, 1, 1), block_dim: (1, 1, 1), shared_mem_bytes: 0 };
    // SAFETY: the kernel's only argument is a number, and it accesses no memory.
    unsafe { launch_kernel(&device, &function, config, LaunchOrder::Serial, &0_u64) }.expect("a launched kernel");
    assert!(is_lost(device.synchronize("test")), "expected the kernel to trap");
    assert!(is_lost(first_deformer.surface().map(|_| ())));
    assert!(is_lost(first_deformer.deform(&state)));
    assert!(is_lost(first_deformer.deform(&state)), "expected a second call to fail, too");
    assert!(is_lost(second_deformer.wait_readback(&pending)));
    assert!(is_lost(second_deformer.deform(&state)), "expected the other deformer to fail, too");
    assert!(is_lost(DeviceBuffer::upload(&device, &[1_u32])));
    assert!(is_lost(CudaDeformer::new(&device, &scene, None, CudaDeformerOptions::default()).map(|_| ())));
    drop((first_deformer, second_deformer, pending));
    assert!(is_lost(device.synchronize("test")), "expected a lost device after all objects were dropped");
}
