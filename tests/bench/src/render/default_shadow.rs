//! Chooses the default shadow map from the measurements of a report, and compares it with the shipped default.
//!
//! The rule: of all variants of the shadow map whose mean light error is at most the limit on every workload, the
//! default is the one with the least time. The light error is that of the sun visibility against the reference with
//! hard shadows, which is the same for all variants, so that blur counts as an error. The limit is the error that
//! changes a white surface in full sunlight by one level of 255 on hardware, and by two levels in software. The light
//! error depends on the size of the image, so the rule applies only to images of 1920 x 1080 on hardware and of
//! 1280 x 720 in software, for which the shipped defaults are chosen. The time is the geometric mean of the frame times
//! over the workloads, so that all have the same weight.
//!
//! Standard maps are not candidates: they are not filtered, and the mean error does not show their jagged edges. The
//! workloads `shelf` and `layers` are not used: their images show only a few texels of the map, so their errors depend
//! on the width of the blur.

use serde::Serialize;

use super::harness::Size;
use super::measure::RenderRow;
use super::workloads::RenderWorkload;
use modalcast_model::scene::{
    Culling, MomentFormat, PresetRequest, RenderSettings, RendererKind, ShadowMethod, ShadowSettings,
};
use modalcast_render::{BlurMethod, RendererInfo};

/// Mean error of the sun visibility that changes a white surface in full sunlight by one level of 255. The slope of the
/// sRGB curve at white is 255 * 1.055 / 2.4 levels, and the default sun contributes 0.76 of the light.
const LIGHT_ERROR_OF_LEVEL: f64 = 2.4 / (255.0 * 1.055 * 0.76);
/// Largest mean errors in levels of 255. Software has the larger limit, because its frames take longer.
const HARDWARE_LEVELS: f64 = 1.0;
const SOFTWARE_LEVELS: f64 = 2.0;
/// The size of the images from which the default is chosen.
const HARDWARE_SIZE: Size = Size { width: 1920, height: 1080 };
const SOFTWARE_SIZE: Size = Size { width: 1280, height: 720 };

/// The default shadow map by the measurements of a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DefaultShadow {
    /// The limit of the rule on the mean light error.
    pub max_light_error: f64,
    /// The workloads that every candidate was measured on.
    pub loads: Vec<String>,
    /// Fastest first.
    pub candidates: Vec<DefaultCandidate>,
    /// The size of the images to which the rule applies.
    pub rule_size: Size,
    /// Whether the images of the report have this size.
    pub has_rule_size: bool,
    /// The variant that the rule chooses; `None` if no candidate is within the limit or the images have another size.
    pub chosen: Option<String>,
    /// The variant that is the shipped default on this kind of renderer; `None` if it was not measured.
    pub shipped: Option<String>,
}

/// A variant that the rule can choose.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DefaultCandidate {
    pub name: String,
    /// Largest mean light error of a workload.
    pub light_error: f64,
    /// The workload with this error.
    pub worst_load: String,
    /// Geometric mean of the median frame times.
    pub frame_us: f64,
}

impl DefaultShadow {
    /// Applies the rule to the rows of a report. `None` if no variant of the shadow map was timed.
    pub(super) fn choose(rows: &[RenderRow], renderer: &RendererInfo, size: Size) -> Option<Self> {
        let (kind, levels, rule_size) = match renderer.software {
            true => (RendererKind::Software, SOFTWARE_LEVELS, SOFTWARE_SIZE),
            false => (RendererKind::Hardware, HARDWARE_LEVELS, HARDWARE_SIZE),
        };
        let has_rule_size = size == rule_size;
        let max_light_error = levels * LIGHT_ERROR_OF_LEVEL;
        let rows: Vec<&RenderRow> = rows.iter().filter(|row| is_candidate(row)).collect();
        let distinct = |name: fn(&RenderRow) -> &str| {
            let mut names: Vec<String> = Vec::new();
            for row in &rows {
                if !names.iter().any(|known| known == name(row)) {
                    names.push(name(row).to_owned());
                }
            }
            names
        };
        let (loads, variants) = (distinct(|row| &row.load), distinct(|row| &row.name));
        let candidate = |variant: &String| {
            let rows: Vec<&&RenderRow> = rows.iter().filter(|row| row.name == *variant).collect();
            (rows.len() == loads.len()).then(|| DefaultCandidate::of(variant, &rows)).flatten()
        };
        let mut candidates: Vec<DefaultCandidate> = variants.iter().filter_map(candidate).collect();
        candidates.sort_by(|a, b| a.frame_us.total_cmp(&b.frame_us));
        let is_allowed = |candidate: &&DefaultCandidate| has_rule_size && candidate.light_error <= max_light_error;
        let chosen = candidates.iter().find(is_allowed).map(|candidate| candidate.name.clone());
        let shipped_map = shipped_shadow(kind);
        let shipped = rows.iter().find(|row| row.shadow == Some(shipped_map)).map(|row| row.name.clone());
        let has_candidates = !candidates.is_empty();
        has_candidates.then_some(Self { max_light_error, loads, candidates, rule_size, has_rule_size, chosen, shipped })
    }

