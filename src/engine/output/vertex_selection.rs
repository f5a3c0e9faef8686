//! The domains and vertex attributes that a client selects.

use std::ops::Range;
use std::sync::Arc;

use super::vertex_encoding::Encoding;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// An attribute of the vertices of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Attribute {
    Positions,
    Normals,
    Displacements,
    Boxes,
    /// Sent without being selected.
    Origins,
}

impl Attribute {
    /// The encodings that the attribute may have.
    pub const fn encodings(self) -> &'static [Encoding] {
        match self {
            Self::Positions | Self::Displacements => &[Encoding::F32, Encoding::F16, Encoding::U16Box],
            Self::Normals => &[Encoding::F32, Encoding::F16, Encoding::OctahedralI16],
            Self::Boxes => &[Encoding::F32],
            Self::Origins => &[],
        }
    }
}

/// The domains and vertex attributes that a client selects.
#[derive(Debug, Clone)]
pub struct VertexSelection {
    pub(super) scene: Arc<Scene>,
    /// Domains by index, in the order of the reply.
    pub domains: Arc<[u32]>,
    /// The attributes in the order of the reply.
    pub(super) attributes: Vec<(Attribute, Encoding)>,
    /// The vertices of the domains as ranges of all vertices of the scene. Consecutive ranges are joined.
    vertex_ranges: Vec<Range<usize>>,
    /// The corners of the domains as ranges of all corners. A corner is a vertex with one of its normals.
    corner_ranges: Vec<Range<usize>>,
}

impl VertexSelection {
    /// Selects attributes of the given domains. An empty list of domains selects all domains. An empty list of
    /// attributes selects positions and normals as f32.
    ///
    /// # Errors
    /// `Invalid` when an index is out of range, there are more indices than domains, an attribute is selected twice or
    /// with an encoding that it cannot have, or the scene does not compute it.
    pub fn new(scene: &Arc<Scene>, domains: Vec<u32>, mut attributes: Vec<(Attribute, Encoding)>) -> Result<Self> {
        if attributes.is_empty() {
            attributes = vec![(Attribute::Positions, Encoding::F32), (Attribute::Normals, Encoding::F32)];
        }
        for (index, (attribute, encoding)) in attributes.iter().enumerate() {
            let field = format!("selection.attributes[{index}]");
            if attributes[..index].iter().any(|(earlier_attribute, _)| earlier_attribute == attribute) {
                return Err(invalid(field, "each attribute once", format!("{attribute:?} again")));
            }
            if !attribute.encodings().contains(encoding) {
                let expected = format!("one of {:?} for {attribute:?}", attribute.encodings());
                return Err(invalid(format!("{field}.encoding"), expected, format!("{encoding:?}")));
            }
            check_available(&field, scene, *attribute)?;
        }
        let domains = validate_domains("selection.domains", scene, domains)?;
        let layouts = || domains.iter().map(|domain| &scene.layout.domains[*domain as usize]);
        let vertex_ranges = join_consecutive(layouts().map(|layout| (layout.first_vertex, layout.vertices)));
        let corner_ranges = join_consecutive(layouts().map(|layout| (layout.first_corner, layout.corners)));
        Ok(Self { scene: Arc::clone(scene), domains: domains.into(), attributes, vertex_ranges, corner_ranges })
    }

    /// The attributes to copy from the device.
    pub fn vertex_attributes(&self) -> VertexAttributes {
        let is_selected = |attribute: Attribute| self.attributes.iter().any(|(selected, _)| *selected == attribute);
        VertexAttributes {
            positions: is_selected(Attribute::Positions),
            normals: is_selected(Attribute::Normals),
            displacements: is_selected(Attribute::Displacements),
            boxes: is_selected(Attribute::Boxes),
        }
    }

    /// Where the vectors of an attribute lie in the array of the whole scene; empty for attributes that have no such
    /// array.
    pub(super) fn ranges(&self, attribute: Attribute) -> &[Range<usize>] {
        match attribute {
            Attribute::Positions | Attribute::Displacements => &self.vertex_ranges,
            Attribute::Normals => &self.corner_ranges,
            Attribute::Boxes | Attribute::Origins => &[],
        }
    }

    /// Vertex and corner count of each selected domain.
    pub fn counts(&self) -> impl Iterator<Item = (u32, u32)> {
        let domain_layouts = &self.scene.layout.domains;
        self.domains.iter().map(|domain| {
            let layout = &domain_layouts[*domain as usize];
            (layout.vertices as u32, layout.corners as u32)
        })
    }
}

