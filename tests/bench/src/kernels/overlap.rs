//! Measures figure 3.1 of the thesis: steps with readback of the vertices, serial and overlapped.
//!
//! ```text
//! serial:      write k, [copy in][kernels], [copy out], write k+1, ...
//! overlapped:  while the device computes k+1, the host writes k+2 and k is copied out
//! ```

use std::collections::VecDeque;
use std::hint::black_box;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::timer::EventPair;
use crate::timing::{Timing, quantile};
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::{PinnedBuffer, PinnedUse};
use modalcast_compute::gpu::step_input::{
    Header, InputPacker, InputWriter, PARALLEL_THRESHOLD, StepInputs, parallel_copy,
};
use modalcast_compute::gpu::{CudaDeformer, MAX_STEPS_IN_FLIGHT};
use modalcast_model::deform::{DeformedSurface, Deformer as _, VertexAttributes};
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// Rounds over all steps per method. The methods alternate; the median over the rounds is reported.
const ROUNDS: usize = 5;

/// Times of one step and of its parts, microseconds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Overlap {
    /// Steps per round.
    pub steps: usize,
    /// Threads that write the inputs.
    pub cores: usize,
    pub bytes_in: u64,
    /// Bytes of positions and normals.
    pub bytes_out: u64,
    /// Host write of a step's values to pinned memory on one core.
    pub write_one_core_us: f64,
    /// The same write as the deformer does it, on several cores where that is faster.
    pub write_us: f64,
    /// Device graph: upload, kernels, and readback of the bounds.
    pub graph_us: f64,
    /// Readback of the vertices.
    pub copy_out_us: f64,
    /// A whole step without readback of the vertices.
    pub step_us: f64,
    /// Every step is read back before the next is written.
    pub serial_us: f64,
    /// The readback of every step is started at once and awaited after the next step, as the server does.
    pub fetched_us: f64,
    /// Two steps are in flight, so that the host also writes while the device works.
    pub overlapped_us: f64,
    /// `serial_us` divided by `overlapped_us`.
    pub gain: f64,
    /// Lower limit of an overlapped step: the longest of host write, graph and readback.
    pub ideal_us: f64,
    /// Steps of the fetched and overlapped methods whose vertices differ from the serial ones in any bit; must be 0.
    pub differing: usize,
}

/// Measures a scene over rotating states.
///
/// # Errors
/// `Invalid` without states or steps; errors of creating a deformer; `Fault` when the device fails.
pub fn overlap(device: &Arc<Device>, scene: &Arc<Scene>, states: &[SceneState], steps: usize) -> Result<Overlap> {
    if states.is_empty() || steps == 0 {
        return Err(invalid("states and steps", "at least 1", format!("{} and {steps}", states.len())));
    }
    let mut deformer = CudaDeformer::new(device, scene, None, scene.light_axes())?;
    let differing = differing(&mut deformer, states, steps)?;
    let mut times = [Vec::new(), Vec::new(), Vec::new()];
    for _ in 0..ROUNDS {
        for (way, times) in [serial, pipelined, overlapped].iter().zip(&mut times) {
            let begin = Instant::now();
            way(&mut deformer, states, steps, &mut |_, surface| {
                black_box(surface.positions.first());
            })?;
            times.push(since(begin) / steps as f64);
        }
    }
    let [serial_us, fetched_us, overlapped_us] = times.map(median);
    let [step_us, copy_out_us] = alone(&mut deformer, states, steps)?;
    let (bytes_in, [write_one_core_us, write_us]) = writes(device, scene, states, steps)?;
    let graph_us = graph(device, &deformer, steps)?;
    let read = deformer.readback(VertexAttributes::VERTICES)?;
    let surface = deformer.wait_readback(&read)?;
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
        fetched_us,
        overlapped_us,
        gain: serial_us / overlapped_us,
        ideal_us: write_us.max(graph_us).max(copy_out_us),
        differing,
    })
}

type Read<'a> = &'a mut dyn FnMut(usize, &DeformedSurface);

fn serial(deformer: &mut CudaDeformer, states: &[SceneState], steps: usize, read: Read<'_>) -> Result<()> {
    for step in 0..steps {
        deformer.deform(&states[step % states.len()])?;
        let readback = deformer.readback(VertexAttributes::VERTICES)?;
        read(step, &*deformer.wait_readback(&readback)?);
    }
    Ok(())
}

fn pipelined(deformer: &mut CudaDeformer, states: &[SceneState], steps: usize, read: Read<'_>) -> Result<()> {
    let mut before = None;
    for step in 0..=steps {
        let next = match step < steps {
            true => {
                deformer.deform(&states[step % states.len()])?;
                Some(deformer.readback(VertexAttributes::VERTICES)?)
            }
            false => None,
        };
        if let Some(readback) = std::mem::replace(&mut before, next) {
            read(step - 1, &*deformer.wait_readback(&readback)?);
        }
    }
    Ok(())
}

