//! Deforms and draws the plants of table 4.5 of the thesis and compares the results with the rendering columns of its
//! tables 4.6 and 4.7.
//!
//! Definitions of the thesis: `t_vbr` is the time to update the vertices and render them. `O_vbr` is the fraction of
//! the whole frame that is `t_vbr`. FPS are whole frames per second. s is device memory.
//!
//! Our `t_vbr` is the sum of three times: a step of the deformer (upload of the modal coordinates q and of the
//! transforms T, and the product U q with the modes U), the upload of vertices if the deformer does not write the
//! renderer's buffers, and all passes except the readback. Our frame also contains the readback of the pixels and the
//! waits between all of these. The thesis's frame includes the simulation, ours does not.

use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::harness::{RenderHarness, Size};
use super::{RenderReportOptions, light_meter};
use crate::motion::WorkloadMotion;
use crate::thesis::{PLANTS, ThesisPlant};
use crate::timing::{MIN_REPETITIONS, Timing};
use crate::workloads::{Size as WorkloadSize, Workload, WorkloadKind};
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, Device};
use modalcast_model::deform::{Backend, DeformSummary, Deformer, VertexAttributes};
use modalcast_model::error::{Result, fault};
use modalcast_model::scene::{Camera, RenderSettings, Scene, SceneState, ShadowSettings};
use modalcast_render::{FrameParams, SceneBuffers};

/// Results of one plant, with the numbers of the thesis.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PlantResult {
    pub load: String,
    pub thesis: ThesisPlant,
    /// Whether the plant has the size of its row in table 4.5. Only then are the results comparable.
    #[serde(rename = "full")]
    pub is_full_size: bool,
    /// How the plant differs from its row in table 4.5.
    pub remarks: Vec<String>,
    pub backend: Backend,
    /// Whether the deformer fills the renderer's buffers, so that vertices do not pass through the host.
    #[serde(rename = "shared")]
    pub fills_gl_buffers: bool,
    pub triangles: usize,
    pub domains: usize,
    /// Side of the variance shadow map, texels.
    #[serde(rename = "map")]
    pub map_size: u32,
    /// A step of the deformer.
    pub deform: Timing,
    /// Upload of the vertices; 0 if the deformer fills the renderer's buffers.
    pub upload: Timing,
    /// Shadow and draw passes.
    pub render: Timing,
    /// `t_vbr`: the sum of deform, upload and render.
    pub vbr: Timing,
    pub frame: Timing,
    pub fps: f64,
    /// `O_vbr`: the fraction of the frame that is `t_vbr`.
    pub occupation: f64,
    /// s: device memory of the renderer and the deformer, bytes.
    pub bytes: u64,
}

/// Number of different states that the frames cycle through.
const STATES: usize = 8;

/// A plant's deformer and renderer buffers. The deformer is dropped first, because it may have registered the buffers.
struct PlantSetup {
    deformer: Box<dyn Deformer>,
    /// Device bytes of the deformer.
    deformer_bytes: u64,
    buffers: SceneBuffers,
}

/// Measures the plant `index` of table 4.5, counted from 0.
pub(super) fn measure(
    harness: &mut RenderHarness,
    device: Option<&Arc<Device>>,
    options: &RenderReportOptions,
    index: usize,
) -> Result<PlantResult> {
    let workload_size = if options.quick { WorkloadSize::Quick } else { WorkloadSize::Full };
    let workload = WorkloadKind::Plant(index).build(workload_size)?;
    let map_size = options.shadow_map_size();
    let shadow = Some(ShadowSettings { size: map_size, ..ShadowSettings::default() });
    let scene = light_meter::with_settings(&workload.scene, RenderSettings { shadow, ..workload.scene.look })?;
    let states = motion_states(&Workload { scene: Arc::clone(&scene), ..workload.clone() });
    let mut setup = create_setup(harness, device, &scene)?;
    let timings = time_frames(harness, &mut setup, &scene, options, &states)?;
    let PlantSetup { deformer, deformer_bytes, buffers } = setup;
    let (backend, fills_gl_buffers) = (deformer.backend(), deformer.fills_gl_buffers());
    let bytes = deformer_bytes + buffers.plan().bytes();
    drop(deformer);
    harness.renderer.unload(buffers);
    Ok(PlantResult {
        load: workload.name,
        thesis: PLANTS[index],
        is_full_size: workload_size == WorkloadSize::Full,
        remarks: workload.remarks,
        backend,
        fills_gl_buffers,
        triangles: scene.layout.triangles,
        domains: scene.domains.len(),
        map_size,
        deform: timings.deform,
        upload: timings.upload,
        render: timings.render,
        vbr: timings.vbr,
        frame: timings.frame,
        fps: 1e6 / timings.frame.median_us,
        occupation: timings.vbr.median_us / timings.frame.median_us,
        bytes,
    })
}

fn motion_states(workload: &Workload) -> Vec<SceneState> {
    let motion = WorkloadMotion::new(workload, None);
    let state = |step: usize| SceneState {
        step: step as u64 + 1,
        serial: step as u64 + 1,
        ..motion.trajectory_state(step).state()
    };
    (0..STATES).map(state).collect()
}

