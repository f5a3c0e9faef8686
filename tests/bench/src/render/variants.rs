//! The rendering variants: ways to draw the same scene, each with changed render settings.
//!
//! To add a variant, add it to [`all`]: its name, method, changed settings, and intended result.

use serde::Serialize;

use super::packing::Packing;
use super::workloads::RenderWorkload;
use modalcast_model::scene::{
    Antialiasing, Culling, LookOverrides, LookPreset, MomentFormat, PresetRequest, RenderSettings, ShadowFit,
    ShadowMethod, ShadowSettings, Transparency,
};
use modalcast_render::BlurMethod;

/// Shadow technique.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum ShadowVariant {
    /// No shadows.
    None,
    /// Standard shadow map.
    Standard,
    /// Percentage-closer filtering.
    Filtered,
    /// Variance shadow map.
    Variance,
}

/// Sampling of the ambient occlusion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OcclusionVariant {
    /// One texel per pixel, as GPUs sample it, and all renderers for pictures.
    FullResolution,
    /// One texel for 2 x 2 pixels, as a CPU samples it for streams.
    HalfResolution,
    /// No ambient occlusion.
    None,
}

/// Intended result of a variant: the reference that it is compared with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ReferenceKind {
    /// No shadow at all.
    Unshadowed,
    /// Hard shadow edges, as of a point light.
    Hard,
    /// Shadow edges filtered by a Gaussian of this standard deviation, in texels of the variant's own map.
    Filtered { texels: f64 },
}

/// One way to draw a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderVariant {
    /// Unique within a report.
    pub name: String,
    pub method: ShadowVariant,
    pub shadow: Option<ShadowSettings>,
    /// Transparency method, for variants that compare it; `None` uses that of the scene's settings.
    pub transparency: Option<Transparency>,
    /// Packing of images in arrays, for variants that compare it.
    pub packing: Option<Packing>,
    /// Culling, for variants that compare it. It does not change the image.
    pub culling: Option<Culling>,
    /// Antialiasing, for variants that compare it.
    pub antialias: Option<Antialiasing>,
    /// Sampling of the scene's ambient occlusion, for variants that compare it.
    pub occlusion: Option<OcclusionVariant>,
    /// Implementation of the shadow blur. It changes the image only by rounding.
    pub blur_method: BlurMethod,
    pub intended_reference: ReferenceKind,
}

/// Samples per pixel of multisampling, the only number that the renderer has.
const MULTISAMPLES: u32 = 4;

/// Sides of shadow maps, texels.
const MAP_SIZES: [u32; 5] = [256, 512, 1024, 2048, 4096];
/// Standard deviations of the blur, texels.
const BLUR_DEVIATIONS: [f32; 3] = [0.0, 1.5, 4.0];

impl RenderVariant {
    /// The render settings of a scene as this variant draws it.
    pub fn settings(&self, look: RenderSettings) -> RenderSettings {
        let (transparency, culling) =
            (self.transparency.unwrap_or(look.transparency), self.culling.unwrap_or(look.culling));
        let ambient_occlusion = look.ambient_occlusion.filter(|_| self.occlusion != Some(OcclusionVariant::None));
        let is_half = self.occlusion == Some(OcclusionVariant::HalfResolution);
        let preset = if is_half { Some(half_resolution_request(&look)) } else { look.preset };
        let settings = RenderSettings { shadow: self.shadow, transparency, culling, ambient_occlusion, preset, ..look };
        match self.antialias {
            Some(antialias) => RenderSettings { antialias, samples: MULTISAMPLES, ..settings },
            None => settings,
        }
    }

    /// Whether a workload has the features that the variant compares.
    pub fn is_applicable(&self, workload: RenderWorkload) -> bool {
        let is_large = matches!(workload, RenderWorkload::Tree | RenderWorkload::Grove | RenderWorkload::Triangles(_));
        let matches_packing = self.packing.is_some() == (workload == RenderWorkload::Images);
        let matches_occlusion = self.occlusion.is_some() == (workload == RenderWorkload::Bracket);
        matches_packing
            && matches_occlusion
            && (self.transparency.is_none() || workload == RenderWorkload::Panes)
            && (self.culling.is_none() || is_large)
            && (self.antialias.is_none() || is_large || workload == RenderWorkload::Square)
    }