fn overlapped(deformer: &mut CudaDeformer, states: &[SceneState], steps: usize, read: Read<'_>) -> Result<()> {
    let mut readbacks = VecDeque::new();
    for step in 0..steps + MAX_STEPS_IN_FLIGHT {
        let finished = step.checked_sub(MAX_STEPS_IN_FLIGHT);
        if finished.is_some_and(|finished| finished < steps) {
            deformer.finish()?;
        }
        if step < steps {
            deformer.submit(&states[step % states.len()])?;
            readbacks.push_back(deformer.readback(VertexAttributes::VERTICES)?);
        }
        if let (Some(finished), true) = (finished, readbacks.len() > MAX_STEPS_IN_FLIGHT || step >= steps)
            && let Some(readback) = readbacks.pop_front()
        {
            read(finished, &*deformer.wait_readback(&readback)?);
        }
    }
    Ok(())
}

/// Counts steps of the other two methods whose vertices differ from the serial ones.
fn differing(deformer: &mut CudaDeformer, states: &[SceneState], steps: usize) -> Result<usize> {
    let mut want = Vec::new();
    serial(deformer, states, states.len(), &mut |_, surface| want.push(surface.clone()))?;
    let mut differing = 0;
    for way in [pipelined, overlapped] {
        let mut seen = 0;
        way(deformer, states, steps, &mut |step, surface| {
            seen += 1;
            differing += usize::from(!same_bits(surface, &want[step % states.len()]));
        })?;
        differing += steps.abs_diff(seen);
    }
    Ok(differing)
}

fn same_bits(one: &DeformedSurface, other: &DeformedSurface) -> bool {
    let same =
        |one: &[f32], other: &[f32]| bytemuck::cast_slice::<f32, u32>(one) == bytemuck::cast_slice::<f32, u32>(other);
    same(&one.positions, &other.positions) && same(&one.normals, &other.normals)
}

/// Median times of a step without readback, and of the readback alone.
fn alone(deformer: &mut CudaDeformer, states: &[SceneState], steps: usize) -> Result<[f64; 2]> {
    let [mut whole, mut out] = [Vec::new(), Vec::new()];
    for step in 0..steps {
        let begin = Instant::now();
        deformer.deform(&states[step % states.len()])?;
        whole.push(since(begin));
        let begin = Instant::now();
        let readback = deformer.readback(VertexAttributes::VERTICES)?;
        deformer.wait_readback(&readback)?;
        out.push(since(begin));
    }
    Ok([whole, out].map(median))
}

/// Bytes of a step's values, and median times of writing them on one core and on all.
fn writes(device: &Device, scene: &Arc<Scene>, states: &[SceneState], steps: usize) -> Result<(u64, [f64; 2])> {
    let packing = Arc::new(InputPacker::sizes_only(scene));
    let mut staging = StepInputs::new(device, &packing)?.staging(device)?;
    let words = staging.as_mut_slice()?;
    let mut writer = InputWriter::new(&packing);
    let bytes = size_of_val(words) as u64;
    let mut run = move || {
        let mut write = |step: usize| {
            let begin = Instant::now();
            writer.write(words, &Header::default(), &states[step % states.len()]);
            since(begin)
        };
        write(0);
        median((0..steps).map(&mut write).collect())
    };
    let one = rayon::ThreadPoolBuilder::new().num_threads(1).build().map_err(fault_in("write"))?;
    Ok((bytes, [one.install(&mut run), run()]))
}

/// Median time of the last step's graph alone, between two events.
fn graph(device: &Device, deformer: &CudaDeformer, steps: usize) -> Result<f64> {
    let mut times = Vec::with_capacity(steps);
    for _ in 0..steps {
        let span = EventPair::new(device)?;
        span.around(device, || deformer.replay())?;
        times.push(span.microseconds()?);
    }
    Ok(median(times))
}

fn since(begin: Instant) -> f64 {
    begin.elapsed().as_secs_f64() * 1e6
}

fn median(mut times: Vec<f64>) -> f64 {
    quantile(&mut times, 0.5).unwrap_or(f64::NAN)
}

/// Times of copying `bytes` to pinned, write-combined memory, microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct HostWrite {
    pub bytes: u64,
    pub one_core_us: f64,
    pub all_cores_us: f64,
    /// Whether the deformer writes steps of this size on all cores.
    pub on_all_cores: bool,
}

/// Copy times for powers of two from 64 KiB to 64 MiB; they show from which size several cores are faster.
///
/// # Errors
/// `Invalid` when `replays` is 0; `Fault` when the driver cannot allocate memory.
pub fn host_writes(device: &Device, replays: usize) -> Result<Vec<HostWrite>> {
    const LARGEST: usize = 64 << 20;
    let mut staging = PinnedBuffer::<f32>::zeroed(device, LARGEST / 4, PinnedUse::ToDevice)?;
    let to = staging.as_mut_slice()?;
    let from = vec![1.0_f32; LARGEST / 4];
    let mut row = |bytes: usize| {
        let (to, from) = (&mut to[..bytes / 4], &from[..bytes / 4]);
        let mut time = |copy: &dyn Fn(&mut [f32], &[f32])| {
            let once = |_| {
                let begin = Instant::now();
                copy(to, from);
                since(begin)
            };
            let timing = Timing::of((0..replays).map(once).collect());
            timing.map(|timing| timing.median_us).ok_or_else(|| invalid("replays", "at least 1", 0))
        };
        Ok(HostWrite {
            bytes: bytes as u64,
            one_core_us: time(&|to, from| to.copy_from_slice(from))?,
            all_cores_us: time(&parallel_copy)?,
            on_all_cores: bytes >= PARALLEL_THRESHOLD,
        })
    };
    (16..=26).map(|power| row(1 << power)).collect()
}
