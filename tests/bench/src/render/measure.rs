//! Measures one load: traces its references, compares every variant with them, then measures frame times and flicker.

use std::sync::Arc;
use std::time::Instant;

use nalgebra::Vector3;
use serde::Serialize;

use super::harness::{HarnessScene, PassTime, RenderHarness, Size};
use super::image_files::{self, ImageFile};
use super::metrics::{self, ErrorDistribution, Flicker, LightErrors};
use super::minimal_passes::{self, FrameBaseline, MinimalPasses};
use super::packing::{Packing, packed};
use super::ray_scene::RayScene;
use super::reference_image::{ReferenceImage, SampleCounts, SunTerm, trace};
use super::reference_view::View;
use super::time_budget::{STEP_TIME_BUDGET, TimeBudget};
use super::variants::{ErrorLimits, ReferenceKind, RenderVariant, ShadowVariant};
use super::workloads::{AnimatedScene, RenderWorkload};
use super::{RenderReportOptions, RenderWorkloadSummary, ShadowTexelSize, light_meter};
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, Culling, RenderSettings, Scene, ShadowSettings};
use modalcast_render::{BlurMethod, FrameCullStats, FrameImage, shadow_texel_axes};

/// Step of the motion that still pictures show.
pub(super) const STILL: usize = 10;
/// Steps over which flicker is measured.
const STEPS: usize = 60;
/// Factor per side by which pictures of moving scenes are smaller.
const SMALLER: u32 = 4;

/// Results of one variant on one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RenderRow {
    pub load: String,
    pub name: String,
    pub method: ShadowVariant,
    pub shadow: Option<ShadowSettings>,
    /// Implementation of the shadow blur; part of the variant's name.
    #[serde(skip)]
    pub blur_method: BlurMethod,
    /// Packing of images in arrays, for variants that compare it.
    pub packing: Option<Packing>,
    /// Culling of the variant's look.
    pub culling: Culling,
    /// Bounds on the error against the intended result.
    pub bounds: ErrorLimits,
    /// Whether the variant is within its bounds.
    pub passed: bool,
    /// Whether the variant is included to show a failure. The report fails if it passes.
    pub to_fail: bool,
    /// Reasons why it failed.
    pub faults: Vec<String>,
    /// Color errors against one ray per sample to the sun, which is exact for a point light.
    #[serde(rename = "colour")]
    pub color: ErrorDistribution,
    /// Color errors against the intended result.
    #[serde(rename = "colour_of_aim")]
    pub color_of_reference: ErrorDistribution,
    /// Sun visibility against the hard shadow.
    pub light: LightErrors,
    /// Sun visibility against the intended result.
    pub light_of_aim: LightErrors,
    /// `None` when the variant failed or flicker was skipped.
    pub flicker: Option<ErrorDistribution>,
    /// Reason why a variant that passed has no flicker.
    pub no_flicker: Option<String>,
    /// Times per pass; "frame" is the sum without readback. Empty when the variant failed.
    pub passes: Vec<PassTime>,
    /// Device memory of the scene.
    pub bytes: u64,
    /// Part of `bytes` that the shadow takes.
    pub shadow_bytes: u64,
    /// Part of `bytes` that the images take, with all mip levels.
    pub image_bytes: u64,
    pub samples: u32,
    pub draws: usize,
    /// Culling counts of the last timed frame, where triangles are culled.
    pub culled: Option<FrameCullStats>,
}

impl RenderRow {
    /// Whether it passed or failed as stated.
    pub const fn as_stated(&self) -> bool {
        self.passed != self.to_fail
    }

    /// Median time of a frame in microseconds.
    pub fn median_us(&self) -> Option<f64> {
        self.passes.iter().find(|pass| pass.name == "frame").map(|pass| pass.timing.median_us)
    }
}

/// References of a load's still picture.
struct References {
    hard: ReferenceImage,
    /// The intended result of each variant.
    aims: Vec<ReferenceImage>,
    texels: Option<ShadowTexelSize>,
}

/// Data that all variants of a load share.
struct WorkloadContext<'a> {
    request: &'a RenderReportOptions,
    stage: AnimatedScene,
    camera: Camera,
    variants: Vec<RenderVariant>,
    references: References,
    /// Light-meter image of the still picture without shadows.
    bright: FrameImage,
    moving: MovingReferences,
}

