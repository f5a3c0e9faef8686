//! Measures one workload: traces its references, compares every variant with them, then measures frame times and
//! flicker.

use std::sync::Arc;
use std::time::Instant;

use nalgebra::Vector3;
use serde::Serialize;

use super::error_limits::ErrorLimits;
use super::harness::{LoadedScene, PassTime, RenderHarness, Size};
use super::image_files::{self, ImageFile};
use super::metrics::{self, ErrorDistribution, FlickerMeter, LightErrors};
use super::minimal_passes::{self, FrameBaseline, MinimalPasses};
use super::packing::{Packing, pack_images};
use super::ray_scene::RayScene;
use super::reference_image::{ReferenceImage, SampleCounts, ShadowModel, trace_reference_images};
use super::reference_view::ReferenceView;
use super::time_budget::{STEP_TIME_BUDGET, TimeBudget};
use super::variants::{ReferenceKind, RenderVariant, ShadowVariant};
use super::workloads::{AnimatedScene, RenderWorkload};
use super::{RenderReportOptions, RenderWorkloadSummary, ShadowTexelSize, light_meter};
use crate::timing::Timing;
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, Culling, RenderSettings, Scene, ShadowSettings};
use modalcast_render::{BlurMethod, FrameCullStats, FrameImage, shadow_texel_axes};

/// Step of the motion that still images show. Any step at which the modes are displaced would do.
pub(super) const STILL_STEP: usize = 10;
/// Steps over which flicker is measured.
const FLICKER_STEPS: usize = 60;
/// Still images are larger than images of moving scenes by this factor per side.
const MOVING_SIZE_DIVISOR: u32 = 4;

/// Results of one variant on one workload.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RenderRow {
    /// Name of the workload.
    pub load: String,
    /// Name of the variant.
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
    /// Limits of the error against the intended result.
    pub error_limits: ErrorLimits,
    /// Whether the variant is within its limits.
    pub passed: bool,
    /// Whether the variant is expected to fail. The report fails if it passes.
    #[serde(rename = "to_fail")]
    pub is_expected_to_fail: bool,
    /// Messages about the limits that the variant exceeds.
    pub faults: Vec<String>,
    /// Color errors against the reference with hard shadows, which is exact for a point light.
    #[serde(rename = "color")]
    pub color_errors: ErrorDistribution,
    /// Color errors against the intended result.
    #[serde(rename = "color_of_aim")]
    pub intended_color_errors: ErrorDistribution,
    /// Color errors against the intended result, of the pixels that show triangles.
    #[serde(rename = "color_of_surfaces")]
    pub surface_color_errors: ErrorDistribution,
    /// Errors of the sun visibility against the reference with hard shadows.
    #[serde(rename = "light")]
    pub light_errors: LightErrors,
    /// Errors of the sun visibility against the intended result.
    #[serde(rename = "light_of_aim")]
    pub intended_light_errors: LightErrors,
    /// `None` when the variant failed or flicker was skipped.
    pub flicker: Option<ErrorDistribution>,
    /// Reason why the flicker of a variant that passed was not measured.
    #[serde(rename = "no_flicker")]
    pub flicker_skip_reason: Option<String>,
    /// Times per pass; "frame" is the sum without readback. Empty when the variant failed.
    pub passes: Vec<PassTime>,
    /// Device memory of the scene.
    pub bytes: u64,
    /// Part of `bytes` for the textures of the shadow map.
    pub shadow_bytes: u64,
    /// Part of `bytes` for color and normal images, with all mip levels.
    pub image_bytes: u64,
    /// Samples per pixel of the frame.
    pub samples: u32,
    /// Number of draw calls of the visibility and blended passes.
    pub draws: usize,
    /// Culling counts of the last timed frame; `None` if culling is off.
    #[serde(rename = "culled")]
    pub cull_stats: Option<FrameCullStats>,
}

impl RenderRow {
    /// Whether the variant passed or failed as expected.
    pub const fn is_as_expected(&self) -> bool {
        self.passed != self.is_expected_to_fail
    }

