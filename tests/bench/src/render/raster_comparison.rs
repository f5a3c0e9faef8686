//! Compares the CUDA rasterizer with OpenGL in one run on two passes: ids with depth, and depth only. An id is the
//! index of the visible triangle of a sample. The scene is stripped to its mesh and has one sample per pixel. The
//! passes are timed only if both rasterizers agree on nearly all ids.

use std::sync::Arc;

use nalgebra::Matrix4;
use serde::Serialize;

use super::harness::{LoadedScene, RenderHarness, Size};
use super::measure::STILL_STEP;
use super::rigid_domain::add_rigid_domain;
use super::workloads::{RenderWorkload, room_mesh, screen_mesh};
use super::{RenderReportOptions, minimal_passes};
use crate::kernels;
use crate::kernels::{KernelBenchmark as _, RasterBenchmark, RasterCounts, RasterMesh};
use crate::timing::{CacheState, MIN_REPETITIONS, Timing};
use modalcast_compute::gpu::{Device, RasterVariant};
use modalcast_model::error::{Result, fault};
use modalcast_model::scene::{Camera, CullMode, DrawRange, RenderSettings, Scene, SceneParts, SceneState, Viewport};
use modalcast_render::{FrameParams, VisibilityId, shadow_clip_from_world};

/// Largest fraction of samples whose ids may differ from OpenGL's. If more ids differ, no speedup is measured. Correct
/// rasterizers differ only at edges and depth ties: on an H200 at 59 of 2,073,600 samples, a fraction of 2.8e-5.
pub(super) const MAX_DIFFERING_FRACTION: f64 = 1e-4;

/// Both passes by both rasterizers on one workload.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RasterComparison {
    pub load: String,
    pub triangles: usize,
    /// Side of the depth map, texels.
    #[serde(rename = "map")]
    pub map_size: u32,
    /// Samples of the frame whose id differs from OpenGL's.
    #[serde(rename = "differing")]
    pub differing_ids: usize,
    pub samples: usize,
    /// `None` where too many ids differ.
    pub passes: Option<PassPairs>,
    /// Triangle counts of the frame.
    pub in_frame: TriangleCounts,
    /// Triangle counts of the depth map.
    pub in_map: TriangleCounts,
}

/// Times of the passes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PassPairs {
    pub depth: TimingPair,
    pub visibility: TimingPair,
}

/// The same pass by both rasterizers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct TimingPair {
    pub opengl: Timing,
    pub cuda: Timing,
}

impl TimingPair {
    /// Speedup of CUDA over OpenGL.
    pub fn ratio(&self) -> f64 {
        self.opengl.median_us / self.cuda.median_us
    }
}

/// Numbers of triangles by how they were drawn or why they were dropped.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct TriangleCounts {
    /// Drawn by one thread each.
    pub small: u32,
    /// Drawn by one warp each.
    pub medium: u32,
    /// Drawn tile by tile, by several warps each.
    pub large: u32,
    /// Not drawn, because they cover no sample.
    pub missed: u32,
    /// Not finite, outside of the view, without area, or back-facing.
    pub dropped: u32,
}

impl From<RasterCounts> for TriangleCounts {
    fn from(counts: RasterCounts) -> Self {
        let RasterCounts { small, medium, large, not_finite, outside, flat, back, missed } = counts;
        Self { small, medium, large, missed, dropped: not_finite + outside + flat + back }
    }
}

impl RasterComparison {
    /// Describes why the passes were not timed; `None` if they were.
    pub(super) fn describe_missing_times(&self) -> Option<String> {
        let Self { load, differing_ids, samples, passes, .. } = self;
        passes
            .is_none()
            .then(|| format!("{load}: raster: expected equal ids, {differing_ids} of {samples} samples differ"))
    }

    /// The results as one line of text.
    pub fn line(&self) -> String {
        let format_pair = |pair: TimingPair| {
            format!(
                "{:.1} us by OpenGL, {:.1} by CUDA, {:.1} times as fast",
                pair.opengl.median_us,
                pair.cuda.median_us,
                pair.ratio()
            )
        };
        let times = self.passes.map_or("not timed".into(), |passes| {
            format!("depth {} {}; ids {}", self.map_size, format_pair(passes.depth), format_pair(passes.visibility))
        });
        format!("{:<18}{times}; {} of {} ids differ", self.load, self.differing_ids, self.samples)
    }
}

