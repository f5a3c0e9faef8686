//! The largest errors that a variant may have against its intended result.

use serde::Serialize;

use super::packing::Packing;
use super::variants::{ReferenceKind, RenderVariant};
use super::workloads::RenderWorkload;
use modalcast_model::scene::Transparency;

/// Error limits of a variant against its intended result.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ErrorLimits {
    /// Mean color error of a pixel, of 255.
    pub mean_color: f64,
    /// Mean color error of a pixel that shows a triangle, of 255; `None` without such a limit.
    pub mean_surface_color: Option<f64>,
    /// Mean error of the sun visibility, of 1.
    pub mean_light: f64,
    /// Mean sun visibility inside the umbra (light bleeding), of 1.
    pub bleeding: f64,
    /// Mean sun visibility that is missing outside of shadows, of 1.
    #[serde(rename = "lost")]
    pub lost_visibility: f64,
}

impl ErrorLimits {
    /// No limits.
    const NONE: Self = Self {
        mean_color: f64::INFINITY,
        mean_surface_color: None,
        mean_light: f64::INFINITY,
        bleeding: f64::INFINITY,
        lost_visibility: f64::INFINITY,
    };

    /// The limits of a variant on a workload: 1.5 times the largest error of all variants, which llvmpipe drew with
    /// 640x360 pixels, against references of 64 samples per pixel. Larger images should have smaller errors, because fewer
    /// of their pixels lie on edges. On the grove and the field (300,000 triangles), 23 variants were measured, among them
    /// the coarsest maps and the widest blurs, most of them against 16 samples.
    ///
    /// Variants with cascades are compared with hard shadows, outside of which filtered depths lose half of each penumbra:
    /// most of `lost_visibility` on layers, tree and grove. Some limits were not measured in the way above:
    /// - Layers: 1.5 times the errors of a model of the scene, except for `lost_visibility`, which is 1.5 times that of the
    ///   cascades at 1920x1080 on an H200 (0.077; 0.075 by llvmpipe).
    /// - `lost_visibility` of tree and grove: 1.5 times the errors of llvmpipe (0.0022 and 0.012) with an earlier form of
    ///   the fallback to filtered depths, which lost more. The tree has 0.0018 at 1920x1080 on an H200.
    /// - Bracket: less than the error of an image without ambient occlusion.
    pub(super) fn of(variant: &RenderVariant, workload: RenderWorkload) -> Self {
        let limits = Self::of_workload(workload);
        let has_bleeding_reduction = variant.shadow.is_none_or(|shadow| shadow.bleeding > 0.0);
        match (workload, variant.intended_reference) {
            // The shelf is the only caster, so Chebyshev's bound is exact, except where the depth of the ground varies
            // within the blur. The reduction of light bleeding removes most of that light.
            (RenderWorkload::Shelf, ReferenceKind::Filtered { .. }) if has_bleeding_reduction => {
                Self { bleeding: 0.02, ..limits }
            }
            (RenderWorkload::Shelf, ReferenceKind::Filtered { .. }) => Self { bleeding: 0.27, ..limits },
            // Filtered shadows leave the umbra dark, within 0.0003. Moments alone light it by 0.018.
            (RenderWorkload::Layers, ReferenceKind::Filtered { .. }) => Self { bleeding: 0.002, ..limits },
            // The passes of the thesis blend panes in the order of the list, not of their depth.
            (RenderWorkload::Panes, _) if variant.transparency == Some(Transparency::TwoPass) => {
                Self { mean_color: 4.0, ..limits }
            }
            // The rule of the thesis repeats images at a wrong scale.
            (RenderWorkload::Images, _) if variant.packing == Some(Packing::PrintedRepetition) => {
                Self { mean_color: 14.4, ..limits }
            }
            _ => limits,
        }
    }

