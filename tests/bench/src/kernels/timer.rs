//! Times a step's kernels on the device: replays of CUDA graphs, each between two events.

use std::time::{Duration, Instant};

use cudarc::driver::sys::{CUdevice_attribute, CUevent_flags};
use cudarc::driver::{CudaEvent, CudaFunction, CudaGraph, LaunchConfig, PushKernelArg as _};

use super::bandwidth;
use super::kernel_benchmark::KernelBenchmark;
use crate::timing::{CacheState, Timing};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::{DeviceBuffer, capture};
use modalcast_model::error::{Result, fault_in, invalid};

/// Replays that are enqueued together, behind a kernel that blocks the stream meanwhile, so that the host's launch
/// overhead does not affect the times. The stream takes about a thousand entries before it blocks the host.
const BATCH: usize = 25;

/// Microseconds for which the stream is blocked per replay of a batch: longer than the host needs for its calls.
const HOLD_US: u64 = 40;

/// Upper limit of turns to rotate through: enough that no replay finds the q of the previous one in a cache.
pub(super) const MAX_GRAPHS: usize = 8;

/// Warm-up time before timing, so that the device reaches its clock rates.
const WARM_UP: Duration = Duration::from_millis(30);

/// Size of the buffer that the cold sweep reads, in multiples of the L2 size.
const SWEEPS: u64 = 4;

/// Times a trial's step: one CUDA graph per turn, replayed in rotation, each replay between two events.
///
/// # Errors
/// `Invalid` when `replays` is 0; `Unavailable` when NVRTC is missing; `Fault` when the device fails or a launch cannot
/// be captured.
pub fn time(
    device: &Device,
    kernel_benchmark: &dyn KernelBenchmark,
    cache: CacheState,
    replays: usize,
) -> Result<Timing> {
    if replays == 0 {
        return Err(invalid("replays", "at least 1", 0));
    }
    let hold = StreamDelay::new(device)?;
    let sweep = matches!(cache, CacheState::Cold).then(|| L2Flush::new(device)).transpose()?;
    // The first launch is outside of a graph: it loads code and allocates workspaces, neither of which a capture
    // allows.
    kernel_benchmark.launch(device, 0)?;
    let turns = kernel_benchmark.turns().min(MAX_GRAPHS);
    let graphs = (0..turns).map(|turn| capture_turn(device, kernel_benchmark, turn)).collect::<Result<Vec<_>>>()?;
    let begin = Instant::now();
    while begin.elapsed() < WARM_UP {
        graphs.iter().try_for_each(|graph| graph.launch().map_err(fault_in("replay")))?;
        device.stream().synchronize().map_err(fault_in("replay"))?;
    }
    let mut times = Vec::with_capacity(replays);
    while times.len() < replays {
        let batch = BATCH.min(replays - times.len());
        let first = times.len();
        let spans: Vec<EventPair> = (0..batch).map(|_| EventPair::new(device)).collect::<Result<_>>()?;
        hold.launch(device, HOLD_US * batch as u64)?;
        for (index, span) in spans.iter().enumerate() {
            sweep.as_ref().map_or(Ok(()), |sweep| sweep.launch(device))?;
            span.around(device, || graphs[(first + index) % graphs.len()].launch().map_err(fault_in("replay")))?;
        }
        device.stream().synchronize().map_err(fault_in("replay"))?;
        for span in &spans {
            times.push(span.microseconds()?);
        }
    }
    Timing::of(times).ok_or_else(|| invalid("replays", "at least 1", 0))
}

/// Times a graph with one empty kernel: the lower limit of any step's time.
pub fn empty_replay(device: &Device, replays: usize) -> Result<Timing> {
    struct Nothing(CudaFunction);
    impl KernelBenchmark for Nothing {
        fn name(&self) -> String {
            "empty".into()
        }
        fn turns(&self) -> usize {
            1
        }
        fn launch(&self, device: &Device, _: usize) -> Result<()> {
            let mut launch = device.stream().launch_builder(&self.0);
            // SAFETY: the kernel has no arguments and does nothing.
            unsafe { launch.launch(SINGLE) }.map_err(fault_in("replay"))?;
            Ok(())
        }
        fn launches(&self) -> usize {
            1
        }
    }
    let nothing = Nothing(device.function("nothing", bandwidth::CODE.source, &[])?);
    time(device, &nothing, CacheState::Warm, replays)
}

