//! The report of `modalcast report render --views`: rates of batches of small views on a CUDA device, and the
//! difference of their pictures from single frames.

use std::path::Path;
use std::sync::Arc;
use std::time::Instant;

use serde::Serialize;

use super::harness::{RenderHarness, Size};
use super::view_workloads::{self, ViewWorkload};
use crate::kernels::time_stream;
use crate::markdown_table::table;
use crate::output_files::write_files;
use crate::provenance::Provenance;
use crate::timing::{CacheState, Timing};
use modalcast_compute::gpu::launch::{PinnedBuffer, PinnedUse};
use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, CudaViewRenderer, Device};
use modalcast_compute::reference::views::ReferenceViewRenderer;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::scene::Camera;
use modalcast_model::views::{View, ViewBatch, ViewFormat, ViewOutputs, ViewPictures, ViewScene, ViewVertices};
use modalcast_render::view_data::{view_camera, view_scene};
use modalcast_render::{FrameParams, VisibilityId};

/// Views that are compared with single frames and with the reference.
const COMPARED_VIEWS: usize = 16;

/// How the numbers are defined.
const NOTE: &str = "`deform` and `draw`: time of the device by events, all worlds and views of a step. `step`: \
wall-clock time from a new state of all worlds to its pictures in device memory. `read`: wall-clock time of a draw and \
of its copy to pinned memory. `frames`: difference from single frames of OpenGL with the same vertices and the ids of \
the CUDA rasterizer: pixels with another domain, and others that differ by more than one level, both per million, and \
the largest difference of the others in levels. `reference`: the same against the CPU. `CPU`: rate of the CPU on all \
cores.";

/// Rates of all workloads.
#[derive(Debug, Clone, Serialize)]
pub struct ViewsReport {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    pub device: String,
    pub rows: Vec<ViewsRow>,
}

/// Times of one workload.
#[derive(Debug, Clone, Serialize)]
pub struct ViewsRow {
    pub load: String,
    pub worlds: usize,
    pub views: usize,
    pub size: Size,
    pub triangles: usize,
    pub domains: usize,
    pub deform: Timing,
    pub draw: Timing,
    pub step: Timing,
    /// `None` without color.
    pub read: Option<Timing>,
    /// `None` without color or without OpenGL.
    pub frames: Option<PictureDifference>,
    /// Difference of the batch from batches of one view each.
    pub single_views: PictureDifference,
    pub reference: PictureDifference,
    /// Rate of the reference on all cores.
    pub reference_views_per_s: f64,
}

/// Difference of two sets of pictures.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PictureDifference {
    pub pixels: usize,
    /// Pixels with another domain.
    pub other_domains: usize,
    /// Other pixels with a color that differs by more than one level.
    pub other_colors: usize,
    /// Largest difference of a color channel of pixels with the same domain, in levels.
    pub max_levels: u8,
}

impl PictureDifference {
    fn of(got: &ViewPictures, expected: &ViewPictures) -> Self {
        let pixels = expected.domains.len();
        let levels = |pixel: usize| {
            let channels = 3 * pixel..(3 * pixel + 3).min(expected.color.len());
            channels.map(|index| got.color[index].abs_diff(expected.color[index])).max().unwrap_or(0)
        };
        let has_same_domain = |pixel: &usize| got.domains[*pixel] == expected.domains[*pixel];
        let levels_of_same_domains = || (0..pixels).filter(has_same_domain).map(levels);
        Self {
            pixels,
            other_domains: pixels - levels_of_same_domains().count(),
            other_colors: levels_of_same_domains().filter(|levels| *levels > 1).count(),
            max_levels: levels_of_same_domains().max().unwrap_or(0),
        }
    }

    fn text(self) -> String {
        let parts_per_million = |count: usize| 1e6 * count as f64 / self.pixels.max(1) as f64;
        let [domains, colors] = [self.other_domains, self.other_colors].map(parts_per_million);
        format!("{domains:.0}, {colors:.0}, {}", self.max_levels)
    }
}

impl ViewsRow {
    /// Views per second.
    fn rate(&self, timing: &Timing) -> f64 {
        self.views as f64 * 1e6 / timing.median_us
    }

    /// The results as one line of text.
    pub fn line(&self) -> String {
        let read = self.read.as_ref().map_or("-".into(), |read| format!("{:.0}", self.rate(read)));
        let frames = self.frames.map_or("-".into(), PictureDifference::text);
        format!(
            "{:<36}{:.0} views/s drawn, {:.0} as steps, {read} read; differences from frames {frames}, from \
             single views {}, from the reference {}",
            self.load,
            self.rate(&self.draw),
            self.rate(&self.step),
            self.single_views.text(),
            self.reference.text()
        )
    }

    fn cells(&self) -> Vec<String> {
        let rate = |timing: &Timing| format!("{:.0}", self.rate(timing));
        vec![
            self.load.clone(),
            format!("{} x {}", self.size.width, self.size.height),
            self.views.to_string(),
            format!("{:.0}", self.deform.median_us),
            format!("{:.0}", self.draw.median_us),
            rate(&self.draw),
            rate(&self.step),
            self.read.as_ref().map_or(String::new(), rate),
            self.frames.map_or(String::new(), PictureDifference::text),
            self.reference.text(),
            format!("{:.0}", self.reference_views_per_s),
        ]
    }
}

