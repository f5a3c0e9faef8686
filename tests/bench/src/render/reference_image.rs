//! Traces reference images. Every sample of a pixel is ray-cast, and transparent layers are sorted. Rays to the sun
//! determine shadows, and rays over the hemisphere determine ambient occlusion.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::ambient_occlusion::ambient_visibility;
use super::ray_scene::{Ray, RayScene};
use super::reference_texture::srgb_from_linear;
use super::reference_view::ReferenceView;
use super::sample_pattern;
use super::shade::{self, ShadedPoint};

/// The shadow model: determines the sun visibility of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum ShadowModel {
    /// No shadows: visibility 1.
    Unshadowed,
    /// One ray to the sun.
    Hard,
    /// Fraction of unoccluded rays. The ray origins have a Gaussian distribution in the plane perpendicular to the
    /// light; each of the two vectors is one standard deviation. Origins are projected onto the receiver's tangent
    /// plane. Casters within half of the origin's offset are ignored, because they are probably the curved receiver
    /// itself.
    Filtered([Vector3<f64>; 2]),
}

/// An image with one shadow model.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct ReferenceImage {
    /// sRGB, 0 to 255, not rounded, top row first.
    pub(super) colors: Vec<[f32; 3]>,
    /// Sun visibility per pixel; `None` where the unshadowed sunlight is less than [`MIN_SUNLIGHT`].
    pub(super) sun_visibility: Vec<Option<f32>>,
    /// Whether a sample of the pixel shows a triangle.
    pub(super) shows_triangle: Vec<bool>,
}

/// Minimum unshadowed sunlight for which sun visibility is defined, as a fraction of the maximum.
pub(super) const MIN_SUNLIGHT: f64 = 0.1;

/// Sample counts of a reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SampleCounts {
    /// Samples along each side of a pixel.
    pub(super) samples_per_side: usize,
    /// Rays to the sun per sample of a filtered shadow.
    pub(super) taps: usize,
    /// Rays over the hemisphere per sample, if the scene has ambient occlusion.
    pub(super) ambient_rays: usize,
}

impl SampleCounts {
    /// 64 samples per pixel, with 64 x 16 = 1024 rays per pixel for the ambient occlusion.
    pub(super) const FULL: Self = Self { samples_per_side: 8, taps: 1, ambient_rays: 16 };
    /// 16 samples per pixel, for machines with few cores. Filtered shadows still have 16 x 4 = 64 rays per pixel, and
    /// the ambient occlusion has 16 x 16 = 256.
    pub(super) const QUICK: Self = Self { samples_per_side: 4, taps: 4, ambient_rays: 16 };
}

/// Traces one image per shadow model; camera rays are shared.
pub(super) fn trace_reference_images(
    ray_scene: &RayScene,
    view: &ReferenceView,
    shadow_models: &[ShadowModel],
    counts: SampleCounts,
) -> Vec<ReferenceImage> {
    let samples = sample_pattern::pixel_samples(counts.samples_per_side);
    let pixels: Vec<TracedPixel> = (0..view.width * view.height)
        .into_par_iter()
        .map(|pixel| {
            let position = (pixel % view.width, pixel / view.width);
            trace_pixel(ray_scene, view, shadow_models, position, (&samples, counts))
        })
        .collect();
    let extract_image = |shadow_model: usize| ReferenceImage {
        colors: pixels.iter().map(|pixel| pixel.light[shadow_model].0).collect(),
        sun_visibility: pixels.iter().map(|pixel| pixel.light[shadow_model].1).collect(),
        shows_triangle: pixels.iter().map(|pixel| pixel.shows_triangle).collect(),
    };
    (0..shadow_models.len()).map(extract_image).collect()
}

/// Results of one pixel.
struct TracedPixel {
    /// Color and sun visibility with each shadow model.
    light: Vec<([f32; 3], Option<f32>)>,
    shows_triangle: bool,
}

/// Sums over the samples of a pixel with one shadow model.
#[derive(Debug, Clone, Copy, Default)]
struct PixelSum {
    color: Vector3<f64>,
    /// Sunlight with shadows.
    shadowed: f64,
    /// Sunlight without shadows.
    unshadowed: f64,
}

/// Traces a pixel with each shadow model. `samples` are positions within the pixel.
fn trace_pixel(
    ray_scene: &RayScene,
    view: &ReferenceView,
    shadow_models: &[ShadowModel],
    (x, y): (u32, u32),
    (samples, SampleCounts { taps, ambient_rays, .. }): (&[[f64; 2]], SampleCounts),
) -> TracedPixel {
    let shift = sample_pattern::pixel_shift(x, y);
    let gaussian_samples = sample_pattern::gaussian_samples(samples.len() * taps, shift);
    // No rays without ambient occlusion.
    let ambient_rays = view.occlusion_radius.map_or(0, |_| ambient_rays);
    let cosine_samples = sample_pattern::cosine_samples(samples.len() * ambient_rays, shift);
    let mut sums = vec![PixelSum::default(); shadow_models.len()];
    let mut shows_triangle = false;
    for (index, [dx, dy]) in samples.iter().enumerate() {
        let mut layers = trace_layers(ray_scene, view, &view.ray(f64::from(x) + dx, f64::from(y) + dy));
        shows_triangle |= layers.iter().any(|layer| layer.triangle.is_some());
        // The number of samples is a power of two, so an odd stride visits all points. With the stride 37, neighboring
        // samples get points that are far from each other. The offset 11 is arbitrary.
        let point_index = (index * 37 + 11) % samples.len();
        let sun_samples: Vec<[f64; 2]> = (0..taps).map(|tap| gaussian_samples[point_index * taps + tap]).collect();
        // Only the opaque layer, which is the first, receives ambient occlusion.
        if ambient_rays > 0 {
            let directions: Vec<[f64; 3]> =
                cosine_samples.iter().skip(point_index).step_by(samples.len()).copied().collect();
            let visibility = ambient_visibility(ray_scene, view, &layers[0], &directions);
            layers[0].ambient *= visibility;
        }
        for (sum, shadow_model) in sums.iter_mut().zip(shadow_models) {
            add_sample(sum, &layers, |point| sun_visibility(ray_scene, view, point, *shadow_model, &sun_samples));
        }
    }
    TracedPixel { light: sums.iter().map(|sum| sum.resolve(samples.len())).collect(), shows_triangle }
}

