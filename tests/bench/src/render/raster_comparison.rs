//! Compares the CUDA rasterizer with OpenGL on two passes, ids with depth and depth alone: the scene stripped to its
//! mesh, one sample per pixel, both in one run. Ids are compared before anything is timed.

use std::sync::Arc;

use nalgebra::Matrix4;
use serde::Serialize;

use super::harness::{HarnessScene, RenderHarness, Size};
use super::measure::STILL;
use super::rigid_domain::add_rigid_domain;
use super::workloads::{RenderWorkload, room, screen};
use super::{RenderReportOptions, minimal_passes};
use crate::kernels;
use crate::kernels::{KernelBenchmark as _, RasterBenchmark, RasterCounts, RasterMesh};
use crate::timing::{CacheState, MIN_REPETITIONS, Timing};
use modalcast_compute::gpu::{Device, RasterVariant};
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{Camera, CullMode, DrawRange, RenderSettings, Scene, SceneParts, SceneState, Viewport};
use modalcast_render::{FrameParams, VisibilityId, shadow_clip_from_world};

/// Side of the depth map: in a full and in a quick run.
pub(super) const MAPS: (u32, u32) = (4096, 1024);

/// Largest fraction of samples whose ids may differ from OpenGL's, because of edges and depth ties. Above it nothing is
/// timed.
pub(super) const MOST_DIFFERING: f64 = 0.01;

/// Both passes by both rasterizers on one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RasterComparison {
    pub load: String,
    pub triangles: usize,
    /// Side of the depth map, texels.
    pub map: u32,
    /// Samples of the frame whose id differs from OpenGL's.
    pub differing: usize,
    pub samples: usize,
    /// `None` where too many ids differ.
    pub passes: Option<PassPairs>,
    /// Triangle counts in the frame, and below in the map.
    pub in_frame: TriangleCounts,
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

/// Triangle counts by outcome.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct TriangleCounts {
    pub small: u32,
    pub medium: u32,
    pub large: u32,
    pub missed: u32,
    /// Not finite, outside of the view, without area, or back-facing.
    pub dropped: u32,
}

impl From<RasterCounts> for TriangleCounts {
    fn from(own: RasterCounts) -> Self {
        let RasterCounts { small, medium, large, not_finite, outside, flat, back, missed } = own;
        Self { small, medium, large, missed, dropped: not_finite + outside + flat + back }
    }
}

impl RasterComparison {
    /// Reason why the passes are not timed.
    pub(super) fn fault(&self) -> Option<String> {
        let Self { load, differing, samples, passes, .. } = self;
        passes.is_none().then(|| format!("{load}: raster: {differing} of {samples} samples see another triangle"))
    }
}

impl RasterComparison {
    /// The results as one line of text.
    pub fn line(&self) -> String {
        let pair = |pair: TimingPair| {
            format!(
                "{:.1} us by OpenGL, {:.1} by CUDA, {:.1} times as fast",
                pair.opengl.median_us,
                pair.cuda.median_us,
                pair.ratio()
            )
        };
        let times = self.passes.map_or("not timed".into(), |passes| {
            format!("depth {} {}; ids {}", self.map, pair(passes.depth), pair(passes.visibility))
        });
        format!("{:<18}{times}; {} of {} ids differ", self.load, self.differing, self.samples)
    }
}

/// A stripped scene with its state and camera.
struct RasterSetup {
    name: String,
    scene: Arc<Scene>,
    state: SceneState,
    camera: Camera,
    size: Size,
    map: u32,
    replays: usize,
}

