//! Settings of a scene's shadow map. "The thesis" is B. Wang, "CUDA Deformers for Model Reduction".

use crate::error::{Result, invalid};

/// How a lookup in the shadow map is filtered.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadowMethod {
    /// Variance shadow map (equation 3.10 of the thesis): Chebyshev's bound on blurred moments of depth. Soft edges.
    /// For a receiver with a single occluder the bound is exact: with `bleeding` 0, the shadow is half dark within half
    /// a texel of the true edge. Where occluders overlap, the bound alone lets light bleed through: up to 117 of 121
    /// levels between shadow and light in a model of three layers with the default blur. So the moments only decide
    /// pixels in full shadow or full light. At all others, the depths are filtered as with `PercentageCloser`, and the
    /// smaller value counts, which is at most 0.3 levels above that of `PercentageCloser`. One lookup per decided pixel;
    /// (5 blur + 2)^2 depths per undecided one, at most 32^2: 6 to 18 % of the pixels of a few large occluders, 55 to
    /// 80 % of dense foliage. A blur wider than 6 texels skips depths: full shadow remains dark, and penumbrae of large
    /// occluders are at most one level brighter and 10 levels darker.
    #[default]
    Variance,
    /// Standard shadow map with one depth per texel. Hard edges, within half a texel of the true edge in the plane of
    /// the map. An occluder closer than one texel side to the surface behind it casts no shadow.
    Standard,
    /// Percentage-closer filtering: the fraction of surrounding depths behind the receiver, weighted by the Gaussian of
    /// `blur`. Soft edges, half dark within half a texel of the true edge, no light bleeding. A pixel reads
    /// (6 blur + 2)^2 depths: 2 x 3 blur + 1 taps per axis, and one more for bilinear weights. As with `Standard`, an
    /// occluder closer than one texel side casts no shadow.
    #[serde(rename = "filtered")]
    PercentageCloser,
}

impl ShadowMethod {
    /// Name in scene files and results.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Variance => "variance",
            Self::Standard => "standard",
            Self::PercentageCloser => "filtered",
        }
    }
}

/// The storage type of a variance map's moments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum MomentFormat {
    #[default]
    F32,
    /// Half the memory, but insufficient precision: the second moment is rounded by up to 2^-14, which is thirty times
    /// the default `least_variance`. Shadows near their occluder are speckled with light. Intended for measurements
    /// only.
    F16,
}

/// What the light's view volume is fitted to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadowFit {
    /// Bounds of the vertices in light space. Texels are smaller than with `Corners`: for a tree, a third of the area.
    #[default]
    Vertices,
    /// The corners of the world-space bounding box of the vertices, as in the thesis (section 3.3.1). Deformers need
    /// not compute bounds in light space.
    Corners,
}