const SINGLE: LaunchConfig = LaunchConfig { grid_dim: (1, 1, 1), block_dim: (1, 1, 1), shared_mem_bytes: 0 };

/// Captures one step as a graph and uploads it.
fn capture_turn(device: &Device, kernel_benchmark: &dyn KernelBenchmark, turn: usize) -> Result<CudaGraph> {
    let graph = capture(device, || kernel_benchmark.launch(device, turn))?;
    graph.upload().map_err(fault_in("capture"))?;
    Ok(graph)
}

/// Two events on the device's stream that enclose some work.
pub(super) struct EventPair {
    begin: CudaEvent,
    end: CudaEvent,
}

impl EventPair {
    pub(super) fn new(device: &Device) -> Result<Self> {
        let event = || device.context().new_event(Some(CUevent_flags::CU_EVENT_DEFAULT)).map_err(fault_in("event"));
        Ok(Self { begin: event()?, end: event()? })
    }

    /// Records the events before and after the work that `work` enqueues.
    pub(super) fn around(&self, device: &Device, work: impl FnOnce() -> Result<()>) -> Result<()> {
        self.begin.record(device.stream()).map_err(fault_in("event"))?;
        work()?;
        self.end.record(device.stream()).map_err(fault_in("event"))
    }

    /// Time between the two events, microseconds. Waits until both are complete.
    pub(super) fn microseconds(&self) -> Result<f64> {
        self.begin.elapsed_ms(&self.end).map(|ms| 1e3 * f64::from(ms)).map_err(fault_in("event"))
    }
}

/// Blocks the stream for a given time.
struct StreamDelay(CudaFunction);

impl StreamDelay {
    fn new(device: &Device) -> Result<Self> {
        device.function("hold", bandwidth::CODE.source, &[]).map(Self)
    }

    fn launch(&self, device: &Device, us: u64) -> Result<()> {
        let nanoseconds = 1000 * us;
        let mut launch = device.stream().launch_builder(&self.0);
        // SAFETY: the kernel's only argument is a number of nanoseconds; it touches no memory.
        unsafe { launch.arg(&nanoseconds).launch(SINGLE) }.map_err(fault_in("replay"))?;
        Ok(())
    }
}

/// Evicts the L2 by reading a buffer that nothing else uses.
struct L2Flush {
    function: CudaFunction,
    buffer: DeviceBuffer,
    blocks: u32,
}

impl L2Flush {
    fn new(device: &Device) -> Result<Self> {
        let l2 = device.context().attribute(CUdevice_attribute::CU_DEVICE_ATTRIBUTE_L2_CACHE_SIZE);
        let l2 = u64::try_from(l2.map_err(fault_in("device"))?).unwrap_or(0);
        let tiles = (SWEEPS * l2).div_ceil(bandwidth::tile(bandwidth::SWEEP_LOADS)).max(1);
        Ok(Self {
            function: device.function("read", bandwidth::CODE.source, bandwidth::SWEEP)?,
            buffer: DeviceBuffer::zeroed(device, tiles * bandwidth::tile(bandwidth::SWEEP_LOADS))?,
            blocks: tiles as u32,
        })
    }

    fn launch(&self, device: &Device) -> Result<()> {
        // The kernel writes only if all bits that it read are ones. The buffer holds zeros, so input and output may be
        // the same.
        let from = self.buffer.address();
        bandwidth::launch(device, &self.function, self.blocks, [from, from])
    }
}

/// Rate of `bytes` in `us` microseconds, GB/s (1e9 bytes).
pub fn gigabytes_per_second(bytes: u64, us: f64) -> f64 {
    bytes as f64 / (1e3 * us)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rate_is_bytes_per_time() {
        assert_eq!(gigabytes_per_second(4_000_000_000, 1e6), 4.0);
        assert_eq!(gigabytes_per_second(4_000, 1.0), 4.0);
    }
}
