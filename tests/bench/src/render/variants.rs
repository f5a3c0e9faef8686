//! What is measured: ways to draw the same scene, each as a change of its look.
//!
//! To add one, add it to [`all`]: its name, its method, the change, and what it is meant to look like.

use serde::Serialize;

use super::loads::Kind;
use super::packing::Packing;
use modalcast_model::scene::{Blurring, Culling, Fit, Look, Moments, Shadow, ShadowMethod, Transparency};

/// How shadows are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// There are none.
    None,
    /// The standard shadow map.
    Standard,
    /// Percentage-closer filtering.
    Filtered,
    /// The variance shadow map.
    Variance,
}

/// What a variant means to show: the reference that it must be near to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aim {
    /// No shadow at all.
    Unshadowed,
    /// The edge of a shadow as a sun without size makes it.
    Hard,
    /// The edge of a shadow as soft as a bell of this deviation, in texels of its own map.
    Filtered { texels: f64 },
}

/// What a variant must keep against what it means to show.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Bounds {
    /// Mean error of a pixel, of 255.
    pub mean_colour: f64,
    /// Mean error of the light that arrives, of 1.
    pub mean_light: f64,
    /// Mean light where none should be, and mean light that is missing where all should be, of 1.
    pub bleeding: f64,
    pub lost: f64,
}

/// One way to draw a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Variant {
    /// Unique within a report.
    pub name: String,
    pub method: Method,
    pub shadow: Option<Shadow>,
    /// How blended triangles are drawn, where that is what is compared; else as the look of the load says.
    pub transparency: Option<Transparency>,
    /// How images lie in arrays, where that is what is compared.
    pub packing: Option<Packing>,
    /// What is left out before it is drawn, where that is what is compared: the picture is the same.
    pub culling: Option<Culling>,
    pub aim: Aim,
}

/// Twice what small pictures of many leaves are found at, where each leaf is a pixel or two; all others are far below. A
/// shadow that is missing or lies elsewhere exceeds the last two however little of the picture it takes.
pub(super) const BOUNDS: Bounds = Bounds { mean_colour: 16.0, mean_light: 0.2, bleeding: 0.25, lost: 0.25 };
/// The light that a filtered map may let into the umbra where no two casters overlap: the bound of Chebyshev is exact
/// there, and only rounding is left.
const EXACT: f64 = 0.01;
/// The mean error of light on the shelf, whose shadow fills half of the picture and is narrower than the widest blur:
/// the depths of the ground itself then vary as much as the shelf is above it, and most of the sun gets through.
const NARROW: f64 = 0.4;

/// Sides of shadow maps and deviations of their blur, texels.
const SIZES: [u32; 4] = [512, 1024, 2048, 4096];
const BLURS: [f32; 3] = [0.0, 1.5, 4.0];

impl Variant {
    /// The look of a scene as this variant draws it.
    pub fn look(&self, look: Look) -> Look {
        let (transparency, culling) =
            (self.transparency.unwrap_or(look.transparency), self.culling.unwrap_or(look.culling));
        Look { shadow: self.shadow, transparency, culling, ..look }
    }

    /// Whether a load has what it is about.
    pub fn suits(&self, load: Kind) -> bool {
        let is_large = matches!(load, Kind::Tree | Kind::Grove | Kind::Triangles(_));
        let has_images = self.packing.is_some() == (load == Kind::Images);
        has_images && (self.transparency.is_none() || load == Kind::Panes) && (self.culling.is_none() || is_large)
    }

    /// What it must keep on a load.
    pub fn bounds(&self, load: Kind) -> Bounds {
        let bleeding = match (self.aim, load) {
            (Aim::Filtered { .. }, Kind::Square | Kind::Shelf) => EXACT,
            _ => BOUNDS.bleeding,
        };
        let mean_light = if load == Kind::Shelf { NARROW } else { BOUNDS.mean_light };
        Bounds { bleeding, mean_light, ..BOUNDS }
    }

    /// Whether it is there to be seen to exceed its bounds: the second moment of f16 lets light into a shadow near its
    /// caster.
    pub fn is_to_fail(&self, load: Kind) -> bool {
        load == Kind::Shelf && self.shadow.is_some_and(|shadow| shadow.moments == Moments::F16)
    }

