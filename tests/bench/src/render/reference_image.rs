//! Reference pictures: every sample of every pixel is ray-cast, transparent layers are sorted, shadows are cast by
//! rays.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::ray_scene::{Ray, RayScene};
use super::reference_texture::srgb_from_linear;
use super::reference_view::View;
use super::sample_pattern;
use super::shade::{self, ShadedPoint};

/// The shadow model: determines the sun visibility of a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum SunTerm {
    /// No shadows: visibility 1.
    Unshadowed,
    /// One ray to the sun.
    Hard,
    /// Fraction of unoccluded rays, distributed by a Gaussian in the plane perpendicular to the light; the two vectors
    /// are one standard deviation each. The rays begin on the receiver's own tangent plane. Casters closer than half of
    /// a ray's offset from the center are ignored, because at this distance they are the receiver itself.
    Filtered([Vector3<f64>; 2]),
}

/// A picture with one shadow model.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct ReferenceImage {
    /// sRGB, 0 to 255, not rounded, top row first.
    pub(super) colors: Vec<[f32; 3]>,
    /// Sun visibility per pixel; `None` where the unshadowed sunlight is less than [`LEAST_LIGHT`].
    pub(super) light: Vec<Option<f32>>,
}

/// Minimum of unshadowed sunlight, of 1, for which sun visibility is defined.
pub(super) const LEAST_LIGHT: f64 = 0.1;

/// Sample counts of a reference.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct SampleCounts {
    /// Samples along each side of a pixel.
    pub(super) side: usize,
    /// Rays to the sun per sample of a filtered shadow.
    pub(super) taps: usize,
}

impl SampleCounts {
    /// 64 samples per pixel.
    pub(super) const FULL: Self = Self { side: 8, taps: 1 };
    /// A quarter of the samples, for machines with few cores.
    pub(super) const QUICK: Self = Self { side: 4, taps: 4 };
}

/// Traces pictures with all shadow models at once; camera rays are shared.
pub(super) fn trace(ray_scene: &RayScene, view: &View, terms: &[SunTerm], detail: SampleCounts) -> Vec<ReferenceImage> {
    let samples = sample_pattern::pixel(detail.side);
    let pixels: Vec<Vec<([f32; 3], Option<f32>)>> = (0..view.width * view.height)
        .into_par_iter()
        .map(|pixel| {
            trace_pixel(ray_scene, view, terms, (pixel % view.width, pixel / view.width), (&samples, detail.taps))
        })
        .collect();
    let of_term = |term: usize| ReferenceImage {
        colors: pixels.iter().map(|pixel| pixel[term].0).collect(),
        light: pixels.iter().map(|pixel| pixel[term].1).collect(),
    };
    (0..terms.len()).map(of_term).collect()
}

/// Sums over the samples of a pixel with one shadow model.
#[derive(Debug, Clone, Copy, Default)]
struct Sum {
    color: Vector3<f64>,
    /// Sunlight that arrives, and below it the sunlight without any shadow.
    arrives: f64,
    whole: f64,
}

type Samples<'a> = (&'a [[f64; 2]], usize);

fn trace_pixel(
    ray_scene: &RayScene,
    view: &View,
    terms: &[SunTerm],
    (x, y): (u32, u32),
    (samples, taps): Samples<'_>,
) -> Vec<([f32; 3], Option<f32>)> {
    let gaussian_samples = sample_pattern::gaussian_samples(samples.len() * taps, sample_pattern::scatter(x, y));
    let mut sums = vec![Sum::default(); terms.len()];
    for (at, [dx, dy]) in samples.iter().enumerate() {
        let layers = layers(ray_scene, view, &view.ray(f64::from(x) + dx, f64::from(y) + dy));
        // Any odd stride visits all points; this one keeps neighboring samples far from each other.
        let own: Vec<[f64; 2]> =
            (0..taps).map(|tap| gaussian_samples[((at * 37 + 11) % samples.len()) * taps + tap]).collect();
        for (sum, term) in sums.iter_mut().zip(terms) {
            add(sum, &layers, |seen| sunlit(ray_scene, view, seen, *term, &own));
        }
    }
    sums.iter().map(|sum| sum.shown(samples.len())).collect()
}

