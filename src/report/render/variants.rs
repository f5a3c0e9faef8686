//! What is measured: ways to draw the same scene, each as a change of its look.
//!
//! To add one, add it to [`all`]: its name, its method, the change, and what it is meant to look like.

use serde::Serialize;

use crate::scene::{Look, Shadow};

/// How shadows are made.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Method {
    /// There are none.
    None,
    /// The variance shadow map.
    Variance,
}

/// What a variant means to show: the reference that it must be near to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Aim {
    /// No shadow at all.
    Unshadowed,
    /// The edge of a shadow as soft as a bell of this deviation, in texels of its own map.
    Filtered { texels: f64 },
}

/// One way to draw a scene.
#[derive(Debug, Clone, PartialEq)]
pub struct Variant {
    /// Unique within a report.
    pub name: String,
    pub method: Method,
    pub shadow: Option<Shadow>,
    pub aim: Aim,
}

/// Sides of shadow maps and deviations of their blur, texels.
const SIZES: [u32; 4] = [512, 1024, 2048, 4096];
const BLURS: [f32; 3] = [0.0, 1.5, 4.0];

impl Variant {
    /// The look of a scene as this variant draws it.
    pub fn look(&self, look: Look) -> Look {
        Look { shadow: self.shadow, ..look }
    }

    fn unshadowed() -> Self {
        Self { name: "none".into(), method: Method::None, shadow: None, aim: Aim::Unshadowed }
    }

    /// A variance map of this size, its moments blurred by a bell of `blur` texels and then read between texels, which
    /// is a tent of variance 1/6: the footprint is that of both.
    fn variance(size: u32, blur: f32) -> Self {
        let texels = (f64::from(blur).powi(2) + 1.0 / 6.0).sqrt();
        Self {
            name: format!("variance {size}, blur {blur}"),
            method: Method::Variance,
            shadow: Some(Shadow { size, blur, ..Shadow::default() }),
            aim: Aim::Filtered { texels },
        }
    }
}

/// Every variant, or the few of a quick run.
pub fn all(quick: bool) -> Vec<Variant> {
    let (sizes, blurs): (&[u32], &[f32]) = if quick { (&[512, 2048], &BLURS[1..]) } else { (&SIZES, &BLURS) };
    let maps = sizes.iter().flat_map(|size| blurs.iter().map(|blur| Variant::variance(*size, *blur)));
    std::iter::once(Variant::unshadowed()).chain(maps).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_differ_and_only_the_shadow_of_a_look_changes() {
        for quick in [false, true] {
            let all = all(quick);
            let names: std::collections::BTreeSet<&str> = all.iter().map(|variant| variant.name.as_str()).collect();
            assert_eq!((names.len(), all.len()), if quick { (5, 5) } else { (13, 13) });
            for variant in &all {
                let look = variant.look(Look::default());
                assert_eq!(Look { shadow: None, ..look }, Look { shadow: None, ..Look::default() });
                assert_eq!(look.shadow.is_none(), variant.aim == Aim::Unshadowed);
            }
        }
    }
}
