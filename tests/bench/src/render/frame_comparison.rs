//! Compares whole frames by the OpenGL and by the CUDA rasterizer in one run. Both rasterizers draw the scene with its
//! materials, a variance shadow map and one sample per pixel with FXAA. Frames with CUDA are timed only if both
//! rasterizers agree on the ids of the visible triangles in nearly all pixels.

use std::sync::Arc;

use serde::Serialize;

use super::harness::{LoadedScene, PassTime, RenderHarness, Size};
use super::light_meter::with_settings;
use super::measure::STILL_STEP;
use super::metrics::{ErrorDistribution, compare_colors};
use super::rigid_domain::add_rigid_domain;
use super::workloads::{room_mesh, screen_mesh};
use super::{RenderReportOptions, harness};
use modalcast_compute::gpu::Device;
use modalcast_model::error::Result;
use modalcast_model::scene::{
    Antialiasing, Camera, Culling, RenderSettings, Scene, SceneParts, SceneState, ShadowSettings,
};
use modalcast_render::{FrameCullStats, FrameImage, RasterBackends, VisibilityId};

/// Largest fraction of pixels whose ids may differ from OpenGL's. More than in [`super::raster_comparison`], because at
/// the border of a cut-out the filtered alpha crosses its threshold, and hardware filters with 8-bit weights.
const MAX_DIFFERING_FRACTION: f64 = 2e-3;

/// Results of one workload with both rasterizers.
#[derive(Debug, Clone, Serialize)]
pub struct FrameComparison {
    pub load: String,
    pub triangles: usize,
    /// Side of the shadow map, texels.
    #[serde(rename = "map")]
    pub map_size: u32,
    /// Taps of the map's blur per direction.
    pub taps: u32,
    /// Rasterizer of each pass when CUDA is available.
    #[serde(rename = "paths")]
    pub raster_backends: RasterBackends,
    /// Pixels whose visible triangle differs from OpenGL's.
    #[serde(rename = "differing")]
    pub differing_ids: usize,
    pub pixels: usize,
    /// Color differences from OpenGL's image, 0 to 255.
    #[serde(rename = "colors")]
    pub color_errors: ErrorDistribution,
    /// Times per pass of OpenGL with automatic culling; "frame" is the sum without readback.
    pub opengl: Vec<PassTime>,
    /// Culling counts of OpenGL's last timed frame; `None` if culling is off.
    #[serde(rename = "culled")]
    pub cull_stats: Option<FrameCullStats>,
    /// Times per pass with CUDA; `None` if too many ids differ.
    pub cuda: Option<Vec<PassTime>>,
}

impl FrameComparison {
    /// Speedup of the frame by CUDA.
    pub fn ratio(&self) -> Option<f64> {
        let frame_us =
            |passes: &[PassTime]| passes.iter().find(|pass| pass.name == "frame").map(|pass| pass.timing.median_us);
        Some(frame_us(&self.opengl)? / frame_us(self.cuda.as_deref()?)?)
    }

    /// The results as one line of text.
    pub fn line(&self) -> String {
        let pass_times = |passes: &[PassTime]| {
            let pass_time = |pass: &PassTime| format!("{} {:.1}", pass.name, pass.timing.median_us);
            passes.iter().map(pass_time).collect::<Vec<_>>().join(", ")
        };
        format!(
            "{:<18}opengl: {}; cuda: {}; {:.1} times as fast; {} of {} ids differ, colors by {:.3} of 255 on average, \
             {} at most",
            self.load,
            pass_times(&self.opengl),
            self.cuda.as_deref().map_or("not timed".into(), pass_times),
            self.ratio().unwrap_or(f64::NAN),
            self.differing_ids,
            self.pixels,
            self.color_errors.mean,
            self.color_errors.max
        )
    }
}

/// A scene with the render settings of this benchmark, its state and camera.
struct FrameSetup {
    name: String,
    scene: Arc<Scene>,
    state: SceneState,
    camera: Camera,
}

