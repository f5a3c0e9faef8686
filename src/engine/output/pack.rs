//! Packs the selected vertex attributes into bytes for the wire, on the blocking pool.

use std::borrow::Cow;
use std::sync::Arc;
use std::time::Instant;

use super::frame_encoder::EncodedOutput;
use super::step_output::{OutputBody, StepOutput};
use super::vertex_encoding::{Encoding, encode_vectors};
use crate::engine::blocking::run_blocking;
use crate::telemetry::{Stage, ms_since};
use modalcast_model::deform::{DeformedSurface, VertexAttributes};
use modalcast_model::error::{Result, fault, invalid};
use modalcast_model::scene::{BoundingBox, DomainLayout, FloatingOrigins, Scene};
use modalcast_render::RasterBackends;

// Vertices are copied in memory order, and the wire format is little-endian.
const _: () = assert!(cfg!(target_endian = "little"), "expected a little-endian target");

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
    const fn encodings(self) -> &'static [Encoding] {
        match self {
            Self::Positions | Self::Displacements => &[Encoding::F32, Encoding::F16, Encoding::U16Box],
            Self::Normals => &[Encoding::F32, Encoding::F16, Encoding::OctahedralI16],
            Self::Boxes => &[Encoding::F32],
            Self::Origins => &[],
        }
    }
}

/// A part of the bytes of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Section {
    pub attribute: Attribute,
    pub encoding: Encoding,
    pub offset: u64,
    pub bytes: u64,
}

/// The origin of all positions of a reply in the world, in meters, or the origin of each selected domain if they differ.
pub type Origins = Arc<[[f64; 3]]>;

/// The vertices of a step as bytes.
#[derive(Debug, Clone)]
pub struct PackedVertices {
    pub encoded: EncodedOutput,
    /// In the order of their offsets, without gaps.
    pub sections: Vec<Section>,
    pub origins: Origins,
}

/// The domains and vertex attributes that a client selects.
#[derive(Debug, Clone)]
pub struct VertexSelection {
    scene: Arc<Scene>,
    /// Domains by index, in the order of the reply.
    pub domains: Vec<u32>,
    /// The attributes in the order of the reply.
    attributes: Vec<(Attribute, Encoding)>,
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
        Ok(Self { scene: Arc::clone(scene), domains, attributes })
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

    /// Number of vectors of an attribute in the selected domains.
    fn vector_count(&self, attribute: Attribute) -> usize {
        match attribute {
            Attribute::Positions | Attribute::Displacements => {
                self.counts().map(|(vertices, _)| vertices as usize).sum()
            }
            Attribute::Normals => self.counts().map(|(_, corners)| corners as usize).sum(),
            Attribute::Boxes => 2 * self.domains.len(),
            Attribute::Origins => 0,
        }
    }