/// References of the moving scene per step, unshadowed and with hard shadows; or the reason why there are none.
type MovingReferences = std::result::Result<Vec<[ReferenceImage; 2]>, String>;

/// All results of one load.
pub(super) struct WorkloadResult {
    pub(super) entry: RenderWorkloadSummary,
    pub(super) rows: Vec<RenderRow>,
    /// `None` when there is no row to compare it with.
    pub(super) bare: Option<MinimalPasses>,
    pub(super) files: Vec<ImageFile>,
}

/// Measures every requested variant on one load.
pub(super) fn load(
    studio: &mut RenderHarness,
    request: &RenderReportOptions,
    kind: RenderWorkload,
    progress: &mut dyn FnMut(&str),
) -> Result<WorkloadResult> {
    let stage = kind.stage()?;
    let camera = stage.camera(request.size);
    let mut variants = request.wanted();
    variants.retain(|variant| variant.suits(kind));
    progress(&format!("{}: tracing the references", stage.name));
    let begin = Instant::now();
    let references = references(studio, request, &stage, camera, &variants)?;
    let reference_ms = begin.elapsed().as_secs_f64() * 1e3;
    progress(&format!("{}: tracing the moving scene", stage.name));
    let moving = moving(studio, request, &stage)?;
    let unlit = light_meter::relit(&stage.scene, RenderSettings { shadow: None, ..stage.scene.look })?;
    let bright = frame(studio, &light_meter::meter(&unlit)?, &stage, request)?;
    let job = WorkloadContext { request, stage, camera, variants, references, bright, moving };
    let mut files = vec![job.reference_file("hard", &job.references.hard)?];
    files.push(job.light_file()?);
    let mut rows = Vec::new();
    for at in 0..job.variants.len() {
        progress(&format!("{}: {}", job.stage.name, job.variants[at].name));
        studio.renderer.set_blur_method(job.variants[at].blur_method);
        let (row, file) = job.measure(studio, at)?;
        rows.push(row);
        files.push(file);
    }
    studio.renderer.set_blur_method(BlurMethod::Auto);
    progress(&format!("{}: bare passes", job.stage.name));
    let bare = job.bare(studio, &rows)?;
    Ok(WorkloadResult { entry: job.entry(reference_ms), rows, bare, files })
}

fn detail(request: &RenderReportOptions) -> SampleCounts {
    if request.quick { SampleCounts::QUICK } else { SampleCounts::FULL }
}

fn references(
    studio: &mut RenderHarness,
    request: &RenderReportOptions,
    stage: &AnimatedScene,
    camera: Camera,
    variants: &[RenderVariant],
) -> Result<References> {
    let mut set = studio.set(&stage.scene)?;
    studio.pose(&mut set, &stage.state(STILL))?;
    let shot = set.shot(camera, request.size);
    let ray_scene = RayScene::new(&stage.scene, set.surface()?);
    let view = View::new(set.scene(), &shot);
    let mut terms = vec![SunTerm::Hard];
    for variant in variants {
        let scene = light_meter::relit(&stage.scene, variant.look(stage.scene.look))?;
        terms.push(term(variant, shadow_texel_axes(&scene, &shot)));
    }
    let mut pictures = trace(&ray_scene, &view, &terms, detail(request));
    studio.unload(set);
    let aims = pictures.split_off(1);
    Ok(References { hard: pictures.pop().unwrap_or_default(), aims, texels: ShadowTexelSize::of(&stage.scene, &shot) })
}

fn term(variant: &RenderVariant, texel: Option<[Vector3<f64>; 2]>) -> SunTerm {
    match (variant.aim, texel) {
        (ReferenceKind::Hard, _) => SunTerm::Hard,
        (ReferenceKind::Filtered { texels }, Some(texel)) => SunTerm::Filtered(texel.map(|side| side * texels)),
        _ => SunTerm::Unshadowed,
    }
}

/// Size of the pictures of the moving scene.
fn small(size: Size) -> Size {
    Size { width: (size.width / SMALLER).max(1), height: (size.height / SMALLER).max(1) }
}

