//! Post-processing of a shaded image: antialiasing, bloom and tone mapping.

use crate::error::{Result, invalid};

/// The antialiasing method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Antialiasing {
    /// Multisampling with the look's number of samples per pixel.
    #[default]
    #[serde(rename = "samples")]
    Msaa,
    /// Fast approximate antialiasing (FXAA, Lottes 2009): one sample per pixel; edges are detected in the image and
    /// smoothed along their length.
    Fxaa,
    /// One sample per pixel and no antialiasing.
    None,
}

impl Antialiasing {
    /// Name in scene files and results.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Msaa => "samples",
            Self::Fxaa => "fxaa",
            Self::None => "none",
        }
    }
}

/// The tone-mapping curve, applied to each color channel.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ToneMapping {
    /// Linear; values above 1 are clipped to white.
    #[default]
    None,
    /// x / (1 + x): Reinhard et al. 2002, "Photographic tone reproduction for digital images", equation 3. Never
    /// reaches white.
    Reinhard,
    /// The film curve of the Academy Color Encoding System in Narkowicz's fit of 2015: x (2.51 x + 0.03) / (x (2.43 x +
    /// 0.59) + 0.14).
    Aces,
}

/// Bloom: a fraction of the light above a threshold is spread over the neighborhood of its pixel, as in a lens. Energy
/// is conserved.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Bloom {
    /// Threshold of the brightest channel of a pixel, after exposure, 0 to 1000.
    pub threshold: f32,
    /// The fraction of the light above the threshold that is spread, 0 to 1.
    pub strength: f32,
    /// Number of successive halvings of the image, 1 to 8. The glow of level n extends about 2^n pixels to each side.
    /// All levels have equal energy.
    pub levels: u32,
}

impl Default for Bloom {
    fn default() -> Self {
        Self { threshold: 1.0, strength: 0.5, levels: 5 }
    }
}

/// The largest exposure. The limit prevents overflow of the radiance.
const MAX_EXPOSURE: f32 = 1024.0;

impl Bloom {
    fn check(&self) -> Result<()> {
        if !(0.0..=1000.0).contains(&self.threshold) {
            return Err(invalid("look.bloom.threshold", "0 to 1000", self.threshold));
        }
        if !(0.0..=1.0).contains(&self.strength) {
            return Err(invalid("look.bloom.strength", "a fraction of 0 to 1", self.strength));
        }
        if !(1..=8).contains(&self.levels) {
            return Err(invalid("look.bloom.levels", "1 to 8 halvings", self.levels));
        }
        Ok(())
    }
}

impl super::RenderSettings {
    /// Number of samples per pixel. It is 1 unless the antialiasing method is [`Antialiasing::Msaa`].
    pub fn samples_per_pixel(&self) -> u32 {
        if self.antialias == Antialiasing::Msaa { self.samples } else { 1 }
    }

    pub(super) fn check_post(&self) -> Result<()> {
        if !(self.exposure > 0.0 && self.exposure <= MAX_EXPOSURE) {
            return Err(invalid("look.exposure", format!("above 0, up to {MAX_EXPOSURE}"), self.exposure));
        }
        self.bloom.map_or(Ok(()), |bloom| bloom.check())
    }
}

#[cfg(test)]
mod tests {
    use super::super::RenderSettings;
    use super::*;

    #[test]
    fn out_of_range_numbers_are_rejected_with_their_field() {
        let settings =
            |bloom: Bloom, exposure: f32| RenderSettings { bloom: Some(bloom), exposure, ..RenderSettings::default() };
        let default_bloom = Bloom::default();
        for (bloom, exposure) in [
            (default_bloom, 1.0),
            (Bloom { threshold: 0.0, strength: 0.0, levels: 1 }, 1e-6),
            (Bloom { threshold: 1000.0, strength: 1.0, levels: 8 }, 1024.0),
        ] {
            settings(bloom, exposure).check_post().expect("valid settings");
        }
        for (bloom, exposure, field) in [
            (Bloom { threshold: f32::NAN, ..default_bloom }, 1.0, "look.bloom.threshold"),
            (Bloom { threshold: -0.1, ..default_bloom }, 1.0, "look.bloom.threshold"),
            (Bloom { strength: 1.1, ..default_bloom }, 1.0, "look.bloom.strength"),
            (Bloom { levels: 0, ..default_bloom }, 1.0, "look.bloom.levels"),
            (Bloom { levels: 9, ..default_bloom }, 1.0, "look.bloom.levels"),
            (default_bloom, 0.0, "look.exposure"),
            (default_bloom, f32::NAN, "look.exposure"),
            (default_bloom, f32::INFINITY, "look.exposure"),
        ] {
            let message = settings(bloom, exposure).check_post().expect_err(field).to_string();
            assert!(message.starts_with(&format!("{field}:")), "expected an error about {field}, got {message}");
        }
    }

    #[test]
    fn only_msaa_has_more_than_one_sample_per_pixel() {
        let samples =
            |antialias| RenderSettings { antialias, samples: 4, ..RenderSettings::default() }.samples_per_pixel();
        assert_eq!([Antialiasing::Msaa, Antialiasing::Fxaa, Antialiasing::None].map(samples), [4, 1, 1]);
        assert_eq!(RenderSettings { samples: 1, ..RenderSettings::default() }.samples_per_pixel(), 1);
    }
}
