//! Deforms and draws the plants of table 4.5 of the thesis and compares the results with the rendering columns of its
//! tables 4.6 and 4.7.
//!
//! Definitions of the thesis: `t_vbr` is the time to update the vertices and render them. `O_vbr` is the fraction of
//! the whole frame that is `t_vbr`. FPS are whole frames per second. s is device memory.
//!
//! Our `t_vbr` is the sum of three times: a step of the deformer (upload of the modal coordinates q and of the
//! transforms T, and the product U q with the modes U), the upload of vertices if the deformer does not write the
//! renderer's buffers, and all passes except the readback, with the change from CUDA to OpenGL before them. Our frame
//! also contains the readback of the pixels and the waits between all of these. The thesis's frame includes the
//! simulation, ours does not. The thesis states neither the size of its images nor that of its shadow maps, so several
//! settings are measured ([`PlantSetting`]).

use std::fmt;
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
use modalcast_model::scene::{Antialiasing, Camera, RenderSettings, Scene, SceneState, ShadowFit, ShadowSettings};
use modalcast_render::{FrameParams, RasterBackend, RenderStage, SceneBuffers, SharedFrame};

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
    pub setting: PlantSetting,
    /// A step of the deformer.
    pub deform: Timing,
    /// Upload of the vertices; 0 if the deformer fills the renderer's buffers.
    pub upload: Timing,
    /// Shadow and draw passes, with the change from CUDA to OpenGL.
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

/// How a plant is drawn: with a variance shadow map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct PlantSetting {
    /// Side of the shadow map, texels.
    #[serde(rename = "map")]
    pub map_size: u32,
    pub fit: ShadowFit,
    /// Whether the CUDA rasterizer draws the passes that it supports, with one sample per pixel and FXAA. Otherwise
    /// OpenGL draws four samples per pixel.
    #[serde(rename = "cuda_raster")]
    pub is_cuda_rasterized: bool,
}

impl PlantSetting {
    /// Three sizes with the thesis's fit to the corners of a bounding box; the default fit; and the CUDA rasterizer, if
    /// there is a device. Quick runs have smaller maps.
    fn all(quick: bool, has_device: bool) -> Vec<Self> {
        let scale: u32 = if quick { 4 } else { 1 };
        let with_opengl = |map_size, fit| Self { map_size: map_size / scale, fit, is_cuda_rasterized: false };
        let mut settings = [1024, 2048, 4096].map(|size| with_opengl(size, ShadowFit::Corners)).to_vec();
        let fitted = with_opengl(2048, ShadowFit::Vertices);
        settings.push(fitted);
        if has_device {
            settings.push(Self { is_cuda_rasterized: true, ..fitted });
        }
        settings
    }

    fn look(self, scene: &Scene) -> RenderSettings {
        let shadow = Some(ShadowSettings { size: self.map_size, fit: self.fit, ..ShadowSettings::default() });
        let (antialias, samples) =
            if self.is_cuda_rasterized { (Antialiasing::Fxaa, 1) } else { (Antialiasing::Msaa, 4) };
        RenderSettings { shadow, antialias, samples, ..scene.look }
    }
}

impl fmt::Display for PlantSetting {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let rasterizer = if self.is_cuda_rasterized { "CUDA, FXAA" } else { "OpenGL" };
        let fit = match self.fit {
            ShadowFit::Corners => "corners",
            ShadowFit::Vertices => "fitted",
        };
        write!(out, "{}, {fit}, {rasterizer}", self.map_size)
    }
}

/// Number of different states that the frames cycle through.
const STATES: usize = 8;

/// A plant to measure.
struct Plant {
    thesis: ThesisPlant,
    workload: Workload,
    is_full_size: bool,
    states: Vec<SceneState>,
}

/// A plant's deformer and renderer buffers. The deformer is dropped first, because it may have registered the buffers.
struct PlantSetup {
    deformer: Box<dyn Deformer>,
    /// Device bytes of the deformer.
    deformer_bytes: u64,
    buffers: SceneBuffers,
    is_cuda_rasterized: bool,
}

