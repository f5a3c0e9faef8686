//! The rendering variants: ways to draw the same scene, each a change of its look.
//!
//! To add a variant, add it to [`all`]: its name, method, change of the look, and intended result.

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
    /// Transparency method, for variants that compare it; otherwise that of the load's look.
    pub transparency: Option<Transparency>,
    /// Packing of images in arrays, for variants that compare it.
    pub packing: Option<Packing>,
    /// Culling, for variants that compare it. It does not change the picture.
    pub culling: Option<Culling>,
    /// Implementation of the shadow blur. It does not change the picture beyond rounding.
    pub blur_method: BlurMethod,
    pub aim: ReferenceKind,
}

/// Twice the errors of small pictures with many leaves, where each leaf covers a pixel or two; all other errors are far
/// below. A missing or displaced shadow exceeds the last two bounds, however small its part of the picture is.
pub(super) const ERROR_LIMITS: ErrorLimits =
    ErrorLimits { mean_color: 16.0, mean_light: 0.2, bleeding: 0.25, lost: 0.25 };
/// Bound on light bleeding of a filtered map where no two casters overlap: Chebyshev's bound is exact there, and only
/// rounding remains.
const EXACT: f64 = 0.01;
/// Bound on the mean light error of the shelf. Its shadow fills half of the picture and is narrower than the widest
/// blur. The depths of the ground itself then vary as much as the shelf's height above it, and most of the sunlight
/// leaks through.
const NARROW: f64 = 0.4;

/// Sides of shadow maps, and standard deviations of their blur in texels.
const SIZES: [u32; 4] = [512, 1024, 2048, 4096];
const BLURS: [f32; 3] = [0.0, 1.5, 4.0];

impl RenderVariant {
    /// The look of a scene as this variant draws it.
    pub fn look(&self, look: RenderSettings) -> RenderSettings {
        let (transparency, culling) =
            (self.transparency.unwrap_or(look.transparency), self.culling.unwrap_or(look.culling));
        RenderSettings { shadow: self.shadow, transparency, culling, ..look }
    }

    /// Whether a load has the features that the variant compares.
    pub fn suits(&self, load: RenderWorkload) -> bool {
        let is_large = matches!(load, RenderWorkload::Tree | RenderWorkload::Grove | RenderWorkload::Triangles(_));
        let has_images = self.packing.is_some() == (load == RenderWorkload::Images);
        has_images
            && (self.transparency.is_none() || load == RenderWorkload::Panes)
            && (self.culling.is_none() || is_large)
    }

    /// Error bounds on a load.
    pub fn bounds(&self, load: RenderWorkload) -> ErrorLimits {
        let bleeding = match (self.aim, load) {
            (ReferenceKind::Filtered { .. }, RenderWorkload::Square | RenderWorkload::Shelf) => EXACT,
            _ => ERROR_LIMITS.bleeding,
        };
        let mean_light = if load == RenderWorkload::Shelf { NARROW } else { ERROR_LIMITS.mean_light };
        ErrorLimits { bleeding, mean_light, ..ERROR_LIMITS }
    }

    /// Whether the variant is stated to exceed its bounds on a load: f16 second moments let light into a shadow near
    /// its caster.
    pub fn is_to_fail(&self, load: RenderWorkload) -> bool {
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
            aim: ReferenceKind::Unshadowed,
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
            aim: ReferenceKind::Hard,
        }
    }

    /// A map whose comparisons are weighted by a Gaussian of `blur` texels around the shaded point (PCF).
    fn filtered(size: u32, blur: f32) -> Self {
        let shadow = ShadowSettings { method: ShadowMethod::PercentageCloser, size, blur, ..ShadowSettings::default() };
        Self::soft(format!("filtered {size}, blur {blur}"), ShadowVariant::Filtered, shadow)
    }

    /// A variance map whose moments are blurred by a Gaussian of `blur` texels and then interpolated.
    fn variance(size: u32, blur: f32) -> Self {
        let shadow = ShadowSettings { size, blur, ..ShadowSettings::default() };
        Self::soft(format!("variance {size}, blur {blur}"), ShadowVariant::Variance, shadow)
    }

    fn f16(size: u32) -> Self {
        let shadow = ShadowSettings { size, moments: MomentFormat::F16, ..ShadowSettings::default() };
        Self::soft(format!("variance {size}, f16"), ShadowVariant::Variance, shadow)
    }

    /// A variance map without light-bleeding reduction.
    fn uncut(size: u32, blur: f32) -> Self {
        let shadow = ShadowSettings { size, blur, bleeding: 0.0, ..ShadowSettings::default() };
        Self::soft(format!("variance {size}, blur {blur}, bleeding uncut"), ShadowVariant::Variance, shadow)
    }

    /// A map that is fitted to the corners of the bounding box, as in the thesis.
    fn cornered(size: u32) -> Self {
        let shadow = ShadowSettings { size, fit: ShadowFit::Corners, ..ShadowSettings::default() };
        Self::soft(format!("variance {size}, fitted to corners"), ShadowVariant::Variance, shadow)
    }

    /// The same picture with the blur in other passes: a baseline for times.
    fn blurred((size, blur): (u32, f32), (name, blur_method): (&str, BlurMethod)) -> Self {
        let shadow = ShadowSettings { size, blur, ..ShadowSettings::default() };
        let name = format!("variance {size}, blur {blur}, {name}");
        Self { blur_method, ..Self::soft(name, ShadowVariant::Variance, shadow) }
    }

    /// Cascaded maps, sharper near the camera. The intended result is the hard shadow.
    fn split(size: u32, splits: u32) -> Self {
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
            aim: ReferenceKind::Hard,
        }
    }

    /// Panes with this transparency method, without shadows.
    fn blended(name: &str, transparency: Transparency) -> Self {
        Self { name: name.into(), transparency: Some(transparency), ..Self::unshadowed() }
    }

    /// Images with this packing, without shadows.
    fn packed(name: &str, packing: Packing) -> Self {
        Self { name: name.into(), packing: Some(packing), ..Self::unshadowed() }
    }

    /// The same picture from fewer triangles.
    fn culled((name, culling): (&str, Culling)) -> Self {
        Self { name: format!("culling {name}"), culling: Some(culling), ..Self::variance(2048, BLURS[1]) }
    }

    fn soft(name: String, method: ShadowVariant, shadow: ShadowSettings) -> Self {
        let aim = ReferenceKind::Filtered { texels: shadow.filter_deviation() };
        Self {
            name,
            method,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            blur_method: BlurMethod::Auto,
            aim,
        }
    }
}

