//! Packs vertices into bytes for the wire, on the blocking pool.

use std::sync::Arc;
use std::time::Instant;

use super::frame_encoder::EncodedOutput;
use super::step_output::{OutputBody, StepOutput};
use crate::engine::blocking::run_blocking;
use crate::telemetry::{Stage, ms_since};
use modalcast_model::deform::{DeformedSurface, VertexAttributes};
use modalcast_model::error::{Result, fault, invalid};
use modalcast_model::scene::{BoundingBox, DomainLayout, FloatingOrigins, Layout, Scene};
use modalcast_render::RasterBackends;

// Vertices are copied in memory order, and the wire format is little-endian.
const _: () = assert!(cfg!(target_endian = "little"), "expected a little-endian target");

/// Limit on the domains of one vertex reply. It bounds the size of the first message, which contains the index and two
/// counts of every selected domain.
const MAX_DOMAINS: usize = 65_536;

/// Size of a vector in bytes: 3 f32.
const VECTOR_BYTES: usize = 12;

/// Size of a domain's bounding box in bytes: 6 f32.
const BOX_BYTES: u64 = 24;

/// Vertices as bytes, and the origin of their positions.
#[derive(Debug, Clone)]
pub struct PackedVertices {
    pub encoded: EncodedOutput,
    /// Origin of the positions in the world, meters.
    pub origin: [f64; 3],
    /// Size in bytes of the per-domain origins at the end of the reply; 0 if `origin` applies to all selected domains.
    pub origin_bytes: u64,
}

/// The domains and vertex attributes that a client selects.
#[derive(Debug, Clone)]
pub struct VertexSelection {
    scene: Arc<Scene>,
    /// Domains by index, in the order of the reply.
    pub domains: Vec<u32>,
    pub attributes: VertexAttributes,
}

impl VertexSelection {
    /// Selects attributes of the given domains. An empty list selects all domains.
    ///
    /// # Errors
    /// `Invalid` when an index is out of range, there are more indices than domains or more than 65 536, no attribute
    /// is selected, or the scene does not compute a selected attribute.
    pub fn new(scene: &Arc<Scene>, domains: Vec<u32>, attributes: VertexAttributes) -> Result<Self> {
        check_available(scene, attributes)?;
        let domains = validate_domains("selection.domains", scene, domains)?;
        if domains.len() > MAX_DOMAINS {
            return Err(invalid("selection.domains", format!("at most {MAX_DOMAINS} per reply"), domains.len()));
        }
        Ok(Self { scene: Arc::clone(scene), domains, attributes })
    }

    /// Size of the positions in bytes.
    pub fn position_bytes(&self) -> u64 {
        if self.attributes.positions { self.vector_bytes() } else { 0 }
    }

    /// Size of the displacements in bytes.
    pub fn displacement_bytes(&self) -> u64 {
        if self.attributes.displacements { self.vector_bytes() } else { 0 }
    }

    /// Size of the boxes in bytes.
    pub fn box_bytes(&self) -> u64 {
        if self.attributes.boxes { BOX_BYTES * self.domains.len() as u64 } else { 0 }
    }

    /// Size in bytes of one vector per vertex of the selected domains.
    fn vector_bytes(&self) -> u64 {
        self.vertex_counts().map(|count| VECTOR_BYTES as u64 * u64::from(count)).sum()
    }

    /// Vertex count of each selected domain.
    pub fn vertex_counts(&self) -> impl Iterator<Item = u32> {
        let domain_layouts = &self.scene.layout.domains;
        self.domains.iter().map(|domain| domain_layouts[*domain as usize].vertices as u32)
    }

    /// Corner count of each selected domain.
    pub fn corner_counts(&self) -> impl Iterator<Item = u32> {
        let domain_layouts = &self.scene.layout.domains;
        self.domains.iter().map(|domain| domain_layouts[*domain as usize].corners as u32)
    }
}