/// The layers along a ray, farthest first: one opaque layer, then every transparent layer in front of it.
fn trace_layers(ray_scene: &RayScene, view: &ReferenceView, ray: &Ray) -> Vec<ShadedPoint> {
    let (near, far) = view.depth_range;
    let mut opaque = ray_scene.nearest_hit(ray, (near, far), |hit| ray_scene.is_opaque(hit));
    let ground = view.intersect_ground(ray);
    // A triangle in the plane of the ground hides the ground, so the ground must be nearer by a tolerance.
    if let (Some(hit), Some(t)) = (opaque, ground)
        && hit.t > t + 1e-6 * ray_scene.radius
    {
        opaque = None;
    }
    let (background, max_t) = match (opaque, ground) {
        (Some(hit), _) => (shade::shade_triangle(ray_scene, view, ray, &hit), hit.t),
        (None, Some(t)) => (shade::shade_ground(view, ray, t), t.min(far)),
        (None, None) => (shade::shade_sky(view, ray), far),
    };
    let mut layers = vec![background];
    if ray_scene.has_blended {
        let blended = ray_scene.all_hits(ray, (near, max_t), |hit| ray_scene.is_blended(hit));
        layers.extend(blended.iter().map(|hit| shade::shade_triangle(ray_scene, view, ray, hit)));
    }
    layers
}

/// Composites layers back to front, C = a C_layer + (1 - a) C_behind, and likewise the sunlight.
fn add_sample(sum: &mut PixelSum, layers: &[ShadedPoint], visibility: impl Fn(&ShadedPoint) -> f64) {
    let mut sample = PixelSum::default();
    for point in layers {
        let visibility = if point.cosine > 0.0 { visibility(point) } else { 0.0 };
        let transmittance = 1.0 - point.alpha;
        let light = point.ambient + point.unoccluded + point.sun * visibility;
        sample.color = light * point.alpha + sample.color * transmittance;
        sample.shadowed = point.cosine * visibility * point.alpha + sample.shadowed * transmittance;
        sample.unshadowed = point.cosine * point.alpha + sample.unshadowed * transmittance;
    }
    // Each sample is clamped separately, so that overexposed samples do not brighten the edges of their pixel.
    sum.color += sample.color.map(|channel| channel.clamp(0.0, 1.0));
    sum.shadowed += sample.shadowed;
    sum.unshadowed += sample.unshadowed;
}

impl PixelSum {
    /// The sRGB color and sun visibility of a pixel with this number of samples.
    fn resolve(&self, samples: usize) -> ([f32; 3], Option<f32>) {
        let count = samples as f64;
        let color = (self.color / count).map(|channel| (255.0 * srgb_from_linear(channel)) as f32);
        let is_defined = self.unshadowed / count >= MIN_SUNLIGHT;
        (color.into(), is_defined.then(|| (self.shadowed / self.unshadowed) as f32))
    }
}

/// Sun visibility of a point, 0 to 1.
fn sun_visibility(
    ray_scene: &RayScene,
    view: &ReferenceView,
    point: &ShadedPoint,
    shadow_model: ShadowModel,
    gaussian_samples: &[[f64; 2]],
) -> f64 {
    // The offset of 1e-9 radii excludes hits at the origin.
    let is_occluded = |origin: Vector3<f64>, min_t: f64| {
        ray_scene.is_occluded(&Ray { origin, direction: view.to_sun }, min_t + 1e-9 * ray_scene.radius, point.triangle)
    };
    match shadow_model {
        ShadowModel::Unshadowed => 1.0,
        ShadowModel::Hard => f64::from(u8::from(!is_occluded(point.point, 0.0))),
        ShadowModel::Filtered([x_axis, y_axis]) => {
            // The lower bound limits the height of an origin above a receiver that the sun grazes.
            let cosine = point.geometric_normal.dot(&view.to_sun).max(0.05);
            let unoccluded_samples = gaussian_samples.iter().filter(|[x, y]| {
                let offset = x_axis * *x + y_axis * *y;
                let height = -point.geometric_normal.dot(&offset) / cosine;
                !is_occluded(point.point + offset + view.to_sun * height, 0.5 * offset.norm())
            });
            unoccluded_samples.count() as f64 / gaussian_samples.len() as f64
        }
    }
}
