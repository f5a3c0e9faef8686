//! The rendering variants: ways to draw the same scene, each with changed render settings.
//!
//! To add a variant, add it to [`all`]: its name, method, changed settings, and intended result.

use serde::Serialize;

use super::packing::Packing;
use super::workloads::RenderWorkload;
use modalcast_model::scene::{
    Culling, MomentFormat, RenderSettings, ShadowFit, ShadowMethod, ShadowSettings, Transparency,
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

/// Error bounds of a variant against its intended result.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorLimits {
    /// Mean color error of a pixel, of 255.
    #[serde(rename = "mean_colour")]
    pub mean_color: f64,
    /// Mean error of the sun visibility, of 1.
    pub mean_light: f64,
    /// Mean sun visibility inside the umbra (light bleeding), of 1.
    pub bleeding: f64,
    /// Mean sun visibility that is missing outside of shadows, of 1.
    pub lost: f64,
}

/// One way to draw a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderVariant {
    /// Unique within a report.
    pub name: String,
    pub method: ShadowVariant,
    pub shadow: Option<ShadowSettings>,
    /// Transparency method, for variants that compare it; `None` uses that of the load's settings.
    pub transparency: Option<Transparency>,
    /// Packing of images in arrays, for variants that compare it.
    pub packing: Option<Packing>,
    /// Culling, for variants that compare it. It does not change the image.
    pub culling: Option<Culling>,
    /// Implementation of the shadow blur. It changes the image only by rounding.
    pub blur_method: BlurMethod,
    pub intended: ReferenceKind,
}

/// Twice the errors of small images with many leaves, where each leaf covers a pixel or two; all other errors are far
/// smaller. A missing or displaced shadow exceeds `bleeding` or `lost` even if it covers a small part of the image.
pub(super) const ERROR_LIMITS: ErrorLimits =
    ErrorLimits { mean_color: 16.0, mean_light: 0.2, bleeding: 0.25, lost: 0.25 };
/// Bound on light bleeding of a filtered map where no two casters overlap: Chebyshev's bound is exact there, and only
/// rounding remains.
const EXACT_BLEEDING_LIMIT: f64 = 0.01;
/// Bound on the mean light error of the shelf. Its shadow fills half of the image and is narrower than the widest blur.
/// The depths of the ground itself then vary as much as the shelf's height above it, and most of the sunlight
/// leaks through.
const SHELF_MEAN_LIGHT_LIMIT: f64 = 0.4;

/// Sides of shadow maps, texels.
const SIZES: [u32; 4] = [512, 1024, 2048, 4096];
/// Standard deviations of the blur, texels.
const BLURS: [f32; 3] = [0.0, 1.5, 4.0];

impl RenderVariant {
    /// The render settings of a scene as this variant draws it.
    pub fn settings(&self, look: RenderSettings) -> RenderSettings {
        let (transparency, culling) =
            (self.transparency.unwrap_or(look.transparency), self.culling.unwrap_or(look.culling));
        RenderSettings { shadow: self.shadow, transparency, culling, ..look }
    }

    /// Whether a load has the features that the variant compares.
    pub fn is_applicable(&self, load: RenderWorkload) -> bool {
        let is_large = matches!(load, RenderWorkload::Tree | RenderWorkload::Grove | RenderWorkload::Triangles(_));
        let has_images = self.packing.is_some() == (load == RenderWorkload::Images);
        has_images
            && (self.transparency.is_none() || load == RenderWorkload::Panes)
            && (self.culling.is_none() || is_large)
    }

    /// Error bounds on a load.
    pub fn bounds(&self, load: RenderWorkload) -> ErrorLimits {
        let bleeding = match (self.intended, load) {
            (ReferenceKind::Filtered { .. }, RenderWorkload::Square | RenderWorkload::Shelf) => EXACT_BLEEDING_LIMIT,
            _ => ERROR_LIMITS.bleeding,
        };
        let mean_light = if load == RenderWorkload::Shelf { SHELF_MEAN_LIGHT_LIMIT } else { ERROR_LIMITS.mean_light };
        ErrorLimits { bleeding, mean_light, ..ERROR_LIMITS }
    }

    /// Whether the variant is expected to exceed its bounds on a load: with f16 second moments, light bleeds into a
    /// shadow near its caster.
    pub fn is_expected_to_fail(&self, load: RenderWorkload) -> bool {
        load == RenderWorkload::Shelf && self.shadow.is_some_and(|shadow| shadow.moments == MomentFormat::F16)
    }

