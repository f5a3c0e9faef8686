//! Measures steps whose vertices are read back to the host, serial and overlapped as in figure 3.1 of the thesis.
//!
//! Brackets are work of the device.
//!
//! ```text
//! serial:      write step k, [copy in][kernels], [copy out], write step k+1, ...
//! overlapped:  while the device computes step k+1, the host writes step k+2, and step k is copied out
//! ```

use std::collections::VecDeque;
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::timer::EventPair;
use crate::timing::{Timing, quantile};
use crate::workloads::Workload;
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::{PinnedBuffer, PinnedUse};
use modalcast_compute::gpu::step_input::{InputPacker, PARALLEL_THRESHOLD, StepHeader, StepInputs, parallel_copy};
use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, MAX_STEPS_IN_FLIGHT};
use modalcast_model::deform::{DeformedSurface, Deformer as _, VertexAttributes};
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// Rounds per method. A round runs all steps. The methods alternate, and the median of the rounds is reported.
const ROUNDS: usize = 5;

/// Times of one step and of its parts, microseconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Overlap {
    /// Steps per round.
    pub steps: usize,
    /// Threads that write the inputs.
    pub cores: usize,
    /// Bytes of a step's inputs.
    pub bytes_in: u64,
    /// Bytes of positions and normals.
    pub bytes_out: u64,
    /// Host write of a step's inputs to pinned memory on one core.
    pub write_one_core_us: f64,
    /// Host write as the deformer does it: on several cores for large steps.
    pub write_us: f64,
    /// Device graph: upload, kernels, and readback of the bounds.
    pub graph_us: f64,
    /// Readback of the vertices.
    pub copy_out_us: f64,
    /// A complete step without readback of the vertices.
    pub step_us: f64,
    /// Time per step if every step is read back before the next step is written (`run_serial`).
    pub serial_us: f64,
    /// Time per step if the host starts the next step before it waits for a readback, as the server does
    /// (`run_pipelined`).
    #[serde(rename = "fetched_us")]
    pub pipelined_us: f64,
    /// Time per step with two steps in flight, so that the host also writes inputs while the device computes
    /// (`run_overlapped`).
    pub overlapped_us: f64,
    /// `serial_us` divided by `overlapped_us`.
    pub gain: f64,
    /// Lower limit of an overlapped step: the longest of host write, graph and readback.
    pub ideal_us: f64,
    /// Number of steps of `run_pipelined` and `run_overlapped` that are missing, or whose positions or normals differ
    /// in any bit from `run_serial`; must be 0.
    pub differing: usize,
}

/// Measures `steps` steps of a workload per method and round. Steps rotate through `states`.
///
/// # Errors
/// `Invalid` without states or steps; errors of creating a deformer; `Fault` when the device fails.
pub fn measure_overlap(
    device: &Arc<Device>,
    workload: &Workload,
    states: &[SceneState],
    steps: usize,
) -> Result<Overlap> {
    if states.is_empty() || steps == 0 {
        return Err(invalid("states and steps", "at least 1", format!("{} and {steps}", states.len())));
    }
    let scene = &workload.scene;
    let options = CudaDeformerOptions { batches: workload.batches, bounding_axes: scene.light_axes() };
    let mut deformer = CudaDeformer::new(device, scene, None, options)?;
    let differing = count_differing_steps(&mut deformer, states, steps)?;
    let mut times = [Vec::new(), Vec::new(), Vec::new()];
    for _ in 0..ROUNDS {
        for (run_steps, times) in [run_serial, run_pipelined, run_overlapped].iter().zip(&mut times) {
            let begin = Instant::now();
            run_steps(&mut deformer, states, steps, &mut |_, surface| {
                black_box(surface.positions.first());
            })?;
            times.push(elapsed_us(begin) / steps as f64);
        }
    }
    let [serial_us, pipelined_us, overlapped_us] = times.map(median);
    let [step_us, copy_out_us] = time_step_and_readback(&mut deformer, states, steps)?;
    let (bytes_in, [write_one_core_us, write_us]) = time_input_writes(device, scene, states, steps)?;
    let graph_us = time_graph(device, &deformer, steps)?;
    let readback = deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS)?;
    let surface = deformer.wait_readback(&readback)?;
    Ok(Overlap {
        steps,
        cores: rayon::current_num_threads(),
        bytes_in,
        bytes_out: (size_of_val(surface.positions.as_slice()) + size_of_val(surface.normals.as_slice())) as u64,
        write_one_core_us,
        write_us,
        graph_us,
        copy_out_us,
        step_us,
        serial_us,
        pipelined_us,
        overlapped_us,
        gain: serial_us / overlapped_us,
        ideal_us: write_us.max(graph_us).max(copy_out_us),
        differing,
    })
}