    /// Whether the variant is expected to exceed its limits on a workload: moments alone let light bleed where layers
    /// of occluders overlap, and the recesses of the bracket are too bright without ambient occlusion.
    pub fn is_expected_to_fail(&self, workload: RenderWorkload) -> bool {
        let has_moments_only = |shadow: ShadowSettings| shadow.has_moments() && !shadow.pcf_fallback;
        match workload {
            RenderWorkload::Layers => self.shadow.is_some_and(has_moments_only),
            RenderWorkload::Bracket => self.occlusion == Some(OcclusionVariant::None),
            _ => false,
        }
    }

    fn without_shadow() -> Self {
        Self {
            name: "none".into(),
            method: ShadowVariant::None,
            shadow: None,
            transparency: None,
            packing: None,
            culling: None,
            antialias: None,
            occlusion: None,
            blur_method: BlurMethod::Auto,
            intended_reference: ReferenceKind::Unshadowed,
        }
    }

    /// One standard map. The intended result is the hard shadow for every map size.
    fn with_standard_map(size: u32) -> Self {
        let shadow = ShadowSettings { method: ShadowMethod::Standard, size, ..ShadowSettings::default() };
        Self {
            name: format!("standard {size}"),
            method: ShadowVariant::Standard,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            antialias: None,
            occlusion: None,
            blur_method: BlurMethod::Auto,
            intended_reference: ReferenceKind::Hard,
        }
    }

    /// A map whose comparisons are weighted by a Gaussian of `blur` texels around the shaded point (PCF).
    fn with_filtered_map(size: u32, blur: f32) -> Self {
        let shadow = ShadowSettings { method: ShadowMethod::PercentageCloser, size, blur, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("filtered {size}, blur {blur}"), ShadowVariant::Filtered, shadow)
    }

    /// A variance map whose moments are blurred by a Gaussian of `blur` texels and then interpolated.
    fn with_variance_map(size: u32, blur: f32) -> Self {
        let shadow = ShadowSettings { size, blur, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("variance {size}, blur {blur}"), ShadowVariant::Variance, shadow)
    }

    /// A variance map with f16 moments.
    fn with_f16_moments(size: u32) -> Self {
        let shadow = ShadowSettings { size, moments: MomentFormat::F16, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("variance {size}, f16"), ShadowVariant::Variance, shadow)
    }

    /// A variance map without light-bleeding reduction.
    fn without_bleeding_reduction(size: u32, blur: f32) -> Self {
        let shadow = ShadowSettings { size, blur, bleeding: 0.0, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("variance {size}, blur {blur}, bleeding uncut"), ShadowVariant::Variance, shadow)
    }

    /// A variance map without the fallback to filtered depths: its bound where light bleeds.
    fn without_fallback(size: u32) -> Self {
        let shadow = ShadowSettings { size, pcf_fallback: false, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("variance {size}, moments only"), ShadowVariant::Variance, shadow)
    }

    /// A map that is fitted to the corners of the bounding box, as in the thesis.
    fn with_corner_fit(size: u32) -> Self {
        let shadow = ShadowSettings { size, fit: ShadowFit::Corners, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("variance {size}, fitted to corners"), ShadowVariant::Variance, shadow)
    }

    /// A variance map with this implementation of the blur, to compare times.
    fn with_blur_method((size, blur): (u32, f32), (name, blur_method): (&str, BlurMethod)) -> Self {
        let shadow = ShadowSettings { size, blur, ..ShadowSettings::default() };
        let name = format!("variance {size}, blur {blur}, {name}");
        Self { blur_method, ..Self::with_soft_shadow(name, ShadowVariant::Variance, shadow) }
    }

    /// Cascaded maps, which are sharper near the camera. The intended result is the hard shadow, because the width of
    /// the blur varies with the cascade.
    fn with_cascades(size: u32, cascades: u32) -> Self {
        let shadow = ShadowSettings { size, cascades, ..ShadowSettings::default() };
        let name = format!("variance {size}, {cascades} splits");
        Self {
            name,
            method: ShadowVariant::Variance,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            antialias: None,
            occlusion: None,
            blur_method: BlurMethod::Auto,
            intended_reference: ReferenceKind::Hard,
        }
    }

    /// Panes with this transparency method, without shadows.
    fn with_transparency(name: &str, transparency: Transparency) -> Self {
        Self { name: name.into(), transparency: Some(transparency), ..Self::without_shadow() }
    }

    /// Images with this packing, without shadows.
    fn with_packing(name: &str, packing: Packing) -> Self {
        Self { name: name.into(), packing: Some(packing), ..Self::without_shadow() }
    }

    /// With or without the scene's ambient occlusion, without shadows.
    fn with_occlusion((name, occlusion): (&str, OcclusionVariant)) -> Self {
        Self { name: name.into(), occlusion: Some(occlusion), ..Self::without_shadow() }
    }

