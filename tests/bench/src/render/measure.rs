//! Measures one load: traces its references, compares every variant with them, then measures frame times and flicker.

use std::sync::Arc;
use std::time::Instant;

use nalgebra::Vector3;
use serde::Serialize;

use super::harness::{LoadedScene, PassTime, RenderHarness, Size};
use super::image_files::{self, ImageFile};
use super::metrics::{self, ErrorDistribution, Flicker, LightErrors};
use super::minimal_passes::{self, FrameBaseline, MinimalPasses};
use super::packing::{Packing, pack_images};
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

/// Step of the motion that the still images show.
pub(super) const STILL: usize = 10;
/// Steps over which flicker is measured.
const FLICKER_STEPS: usize = 60;
/// Factor per side by which images of moving scenes are smaller than still images.
const MOVING_SIZE_DIVISOR: u32 = 4;

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
    /// Culling of the variant's settings.
    pub culling: Culling,
    /// Bounds on the error against the intended result.
    pub bounds: ErrorLimits,
    /// Whether the variant is within its bounds.
    pub passed: bool,
    /// Whether the variant is expected to fail. The report fails if it passes.
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
    /// Part of `bytes` for the textures of the shadow map.
    pub shadow_bytes: u64,
    /// Part of `bytes` for color and normal images, with all mip levels.
    pub image_bytes: u64,
    pub samples: u32,
    pub draws: usize,
    /// Culling counts of the last timed frame, where triangles are culled.
    pub culled: Option<FrameCullStats>,
}

impl RenderRow {
    /// Whether the variant passed or failed as expected.
    pub const fn is_as_expected(&self) -> bool {
        self.passed != self.to_fail
    }

    /// Median time of a frame in microseconds.
    pub fn median_us(&self) -> Option<f64> {
        self.passes.iter().find(|pass| pass.name == "frame").map(|pass| pass.timing.median_us)
    }
}

/// References of a load's still image.
struct References {
    hard: ReferenceImage,
    /// The intended result of each variant.
    intended: Vec<ReferenceImage>,
    texel_size: Option<ShadowTexelSize>,
}

/// Data that all variants of a load share.
struct WorkloadContext<'a> {
    request: &'a RenderReportOptions,
    animation: AnimatedScene,
    camera: Camera,
    variants: Vec<RenderVariant>,
    references: References,
    /// Light-meter frame of the still scene without shadows.
    unshadowed: FrameImage,
    moving: MovingReferences,
}

/// References of the moving scene per step, unshadowed and with hard shadows; or the reason why there are none.
type MovingReferences = std::result::Result<Vec<[ReferenceImage; 2]>, String>;

/// All results of one load.
pub(super) struct WorkloadResult {
    pub(super) summary: RenderWorkloadSummary,
    pub(super) rows: Vec<RenderRow>,
    /// `None` when no row was timed with a default variance map.
    pub(super) minimal_passes: Option<MinimalPasses>,
    pub(super) files: Vec<ImageFile>,
}

/// Measures every requested variant on one load.
pub(super) fn measure_workload(
    harness: &mut RenderHarness,
    request: &RenderReportOptions,
    workload: RenderWorkload,
    progress: &mut dyn FnMut(&str),
) -> Result<WorkloadResult> {
    let animation = workload.build()?;
    let camera = animation.camera(request.size);
    let mut variants = request.selected_variants();
    variants.retain(|variant| variant.is_applicable(workload));
    progress(&format!("{}: tracing the references of the still image", animation.name));
    let begin = Instant::now();
    let references = trace_references(harness, request, &animation, camera, &variants)?;
    let reference_ms = begin.elapsed().as_secs_f64() * 1e3;
    progress(&format!("{}: tracing the references of the moving scene", animation.name));
    let moving = trace_moving_references(harness, request, &animation)?;
    let without_shadow =
        light_meter::with_settings(&animation.scene, RenderSettings { shadow: None, ..animation.scene.look })?;
    let unshadowed = draw_still(harness, &light_meter::meter_scene(&without_shadow)?, &animation, request)?;
    let context = WorkloadContext { request, animation, camera, variants, references, unshadowed, moving };
    let mut files = vec![context.reference_file("hard", &context.references.hard)?];
    files.push(context.light_file()?);
    let mut rows = Vec::new();
    for index in 0..context.variants.len() {
        progress(&format!("{}: {}", context.animation.name, context.variants[index].name));
        harness.renderer.set_blur_method(context.variants[index].blur_method);
        let (row, strip) = context.measure(harness, index)?;
        rows.push(row);
        files.push(strip);
    }
    harness.renderer.set_blur_method(BlurMethod::Auto);
    progress(&format!("{}: timing the minimal passes", context.animation.name));
    let minimal_passes = context.time_minimal_passes(harness, &rows)?;
    Ok(WorkloadResult { summary: context.summarize(reference_ms), rows, minimal_passes, files })
}