    fn unshadowed() -> Self {
        Self {
            name: "none".into(),
            method: Method::None,
            shadow: None,
            transparency: None,
            packing: None,
            culling: None,
            aim: Aim::Unshadowed,
        }
    }

    /// One map, hard: it means to show the hard shadow, whatever its texels.
    fn standard(size: u32) -> Self {
        let shadow = Shadow { method: ShadowMethod::Standard, size, ..Shadow::default() };
        Self {
            name: format!("standard {size}"),
            method: Method::Standard,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            aim: Aim::Hard,
        }
    }

    /// A map whose answers are weighed by a bell of `blur` texels that moves with the point.
    fn filtered(size: u32, blur: f32) -> Self {
        let shadow = Shadow { method: ShadowMethod::Filtered, size, blur, ..Shadow::default() };
        Self::soft(format!("filtered {size}, blur {blur}"), Method::Filtered, shadow)
    }

    /// A variance map of this size, its moments blurred by a bell of `blur` texels and then read between texels.
    fn variance(size: u32, blur: f32) -> Self {
        let shadow = Shadow { size, blur, ..Shadow::default() };
        Self::soft(format!("variance {size}, blur {blur}"), Method::Variance, shadow)
    }

    fn f16(size: u32) -> Self {
        let shadow = Shadow { size, moments: Moments::F16, ..Shadow::default() };
        Self::soft(format!("variance {size}, f16"), Method::Variance, shadow)
    }

    /// A variance map without the cut that keeps light from bleeding.
    fn uncut(size: u32, blur: f32) -> Self {
        let shadow = Shadow { size, blur, bleeding: 0.0, ..Shadow::default() };
        Self::soft(format!("variance {size}, blur {blur}, bleeding uncut"), Method::Variance, shadow)
    }

    /// A map that is fitted to the corners of a box, as the thesis has it.
    fn cornered(size: u32) -> Self {
        let shadow = Shadow { size, fit: Fit::Corners, ..Shadow::default() };
        Self::soft(format!("variance {size}, fitted to corners"), Method::Variance, shadow)
    }

    /// The same picture, blurred by other passes: a baseline of time.
    fn blurred((size, blur): (u32, f32), (name, blurring): (&str, Blurring)) -> Self {
        let shadow = Shadow { size, blur, blurring, ..Shadow::default() };
        Self::soft(format!("variance {size}, blur {blur}, {name}"), Method::Variance, shadow)
    }

    /// Maps split by distance: the nearer the sharper, so that all of them mean to show the hard shadow.
    fn split(size: u32, splits: u32) -> Self {
        let shadow = Shadow { size, splits, ..Shadow::default() };
        let name = format!("variance {size}, {splits} splits");
        Self {
            name,
            method: Method::Variance,
            shadow: Some(shadow),
            transparency: None,
            packing: None,
            culling: None,
            aim: Aim::Hard,
        }
    }

    /// Panes as this method blends them, without shadows.
    fn blended(name: &str, transparency: Transparency) -> Self {
        Self { name: name.into(), transparency: Some(transparency), ..Self::unshadowed() }
    }

    /// Images packed so, without shadows.
    fn packed(name: &str, packing: Packing) -> Self {
        Self { name: name.into(), packing: Some(packing), ..Self::unshadowed() }
    }

    /// The same picture from fewer triangles.
    fn culled((name, culling): (&str, Culling)) -> Self {
        Self { name: format!("culling {name}"), culling: Some(culling), ..Self::variance(2048, BLURS[1]) }
    }

    fn soft(name: String, method: Method, shadow: Shadow) -> Self {
        let aim = Aim::Filtered { texels: shadow.deviation() };
        Self { name, method, shadow: Some(shadow), transparency: None, packing: None, culling: None, aim }
    }
}