    /// One antialiasing method, without shadows. The reference has 64 samples per pixel, 16 in a quick run.
    fn with_antialias((name, antialias): (&str, Antialiasing)) -> Self {
        Self { name: format!("antialias {name}"), antialias: Some(antialias), ..Self::without_shadow() }
    }

    /// The default variance map with this culling, which does not change the image.
    fn with_culling((name, culling): (&str, Culling)) -> Self {
        Self {
            name: format!("culling {name}"),
            culling: Some(culling),
            ..Self::with_variance_map(2048, BLUR_DEVIATIONS[1])
        }
    }

    /// A variant whose intended result is the filtered shadow.
    fn with_soft_shadow(name: String, method: ShadowVariant, shadow: ShadowSettings) -> Self {
        let intended_reference = ReferenceKind::Filtered { texels: shadow.filter_deviation() };
        Self {
            name,
            method,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            antialias: None,
            occlusion: None,
            blur_method: BlurMethod::Auto,
            intended_reference,
        }
    }
}

/// All variants, or a selection for a quick run.
pub fn all(quick: bool) -> Vec<RenderVariant> {
    if quick {
        return quick_variants();
    }
    let mut variants = vec![RenderVariant::without_shadow()];
    for size in MAP_SIZES {
        variants.push(RenderVariant::with_standard_map(size));
        variants.extend(BLUR_DEVIATIONS[1..].iter().map(|blur| RenderVariant::with_filtered_map(size, *blur)));
        variants.extend(BLUR_DEVIATIONS.iter().map(|blur| RenderVariant::with_variance_map(size, *blur)));
    }
    variants.extend([2048, 4096].map(RenderVariant::with_f16_moments));
    variants.push(RenderVariant::without_fallback(1024));
    variants.extend(BLUR_DEVIATIONS[1..].iter().map(|blur| RenderVariant::without_bleeding_reduction(1024, *blur)));
    variants.extend((2..=4).map(|cascades| RenderVariant::with_cascades(1024, cascades)));
    variants.push(RenderVariant::with_corner_fit(2048));
    let blur_methods = [("tiles", BlurMethod::Tiles), ("rows", BlurMethod::Rows), ("fragments", BlurMethod::Fragments)];
    // Blurs of 25 taps per direction, and of 15.
    for map in [(1024, 4.0), (4096, 4.0), (4096, 2.3)] {
        variants.extend(blur_methods.map(|blur_method| RenderVariant::with_blur_method(map, blur_method)));
    }
    variants.push(RenderVariant::with_transparency("exact transparency", Transparency::OrderIndependent));
    variants.push(RenderVariant::with_transparency("two-pass transparency", Transparency::TwoPass));
    variants.extend(packing_variants());
    variants.extend(culling_variants());
    variants.extend(
        [("none", Antialiasing::None), ("4 samples", Antialiasing::Msaa), ("fxaa", Antialiasing::Fxaa)]
            .map(RenderVariant::with_antialias),
    );
    variants.extend(occlusion_variants());
    variants
}

fn packing_variants() -> [RenderVariant; 3] {
    [
        RenderVariant::with_packing("images by size", Packing::SizeClasses),
        RenderVariant::with_packing("images repeat-filled", Packing::PrintedRepetition),
        RenderVariant::with_packing("images repeat-filled, whole", Packing::CorrectedRepetition),
    ]
}

fn occlusion_variants() -> [RenderVariant; 3] {
    [
        ("occlusion", OcclusionVariant::FullResolution),
        ("occlusion, half resolution", OcclusionVariant::HalfResolution),
        ("no occlusion", OcclusionVariant::None),
    ]
    .map(RenderVariant::with_occlusion)
}

/// The preset that samples the ambient occlusion at half resolution, with the antialiasing of the look.
fn half_resolution_request(look: &RenderSettings) -> PresetRequest {
    let overrides =
        LookOverrides { antialias: Some(look.antialias), samples: Some(look.samples), ..LookOverrides::default() };
    PresetRequest { preset: Some(LookPreset::Preview), overrides }
}

fn culling_variants() -> [RenderVariant; 3] {
    [("none", Culling::None), ("triangles", Culling::Triangles), ("depth", Culling::Occlusion)]
        .map(RenderVariant::with_culling)
}