fn sample_counts(request: &RenderReportOptions) -> SampleCounts {
    if request.quick { SampleCounts::QUICK } else { SampleCounts::FULL }
}

fn trace_references(
    harness: &mut RenderHarness,
    request: &RenderReportOptions,
    animation: &AnimatedScene,
    camera: Camera,
    variants: &[RenderVariant],
) -> Result<References> {
    let mut loaded_scene = harness.load(&animation.scene)?;
    harness.deform(&mut loaded_scene, &animation.state(STILL))?;
    let frame_params = loaded_scene.frame_params(camera, request.size);
    let ray_scene = RayScene::new(&animation.scene, loaded_scene.surface()?);
    let view = View::new(loaded_scene.scene(), &frame_params);
    let mut terms = vec![SunTerm::Hard];
    for variant in variants {
        let scene = light_meter::with_settings(&animation.scene, variant.settings(animation.scene.look))?;
        terms.push(intended_sun_term(variant, shadow_texel_axes(&scene, &frame_params)));
    }
    let mut images = trace(&ray_scene, &view, &terms, sample_counts(request));
    harness.unload(loaded_scene);
    let intended = images.split_off(1);
    Ok(References {
        hard: images.pop().unwrap_or_default(),
        intended,
        texel_size: ShadowTexelSize::measure(&animation.scene, &frame_params),
    })
}

fn intended_sun_term(variant: &RenderVariant, texel_axes: Option<[Vector3<f64>; 2]>) -> SunTerm {
    match (variant.intended, texel_axes) {
        (ReferenceKind::Hard, _) => SunTerm::Hard,
        (ReferenceKind::Filtered { texels }, Some(axes)) => SunTerm::Filtered(axes.map(|axis| axis * texels)),
        _ => SunTerm::Unshadowed,
    }
}

/// Size of the images of the moving scene.
fn moving_size(size: Size) -> Size {
    Size { width: (size.width / MOVING_SIZE_DIVISOR).max(1), height: (size.height / MOVING_SIZE_DIVISOR).max(1) }
}

/// Traces the references of every step, with a quarter of the samples of a still image.
fn trace_moving_references(
    harness: &mut RenderHarness,
    request: &RenderReportOptions,
    animation: &AnimatedScene,
) -> Result<MovingReferences> {
    let size = moving_size(request.size);
    let camera = animation.camera(size);
    let mut loaded_scene = harness.load(&animation.scene)?;
    let (mut images, mut previous, mut stop_reason) = (Vec::new(), None::<RayScene>, None);
    let mut time_budget = TimeBudget::new(STEP_TIME_BUDGET, FLICKER_STEPS);
    for step in 0..FLICKER_STEPS {
        harness.deform(&mut loaded_scene, &animation.state(step))?;
        let view = View::new(loaded_scene.scene(), &loaded_scene.frame_params(camera, size));
        let ray_scene = match previous.take() {
            Some(ray_scene) => ray_scene.refit(&animation.scene, loaded_scene.surface()?),
            None => RayScene::new(&animation.scene, loaded_scene.surface()?),
        };
        let counts = SampleCounts { taps: 1, ..SampleCounts::QUICK };
        if let Ok(pair) = trace(&ray_scene, &view, &[SunTerm::Unshadowed, SunTerm::Hard], counts).try_into() {
            images.push(pair);
        }
        previous = Some(ray_scene);
        stop_reason = time_budget.finish_step("references");
        if stop_reason.is_some() {
            break;
        }
    }
    harness.unload(loaded_scene);
    Ok(stop_reason.map_or(Ok(images), Err))
}

