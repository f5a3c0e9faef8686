//! Measures the peak bandwidths of device memory and of transfers between host and device. Reports compare the
//! bandwidth of a deformer with the peak of the same run.

use cudarc::driver::{CudaFunction, result};
use serde::Serialize;

use super::bandwidth::{SOURCE, launch, random_buffer, tile_bytes, variants};
use super::kernel_benchmark::KernelBenchmark;
use super::timer::{EventPair, gigabytes_per_second, time_empty_kernel, time_steps};
use crate::timing::{CacheState, Timing};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::{DeviceBuffer, PinnedBuffer, PinnedUse};
use modalcast_model::error::{Error, Result, fault_in, invalid};

/// Maximum size of the buffers of `copy` and `read`, bytes: many times the size of any L2 cache.
const MAX_BUFFER: u64 = 4 << 30;

/// Bytes of a copy between pinned host memory and the device.
const PINNED_BYTES: usize = 64 << 20;
/// Number of timed pinned copies.
const PINNED_COPIES: usize = 15;

/// Timed replays of each variant of `copy` and `read`.
const REPLAYS: usize = 20;
/// Timed replays of the empty kernel.
const EMPTY_REPLAYS: usize = 200;

/// Measured peak bandwidths of the device.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct DeviceBandwidth {
    /// Fastest copy kernel, GB/s (1e9 bytes), read plus written.
    pub copy_gbs: f64,
    /// Fastest pure read, GB/s.
    pub read_gbs: f64,
    /// Median time of a replay of a graph with one empty kernel, microseconds.
    pub empty_us: f64,
    /// Copies from pinned host memory to the device, 64 MiB each, GB/s.
    pub pinned_h2d_gbs: f64,
    /// Copies from the device to pinned host memory, 64 MiB each, GB/s.
    pub pinned_d2h_gbs: f64,
}

/// Measures the bandwidths of a device. `copy` and `read` process 4 GiB, or an eighth of the free memory if that is
/// less.
///
/// # Errors
/// `Unavailable` when NVRTC is missing; `Fault` when the device fails or `copy` does not copy.
pub fn measure_bandwidth(device: &Device) -> Result<DeviceBandwidth> {
    let (free, _) = device.memory()?;
    // A block processes one tile, of a size proportional to the variant's loads per thread: 1, 2, 4, 8 or 16. A buffer
    // of whole tiles of 16 loads therefore has whole tiles of every variant.
    let max_tile_bytes = tile_bytes(16);
    let bytes = (MAX_BUFFER.min(free as u64 / 8) / max_tile_bytes).max(1) * max_tile_bytes;
    let src = random_buffer(device, bytes)?;
    let dst = DeviceBuffer::zeroed(device, bytes)?;
    let max_bandwidth = |function: &'static str, traffic: u64| -> Result<f64> {
        let mut max_gbs = 0.0_f64;
        for (loads, defines) in variants() {
            let benchmark =
                BandwidthBenchmark::new(device, function, defines, [&src, &dst], bytes / tile_bytes(loads))?;
            if function == "copy" {
                benchmark.check_copy(device, &src, &dst)?;
            }
            let timing = time_steps(device, &benchmark, CacheState::Warm, REPLAYS)?;
            max_gbs = max_gbs.max(gigabytes_per_second(traffic, timing.median_us));
        }
        Ok(max_gbs)
    };
    let (copy_gbs, read_gbs) = (max_bandwidth("copy", 2 * bytes)?, max_bandwidth("read", bytes)?);
    let empty_us = time_empty_kernel(device, EMPTY_REPLAYS)?.median_us;
    let (pinned_h2d_gbs, pinned_d2h_gbs) = pinned_bandwidths(device)?;
    Ok(DeviceBandwidth { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs })
}

/// One variant of `copy` or `read`.
struct BandwidthBenchmark {
    function: CudaFunction,
    name: String,
    /// Device addresses of the source and the destination.
    buffers: [u64; 2],
    blocks: u32,
}

