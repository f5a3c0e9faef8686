//! Throughput of steps with frames in flight, as the device thread of the server executes them, without the network: each
//! step is deformed and drawn, and the pixels of every frame are copied to the host.
//!
//! Also measures a step that is not drawn, by the wall clock and beside the time of its graph of kernels and copies, and the
//! cost of reading every frame back ([`readback`]).

use std::collections::VecDeque;
use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::harness::{RenderHarness, Size, WARM_UP};
use super::light_meter::with_settings;
use super::readback::{self, ReadbackRates};
use super::workloads::{RenderWorkload, moving_states};
use super::{RenderReportOptions, harness};
use crate::provenance::Provenance;
use crate::timing::quantile;
use modalcast::config::{BackendChoice, Config};
use modalcast::engine::{DeviceContext, LoadedScene};
use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, Device};
use modalcast_model::backend_settings::{BackendSettings, RasterPolicy};
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::load;
use modalcast_model::scene::{
    Antialiasing, Camera, FrameSize, FrameStyle, RenderSettings, Scene, SceneState, ShadowSettings,
};
use modalcast_render::{FrameTimes, MAX_FRAMES_IN_FLIGHT, MappedPixels, RasterBackends};

/// Rounds, of which the median counts.
const ROUNDS: usize = 5;
/// Number of states, which the steps repeat.
const STATES: usize = 24;
/// Side of the shadow map of a field of triangles. Other scenes have the default side.
const FIELD_MAP_SIZE: u32 = 4096;

/// Frames of one scene by one rasterizer.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct PipelineRow {
    pub load: String,
    pub triangles: usize,
    /// Side of the variance shadow map, texels.
    pub map_size: u32,
    /// Rasterizers that drew the passes. All frames have one sample per pixel and FXAA.
    pub raster_backends: RasterBackends,
    /// Whether the deformer knows the next step, so that it computes two at once.
    pub knows_next_step: bool,
    /// Frames per round.
    pub frames: usize,
    /// Median rate of the rounds.
    pub per_second: f64,
    /// Median milliseconds of each stage.
    pub stages: Vec<StageMedian>,
}

/// Median time of a stage.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct StageMedian {
    pub name: &'static str,
    pub ms: f64,
}

/// A step that is not drawn, with OpenGL idle.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct UndrawnStep {
    pub load: String,
    /// Median and 99th percentile of the call by the wall clock.
    pub wall_us: [f64; 2],
    /// Mean time of the step's graph of copies and kernels when it is replayed without a pause.
    pub graph_us: f64,
}

/// Results of all scenes.
#[derive(Debug, Clone, Serialize)]
pub struct PipelineReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    pub size: Size,
    pub rows: Vec<PipelineRow>,
    pub undrawn_steps: Vec<UndrawnStep>,
    /// Frames of the workloads with their own looks, by OpenGL.
    pub readback: Vec<ReadbackRates>,
}

/// A scene with its states and camera.
struct PipelineSetup {
    name: String,
    scene: Arc<Scene>,
    states: Vec<Arc<SceneState>>,
    camera: Camera,
    size: FrameSize,
}

impl PipelineRow {
    /// The results as one line of text.
    pub fn line(&self) -> String {
        let stages: Vec<String> = self.stages.iter().map(|stage| format!("{} {:.3}", stage.name, stage.ms)).collect();
        let steps = if self.knows_next_step { "two steps at once" } else { "one step at once" };
        let backends = format!("{:?}/{:?}", self.raster_backends.shadow, self.raster_backends.visibility);
        format!(
            "{:<18}map {:>4}, {backends}, {steps}: {:>7.1} frames/s; ms: {}",
            self.load,
            self.map_size,
            self.per_second,
            stages.join(", ")
        )
    }
}

impl UndrawnStep {
    /// The results as one line of text.
    pub fn line(&self) -> String {
        let [median, p99] = self.wall_us;
        let (load, graph) = (&self.load, self.graph_us);
        format!("{load:<18}step that is not drawn: {median:.1} us (p99 {p99:.1}), its graph alone {graph:.1} us")
    }
}

impl PipelineReport {
    /// Writes `pipeline.json` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when the file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(fault_in("report"))?;
        let json = serde_json::to_vec_pretty(self).map_err(fault_in("report"))?;
        std::fs::write(folder.join("pipeline.json"), json).map_err(fault_in("report"))
    }
}