/// Traces the references of every step, with a quarter of a still picture's samples.
fn moving(
    studio: &mut RenderHarness,
    request: &RenderReportOptions,
    stage: &AnimatedScene,
) -> Result<MovingReferences> {
    let size = small(request.size);
    let camera = stage.camera(size);
    let mut set = studio.set(&stage.scene)?;
    let (mut all, mut ray_scene, mut too_long) = (Vec::new(), None::<RayScene>, None);
    let mut time_budget = TimeBudget::new(STEP_TIME_BUDGET, STEPS);
    for step in 0..STEPS {
        studio.pose(&mut set, &stage.state(step))?;
        let view = View::new(set.scene(), &set.shot(camera, size));
        let own = match ray_scene.take() {
            Some(ray_scene) => ray_scene.moved(&stage.scene, set.surface()?),
            None => RayScene::new(&stage.scene, set.surface()?),
        };
        let detail = SampleCounts { taps: 1, ..SampleCounts::QUICK };
        if let Ok(pair) = trace(&own, &view, &[SunTerm::Unshadowed, SunTerm::Hard], detail).try_into() {
            all.push(pair);
        }
        ray_scene = Some(own);
        too_long = time_budget.tick("references");
        if too_long.is_some() {
            break;
        }
    }
    studio.unload(set);
    Ok(too_long.map_or(Ok(all), Err))
}

/// Draws the still picture of a scene.
fn frame(
    studio: &mut RenderHarness,
    scene: &Arc<Scene>,
    stage: &AnimatedScene,
    request: &RenderReportOptions,
) -> Result<FrameImage> {
    let mut set = studio.set(scene)?;
    studio.pose(&mut set, &stage.state(STILL))?;
    let image = studio.draw(&set, stage.camera(request.size), request.size);
    studio.unload(set);
    image
}