/// A stripped scene with its state and camera.
struct RasterSetup {
    name: String,
    scene: Arc<Scene>,
    state: SceneState,
    camera: Camera,
    size: Size,
    map_size: u32,
    replays: usize,
}

/// Measures the selected workloads, a room, and two triangles that fill the frame.
///
/// # Errors
/// Errors of drawing and of the device.
pub(super) fn measure(
    harness: &mut RenderHarness,
    device: &Device,
    options: &RenderReportOptions,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<RasterComparison>> {
    let mut comparisons = Vec::new();
    for workload in &options.loads {
        progress(&format!("{}: raster", workload.name()));
        comparisons.push(measure_workload(harness, device, options, *workload)?);
    }
    for (name, (mesh, camera)) in [("room", room_mesh()?), ("screen", screen_mesh()?)] {
        progress(&format!("{name}: raster"));
        let mut parts = SceneParts { look: RenderSettings::default(), ..SceneParts::named(name) };
        add_rigid_domain(&mut parts, name, mesh, modalcast_model::domain::Material::default())?;
        let scene = Scene::new(parts)?;
        let state = SceneState::rest(&scene);
        comparisons.push(RasterSetup::new(name, &scene, (state, camera), options)?.measure(harness, device)?);
    }
    Ok(comparisons)
}

fn measure_workload(
    harness: &mut RenderHarness,
    device: &Device,
    options: &RenderReportOptions,
    workload: RenderWorkload,
) -> Result<RasterComparison> {
    let animation = workload.build()?;
    let view = (animation.state(STILL_STEP), animation.camera(options.size));
    RasterSetup::new(&animation.name, &animation.scene, view, options)?.measure(harness, device)
}

impl RasterSetup {
    fn new(
        name: &str,
        scene: &Scene,
        (state, camera): (SceneState, Camera),
        options: &RenderReportOptions,
    ) -> Result<Self> {
        let map_size = options.shadow_map_size();
        let single_sample_scene =
            Scene::new(SceneParts { look: RenderSettings { samples: 1, ..scene.look }, ..scene.parts() })?;
        let (size, replays) = (options.size, options.replays.max(MIN_REPETITIONS));
        Ok(Self {
            name: name.into(),
            scene: minimal_passes::strip_to_mesh(&single_sample_scene, map_size)?,
            state,
            camera,
            size,
            map_size,
            replays,
        })
    }

    fn measure(&self, harness: &mut RenderHarness, device: &Device) -> Result<RasterComparison> {
        let mut loaded_scene = harness.load(&self.scene)?;
        let comparison = self.measure_loaded(harness, &mut loaded_scene, device);
        harness.unload(loaded_scene);
        comparison
    }

    fn measure_loaded(
        &self,
        harness: &mut RenderHarness,
        loaded_scene: &mut LoadedScene,
        device: &Device,
    ) -> Result<RasterComparison> {
        harness.deform(loaded_scene, &self.state)?;
        harness.draw(loaded_scene, self.camera, self.size)?;
        let ids = self.packed_ids(&harness.renderer.read_visibility()?, loaded_scene);
        let frame_params = loaded_scene.frame_params(self.camera, self.size);
        let triangles = self.scene.triangle_vertices();
        let positions = loaded_scene.surface()?.positions.clone();
        let draw_ranges =
            [DrawRange { first_triangle: 0, triangle_count: triangles.len() as u32, cull_mode: CullMode::None }];
        let mesh = RasterMesh { positions: &positions, triangles: &triangles, groups: &draw_ranges, cut_outs: None };
        let (frame_viewport, map_viewport) = (self.frame_viewport(&frame_params)?, self.map_viewport(&frame_params)?);
        let frame_variant = RasterVariant::default();
        let map_variant = RasterVariant { depth_only: true, ..RasterVariant::default() };
        let frame_raster = RasterBenchmark::new(device, mesh, frame_viewport, frame_variant)?;
        let map_raster = RasterBenchmark::new(device, mesh, map_viewport, map_variant)?;
        frame_raster.launch(device, 0)?;
        let keys = frame_raster.keys(device)?;
        // The lower 32 bits of a key are the triangle.
        let differing_ids = keys.iter().zip(&ids).filter(|(key, id)| **key as u32 != **id).count();
        let is_accepted = differing_ids as f64 <= MAX_DIFFERING_FRACTION * ids.len() as f64;
        let passes = if is_accepted {
            Some(self.time_pass_pairs(harness, loaded_scene, device, [&map_raster, &frame_raster])?)
        } else {
            None
        };
        Ok(RasterComparison {
            load: self.name.clone(),
            triangles: triangles.len(),
            map_size: self.map_size,
            differing_ids,
            samples: ids.len(),
            passes,
            in_frame: count_triangles(device, mesh, frame_viewport, frame_variant)?,
            in_map: count_triangles(device, mesh, map_viewport, map_variant)?,
        })
    }

    /// Converts ids that OpenGL drew to the ids of the CUDA rasterizer: indices into the triangles of all domains in
    /// order. `u32::MAX` where OpenGL drew no triangle.
    fn packed_ids(&self, visibility: &[VisibilityId], loaded_scene: &LoadedScene) -> Vec<u32> {
        let domain_layouts = &self.scene.layout.domains;
        let source_triangle = |id: &VisibilityId| match id {
            VisibilityId::Triangle(triangle) => loaded_scene.buffers.source_triangle(*triangle),
            _ => None,
        };
        let packed_index =
            |(domain, triangle): (usize, usize)| (domain_layouts[domain].first_triangle + triangle) as u32;
        visibility.iter().map(|id| source_triangle(id).map_or(u32::MAX, packed_index)).collect()
    }

    fn frame_viewport(&self, frame_params: &FrameParams) -> Result<Viewport> {
        let Size { width, height } = self.size;
        let bounds = frame_params.bounds.union(self.scene.rest_bounds);
        Viewport::new(
            &(self.camera.clip_from_camera(width, height, &bounds) * self.camera.camera_from_world()),
            width,
            height,
        )
    }

    fn map_viewport(&self, frame_params: &FrameParams) -> Result<Viewport> {
        let clip_from_world: Matrix4<f64> = shadow_clip_from_world(&self.scene, frame_params)
            .ok_or_else(|| fault("raster", "expected a scene with a shadow map"))?;
        Viewport::new(&clip_from_world, self.map_size, self.map_size)
    }

    fn time_pass_pairs(
        &self,
        harness: &mut RenderHarness,
        loaded_scene: &LoadedScene,
        device: &Device,
        [map_raster, frame_raster]: [&RasterBenchmark; 2],
    ) -> Result<PassPairs> {
        let passes = harness.time_passes(loaded_scene, self.camera, self.size, self.replays)?;
        let time_pair = |name: &str, raster: &RasterBenchmark| {
            let opengl = passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
            let opengl = opengl.ok_or_else(|| fault("raster", format!("expected a pass named {name}")))?;
            let cuda = kernels::time_steps(device, raster, CacheState::Warm, self.replays)?;
            Ok(TimingPair { opengl, cuda })
        };
        Ok(PassPairs { depth: time_pair("shadow", map_raster)?, visibility: time_pair("visibility", frame_raster)? })
    }
}

/// Counts triangles in a separate launch, because the timed kernels do not count.
fn count_triangles(
    device: &Device,
    mesh: RasterMesh<'_>,
    viewport: Viewport,
    variant: RasterVariant,
) -> Result<TriangleCounts> {
    let raster = RasterBenchmark::new(device, mesh, viewport, RasterVariant { count_triangles: true, ..variant })?;
    raster.launch(device, 0)?;
    Ok(raster.counts(device)?.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_render::Renderer;

    /// The viewport of the CUDA rasterizer projects the triangle of each OpenGL id to a bounding box that contains the
    /// sample of the id.
    #[test]
    fn viewports_and_triangles_match_the_opengl_frame() {
        let mut harness = RenderHarness::open().expect("OpenGL");
        let (mesh, camera) = room_mesh().expect("a room");
        let mut parts = SceneParts::named("room");
        add_rigid_domain(&mut parts, "room", mesh, modalcast_model::domain::Material::default()).expect("a domain");
        let scene = Scene::new(parts).expect("a scene");
        let options = RenderReportOptions {
            loads: vec![],
            plants: vec![],
            variants: vec![],
            size: Size { width: 160, height: 90 },
            quick: true,
            replays: 1,
        };
        let setup = RasterSetup::new("room", &scene, (SceneState::rest(&scene), camera), &options).expect("a setup");
        assert!((9_000..11_000).contains(&setup.scene.layout.triangles));
        let mut loaded_scene = harness.load(&setup.scene).expect("a loaded scene");
        harness.deform(&mut loaded_scene, &setup.state).expect("deformed vertices");
        harness.draw(&loaded_scene, camera, setup.size).expect("a frame");
        assert_eq!(Renderer::stats(&harness.renderer).samples, 1);
        let ids = setup.packed_ids(&harness.renderer.read_visibility().expect("visibility ids"), &loaded_scene);
        assert!(ids.iter().all(|id| *id != u32::MAX), "expected a triangle at every sample");
        let frame_params = loaded_scene.frame_params(camera, setup.size);
        let (viewport, positions) = (
            setup.frame_viewport(&frame_params).expect("a viewport"),
            loaded_scene.surface().expect("a surface").positions.clone(),
        );
        let triangles = setup.scene.triangle_vertices();
        // A row-major matrix of 4 x 4.
        let clip_from_world = viewport.clip_from_positions();
        let clip_coordinate = |row: usize, point: [f32; 3]| {
            (0..3).map(|axis| clip_from_world[4 * row + axis] * point[axis]).sum::<f32>() + clip_from_world[4 * row + 3]
        };
        let mut contained_samples = 0;
        for (pixel, id) in ids.iter().enumerate() {
            let corners =
                triangles[*id as usize].map(|vertex| [0, 1, 2].map(|axis| positions[3 * vertex as usize + axis]));
            // Normalized device coordinates of the three corners.
            let [x, y] =
                [0, 1].map(|axis| corners.map(|point| clip_coordinate(axis, point) / clip_coordinate(3, point)));
            let sample = [(pixel % 160) as f32 + 0.5, (pixel / 160) as f32 + 0.5];
            // Compares along one axis, in normalized device coordinates.
            let contains_sample = |corners: [f32; 3], coordinate: f32, tolerance: f32| {
                corners.iter().any(|corner| *corner <= coordinate + tolerance)
                    && corners.iter().any(|corner| *corner >= coordinate - tolerance)
            };
            // The frame of 160 x 90 pixels extends from -1 to 1; the tolerance is half a pixel.
            let is_inside = contains_sample(x, sample[0] / 80.0 - 1.0, 1.0 / 160.0)
                && contains_sample(y, 1.0 - sample[1] / 45.0, 1.0 / 90.0);
            contained_samples += usize::from(is_inside);
        }
        assert_eq!(contained_samples, ids.len());
        let map = setup.map_viewport(&frame_params).expect("a viewport of the map");
        assert_eq!(map.size(), [1024; 2]);
        // The projection of the map is orthographic, so that w is 1.
        let clip_from_world = map.clip_from_positions();
        let is_inside = |point: &[f32]| {
            (0..3).all(|row| {
                let coordinate: f32 = (0..3).map(|axis| clip_from_world[4 * row + axis] * point[axis]).sum::<f32>()
                    + clip_from_world[4 * row + 3];
                // x and y are from -1 to 1, depth is from 0 to 1.
                coordinate <= 1.0 && coordinate >= if row == 2 { 0.0 } else { -1.0 }
            })
        };
        assert!(positions.chunks_exact(3).all(is_inside), "expected all vertices inside the map");
        harness.unload(loaded_scene);
    }

    #[test]
    fn ratio_exceeds_one_where_cuda_is_faster() {
        let timing = |us: f64| Timing::of(vec![us]).expect("a timing");
        assert_eq!(TimingPair { opengl: timing(10.0), cuda: timing(2.0) }.ratio(), 5.0);
    }
}