/// Every variant, or the few of a quick run.
pub fn all(quick: bool) -> Vec<Variant> {
    if quick {
        return few();
    }
    let mut all = vec![Variant::unshadowed()];
    for size in SIZES {
        all.push(Variant::standard(size));
        all.extend(BLURS[1..].iter().map(|blur| Variant::filtered(size, *blur)));
        all.extend(BLURS.iter().map(|blur| Variant::variance(size, *blur)));
    }
    all.extend([2048, 4096].map(Variant::f16));
    all.extend(BLURS[1..].iter().map(|blur| Variant::uncut(1024, *blur)));
    all.extend((2..=4).map(|splits| Variant::split(1024, splits)));
    all.push(Variant::cornered(2048));
    let passes = [("tiles", Blurring::Tiles), ("rows", Blurring::Rows), ("fragments", Blurring::Fragments)];
    // 25 depths in each direction, and 15.
    for map in [(1024, 4.0), (4096, 4.0), (4096, 2.3)] {
        all.extend(passes.map(|pass| Variant::blurred(map, pass)));
    }
    all.push(Variant::blended("exact transparency", Transparency::Exact));
    all.push(Variant::blended("two-pass transparency", Transparency::TwoPass));
    all.extend(packings());
    all.extend(cullings());
    all
}

fn packings() -> [Variant; 3] {
    [
        Variant::packed("images by size", Packing::Classes),
        Variant::packed("images repeat-filled", Packing::Repeated),
        Variant::packed("images repeat-filled, whole", Packing::RepeatedWhole),
    ]
}

fn cullings() -> [Variant; 3] {
    [("none", Culling::None), ("triangles", Culling::Triangles), ("depth", Culling::Depth)].map(Variant::culled)
}

fn few() -> Vec<Variant> {
    let mut few = vec![
        Variant::unshadowed(),
        Variant::variance(512, BLURS[1]),
        Variant::variance(512, BLURS[2]),
        Variant::variance(2048, BLURS[1]),
        Variant::standard(1024),
        Variant::filtered(1024, BLURS[1]),
        Variant::f16(2048),
        Variant::split(1024, 3),
        Variant::cornered(2048),
        Variant::blended("exact transparency", Transparency::Exact),
        Variant::blended("two-pass transparency", Transparency::TwoPass),
    ];
    few.extend(packings());
    few.extend(cullings());
    few
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_differ_and_only_the_shadow_of_a_look_changes_or_how_it_blends() {
        for quick in [false, true] {
            let all = all(quick);
            let names: std::collections::BTreeSet<&str> = all.iter().map(|variant| variant.name.as_str()).collect();
            assert_eq!((names.len(), all.len()), if quick { (17, 17) } else { (50, 50) });
            for variant in &all {
                let look = variant.look(Look::default());
                let transparency = variant.transparency.unwrap_or_default();
                let culling = variant.culling.unwrap_or_default();
                let plain = Look { shadow: None, transparency, culling, ..Look::default() };
                assert_eq!(Look { shadow: None, ..look }, plain);
                let (blends, packs) = (variant.transparency.is_some(), variant.packing.is_some());
                let suits = [Kind::Panes, Kind::Tree, Kind::Images].map(|load| variant.suits(load));
                let culls = variant.culling.is_some();
                assert_eq!(suits, [!packs && !culls, !packs && !blends, packs], "{}", variant.name);
                assert_eq!(look.shadow.is_none(), variant.aim == Aim::Unshadowed);
            }
        }
    }
    #[test]
    fn f16_is_to_fail_beside_its_caster_alone_and_nothing_else_is() {
        for variant in all(false) {
            let loads: Vec<Kind> = Kind::all(false).into_iter().filter(|load| variant.is_to_fail(*load)).collect();
            let wanted: &[Kind] = if variant.name.contains("f16") { &[Kind::Shelf] } else { &[] };
            assert_eq!(loads, wanted, "{}", variant.name);
        }
    }

    #[test]
    fn soft_maps_alone_are_held_to_the_exact_bound_where_it_is_exact() {
        let soft = Variant::variance(512, 1.5);
        assert!(soft.bounds(Kind::Square).bleeding < 0.02 && soft.bounds(Kind::Tree) == BOUNDS);
        assert_eq!(Variant::standard(512).bounds(Kind::Square), BOUNDS);
    }
}