    fn unshadowed() -> Self {
        Self {
            name: "none".into(),
            method: ShadowVariant::None,
            shadow: None,
            transparency: None,
            packing: None,
            culling: None,
            blur_method: BlurMethod::Auto,
            intended: ReferenceKind::Unshadowed,
        }
    }

    /// One standard map. The intended result is the hard shadow, whatever the size of the texels.
    fn standard(size: u32) -> Self {
        let shadow = ShadowSettings { method: ShadowMethod::Standard, size, ..ShadowSettings::default() };
        Self {
            name: format!("standard {size}"),
            method: ShadowVariant::Standard,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            blur_method: BlurMethod::Auto,
            intended: ReferenceKind::Hard,
        }
    }

    /// A map whose comparisons are weighted by a Gaussian of `blur` texels around the shaded point (PCF).
    fn filtered(size: u32, blur: f32) -> Self {
        let shadow = ShadowSettings { method: ShadowMethod::PercentageCloser, size, blur, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("filtered {size}, blur {blur}"), ShadowVariant::Filtered, shadow)
    }

    /// A variance map whose moments are blurred by a Gaussian of `blur` texels and then interpolated.
    fn variance(size: u32, blur: f32) -> Self {
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

    /// A map that is fitted to the corners of the bounding box, as in the thesis.
    fn fitted_to_corners(size: u32) -> Self {
        let shadow = ShadowSettings { size, fit: ShadowFit::Corners, ..ShadowSettings::default() };
        Self::with_soft_shadow(format!("variance {size}, fitted to corners"), ShadowVariant::Variance, shadow)
    }

    /// A variance map with this implementation of the blur: a baseline for times.
    fn with_blur_method((size, blur): (u32, f32), (name, blur_method): (&str, BlurMethod)) -> Self {
        let shadow = ShadowSettings { size, blur, ..ShadowSettings::default() };
        let name = format!("variance {size}, blur {blur}, {name}");
        Self { blur_method, ..Self::with_soft_shadow(name, ShadowVariant::Variance, shadow) }
    }

    /// Cascaded maps, sharper near the camera. The intended result is the hard shadow.
    fn with_splits(size: u32, splits: u32) -> Self {
        let shadow = ShadowSettings { size, splits, ..ShadowSettings::default() };
        let name = format!("variance {size}, {splits} splits");
        Self {
            name,
            method: ShadowVariant::Variance,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            blur_method: BlurMethod::Auto,
            intended: ReferenceKind::Hard,
        }
    }

    /// Panes with this transparency method, without shadows.
    fn with_transparency(name: &str, transparency: Transparency) -> Self {
        Self { name: name.into(), transparency: Some(transparency), ..Self::unshadowed() }
    }

    /// Images with this packing, without shadows.
    fn with_packing(name: &str, packing: Packing) -> Self {
        Self { name: name.into(), packing: Some(packing), ..Self::unshadowed() }
    }

    /// The same image with this culling.
    fn with_culling((name, culling): (&str, Culling)) -> Self {
        Self { name: format!("culling {name}"), culling: Some(culling), ..Self::variance(2048, BLURS[1]) }
    }

    /// A variant whose intended result is the filtered shadow.
    fn with_soft_shadow(name: String, method: ShadowVariant, shadow: ShadowSettings) -> Self {
        let intended = ReferenceKind::Filtered { texels: shadow.filter_deviation() };
        Self {
            name,
            method,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            blur_method: BlurMethod::Auto,
            intended,
        }
    }
}

/// All variants, or a selection for a quick run.
pub fn all(quick: bool) -> Vec<RenderVariant> {
    if quick {
        return quick_variants();
    }
    let mut all = vec![RenderVariant::unshadowed()];
    for size in SIZES {
        all.push(RenderVariant::standard(size));
        all.extend(BLURS[1..].iter().map(|blur| RenderVariant::filtered(size, *blur)));
        all.extend(BLURS.iter().map(|blur| RenderVariant::variance(size, *blur)));
    }
    all.extend([2048, 4096].map(RenderVariant::with_f16_moments));
    all.extend(BLURS[1..].iter().map(|blur| RenderVariant::without_bleeding_reduction(1024, *blur)));
    all.extend((2..=4).map(|splits| RenderVariant::with_splits(1024, splits)));
    all.push(RenderVariant::fitted_to_corners(2048));
    let passes = [("tiles", BlurMethod::Tiles), ("rows", BlurMethod::Rows), ("fragments", BlurMethod::Fragments)];
    // Blurs of 25 taps per direction, and of 15.
    for map in [(1024, 4.0), (4096, 4.0), (4096, 2.3)] {
        all.extend(passes.map(|pass| RenderVariant::with_blur_method(map, pass)));
    }
    all.push(RenderVariant::with_transparency("exact transparency", Transparency::OrderIndependent));
    all.push(RenderVariant::with_transparency("two-pass transparency", Transparency::TwoPass));
    all.extend(packings());
    all.extend(cullings());
    all
}

fn packings() -> [RenderVariant; 3] {
    [
        RenderVariant::with_packing("images by size", Packing::Classes),
        RenderVariant::with_packing("images repeat-filled", Packing::Repeated),
        RenderVariant::with_packing("images repeat-filled, whole", Packing::RepeatedWhole),
    ]
}

fn cullings() -> [RenderVariant; 3] {
    [("none", Culling::None), ("triangles", Culling::Triangles), ("depth", Culling::Occlusion)]
        .map(RenderVariant::with_culling)
}

fn quick_variants() -> Vec<RenderVariant> {
    let mut quick = vec![
        RenderVariant::unshadowed(),
        RenderVariant::variance(512, BLURS[1]),
        RenderVariant::variance(512, BLURS[2]),
        RenderVariant::variance(2048, BLURS[1]),
        RenderVariant::standard(1024),
        RenderVariant::filtered(1024, BLURS[1]),
        RenderVariant::with_f16_moments(2048),
        RenderVariant::with_splits(1024, 3),
        RenderVariant::fitted_to_corners(2048),
        RenderVariant::with_transparency("exact transparency", Transparency::OrderIndependent),
        RenderVariant::with_transparency("two-pass transparency", Transparency::TwoPass),
    ];
    quick.extend(packings());
    quick.extend(cullings());
    quick
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_unique_and_variants_change_only_their_feature() {
        for quick in [false, true] {
            let all = all(quick);
            let names: std::collections::BTreeSet<&str> = all.iter().map(|variant| variant.name.as_str()).collect();
            assert_eq!((names.len(), all.len()), if quick { (17, 17) } else { (50, 50) });
            for variant in &all {
                let look = variant.settings(RenderSettings::default());
                let transparency = variant.transparency.unwrap_or_default();
                let culling = variant.culling.unwrap_or_default();
                let expected = RenderSettings { shadow: None, transparency, culling, ..RenderSettings::default() };
                assert_eq!(RenderSettings { shadow: None, ..look }, expected);
                let (has_transparency, has_packing) = (variant.transparency.is_some(), variant.packing.is_some());
                let is_applicable = [RenderWorkload::Panes, RenderWorkload::Tree, RenderWorkload::Images]
                    .map(|load| variant.is_applicable(load));
                let has_culling = variant.culling.is_some();
                assert_eq!(
                    is_applicable,
                    [!has_packing && !has_culling, !has_packing && !has_transparency, has_packing],
                    "{}",
                    variant.name
                );
                assert_eq!(look.shadow.is_none(), variant.intended == ReferenceKind::Unshadowed);
            }
        }
    }
    #[test]
    fn only_f16_on_the_shelf_is_expected_to_fail() {
        for variant in all(false) {
            let loads: Vec<RenderWorkload> =
                RenderWorkload::all(false).into_iter().filter(|load| variant.is_expected_to_fail(*load)).collect();
            let expected: &[RenderWorkload] = if variant.name.contains("f16") { &[RenderWorkload::Shelf] } else { &[] };
            assert_eq!(loads, expected, "{}", variant.name);
        }
    }

    #[test]
    fn only_filtered_maps_get_the_exact_bleeding_bound() {
        let filtered = RenderVariant::variance(512, 1.5);
        assert!(
            filtered.bounds(RenderWorkload::Square).bleeding < 0.02
                && filtered.bounds(RenderWorkload::Tree) == ERROR_LIMITS
        );
        assert_eq!(RenderVariant::standard(512).bounds(RenderWorkload::Square), ERROR_LIMITS);
    }
}
