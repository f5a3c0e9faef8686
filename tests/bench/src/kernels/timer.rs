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

/// Replays that are enqueued while a kernel delays the stream, so that the launch overhead of the host does not affect
/// the times. A replay adds up to four entries to the stream: an L2 flush, a graph and two events. A stream holds about
/// a thousand entries before it blocks the host.
const BATCH_REPLAYS: usize = 25;

/// Delay of the stream per replay of a batch, microseconds. The host enqueues a replay in less time.
const DELAY_US: u64 = 40;

/// Maximum number of graphs that the replays rotate through. Each graph has its own input set.
const MAX_GRAPHS: usize = 8;

/// Warm-up time before timing, so that the device reaches its clock rates.
const WARM_UP: Duration = Duration::from_millis(30);

/// Size of the buffer that evicts the L2 cache, in multiples of the size of the cache. Reading as many bytes as the
/// cache has might leave some of the old lines in it.
const L2_FLUSH_FACTOR: u64 = 4;

/// Times steps of a benchmark. Each input set has a CUDA graph. The graphs are replayed in rotation. An event before
/// and an event after each replay measure its time.
///
/// # Errors
/// `Invalid` when `replays` is 0; `Unavailable` when NVRTC is missing; `Fault` when the device fails or a launch cannot
/// be captured.
pub fn time_steps(
    device: &Device,
    benchmark: &dyn KernelBenchmark,
    cache: CacheState,
    replays: usize,
) -> Result<Timing> {
    if replays == 0 {
        return Err(invalid("replays", "at least 1", 0));
    }
    let delay = StreamDelay::new(device)?;
    let l2_flush = matches!(cache, CacheState::Cold).then(|| L2Flush::new(device)).transpose()?;
    // The first launch loads code and allocates workspaces. A capture allows neither, so this launch precedes the
    // captures.
    benchmark.launch(device, 0)?;
    let graph_count = benchmark.input_set_count().min(MAX_GRAPHS);
    let graphs =
        (0..graph_count).map(|input_set| capture_graph(device, benchmark, input_set)).collect::<Result<Vec<_>>>()?;
    let warm_up_start = Instant::now();
    while warm_up_start.elapsed() < WARM_UP {
        graphs.iter().try_for_each(|graph| graph.launch().map_err(fault_in("replay")))?;
        device.stream().synchronize().map_err(fault_in("replay"))?;
    }
    let mut times = Vec::with_capacity(replays);
    while times.len() < replays {
        let batch_replays = BATCH_REPLAYS.min(replays - times.len());
        let first_replay = times.len();
        let event_pairs: Vec<EventPair> = (0..batch_replays).map(|_| EventPair::new(device)).collect::<Result<_>>()?;
        delay.launch(device, DELAY_US * batch_replays as u64)?;
        for (index, event_pair) in event_pairs.iter().enumerate() {
            l2_flush.as_ref().map_or(Ok(()), |l2_flush| l2_flush.launch(device))?;
            event_pair.record_around(device, || {
                graphs[(first_replay + index) % graphs.len()].launch().map_err(fault_in("replay"))
            })?;
        }
        device.stream().synchronize().map_err(fault_in("replay"))?;
        for event_pair in &event_pairs {
            times.push(event_pair.microseconds()?);
        }
    }
    Timing::of(times).ok_or_else(|| invalid("replays", "at least 1", 0))
}

/// Times work that `work` submits to the device's stream by events, after some untimed runs.
///
/// # Errors
/// Errors of `work` and of the device.
pub fn time_stream(device: &Device, replays: usize, mut work: impl FnMut() -> Result<()>) -> Result<Timing> {
    let warm_up_start = Instant::now();
    while warm_up_start.elapsed() < WARM_UP {
        work()?;
        device.stream().synchronize().map_err(fault_in("replay"))?;
    }
    let mut times = Vec::with_capacity(replays);
    for _ in 0..replays {
        let event_pair = EventPair::new(device)?;
        event_pair.record_around(device, &mut work)?;
        device.stream().synchronize().map_err(fault_in("replay"))?;
        times.push(event_pair.microseconds()?);
    }
    Timing::of(times).ok_or_else(|| invalid("replays", "at least 1", 0))
}