/// Measures the selected workloads and the scenes at `paths`; `progress` receives the name of each.
///
/// # Errors
/// `Unavailable` without a CUDA device and a renderer; errors of loading, deforming and drawing.
pub fn measure_pipelines(
    options: &RenderReportOptions,
    paths: &[String],
    mut progress: impl FnMut(&str),
) -> Result<PipelineReport> {
    let device = harness::cuda_device().ok_or_else(|| fault("pipeline", "expected a CUDA device and its compiler"))?;
    let readback = measure_readback(options)?;
    let mut context = DeviceContext::open(&Config { backend: BackendChoice::Cuda, ..Config::default() })?;
    let provenance = Provenance::collect();
    let mut report = PipelineReport { provenance, size: options.size, rows: vec![], undrawn_steps: vec![], readback };
    let workloads = options.loads.iter().map(|workload| PipelineSetup::of_workload(*workload, options.size));
    let scenes = paths.iter().map(|path| PipelineSetup::of_path(path, options.size));
    for setup in workloads.chain(scenes) {
        let setup = setup?;
        progress(&setup.name);
        for (raster, knows_next_step) in
            [(RasterPolicy::OpenGl, true), (RasterPolicy::Cuda, false), (RasterPolicy::Cuda, true)]
        {
            let settings = BackendSettings { raster, ..BackendSettings::default() };
            let mut loaded_scene = context.load_scene(&setup.scene, settings)?;
            let row = setup.measure_frames(&mut context, &mut loaded_scene, knows_next_step, options.replays);
            let wall_us =
                (raster == RasterPolicy::OpenGl).then(|| setup.measure_undrawn(&mut loaded_scene, options.replays));
            context.unload_scene(loaded_scene);
            report.rows.push(row?);
            if let Some(wall_us) = wall_us.transpose()? {
                let graph_us = setup.measure_graph(&device, options.replays)?;
                report.undrawn_steps.push(UndrawnStep { load: setup.name.clone(), wall_us, graph_us });
            }
        }
    }
    Ok(report)
}

/// The cost of reading every frame back.
fn measure_readback(options: &RenderReportOptions) -> Result<Vec<ReadbackRates>> {
    let mut harness = RenderHarness::open()?;
    options.loads.iter().map(|workload| readback::measure(&mut harness, options, *workload)).collect()
}

impl PipelineSetup {
    fn of_workload(workload: RenderWorkload, size: Size) -> Result<Self> {
        let animation = workload.build()?;
        let map_size = match workload {
            RenderWorkload::Triangles(_) => FIELD_MAP_SIZE,
            _ => ShadowSettings::default().size,
        };
        let states = (0..STATES).map(|step| Arc::new(animation.state(step))).collect();
        Self::new(animation.name.clone(), &animation.scene, (states, animation.camera(size)), (map_size, size))
    }

    /// A scene whose modes move. It keeps the side of its own shadow map.
    fn of_path(path: &str, size: Size) -> Result<Self> {
        let scene = load::open(path)?.scene;
        let name = Path::new(path).file_name().map_or_else(|| path.into(), |name| name.to_string_lossy().into_owned());
        let map_size = scene.look.shadow.unwrap_or_default().size;
        let camera = Camera::fit_to_scene(&scene, size.width, size.height);
        let states = moving_states(&scene, STATES).into_iter().map(Arc::new).collect();
        Self::new(name, &scene, (states, camera), (map_size, size))
    }

    fn new(
        name: String,
        scene: &Scene,
        (states, camera): (Vec<Arc<SceneState>>, Camera),
        (map_size, Size { width, height }): (u32, Size),
    ) -> Result<Self> {
        let shadow = Some(ShadowSettings { size: map_size, ..ShadowSettings::default() });
        let look = RenderSettings { shadow, antialias: Antialiasing::Fxaa, ..scene.look };
        Ok(Self { name, scene: with_settings(scene, look)?, states, camera, size: FrameSize::new(width, height) })
    }

