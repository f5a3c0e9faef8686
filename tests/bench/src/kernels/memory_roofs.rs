//! Measures the best rates of device memory, and the transfer rates between host and device. The rate of a deformer is only
//! meaningful relative to the best rate of the same run.

use cudarc::driver::{CudaFunction, result};
use serde::Serialize;

use super::bandwidth::{CODE, filled, launch, tile, variants};
use super::kernel_benchmark::KernelBenchmark;
use super::timer::{EventPair, empty_replay, gigabytes_per_second, time};
use crate::timing::{CacheState, Timing};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::{DeviceBuffer, PinnedBuffer, PinnedUse};
use modalcast_model::error::{Error, Result, fault_in, invalid};

/// Largest buffer of `copy` and `read`, bytes.
const LARGEST: u64 = 4 << 30;

/// Bytes of a pinned copy, and the number of timed copies.
const PINNED: usize = 64 << 20;
const PINNED_COPIES: usize = 15;

const REPLAYS: usize = 20;

/// Measured memory rates of the device.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Roofs {
    /// Best copy kernel, GB/s (1e9 bytes), read plus written.
    pub copy_gbs: f64,
    /// Best pure read, GB/s.
    pub read_gbs: f64,
    /// A replay of a graph with one empty kernel, microseconds.
    pub empty_us: f64,
    /// Copies from pinned host memory to the device, 64 MiB each, GB/s.
    pub pinned_h2d_gbs: f64,
    pub pinned_d2h_gbs: f64,
}

/// Measures the rates of a device. `copy` and `read` process 4 GiB, or an eighth of the free memory if that is less.
///
/// # Errors
/// `Unavailable` when NVRTC is missing; `Fault` when the device fails or a copy did not copy.
pub fn roofs(device: &Device) -> Result<Roofs> {
    let (free, _) = device.memory()?;
    let unit = tile(16);
    let bytes = (LARGEST.min(free as u64 / 8) / unit).max(1) * unit;
    let from = filled(device, bytes)?;
    let to = DeviceBuffer::zeroed(device, bytes)?;
    let best = |function: &'static str, moved: u64| -> Result<f64> {
        let mut best = 0.0_f64;
        for (loads, defines) in variants() {
            let stream = CopyBenchmark::new(device, function, defines, [&from, &to], bytes / tile(loads))?;
            if function == "copy" {
                stream.check(device, &from, &to)?;
            }
            let timing = time(device, &stream, CacheState::Warm, REPLAYS)?;
            best = best.max(gigabytes_per_second(moved, timing.median_us));
        }
        Ok(best)
    };
    let (copy_gbs, read_gbs) = (best("copy", 2 * bytes)?, best("read", bytes)?);
    let empty_us = empty_replay(device, 200)?.median_us;
    let (pinned_h2d_gbs, pinned_d2h_gbs) = pinned(device)?;
    Ok(Roofs { copy_gbs, read_gbs, empty_us, pinned_h2d_gbs, pinned_d2h_gbs })
}

/// One variant of `copy` or `read`.
struct CopyBenchmark {
    function: CudaFunction,
    name: String,
    buffers: [u64; 2],
    blocks: u32,
}

impl CopyBenchmark {
    fn new(
        device: &Device,
        function: &str,
        defines: &[&str],
        buffers: [&DeviceBuffer; 2],
        blocks: u64,
    ) -> Result<Self> {
        Ok(Self {
            function: device.function(function, CODE.source, defines)?,
            name: format!("{function} {}", defines.join(" ")),
            buffers: buffers.map(|buffer| buffer.address()),
            blocks: blocks as u32,
        })
    }

    /// Copies once and compares both ends, because a copy that does nothing would be fast.
    fn check(&self, device: &Device, from: &DeviceBuffer, to: &DeviceBuffer) -> Result<()> {
        const END: usize = 4096;
        let (last, fail) = (to.bytes() - END as u64, fault_in("roof"));
        let ends = |buffer: &DeviceBuffer| -> Result<[Vec<u8>; 2]> {
            let end = |first: u64| {
                let mut bytes = vec![0_u8; END];
                buffer.read(device, first, &mut bytes).map(|()| bytes)
            };
            Ok([end(0)?, end(last)?])
        };
        for first in [0, last] {
            // SAFETY: the buffer has at least one tile, which is more than END bytes, from both ends.
            unsafe { result::memset_d8_async(to.address() + first, 0, END, device.stream().cu_stream()) }
                .map_err(&fail)?;
        }
        launch(device, &self.function, self.blocks, self.buffers)?;
        if ends(from)? == ends(to)? {
            return Ok(());
        }
        Err(Error::Fault { stage: "roof", reason: format!("{} did not copy", self.name) })
    }
}

impl KernelBenchmark for CopyBenchmark {
    fn name(&self) -> String {
        self.name.clone()
    }

    fn turns(&self) -> usize {
        1
    }

    fn launch(&self, device: &Device, _: usize) -> Result<()> {
        launch(device, &self.function, self.blocks, self.buffers)
    }

    fn launches(&self) -> usize {
        1
    }
}

/// Rates of pinned copies to and from the device, GB/s.
fn pinned(device: &Device) -> Result<(f64, f64)> {
    let fail = fault_in("pinned copy");
    let mut host = PinnedBuffer::<u8>::zeroed(device, PINNED, PinnedUse::FromDevice)?;
    let host = host.as_mut_slice()?;
    host.fill(0x5a);
    let buffer = DeviceBuffer::zeroed(device, PINNED as u64)?;
    let (there, stream) = (buffer.address(), device.stream().cu_stream());
    let mut rate = |copy: &mut dyn FnMut(&mut [u8]) -> Result<()>| -> Result<f64> {
        let mut times = Vec::with_capacity(PINNED_COPIES);
        // The first copy is a warm-up and does not count.
        for count in 0..=PINNED_COPIES {
            let span = EventPair::new(device)?;
            span.around(device, || copy(host))?;
            let us = span.microseconds()?;
            if count > 0 {
                times.push(us);
            }
        }
        let timing = Timing::of(times).ok_or_else(|| invalid("replays", "at least 1", 0))?;
        Ok(gigabytes_per_second(PINNED as u64, timing.median_us))
    };
    // SAFETY: both sides have the bytes of `host`. Reading the span waits for each copy, before the next one and before
    // either side is dropped.
    let to = rate(&mut |host| unsafe { result::memcpy_htod_async(there, host, stream) }.map_err(&fail))?;
    // SAFETY: as above.
    let from = rate(&mut |host| unsafe { result::memcpy_dtoh_async(host, there, stream) }.map_err(&fail))?;
    Ok((to, from))
}