/// Measures the loads of a request, a room and two triangles that fill the frame.
///
/// # Errors
/// Errors of drawing and of the device.
pub(super) fn measure(
    studio: &mut RenderHarness,
    device: &Device,
    request: &RenderReportOptions,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<RasterComparison>> {
    let mut list = Vec::new();
    for kind in &request.loads {
        progress(&format!("{}: raster", kind.name()));
        list.push(measure_load(studio, device, request, *kind)?);
    }
    for (name, (mesh, camera)) in [("room", room()?), ("screen", screen()?)] {
        progress(&format!("{name}: raster"));
        let mut parts = SceneParts { look: RenderSettings::default(), ..SceneParts::named(name) };
        add_rigid_domain(&mut parts, name, mesh, modalcast_model::domain::Material::default())?;
        let scene = Scene::new(parts)?;
        let state = SceneState::rest(&scene);
        list.push(RasterSetup::new(name, &scene, (state, camera), request)?.measure(studio, device)?);
    }
    Ok(list)
}

fn measure_load(
    studio: &mut RenderHarness,
    device: &Device,
    request: &RenderReportOptions,
    kind: RenderWorkload,
) -> Result<RasterComparison> {
    let stage = kind.stage()?;
    let view = (stage.state(STILL), stage.camera(request.size));
    RasterSetup::new(&stage.name, &stage.scene, view, request)?.measure(studio, device)
}

impl RasterSetup {
    fn new(
        name: &str,
        scene: &Scene,
        (state, camera): (SceneState, Camera),
        request: &RenderReportOptions,
    ) -> Result<Self> {
        let map = if request.quick { MAPS.1 } else { MAPS.0 };
        let one = Scene::new(SceneParts { look: RenderSettings { samples: 1, ..scene.look }, ..scene.parts() })?;
        let (size, replays) = (request.size, request.replays.max(MIN_REPETITIONS));
        Ok(Self { name: name.into(), scene: minimal_passes::stripped(&one, map)?, state, camera, size, map, replays })
    }

    fn measure(&self, studio: &mut RenderHarness, device: &Device) -> Result<RasterComparison> {
        let mut set = studio.set(&self.scene)?;
        let measured = self.measure_set(studio, &mut set, device);
        studio.unload(set);
        measured
    }

    fn measure_set(
        &self,
        studio: &mut RenderHarness,
        set: &mut HarnessScene,
        device: &Device,
    ) -> Result<RasterComparison> {
        studio.pose(set, &self.state)?;
        studio.draw(set, self.camera, self.size)?;
        let ids = self.ids(&studio.renderer.read_visibility()?, set);
        let shot = set.shot(self.camera, self.size);
        let triangles = self.scene.triangle_vertices();
        let positions = set.surface()?.positions.clone();
        let group = [DrawRange { first: 0, triangles: triangles.len() as u32, faces: CullMode::None }];
        let mesh = RasterMesh { positions: &positions, triangles: &triangles, groups: &group, cut_outs: None };
        let (frame, map) = (self.frame(&shot)?, self.map(&shot)?);
        let [of_frame, of_map] = [(frame, false), (map, true)].map(|(window, depth_only)| {
            RasterBenchmark::new(device, mesh, window, RasterVariant { depth_only, ..RasterVariant::default() })
        });
        let (of_frame, of_map) = (of_frame?, of_map?);
        of_frame.launch(device, 0)?;
        let keys = of_frame.keys(device)?;
        let differing = keys.iter().zip(&ids).filter(|(key, id)| **key as u32 != **id).count();
        let agrees = differing as f64 <= MOST_DIFFERING * ids.len() as f64;
        let passes = if agrees { Some(self.passes(studio, set, device, [&of_map, &of_frame])?) } else { None };
        Ok(RasterComparison {
            load: self.name.clone(),
            triangles: triangles.len(),
            map: self.map,
            differing,
            samples: ids.len(),
            passes,
            in_frame: counts(device, mesh, frame, false)?,
            in_map: counts(device, mesh, map, true)?,
        })
    }

    /// Ids that OpenGL drew, as indices of packed triangles; all ones where it drew none.
    fn ids(&self, seen: &[VisibilityId], set: &HarnessScene) -> Vec<u32> {
        let slots = &self.scene.layout.domains;
        let id = |seen: &VisibilityId| match seen {
            VisibilityId::Triangle(place) => set.buffers.source_triangle(*place),
            _ => None,
        };
        let packed = |(domain, triangle): (usize, usize)| (slots[domain].first_triangle + triangle) as u32;
        seen.iter().map(|seen| id(seen).map_or(u32::MAX, packed)).collect()
    }

    fn frame(&self, shot: &FrameParams) -> Result<Viewport> {
        let Size { width, height } = self.size;
        let bounds = shot.bounds.union(self.scene.rest_bounds);
        Viewport::new(
            &(self.camera.clip_from_camera(width, height, &bounds) * self.camera.camera_from_world()),
            width,
            height,
        )
    }

    fn map(&self, shot: &FrameParams) -> Result<Viewport> {
        let clip: Matrix4<f64> =
            shadow_clip_from_world(&self.scene, shot).ok_or_else(|| fault_in("raster")("no shadow"))?;
        Viewport::new(&clip, self.map, self.map)
    }

    fn passes(
        &self,
        studio: &mut RenderHarness,
        set: &HarnessScene,
        device: &Device,
        ours: [&RasterBenchmark; 2],
    ) -> Result<PassPairs> {
        let passes = studio.time(set, self.camera, self.size, self.replays)?;
        let pair = |name: &str, raster: &RasterBenchmark| {
            let opengl = passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
            let opengl = opengl.ok_or_else(|| fault_in("raster")(format!("no pass {name}")))?;
            let cuda = kernels::time(device, raster, CacheState::Warm, self.replays)?;
            Ok(TimingPair { opengl, cuda })
        };
        Ok(PassPairs { depth: pair("shadow", ours[0])?, visibility: pair("visibility", ours[1])? })
    }
}

/// Counts by a separate launch, because the timed kernels do not count.
fn counts(device: &Device, mesh: RasterMesh<'_>, window: Viewport, depth_only: bool) -> Result<TriangleCounts> {
    let raster = RasterBenchmark::new(
        device,
        mesh,
        window,
        RasterVariant { depth_only, count_triangles: true, ..RasterVariant::default() },
    )?;
    raster.launch(device, 0)?;
    Ok(raster.counts(device)?.into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_render::Renderer;

    /// The bounding box of the triangle that OpenGL drew at a sample contains the sample.
    #[test]
    fn windows_and_triangles_match_the_opengl_frame() {
        let mut studio = RenderHarness::open().expect("OpenGL");
        let (mesh, camera) = room().expect("a room");
        let mut parts = SceneParts::named("room");
        add_rigid_domain(&mut parts, "room", mesh, modalcast_model::domain::Material::default()).expect("added");
        let scene = Scene::new(parts).expect("a scene");
        let request = RenderReportOptions {
            loads: vec![],
            plants: vec![],
            variants: vec![],
            size: Size { width: 160, height: 90 },
            quick: true,
            replays: 1,
        };
        let job = RasterSetup::new("room", &scene, (SceneState::rest(&scene), camera), &request).expect("a job");
        assert!((9_000..11_000).contains(&job.scene.layout.triangles));
        let mut set = studio.set(&job.scene).expect("set");
        studio.pose(&mut set, &job.state).expect("posed");
        studio.draw(&set, camera, job.size).expect("drawn");
        assert_eq!(Renderer::stats(&studio.renderer).samples, 1);
        let ids = job.ids(&studio.renderer.read_visibility().expect("seen"), &set);
        assert!(ids.iter().all(|id| *id != u32::MAX), "a room is all around");
        let shot = set.shot(camera, job.size);
        let (window, positions) =
            (job.frame(&shot).expect("a window"), set.surface().expect("there").positions.clone());
        let list = job.scene.triangle_vertices();
        let clip = window.clip();
        let row =
            |row: usize, p: [f32; 3]| (0..3).map(|at| clip[4 * row + at] * p[at]).sum::<f32>() + clip[4 * row + 3];
        // Visible triangles in front of the eye surround their samples: each bounding box contains its sample, up to
        // half a pixel.
        let mut held = 0;
        for (at, id) in ids.iter().enumerate() {
            let corners = list[*id as usize].map(|vertex| [0, 1, 2].map(|axis| positions[3 * vertex as usize + axis]));
            let [x, y] = [0, 1].map(|axis| corners.map(|p| row(axis, p) / row(3, p)));
            let sample = [(at % 160) as f32 + 0.5, (at / 160) as f32 + 0.5];
            let within = |list: [f32; 3], at: f32, pixel: f32| {
                list.iter().any(|own| *own <= at + pixel) && list.iter().any(|own| *own >= at - pixel)
            };
            let inside =
                within(x, sample[0] / 80.0 - 1.0, 1.0 / 160.0) && within(y, 1.0 - sample[1] / 45.0, 1.0 / 90.0);
            held += usize::from(inside);
        }
        assert_eq!(held, ids.len());
        let map = job.map(&shot).expect("a map");
        assert_eq!(map.size(), [1024; 2]);
        let inside = |p: &[f32]| {
            (0..3).all(|axis| {
                let clip = map.clip();
                let at: f32 = (0..3).map(|k| clip[4 * axis + k] * p[k]).sum::<f32>() + clip[4 * axis + 3];
                at.abs() <= 1.0
            })
        };
        assert!(positions.chunks_exact(3).all(inside), "the map holds the whole room");
        studio.unload(set);
    }

    #[test]
    fn ratio_exceeds_one_where_cuda_is_faster() {
        let of = |us: f64| Timing::of(vec![us]).expect("one");
        assert_eq!(TimingPair { opengl: of(10.0), cuda: of(2.0) }.ratio(), 5.0);
    }
}