    /// Draws rounds of frames, after a warm-up.
    fn measure_frames(
        &self,
        context: &mut DeviceContext,
        loaded_scene: &mut LoadedScene,
        knows_next_step: bool,
        frames: usize,
    ) -> Result<PipelineRow> {
        let warm_up_begin = Instant::now();
        while warm_up_begin.elapsed() < WARM_UP {
            self.draw_round(context, loaded_scene, knows_next_step, STATES, &mut |_| {})?;
        }
        let (mut rates, mut times) = (Vec::new(), Vec::new());
        for _ in 0..ROUNDS {
            let begin = Instant::now();
            let mut keep = |frame: &MappedPixels| times.push(frame.times().clone());
            self.draw_round(context, loaded_scene, knows_next_step, frames, &mut keep)?;
            rates.push(frames as f64 / begin.elapsed().as_secs_f64());
        }
        let stats = context.stats().ok_or_else(|| fault("pipeline", "expected a renderer"))?;
        Ok(PipelineRow {
            load: self.name.clone(),
            triangles: self.scene.layout.triangles,
            map_size: self.scene.look.shadow.unwrap_or_default().size,
            raster_backends: stats.raster_backends,
            knows_next_step,
            frames,
            per_second: quantile(&mut rates, 0.5).unwrap_or(f64::NAN),
            stages: stage_medians(&times),
        })
    }

    /// Deforms and draws steps with [`MAX_FRAMES_IN_FLIGHT`] frames in flight. `on_frame` receives each finished frame.
    fn draw_round(
        &self,
        context: &mut DeviceContext,
        loaded_scene: &mut LoadedScene,
        knows_next_step: bool,
        frames: usize,
        on_frame: &mut dyn FnMut(&MappedPixels),
    ) -> Result<()> {
        let mut in_flight = VecDeque::new();
        for step in 0..frames {
            if knows_next_step {
                loaded_scene.announce(&self.states[(step + 1) % STATES]);
            }
            loaded_scene.deform_shared(&self.states[step % STATES])?;
            if in_flight.len() == MAX_FRAMES_IN_FLIGHT
                && let Some(frame) = in_flight.pop_front()
            {
                on_frame(&context.finish_draw(frame)?);
            }
            in_flight.push_back(context.begin_draw(loaded_scene, &self.camera, self.size, FrameStyle::default())?);
        }
        in_flight.into_iter().try_for_each(|frame| context.finish_draw(frame).map(|pixels| on_frame(&pixels)))
    }

    /// Median and 99th percentile of a step that is not drawn, in microseconds. The first step, which follows a frame, does
    /// not count.
    fn measure_undrawn(&self, loaded_scene: &mut LoadedScene, replays: usize) -> Result<[f64; 2]> {
        let mut wall_us = Vec::new();
        for step in 0..=replays {
            let begin = Instant::now();
            loaded_scene.deform_shared(&self.states[step % STATES])?;
            wall_us.push(begin.elapsed().as_secs_f64() * 1e6);
        }
        wall_us.remove(0);
        Ok([0.5, 0.99].map(|fraction| quantile(&mut wall_us, fraction).unwrap_or(f64::NAN)))
    }

    /// Microseconds of the step's graph, replayed without a pause.
    fn measure_graph(&self, device: &Arc<Device>, replays: usize) -> Result<f64> {
        use modalcast_model::deform::Deformer as _;
        let options = CudaDeformerOptions::with_bounding_axes(self.scene.light_axes());
        let mut deformer = CudaDeformer::new(device, &self.scene, None, options)?;
        deformer.deform(&self.states[0])?;
        let begin = Instant::now();
        (0..replays).try_for_each(|_| deformer.replay())?;
        device.synchronize("pipeline")?;
        Ok(begin.elapsed().as_secs_f64() * 1e6 / replays as f64)
    }
}

/// The median time of each stage and pass of the frames.
fn stage_medians(times: &[FrameTimes]) -> Vec<StageMedian> {
    let mut ms_by_stage: Vec<(&'static str, Vec<f64>)> = Vec::new();
    for (key, ms) in times.iter().flat_map(FrameTimes::iter) {
        match ms_by_stage.iter_mut().find(|(name, _)| *name == key.name()) {
            Some((_, stage_ms)) => stage_ms.push(ms),
            None => ms_by_stage.push((key.name(), vec![ms])),
        }
    }
    let median = |(name, mut ms): (&'static str, Vec<f64>)| quantile(&mut ms, 0.5).map(|ms| StageMedian { name, ms });
    ms_by_stage.into_iter().filter_map(median).collect()
}