/// Rejects attributes that the scene does not compute. The error names the option of `scene.toml` that enables them.
fn check_available(scene: &Scene, attributes: VertexAttributes) -> Result<()> {
    if attributes == VertexAttributes::default() {
        return Err(invalid("selection.without_vertices", "displacements or boxes to be selected", "neither"));
    }
    let options = [
        ("displacements", attributes.displacements, scene.features.displacements),
        ("boxes", attributes.boxes, scene.features.boxes),
    ];
    match options.into_iter().find(|(_, is_selected, is_computed)| *is_selected && !is_computed) {
        None => Ok(()),
        Some((name, ..)) => {
            let expected = format!("a scene with {name} (deform.{name} = true in its scene.toml)");
            Err(invalid(format!("selection.{name}"), expected, format!("'{}' without them", scene.name)))
        }
    }
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

/// Packs the selected attributes of the selected domains: all positions in row order of U, then all normals, all
/// displacements and all boxes, then the per-domain origins if they differ.
///
/// # Errors
/// `Fault` when `output` does not contain vertices.
pub async fn pack_vertices(output: StepOutput, selection: &Arc<VertexSelection>) -> Result<PackedVertices> {
    let OutputBody::Vertices(surface) = output.body else {
        return Err(fault("copy", "expected vertices, got another output"));
    };
    let mut stages = output.stages;
    let begin = Instant::now();
    let (selection, origins) = (Arc::clone(selection), output.origins);
    let pack_on_pool = move || {
        let mut bytes = pack(&surface, &selection);
        let size_without_origins = bytes.len();
        let origin = push_origins(&selection, origins.as_deref(), &mut bytes);
        Ok((origin, (bytes.len() - size_without_origins) as u64, bytes))
    };
    let (origin, origin_bytes, bytes) = run_blocking("copy", pack_on_pool).await?;
    stages.push((Stage::Encode, ms_since(begin)));
    let (step, skipped, raster_backends) = (output.step, output.skipped, RasterBackends::default());
    let encoded = EncodedOutput { step, skipped, stages, raster_backends, bytes: bytes.into() };
    Ok(PackedVertices { encoded, origin, origin_bytes })
}

/// Returns the origin of the reply in meters. Appends per-domain origins to `bytes` if any differs from the reply's
/// origin.
fn push_origins(selection: &VertexSelection, origins: Option<&FloatingOrigins>, bytes: &mut Vec<u8>) -> [f64; 3] {
    let scene = &selection.scene;
    let to_meters = |origin: [f64; 3]| std::array::from_fn(|axis| scene.origin[axis] + scene.unit * origin[axis]);
    let Some(origins) = origins else { return scene.origin };
    // A domain that follows another one has the origin of its transform root.
    let domain_origins =
        || selection.domains.iter().map(|domain| origins.origin_of(scene.transform_roots.root_of(*domain as usize)));
    if domain_origins().any(|origin| origin != origins.shared_origin()) {
        bytes.extend(
            domain_origins().map(to_meters).flat_map(|origin: [f64; 3]| origin.map(f64::to_le_bytes)).flatten(),
        );
    }
    to_meters(origins.shared_origin())
}

fn pack(surface: &DeformedSurface, selection: &VertexSelection) -> Vec<u8> {
    let (layout, attributes): (&Layout, VertexAttributes) = (&selection.scene.layout, selection.attributes);
    let corner_count: usize =
        if attributes.normals { selection.corner_counts().map(|count| count as usize).sum() } else { 0 };
    let bytes_without_normals = selection.position_bytes() + selection.displacement_bytes() + selection.box_bytes();
    let mut bytes = Vec::with_capacity(VECTOR_BYTES * corner_count + bytes_without_normals as usize);
    // `range` gives the index of a domain's first vector in `numbers`, and the number of its vectors.
    let mut append_attribute = |is_selected: bool, numbers: &[f32], range: &dyn Fn(&DomainLayout) -> (usize, usize)| {
        if !is_selected {
            return;
        }
        for domain in &selection.domains {
            let (first_vector, count) = range(&layout.domains[*domain as usize]);
            bytes.extend_from_slice(bytemuck::cast_slice(&numbers[3 * first_vector..][..3 * count]));
        }
    };
    let vertex_range = |domain_layout: &DomainLayout| (domain_layout.first_vertex, domain_layout.vertices);
    let corner_range = |domain_layout: &DomainLayout| (domain_layout.first_corner, domain_layout.corners);
    append_attribute(attributes.positions, &surface.positions, &vertex_range);
    append_attribute(attributes.normals, &surface.normals, &corner_range);
    append_attribute(attributes.displacements, &surface.displacements, &vertex_range);
    if attributes.boxes {
        for domain in &selection.domains {
            let BoundingBox { min, max } = surface.boxes[*domain as usize];
            // The bounds are f32 values stored as f64, so the conversion is exact.
            let bounds_f32 = [min, max].map(|bound| bound.map(|number| number as f32));
            bytes.extend_from_slice(bytemuck::cast_slice(&bounds_f32));
        }
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

    /// `count` consecutive numbers.
    fn numbers_from(first: f32, count: usize) -> Vec<f32> {
        (0..count).map(|index| first + index as f32).collect()
    }

    #[test]
    fn packs_positions_then_normals_in_the_selected_order() {
        let scene = testing::two_strips();
        let surface = DeformedSurface {
            positions: numbers_from(0.0, 24),
            normals: numbers_from(100.0, 24),
            ..DeformedSurface::default()
        };
        // Each strip has four vertices and four corners. Numbers 12 to 23 of each list belong to the second strip.
        let selection = VertexSelection::new(&scene, vec![1], VertexAttributes::POSITIONS_AND_NORMALS)
            .expect("expected a valid selection");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &selection));
        assert_eq!(floats, [numbers_from(12.0, 12), numbers_from(112.0, 12)].concat());
        assert_eq!(selection.position_bytes(), 48);
        let positions = VertexAttributes { positions: true, ..VertexAttributes::default() };
        let without_normals = VertexSelection::new(&scene, vec![1, 0], positions).expect("expected a valid selection");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &without_normals));
        assert_eq!(floats, [numbers_from(12.0, 12), numbers_from(0.0, 12)].concat());
    }

    #[test]
    fn invalid_index_lists_are_rejected() {
        let scene = testing::two_strips();
        let error = VertexSelection::new(&scene, vec![0, 2], VertexAttributes::POSITIONS_AND_NORMALS)
            .expect_err("expected an index out of range")
            .to_string();
        assert!(error.starts_with("selection.domains[1]: expected an index below 2, got 2"), "{error}");
        let longer_than_the_scene = vec![0; 3];
        assert!(VertexSelection::new(&scene, longer_than_the_scene, VertexAttributes::POSITIONS_AND_NORMALS).is_err());
    }

    #[test]
    fn packs_displacements_then_boxes_after_the_positions() {
        let scene = testing::strips_with_attributes();
        let box_at = |min: f64| BoundingBox { min: [min; 3], max: [min + 1.0, min + 2.0, min + 3.0] };
        let surface = DeformedSurface {
            displacements: numbers_from(50.0, 24),
            boxes: vec![box_at(7.0), box_at(-3.5)],
            positions: numbers_from(0.0, 24),
            ..DeformedSurface::default()
        };
        let attributes = VertexAttributes { normals: false, ..VertexAttributes::ALL };
        let selection = VertexSelection::new(&scene, vec![1], attributes).expect("expected a valid selection");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &selection));
        let box_of_second_strip = vec![-3.5, -3.5, -3.5, -2.5, -1.5, -0.5];
        let expected = [numbers_from(12.0, 12), numbers_from(62.0, 12), box_of_second_strip.clone()].concat();
        assert_eq!(floats, expected);
        assert_eq!((selection.displacement_bytes(), selection.box_bytes()), (48, 24));
        let only_boxes = VertexAttributes { boxes: true, ..VertexAttributes::default() };
        let box_selection = VertexSelection::new(&scene, vec![1], only_boxes).expect("expected a valid selection");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &box_selection));
        assert_eq!(floats, box_of_second_strip);
        assert_eq!((box_selection.position_bytes(), box_selection.displacement_bytes()), (0, 0));
    }

    #[test]
    fn attributes_without_their_scene_option_are_rejected() {
        let scene = testing::two_strips();
        let boxes = VertexAttributes { boxes: true, ..VertexAttributes::default() };
        let displacements = VertexAttributes { displacements: true, ..VertexAttributes::default() };
        for (attributes, option) in [(boxes, "boxes"), (displacements, "displacements")] {
            let error = VertexSelection::new(&scene, vec![1], attributes)
                .expect_err("expected an error without the option")
                .to_string();
            assert!(error.starts_with(&format!("selection.{option}: ")), "{error}");
            assert!(error.contains(&format!("deform.{option} = true")), "{error}");
        }
        let no_attributes = VertexAttributes::default();
        assert!(VertexSelection::new(&testing::strips_with_attributes(), vec![1], no_attributes).is_err());
    }
}
