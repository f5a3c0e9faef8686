//! Presets of a look: antialiasing and shadow map, which trade error for time, chosen together.
//!
//! | preset | antialiasing | shadow map | intended for |
//! |---|---|---|---|
//! | `preview` | none, one sample per pixel | variance, 512², blur 1.5 | CPUs |
//! | `standard` | four samples per pixel | filtered, 1024², blur 1.5 | GPUs, and images of small scenes on CPUs |
//! | `best` | four samples per pixel | filtered, 2048², blur 3 | still images |
//!
//! Without a preset, a rule chooses. It depends on numbers only and never on measured times, so equal requests give
//! equal images on one machine:
//!
//! | renderer | antialiasing | shadow map |
//! |---|---|---|
//! | hardware | of `standard` | variance, 1024², blur 1.5 |
//! | software (OpenGL on the CPU) | of `standard` if the frame has at most 320 x 240 pixels and the scene at most 16,384 triangles, else of `preview` | of `preview` |
//!
//! A still picture is drawn with the antialiasing of `standard` on every renderer ([`RenderSettings::still_samples`]):
//! it is looked at for longer than a frame of a stream, and no rate depends on its time.
//!
//! The shadow map of the rule is the fastest one with a mean light error that changes a white surface in full sunlight
//! by at most one level of 255 (hardware, at 1920 x 1080) or two levels (software, at 1280 x 720). `modalcast report
//! render` measures both and ends with this choice. It does not depend on the number of pixels, because all frames of a
//! step share it. A part of the look that the scene sets itself ([`LookOverrides`]) is never changed.

use super::{Antialiasing, RenderSettings, ShadowMethod};
use crate::error::{Error, invalid};

/// A named choice of antialiasing and shadow map.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum LookPreset {
    /// FXAA is not used, because on a CPU it takes more time than the rest of a frame.
    Preview,
    Standard,
    /// Least error.
    Best,
}

/// The kind of renderer, on which the rule without a preset depends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RendererKind {
    /// OpenGL on a GPU.
    Hardware,
    /// OpenGL on the CPU.
    Software,
}

impl RendererKind {
    /// Method, size and blur of the shadow map that the rule chooses.
    const fn shadow_map(self) -> (ShadowMethod, u32, f32) {
        match self {
            Self::Hardware => (ShadowMethod::Variance, 1024, 1.5),
            Self::Software => LookPreset::Preview.shadow_map(),
        }
    }
}

/// A choice of antialiasing and shadow map that the renderer makes when it loads a scene and draws a frame.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct PresetRequest {
    /// `None` leaves the choice to the rule.
    pub preset: Option<LookPreset>,
    pub overrides: LookOverrides,
}

/// The parts of a look that a scene sets itself. A preset or the rule chooses the parts that are `None`.
#[derive(Debug, Clone, Copy, Default, PartialEq, serde::Serialize)]
pub struct LookOverrides {
    pub antialias: Option<Antialiasing>,
    pub samples: Option<u32>,
    pub shadow_method: Option<ShadowMethod>,
    pub shadow_size: Option<u32>,
    pub shadow_blur: Option<f32>,
}

/// Largest frame, in pixels, that a software renderer draws with the antialiasing of `standard` by the rule.
const SOFTWARE_STANDARD_PIXELS: u64 = 320 * 240;
/// Largest scene, in triangles, that a software renderer draws with the antialiasing of `standard` by the rule.
const SOFTWARE_STANDARD_TRIANGLES: usize = 1 << 14;

/// Samples per pixel of multisampling where the scene does not set them.
const MULTISAMPLES: u32 = 4;

/// Antialiasing of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameAntialiasing {
    pub method: Antialiasing,
    /// Samples per pixel: 1, or 4 with [`Antialiasing::Msaa`].
    pub samples: u32,
}

impl LookPreset {
    /// All presets.
    pub const ALL: [Self; 3] = [Self::Preview, Self::Standard, Self::Best];

    /// Name in scene files, results and logs.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Preview => "preview",
            Self::Standard => "standard",
            Self::Best => "best",
        }
    }

    const fn antialiasing(self) -> FrameAntialiasing {
        match self {
            Self::Preview => FrameAntialiasing { method: Antialiasing::None, samples: 1 },
            Self::Standard | Self::Best => FrameAntialiasing { method: Antialiasing::Msaa, samples: MULTISAMPLES },
        }
    }

    /// Method, size and blur of the shadow map.
    const fn shadow_map(self) -> (ShadowMethod, u32, f32) {
        match self {
            Self::Preview => (ShadowMethod::Variance, 512, 1.5),
            Self::Standard => (ShadowMethod::PercentageCloser, 1024, 1.5),
            Self::Best => (ShadowMethod::PercentageCloser, 2048, 3.0),
        }
    }

    /// The preset that the rule chooses for the antialiasing of a frame.
    const fn of_antialiasing(renderer: RendererKind, triangles: usize, pixels: u64) -> Self {
        match renderer {
            RendererKind::Hardware => Self::Standard,
            RendererKind::Software
                if triangles <= SOFTWARE_STANDARD_TRIANGLES && pixels <= SOFTWARE_STANDARD_PIXELS =>
            {
                Self::Standard
            }
            RendererKind::Software => Self::Preview,
        }
    }
}

