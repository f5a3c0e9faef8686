//! Shader sources of exact transparency: gather, tally, place and resolve.

use std::fmt::Write as _;

use super::{CLIP, DRAWN, FRAME, LISTS, Options, PHONG, SHARES, Slopes, Source, TILE, TILE_ROW, TRIANGLE, drawn};
use crate::geometry::Kind;
use crate::gl;

/// Side of the square of pixels whose fragments a workgroup counts.
pub(crate) const TALLY: u32 = 16;
/// Bins of the histogram over fragments per pixel; the last bin also counts pixels with more fragments.
pub(crate) const BINS: usize = 256;

impl Options {
    /// Counts the blended fragments of each pixel, and adds them to the lists.
    pub(crate) fn gather(&self, samples: u32) -> Source {
        // Extension directives must precede all other code.
        let post_depth = samples > 1 && self.post_depth;
        let more: &[&str] = if post_depth { &["MASK", "POST_DEPTH"] } else { &["MASK"] };
        let extension = if post_depth { "#extension GL_ARB_post_depth_coverage : require\n" } else { "" };
        let branches = self.branches(&[Kind::Blend]);
        let vertex = [&self.head(&["MASK"]), &branches, FRAME, CLIP, include_str!("../../../shaders/visibility.vert")];
        let head = self.head(more) + extension + &branches + &bins();
        let (lookups, sampling) = (self.lookups(&[Kind::Blend], Slopes::OfTheQuad), self.sampling(samples));
        let body = include_str!("../../../shaders/gather.frag");
        let fragment = [&head, &sampling, &lookups, DRAWN, LISTS, body].concat();
        Source { label: format!("gather, {samples} samples"), stages: drawn(vertex.concat(), fragment) }
    }

    /// Sorts, shades and blends the lists to layers.
    pub(crate) fn resolve_lists(&self, samples: u32) -> Source {
        let mut text = self.head(&[]) + &bins() + &tiles() + &self.branches(&[Kind::Blend]);
        text += &[&self.sampling(samples), FRAME, CLIP, &self.sun(), LISTS].concat();
        text += &[&self.lookups(&[Kind::Blend], Slopes::Given), PHONG, SHARES, TRIANGLE].concat();
        text += include_str!("../../../shaders/resolve.comp");
        Source { label: format!("resolve, {samples} samples"), stages: vec![(gl::COMPUTE_SHADER, text)] }
    }
}

/// Builds the histogram of fragments per pixel.
pub(crate) fn tally() -> Source {
    let head = format!("#version 430 core\n#define SIDE {TALLY}\n{}", bins());
    let text = [&head, LISTS, include_str!("../../../shaders/tally.comp")].concat();
    Source { label: "tally".into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
}

/// Allocates the list of each pixel.
pub(crate) fn place() -> Source {
    let head = format!("#version 430 core\n{}{}", tiles(), bins());
    let text = [&head, LISTS, include_str!("../../../shaders/place.comp")].concat();
    Source { label: "place".into(), stages: vec![(gl::COMPUTE_SHADER, text)] }
}

fn bins() -> String {
    format!("#define BINS {BINS}\n")
}

fn tiles() -> String {
    let mut text = String::new();
    writeln!(text, "#define TILE {TILE}\n#define ROW {TILE_ROW}u").ok();
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shaders::Used;
    use modalcast_model::scene::Shadow;

    fn options(post_depth: bool) -> Options {
        let used = vec![Used { kind: Kind::Blend, colour: None, normal: None }];
        Options {
            defines: vec!["LAYERS", "LISTED"],
            used,
            shadow: Shadow::default(),
            sample_places: vec![[0.5; 2]; 4],
            resolve: String::new(),
            post_depth,
        }
    }

    #[test]
    fn coverage_after_the_depth_test_is_asked_for_where_it_is_known_and_needed() {
        let text = |post_depth: bool, samples: u32| options(post_depth).gather(samples).stages[1].1.clone();
        for (post_depth, samples, asked) in [(true, 4, true), (false, 4, false), (true, 1, false)] {
            let text = text(post_depth, samples);
            assert_eq!(text.contains("#extension GL_ARB_post_depth_coverage"), asked, "{post_depth}, {samples}");
            assert_eq!(text.contains("#define POST_DEPTH"), asked, "{post_depth}, {samples}");
        }
    }

    #[test]
    fn glass_without_an_image_is_gathered_and_resolved_without_a_lookup() {
        for source in [options(true).gather(4), options(true).resolve_lists(4)] {
            assert!(source.stages.iter().all(|(_, text)| !text.contains("vec4 colour_texel(")), "{}", source.label);
        }
    }
}
