//! Which shadow map a scene asks for.

use crate::error::{Result, invalid};

/// How the map answers whether the sun is seen.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadowMethod {
    /// Chebyshev's bound on blurred moments of depth (variance shadow map, equation 3.10): soft, one lookup a pixel. On a
    /// receiver with one caster before it the bound is exact, and half dark within half a texel of the true edge but for
    /// `bleeding`; where casters overlap it lets light through.
    #[default]
    Variance,
    /// One depth a pixel (standard shadow map): hard, its edge within half a texel of the true one in the plane of the
    /// map. A caster nearer than the side of a texel to the surface behind it casts none.
    Standard,
    /// The share of depths around the pixel that lie behind it, weighed by the Gaussian of `blur` (percentage-closer
    /// filtering): soft, half dark within half a texel of the true edge, no light through where casters overlap, and
    /// (6 blur + 2)^2 depths a pixel. Nearer than the side of a texel it casts none either.
    Filtered,
}

/// How the moments of a variance map are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Moments {
    #[default]
    F32,
    /// Half the memory, and wrong: the second moment is rounded by up to 2^-14, thirty times the default least variance,
    /// so that the shadow near its caster is spotted with light. It is there to be measured.
    F16,
}

/// What a map is fitted to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Fit {
    /// What the vertices take up as the sun sees them: the texels of a tree have a third of the area, and its leaves fill three
    /// times as many of them.
    #[default]
    Vertices,
    /// The corners of the vertices' box in the world, as the thesis has it (section 3.3.1): deformers measure nothing more.
    Corners,
}

/// What blurs the moments of a variance map; all three give the same map up to rounding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Blurring {
    /// Tiles on hardware, rows in software.
    #[default]
    Fitting,
    /// One compute pass: over strips, with sums in registers; over tiles in shared memory where a blur above 8 reaches too
    /// far for that.
    Tiles,
    /// Two compute passes without shared memory.
    Rows,
    /// Two passes of fragments, as the thesis draws them: a baseline for the report.
    Fragments,
}

/// The shadow map.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Shadow {
    pub method: ShadowMethod,
    /// Side of the square map in texels, 16 to 16384.
    pub size: u32,
    /// Standard deviation of the Gaussian in texels, 0 (none) to 16. A standard map has none.
    pub blur: f32,
    /// Smallest variance, as a fraction of the squared depth range. Not less than what rounding alone makes of no
    /// variance is ever taken: [`Self::floor`].
    pub least_variance: f32,
    /// Chebyshev values below this count as full shadow, 0 to 0.99 (light-bleeding reduction). It moves the edge of a
    /// shadow outwards: at 0.2 by a quarter of the deviation.
    pub bleeding: f32,
    /// Blended materials cast a shadow from this alpha on (the thesis's t_alpha).
    pub alpha_threshold: f32,
    pub moments: Moments,
    /// Maps of this size, 1 to 4, split by distance from the camera: the nearer finer, the last over the whole scene.
    /// `blur` is in texels of each, so that shadows are sharper nearby.
    pub splits: u32,
    pub fit: Fit,
    /// For measurements; no file names it.
    #[serde(skip)]
    pub blurring: Blurring,
}

impl Default for Shadow {
    fn default() -> Self {
        Self {
            method: ShadowMethod::default(),
            size: 1024,
            blur: 1.5,
            least_variance: 2e-6,
            bleeding: 0.2,
            alpha_threshold: 0.5,
            moments: Moments::default(),
            splits: 1,
            fit: Fit::default(),
            blurring: Blurring::default(),
        }
    }
}

/// The most texels of all maps together.
const MOST_TEXELS: u64 = 16384 * 16384;

impl Shadow {
    /// Whether moments are made of the depth, and blurred.
    pub const fn has_moments(&self) -> bool {
        matches!(self.method, ShadowMethod::Variance)
    }

    /// Texels to each side of the middle one that the Gaussian reaches: three deviations.
    pub fn reach(&self) -> u32 {
        match self.method {
            ShadowMethod::Standard => 0,
            _ => (3.0 * f64::from(self.blur)).ceil() as u32,
        }
    }

    /// Standard deviation of what a soft map weighs depths with, in texels: that of the blur, and of reading between
    /// texels, which is a tent of variance 1/6.
    pub fn deviation(&self) -> f64 {
        (f64::from(self.blur).powi(2) + 1.0 / 6.0).sqrt()
    }

    /// The variance that rounding to f32 can make of equal depths m, |m| <= 1/2, blurred by N taps in x and in y. With
    /// u = 2^-24: the products, sums and weights of two passes and the bilinear lookup leave M2 <= 1/4 wrong by at most
    /// (2 N + 6) u / 4 and M1 by at most (2 N + 5) u / 2, so M1^2 by (N + 3) u; in all below (1.5 N + 5) u.
    pub fn floor(&self) -> f32 {
        let taps = 2 * self.reach() + 1;
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
        if !(1..=4).contains(&self.splits) || texels > MOST_TEXELS {
            let expected = format!("1 to 4 maps of together {MOST_TEXELS} texels at most");
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
        let good = Shadow::default();
        good.check().expect("good");
        let bad = [
            (Shadow { size: 15, ..good }, "size"),
            (Shadow { blur: f32::NAN, ..good }, "blur"),
            (Shadow { bleeding: 1.0, ..good }, "bleeding"),
            (Shadow { splits: 0, ..good }, "splits"),
            (Shadow { splits: 5, ..good }, "splits"),
            (Shadow { splits: 2, size: 16384, ..good }, "splits"),
        ];
        for (shadow, field) in bad {
            let refusal = shadow.check().expect_err(field).to_string();
            assert!(refusal.starts_with(&format!("look.shadow.{field}:")), "{refusal}");
        }
    }

    /// Moments of equal depths m, blurred twice in f32 as the shaders do it; the largest |M2 - M1^2|.
    fn spurious(shadow: &Shadow) -> f32 {
        let reach = shadow.reach() as i32;
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
            let shadow = Shadow { blur, ..Shadow::default() };
            let (worst, floor) = (spurious(&shadow), shadow.floor());
            assert!(worst <= floor && floor < 100.0 * worst, "blur {blur}: {worst} of {floor}");
        }
        let default = Shadow::default();
        assert!(default.floor() < default.least_variance, "the default least variance is above its floor");
    }
}