/// Receives the index and the surface of every step.
type SurfaceCallback<'a> = &'a mut dyn FnMut(usize, &DeformedSurface);

/// Reads every step back before the next one starts.
fn run_serial(
    deformer: &mut CudaDeformer,
    states: &[SceneState],
    steps: usize,
    on_surface: SurfaceCallback<'_>,
) -> Result<()> {
    for step in 0..steps {
        deformer.deform(&states[step % states.len()])?;
        let readback = deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS)?;
        on_surface(step, &*deformer.wait_readback(&readback)?);
    }
    Ok(())
}

/// Starts every step before it waits for the readback of the previous one.
fn run_pipelined(
    deformer: &mut CudaDeformer,
    states: &[SceneState],
    steps: usize,
    on_surface: SurfaceCallback<'_>,
) -> Result<()> {
    let mut previous = None;
    for step in 0..=steps {
        let current = match step < steps {
            true => {
                deformer.deform(&states[step % states.len()])?;
                Some(deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS)?)
            }
            false => None,
        };
        if let Some(readback) = std::mem::replace(&mut previous, current) {
            on_surface(step - 1, &*deformer.wait_readback(&readback)?);
        }
    }
    Ok(())
}

/// Keeps [`MAX_STEPS_IN_FLIGHT`] steps in flight. An iteration finishes the oldest step, submits a step, and waits for
/// the readback of the finished step. The first [`MAX_STEPS_IN_FLIGHT`] iterations only submit steps, and as many at
/// the end only finish them.
fn run_overlapped(
    deformer: &mut CudaDeformer,
    states: &[SceneState],
    steps: usize,
    on_surface: SurfaceCallback<'_>,
) -> Result<()> {
    let mut readbacks = VecDeque::new();
    for step in 0..steps + MAX_STEPS_IN_FLIGHT {
        let finished_step = step.checked_sub(MAX_STEPS_IN_FLIGHT);
        if finished_step.is_some_and(|finished_step| finished_step < steps) {
            deformer.finish()?;
        }
        if step < steps {
            deformer.submit(&states[step % states.len()])?;
            readbacks.push_back(deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS)?);
        }
        // With more readbacks than steps in flight, the oldest readback belongs to the step that `finish` completed.
        let is_oldest_finished = readbacks.len() > MAX_STEPS_IN_FLIGHT || step >= steps;
        if let Some(finished_step) = finished_step
            && is_oldest_finished
            && let Some(readback) = readbacks.pop_front()
        {
            on_surface(finished_step, &*deformer.wait_readback(&readback)?);
        }
    }
    Ok(())
}

/// Computes [`Overlap::differing`].
fn count_differing_steps(deformer: &mut CudaDeformer, states: &[SceneState], steps: usize) -> Result<usize> {
    let mut want = Vec::new();
    run_serial(deformer, states, states.len(), &mut |_, surface| want.push(surface.clone()))?;
    let mut differing = 0;
    for run_steps in [run_pipelined, run_overlapped] {
        let mut received = 0;
        run_steps(deformer, states, steps, &mut |step, surface| {
            received += 1;
            differing += usize::from(!have_equal_bits(surface, &want[step % states.len()]));
        })?;
        differing += steps.abs_diff(received);
    }
    Ok(differing)
}

fn have_equal_bits(one: &DeformedSurface, other: &DeformedSurface) -> bool {
    let are_equal =
        |one: &[f32], other: &[f32]| bytemuck::cast_slice::<f32, u32>(one) == bytemuck::cast_slice::<f32, u32>(other);
    are_equal(&one.positions, &other.positions) && are_equal(&one.normals, &other.normals)
}

