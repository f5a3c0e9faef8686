//! Compares whole frames of OpenGL's and the CUDA rasterizer in one run: the same scene with its materials, a variance
//! map and one sample per pixel with FXAA. Ids and colors are compared before anything is timed.

use std::sync::Arc;

use serde::Serialize;

use super::harness::{HarnessScene, PassTime, RenderHarness, Size};
use super::light_meter::relit;
use super::measure::STILL;
use super::metrics::{ErrorDistribution, colors};
use super::raster_comparison::{MAPS, MOST_DIFFERING};
use super::rigid_domain::add_rigid_domain;
use super::workloads::{room, screen};
use super::{RenderReportOptions, harness};
use modalcast_compute::gpu::Device;
use modalcast_model::error::Result;
use modalcast_model::scene::{
    Antialiasing, Camera, Culling, RenderSettings, Scene, SceneParts, SceneState, ShadowSettings,
};
use modalcast_render::{FrameCullStats, RasterBackends, VisibilityId};

/// Results of one load with both rasterizers.
#[derive(Debug, Clone, Serialize)]
pub struct FrameComparison {
    pub load: String,
    pub triangles: usize,
    /// Side of the shadow map, texels.
    pub map: u32,
    /// Taps of its blur per direction.
    pub taps: u32,
    /// Rasterizer of each pass when CUDA is available.
    #[serde(rename = "paths")]
    pub raster_backends: RasterBackends,
    /// Pixels whose id differs from OpenGL's.
    pub differing: usize,
    pub pixels: usize,
    /// Color differences from OpenGL's picture, of 255.
    #[serde(rename = "colours")]
    pub colors: ErrorDistribution,
    /// Times of OpenGL with the load's culling; "frame" is the sum without readback.
    pub opengl: Vec<PassTime>,
    pub culled: Option<FrameCullStats>,
    /// Times with CUDA; `None` where too many ids differ.
    pub cuda: Option<Vec<PassTime>>,
}

impl FrameComparison {
    /// Speedup of the frame by CUDA.
    pub fn ratio(&self) -> Option<f64> {
        let frame =
            |passes: &[PassTime]| passes.iter().find(|pass| pass.name == "frame").map(|pass| pass.timing.median_us);
        Some(frame(&self.opengl)? / frame(self.cuda.as_deref()?)?)
    }

    /// The results as one line of text.
    pub fn line(&self) -> String {
        let us = |passes: &[PassTime]| {
            let one = |pass: &PassTime| format!("{} {:.1}", pass.name, pass.timing.median_us);
            passes.iter().map(one).collect::<Vec<_>>().join(", ")
        };
        format!(
            "{:<18}opengl: {}; cuda: {}; {:.1} times as fast; {} of {} ids differ, pixels by {:.3} of 255 on average, {} at most",
            self.load,
            us(&self.opengl),
            self.cuda.as_deref().map_or("not timed".into(), us),
            self.ratio().unwrap_or(f64::NAN),
            self.differing,
            self.pixels,
            self.colors.mean,
            self.colors.largest
        )
    }
}

/// A scene with the look of this benchmark, its state and camera.
struct FrameSetup {
    name: String,
    scene: Arc<Scene>,
    state: SceneState,
    camera: Camera,
}

/// Measures the loads of a request, a room and two triangles that fill the frame.
///
/// # Errors
/// Errors of drawing and of the device.
pub(super) fn measure(
    studio: &mut RenderHarness,
    device: &Arc<Device>,
    request: &RenderReportOptions,
    progress: &mut dyn FnMut(&str),
) -> Result<Vec<FrameComparison>> {
    let mut jobs = Vec::new();
    for kind in &request.loads {
        let stage = kind.stage()?;
        jobs.push(FrameSetup::new(
            &stage.name,
            &stage.scene,
            (stage.state(STILL), stage.camera(request.size)),
            request,
        )?);
    }
    for (name, (mesh, camera)) in [("room", room()?), ("screen", screen()?)] {
        let mut parts = SceneParts::named(name);
        add_rigid_domain(&mut parts, name, mesh, modalcast_model::domain::Material::default())?;
        let scene = Scene::new(parts)?;
        jobs.push(FrameSetup::new(name, &scene, (SceneState::rest(&scene), camera), request)?);
    }
    let mut list = Vec::new();
    for job in jobs {
        progress(&format!("{}: frames by OpenGL and by CUDA", job.name));
        let mut set = studio.set(&job.scene)?;
        let measured = job.measure(studio, &mut set, device, request);
        studio.unload(set);
        list.push(measured?);
    }
    Ok(list)
}

impl FrameSetup {
    fn new(
        name: &str,
        scene: &Scene,
        (state, camera): (SceneState, Camera),
        request: &RenderReportOptions,
    ) -> Result<Self> {
        let size = if request.quick { MAPS.1 } else { MAPS.0 };
        let shadow = Some(ShadowSettings { size, ..ShadowSettings::default() });
        let look = RenderSettings { shadow, antialias: Antialiasing::Fxaa, culling: Culling::Auto, ..scene.look };
        Ok(Self { name: name.into(), scene: relit(scene, look)?, state, camera })
    }

