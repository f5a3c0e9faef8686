//! Compares the CUDA rasterizer with OpenGL on two passes, ids with depth and depth alone: the scene stripped to its
//! mesh, one sample per pixel, both in one run. Ids are compared before anything is timed.

use std::path::Path;
use std::sync::Arc;

use nalgebra::Matrix4;
use serde::Serialize;

use super::loads::{Kind, add, room, screen};
use super::measure::STILL;
use super::paths::{self, Frames};
use super::studio::{Set, Size, Studio};
use super::{Request, bare, beside};
use crate::kernels;
use crate::kernels::{Raster, RasterCounts, RasterMesh, Trial as _};
use crate::machine::Provenance;
use crate::timing::{FEWEST, Timing};
use modalcast_compute::gpu::{Device, RasterForm};
use modalcast_model::error::{Result, during};
use modalcast_model::scene::{Camera, Faces, Group, Look, Parts, Scene, State, Window};
use modalcast_render::{Info, Seen, Shot, shadow_clip};

/// Side of the depth map: in a full and in a quick run.
pub(super) const MAPS: (u32, u32) = (4096, 1024);

/// Largest fraction of samples whose ids may differ from OpenGL's, because of edges and depth ties. Above it nothing is
/// timed.
pub(super) const MOST_DIFFERING: f64 = 0.01;

/// Both passes by both rasterizers on one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rastered {
    pub load: String,
    pub triangles: usize,
    /// Side of the depth map, texels.
    pub map: u32,
    /// Samples of the frame whose id differs from OpenGL's.
    pub differing: usize,
    pub samples: usize,
    /// `None` where too many ids differ.
    pub passes: Option<Passes>,
    /// Triangle counts in the frame, and below in the map.
    pub in_frame: Counts,
    pub in_map: Counts,
}

/// Times of the passes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Passes {
    pub depth: Pair,
    pub visibility: Pair,
}

/// The same pass by both rasterizers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Pair {
    pub opengl: Timing,
    pub cuda: Timing,
}

impl Pair {
    /// Speedup of CUDA over OpenGL.
    pub fn ratio(&self) -> f64 {
        self.opengl.median_us / self.cuda.median_us
    }
}

/// Triangle counts by outcome.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Counts {
    pub small: u32,
    pub medium: u32,
    pub large: u32,
    pub missed: u32,
    /// Not finite, outside of the view, without area, or back-facing.
    pub dropped: u32,
}

impl From<RasterCounts> for Counts {
    fn from(own: RasterCounts) -> Self {
        let RasterCounts { small, medium, large, not_finite, outside, flat, back, missed } = own;
        Self { small, medium, large, missed, dropped: not_finite + outside + flat + back }
    }
}

impl Rastered {
    /// Reason why the passes are not timed.
    pub(super) fn fault(&self) -> Option<String> {
        let Self { load, differing, samples, passes, .. } = self;
        passes.is_none().then(|| format!("{load}: raster: {differing} of {samples} samples see another triangle"))
    }
}

