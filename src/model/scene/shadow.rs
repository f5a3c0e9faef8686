//! Settings of a scene's shadow map.

use crate::error::{Result, invalid};

/// How a lookup in the shadow map is filtered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadowMethod {
    /// Variance shadow map (equation 3.10): Chebyshev's bound on blurred moments of depth. Soft edges, one lookup per
    /// pixel. For a receiver with a single occluder the bound is exact, and, apart from `bleeding`, the half-dark
    /// contour is within half a texel of the true edge. Where occluders overlap, light bleeds through.
    #[default]
    Variance,
    /// Standard shadow map with one depth per texel. Hard edges, within half a texel of the true edge in the plane of
    /// the map. An occluder closer than one texel side to the surface behind it casts no shadow.
    Standard,
    /// Percentage-closer filtering: the fraction of surrounding depths behind the receiver, weighted by the Gaussian of
    /// `blur`. Soft edges, half dark within half a texel of the true edge, no light bleeding, at the cost of
    /// (6 blur + 2)^2 depths per pixel. As with `Standard`, an occluder closer than one texel side casts no shadow.
    #[serde(rename = "filtered")]
    PercentageCloser,
}

/// The storage type of a variance map's moments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MomentFormat {
    #[default]
    F32,
    /// Half the memory, but insufficient precision: the second moment is rounded by up to 2^-14, thirty times the
    /// default `least_variance`, so that shadows near their occluder are speckled with light. Intended for measurements
    /// only.
    F16,
}

/// What the light's view volume is fitted to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadowFit {
    /// Bounds of the vertices in light space. Compared with `Corners`, the texels of a tree have a third of the area,
    /// and its leaves cover three times as many of them.
    #[default]
    Vertices,
    /// The corners of the vertices' bounding box in the world, as in the thesis (section 3.3.1). Needs no extra
    /// measurement by the deformers.
    Corners,
}

/// Settings of the shadow map.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ShadowSettings {
    pub method: ShadowMethod,
    /// Side of the square map in texels, 16 to 16384.
    pub size: u32,
    /// Standard deviation of the Gaussian in texels, 0 (no blur) to 16. [`ShadowMethod::Standard`] ignores it.
    pub blur: f32,
    /// Lower bound of the variance, as a fraction of the squared depth range. The effective bound is at least
    /// [`Self::variance_floor`], the variance that rounding alone produces.
    pub least_variance: f32,
    /// Light-bleeding reduction: Chebyshev values below this count as full shadow, 0 to 0.99. It moves the edge of a
    /// shadow outwards, at 0.2 by a quarter of the standard deviation.
    pub bleeding: f32,
    /// The alpha from which blended materials cast a shadow (t_alpha of the thesis).
    pub alpha_threshold: f32,
    pub moments: MomentFormat,
    /// Number of cascades, 1 to 4, each with a map of `size`, split by distance from the camera. Nearer cascades have
    /// finer texels; the last one covers the whole scene. `blur` is in texels of each cascade, so that shadows are
    /// sharper nearby.
    pub splits: u32,
    pub fit: ShadowFit,
}

impl Default for ShadowSettings {
    fn default() -> Self {
        Self {
            method: ShadowMethod::default(),
            size: 1024,
            blur: 1.5,
            least_variance: 2e-6,
            bleeding: 0.2,
            alpha_threshold: 0.5,
            moments: MomentFormat::default(),
            splits: 1,
            fit: ShadowFit::default(),
        }
    }
}

/// The largest number of texels of all cascades together.
const MAX_TEXELS: u64 = 16384 * 16384;

impl ShadowSettings {
    /// Whether the map stores moments of depth, which are blurred.
    pub const fn has_moments(&self) -> bool {
        matches!(self.method, ShadowMethod::Variance)
    }

    /// Radius of the blur kernel in texels: three standard deviations.
    pub fn blur_radius(&self) -> u32 {
        match self.method {
            ShadowMethod::Standard => 0,
            _ => (3.0 * f64::from(self.blur)).ceil() as u32,
        }
    }

    /// Standard deviation, in texels, of the filter that a soft map applies to depths: the blur and the bilinear
    /// lookup, a tent of variance 1/6.
    pub fn filter_deviation(&self) -> f64 {
        (f64::from(self.blur).powi(2) + 1.0 / 6.0).sqrt()
    }

