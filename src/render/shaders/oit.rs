//! Shader sources of exact transparency: gather, histogram, allocate and resolve.

use super::{
    BAND, CLIP, FRAGMENT_ALPHA, FRAME, OIT_LISTS, ProgramSource, ShaderOptions, TILE_APPEND, TRIANGLE_ID,
    UvDerivatives, VERSION, tile_list, vertex_and_fragment,
};
use crate::layout::oit::{BINS, HISTOGRAM_TILE};
use crate::scene_data::geometry::BlendMode;

impl ShaderOptions {
    /// Counts the blended fragments of each pixel, or adds them to the list of the pixel; see the phases in
    /// `layout::oit`.
    pub(crate) fn oit_gather(&self, samples: u32) -> ProgramSource {
        // An extension directive must precede all code except other directives.
        let post_depth_coverage = samples > 1 && self.post_depth_coverage;
        let defines: &[&str] = if post_depth_coverage { &["MASK", "POST_DEPTH_COVERAGE"] } else { &["MASK"] };
        let extension = if post_depth_coverage { "#extension GL_ARB_post_depth_coverage : require\n" } else { "" };
        let material_defines = self.material_defines(&[BlendMode::Blend]);
        let vertex =
            [&self.head(&["MASK"]), &material_defines, FRAME, CLIP, include_str!("../../../shaders/visibility.vert")];
        let head = self.head(defines) + extension + &material_defines + &bins_define();
        let (material_lookups, sample_defines) =
            (self.material_lookups(&[BlendMode::Blend], UvDerivatives::Implicit), self.sample_defines(samples));
        let body = include_str!("../../../shaders/oit_gather.frag");
        let fragment =
            [&head, &sample_defines, &material_lookups, TRIANGLE_ID, FRAGMENT_ALPHA, OIT_LISTS, body].concat();
        ProgramSource {
            label: format!("oit gather, {samples} samples"),
            stages: vertex_and_fragment(vertex.concat(), fragment),
        }
    }

    /// Sorts each list, and shades and blends its fragments to one blend layer per sample.
    pub(crate) fn oit_resolve(&self, samples: u32) -> ProgramSource {
        let mut text = self.head(&[]) + &bins_define() + &tile_list() + &self.material_defines(&[BlendMode::Blend]);
        text += &[&self.sample_defines(samples), FRAME, CLIP, &self.sun_visibility(), &self.ambient_light, OIT_LISTS]
            .concat();
        text += &self.triangle_shading(&[BlendMode::Blend], "");
        text += include_str!("../../../shaders/oit_resolve.comp");
        ProgramSource::compute(format!("oit resolve, {samples} samples"), text)
    }
}

/// Builds the histogram of fragments per pixel.
pub(crate) fn histogram() -> ProgramSource {
    let head = format!("{VERSION}#define TILE_SIDE {HISTOGRAM_TILE}\n{}", bins_define());
    let text = [&head, OIT_LISTS, include_str!("../../../shaders/oit_histogram.comp")].concat();
    ProgramSource::compute("oit histogram", text)
}

/// Allocates the list of each pixel.
pub(crate) fn allocate() -> ProgramSource {
    let head = [VERSION, BAND, &tile_list(), TILE_APPEND, &bins_define()].concat();
    let text = [&head, OIT_LISTS, include_str!("../../../shaders/oit_allocate.comp")].concat();
    ProgramSource::compute("oit allocate", text)
}

/// Defines the number of bins of the histogram.
fn bins_define() -> String {
    format!("#define BINS {BINS}\n")
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::features::ShaderFeatures;
    use crate::shaders::MaterialUse;

    fn options(post_depth_coverage: bool) -> ShaderOptions {
        let used_materials = vec![MaterialUse { blend_mode: BlendMode::Blend, color_array: None, normal_array: None }];
        ShaderOptions {
            features: ShaderFeatures { blend_layers: true, oit: true, ..ShaderFeatures::NONE },
            used_materials,
            inner_edges: false,
            image_filter: crate::shaders::ImageFilter { anisotropy: 1.0, blends_levels: false },
            sample_positions: vec![[0.5; 2]; 4],
            sample_resolve: String::new(),
            ambient_light: String::new(),
            post_depth_coverage,
        }
    }

    #[test]
    fn post_depth_coverage_needs_support_and_multisampling() {
        let gather_fragment = |post_depth_coverage: bool, samples: u32| {
            options(post_depth_coverage).oit_gather(samples).stages[1].1.clone()
        };
        for (post_depth_coverage, samples, is_expected) in [(true, 4, true), (false, 4, false), (true, 1, false)] {
            let fragment_text = gather_fragment(post_depth_coverage, samples);
            assert_eq!(
                fragment_text.contains("#extension GL_ARB_post_depth_coverage"),
                is_expected,
                "{post_depth_coverage}, {samples} samples"
            );
            assert_eq!(
                fragment_text.contains("#define POST_DEPTH_COVERAGE"),
                is_expected,
                "{post_depth_coverage}, {samples} samples"
            );
        }
    }

    #[test]
    fn oit_of_untextured_materials_has_no_texture_lookup() {
        for source in [options(true).oit_gather(4), options(true).oit_resolve(4)] {
            assert!(source.stages.iter().all(|(_, text)| !text.contains("vec4 color_texel(")), "{}", source.label);
        }
    }
}