    /// Whether the shipped default is the variant that the rule chooses.
    pub fn is_shipped(&self) -> bool {
        self.chosen.is_some() && self.chosen == self.shipped
    }

    /// The table of the candidates and the choice, as lines of text.
    pub fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!(
            "default shadow map: least geometric mean of frame times on {}, light error at most {:.4}",
            self.loads.join(", "),
            self.max_light_error
        )];
        lines.extend(self.candidates.iter().map(|candidate| {
            let DefaultCandidate { name, light_error, worst_load, frame_us } = candidate;
            format!("  {name:<40}{frame_us:>12.1} us{light_error:>10.5} on {worst_load}")
        }));
        if !self.has_rule_size {
            let Size { width, height } = self.rule_size;
            lines.push(format!("  none is chosen: the default is chosen from images of {width} x {height} pixels"));
            return lines;
        }
        let name = |variant: &Option<String>| variant.clone().unwrap_or_else(|| "none of the measured".into());
        let verdict = if self.is_shipped() { "equal to" } else { "different from" };
        lines.push(format!("  chosen: {}; {verdict} the shipped default: {}", name(&self.chosen), name(&self.shipped)));
        lines
    }
}

impl DefaultCandidate {
    /// `rows`: the rows of a variant, one for each workload. `None` if one of them was not timed or has no error.
    fn of(name: &str, rows: &[&&RenderRow]) -> Option<Self> {
        let mut log_sum = 0.0;
        for row in rows {
            log_sum += row.median_us().filter(|us| *us > 0.0)?.ln();
        }
        let light_error = |row: &RenderRow| row.light_errors.all_pixels.mean;
        let worst = rows.iter().max_by(|a, b| light_error(a).total_cmp(&light_error(b)))?;
        Some(Self {
            name: name.into(),
            light_error: light_error(worst),
            worst_load: worst.load.clone(),
            frame_us: (log_sum / rows.len() as f64).exp(),
        })
    }
}

/// The shadow map that a scene without settings has on a kind of renderer.
fn shipped_shadow(kind: RendererKind) -> ShadowSettings {
    let look = RenderSettings::default().with_preset(PresetRequest::default());
    look.with_shadow_map_for(kind).shadow.unwrap_or_default()
}