/// Measures the plant `index` of table 4.5, counted from 0, with all settings.
pub(super) fn measure(
    harness: &mut RenderHarness,
    device: Option<&Arc<Device>>,
    options: &RenderReportOptions,
    index: usize,
) -> Result<Vec<PlantResult>> {
    let workload_size = if options.quick { WorkloadSize::Quick } else { WorkloadSize::Full };
    let workload = WorkloadKind::Plant(index).build(workload_size)?;
    let states = motion_states(&workload);
    let is_full_size = workload_size == WorkloadSize::Full;
    let plant = Plant { thesis: PLANTS[index], workload, is_full_size, states };
    let settings = PlantSetting::all(options.quick, device.is_some());
    settings.into_iter().map(|setting| measure_setting(harness, device, options, &plant, setting)).collect()
}

fn measure_setting(
    harness: &mut RenderHarness,
    device: Option<&Arc<Device>>,
    options: &RenderReportOptions,
    plant: &Plant,
    setting: PlantSetting,
) -> Result<PlantResult> {
    let Plant { thesis, workload, is_full_size, states } = plant;
    let scene = light_meter::with_settings(&workload.scene, setting.look(&workload.scene))?;
    let mut setup = create_setup(harness, device, &scene, setting)?;
    let timings = time_frames(harness, &mut setup, &scene, options, states)?;
    let PlantSetup { deformer, deformer_bytes, buffers, .. } = setup;
    let (backend, fills_gl_buffers) = (deformer.backend(), deformer.fills_gl_buffers());
    let bytes = deformer_bytes + buffers.plan().bytes();
    drop(deformer);
    harness.renderer.unload(buffers);
    Ok(PlantResult {
        load: workload.name.clone(),
        thesis: *thesis,
        is_full_size: *is_full_size,
        remarks: workload.remarks.clone(),
        backend,
        fills_gl_buffers,
        triangles: scene.layout.triangles,
        domains: scene.domains.len(),
        setting,
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

fn create_setup(
    harness: &mut RenderHarness,
    device: Option<&Arc<Device>>,
    scene: &Arc<Scene>,
    setting: PlantSetting,
) -> Result<PlantSetup> {
    let mut buffers = harness.renderer.load(scene)?;
    let Some(device) = device else {
        return Ok(PlantSetup {
            deformer: Box::new(CpuDeformer::new(scene).with_bounding_axes(scene.light_axes())),
            deformer_bytes: 0,
            buffers,
            is_cuda_rasterized: false,
        });
    };
    let renderer_device = harness.renderer.info().cuda_device.and_then(|ordinal| usize::try_from(ordinal).ok());
    let is_same_device = renderer_device == Some(device.ordinal());
    let vertex_buffers = if is_same_device { Some(buffers.vertex_buffers()) } else { None };
    let deformer =
        CudaDeformer::new(device, scene, vertex_buffers, CudaDeformerOptions::with_bounding_axes(scene.light_axes()))?;
    if setting.is_cuda_rasterized {
        harness.attach_rasterizer_to(&mut buffers, device)?;
    }
    let is_cuda_rasterized = setting.is_cuda_rasterized;
    let deformer_bytes = deformer.plan().total_bytes();
    Ok(PlantSetup { deformer_bytes, deformer: Box::new(deformer), buffers, is_cuda_rasterized })
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
    let frame_params = FrameParams {
        camera,
        width: size.width,
        height: size.height,
        bounds,
        light_bounds,
        edges: None,
        samples: None,
    };
    let frames = setup.deformer.shared_steps()?.into_iter();
    let frames = frames.map(|step| SharedFrame { params: frame_params, positions: step.positions });
    harness.renderer.rasterize(&setup.buffers, frames.collect())?;
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
    let image = harness.renderer.draw(&setup.buffers, &frame_params)?;
    if setup.is_cuda_rasterized && image.info.raster_backends.visibility != Some(RasterBackend::Cuda) {
        return Err(fault("plants", "expected a frame by the CUDA rasterizer, got one by OpenGL"));
    }
    let frame = elapsed_us(frame_begin);
    let switch_ms = image.times.stage(RenderStage::Switch).unwrap_or(0.0);
    let render = 1e3 * (switch_ms + image.times.drawing_ms());
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
        let plants = measure(&mut harness, None, &options, 1).expect("results");
        assert_eq!(
            plants.iter().map(|plant| plant.setting.to_string()).collect::<Vec<_>>(),
            ["256, corners, OpenGL", "512, corners, OpenGL", "1024, corners, OpenGL", "512, fitted, OpenGL"]
        );
        let plant = &plants[0];
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