impl WorkloadContext<'_> {
    fn entry(&self, reference_ms: f64) -> RenderWorkloadSummary {
        let (layout, detail) = (&self.stage.scene.layout, detail(self.request));
        RenderWorkloadSummary {
            name: self.stage.name.clone(),
            vertices: layout.vertices,
            triangles: layout.triangles,
            domains: self.stage.scene.domains.len(),
            samples: detail.side * detail.side,
            taps: detail.taps,
            reference_ms,
            texels: self.references.texels,
            steps: self.moving.as_ref().map_or(0, Vec::len),
            no_flicker: self.moving.as_ref().err().cloned(),
            steps_size: small(self.request.size),
        }
    }

    /// Compares one variant's still picture and sun visibility with the references; if it passes, measures its times
    /// and flicker.
    fn measure(&self, studio: &mut RenderHarness, at: usize) -> Result<(RenderRow, ImageFile)> {
        let (variant, aim) = (&self.variants[at], &self.references.aims[at]);
        let mut scene = light_meter::relit(&self.stage.scene, variant.look(self.stage.scene.look))?;
        if let Some(packing) = variant.packing {
            scene = packed(&scene, packing)?;
        }
        let dark = frame(studio, &light_meter::meter(&scene)?, &self.stage, self.request)?;
        let lit = light_meter::read(&dark.rgba, &self.bright.rgba);
        let mut set = studio.set(&scene)?;
        studio.pose(&mut set, &self.stage.state(STILL))?;
        let image = studio.draw(&set, self.camera, self.request.size)?;
        let stats = studio.renderer.stats().clone();
        let mut row = self.compared(variant, (&image, &lit), aim);
        (row.samples, row.draws) = (stats.samples, stats.draw_calls);
        let plan = set.buffers.plan();
        row.bytes = plan.bytes();
        let of = |begins: &[&str]| -> u64 {
            let own = plan.textures.iter().filter(|texture| begins.iter().any(|begin| texture.name.starts_with(begin)));
            own.map(|texture| texture.bytes).sum()
        };
        (row.shadow_bytes, row.image_bytes) = (of(&["shadow"]), of(&["color", "normal"]));
        if row.passed {
            row.passes = studio.time(&set, self.camera, self.request.size, self.request.replays)?;
            row.culled = studio.renderer.stats().culled;
            match self.flicker(studio, &mut set, variant)? {
                Ok(flicker) => row.flicker = Some(flicker),
                Err(why) => row.no_flicker = Some(why),
            }
        }
        studio.unload(set);
        let file = image_files::strip(&self.file_name(&variant.name), self.request.size, (&image.rgba, &aim.colors))?;
        Ok((row, file))
    }

    /// Times the passes of the stripped scene, for comparison with frames that use the largest timed variance map with
    /// default settings.
    fn bare(&self, studio: &mut RenderHarness, rows: &[RenderRow]) -> Result<Option<MinimalPasses>> {
        let usual = |row: &RenderRow| {
            let own = row.shadow.filter(|own| ShadowSettings { size: own.size, ..ShadowSettings::default() } == *own);
            own.filter(|_| row.median_us().is_some())
        };
        let Some(shadow) = rows.iter().filter_map(usual).max_by_key(|own| own.size) else { return Ok(None) };
        let scene = minimal_passes::stripped(&self.stage.scene, shadow.size)?;
        let passes = self.timed(studio, &scene)?;
        let stats = studio.renderer.stats().clone();
        let timing = |name: &str| passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
        let Some((depth, visibility)) = timing("shadow").zip(timing("visibility")) else { return Ok(None) };
        if !minimal_passes::is_bare(&stats) {
            tracing::warn!(load = self.stage.name, "the stripped scene was not one draw a pass: no bare passes");
            return Ok(None);
        }
        let own = MinimalPasses {
            load: self.stage.name.clone(),
            triangles: scene.layout.triangles,
            map: shadow.size,
            samples: stats.samples,
            depth,
            visibility,
            unculled: self.beside(studio, rows, (shadow, Culling::None))?,
            usual: self.beside(studio, rows, (shadow, self.stage.scene.look.culling))?,
        };
        Ok(Some(own.compared()))
    }

    /// Time of a frame with this shadow map and culling: that of an existing row, or a new measurement.
    fn beside(
        &self,
        studio: &mut RenderHarness,
        rows: &[RenderRow],
        (shadow, culling): (ShadowSettings, Culling),
    ) -> Result<FrameBaseline> {
        // A row with the load's own look may not have culled anything.
        let is = |row: &&RenderRow| {
            let culls_so = row.culling == culling || culling == Culling::None && row.culled.is_none();
            row.shadow == Some(shadow) && culls_so
        };
        let found = rows.iter().filter(is).find_map(|row| Some((row.name.clone(), row.median_us()?)));
        let (name, frame_us) = match found {
            Some(found) => found,
            None => {
                let look = RenderSettings { shadow: Some(shadow), culling, ..self.stage.scene.look };
                let passes = self.timed(studio, &light_meter::relit(&self.stage.scene, look)?)?;
                let frame = passes.iter().find(|pass| pass.name == "frame").map_or(0.0, |pass| pass.timing.median_us);
                (format!("variance {}, blur {}", shadow.size, shadow.blur), frame)
            }
        };
        let way = if culling == Culling::None { "without culling" } else { "as the load culls" };
        Ok(FrameBaseline { name: format!("{name}: {way}"), frame_us, beyond_us: 0.0 })
    }

    /// Times the passes of the still picture of a scene.
    fn timed(&self, studio: &mut RenderHarness, scene: &Arc<Scene>) -> Result<Vec<PassTime>> {
        let mut set = studio.set(scene)?;
        studio.pose(&mut set, &self.stage.state(STILL))?;
        let passes = studio.time(&set, self.camera, self.request.size, self.request.replays);
        studio.unload(set);
        passes
    }

    fn compared(
        &self,
        variant: &RenderVariant,
        (image, lit): (&FrameImage, &[Option<f32>]),
        aim: &ReferenceImage,
    ) -> RenderRow {
        let hard = &self.references.hard;
        let color_of_reference = metrics::colors(&image.rgba, &aim.colors);
        let light_of_aim = metrics::light(lit, &aim.light);
        let bounds = variant.bounds(self.stage.kind);
        let faults = faults(&color_of_reference, &light_of_aim, &bounds);
        RenderRow {
            load: self.stage.name.clone(),
            name: variant.name.clone(),
            method: variant.method,
            shadow: variant.shadow,
            blur_method: variant.blur_method,
            packing: variant.packing,
            culling: variant.look(self.stage.scene.look).culling,
            bounds,
            passed: faults.is_empty(),
            to_fail: variant.is_to_fail(self.stage.kind),
            faults,
            color: metrics::colors(&image.rgba, &hard.colors),
            color_of_reference,
            light: metrics::light(lit, &hard.light),
            light_of_aim,
            flicker: None,
            no_flicker: None,
            passes: Vec::new(),
            bytes: 0,
            shadow_bytes: 0,
            image_bytes: 0,
            samples: 0,
            draws: 0,
            culled: None,
        }
    }

    /// The flicker of a variant, or the reason why it was skipped.
    fn flicker(
        &self,
        studio: &mut RenderHarness,
        set: &mut HarnessScene,
        variant: &RenderVariant,
    ) -> Result<std::result::Result<ErrorDistribution, String>> {
        let moving = match &self.moving {
            Ok(moving) => moving,
            Err(why) => return Ok(Err(why.clone())),
        };
        let size = small(self.request.size);
        let camera = self.stage.camera(size);
        let mut flicker = Flicker::default();
        let mut time_budget = TimeBudget::new(STEP_TIME_BUDGET, STEPS);
        for (step, [unshadowed, hard]) in moving.iter().enumerate() {
            studio.pose(set, &self.stage.state(step))?;
            let image = studio.draw(set, camera, size)?;
            let reference = if variant.aim == ReferenceKind::Unshadowed { unshadowed } else { hard };
            flicker.push(&image.rgba, &reference.colors);
            if let Some(why) = time_budget.tick("frames") {
                return Ok(Err(why));
            }
        }
        Ok(Ok(flicker.spread()))
    }

    fn file_name(&self, what: &str) -> String {
        format!("{}-{}", self.stage.name, what.replace(", ", "-").replace(' ', "-"))
    }

    fn reference_file(&self, what: &str, picture: &ReferenceImage) -> Result<ImageFile> {
        image_files::picture(&self.file_name(what), self.request.size, &picture.colors)
    }

    /// Sun visibility of the hard reference as a gray image; blue where it is undefined.
    fn light_file(&self) -> Result<ImageFile> {
        let shade = |light: &Option<f32>| light.map_or([60.0, 70.0, 110.0], |light| [255.0 * light; 3]);
        let colors: Vec<[f32; 3]> = self.references.hard.light.iter().map(shade).collect();
        image_files::picture(&self.file_name("hard light"), self.request.size, &colors)
    }
}