fn create_setup(harness: &mut RenderHarness, device: Option<&Arc<Device>>, scene: &Arc<Scene>) -> Result<PlantSetup> {
    let buffers = harness.renderer.load(scene)?;
    let Some(device) = device else {
        return Ok(PlantSetup {
            deformer: Box::new(CpuDeformer::new(scene).with_bounding_axes(scene.light_axes())),
            deformer_bytes: 0,
            buffers,
        });
    };
    let renderer_device = harness.renderer.info().cuda_device.and_then(|ordinal| usize::try_from(ordinal).ok());
    let is_same_device = renderer_device == Some(device.ordinal());
    let vertex_buffers = if is_same_device { Some(buffers.vertex_buffers()) } else { None };
    let deformer =
        CudaDeformer::new(device, scene, vertex_buffers, CudaDeformerOptions::with_bounding_axes(scene.light_axes()))?;
    Ok(PlantSetup { deformer_bytes: deformer.plan().total_bytes(), deformer: Box::new(deformer), buffers })
}

/// Times of one frame in microseconds, or their distributions over many frames.
#[derive(Debug, Clone, Copy)]
struct FrameTimes<T> {
    deform: T,
    upload: T,
    render: T,
    /// `t_vbr`: the sum of deform, upload and render.
    vbr: T,
    frame: T,
}

/// Draws frames of all states in turn and measures them.
fn time_frames(
    harness: &mut RenderHarness,
    setup: &mut PlantSetup,
    scene: &Arc<Scene>,
    options: &RenderReportOptions,
    states: &[SceneState],
) -> Result<FrameTimes<Timing>> {
    let size = options.size;
    let camera = Camera::fit_to_scene(scene, size.width, size.height);
    let begin = Instant::now();
    let mut warm_up_frames = 0;
    // The first frames compile shaders and allocate textures, and the clock rates of an idle device rise slowly.
    while warm_up_frames < 2 || (!harness.renderer.info().software && begin.elapsed() < super::harness::WARM_UP) {
        time_frame(harness, setup, (camera, size), &states[warm_up_frames % states.len()])?;
        warm_up_frames += 1;
    }
    let mut samples = Vec::new();
    for replay in 0..options.replays.max(MIN_REPETITIONS) {
        samples.push(time_frame(harness, setup, (camera, size), &states[replay % states.len()])?);
    }
    let timing = |time: fn(&FrameTimes<f64>) -> f64| {
        let values = samples.iter().map(time).collect();
        Timing::of(values).ok_or_else(|| fault("plants", "expected at least one frame, got none"))
    };
    Ok(FrameTimes {
        deform: timing(|times| times.deform)?,
        upload: timing(|times| times.upload)?,
        render: timing(|times| times.render)?,
        vbr: timing(|times| times.vbr)?,
        frame: timing(|times| times.frame)?,
    })
}

/// Deforms and draws one frame and measures it in microseconds.
fn time_frame(
    harness: &mut RenderHarness,
    setup: &mut PlantSetup,
    (camera, size): (Camera, Size),
    state: &SceneState,
) -> Result<FrameTimes<f64>> {
    let elapsed_us = |begin: Instant| begin.elapsed().as_secs_f64() * 1e6;
    let frame_begin = Instant::now();
    let DeformSummary { bounds, oriented_bounds: light_bounds, .. } = setup.deformer.deform(state)?;
    let deform = elapsed_us(frame_begin);
    let begin = Instant::now();
    let mut upload = 0.0;
    if setup.deformer.fills_gl_buffers() {
        setup.deformer.fill_gl_buffers()?;
    } else {
        harness
            .renderer
            .upload(&setup.buffers, setup.deformer.surface_with(VertexAttributes::POSITIONS_AND_NORMALS)?)?;
        upload = elapsed_us(begin);
    }
    let frame_params = FrameParams {
        camera,
        width: size.width,
        height: size.height,
        bounds,
        light_bounds,
        edges: None,
        samples: None,
    };
    let image = harness.renderer.draw(&setup.buffers, &frame_params)?;
    let frame = elapsed_us(frame_begin);
    let render = 1e3 * image.times.drawing_ms();
    Ok(FrameTimes { deform, upload, render, vbr: deform + upload + render, frame })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn deforms_and_draws_a_plant_with_consistent_times() {
        let mut harness = RenderHarness::open().expect("a renderer");
        let options = RenderReportOptions {
            loads: vec![],
            plants: vec![1],
            variants: vec![],
            size: Size { width: 48, height: 32 },
            quick: true,
            replays: 1,
        };
        // Plant 1 is the conifer of table 4.5.
        let plant = measure(&mut harness, None, &options, 1).expect("a result");
        assert_eq!(
            (plant.thesis.name, plant.is_full_size, plant.backend, plant.fills_gl_buffers),
            ("Conifer", false, Backend::Cpu, false)
        );
        assert!(plant.vbr.median_us > plant.deform.median_us && plant.render.median_us > 0.0);
        // Each frame takes at least t_vbr. Half of it is a margin for the render time, which has another clock.
        assert!(plant.frame.median_us >= plant.vbr.median_us * 0.5 && plant.bytes > 0);
        assert!((plant.occupation - plant.vbr.median_us / plant.frame.median_us).abs() < 1e-12);
        assert!((plant.fps * plant.frame.median_us - 1e6).abs() < 1.0);
        assert_eq!(plant.frame.replays, MIN_REPETITIONS);
    }
}