/// Times a graph with one empty kernel: the lower limit of any step's time.
///
/// # Errors
/// Those of [`time_steps`].
pub fn time_empty_kernel(device: &Device, replays: usize) -> Result<Timing> {
    struct EmptyBenchmark(CudaFunction);
    impl KernelBenchmark for EmptyBenchmark {
        fn name(&self) -> String {
            "empty".into()
        }
        fn input_set_count(&self) -> usize {
            1
        }
        fn launch(&self, device: &Device, _: usize) -> Result<()> {
            let mut launch = device.stream().launch_builder(&self.0);
            // SAFETY: the kernel has no arguments and does nothing.
            unsafe { launch.launch(ONE_THREAD) }.map_err(fault_in("replay"))?;
            Ok(())
        }
        fn launches_per_step(&self) -> usize {
            1
        }
    }
    let benchmark = EmptyBenchmark(device.function("empty_kernel", bandwidth::SOURCE.text, &[])?);
    time_steps(device, &benchmark, CacheState::Warm, replays)
}

const ONE_THREAD: LaunchConfig = LaunchConfig { grid_dim: (1, 1, 1), block_dim: (1, 1, 1), shared_mem_bytes: 0 };

/// Captures one step as a graph and uploads the graph.
fn capture_graph(device: &Device, benchmark: &dyn KernelBenchmark, input_set: usize) -> Result<CudaGraph> {
    let graph = capture(device, || benchmark.launch(device, input_set))?;
    graph.upload().map_err(fault_in("capture"))?;
    Ok(graph)
}

/// Two events on the device's stream, recorded before and after some work.
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
    pub(super) fn record_around(&self, device: &Device, work: impl FnOnce() -> Result<()>) -> Result<()> {
        self.begin.record(device.stream()).map_err(fault_in("event"))?;
        work()?;
        self.end.record(device.stream()).map_err(fault_in("event"))
    }

    /// Waits until both events are complete and returns the time between them, microseconds.
    pub(super) fn microseconds(&self) -> Result<f64> {
        self.begin.elapsed_ms(&self.end).map(|ms| 1e3 * f64::from(ms)).map_err(fault_in("event"))
    }
}

/// A kernel that delays the stream for a given time.
struct StreamDelay(CudaFunction);

impl StreamDelay {
    fn new(device: &Device) -> Result<Self> {
        device.function("delay", bandwidth::SOURCE.text, &[]).map(Self)
    }

    fn launch(&self, device: &Device, delay_us: u64) -> Result<()> {
        let nanoseconds = 1000 * delay_us;
        let mut launch = device.stream().launch_builder(&self.0);
        // SAFETY: the kernel's only argument is a number of nanoseconds; it touches no memory.
        unsafe { launch.arg(&nanoseconds).launch(ONE_THREAD) }.map_err(fault_in("replay"))?;
        Ok(())
    }
}

/// Evicts the L2 cache by reading a buffer that no benchmark uses.
struct L2Flush {
    function: CudaFunction,
    buffer: DeviceBuffer,
    blocks: u32,
}

impl L2Flush {
    fn new(device: &Device) -> Result<Self> {
        let l2_size = device.context().attribute(CUdevice_attribute::CU_DEVICE_ATTRIBUTE_L2_CACHE_SIZE);
        let l2_bytes = u64::try_from(l2_size.map_err(fault_in("device"))?).unwrap_or(0);
        let tiles = (L2_FLUSH_FACTOR * l2_bytes).div_ceil(bandwidth::tile_bytes(bandwidth::L2_FLUSH_LOADS)).max(1);
        Ok(Self {
            function: device.function("read", bandwidth::SOURCE.text, bandwidth::L2_FLUSH_DEFINES)?,
            buffer: DeviceBuffer::zeroed(device, tiles * bandwidth::tile_bytes(bandwidth::L2_FLUSH_LOADS))?,
            blocks: tiles as u32,
        })
    }

    fn launch(&self, device: &Device) -> Result<()> {
        // `read` stores only if it reads all ones. The buffer holds zeros, so it can be both source and destination.
        let buffer = self.buffer.address();
        bandwidth::launch(device, &self.function, self.blocks, [buffer, buffer])
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
