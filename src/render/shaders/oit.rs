//! Shader sources of exact transparency: gather, histogram, allocate and resolve.

use std::fmt::Write as _;

use super::{
    BARYCENTRICS, CLIP, FRAME, OIT_LISTS, PHONG, ProgramSource, ShaderOptions, TRIANGLE_ID, TRIANGLE_SHADING,
    UvDerivatives, VERSION, vertex_and_fragment,
};
use crate::layout::oit::{BINS, HISTOGRAM_TILE};
use crate::layout::{TILE, TILE_ROW};
use crate::scene_data::geometry::BlendMode;

impl ShaderOptions {
    /// Counts the blended fragments of each pixel, and adds them to the lists.
    pub(crate) fn oit_gather(&self, samples: u32) -> ProgramSource {
        // Extension directives must precede all other code.
        let post_depth_coverage = samples > 1 && self.post_depth_coverage;
        let more: &[&str] = if post_depth_coverage { &["MASK", "POST_DEPTH_COVERAGE"] } else { &["MASK"] };
        let extension = if post_depth_coverage { "#extension GL_ARB_post_depth_coverage : require\n" } else { "" };
        let material_defines = self.material_defines(&[BlendMode::Blend]);
        let vertex =
            [&self.head(&["MASK"]), &material_defines, FRAME, CLIP, include_str!("../../../shaders/visibility.vert")];
        let head = self.head(more) + extension + &material_defines + &bins();
        let (material_lookups, sample_defines) =
            (self.material_lookups(&[BlendMode::Blend], UvDerivatives::Implicit), self.sample_defines(samples));
        let body = include_str!("../../../shaders/oit_gather.frag");
        let fragment = [&head, &sample_defines, &material_lookups, TRIANGLE_ID, OIT_LISTS, body].concat();
        ProgramSource {
            label: format!("oit gather, {samples} samples"),
            stages: vertex_and_fragment(vertex.concat(), fragment),
        }
    }

    /// Sorts, shades and blends the lists to layers.
    pub(crate) fn oit_resolve(&self, samples: u32) -> ProgramSource {
        let mut text = self.head(&[]) + &bins() + &tiles() + &self.material_defines(&[BlendMode::Blend]);
        text += &[&self.sample_defines(samples), FRAME, CLIP, &self.sun(), OIT_LISTS].concat();
        text += &[
            &self.material_lookups(&[BlendMode::Blend], UvDerivatives::Explicit),
            PHONG,
            BARYCENTRICS,
            TRIANGLE_SHADING,
        ]
        .concat();
        text += include_str!("../../../shaders/oit_resolve.comp");
        ProgramSource::compute(format!("oit resolve, {samples} samples"), text)
    }
}

/// Builds the histogram of fragments per pixel.
pub(crate) fn histogram() -> ProgramSource {
    let head = format!("{VERSION}#define TILE_SIDE {HISTOGRAM_TILE}\n{}", bins());
    let text = [&head, OIT_LISTS, include_str!("../../../shaders/oit_histogram.comp")].concat();
    ProgramSource::compute("oit histogram", text)
}

/// Allocates the list of each pixel.
pub(crate) fn allocate() -> ProgramSource {
    let head = format!("{VERSION}{}{}", tiles(), bins());
    let text = [&head, OIT_LISTS, include_str!("../../../shaders/oit_allocate.comp")].concat();
    ProgramSource::compute("oit allocate", text)
}

fn bins() -> String {
    format!("#define BINS {BINS}\n")
}

fn tiles() -> String {
    let mut text = String::new();
    writeln!(text, "#define TILE {TILE}\n#define TILES_PER_ROW {TILE_ROW}u").ok();
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::features::ShaderFeatures;
    use crate::shaders::MaterialUse;

    fn options(post_depth_coverage: bool) -> ShaderOptions {
        let used = vec![MaterialUse { blend_mode: BlendMode::Blend, color: None, normal: None }];
        ShaderOptions {
            features: ShaderFeatures { blend_layers: true, oit: true, ..ShaderFeatures::NONE },
            used,
            sample_positions: vec![[0.5; 2]; 4],
            sample_resolve: String::new(),
            post_depth_coverage,
        }
    }

    #[test]
    fn coverage_after_the_depth_test_is_asked_for_where_it_is_known_and_needed() {
        let text = |post_depth_coverage: bool, samples: u32| {
            options(post_depth_coverage).oit_gather(samples).stages[1].1.clone()
        };
        for (post_depth_coverage, samples, asked) in [(true, 4, true), (false, 4, false), (true, 1, false)] {
            let text = text(post_depth_coverage, samples);
            assert_eq!(
                text.contains("#extension GL_ARB_post_depth_coverage"),
                asked,
                "{post_depth_coverage}, {samples}"
            );
            assert_eq!(text.contains("#define POST_DEPTH_COVERAGE"), asked, "{post_depth_coverage}, {samples}");
        }
    }

    #[test]
    fn glass_without_an_image_is_gathered_and_resolved_without_a_lookup() {
        for source in [options(true).oit_gather(4), options(true).oit_resolve(4)] {
            assert!(source.stages.iter().all(|(_, text)| !text.contains("vec4 color_texel(")), "{}", source.label);
        }
    }
}