    fn measure(
        &self,
        studio: &mut RenderHarness,
        set: &mut HarnessScene,
        device: &Arc<Device>,
        request: &RenderReportOptions,
    ) -> Result<FrameComparison> {
        let (size, replays) = (request.size, request.replays);
        studio.pose(set, &self.state)?;
        let want = self.shown(studio, set, size)?;
        let opengl = studio.time(set, self.camera, size, replays)?;
        let culled = studio.renderer.stats().culled;
        studio.attach_rasterizer(set, device)?;
        let got = self.shown(studio, set, size)?;
        let raster_backends = studio.renderer.stats().raster_backends;
        let differing = got.1.iter().zip(&want.1).filter(|(got, want)| got != want).count();
        let agrees = differing as f64 <= MOST_DIFFERING * want.1.len() as f64;
        let cuda = if agrees { Some(studio.time(set, self.camera, size, replays)?) } else { None };
        let reference: Vec<[f32; 3]> =
            want.0.chunks_exact(4).map(|pixel| [0, 1, 2].map(|channel| f32::from(pixel[channel]))).collect();
        let shadow = self.scene.look.shadow.unwrap_or_default();
        Ok(FrameComparison {
            load: self.name.clone(),
            triangles: self.scene.layout.triangles,
            map: shadow.size,
            taps: 2 * shadow.reach() + 1,
            raster_backends,
            differing,
            pixels: want.1.len(),
            colors: colors(&got.0, &reference),
            opengl,
            culled,
            cuda,
        })
    }

    /// The picture, and the id at each of its pixels.
    fn shown(
        &self,
        studio: &mut RenderHarness,
        set: &HarnessScene,
        size: Size,
    ) -> Result<(Vec<u8>, Vec<VisibilityId>)> {
        let image = studio.draw(set, self.camera, size)?;
        Ok((image.rgba, studio.renderer.read_visibility()?))
    }
}

/// Descriptions of the frames that were not timed.
pub(super) fn faults(list: &[FrameComparison]) -> Vec<String> {
    let untimed = list.iter().filter(|own| own.cuda.is_none());
    untimed
        .map(|own| format!("{}: {} of {} pixels see another triangle", own.load, own.differing, own.pixels))
        .collect()
}

/// The section of whole frames in `raster.md`.
pub(super) fn markdown(list: &[FrameComparison]) -> String {
    use crate::markdown_table::{dash, table};
    let head = [
        "load",
        "triangles",
        "map",
        "taps",
        "drawn by CUDA",
        "frame us: OpenGL",
        "CUDA",
        "times as fast",
        "raster",
        "shadow",
        "blur",
        "visibility",
        "shade",
        "encode",
        "ids that differ",
        "colours: mean",
        "p99",
        "largest",
    ];
    let mut text = format!(
        "\n## Whole frames\n\nOne sample a pixel, edges smoothed after, by OpenGL as the load is culled there and with CUDA's \
         rasteriser where it may draw, in the same run. A pass with two numbers: OpenGL / CUDA, us; \"raster\" is by \
         CUDA and counted to \"shadow\", as is the blur. Where more than {} % of the ids differ nothing is timed.\n\n",
        100.0 * MOST_DIFFERING
    );
    let row = |own: &FrameComparison| {
        let of = |passes: &[harness::PassTime], name: &str| {
            passes
                .iter()
                .find(|pass| pass.name == name)
                .map_or_else(dash, |pass| format!("{:.1}", pass.timing.median_us))
        };
        let cuda = own.cuda.as_deref().unwrap_or_default();
        let both = |name: &str| format!("{} / {}", of(&own.opengl, name), of(cuda, name));
        let by_cuda: Vec<&str> =
            [("shadow", own.raster_backends.shadow), ("visibility", own.raster_backends.visibility)]
                .into_iter()
                .filter(|(_, path)| *path == Some(modalcast_render::RasterBackend::Cuda))
                .map(|(name, _)| name)
                .collect();
        let first = [own.load.clone(), own.triangles.to_string(), own.map.to_string(), own.taps.to_string()];
        let frames = [by_cuda.join(", "), of(&own.opengl, "frame"), of(cuda, "frame")];
        let ratio = own.ratio().map_or_else(dash, |ratio| format!("{ratio:.1}"));
        let passes = ["raster", "shadow", "blur", "visibility", "shade", "encode"].map(both);
        let ids = format!("{} of {}", own.differing, own.pixels);
        let colors = [own.colors.mean, own.colors.p99, own.colors.largest].map(|own| format!("{own:.3}"));
        first.into_iter().chain(frames).chain([ratio]).chain(passes).chain([ids]).chain(colors)
    };
    text.push_str(&table(&head, list.iter().map(row)));
    text
}