impl BandwidthBenchmark {
    fn new(
        device: &Device,
        function: &str,
        defines: &[&str],
        buffers: [&DeviceBuffer; 2],
        blocks: u64,
    ) -> Result<Self> {
        Ok(Self {
            function: device.function(function, SOURCE.text, defines)?,
            name: format!("{function} {}", defines.join(" ")),
            buffers: buffers.map(|buffer| buffer.address()),
            blocks: blocks as u32,
        })
    }

    /// Runs `copy` once and compares the first and last bytes, because a kernel that copies nothing would look fast.
    fn check_copy(&self, device: &Device, src: &DeviceBuffer, dst: &DeviceBuffer) -> Result<()> {
        const CHECKED_BYTES: usize = 4096;
        let last_offset = dst.bytes() - CHECKED_BYTES as u64;
        let read_ends = |buffer: &DeviceBuffer| -> Result<[Vec<u8>; 2]> {
            let read_at = |offset: u64| {
                let mut bytes = vec![0_u8; CHECKED_BYTES];
                buffer.read(device, offset, &mut bytes).map(|()| bytes)
            };
            Ok([read_at(0)?, read_at(last_offset)?])
        };
        for offset in [0, last_offset] {
            // SAFETY: the buffer has at least one tile, which is more than `CHECKED_BYTES`, so both ranges are inside.
            unsafe { result::memset_d8_async(dst.address() + offset, 0, CHECKED_BYTES, device.stream().cu_stream()) }
                .map_err(fault_in("bandwidth"))?;
        }
        launch(device, &self.function, self.blocks, self.buffers)?;
        if read_ends(src)? == read_ends(dst)? {
            return Ok(());
        }
        Err(Error::Fault { stage: "bandwidth", reason: format!("{}: expected a copy, got other bytes", self.name) })
    }
}

impl KernelBenchmark for BandwidthBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn input_set_count(&self) -> usize {
        1
    }

    fn launch(&self, device: &Device, _: usize) -> Result<()> {
        launch(device, &self.function, self.blocks, self.buffers)
    }

    fn launches_per_step(&self) -> usize {
        1
    }
}

/// Bandwidths of pinned copies to and from the device, GB/s.
fn pinned_bandwidths(device: &Device) -> Result<(f64, f64)> {
    let to_fault = fault_in("pinned copy");
    let mut host = PinnedBuffer::<u8>::zeroed(device, PINNED_BYTES, PinnedUse::FromDevice)?;
    let host = host.as_mut_slice()?;
    // Not zeros, because copies of zeros may be faster.
    host.fill(0x5a);
    let buffer = DeviceBuffer::zeroed(device, PINNED_BYTES as u64)?;
    let (device_address, stream) = (buffer.address(), device.stream().cu_stream());
    let mut measure_gbs = |copy: &mut dyn FnMut(&mut [u8]) -> Result<()>| -> Result<f64> {
        let mut times = Vec::with_capacity(PINNED_COPIES);
        // The first copy is a warm-up and is not timed.
        for repetition in 0..=PINNED_COPIES {
            let event_pair = EventPair::new(device)?;
            event_pair.record_around(device, || copy(host))?;
            let us = event_pair.microseconds()?;
            if repetition > 0 {
                times.push(us);
            }
        }
        let timing = Timing::of(times).ok_or_else(|| invalid("replays", "at least 1", 0))?;
        Ok(gigabytes_per_second(PINNED_BYTES as u64, timing.median_us))
    };
    // SAFETY: `buffer` and `host` have equal sizes. `microseconds` waits for each copy, so the copy ends before the
    // next one starts and before either buffer is dropped.
    let to_device =
        measure_gbs(&mut |host| unsafe { result::memcpy_htod_async(device_address, host, stream) }.map_err(&to_fault))?;
    // SAFETY: as above.
    let from_device =
        measure_gbs(&mut |host| unsafe { result::memcpy_dtoh_async(host, device_address, stream) }.map_err(&to_fault))?;
    Ok((to_device, from_device))
}