/// Settings of the shadow map.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
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
    #[serde(rename = "splits")]
    pub cascades: u32,
    pub fit: ShadowFit,
    /// Whether a variance map filters the depths where its moments do not decide. No scene file turns this off; reports
    /// and tests do, to measure the light that bleeds without it.
    pub pcf_fallback: bool,
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
            cascades: 1,
            fit: ShadowFit::default(),
            pcf_fallback: true,
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

    /// Whether the lookup of a variance map filters the depths by percentage closer where its moments do not decide.
    pub const fn filters_undecided_points(&self) -> bool {
        self.has_moments() && self.pcf_fallback
    }

    /// Radius of the blur kernel in texels: three standard deviations.
    pub fn blur_radius(&self) -> u32 {
        match self.method {
            ShadowMethod::Standard => 0,
            _ => (3.0 * f64::from(self.blur)).ceil() as u32,
        }
    }

    /// Standard deviation, in texels, of the filter of a soft shadow map: the blur combined with the bilinear lookup,
    /// which is a tent filter of variance 1/6.
    pub fn filter_deviation(&self) -> f64 {
        (f64::from(self.blur).powi(2) + 1.0 / 6.0).sqrt()
    }

    /// Upper bound of the variance M2 - M1^2 that f32 rounding produces from equal depths m, |m| <= 1/2. M1 and M2 are
    /// the means of m and m^2, blurred by N taps in x and in y.
    ///
    /// Let u = 2^-24 be the unit roundoff. The products, sums and weights of two passes and the bilinear lookup cause
    /// an error of at most (2 N + 6) u / 4 in M2, because M2 <= 1/4, and of at most (2 N + 5) u / 2 in M1. As
    /// |M1| <= 1/2, the error of M1^2 is at most (N + 3) u. The sum of both errors is below (1.5 N + 5) u.
    pub fn variance_floor(&self) -> f32 {
        let taps = 2 * self.blur_radius() + 1;
        let unit_roundoff = 0.5 * f32::EPSILON;
        (1.5 * taps as f32 + 5.0) * unit_roundoff
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
        let texels = u64::from(self.size) * u64::from(self.size) * u64::from(self.cascades);
        if !(1..=4).contains(&self.cascades) || texels > MAX_TEXELS {
            let expected = format!("1 to 4 maps of at most {MAX_TEXELS} texels together");
            return Err(invalid(
                "look.shadow.splits",
                expected,
                format!("{} maps of {} x {} texels", self.cascades, self.size, self.size),
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn out_of_range_settings_are_rejected_with_their_field() {
        let valid_shadow = ShadowSettings::default();
        valid_shadow.check().expect("valid settings");
        let invalid_shadows = [
            (ShadowSettings { size: 15, ..valid_shadow }, "size"),
            (ShadowSettings { blur: f32::NAN, ..valid_shadow }, "blur"),
            (ShadowSettings { bleeding: 1.0, ..valid_shadow }, "bleeding"),
            (ShadowSettings { cascades: 0, ..valid_shadow }, "splits"),
            (ShadowSettings { cascades: 5, ..valid_shadow }, "splits"),
            (ShadowSettings { cascades: 2, size: 16384, ..valid_shadow }, "splits"),
        ];
        for (shadow, field) in invalid_shadows {
            let message = shadow.check().expect_err(field).to_string();
            assert!(
                message.starts_with(&format!("look.shadow.{field}:")),
                "expected an error about {field}, got {message}"
            );
        }
    }

    /// Blurs the moments of equal depths m in x and then in y in f32, as the shaders do. Returns the largest
    /// |M2 - M1^2|.
    fn largest_rounding_variance(shadow: &ShadowSettings) -> f32 {
        let radius = shadow.blur_radius() as i32;
        let gaussian = |offset: i32| (-0.5 * (f64::from(offset) / f64::from(shadow.blur)).powi(2)).exp();
        let weight_sum: f64 = (-radius..=radius).map(gaussian).sum();
        let weights: Vec<f32> = (-radius..=radius).map(|offset| (gaussian(offset) / weight_sum) as f32).collect();
        let blur = |value: f32| weights.iter().fold(0.0_f32, |sum, weight| sum + weight * value);
        let depths = (0..=20_000).map(|step| step as f32 / 20_000.0 - 0.5);
        depths
            .map(|m| (blur(blur(m)), blur(blur(m * m))))
            .map(|(mean, second_moment)| (second_moment - mean * mean).abs())
            .fold(0.0, f32::max)
    }

    #[test]
    fn variance_floor_bounds_the_rounding_variance() {
        for blur in [0.5, 1.5, 4.0, 16.0] {
            let shadow = ShadowSettings { blur, ..ShadowSettings::default() };
            let (rounding_variance, floor) = (largest_rounding_variance(&shadow), shadow.variance_floor());
            // The bound holds, and it is less than a hundred times too large.
            assert!(
                rounding_variance <= floor && floor < 100.0 * rounding_variance,
                "blur {blur}: expected at most {floor}, got {rounding_variance}"
            );
        }
        let default = ShadowSettings::default();
        assert!(default.variance_floor() < default.least_variance, "expected a default above the floor");
    }
}