/// Descriptions of the exceeded bounds.
fn faults(color: &ErrorDistribution, light: &LightErrors, bounds: &ErrorLimits) -> Vec<String> {
    let found = [
        ("mean error of colour", Some(color.mean), bounds.mean_color),
        ("mean error of light", Some(light.all.mean), bounds.mean_light),
        ("mean light in the umbra", light.in_umbra, bounds.bleeding),
        ("mean light lost outside of shadows", light.lost, bounds.lost),
    ];
    let over = |(what, found, bound): (&str, Option<f64>, f64)| {
        let found = found.filter(|found| found.is_nan() || *found > bound)?;
        Some(format!("{what} {found:.3}, bound {bound}"))
    };
    found.into_iter().filter_map(over).collect()
}

#[cfg(test)]
mod tests {
    use super::super::variants::ERROR_LIMITS;
    use super::*;

    #[test]
    fn detects_missing_dark_or_displaced_small_shadows() {
        let shadow = |first: usize| -> Vec<Option<f32>> {
            (0..1000).map(|at| Some(if (first..first + 10).contains(&at) { 0.0 } else { 1.0 })).collect()
        };
        let judged = |own: &[Option<f32>]| {
            faults(&ErrorDistribution::default(), &metrics::light(own, &shadow(100)), &ERROR_LIMITS)
        };
        assert_eq!(judged(&shadow(100)), Vec::<String>::new(), "control: the right one");
        assert_eq!(judged(&shadow(102)), Vec::<String>::new(), "a fifth of it beside its place is within the bound");
        for wrong in [shadow(200), vec![Some(1.0); 1000], shadow(105)] {
            assert!(judged(&wrong)[0].starts_with("mean light in the umbra"), "{:?}", judged(&wrong));
        }
        assert!(judged(&vec![Some(0.5); 1000]).iter().any(|fault| fault.starts_with("mean light lost")));
        let loud = ErrorDistribution { mean: f64::NAN, ..ErrorDistribution::default() };
        assert_eq!(faults(&loud, &LightErrors::default(), &ERROR_LIMITS).len(), 1, "what is no number is a fault");
    }
}