impl ViewsReport {
    /// Writes `views.json` and `views.md` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        let json = serde_json::to_vec_pretty(self).map_err(fault_in("report"))?;
        let head = [
            "load",
            "pixels",
            "views",
            "deform us",
            "draw us",
            "drawn views/s",
            "views/s of steps",
            "read views/s",
            "frames",
            "reference",
            "CPU views/s",
        ];
        let rows = table(&head, self.rows.iter().map(ViewsRow::cells));
        let markdown = format!("# Small views\n\n{}; {}.\n\n{NOTE}\n\n{rows}", self.provenance.line(), self.device);
        write_files(folder, [("views.json", json), ("views.md", markdown.into_bytes())])
    }
}

/// Measures all workloads with this number of worlds; `progress` receives the name of each workload.
///
/// # Errors
/// `Unavailable` without a CUDA device or NVRTC; errors of the device.
pub fn measure_views(world_count: usize, replays: usize, mut progress: impl FnMut(&str)) -> Result<ViewsReport> {
    let device = Device::open(0)?;
    device.check_compiler()?;
    // Without OpenGL, the pictures are compared with the reference only.
    let mut harness = RenderHarness::open().ok();
    let mut rows = Vec::new();
    for workload in view_workloads::all(world_count)? {
        progress(&workload.name);
        rows.push(measure(&device, harness.as_mut(), &workload, replays)?);
    }
    Ok(ViewsReport { provenance: Provenance::collect(), device: device.name().into(), rows })
}

fn measure(
    device: &Arc<Device>,
    harness: Option<&mut RenderHarness>,
    workload: &ViewWorkload,
    replays: usize,
) -> Result<ViewsRow> {
    let scene = view_scene(&workload.scene)?;
    let cameras =
        workload.cameras.iter().map(|camera| view_camera(&workload.scene, &frame_params(workload, *camera), [0.0; 3]));
    let cameras = cameras.collect::<Result<Vec<_>>>()?;
    let format = ViewFormat {
        width: workload.size.width,
        height: workload.size.height,
        outputs: workload.outputs,
        depth_scale: workload.scene.unit as f32,
        depth_includes_ground: false,
    };
    let batch = ViewBatch { cameras: &cameras, views: &workload.views, format };
    let mut deformer = CudaDeformer::new(device, &workload.worlds, None, CudaDeformerOptions::default())?;
    let renderer = CudaViewRenderer::new(device, &scene)?;
    let mut views = renderer.prepare(&batch)?;
    deformer.deform(&workload.states[0])?;
    let deform = time_stream(device, replays, || deformer.replay())?;
    let draw = time_stream(device, replays, || renderer.draw(&deformer.device_vertices()?, &mut views))?;
    let step = Timing::by_wall_clock(CacheState::Warm, replays, |replay| {
        deformer.submit(&workload.states[replay % workload.states.len()])?;
        renderer.draw(&deformer.device_vertices()?, &mut views)?;
        deformer.finish()?;
        device.synchronize("views")
    })?;
    let read = match workload.outputs.color {
        true => {
            let color_bytes = 3 * workload.views.len() * format.pixel_count();
            let mut pinned = PinnedBuffer::<u8>::zeroed(device, color_bytes, PinnedUse::FromDevice)?;
            Timing::by_wall_clock(CacheState::Warm, replays, |_| {
                renderer.draw(&deformer.device_vertices()?, &mut views)?;
                let color = views.color().ok_or_else(|| fault("views", "expected colors"))?;
                color.read(device, 0, pinned.as_mut_slice()?)
            })?
        }
        false => None,
    };
    deformer.deform(&workload.states[0])?;
    let compared: Vec<View> = compared_views(workload);
    let compared_format = ViewFormat { outputs: ViewOutputs { domains: true, ..workload.outputs }, ..format };
    let compared_batch = ViewBatch { views: &compared, format: compared_format, ..batch };
    let mut compared_views = renderer.prepare(&compared_batch)?;
    renderer.draw(&deformer.device_vertices()?, &mut compared_views)?;
    let pictures = compared_views.read(device)?;
    let single_pictures = draw_one_by_one(device, &deformer, &renderer, &compared_batch)?;
    let surface = deformer.surface()?;
    let frames = match harness.filter(|_| workload.outputs.color) {
        Some(harness) => Some(compare_with_frames(device, harness, workload, surface, &compared, &pictures)?),
        None => None,
    };
    let (reference, reference_views_per_s) =
        compare_with_reference(surface, scene.clone(), &compared_batch, &pictures)?;
    let missing_time = || fault("time", "expected at least one run, got none");
    Ok(ViewsRow {
        load: workload.name.clone(),
        worlds: workload.world_count,
        views: workload.views.len(),
        size: workload.size,
        triangles: scene.triangle_vertices.len(),
        domains: scene.domains,
        deform,
        draw,
        step: step.ok_or_else(missing_time)?,
        read,
        frames,
        single_views: PictureDifference::of(&pictures, &single_pictures),
        reference,
        reference_views_per_s,
    })
}