    /// Median time of a frame in microseconds.
    pub fn median_us(&self) -> Option<f64> {
        self.frame_timing().map(|timing| timing.median_us)
    }

    /// Time of a frame.
    pub fn frame_timing(&self) -> Option<Timing> {
        self.passes.iter().find(|pass| pass.name == "frame").map(|pass| pass.timing)
    }
}

/// References of a workload's still image.
struct References {
    /// With hard shadows.
    hard_image: ReferenceImage,
    /// The intended result of each variant.
    intended_images: Vec<ReferenceImage>,
    texel_size: Option<ShadowTexelSize>,
}

/// Data that all variants of a workload share.
struct WorkloadContext<'a> {
    options: &'a RenderReportOptions,
    animation: AnimatedScene,
    camera: Camera,
    variants: Vec<RenderVariant>,
    references: References,
    /// Frame of the still scene with white surfaces and without shadows; see [`light_meter`].
    unshadowed: FrameImage,
    moving: MovingReferences,
}

/// References of the moving scene, one pair per step: without shadows, and with hard shadows. `Err` is the reason why
/// they were not traced.
type MovingReferences = std::result::Result<Vec<[ReferenceImage; 2]>, String>;

/// All results of one workload.
pub(super) struct WorkloadResult {
    pub(super) summary: RenderWorkloadSummary,
    pub(super) rows: Vec<RenderRow>,
    /// `None` when no row with a default variance map was timed.
    pub(super) minimal_passes: Option<MinimalPasses>,
    pub(super) files: Vec<ImageFile>,
}