/// Whether a row is a variant of the shadow map: it compares neither another feature nor an implementation of the blur.
fn is_candidate(row: &RenderRow) -> bool {
    let has_default_parts = |shadow: ShadowSettings| {
        shadow.bleeding == ShadowSettings::default().bleeding
            && shadow.moments == MomentFormat::F32
            && shadow.pcf_fallback
    };
    row.shadow.is_some_and(|shadow| has_default_parts(shadow) && shadow.method != ShadowMethod::Standard)
        && row.blur_method == BlurMethod::Auto
        && !row.name.starts_with("culling")
        && row.culling == Culling::default()
        && ![RenderWorkload::Shelf, RenderWorkload::Layers].iter().any(|workload| row.load == workload.name())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::error_limits::ErrorLimits;
    use crate::render::harness::PassTime;
    use crate::render::metrics::{ErrorDistribution, LightErrors};
    use crate::render::variants;
    use crate::render::workloads::RenderWorkload;
    use crate::timing::Timing;

    fn renderer(software: bool) -> RendererInfo {
        RendererInfo {
            renderer: "test".into(),
            version: "test".into(),
            software,
            cuda_device: None,
            max_side: 8192,
            pixel_readback: modalcast_render::PixelReadback::CopyEngine,
        }
    }

    /// A row with this frame time; `us` 0 means that it was not timed.
    fn row(load: &str, name: &str, shadow: ShadowSettings, us: f64, error: f64) -> RenderRow {
        let all_pixels = ErrorDistribution { mean: error, ..ErrorDistribution::default() };
        let timing = Timing::of(vec![us; 20]).expect("a timing");
        let passes = if us > 0.0 { vec![PassTime { name: "frame", timing }] } else { vec![] };
        let template = variants::all(true).remove(1);
        RenderRow {
            load: load.into(),
            name: name.into(),
            method: template.method,
            shadow: Some(shadow),
            blur_method: BlurMethod::Auto,
            packing: None,
            culling: Culling::default(),
            error_limits: ErrorLimits::of_workload(RenderWorkload::Tree),
            passed: true,
            is_expected_to_fail: false,
            faults: vec![],
            color_errors: ErrorDistribution::default(),
            intended_color_errors: ErrorDistribution::default(),
            surface_color_errors: ErrorDistribution::default(),
            light_errors: LightErrors { all_pixels, ..LightErrors::default() },
            intended_light_errors: LightErrors::default(),
            flicker: None,
            flicker_skip_reason: None,
            passes,
            bytes: 0,
            shadow_bytes: 0,
            image_bytes: 0,
            samples: 4,
            draws: 0,
            cull_stats: None,
        }
    }

    #[test]
    fn fastest_variant_within_the_limit_on_every_workload_is_chosen() {
        let shipped = shipped_shadow(RendererKind::Hardware);
        let other = |size| ShadowSettings { size, ..shipped };
        let standard = ShadowSettings { method: ShadowMethod::Standard, ..shipped };
        let f16 = ShadowSettings { moments: MomentFormat::F16, ..shipped };
        let moments_only = ShadowSettings { pcf_fallback: false, ..shipped };
        let rows = |shipped_us| {
            vec![
                // Faster, but above the limit on one workload.
                row("tree", "small", other(99), 10.0, 0.002),
                row("square", "small", other(99), 10.0, 0.02),
                row("tree", "shipped", shipped, shipped_us, 0.011),
                row("square", "shipped", shipped, shipped_us, 0.001),
                // Slower on one workload, faster on the other; the geometric mean is 200.
                row("tree", "large", other(999), 1000.0, 0.001),
                row("square", "large", other(999), 40.0, 0.001),
                // Not candidates: not filtered, not timed on a workload, another format, no fallback, and a workload
                // that is not used.
                row("tree", "standard", standard, 1.0, 0.0),
                row("square", "standard", standard, 1.0, 0.0),
                row("tree", "untimed", other(77), 1.0, 0.0),
                row("square", "untimed", other(77), 0.0, 0.0),
                row("tree", "f16", f16, 1.0, 0.0),
                row("square", "f16", f16, 1.0, 0.0),
                row("tree", "moments only", moments_only, 1.0, 0.0),
                row("square", "moments only", moments_only, 1.0, 0.0),
                row("shelf", "shipped", shipped, 1.0, 0.9),
                row("layers", "shipped", shipped, 1.0, 0.9),
            ]
        };
        let default = DefaultShadow::choose(&rows(100.0), &renderer(false), HARDWARE_SIZE).expect("candidates");
        assert_eq!((default.chosen.as_deref(), default.is_shipped()), (Some("shipped"), true));
        let names: Vec<&str> = default.candidates.iter().map(|candidate| candidate.name.as_str()).collect();
        assert_eq!(names, ["small", "shipped", "large"]);
        assert!((default.candidates[2].frame_us - 200.0).abs() < 1e-9, "{}", default.candidates[2].frame_us);
        assert_eq!(default.candidates[0].worst_load, "square");
        let slower = DefaultShadow::choose(&rows(300.0), &renderer(false), HARDWARE_SIZE).expect("candidates");
        assert_eq!((slower.chosen.as_deref(), slower.is_shipped()), (Some("large"), false));
        // The limit of software renderers is larger, and their default is another map.
        let software = DefaultShadow::choose(&rows(100.0), &renderer(true), SOFTWARE_SIZE).expect("candidates");
        assert_eq!(
            (software.chosen.as_deref(), software.shipped, software.max_light_error > 0.02),
            (Some("small"), None, true)
        );
        // The images of the report have another size.
        let smaller = DefaultShadow::choose(&rows(100.0), &renderer(false), SOFTWARE_SIZE).expect("candidates");
        assert_eq!((smaller.chosen.as_deref(), smaller.candidates.len()), (None, 3));
        assert!(smaller.lines().last().is_some_and(|line| line.contains("1920 x 1080")), "{:?}", smaller.lines());
        assert_eq!(DefaultShadow::choose(&[], &renderer(false), HARDWARE_SIZE), None);
    }
}