/// The pictures of a batch whose views are drawn in batches of their own.
fn draw_one_by_one(
    device: &Arc<Device>,
    deformer: &CudaDeformer,
    renderer: &CudaViewRenderer,
    batch: &ViewBatch<'_>,
) -> Result<ViewPictures> {
    let mut pictures = ViewPictures::default();
    for view in batch.views {
        let mut single_view = renderer.prepare(&ViewBatch { views: std::slice::from_ref(view), ..*batch })?;
        renderer.draw(&deformer.device_vertices()?, &mut single_view)?;
        let ViewPictures { color, domains, .. } = single_view.read(device)?;
        pictures.color.extend(color);
        pictures.domains.extend(domains);
    }
    Ok(pictures)
}

fn frame_params(workload: &ViewWorkload, camera: Camera) -> FrameParams {
    FrameParams {
        camera,
        width: workload.size.width,
        height: workload.size.height,
        bounds: workload.scene.rest_bounds,
        light_bounds: None,
        edges: None,
        samples: Some(1),
    }
}

/// Some views, evenly spaced.
fn compared_views(workload: &ViewWorkload) -> Vec<View> {
    let step = workload.views.len().div_ceil(COMPARED_VIEWS);
    workload.views.iter().step_by(step).copied().collect()
}

/// Draws views on the CPU. Returns the difference, and the rate of the CPU in views per second.
fn compare_with_reference(
    surface: &DeformedSurface,
    scene: ViewScene,
    batch: &ViewBatch<'_>,
    pictures: &ViewPictures,
) -> Result<(PictureDifference, f64)> {
    let vertices =
        ViewVertices { positions: &surface.positions, normals: &surface.normals, tangents: &surface.tangents };
    let renderer = ReferenceViewRenderer::new(scene)?;
    let start = Instant::now();
    let expected = renderer.draw(&vertices, batch)?;
    let rate = batch.views.len() as f64 / start.elapsed().as_secs_f64();
    Ok((PictureDifference::of(pictures, &expected), rate))
}

/// Compares views with single frames of the same vertices, whose ids the CUDA rasterizer draws.
fn compare_with_frames(
    device: &Arc<Device>,
    harness: &mut RenderHarness,
    workload: &ViewWorkload,
    surface: &DeformedSurface,
    views: &[View],
    pictures: &ViewPictures,
) -> Result<PictureDifference> {
    let mut loaded_scene = harness.load(&workload.scene)?;
    harness.attach_rasterizer(&mut loaded_scene, device)?;
    let mut frames = ViewPictures::default();
    for view in views {
        let world = view.world as usize;
        // Sets the bounds of the frame.
        harness.deform(&mut loaded_scene, &workload.state_of(0, world))?;
        harness.renderer.upload(&loaded_scene.buffers, &surface_of_world(surface, world, workload.world_count))?;
        let frame = harness.draw(&loaded_scene, workload.cameras[view.camera as usize], workload.size)?;
        tracing::info!(backends = ?frame.info.raster_backends, "drew a frame");
        frames.color.extend(frame.rgba.chunks_exact(4).flat_map(|rgba| &rgba[..3]));
        let buffers = &loaded_scene.buffers;
        let domain_of = |id: VisibilityId| match id {
            VisibilityId::Triangle(triangle) => {
                buffers.source_triangle(triangle).map_or(-1, |(domain, _)| domain as i32)
            }
            VisibilityId::Background | VisibilityId::Ground => -1,
        };
        frames.domains.extend(harness.renderer.read_visibility()?.into_iter().map(domain_of));
    }
    harness.unload(loaded_scene);
    Ok(PictureDifference::of(pictures, &frames))
}

/// The vertices of one of `world_count` worlds.
fn surface_of_world(surface: &DeformedSurface, world: usize, world_count: usize) -> DeformedSurface {
    let part = |list: &[f32]| {
        let length = list.len() / world_count;
        list[world * length..(world + 1) * length].to_vec()
    };
    DeformedSurface {
        positions: part(&surface.positions),
        normals: part(&surface.normals),
        tangents: part(&surface.tangents),
        ..DeformedSurface::default()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_count_domains_and_colors_beyond_one_level() {
        let pictures = |color: Vec<u8>, domains: Vec<i32>| ViewPictures { color, domains, ..ViewPictures::default() };
        let expected = pictures(vec![10, 20, 30, 10, 20, 30, 10, 20, 30], vec![0, 1, -1]);
        let got = pictures(vec![11, 20, 29, 10, 23, 30, 99, 20, 30], vec![0, 1, 2]);
        let difference = PictureDifference::of(&got, &expected);
        assert_eq!(difference, PictureDifference { pixels: 3, other_domains: 1, other_colors: 1, max_levels: 3 });
    }
}