    /// The limits of the variants without an exception.
    pub(super) const fn of_workload(workload: RenderWorkload) -> Self {
        match workload {
            // Edges without antialiasing; a map of 256 texels with a blur of 4.
            RenderWorkload::Square => {
                Self { mean_color: 0.9, mean_light: 0.0036, bleeding: 0.0013, lost_visibility: 0.0003, ..Self::NONE }
            }
            // Its shadow fills half of the image and is narrower than the widest blur, so most of the sunlight leaks
            // into the shadow. Texels of standard maps of 256 shade the ground.
            RenderWorkload::Shelf => {
                Self { mean_color: 13.0, mean_light: 0.385, bleeding: 0.123, lost_visibility: 0.185, ..Self::NONE }
            }
            // The image is as wide as 26 texels of a map of 256: a blur of 4 shades all of it, and the reduction of
            // light bleeding moves edges by a texel. Texels of a standard map of 256 cover a part of the lit wedge.
            RenderWorkload::Layers => {
                Self { mean_color: 8.1, mean_light: 0.045, bleeding: 0.0084, lost_visibility: 0.115, ..Self::NONE }
            }
            RenderWorkload::Panes => {
                Self { mean_color: 1.2, mean_light: 0.0094, bleeding: 0.0013, lost_visibility: 0.0003, ..Self::NONE }
            }
            // Differences of filtering between the texture units and the reference.
            RenderWorkload::Images => {
                Self { mean_color: 5.9, mean_light: 0.0001, bleeding: 0.0001, lost_visibility: 0.0001, ..Self::NONE }
            }
            // Differences between horizon angles in the image and rays in the scene. There are no shadows.
            RenderWorkload::Bracket => Self {
                mean_color: 3.0,
                mean_surface_color: Some(3.0),
                mean_light: 0.0001,
                bleeding: 0.0001,
                lost_visibility: 0.0001,
            },
            // Leaves of a pixel or two: without antialiasing, a pixel shows one of several leaves.
            RenderWorkload::Tree => {
                Self { mean_color: 5.4, mean_light: 0.08, bleeding: 0.075, lost_visibility: 0.0033, ..Self::NONE }
            }
            // Four trees in an image of the same size have smaller leaves.
            RenderWorkload::Grove => {
                Self { mean_color: 11.6, mean_light: 0.195, bleeding: 0.163, lost_visibility: 0.018, ..Self::NONE }
            }
            // Poles cast thin shadows, which a map of 256 texels with a blur of 4 widens.
            RenderWorkload::Triangles(_) => {
                Self { mean_color: 1.5, mean_light: 0.022, bleeding: 0.03, lost_visibility: 0.0096, ..Self::NONE }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::variants;
    use super::*;

    /// In the umbra, the mean sun visibility of a missing shadow is 1, that of a shadow displaced by a third of its width
    /// is 1/3.
    #[test]
    fn shadows_displaced_by_a_third_of_their_width_exceed_the_limits() {
        for workload in RenderWorkload::all(false) {
            let shadows = variants::all(false).into_iter().filter(|variant| variant.shadow.is_some());
            for variant in shadows.filter(|variant| variant.is_applicable(workload)) {
                assert!(ErrorLimits::of(&variant, workload).bleeding < 0.3, "{} on {workload:?}", variant.name);
            }
        }
    }

    #[test]
    fn only_the_methods_of_the_thesis_have_other_limits_of_color() {
        for workload in RenderWorkload::all(false) {
            let limit = ErrorLimits::of_workload(workload).mean_color;
            let exceptions = variants::all(false).into_iter().filter(|variant| {
                variant.is_applicable(workload) && ErrorLimits::of(variant, workload).mean_color > limit
            });
            let names: Vec<String> = exceptions.map(|variant| variant.name).collect();
            let expected: &[&str] = match workload {
                RenderWorkload::Panes => &["two-pass transparency"],
                RenderWorkload::Images => &["images repeat-filled"],
                _ => &[],
            };
            assert_eq!(names, expected);
        }
    }
}