    /// Size of all selected attributes in bytes, without origins.
    fn encoded_bytes(&self) -> usize {
        let section_bytes =
            |(attribute, encoding): &(Attribute, Encoding)| encoding.encoded_bytes(self.vector_count(*attribute));
        self.attributes.iter().map(section_bytes).sum()
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
pub fn validate_domains(field: &str, scene: &Scene, domains: Vec<u32>) -> Result<Vec<u32>> {
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

/// Packs the selected attributes of the selected domains, then the origins unless they are `known_origins`, those that
/// the client has received before.
///
/// # Errors
/// `Fault` when `output` does not contain vertices.
pub async fn pack_vertices(
    output: StepOutput,
    selection: &Arc<VertexSelection>,
    known_origins: Option<Origins>,
) -> Result<PackedVertices> {
    let OutputBody::Vertices(surface) = output.body else {
        return Err(fault("copy", "expected vertices, got another output"));
    };
    let mut stages = output.stages;
    let begin = Instant::now();
    let (selection, floating_origins) = (Arc::clone(selection), output.origins);
    let pack_on_pool = move || {
        let origins = origins_in_meters(&selection, floating_origins.as_deref());
        let is_changed = known_origins.is_none_or(|known_origins| known_origins != origins);
        let (sections, bytes) = pack(&surface, &selection, is_changed.then_some(&*origins));
        Ok((sections, origins, bytes))
    };
    let (sections, origins, bytes) = run_blocking("copy", pack_on_pool).await?;
    stages.push((Stage::Encode, ms_since(begin)));
    let (step, skipped, raster_backends) = (output.step, output.skipped, RasterBackends::default());
    let encoded = EncodedOutput { step, skipped, stages, raster_backends, bytes: bytes.into() };
    Ok(PackedVertices { encoded, sections, origins })
}

fn origins_in_meters(selection: &VertexSelection, floating_origins: Option<&FloatingOrigins>) -> Origins {
    let scene = &selection.scene;
    let to_meters = |origin: [f64; 3]| std::array::from_fn(|axis| scene.origin[axis] + scene.unit * origin[axis]);
    let Some(floating_origins) = floating_origins else { return Arc::new([scene.origin]) };
    // A domain that follows another one has the origin of its transform root.
    let origin_of = |domain: &u32| floating_origins.origin_of(scene.transform_roots.root_of(*domain as usize));
    let shared_origin = floating_origins.shared_origin();
    if selection.domains.iter().all(|domain| origin_of(domain) == shared_origin) {
        return Arc::new([to_meters(shared_origin)]);
    }
    selection.domains.iter().map(|domain| to_meters(origin_of(domain))).collect()
}

/// Packs the selected attributes and, if given, the origins.
fn pack(
    surface: &DeformedSurface,
    selection: &VertexSelection,
    origins: Option<&[[f64; 3]]>,
) -> (Vec<Section>, Vec<u8>) {
    let (mut sections, mut bytes) = (Vec::new(), Vec::with_capacity(selection.encoded_bytes() + 24));
    let mut end_section = |attribute: Attribute, encoding: Encoding, offset: usize, bytes: &[u8]| {
        let (offset, end) = (offset as u64, bytes.len() as u64);
        sections.push(Section { attribute, encoding, offset, bytes: end - offset });
    };
    for (attribute, encoding) in &selection.attributes {
        let offset = bytes.len();
        let numbers = gather(surface, selection, *attribute);
        encode_vectors(*encoding, &numbers, &mut bytes);
        end_section(*attribute, *encoding, offset, &bytes);
    }
    if let Some(origins) = origins {
        let offset = bytes.len();
        bytes.extend_from_slice(bytemuck::cast_slice(origins));
        end_section(Attribute::Origins, Encoding::F64, offset, &bytes);
    }
    (sections, bytes)
}

/// The numbers of one attribute of all selected domains. Borrows them if the selection is the whole array.
fn gather<'a>(surface: &'a DeformedSurface, selection: &VertexSelection, attribute: Attribute) -> Cow<'a, [f32]> {
    let layout = &selection.scene.layout;
    let gather_range = |numbers: &'a [f32], range: fn(&DomainLayout) -> (usize, usize)| {
        let is_whole = selection.domains.iter().copied().eq(0..layout.domains.len() as u32);
        if is_whole {
            return Cow::Borrowed(numbers);
        }
        let mut gathered = Vec::with_capacity(3 * selection.vector_count(attribute));
        for domain in &selection.domains {
            let (first_vector, count) = range(&layout.domains[*domain as usize]);
            gathered.extend_from_slice(&numbers[3 * first_vector..][..3 * count]);
        }
        Cow::Owned(gathered)
    };
    let vertex_range = |domain_layout: &DomainLayout| (domain_layout.first_vertex, domain_layout.vertices);
    let corner_range = |domain_layout: &DomainLayout| (domain_layout.first_corner, domain_layout.corners);
    match attribute {
        Attribute::Positions => gather_range(&surface.positions, vertex_range),
        Attribute::Normals => gather_range(&surface.normals, corner_range),
        Attribute::Displacements => gather_range(&surface.displacements, vertex_range),
        // The bounds are f32 values stored as f64, so the conversion is exact.
        Attribute::Boxes => selection
            .domains
            .iter()
            .flat_map(|domain| {
                let BoundingBox { min, max } = surface.boxes[*domain as usize];
                [min, max].into_iter().flatten().map(|number| number as f32)
            })
            .collect(),
        Attribute::Origins => Cow::Borrowed(&[]),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

    /// `count` consecutive numbers.
    fn numbers_from(first: f32, count: usize) -> Vec<f32> {
        (0..count).map(|index| first + index as f32).collect()
    }

    /// Selects attributes of domains as f32.
    fn select(scene: &Arc<Scene>, domains: Vec<u32>, attributes: &[Attribute]) -> Result<VertexSelection> {
        VertexSelection::new(scene, domains, attributes.iter().map(|attribute| (*attribute, Encoding::F32)).collect())
    }

    fn packed_floats(surface: &DeformedSurface, selection: &VertexSelection) -> Vec<f32> {
        bytemuck::pod_collect_to_vec(&pack(surface, selection, None).1)
    }

    #[test]
    fn packs_attributes_in_the_selected_order() {
        let scene = testing::two_strips();
        let surface = DeformedSurface {
            positions: numbers_from(0.0, 24),
            normals: numbers_from(100.0, 24),
            ..DeformedSurface::default()
        };
        // Each strip has four vertices and four corners. Numbers 12 to 23 of each list belong to the second strip.
        let default_selection = select(&scene, vec![1], &[]).expect("expected a valid selection");
        let expected = [numbers_from(12.0, 12), numbers_from(112.0, 12)].concat();
        assert_eq!(packed_floats(&surface, &default_selection), expected);
        let normals_first = [Attribute::Normals, Attribute::Positions];
        let selection = select(&scene, vec![1, 0], &normals_first).expect("expected a valid selection");
        let second_then_first = |first: f32| [numbers_from(first + 12.0, 12), numbers_from(first, 12)].concat();
        assert_eq!(packed_floats(&surface, &selection), [second_then_first(100.0), second_then_first(0.0)].concat());
        let whole_selection = select(&scene, vec![], &[Attribute::Positions]).expect("expected a valid selection");
        assert_eq!(packed_floats(&surface, &whole_selection), surface.positions);
    }

    #[test]
    fn sections_cover_the_bytes_without_gaps() {
        let scene = testing::strips_with_attributes();
        let surface = DeformedSurface {
            positions: numbers_from(0.0, 24),
            normals: [0.0, 0.0, 1.0].repeat(8),
            displacements: numbers_from(50.0, 24),
            boxes: vec![BoundingBox { min: [-1.0; 3], max: [2.0; 3] }; 2],
            ..DeformedSurface::default()
        };
        let attributes = vec![
            (Attribute::Positions, Encoding::U16Box),
            (Attribute::Normals, Encoding::OctahedralI16),
            (Attribute::Displacements, Encoding::F16),
            (Attribute::Boxes, Encoding::F32),
        ];
        let selection = VertexSelection::new(&scene, vec![0], attributes.clone()).expect("expected a valid selection");
        let (sections, bytes) = pack(&surface, &selection, Some(&[[1e7, 0.0, -3.0]]));
        let names: Vec<_> = sections.iter().map(|section| (section.attribute, section.encoding)).collect();
        assert_eq!(names, [attributes, vec![(Attribute::Origins, Encoding::F64)]].concat());
        // Four vectors each: a box and 6 bytes a vector, 4 bytes, 6 bytes; then one box and one origin.
        assert_eq!(sections.iter().map(|section| section.bytes).collect::<Vec<_>>(), [24 + 24, 16, 24, 24, 24]);
        let mut end = 0;
        for section in &sections {
            assert_eq!(section.offset, end);
            end += section.bytes;
        }
        assert_eq!(end, bytes.len() as u64);
        assert_eq!(bytes.len(), selection.encoded_bytes() + 24, "one origin of 24 bytes");
        assert_eq!(bytemuck::pod_collect_to_vec::<u8, f64>(&bytes[bytes.len() - 24..]), [1e7, 0.0, -3.0]);
        let boxes = bytemuck::pod_collect_to_vec::<u8, f32>(&bytes[88..112]);
        assert_eq!(boxes, [-1.0, -1.0, -1.0, 2.0, 2.0, 2.0]);
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