/// The layers along a ray, farthest first: an opaque one, then every transparent layer in front of it.
fn layers(ray_scene: &RayScene, view: &View, ray: &Ray) -> Vec<ShadedPoint> {
    let (near, far) = view.range;
    let mut solid = ray_scene.nearest(ray, (near, far), |hit| ray_scene.is_solid(hit));
    let ground = view.ground_at(ray);
    // Triangles in the plane of the ground cover the ground.
    if let (Some(hit), Some(t)) = (solid, ground)
        && hit.t > t + 1e-6 * ray_scene.radius
    {
        solid = None;
    }
    let (back, until) = match (solid, ground) {
        (Some(hit), _) => (shade::surface(ray_scene, view, ray, &hit), hit.t),
        (None, Some(t)) => (shade::ground(view, ray, t), t.min(far)),
        (None, None) => (shade::sky(view, ray), far),
    };
    let mut layers = vec![back];
    if ray_scene.has_blended {
        let before = ray_scene.every(ray, (near, until), |hit| ray_scene.is_blended(hit));
        layers.extend(before.iter().map(|hit| shade::surface(ray_scene, view, ray, hit)));
    }
    layers
}

/// Composes layers back to front: C = a C_layer + (1 - a) C_behind, and likewise for the light.
fn add(sum: &mut Sum, layers: &[ShadedPoint], arrives: impl Fn(&ShadedPoint) -> f64) {
    let mut sample = Sum::default();
    for seen in layers {
        let share = if seen.facing > 0.0 { arrives(seen) } else { 0.0 };
        let rest = 1.0 - seen.alpha;
        sample.color = (seen.ambient + seen.sun * share) * seen.alpha + sample.color * rest;
        sample.arrives = seen.facing * share * seen.alpha + sample.arrives * rest;
        sample.whole = seen.facing * seen.alpha + sample.whole * rest;
    }
    // Each sample is clamped separately, so that overexposed samples do not brighten the edges of their pixel.
    sum.color += sample.color.map(|channel| channel.clamp(0.0, 1.0));
    sum.arrives += sample.arrives;
    sum.whole += sample.whole;
}

impl Sum {
    fn shown(&self, samples: usize) -> ([f32; 3], Option<f32>) {
        let count = samples as f64;
        let color = (self.color / count).map(|channel| (255.0 * srgb_from_linear(channel)) as f32);
        let lit = self.whole / count >= LEAST_LIGHT;
        (color.into(), lit.then(|| (self.arrives / self.whole) as f32))
    }
}

/// Sun visibility of a point, 0 to 1.
fn sunlit(ray_scene: &RayScene, view: &View, seen: &ShadedPoint, term: SunTerm, gaussian_samples: &[[f64; 2]]) -> f64 {
    let dark = |from: Vector3<f64>, least: f64| {
        ray_scene.is_dark(&Ray { from, along: view.to_sun }, least + 1e-9 * ray_scene.radius, seen.triangle)
    };
    match term {
        SunTerm::Unshadowed => 1.0,
        SunTerm::Hard => f64::from(u8::from(!dark(seen.point, 0.0))),
        SunTerm::Filtered([across, upward]) => {
            let cosine = seen.facet.dot(&view.to_sun).max(0.05);
            let arrives = gaussian_samples.iter().filter(|[x, y]| {
                let aside = across * *x + upward * *y;
                let slide = -seen.facet.dot(&aside) / cosine;
                !dark(seen.point + aside + view.to_sun * slide, 0.5 * aside.norm())
            });
            arrives.count() as f64 / gaussian_samples.len() as f64
        }
    }
}