/// Ranges from their starts and lengths. A range that begins where the previous one ends extends it.
fn join_consecutive(starts_and_lengths: impl Iterator<Item = (usize, usize)>) -> Vec<Range<usize>> {
    let mut ranges: Vec<Range<usize>> = Vec::new();
    for (start, length) in starts_and_lengths.filter(|(_, length)| *length > 0) {
        match ranges.last_mut().filter(|last| last.end == start) {
            Some(last) => last.end += length,
            None => ranges.push(start..start + length),
        }
    }
    ranges
}

/// Rejects an attribute that the scene does not compute. The error names the option of `scene.toml` that enables it.
fn check_available(field: &str, scene: &Scene, attribute: Attribute) -> Result<()> {
    let (name, is_computed) = match attribute {
        Attribute::Displacements => ("displacements", scene.features.displacements),
        Attribute::Boxes => ("boxes", scene.features.boxes),
        Attribute::Positions | Attribute::Normals | Attribute::Origins => return Ok(()),
    };
    if is_computed {
        return Ok(());
    }
    let expected = format!("a scene with {name} (deform.{name} = true in its scene.toml)");
    Err(invalid(format!("{field}.attribute"), expected, format!("'{}' without them", scene.name)))
}

/// Checks a list of domain indices; an empty list means all domains in order. `field` names the list in errors.
///
/// # Errors
/// `Invalid` when an index is out of range or the list is longer than the scene.
fn validate_domains(field: &str, scene: &Scene, domains: Vec<u32>) -> Result<Vec<u32>> {
    let count = scene.domains.len();
    if domains.is_empty() {
        return Ok((0..count as u32).collect());
    }
    if domains.len() > count {
        return Err(invalid(field, format!("at most {count} indices"), domains.len()));
    }
    match domains.iter().position(|domain| *domain as usize >= count) {
        None => Ok(domains),
        Some(index) => Err(invalid(format!("{field}[{index}]"), format!("an index below {count}"), domains[index])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

    /// Selects attributes of domains as f32.
    fn select(scene: &Arc<Scene>, domains: Vec<u32>, attributes: &[Attribute]) -> Result<VertexSelection> {
        VertexSelection::new(scene, domains, attributes.iter().map(|attribute| (*attribute, Encoding::F32)).collect())
    }

    #[test]
    fn consecutive_domains_are_one_range() {
        let scene = testing::two_strips();
        // Each strip has four vertices and four corners.
        let starts_and_ends =
            |ranges: &[Range<usize>]| -> Vec<_> { ranges.iter().map(|range| (range.start, range.end)).collect() };
        for (domains, expected) in [
            (vec![], vec![(0, 8)]),
            (vec![0, 1], vec![(0, 8)]),
            (vec![1], vec![(4, 8)]),
            (vec![1, 0], vec![(4, 8), (0, 4)]),
        ] {
            let selection = select(&scene, domains.clone(), &[]).expect("expected a valid selection");
            for attribute in [Attribute::Positions, Attribute::Normals] {
                assert_eq!(starts_and_ends(selection.ranges(attribute)), expected, "{domains:?}");
            }
        }
        assert_eq!(join_consecutive([(0, 3), (3, 0), (3, 2), (6, 1), (5, 1)].into_iter()), [0..5, 6..7, 5..6]);
    }

    #[test]
    fn invalid_index_lists_are_rejected() {
        let scene = testing::two_strips();
        let error = select(&scene, vec![0, 2], &[]).expect_err("expected an index out of range").to_string();
        assert!(error.starts_with("selection.domains[1]: expected an index below 2, got 2"), "{error}");
        let longer_than_the_scene = vec![0; 3];
        assert!(select(&scene, longer_than_the_scene, &[]).is_err());
    }

    #[test]
    fn invalid_attributes_are_rejected_with_their_field() {
        use Attribute::{Boxes, Displacements, Normals, Origins, Positions};
        let scene = testing::two_strips();
        let cases = [
            (vec![(Positions, Encoding::F32), (Positions, Encoding::F16)], "selection.attributes[1]: ", "once"),
            (vec![(Positions, Encoding::OctahedralI16)], "selection.attributes[0].encoding: ", "U16Box"),
            (vec![(Normals, Encoding::U16Box)], "selection.attributes[0].encoding: ", "OctahedralI16"),
            (vec![(Normals, Encoding::F32), (Origins, Encoding::F64)], "selection.attributes[1].encoding: ", "Origins"),
            (
                vec![(Displacements, Encoding::F32)],
                "selection.attributes[0].attribute: ",
                "deform.displacements = true",
            ),
            (vec![(Boxes, Encoding::F32)], "selection.attributes[0].attribute: ", "deform.boxes = true"),
        ];
        for (attributes, field, text) in cases {
            let error = VertexSelection::new(&scene, vec![1], attributes).expect_err(text).to_string();
            assert!(error.starts_with(field) && error.contains(text), "expected {field} and {text}, got {error}");
        }
    }
}