/// Median times of a step without readback, and of the readback alone, microseconds.
fn time_step_and_readback(deformer: &mut CudaDeformer, states: &[SceneState], steps: usize) -> Result<[f64; 2]> {
    let [mut step_times, mut readback_times] = [Vec::new(), Vec::new()];
    for step in 0..steps {
        let begin = Instant::now();
        deformer.deform(&states[step % states.len()])?;
        step_times.push(elapsed_us(begin));
        let begin = Instant::now();
        let readback = deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS)?;
        deformer.wait_readback(&readback)?;
        readback_times.push(elapsed_us(begin));
    }
    Ok([step_times, readback_times].map(median))
}

/// Bytes of a step's inputs, and the median times in microseconds of writing them on one core and as the deformer does.
fn time_input_writes(
    device: &Device,
    scene: &Arc<Scene>,
    states: &[SceneState],
    steps: usize,
) -> Result<(u64, [f64; 2])> {
    let packer = Arc::new(InputPacker::sizes_only(scene));
    let mut staging = StepInputs::new(device, &packer)?.allocate_staging(device)?;
    let words = staging.as_mut_slice()?;
    let bytes = size_of_val(words) as u64;
    let mut measure = move || {
        let mut time_write = |step: usize| {
            let begin = Instant::now();
            packer.write(words, &StepHeader::default(), &states[step % states.len()]);
            elapsed_us(begin)
        };
        // An untimed warm-up.
        time_write(0);
        median((0..steps).map(&mut time_write).collect())
    };
    let single_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().map_err(fault_in("write"))?;
    Ok((bytes, [single_thread.install(&mut measure), measure()]))
}

/// Median time in microseconds of the deformer's last graph, replayed `steps` times.
fn time_graph(device: &Device, deformer: &CudaDeformer, steps: usize) -> Result<f64> {
    let mut times = Vec::with_capacity(steps);
    for _ in 0..steps {
        let event_pair = EventPair::new(device)?;
        event_pair.record_around(device, || deformer.replay())?;
        times.push(event_pair.microseconds()?);
    }
    Ok(median(times))
}

fn elapsed_us(begin: Instant) -> f64 {
    begin.elapsed().as_secs_f64() * 1e6
}

fn median(mut times: Vec<f64>) -> f64 {
    quantile(&mut times, 0.5).unwrap_or(f64::NAN)
}

/// Median times in microseconds of copying `bytes` to pinned, write-combined memory.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HostWrite {
    pub bytes: u64,
    pub one_core_us: f64,
    pub all_cores_us: f64,
    /// Whether the deformer writes steps of this size on all cores.
    pub on_all_cores: bool,
}

/// Times host writes of 64 KiB to 64 MiB, in powers of two, on one core and on all cores. The times show the smallest
/// size for which all cores are faster than one core.
///
/// # Errors
/// `Invalid` when `replays` is 0; `Fault` when the driver cannot allocate memory.
pub fn time_host_writes(device: &Device, replays: usize) -> Result<Vec<HostWrite>> {
    const MAX_BYTES: usize = 64 << 20;
    let mut staging = PinnedBuffer::<f32>::zeroed(device, MAX_BYTES / 4, PinnedUse::ToDevice)?;
    let dst = staging.as_mut_slice()?;
    let src = vec![1.0_f32; MAX_BYTES / 4];
    let mut measure = |bytes: usize| {
        let (dst, src) = (&mut dst[..bytes / 4], &src[..bytes / 4]);
        let mut time_copy = |copy: &dyn Fn(&mut [f32], &[f32])| {
            let time_once = |_| {
                let begin = Instant::now();
                copy(dst, src);
                elapsed_us(begin)
            };
            let timing = Timing::of((0..replays).map(time_once).collect());
            timing.map(|timing| timing.median_us).ok_or_else(|| invalid("replays", "at least 1", 0))
        };
        Ok(HostWrite {
            bytes: bytes as u64,
            one_core_us: time_copy(&|dst, src| dst.copy_from_slice(src))?,
            all_cores_us: time_copy(&parallel_copy)?,
            on_all_cores: bytes >= PARALLEL_THRESHOLD,
        })
    };
    (16..=26).map(|power| measure(1 << power)).collect()
}