    /// Upper bound of the variance that f32 rounding produces from equal depths m, |m| <= 1/2, blurred by N taps in x
    /// and in y. With u = 2^-24, the products, sums and weights of two passes and the bilinear lookup change M2 <= 1/4
    /// by at most (2 N + 6) u / 4 and M1 by at most (2 N + 5) u / 2, hence M1^2 by (N + 3) u. In total, the
    /// variance is below (1.5 N + 5) u.
    pub fn variance_floor(&self) -> f32 {
        let taps = 2 * self.blur_radius() + 1;
        (1.5 * taps as f32 + 5.0) * (0.5 * f32::EPSILON)
    }

    pub(super) fn check(&self) -> Result<()> {
        if !(16..=16384).contains(&self.size) {
            return Err(invalid("look.shadow.size", "16 to 16384 texels", self.size));
        }
        if !(0.0..=16.0).contains(&self.blur) {
            return Err(invalid("look.shadow.blur", "0 to 16 texels", self.blur));
        }
        if !(0.0..=0.99).contains(&self.bleeding) {
            return Err(invalid("look.shadow.bleeding", "0 to 0.99", self.bleeding));
        }
        if !(0.0..=1.0).contains(&self.alpha_threshold) || !(0.0..=1.0).contains(&self.least_variance) {
            return Err(invalid("look.shadow", "alpha_threshold and least_variance of 0 to 1", format!("{self:?}")));
        }
        let texels = u64::from(self.size) * u64::from(self.size) * u64::from(self.splits);
        if !(1..=4).contains(&self.splits) || texels > MAX_TEXELS {
            let expected = format!("1 to 4 maps of together {MAX_TEXELS} texels at most");
            return Err(invalid("look.shadow.splits", expected, format!("{} of {} a side", self.splits, self.size)));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn maps_out_of_range_are_refused_by_field() {
        let good = ShadowSettings::default();
        good.check().expect("good");
        let bad = [
            (ShadowSettings { size: 15, ..good }, "size"),
            (ShadowSettings { blur: f32::NAN, ..good }, "blur"),
            (ShadowSettings { bleeding: 1.0, ..good }, "bleeding"),
            (ShadowSettings { splits: 0, ..good }, "splits"),
            (ShadowSettings { splits: 5, ..good }, "splits"),
            (ShadowSettings { splits: 2, size: 16384, ..good }, "splits"),
        ];
        for (shadow, field) in bad {
            let refusal = shadow.check().expect_err(field).to_string();
            assert!(refusal.starts_with(&format!("look.shadow.{field}:")), "{refusal}");
        }
    }

    /// Blurs moments of equal depths m twice in f32, as the shaders do. Returns the largest |M2 - M1^2|.
    fn spurious(shadow: &ShadowSettings) -> f32 {
        let reach = shadow.blur_radius() as i32;
        let bell = |step: i32| (-0.5 * (f64::from(step) / f64::from(shadow.blur)).powi(2)).exp();
        let sum: f64 = (-reach..=reach).map(bell).sum();
        let weights: Vec<f32> = (-reach..=reach).map(|step| (bell(step) / sum) as f32).collect();
        let blurred = |value: f32| weights.iter().fold(0.0_f32, |sum, weight| sum + weight * value);
        let depths = (0..=20_000).map(|step| step as f32 / 20_000.0 - 0.5);
        depths
            .map(|m| (blurred(blurred(m)), blurred(blurred(m * m))))
            .map(|(first, second)| (second - first * first).abs())
            .fold(0.0, f32::max)
    }

    #[test]
    fn the_floor_holds_what_rounding_makes_of_no_variance_and_not_a_hundred_times_more() {
        for blur in [0.5, 1.5, 4.0, 16.0] {
            let shadow = ShadowSettings { blur, ..ShadowSettings::default() };
            let (worst, floor) = (spurious(&shadow), shadow.variance_floor());
            assert!(worst <= floor && floor < 100.0 * worst, "blur {blur}: {worst} of {floor}");
        }
        let default = ShadowSettings::default();
        assert!(default.variance_floor() < default.least_variance, "the default least variance is above its floor");
    }
}