impl Rastered {
    /// The results as one line of text.
    pub fn line(&self) -> String {
        let pair = |pair: Pair| {
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

/// Results of these passes alone, for several loads.
#[derive(Debug, Clone, Serialize)]
pub struct Rasters {
    pub made: Provenance,
    pub renderer: Info,
    pub size: Size,
    pub rows: Vec<Rastered>,
    /// Whole frames.
    pub frames: Vec<Frames>,
}

impl Rasters {
    /// Writes `raster.json` and `raster.md` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(during("report"))?;
        let json = serde_json::to_vec_pretty(self).map_err(during("report"))?;
        let page = format!(
            "{}\n\n{}; {} x {} pixels.\n{}{}",
            self.made.line(),
            self.renderer.renderer,
            self.size.width,
            self.size.height,
            beside::raster(&self.rows),
            paths::markdown(&self.frames)
        );
        for (name, bytes) in [("raster.json", json), ("raster.md", page.into_bytes())] {
            std::fs::write(folder.join(name), bytes).map_err(during("report"))?;
        }
        Ok(())
    }

    /// Whether everything was timed.
    pub fn passed(&self) -> bool {
        self.rows.iter().all(|row| row.passes.is_some()) && paths::faults(&self.frames).is_empty()
    }
}

/// Measures these passes and nothing else; `progress` receives a description of each stage.
///
/// # Errors
/// `Unavailable` without OpenGL, a CUDA device or NVRTC; errors of loading and drawing a scene.
pub fn rasters(request: &Request, mut progress: impl FnMut(&str)) -> Result<Rasters> {
    let device = Device::open(0)?;
    device.check_compiler()?;
    let mut studio = Studio::open()?;
    let rows = measure(&mut studio, &device, request, &mut progress)?;
    let frames = paths::measure(&mut studio, &device, request, &mut progress)?;
    let renderer = studio.renderer.info().clone();
    Ok(Rasters { made: Provenance::here(), renderer, size: request.size, rows, frames })
}

/// A stripped scene with its state and camera.
struct Job {
    name: String,
    scene: Arc<Scene>,
    state: State,
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
    studio: &mut Studio,
    device: &Device,
    request: &Request,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<Rastered>> {
    let mut list = Vec::new();
    for kind in &request.loads {
        progress(&format!("{}: raster", kind.name()));
        list.push(measure_load(studio, device, request, *kind)?);
    }
    for (name, (mesh, camera)) in [("room", room()?), ("screen", screen()?)] {
        progress(&format!("{name}: raster"));
        let mut parts = Parts { look: Look::default(), ..Parts::named(name) };
        add(&mut parts, name, mesh, modalcast_model::domain::Material::default())?;
        let scene = Scene::new(parts)?;
        let state = State::rest(&scene);
        list.push(Job::new(name, &scene, (state, camera), request)?.measure(studio, device)?);
    }
    Ok(list)
}

fn measure_load(studio: &mut Studio, device: &Device, request: &Request, kind: Kind) -> Result<Rastered> {
    let stage = kind.stage()?;
    let view = (stage.state(STILL), stage.camera(request.size));
    Job::new(&stage.name, &stage.scene, view, request)?.measure(studio, device)
}

impl Job {
    fn new(name: &str, scene: &Scene, (state, camera): (State, Camera), request: &Request) -> Result<Self> {
        let map = if request.quick { MAPS.1 } else { MAPS.0 };
        let one = Scene::new(Parts { look: Look { samples: 1, ..scene.look }, ..scene.parts() })?;
        let (size, replays) = (request.size, request.replays.max(FEWEST));
        Ok(Self { name: name.into(), scene: bare::stripped(&one, map)?, state, camera, size, map, replays })
    }

    fn measure(&self, studio: &mut Studio, device: &Device) -> Result<Rastered> {
        let mut set = studio.set(&self.scene)?;
        let measured = self.measure_set(studio, &mut set, device);
        studio.strike(set);
        measured
    }

    fn measure_set(&self, studio: &mut Studio, set: &mut Set, device: &Device) -> Result<Rastered> {
        studio.pose(set, &self.state)?;
        studio.draw(set, self.camera, self.size)?;
        let ids = self.ids(&studio.renderer.seen()?, set);
        let shot = set.shot(self.camera, self.size);
        let triangles = self.scene.triangle_vertices();
        let positions = set.surface()?.positions.clone();
        let group = [Group { first: 0, triangles: triangles.len() as u32, faces: Faces::Both }];
        let mesh = RasterMesh { positions: &positions, triangles: &triangles, groups: &group, cut_outs: None };
        let (frame, map) = (self.frame(&shot)?, self.map(&shot)?);
        let [of_frame, of_map] = [(frame, false), (map, true)].map(|(window, depth_only)| {
            Raster::new(device, mesh, window, RasterForm { depth_only, ..RasterForm::default() })
        });
        let (of_frame, of_map) = (of_frame?, of_map?);
        of_frame.launch(device, 0)?;
        let keys = of_frame.keys(device)?;
        let differing = keys.iter().zip(&ids).filter(|(key, id)| **key as u32 != **id).count();
        let agrees = differing as f64 <= MOST_DIFFERING * ids.len() as f64;
        let passes = if agrees { Some(self.passes(studio, set, device, [&of_map, &of_frame])?) } else { None };
        Ok(Rastered {
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
    fn ids(&self, seen: &[Seen], set: &Set) -> Vec<u32> {
        let slots = &self.scene.layout.slots;
        let id = |seen: &Seen| match seen {
            Seen::Triangle(place) => set.buffers.triangle(*place),
            _ => None,
        };
        let packed = |(domain, triangle): (usize, usize)| (slots[domain].first_triangle + triangle) as u32;
        seen.iter().map(|seen| id(seen).map_or(u32::MAX, packed)).collect()
    }

    fn frame(&self, shot: &Shot) -> Result<Window> {
        let Size { width, height } = self.size;
        let bounds = shot.bounds.union(self.scene.rest_bounds);
        Window::new(
            &(self.camera.clip_from_camera(width, height, &bounds) * self.camera.camera_from_world()),
            width,
            height,
        )
    }

    fn map(&self, shot: &Shot) -> Result<Window> {
        let clip: Matrix4<f64> = shadow_clip(&self.scene, shot).ok_or_else(|| during("raster")("no shadow"))?;
        Window::new(&clip, self.map, self.map)
    }

    fn passes(&self, studio: &mut Studio, set: &Set, device: &Device, ours: [&Raster; 2]) -> Result<Passes> {
        let passes = studio.time(set, self.camera, self.size, self.replays)?;
        let pair = |name: &str, raster: &Raster| {
            let opengl = passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
            let opengl = opengl.ok_or_else(|| during("raster")(format!("no pass {name}")))?;
            let kernels::Timing { median_us, q1_us, q3_us, replays } =
                kernels::time(device, raster, kernels::Cache::Warm, self.replays)?;
            Ok(Pair { opengl, cuda: Timing { median_us, q1_us, q3_us, replays } })
        };
        Ok(Passes { depth: pair("shadow", ours[0])?, visibility: pair("visibility", ours[1])? })
    }
}

/// Counts by a separate launch, because the timed kernels do not count.
fn counts(device: &Device, mesh: RasterMesh<'_>, window: Window, depth_only: bool) -> Result<Counts> {
    let raster = Raster::new(device, mesh, window, RasterForm { depth_only, counted: true, ..RasterForm::default() })?;
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
        let mut studio = Studio::open().expect("OpenGL");
        let (mesh, camera) = room().expect("a room");
        let mut parts = Parts::named("room");
        add(&mut parts, "room", mesh, modalcast_model::domain::Material::default()).expect("added");
        let scene = Scene::new(parts).expect("a scene");
        let request = Request {
            loads: vec![],
            plants: vec![],
            variants: vec![],
            size: Size { width: 160, height: 90 },
            quick: true,
            replays: 1,
        };
        let job = Job::new("room", &scene, (State::rest(&scene), camera), &request).expect("a job");
        assert!((9_000..11_000).contains(&job.scene.layout.triangles));
        let mut set = studio.set(&job.scene).expect("set");
        studio.pose(&mut set, &job.state).expect("posed");
        studio.draw(&set, camera, job.size).expect("drawn");
        assert_eq!(Renderer::ran(&studio.renderer).samples, 1);
        let ids = job.ids(&studio.renderer.seen().expect("seen"), &set);
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
        studio.strike(set);
    }

    #[test]
    fn ratio_exceeds_one_where_cuda_is_faster() {
        let of = |us: f64| Timing::of(vec![us]).expect("one");
        assert_eq!(Pair { opengl: of(10.0), cuda: of(2.0) }.ratio(), 5.0);
    }
}