/// Measures the selected workloads, a room, and two triangles that fill the frame.
///
/// # Errors
/// Errors of drawing and of the device.
pub(super) fn measure(
    harness: &mut RenderHarness,
    device: &Arc<Device>,
    options: &RenderReportOptions,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<FrameComparison>> {
    let mut setups = Vec::new();
    for workload in &options.loads {
        let animation = workload.build()?;
        setups.push(FrameSetup::new(
            &animation.name,
            &animation.scene,
            (animation.state(STILL_STEP), animation.camera(options.size)),
            options,
        )?);
    }
    for (name, (mesh, camera)) in [("room", room_mesh()?), ("screen", screen_mesh()?)] {
        let mut parts = SceneParts::named(name);
        add_rigid_domain(&mut parts, name, mesh, modalcast_model::domain::Material::default())?;
        let scene = Scene::new(parts)?;
        setups.push(FrameSetup::new(name, &scene, (SceneState::rest(&scene), camera), options)?);
    }
    let mut comparisons = Vec::new();
    for setup in setups {
        progress(&format!("{}: frames by OpenGL and by CUDA", setup.name));
        let mut loaded_scene = harness.load(&setup.scene)?;
        let comparison = setup.measure(harness, &mut loaded_scene, device, options);
        harness.unload(loaded_scene);
        comparisons.push(comparison?);
    }
    Ok(comparisons)
}

impl FrameSetup {
    fn new(
        name: &str,
        scene: &Scene,
        (state, camera): (SceneState, Camera),
        options: &RenderReportOptions,
    ) -> Result<Self> {
        let shadow = Some(ShadowSettings { size: options.shadow_map_size(), ..ShadowSettings::default() });
        let look = RenderSettings { shadow, antialias: Antialiasing::Fxaa, culling: Culling::Auto, ..scene.look };
        Ok(Self { name: name.into(), scene: with_settings(scene, look)?, state, camera })
    }

    fn measure(
        &self,
        harness: &mut RenderHarness,
        loaded_scene: &mut LoadedScene,
        device: &Arc<Device>,
        options: &RenderReportOptions,
    ) -> Result<FrameComparison> {
        let (size, replays) = (options.size, options.replays);
        harness.deform(loaded_scene, &self.state)?;
        let (opengl_image, opengl_ids) = self.draw_with_ids(harness, loaded_scene, size)?;
        let opengl = harness.time_passes(loaded_scene, self.camera, size, replays)?;
        let cull_stats = harness.renderer.stats().culled;
        harness.attach_rasterizer(loaded_scene, device)?;
        let (cuda_image, cuda_ids) = self.draw_with_ids(harness, loaded_scene, size)?;
        let raster_backends = harness.renderer.stats().raster_backends;
        let differing_ids = cuda_ids.iter().zip(&opengl_ids).filter(|(cuda, opengl)| cuda != opengl).count();
        let is_accepted = differing_ids as f64 <= MAX_DIFFERING_FRACTION * opengl_ids.len() as f64;
        let cuda =
            if is_accepted { Some(harness.time_passes(loaded_scene, self.camera, size, replays)?) } else { None };
        let reference: Vec<[f32; 3]> =
            opengl_image.rgba.chunks_exact(4).map(|pixel| [0, 1, 2].map(|channel| f32::from(pixel[channel]))).collect();
        let shadow = self.scene.look.shadow.unwrap_or_default();
        Ok(FrameComparison {
            load: self.name.clone(),
            triangles: self.scene.layout.triangles,
            map_size: shadow.size,
            taps: 2 * shadow.blur_radius() + 1,
            raster_backends,
            differing_ids,
            pixels: opengl_ids.len(),
            color_errors: compare_colors(&cuda_image.rgba, &reference),
            opengl,
            cull_stats,
            cuda,
        })
    }

    /// Draws the frame and reads the id at each of its pixels.
    fn draw_with_ids(
        &self,
        harness: &mut RenderHarness,
        loaded_scene: &LoadedScene,
        size: Size,
    ) -> Result<(FrameImage, Vec<VisibilityId>)> {
        let image = harness.draw(loaded_scene, self.camera, size)?;
        Ok((image, harness.renderer.read_visibility()?))
    }
}

/// The section of whole frames in `raster.md`.
pub(super) fn markdown(comparisons: &[FrameComparison]) -> String {
    use crate::markdown_table::{dash, table};
    let header = [
        "load",
        "triangles",
        "map",
        "taps",
        "passes drawn by CUDA",
        "frame us: OpenGL",
        "CUDA",
        "speedup",
        "raster shadow",
        "shadow",
        "blur",
        "visibility",
        "shade",
        "encode",
        "differing ids",
        "colors: mean",
        "p99",
        "largest",
    ];
    let mut text = format!(
        "\n## Whole frames\n\nOne sample per pixel with FXAA, by OpenGL with automatic culling and by the CUDA \
         rasterizer where it supports the pass, in the same run. Times of passes: OpenGL / CUDA, us. \"shadow\" \
         includes \"raster shadow\" (by CUDA only) and \"blur\"; \"encode\" converts linear colors to sRGB bytes. A \
         frame is not timed with CUDA if more than {} % of its ids differ.\n\n",
        100.0 * MAX_DIFFERING_FRACTION
    );
    let row = |frame: &FrameComparison| {
        let format_median = |passes: &[harness::PassTime], name: &str| {
            passes
                .iter()
                .find(|pass| pass.name == name)
                .map_or_else(dash, |pass| format!("{:.1}", pass.timing.median_us))
        };
        let cuda = frame.cuda.as_deref().unwrap_or_default();
        let format_both_times =
            |name: &str| format!("{} / {}", format_median(&frame.opengl, name), format_median(cuda, name));
        let cuda_passes: Vec<&str> =
            [("shadow", frame.raster_backends.shadow), ("visibility", frame.raster_backends.visibility)]
                .into_iter()
                .filter(|(_, backend)| *backend == Some(modalcast_render::RasterBackend::Cuda))
                .map(|(name, _)| name)
                .collect();
        let sizes =
            [frame.load.clone(), frame.triangles.to_string(), frame.map_size.to_string(), frame.taps.to_string()];
        let frame_times = [cuda_passes.join(", "), format_median(&frame.opengl, "frame"), format_median(cuda, "frame")];
        let ratio = frame.ratio().map_or_else(dash, |ratio| format!("{ratio:.1}"));
        let passes = ["raster shadow", "shadow", "blur", "visibility", "shade", "encode"].map(format_both_times);
        let ids = format!("{} of {}", frame.differing_ids, frame.pixels);
        let colors = [frame.color_errors.mean, frame.color_errors.p99, frame.color_errors.max]
            .map(|error| format!("{error:.3}"));
        sizes.into_iter().chain(frame_times).chain([ratio]).chain(passes).chain([ids]).chain(colors)
    };
    text.push_str(&table(&header, comparisons.iter().map(row)));
    text
}