/// Measures every selected variant on one workload.
pub(super) fn measure_workload(
    harness: &mut RenderHarness,
    options: &RenderReportOptions,
    workload: RenderWorkload,
    progress: &mut dyn FnMut(&str),
) -> Result<WorkloadResult> {
    let animation = workload.build()?;
    let camera = animation.camera(options.size);
    let mut variants = options.selected_variants();
    variants.retain(|variant| variant.is_applicable(workload));
    progress(&format!("{}: tracing the references of the still image", animation.name));
    let trace_begin = Instant::now();
    let references = trace_references(harness, options, &animation, camera, &variants)?;
    let reference_ms = trace_begin.elapsed().as_secs_f64() * 1e3;
    progress(&format!("{}: tracing the references of the moving scene", animation.name));
    let moving = trace_moving_references(harness, options, &animation)?;
    let without_shadow =
        light_meter::with_settings(&animation.scene, RenderSettings { shadow: None, ..animation.scene.look })?;
    let unshadowed = draw_still(harness, &light_meter::meter_scene(&without_shadow)?, &animation, options)?;
    let context = WorkloadContext { options, animation, camera, variants, references, unshadowed, moving };
    let mut files = vec![context.encode_reference("hard", &context.references.hard_image)?];
    files.push(context.encode_sun_visibility()?);
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

fn sample_counts(options: &RenderReportOptions) -> SampleCounts {
    if options.quick { SampleCounts::QUICK } else { SampleCounts::FULL }
}

fn trace_references(
    harness: &mut RenderHarness,
    options: &RenderReportOptions,
    animation: &AnimatedScene,
    camera: Camera,
    variants: &[RenderVariant],
) -> Result<References> {
    let mut loaded_scene = harness.load(&animation.scene)?;
    harness.deform(&mut loaded_scene, &animation.state(STILL_STEP))?;
    let frame_params = loaded_scene.frame_params(camera, options.size);
    let ray_scene = RayScene::new(&animation.scene, loaded_scene.surface()?);
    let view = ReferenceView::new(loaded_scene.scene(), &frame_params);
    let mut shadow_models = vec![ShadowModel::Hard];
    for variant in variants {
        let scene = light_meter::with_settings(&animation.scene, variant.settings(animation.scene.look))?;
        shadow_models.push(intended_shadow_model(variant, shadow_texel_axes(&scene, &frame_params)));
    }
    let mut images = trace_reference_images(&ray_scene, &view, &shadow_models, sample_counts(options));
    harness.unload(loaded_scene);
    // The first image has hard shadows; the other images are the intended results, in the order of the variants.
    let intended_images = images.split_off(1);
    Ok(References {
        hard_image: images.pop().unwrap_or_default(),
        intended_images,
        texel_size: ShadowTexelSize::measure(&animation.scene, &frame_params),
    })
}

fn intended_shadow_model(variant: &RenderVariant, texel_axes: Option<[Vector3<f64>; 2]>) -> ShadowModel {
    match (variant.intended_reference, texel_axes) {
        (ReferenceKind::Hard, _) => ShadowModel::Hard,
        (ReferenceKind::Filtered { texels }, Some(axes)) => ShadowModel::Filtered(axes.map(|axis| axis * texels)),
        _ => ShadowModel::Unshadowed,
    }
}

/// Size of the images of the moving scene.
fn moving_size(size: Size) -> Size {
    Size { width: (size.width / MOVING_SIZE_DIVISOR).max(1), height: (size.height / MOVING_SIZE_DIVISOR).max(1) }
}

/// Traces the references of every step with the sample counts of a quick run, because there are many steps.
fn trace_moving_references(
    harness: &mut RenderHarness,
    options: &RenderReportOptions,
    animation: &AnimatedScene,
) -> Result<MovingReferences> {
    let size = moving_size(options.size);
    let camera = animation.camera(size);
    let mut loaded_scene = harness.load(&animation.scene)?;
    let (mut images, mut previous_scene, mut stop_reason) = (Vec::new(), None::<RayScene>, None);
    let mut time_budget = TimeBudget::new(STEP_TIME_BUDGET, FLICKER_STEPS);
    for step in 0..FLICKER_STEPS {
        harness.deform(&mut loaded_scene, &animation.state(step))?;
        let view = ReferenceView::new(loaded_scene.scene(), &loaded_scene.frame_params(camera, size));
        let ray_scene = match previous_scene.take() {
            Some(ray_scene) => ray_scene.refit(&animation.scene, loaded_scene.surface()?),
            None => RayScene::new(&animation.scene, loaded_scene.surface()?),
        };
        let counts = SampleCounts { taps: 1, ..SampleCounts::QUICK };
        let step_images =
            trace_reference_images(&ray_scene, &view, &[ShadowModel::Unshadowed, ShadowModel::Hard], counts);
        // The conversion cannot fail, because two shadow models give two images.
        if let Ok(pair) = step_images.try_into() {
            images.push(pair);
        }
        previous_scene = Some(ray_scene);
        stop_reason = time_budget.finish_step("references");
        if stop_reason.is_some() {
            break;
        }
    }
    harness.unload(loaded_scene);
    Ok(match stop_reason {
        Some(reason) => Err(reason),
        None => Ok(images),
    })
}

/// Draws the still image of a scene.
fn draw_still(
    harness: &mut RenderHarness,
    scene: &Arc<Scene>,
    animation: &AnimatedScene,
    options: &RenderReportOptions,
) -> Result<FrameImage> {
    let mut loaded_scene = harness.load(scene)?;
    harness.deform(&mut loaded_scene, &animation.state(STILL_STEP))?;
    let image = harness.draw(&loaded_scene, animation.camera(options.size), options.size);
    harness.unload(loaded_scene);
    image
}

impl WorkloadContext<'_> {
    fn summarize(&self, reference_ms: f64) -> RenderWorkloadSummary {
        let (layout, counts) = (&self.animation.scene.layout, sample_counts(self.options));
        RenderWorkloadSummary {
            name: self.animation.name.clone(),
            vertices: layout.vertices,
            triangles: layout.triangles,
            domains: self.animation.scene.domains.len(),
            samples: counts.samples_per_side * counts.samples_per_side,
            taps: counts.taps,
            reference_ms,
            texel_size: self.references.texel_size,
            steps: self.moving.as_ref().map_or(0, Vec::len),
            flicker_skip_reason: self.moving.as_ref().err().cloned(),
            steps_size: moving_size(self.options.size),
        }
    }

    /// Compares the still image and the sun visibility of variant `index` with the references. If the variant passes,
    /// measures its times and flicker.
    fn measure(&self, harness: &mut RenderHarness, index: usize) -> Result<(RenderRow, ImageFile)> {
        let (variant, reference) = (&self.variants[index], &self.references.intended_images[index]);
        let mut scene = light_meter::with_settings(&self.animation.scene, variant.settings(self.animation.scene.look))?;
        if let Some(packing) = variant.packing {
            scene = pack_images(&scene, packing)?;
        }
        let shadowed = draw_still(harness, &light_meter::meter_scene(&scene)?, &self.animation, self.options)?;
        let sun_visibility = light_meter::read_sun_visibility(&shadowed.rgba, &self.unshadowed.rgba);
        let mut loaded_scene = harness.load(&scene)?;
        harness.deform(&mut loaded_scene, &self.animation.state(STILL_STEP))?;
        let image = harness.draw(&loaded_scene, self.camera, self.options.size)?;
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
            row.passes = harness.time_passes(&loaded_scene, self.camera, self.options.size, self.options.replays)?;
            row.cull_stats = harness.renderer.stats().culled;
            match self.measure_flicker(harness, &mut loaded_scene, variant)? {
                Ok(flicker) => row.flicker = Some(flicker),
                Err(reason) => row.flicker_skip_reason = Some(reason),
            }
        }
        harness.unload(loaded_scene);
        let file = image_files::encode_strip(
            &self.file_name(&variant.name),
            self.options.size,
            (&image.rgba, &reference.colors),
        )?;
        Ok((row, file))
    }

    /// Times the passes of the scene stripped to its mesh, and the frames that the passes are compared with. The shadow
    /// map is as large as the largest map of the timed rows. Rows count only if all their shadow settings except for
    /// the size are the defaults.
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
        let passes = self.time_still_passes(harness, &scene)?;
        let stats = harness.renderer.stats().clone();
        let timing = |name: &str| passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
        let Some((depth, visibility)) = timing("shadow").zip(timing("visibility")) else { return Ok(None) };
        if !minimal_passes::is_minimal(&stats) {
            tracing::warn!(
                load = self.animation.name,
                "expected a shadow pass without blur and one draw of ids, got others; minimal passes are not reported"
            );
            return Ok(None);
        }
        let passes = MinimalPasses {
            load: self.animation.name.clone(),
            triangles: scene.layout.triangles,
            map_size: shadow.size,
            samples: stats.samples,
            depth,
            visibility,
            without_culling: self.frame_baseline(harness, rows, (shadow, Culling::None))?,
            with_scene_culling: self.frame_baseline(harness, rows, (shadow, self.animation.scene.look.culling))?,
        };
        Ok(Some(passes.with_frame_excess()))
    }

    /// Time of a frame with this shadow map and culling. It is taken from a timed row with the same settings if there
    /// is one, and otherwise measured now.
    fn frame_baseline(
        &self,
        harness: &mut RenderHarness,
        rows: &[RenderRow],
        (shadow, culling): (ShadowSettings, Culling),
    ) -> Result<FrameBaseline> {
        // A row with automatic culling counts as not culled if no triangles were culled.
        let has_same_settings = |row: &&RenderRow| {
            let has_same_culling = row.culling == culling || culling == Culling::None && row.cull_stats.is_none();
            row.shadow == Some(shadow) && has_same_culling
        };
        let timed_row =
            rows.iter().filter(has_same_settings).find_map(|row| Some((row.name.clone(), row.median_us()?)));
        let (name, frame_us) = match timed_row {
            Some(name_and_time) => name_and_time,
            None => {
                let settings = RenderSettings { shadow: Some(shadow), culling, ..self.animation.scene.look };
                let passes =
                    self.time_still_passes(harness, &light_meter::with_settings(&self.animation.scene, settings)?)?;
                let frame_us =
                    passes.iter().find(|pass| pass.name == "frame").map_or(0.0, |pass| pass.timing.median_us);
                (format!("variance {}, blur {}", shadow.size, shadow.blur), frame_us)
            }
        };
        let culling_name = if culling == Culling::None { "without culling" } else { "as the load culls" };
        Ok(FrameBaseline { name: format!("{name}: {culling_name}"), frame_us, excess_us: 0.0 })
    }

    /// Times the passes of the still image of a scene.
    fn time_still_passes(&self, harness: &mut RenderHarness, scene: &Arc<Scene>) -> Result<Vec<PassTime>> {
        let mut loaded_scene = harness.load(scene)?;
        harness.deform(&mut loaded_scene, &self.animation.state(STILL_STEP))?;
        let passes = harness.time_passes(&loaded_scene, self.camera, self.options.size, self.options.replays);
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
        let hard_image = &self.references.hard_image;
        let intended_color_errors = metrics::compare_colors(&image.rgba, &reference.colors);
        let surface_color_errors =
            metrics::compare_colors_where(&image.rgba, &reference.colors, &reference.shows_triangle);
        let intended_light_errors = metrics::compare_light(sun_visibility, &reference.sun_visibility);
        let error_limits = ErrorLimits::of(variant, self.animation.workload);
        let color_errors = [&intended_color_errors, &surface_color_errors];
        let faults = exceeded_limits(color_errors, &intended_light_errors, &error_limits);
        RenderRow {
            load: self.animation.name.clone(),
            name: variant.name.clone(),
            method: variant.method,
            shadow: variant.shadow,
            blur_method: variant.blur_method,
            packing: variant.packing,
            culling: variant.settings(self.animation.scene.look).culling,
            error_limits,
            passed: faults.is_empty(),
            is_expected_to_fail: variant.is_expected_to_fail(self.animation.workload),
            faults,
            color_errors: metrics::compare_colors(&image.rgba, &hard_image.colors),
            intended_color_errors,
            surface_color_errors,
            light_errors: metrics::compare_light(sun_visibility, &hard_image.sun_visibility),
            intended_light_errors,
            flicker: None,
            flicker_skip_reason: None,
            passes: Vec::new(),
            bytes: 0,
            shadow_bytes: 0,
            image_bytes: 0,
            samples: 0,
            draws: 0,
            cull_stats: None,
        }
    }

    /// The flicker of a variant, or the reason why the measurement was skipped.
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
        let size = moving_size(self.options.size);
        let camera = self.animation.camera(size);
        let mut flicker = FlickerMeter::default();
        let mut time_budget = TimeBudget::new(STEP_TIME_BUDGET, FLICKER_STEPS);
        for (step, [unshadowed, hard]) in moving.iter().enumerate() {
            harness.deform(loaded_scene, &self.animation.state(step))?;
            let image = harness.draw(loaded_scene, camera, size)?;
            // The references of the moving scene have no filtered shadows.
            let reference = if variant.intended_reference == ReferenceKind::Unshadowed { unshadowed } else { hard };
            flicker.add_frame(&image.rgba, &reference.colors);
            if let Some(reason) = time_budget.finish_step("frames") {
                return Ok(Err(reason));
            }
        }
        Ok(Ok(flicker.into_distribution()))
    }

    fn file_name(&self, image_name: &str) -> String {
        format!("{}-{}", self.animation.name, image_name.replace(", ", "-").replace(' ', "-"))
    }

    fn encode_reference(&self, name: &str, image: &ReferenceImage) -> Result<ImageFile> {
        image_files::encode_reference(&self.file_name(name), self.options.size, &image.colors)
    }

    /// Encodes the sun visibility of the hard reference as a gray image; blue where it is undefined.
    fn encode_sun_visibility(&self) -> Result<ImageFile> {
        let color =
            |visibility: &Option<f32>| visibility.map_or([60.0, 70.0, 110.0], |visibility| [255.0 * visibility; 3]);
        let colors: Vec<[f32; 3]> = self.references.hard_image.sun_visibility.iter().map(color).collect();
        image_files::encode_reference(&self.file_name("hard light"), self.options.size, &colors)
    }
}