/// Draws the still image of a scene.
fn draw_still(
    harness: &mut RenderHarness,
    scene: &Arc<Scene>,
    animation: &AnimatedScene,
    request: &RenderReportOptions,
) -> Result<FrameImage> {
    let mut loaded_scene = harness.load(scene)?;
    harness.deform(&mut loaded_scene, &animation.state(STILL))?;
    let image = harness.draw(&loaded_scene, animation.camera(request.size), request.size);
    harness.unload(loaded_scene);
    image
}

impl WorkloadContext<'_> {
    fn summarize(&self, reference_ms: f64) -> RenderWorkloadSummary {
        let (layout, counts) = (&self.animation.scene.layout, sample_counts(self.request));
        RenderWorkloadSummary {
            name: self.animation.name.clone(),
            vertices: layout.vertices,
            triangles: layout.triangles,
            domains: self.animation.scene.domains.len(),
            samples: counts.side * counts.side,
            taps: counts.taps,
            reference_ms,
            texels: self.references.texel_size,
            steps: self.moving.as_ref().map_or(0, Vec::len),
            no_flicker: self.moving.as_ref().err().cloned(),
            steps_size: moving_size(self.request.size),
        }
    }

    /// Compares the still image and sun visibility of variant `index` with the references; if it passes, measures its
    /// times and flicker.
    fn measure(&self, harness: &mut RenderHarness, index: usize) -> Result<(RenderRow, ImageFile)> {
        let (variant, reference) = (&self.variants[index], &self.references.intended[index]);
        let mut scene = light_meter::with_settings(&self.animation.scene, variant.settings(self.animation.scene.look))?;
        if let Some(packing) = variant.packing {
            scene = pack_images(&scene, packing)?;
        }
        let shadowed = draw_still(harness, &light_meter::meter_scene(&scene)?, &self.animation, self.request)?;
        let sun_visibility = light_meter::read_sun_visibility(&shadowed.rgba, &self.unshadowed.rgba);
        let mut loaded_scene = harness.load(&scene)?;
        harness.deform(&mut loaded_scene, &self.animation.state(STILL))?;
        let image = harness.draw(&loaded_scene, self.camera, self.request.size)?;
        let stats = harness.renderer.stats().clone();
        let mut row = self.compare(variant, (&image, &sun_visibility), reference);
        (row.samples, row.draws) = (stats.samples, stats.draw_calls);
        let plan = loaded_scene.buffers.plan();
        row.bytes = plan.bytes();
        let texture_bytes = |prefixes: &[&str]| -> u64 {
            let has_prefix = |name: &str| prefixes.iter().any(|prefix| name.starts_with(prefix));
            let textures = plan.textures.iter().filter(|texture| has_prefix(texture.name.as_ref()));
            textures.map(|texture| texture.bytes).sum()
        };
        (row.shadow_bytes, row.image_bytes) = (texture_bytes(&["shadow"]), texture_bytes(&["color", "normal"]));
        if row.passed {
            row.passes = harness.time(&loaded_scene, self.camera, self.request.size, self.request.replays)?;
            row.culled = harness.renderer.stats().culled;
            match self.measure_flicker(harness, &mut loaded_scene, variant)? {
                Ok(flicker) => row.flicker = Some(flicker),
                Err(reason) => row.no_flicker = Some(reason),
            }
        }
        harness.unload(loaded_scene);
        let file = image_files::encode_strip(
            &self.file_name(&variant.name),
            self.request.size,
            (&image.rgba, &reference.colors),
        )?;
        Ok((row, file))
    }

    /// Times the passes of the scene stripped to its mesh. Frames with the largest timed variance map of default settings
    /// are the baseline.
    fn time_minimal_passes(&self, harness: &mut RenderHarness, rows: &[RenderRow]) -> Result<Option<MinimalPasses>> {
        let timed_default_shadow = |row: &RenderRow| {
            let is_default =
                |shadow: &ShadowSettings| *shadow == ShadowSettings { size: shadow.size, ..ShadowSettings::default() };
            row.shadow.filter(is_default).filter(|_| row.median_us().is_some())
        };
        let Some(shadow) = rows.iter().filter_map(timed_default_shadow).max_by_key(|shadow| shadow.size) else {
            return Ok(None);
        };
        let scene = minimal_passes::strip_to_mesh(&self.animation.scene, shadow.size)?;
        let passes = self.time_passes(harness, &scene)?;
        let stats = harness.renderer.stats().clone();
        let timing = |name: &str| passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
        let Some((depth, visibility)) = timing("shadow").zip(timing("visibility")) else { return Ok(None) };
        if !minimal_passes::is_minimal(&stats) {
            tracing::warn!(
                load = self.animation.name,
                "expected one draw per pass of the stripped scene, got more; minimal passes are not reported"
            );
            return Ok(None);
        }
        let passes = MinimalPasses {
            load: self.animation.name.clone(),
            triangles: scene.layout.triangles,
            map: shadow.size,
            samples: stats.samples,
            depth,
            visibility,
            unculled: self.frame_baseline(harness, rows, (shadow, Culling::None))?,
            default_culling: self.frame_baseline(harness, rows, (shadow, self.animation.scene.look.culling))?,
        };
        Ok(Some(passes.with_frame_differences()))
    }

    /// Time of a frame with this shadow map and culling: that of an existing row, or a new measurement.
    fn frame_baseline(
        &self,
        harness: &mut RenderHarness,
        rows: &[RenderRow],
        (shadow, culling): (ShadowSettings, Culling),
    ) -> Result<FrameBaseline> {
        // A row with automatic culling counts as not culled if no triangles were culled.
        let matches = |row: &&RenderRow| {
            let has_culling = row.culling == culling || culling == Culling::None && row.culled.is_none();
            row.shadow == Some(shadow) && has_culling
        };
        let found = rows.iter().filter(matches).find_map(|row| Some((row.name.clone(), row.median_us()?)));
        let (name, frame_us) = match found {
            Some(found) => found,
            None => {
                let look = RenderSettings { shadow: Some(shadow), culling, ..self.animation.scene.look };
                let passes = self.time_passes(harness, &light_meter::with_settings(&self.animation.scene, look)?)?;
                let frame = passes.iter().find(|pass| pass.name == "frame").map_or(0.0, |pass| pass.timing.median_us);
                (format!("variance {}, blur {}", shadow.size, shadow.blur), frame)
            }
        };
        let culling_name = if culling == Culling::None { "without culling" } else { "as the load culls" };
        Ok(FrameBaseline { name: format!("{name}: {culling_name}"), frame_us, beyond_us: 0.0 })
    }

    /// Times the passes of the still image of a scene.
    fn time_passes(&self, harness: &mut RenderHarness, scene: &Arc<Scene>) -> Result<Vec<PassTime>> {
        let mut loaded_scene = harness.load(scene)?;
        harness.deform(&mut loaded_scene, &self.animation.state(STILL))?;
        let passes = harness.time(&loaded_scene, self.camera, self.request.size, self.request.replays);
        harness.unload(loaded_scene);
        passes
    }

    /// The row of a variant without times and flicker.
    fn compare(
        &self,
        variant: &RenderVariant,
        (image, sun_visibility): (&FrameImage, &[Option<f32>]),
        reference: &ReferenceImage,
    ) -> RenderRow {
        let hard = &self.references.hard;
        let color_of_reference = metrics::compare_colors(&image.rgba, &reference.colors);
        let light_of_aim = metrics::compare_light(sun_visibility, &reference.light);
        let bounds = variant.bounds(self.animation.workload);
        let faults = exceeded_bounds(&color_of_reference, &light_of_aim, &bounds);
        RenderRow {
            load: self.animation.name.clone(),
            name: variant.name.clone(),
            method: variant.method,
            shadow: variant.shadow,
            blur_method: variant.blur_method,
            packing: variant.packing,
            culling: variant.settings(self.animation.scene.look).culling,
            bounds,
            passed: faults.is_empty(),
            to_fail: variant.is_expected_to_fail(self.animation.workload),
            faults,
            color: metrics::compare_colors(&image.rgba, &hard.colors),
            color_of_reference,
            light: metrics::compare_light(sun_visibility, &hard.light),
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
    fn measure_flicker(
        &self,
        harness: &mut RenderHarness,
        loaded_scene: &mut LoadedScene,
        variant: &RenderVariant,
    ) -> Result<std::result::Result<ErrorDistribution, String>> {
        let moving = match &self.moving {
            Ok(moving) => moving,
            Err(reason) => return Ok(Err(reason.clone())),
        };
        let size = moving_size(self.request.size);
        let camera = self.animation.camera(size);
        let mut flicker = Flicker::default();
        let mut time_budget = TimeBudget::new(STEP_TIME_BUDGET, FLICKER_STEPS);
        for (step, [unshadowed, hard]) in moving.iter().enumerate() {
            harness.deform(loaded_scene, &self.animation.state(step))?;
            let image = harness.draw(loaded_scene, camera, size)?;
            let reference = if variant.intended == ReferenceKind::Unshadowed { unshadowed } else { hard };
            flicker.push(&image.rgba, &reference.colors);
            if let Some(reason) = time_budget.finish_step("frames") {
                return Ok(Err(reason));
            }
        }
        Ok(Ok(flicker.into_distribution()))
    }

    fn file_name(&self, image_name: &str) -> String {
        format!("{}-{}", self.animation.name, image_name.replace(", ", "-").replace(' ', "-"))
    }

    fn reference_file(&self, name: &str, image: &ReferenceImage) -> Result<ImageFile> {
        image_files::encode_reference(&self.file_name(name), self.request.size, &image.colors)
    }

    /// Sun visibility of the hard reference as a gray image; blue where it is undefined.
    fn light_file(&self) -> Result<ImageFile> {
        let shade = |light: &Option<f32>| light.map_or([60.0, 70.0, 110.0], |light| [255.0 * light; 3]);
        let colors: Vec<[f32; 3]> = self.references.hard.light.iter().map(shade).collect();
        image_files::encode_reference(&self.file_name("hard light"), self.request.size, &colors)
    }
}

/// Messages about exceeded bounds.
fn exceeded_bounds(color: &ErrorDistribution, light: &LightErrors, bounds: &ErrorLimits) -> Vec<String> {
    let errors = [
        ("mean color error", Some(color.mean), bounds.mean_color),
        ("mean sun visibility error", Some(light.all.mean), bounds.mean_light),
        ("mean sun visibility in the umbra", light.in_umbra, bounds.bleeding),
        ("mean sun visibility lost outside of shadows", light.lost, bounds.lost),
    ];
    let message = |(quantity, error, bound): (&str, Option<f64>, f64)| {
        let error = error.filter(|error| error.is_nan() || *error > bound)?;
        Some(format!("{quantity}: expected at most {bound}, got {error:.3}"))
    };
    errors.into_iter().filter_map(message).collect()
}

#[cfg(test)]
mod tests {
    use super::super::variants::ERROR_LIMITS;
    use super::*;

    #[test]
    fn detects_missing_dark_or_displaced_small_shadows() {
        let shadow = |first: usize| -> Vec<Option<f32>> {
            (0..1000).map(|pixel| Some(if (first..first + 10).contains(&pixel) { 0.0 } else { 1.0 })).collect()
        };
        let check = |visibility: &[Option<f32>]| {
            exceeded_bounds(
                &ErrorDistribution::default(),
                &metrics::compare_light(visibility, &shadow(100)),
                &ERROR_LIMITS,
            )
        };
        assert_eq!(check(&shadow(100)), Vec::<String>::new(), "control: equal to the reference");
        assert_eq!(
            check(&shadow(102)),
            Vec::<String>::new(),
            "a displacement by a fifth of the shadow's width is within the bound"
        );
        for wrong in [shadow(200), vec![Some(1.0); 1000], shadow(105)] {
            assert!(check(&wrong)[0].starts_with("mean sun visibility in the umbra"), "{:?}", check(&wrong));
        }
        assert!(check(&vec![Some(0.5); 1000]).iter().any(|message| message.starts_with("mean sun visibility lost")));
        let undefined = ErrorDistribution { mean: f64::NAN, ..ErrorDistribution::default() };
        assert_eq!(
            exceeded_bounds(&undefined, &LightErrors::default(), &ERROR_LIMITS).len(),
            1,
            "NaN exceeds every bound"
        );
    }
}