/// All variants, or the few of a quick run.
pub fn all(quick: bool) -> Vec<RenderVariant> {
    if quick {
        return few();
    }
    let mut all = vec![RenderVariant::unshadowed()];
    for size in SIZES {
        all.push(RenderVariant::standard(size));
        all.extend(BLURS[1..].iter().map(|blur| RenderVariant::filtered(size, *blur)));
        all.extend(BLURS.iter().map(|blur| RenderVariant::variance(size, *blur)));
    }
    all.extend([2048, 4096].map(RenderVariant::f16));
    all.extend(BLURS[1..].iter().map(|blur| RenderVariant::uncut(1024, *blur)));
    all.extend((2..=4).map(|splits| RenderVariant::split(1024, splits)));
    all.push(RenderVariant::cornered(2048));
    let passes = [("tiles", BlurMethod::Tiles), ("rows", BlurMethod::Rows), ("fragments", BlurMethod::Fragments)];
    // Blurs of 25 taps per direction, and of 15.
    for map in [(1024, 4.0), (4096, 4.0), (4096, 2.3)] {
        all.extend(passes.map(|pass| RenderVariant::blurred(map, pass)));
    }
    all.push(RenderVariant::blended("exact transparency", Transparency::OrderIndependent));
    all.push(RenderVariant::blended("two-pass transparency", Transparency::TwoPass));
    all.extend(packings());
    all.extend(cullings());
    all
}

fn packings() -> [RenderVariant; 3] {
    [
        RenderVariant::packed("images by size", Packing::Classes),
        RenderVariant::packed("images repeat-filled", Packing::Repeated),
        RenderVariant::packed("images repeat-filled, whole", Packing::RepeatedWhole),
    ]
}

fn cullings() -> [RenderVariant; 3] {
    [("none", Culling::None), ("triangles", Culling::Triangles), ("depth", Culling::Occlusion)]
        .map(RenderVariant::culled)
}

fn few() -> Vec<RenderVariant> {
    let mut few = vec![
        RenderVariant::unshadowed(),
        RenderVariant::variance(512, BLURS[1]),
        RenderVariant::variance(512, BLURS[2]),
        RenderVariant::variance(2048, BLURS[1]),
        RenderVariant::standard(1024),
        RenderVariant::filtered(1024, BLURS[1]),
        RenderVariant::f16(2048),
        RenderVariant::split(1024, 3),
        RenderVariant::cornered(2048),
        RenderVariant::blended("exact transparency", Transparency::OrderIndependent),
        RenderVariant::blended("two-pass transparency", Transparency::TwoPass),
    ];
    few.extend(packings());
    few.extend(cullings());
    few
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
                let look = variant.look(RenderSettings::default());
                let transparency = variant.transparency.unwrap_or_default();
                let culling = variant.culling.unwrap_or_default();
                let plain = RenderSettings { shadow: None, transparency, culling, ..RenderSettings::default() };
                assert_eq!(RenderSettings { shadow: None, ..look }, plain);
                let (blends, packs) = (variant.transparency.is_some(), variant.packing.is_some());
                let suits = [RenderWorkload::Panes, RenderWorkload::Tree, RenderWorkload::Images]
                    .map(|load| variant.suits(load));
                let culls = variant.culling.is_some();
                assert_eq!(suits, [!packs && !culls, !packs && !blends, packs], "{}", variant.name);
                assert_eq!(look.shadow.is_none(), variant.aim == ReferenceKind::Unshadowed);
            }
        }
    }
    #[test]
    fn only_f16_on_the_shelf_is_stated_to_fail() {
        for variant in all(false) {
            let loads: Vec<RenderWorkload> =
                RenderWorkload::all(false).into_iter().filter(|load| variant.is_to_fail(*load)).collect();
            let wanted: &[RenderWorkload] = if variant.name.contains("f16") { &[RenderWorkload::Shelf] } else { &[] };
            assert_eq!(loads, wanted, "{}", variant.name);
        }
    }

    #[test]
    fn only_filtered_maps_get_the_exact_bleeding_bound() {
        let soft = RenderVariant::variance(512, 1.5);
        assert!(
            soft.bounds(RenderWorkload::Square).bleeding < 0.02 && soft.bounds(RenderWorkload::Tree) == ERROR_LIMITS
        );
        assert_eq!(RenderVariant::standard(512).bounds(RenderWorkload::Square), ERROR_LIMITS);
    }
}