impl std::str::FromStr for LookPreset {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        let preset = Self::ALL.into_iter().find(|preset| preset.name() == name);
        preset.ok_or_else(|| invalid("look", "preview, standard or best", name))
    }
}

impl RenderSettings {
    /// These settings with the parts that a preset chooses left to the renderer. Until then they have the values for a
    /// hardware renderer.
    #[must_use]
    pub fn with_preset(self, request: PresetRequest) -> Self {
        let open = Self { preset: Some(request), ..self };
        let FrameAntialiasing { method, samples } = open.look_antialiasing(RendererKind::Hardware, 0, 0);
        // The given number of samples is kept, so that validation rejects it if it is invalid.
        let samples = request.overrides.samples.unwrap_or(samples);
        Self { antialias: method, samples, ..open.with_shadow_map_for(RendererKind::Hardware) }
    }

    /// The settings with which a renderer loads a scene: a preset or the rule has chosen the shadow map.
    #[must_use]
    pub fn with_shadow_map_for(self, renderer: RendererKind) -> Self {
        let Some(PresetRequest { preset, overrides }) = self.preset else { return self };
        let (method, size, blur) = preset.map_or_else(|| renderer.shadow_map(), LookPreset::shadow_map);
        let shadow = self.shadow.map(|shadow| super::ShadowSettings {
            method: overrides.shadow_method.unwrap_or(method),
            size: overrides.shadow_size.unwrap_or(size),
            blur: overrides.shadow_blur.unwrap_or(blur),
            ..shadow
        });
        Self { shadow, ..self }
    }

    /// The samples per pixel that a still picture sets for itself: those of `standard` where the rule would choose, and
    /// none where a preset or the scene has chosen.
    pub fn still_samples(&self) -> Option<u32> {
        let is_open = |request: PresetRequest| {
            request.preset.is_none() && request.overrides.antialias.is_none() && request.overrides.samples.is_none()
        };
        self.preset.is_some_and(is_open).then_some(MULTISAMPLES)
    }

    /// The antialiasing of a frame of `pixels` pixels that shows a scene of `triangles` triangles. `samples`: samples
    /// per pixel that the frame sets for itself.
    pub fn frame_antialiasing(
        &self,
        renderer: RendererKind,
        triangles: usize,
        pixels: u64,
        samples: Option<u32>,
    ) -> FrameAntialiasing {
        let of_look = self.look_antialiasing(renderer, triangles, pixels);
        match samples {
            None => of_look,
            Some(1) if of_look.samples == 1 => of_look,
            Some(1) => FrameAntialiasing { method: Antialiasing::None, samples: 1 },
            Some(samples) => FrameAntialiasing { method: Antialiasing::Msaa, samples },
        }
    }