fn quick_variants() -> Vec<RenderVariant> {
    let mut variants = vec![
        RenderVariant::without_shadow(),
        RenderVariant::with_variance_map(256, BLUR_DEVIATIONS[1]),
        RenderVariant::with_variance_map(512, BLUR_DEVIATIONS[1]),
        RenderVariant::with_variance_map(512, BLUR_DEVIATIONS[2]),
        RenderVariant::with_variance_map(1024, BLUR_DEVIATIONS[1]),
        RenderVariant::with_variance_map(2048, BLUR_DEVIATIONS[1]),
        RenderVariant::with_standard_map(512),
        RenderVariant::with_standard_map(1024),
        RenderVariant::with_filtered_map(512, BLUR_DEVIATIONS[1]),
        RenderVariant::with_filtered_map(1024, BLUR_DEVIATIONS[1]),
        RenderVariant::with_f16_moments(2048),
        RenderVariant::without_fallback(1024),
        RenderVariant::with_cascades(1024, 3),
        RenderVariant::with_corner_fit(2048),
        RenderVariant::with_transparency("exact transparency", Transparency::OrderIndependent),
        RenderVariant::with_transparency("two-pass transparency", Transparency::TwoPass),
    ];
    variants.extend(packing_variants());
    variants.extend(culling_variants());
    variants.extend(occlusion_variants());
    variants
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::Lighting;

    #[test]
    fn names_are_unique_and_variants_change_only_their_feature() {
        for quick in [false, true] {
            let variants = all(quick);
            let names: std::collections::BTreeSet<&str> =
                variants.iter().map(|variant| variant.name.as_str()).collect();
            // Quick: 16 variants, 3 of packing, 3 of culling and 3 of occlusion. All: 1 without shadow, 5 map sizes x
            // 6, 2 f16, 1 without the fallback, 2 bleeding, 3 cascades, 1 corner fit, 3 maps x 3 blur methods, 2
            // transparency, 3 of packing, 3 of culling, 3 of antialiasing and 3 of occlusion.
            assert_eq!((names.len(), variants.len()), if quick { (25, 25) } else { (63, 63) });
            for variant in &variants {
                let settings = variant.settings(RenderSettings::default());
                let transparency = variant.transparency.unwrap_or_default();
                let culling = variant.culling.unwrap_or_default();
                let antialias = variant.antialias.unwrap_or_default();
                let expected =
                    RenderSettings { shadow: None, transparency, culling, antialias, ..RenderSettings::default() };
                assert_eq!(RenderSettings { shadow: None, preset: None, ..settings }, expected);
                let is_half = variant.occlusion == Some(OcclusionVariant::HalfResolution);
                assert_eq!(settings.preset.is_some(), is_half, "{}", variant.name);
                let (has_transparency, has_packing) = (variant.transparency.is_some(), variant.packing.is_some());
                let applies_to = [RenderWorkload::Panes, RenderWorkload::Tree, RenderWorkload::Images]
                    .map(|workload| variant.is_applicable(workload));
                let needs_large_scene = variant.culling.is_some() || variant.antialias.is_some();
                let has_plain_shading = !has_packing && variant.occlusion.is_none();
                assert_eq!(
                    applies_to,
                    [has_plain_shading && !needs_large_scene, has_plain_shading && !has_transparency, has_packing],
                    "panes, tree and images with {}",
                    variant.name
                );
                assert_eq!(settings.shadow.is_none(), variant.intended_reference == ReferenceKind::Unshadowed);
            }
        }
    }

    #[test]
    fn bracket_has_the_studio_with_and_without_its_occlusion() {
        let look = Lighting::Studio.settings();
        for quick in [false, true] {
            let mut variants = all(quick);
            variants.retain(|variant| variant.is_applicable(RenderWorkload::Bracket));
            let [full, half, without_occlusion] = &variants[..] else { panic!("expected three, got {variants:?}") };
            let expected = RenderSettings { shadow: None, ..look };
            assert_eq!(full.settings(look), expected);
            assert_eq!(RenderSettings { preset: None, ..half.settings(look) }, expected);
            assert_eq!(without_occlusion.settings(look), RenderSettings { ambient_occlusion: None, ..expected });
            assert!(expected.ambient_occlusion.is_some(), "control: the studio has ambient occlusion");
        }
    }

    #[test]
    fn only_moments_alone_and_no_occlusion_are_expected_to_fail() {
        for variant in all(false) {
            let workloads: Vec<RenderWorkload> = RenderWorkload::all(false)
                .into_iter()
                .filter(|workload| variant.is_expected_to_fail(*workload))
                .collect();
            let expected: &[RenderWorkload] = match variant.name.as_str() {
                "no occlusion" => &[RenderWorkload::Bracket],
                name if name.contains("moments only") => &[RenderWorkload::Layers],
                _ => &[],
            };
            assert_eq!(workloads, expected, "{}", variant.name);
        }
    }
}
