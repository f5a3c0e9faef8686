//! Frame times of scenes of the user, without references or variants, and all data that another program needs to draw
//! the same view.

use std::path::Path;
use std::time::Instant;

use serde::Serialize;

use super::harness::{PassTime, RenderHarness, Size};
use super::image_files::{self, ImageFile};
use crate::provenance::Provenance;
use crate::timing::{MIN_REPETITIONS, Timing};
use modalcast_model::backend_settings::LookTable;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::load::{self, OpenedScene};
use modalcast_model::scene::{Camera, SceneState};
use modalcast_render::{RasterBackends, RendererInfo};

/// Settings of the timing.
#[derive(Debug, Clone)]
pub struct Request {
    /// Scenes as the command line names them.
    pub scenes: Vec<String>,
    pub size: Size,
    /// Frames per median.
    pub replays: usize,
}

/// Results of one scene at rest.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SceneFrameTimes {
    pub name: String,
    pub vertices: usize,
    pub triangles: usize,
    pub look: LookTable,
    /// Samples per pixel.
    pub samples: u32,
    /// Rasterizers that drew it.
    #[serde(rename = "paths")]
    pub raster_backends: RasterBackends,
    /// `clip_from_world`, column-major; the camera frames the scene.
    pub clip_from_world: Vec<f64>,
    pub eye: [f64; 3],
    pub to_sun: [f64; 3],
    /// Times per pass; "frame" is the sum without readback.
    pub passes: Vec<PassTime>,
    /// Wall-clock time of a whole frame, including readback.
    pub whole: Timing,
    pub picture: String,
}

/// Results of all scenes.
#[derive(Debug, Clone, Serialize)]
pub struct FrameTimeReport {
    pub made: Provenance,
    pub renderer: RendererInfo,
    pub size: Size,
    pub scenes: Vec<SceneFrameTimes>,
    #[serde(skip)]
    files: Vec<ImageFile>,
}

/// Times scenes; `progress` receives the name of each.
///
/// # Errors
/// `Unavailable` without OpenGL; errors of loading and drawing a scene.
pub fn timed(request: &Request, mut progress: impl FnMut(&str)) -> Result<FrameTimeReport> {
    let mut studio = RenderHarness::open()?;
    let (mut scenes, mut files) = (Vec::new(), Vec::new());
    for source in &request.scenes {
        progress(source);
        let (sample, file) = sample(&mut studio, request, source)?;
        scenes.push(sample);
        files.push(file);
    }
    let renderer = studio.renderer.info().clone();
    Ok(FrameTimeReport { made: Provenance::here(), renderer, size: request.size, scenes, files })
}

fn sample(studio: &mut RenderHarness, request: &Request, source: &str) -> Result<(SceneFrameTimes, ImageFile)> {
    let (OpenedScene { scene, backends }, size) = (load::open(source)?, request.size);
    let name = Path::new(source).file_stem().map_or_else(|| "scene".into(), |stem| stem.to_string_lossy());
    let mut set = studio.set(&scene)?;
    studio.pose(&mut set, &SceneState::rest(&scene))?;
    let camera = Camera::fit_to_scene(&scene, size.width, size.height);
    studio.select_rasterizer(&mut set, backends.raster, camera, size)?;
    let passes = studio.time(&set, camera, size, request.replays)?;
    let mut times = Vec::new();
    for _ in 0..request.replays.max(MIN_REPETITIONS) {
        let begin = Instant::now();
        studio.draw(&set, camera, size)?;
        times.push(begin.elapsed().as_secs_f64() * 1e6);
    }
    let (image, shot) = (studio.draw(&set, camera, size)?, set.shot(camera, size));
    let file = image_files::sheet(&name, size, 1, &[image.rgba])?;
    let clip = camera.clip_from_camera(size.width, size.height, &shot.bounds) * camera.camera_from_world();
    let sample = SceneFrameTimes {
        name: name.into_owned(),
        vertices: scene.layout.vertices,
        triangles: scene.layout.triangles,
        look: LookTable { settings: scene.look, raster: backends.raster },
        samples: studio.renderer.stats().samples,
        raster_backends: studio.renderer.stats().raster_backends,
        clip_from_world: clip.iter().copied().collect(),
        eye: camera.eye().into(),
        to_sun: scene.look.to_sun(scene.up).into(),
        passes,
        whole: Timing::of(times).ok_or_else(|| fault_in("time")("no frame was drawn"))?,
        picture: file.name.clone(),
    };
    studio.unload(set);
    Ok((sample, file))
}

impl FrameTimeReport {
    /// Writes the pictures and `times.json` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(fault_in("times"))?;
        let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).map_err(fault_in("times"));
        self.files.iter().try_for_each(|file| write(&file.name, &file.png))?;
        write("times.json", &serde_json::to_vec_pretty(self).map_err(fault_in("times"))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_a_scene_and_its_matrix_centers_it() {
        let request = Request { scenes: vec!["tree".into()], size: Size { width: 32, height: 24 }, replays: 1 };
        let timed = timed(&request, |_| {}).expect("timed");
        let sample = &timed.scenes[0];
        assert!(sample.whole.median_us > 0.0 && sample.whole.replays == MIN_REPETITIONS);
        assert!(sample.passes.iter().any(|pass| pass.name == "frame"));
        let scene = load::open("tree").expect("built").scene;
        let clip = nalgebra::Matrix4::from_column_slice(&sample.clip_from_world);
        let middle = clip.transform_point(&scene.rest_bounds.center());
        assert!(middle.x.abs() < 1e-9 && middle.y.abs() < 1e-9, "{middle}");
        let folder = tempfile::tempdir().expect("a folder");
        timed.write(folder.path()).expect("written");
        assert!(folder.path().join("times.json").exists() && folder.path().join("tree.png").exists());
    }
}
