//! Measures frame times of user-supplied scenes, without references and variants. The results contain all data that
//! another program needs to draw the same view.

use std::path::Path;
use std::time::Instant;

use nalgebra::Matrix4;
use serde::Serialize;

use super::harness::{PassTime, RenderHarness, Size};
use super::image_files::{self, ImageFile};
use crate::provenance::Provenance;
use crate::timing::{MIN_REPETITIONS, Timing};
use modalcast_model::backend_settings::LookTable;
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::load::{self, OpenedScene};
use modalcast_model::scene::{BoundingBox, Camera, SceneState};
use modalcast_render::{RasterBackends, RendererInfo};

/// Settings of the timing.
#[derive(Debug, Clone)]
pub struct FrameTimeOptions {
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
    /// Render settings, with the keys of the table `look` in `scene.toml`.
    pub look: LookTable,
    /// Samples per pixel.
    pub samples: u32,
    /// Rasterizers that drew the passes.
    #[serde(rename = "paths")]
    pub raster_backends: RasterBackends,
    /// Matrix from world to OpenGL's default clip space, -w <= z <= w, column-major. The camera frames the scene.
    pub clip_from_world: Vec<f64>,
    pub eye: [f64; 3],
    /// Unit vector towards the sun.
    pub to_sun: [f64; 3],
    /// Times per pass; "frame" is the sum without readback.
    pub passes: Vec<PassTime>,
    /// Wall-clock time of a frame, including readback.
    #[serde(rename = "whole")]
    pub wall_clock: Timing,
    /// Name of the image file.
    pub picture: String,
}

/// Results of all scenes.
#[derive(Debug, Clone, Serialize)]
pub struct FrameTimeReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    pub renderer: RendererInfo,
    pub size: Size,
    pub scenes: Vec<SceneFrameTimes>,
    #[serde(skip)]
    files: Vec<ImageFile>,
}

/// Times all scenes; `progress` receives the name of each.
///
/// # Errors
/// `Unavailable` without OpenGL; errors of loading and drawing a scene.
pub fn time_scenes(options: &FrameTimeOptions, mut progress: impl FnMut(&str)) -> Result<FrameTimeReport> {
    let mut harness = RenderHarness::open()?;
    let (mut scenes, mut files) = (Vec::new(), Vec::new());
    for source in &options.scenes {
        progress(source);
        let (scene_times, file) = time_scene(&mut harness, options, source)?;
        scenes.push(scene_times);
        files.push(file);
    }
    let renderer = harness.renderer.info().clone();
    Ok(FrameTimeReport { provenance: Provenance::collect(), renderer, size: options.size, scenes, files })
}

fn time_scene(
    harness: &mut RenderHarness,
    options: &FrameTimeOptions,
    source: &str,
) -> Result<(SceneFrameTimes, ImageFile)> {
    let (OpenedScene { scene, backends }, size) = (load::open(source)?, options.size);
    let name = Path::new(source).file_stem().map_or_else(|| "scene".into(), |stem| stem.to_string_lossy());
    let mut loaded_scene = harness.load(&scene)?;
    harness.deform(&mut loaded_scene, &SceneState::rest(&scene))?;
    let camera = Camera::fit_to_scene(&scene, size.width, size.height);
    harness.select_rasterizer(&mut loaded_scene, backends.raster, camera, size)?;
    let passes = harness.time_passes(&loaded_scene, camera, size, options.replays)?;
    let mut wall_clock_us = Vec::new();
    for _ in 0..options.replays.max(MIN_REPETITIONS) {
        let begin = Instant::now();
        harness.draw(&loaded_scene, camera, size)?;
        wall_clock_us.push(begin.elapsed().as_secs_f64() * 1e6);
    }
    let (image, frame_params) = (harness.draw(&loaded_scene, camera, size)?, loaded_scene.frame_params(camera, size));
    let file = image_files::encode_grid(&name, size, 1, &[image.rgba])?;
    let clip_from_world = default_clip_from_world(camera, size, &frame_params.bounds);
    let scene_times = SceneFrameTimes {
        name: name.into_owned(),
        vertices: scene.layout.vertices,
        triangles: scene.layout.triangles,
        look: LookTable { settings: scene.look, raster: backends.raster },
        samples: harness.renderer.stats().samples,
        raster_backends: harness.renderer.stats().raster_backends,
        clip_from_world: clip_from_world.iter().copied().collect(),
        eye: camera.eye().into(),
        to_sun: scene.look.to_sun(scene.up).into(),
        passes,
        wall_clock: Timing::of(wall_clock_us).ok_or_else(|| fault("time", "expected at least one frame, got none"))?,
        picture: file.name.clone(),
    };
    harness.unload(loaded_scene);
    Ok((scene_times, file))
}

/// Matrix from world to OpenGL's default clip space, which other renderers use: z / w is -1 at the near plane and 1 at
/// the far plane. The planes enclose `bounds`, which must be in front of the camera.
fn default_clip_from_world(camera: Camera, size: Size, bounds: &BoundingBox) -> Matrix4<f64> {
    let camera_from_world = camera.camera_from_world();
    let depths = bounds.corners().map(|corner| -camera_from_world.transform_point(&corner).z);
    let far = depths.iter().fold(0.0, |far: f64, depth| far.max(*depth)) + bounds.diagonal();
    let near = 0.5 * depths.iter().fold(far, |near: f64, depth| near.min(*depth)).max(1e-4 * far);
    let reversed = Camera { near, far, ..camera }.clip_from_camera(size.width, size.height, bounds);
    // The depth of the camera is reversed, from 1 to 0: z of the default clip space is w - 2 z.
    let mut default_from_reversed = Matrix4::identity();
    (default_from_reversed[(2, 2)], default_from_reversed[(2, 3)]) = (-2.0, 1.0);
    default_from_reversed * reversed * camera_from_world
}

impl FrameTimeReport {
    /// Writes the images and `times.json` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(fault_in("times"))?;
        let write_file = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).map_err(fault_in("times"));
        self.files.iter().try_for_each(|file| write_file(&file.name, &file.png))?;
        write_file("times.json", &serde_json::to_vec_pretty(self).map_err(fault_in("times"))?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timed_scene_has_a_matrix_that_maps_its_center_to_0() {
        let options =
            FrameTimeOptions { scenes: vec!["tree".into()], size: Size { width: 32, height: 24 }, replays: 1 };
        let report = time_scenes(&options, |_| {}).expect("a report");
        let scene_times = &report.scenes[0];
        assert!(scene_times.wall_clock.median_us > 0.0 && scene_times.wall_clock.replays == MIN_REPETITIONS);
        assert!(scene_times.passes.iter().any(|pass| pass.name == "frame"));
        let scene = load::open("tree").expect("a scene").scene;
        let clip_from_world = nalgebra::Matrix4::from_column_slice(&scene_times.clip_from_world);
        let center = clip_from_world.transform_point(&scene.rest_bounds.center());
        assert!(center.x.abs() < 1e-9 && center.y.abs() < 1e-9, "{center}");
        assert!(center.z > -1.0 && center.z < 1.0, "expected a center inside of the clip volume, got {center}");
        let nearer_point =
            clip_from_world.transform_point(&scene.rest_bounds.center().lerp(&scene_times.eye.into(), 0.1));
        assert!(nearer_point.z < center.z, "expected a depth that increases, got {nearer_point} before {center}");
        let folder = tempfile::tempdir().expect("a folder");
        report.write(folder.path()).expect("report files");
        assert!(folder.path().join("times.json").exists() && folder.path().join("tree.png").exists());
    }
}