    /// The antialiasing of a frame that sets no samples for itself.
    fn look_antialiasing(&self, renderer: RendererKind, triangles: usize, pixels: u64) -> FrameAntialiasing {
        let Some(PresetRequest { preset, overrides }) = self.preset else {
            return FrameAntialiasing { method: self.antialias, samples: self.samples_per_pixel() };
        };
        let preset = preset.unwrap_or_else(|| LookPreset::of_antialiasing(renderer, triangles, pixels));
        match (overrides.antialias, overrides.samples) {
            (None, None) => preset.antialiasing(),
            // Several samples are only used by multisampling, so a number of samples implies the method.
            (None | Some(Antialiasing::Msaa), samples) => {
                FrameAntialiasing { method: Antialiasing::Msaa, samples: samples.unwrap_or(MULTISAMPLES) }
            }
            (Some(method), _) => FrameAntialiasing { method, samples: 1 },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::ShadowSettings;
    use super::*;

    const HD: u64 = 1280 * 720;

    fn request(preset: Option<LookPreset>, overrides: LookOverrides) -> RenderSettings {
        RenderSettings::default().with_preset(PresetRequest { preset, overrides })
    }

    /// Method and size of the shadow map.
    fn map(look: RenderSettings, renderer: RendererKind) -> (ShadowMethod, u32) {
        let shadow = look.with_shadow_map_for(renderer).shadow.expect("a shadow");
        (shadow.method, shadow.size)
    }

    #[test]
    fn rule_depends_on_renderer_pixels_and_triangles() {
        let look = request(None, LookOverrides::default());
        let samples = |renderer, triangles, pixels| look.frame_antialiasing(renderer, triangles, pixels, None).samples;
        for (triangles, pixels) in [(1, 1), (1 << 24, 8192 * 8192)] {
            assert_eq!(samples(RendererKind::Hardware, triangles, pixels), 4);
        }
        let software = |triangles, pixels| samples(RendererKind::Software, triangles, pixels);
        let (small, few) = (SOFTWARE_STANDARD_PIXELS, SOFTWARE_STANDARD_TRIANGLES);
        assert_eq!([software(few, small), software(few, small + 1), software(few + 1, small)], [4, 1, 1]);
        assert_eq!(software(usize::MAX, u64::MAX), 1);
        assert_eq!(look.frame_antialiasing(RendererKind::Software, 1, HD, None).method, Antialiasing::None);
        let [hardware, software] = [RendererKind::Hardware, RendererKind::Software].map(|kind| map(look, kind));
        assert_ne!(hardware, software);
        assert!(hardware.1 > software.1, "expected a smaller map in software");
    }

    #[test]
    fn still_pictures_have_four_samples_where_the_rule_would_choose() {
        let samples_of = |look: RenderSettings, samples| {
            look.frame_antialiasing(RendererKind::Software, usize::MAX, u64::MAX, samples)
        };
        let by_rule = request(None, LookOverrides::default());
        assert_eq!((by_rule.still_samples(), samples_of(by_rule, None).samples), (Some(4), 1));
        let standard = request(Some(LookPreset::Standard), LookOverrides::default());
        assert_eq!(samples_of(by_rule, by_rule.still_samples()), samples_of(standard, None));
        let fxaa = LookOverrides { antialias: Some(Antialiasing::Fxaa), ..LookOverrides::default() };
        let one_sample = LookOverrides { samples: Some(1), ..LookOverrides::default() };
        for look in [
            standard,
            request(Some(LookPreset::Preview), LookOverrides::default()),
            request(None, fxaa),
            request(None, one_sample),
            RenderSettings::default(),
        ] {
            assert_eq!(look.still_samples(), None, "{look:?}");
        }
        // One sample keeps a method that needs no more.
        assert_eq!(samples_of(request(None, fxaa), Some(1)).method, Antialiasing::Fxaa);
        assert_eq!(samples_of(standard, Some(1)), FrameAntialiasing { method: Antialiasing::None, samples: 1 });
        assert_eq!(samples_of(request(None, fxaa), Some(4)).method, Antialiasing::Msaa);
    }

    #[test]
    fn named_preset_gives_equal_settings_on_every_renderer() {
        for preset in LookPreset::ALL {
            let look = request(Some(preset), LookOverrides::default());
            let [hardware, software] = [RendererKind::Hardware, RendererKind::Software].map(|renderer| {
                (look.with_shadow_map_for(renderer), look.frame_antialiasing(renderer, 1 << 24, 8192 * 8192, None))
            });
            assert_eq!(hardware, software, "{preset:?}");
            assert_eq!(preset.name().parse(), Ok(preset));
        }
        let message = "fast".parse::<LookPreset>().expect_err("an unknown name").to_string();
        assert_eq!(message, "look: expected preview, standard or best, got fast");
    }

    #[test]
    fn overrides_win_over_presets_and_over_the_rule() {
        let presets = [None, Some(LookPreset::Preview), Some(LookPreset::Standard), Some(LookPreset::Best)];
        for preset in presets {
            for renderer in [RendererKind::Hardware, RendererKind::Software] {
                let antialiasing = |antialias, samples| {
                    let overrides = LookOverrides { antialias, samples, ..LookOverrides::default() };
                    request(preset, overrides).frame_antialiasing(renderer, 1 << 24, HD, None)
                };
                let expected = |method, samples| FrameAntialiasing { method, samples };
                assert_eq!(antialiasing(None, Some(4)), expected(Antialiasing::Msaa, 4), "{preset:?}");
                assert_eq!(antialiasing(None, Some(1)), expected(Antialiasing::Msaa, 1), "{preset:?}");
                assert_eq!(antialiasing(Some(Antialiasing::Msaa), None), expected(Antialiasing::Msaa, 4));
                assert_eq!(antialiasing(Some(Antialiasing::Fxaa), None), expected(Antialiasing::Fxaa, 1));
                assert_eq!(antialiasing(Some(Antialiasing::None), Some(4)), expected(Antialiasing::None, 1));
                let overrides = LookOverrides {
                    shadow_method: Some(ShadowMethod::Standard),
                    shadow_size: Some(300),
                    shadow_blur: Some(7.0),
                    ..LookOverrides::default()
                };
                let shadow = request(preset, overrides).with_shadow_map_for(renderer).shadow.expect("a shadow");
                let base = ShadowSettings { method: ShadowMethod::Standard, size: 300, ..ShadowSettings::default() };
                assert_eq!(shadow, ShadowSettings { blur: 7.0, ..base });
            }
        }
    }

    #[test]
    fn settings_without_request_are_final() {
        let shadow = Some(ShadowSettings { size: 77, ..ShadowSettings::default() });
        let look = RenderSettings { samples: 1, shadow, ..RenderSettings::default() };
        assert_eq!(look.with_shadow_map_for(RendererKind::Software), look);
        assert_eq!(look.frame_antialiasing(RendererKind::Hardware, 1, 1, None).samples, 1);
        // A preset does not add the shadow that a scene has removed.
        let without_shadow = RenderSettings { shadow: None, ..look }.with_preset(PresetRequest::default());
        assert_eq!(without_shadow.with_shadow_map_for(RendererKind::Hardware).shadow, None);
    }
}