/// Messages about exceeded limits. The color errors are those of all pixels, and of the pixels that show triangles.
fn exceeded_limits(
    [color, surface_color]: [&ErrorDistribution; 2],
    light: &LightErrors,
    limits: &ErrorLimits,
) -> Vec<String> {
    let surface_limit = limits.mean_surface_color.unwrap_or(f64::INFINITY);
    let errors = [
        ("mean color error", Some(color.mean), limits.mean_color),
        ("mean color error of surfaces", Some(surface_color.mean), surface_limit),
        ("mean sun visibility error", Some(light.all_pixels.mean), limits.mean_light),
        ("mean sun visibility in the umbra", light.umbra_visibility, limits.bleeding),
        ("mean sun visibility lost outside of shadows", light.lost_visibility, limits.lost_visibility),
    ];
    let message = |(quantity, error, limit): (&str, Option<f64>, f64)| {
        let error = error.filter(|error| error.is_nan() || *error > limit)?;
        Some(format!("{quantity}: expected at most {limit}, got {error:.3e}"))
    };
    errors.into_iter().filter_map(message).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sun visibility of 1000 pixels: 0 in a shadow of ten pixels and 1 elsewhere.
    fn visibility_with_shadow(first_pixel: usize) -> Vec<Option<f32>> {
        let shadow = first_pixel..first_pixel + 10;
        (0..1000).map(|pixel| Some(if shadow.contains(&pixel) { 0.0 } else { 1.0 })).collect()
    }

    /// The messages about an image with exact colors and this sun visibility.
    fn find_faults(visibility: &[Option<f32>], limits: &ErrorLimits) -> Vec<String> {
        let light_errors = metrics::compare_light(visibility, &visibility_with_shadow(100));
        exceeded_limits([&ErrorDistribution::default(); 2], &light_errors, limits)
    }

    #[test]
    fn limits_of_the_tree_detect_missing_dark_and_displaced_shadows() {
        let limits = ErrorLimits::of_workload(RenderWorkload::Tree);
        let faults = |visibility: &[Option<f32>]| find_faults(visibility, &limits);
        assert_eq!(faults(&visibility_with_shadow(100)), Vec::<String>::new(), "control: equal to the reference");
        // Shadows that are displaced by a tenth of their width or more, and no shadow.
        for visibility in [101, 105, 200].map(visibility_with_shadow).into_iter().chain([vec![Some(1.0); 1000]]) {
            assert!(
                faults(&visibility)[0].starts_with("mean sun visibility in the umbra"),
                "{:?}",
                faults(&visibility)
            );
        }
        let dark = faults(&vec![Some(0.5); 1000]);
        assert!(dark.iter().any(|message| message.starts_with("mean sun visibility lost")));
        let undefined = ErrorDistribution { mean: f64::NAN, ..ErrorDistribution::default() };
        let colors = [&undefined, &ErrorDistribution::default()];
        assert_eq!(exceeded_limits(colors, &LightErrors::default(), &limits).len(), 1, "NaN exceeds every limit");
    }

    #[test]
    fn bracket_alone_has_a_limit_of_surfaces() {
        let wrong_surfaces = ErrorDistribution { mean: 3.5, ..ErrorDistribution::default() };
        for workload in RenderWorkload::all(false) {
            let colors = [&ErrorDistribution::default(), &wrong_surfaces];
            let faults = exceeded_limits(colors, &LightErrors::default(), &ErrorLimits::of_workload(workload));
            let expected: &[&str] = match workload {
                RenderWorkload::Bracket => &["mean color error of surfaces: expected at most 3, got 3.500e0"],
                _ => &[],
            };
            assert_eq!(faults, expected, "{workload:?}");
        }
    }
}
