//! Packs vertices into bytes for the wire, off the device thread.

use std::sync::Arc;
use std::time::Instant;

use super::frame_encoder::EncodedOutput;
use super::step_output::{OutputBody, StepOutput};
use crate::engine::blocking::run_blocking;
use crate::telemetry::{Stage, ms_since};
use modalcast_model::deform::{DeformedSurface, VertexAttributes};
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::{BoundingBox, DomainLayout, FloatingOrigins, Layout, Scene};
use modalcast_render::RasterBackends;

// Vertices are copied in memory order, and the wire format is little-endian.
const _: () = assert!(cfg!(target_endian = "little"), "vertices would need their bytes swapped");

/// Limit on the domains of one vertex reply, because the first message carries counts for every domain.
const MAX_DOMAINS: usize = 65_536;

/// Vertices as bytes, and the origin of their positions.
#[derive(Debug, Clone)]
pub struct PackedVertices {
    pub encoded: EncodedOutput,
    /// Origin of the positions in the world, meters.
    pub origin: [f64; 3],
    /// Size in bytes of the per-domain origins at the end of the reply; 0 if `origin` applies to all selected domains.
    pub origin_bytes: u64,
}

/// Bytes of a domain's box: 6 f32.
const BOX_BYTES: u64 = 24;

/// The domains and vertex attributes that a reader selects.
#[derive(Debug, Clone)]
pub struct VertexSelection {
    scene: Arc<Scene>,
    /// Domains by index, in the order of the reply.
    pub domains: Vec<u32>,
    pub wanted: VertexAttributes,
}

impl VertexSelection {
    /// Selects attributes of the given domains; an empty list selects all domains.
    ///
    /// # Errors
    /// `Invalid` when an index is out of range, the list is longer than the scene or than 65 536 domains, no attribute
    /// is selected, or the scene does not keep a selected attribute.
    pub fn new(scene: &Arc<Scene>, domains: Vec<u32>, wanted: VertexAttributes) -> Result<Self> {
        check_available(scene, wanted)?;
        let domains = validate_domains("selection.domains", scene, domains)?;
        if domains.len() > MAX_DOMAINS {
            return Err(invalid("selection.domains", format!("at most {MAX_DOMAINS} per reply"), domains.len()));
        }
        Ok(Self { scene: Arc::clone(scene), domains, wanted })
    }

    /// Size of the positions in bytes.
    pub fn position_bytes(&self) -> u64 {
        if self.wanted.positions { self.triples() } else { 0 }
    }

    /// Size of the displacements in bytes.
    pub fn displacement_bytes(&self) -> u64 {
        if self.wanted.displacements { self.triples() } else { 0 }
    }

    /// Size of the boxes in bytes.
    pub fn box_bytes(&self) -> u64 {
        if self.wanted.boxes { BOX_BYTES * self.domains.len() as u64 } else { 0 }
    }

    /// Size in bytes of 3 f32 per vertex of the selected domains.
    fn triples(&self) -> u64 {
        self.vertices().map(|count| 12 * u64::from(count)).sum()
    }

    /// Vertex count of each selected domain.
    pub fn vertices(&self) -> impl Iterator<Item = u32> {
        let slots = &self.scene.layout.domains;
        self.domains.iter().map(|domain| slots[*domain as usize].vertices as u32)
    }

    /// Corner count of each selected domain.
    pub fn corners(&self) -> impl Iterator<Item = u32> {
        let slots = &self.scene.layout.domains;
        self.domains.iter().map(|domain| slots[*domain as usize].corners as u32)
    }
}

/// Rejects attributes that the scene does not keep; the error names the option of `scene.toml` that enables them.
fn check_available(scene: &Scene, wanted: VertexAttributes) -> Result<()> {
    if wanted == VertexAttributes::default() {
        return Err(invalid("selection.without_vertices", "displacements or boxes instead", "neither"));
    }
    let options = [
        ("displacements", wanted.displacements, scene.features.displacements),
        ("boxes", wanted.boxes, scene.features.boxes),
    ];
    match options.into_iter().find(|(_, wanted, kept)| *wanted && !kept) {
        None => Ok(()),
        Some((name, ..)) => {
            let expected = format!("a scene that keeps them (deform.{name} = true in its scene.toml)");
            Err(invalid(format!("selection.{name}"), expected, format!("'{}', which does not", scene.name)))
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
        Some(at) => Err(invalid(format!("{field}[{at}]"), format!("an index below {count}"), domains[at])),
    }
}

/// Packs the selected attributes of the selected domains: all positions in row order of U, then all normals, all
/// displacements and all boxes, then the per-domain origins if they differ.
///
/// # Errors
/// `Fault` when `output` does not contain vertices.
pub async fn pack_vertices(output: StepOutput, selection: &Arc<VertexSelection>) -> Result<PackedVertices> {
    let OutputBody::Vertices(surface) = output.body else { return Err(fault_in("copy")("a picture is no vertices")) };
    let mut stages = output.stages;
    let begin = Instant::now();
    let (selection, origins) = (Arc::clone(selection), output.origins);
    let work = move || {
        let mut bytes = pack(&surface, &selection);
        let before = bytes.len();
        let origin = push_origins(&selection, origins.as_deref(), &mut bytes);
        Ok((origin, (bytes.len() - before) as u64, bytes))
    };
    let (origin, origin_bytes, bytes) = run_blocking("copy", work).await?;
    stages.push((Stage::Encode, ms_since(begin)));
    let (step, skipped, raster_backends) = (output.step, output.skipped, RasterBackends::default());
    let encoded = EncodedOutput { step, skipped, stages, raster_backends, bytes: bytes.into() };
    Ok(PackedVertices { encoded, origin, origin_bytes })
}

/// Returns the origin of the reply in meters; appends per-domain origins to `bytes` if any differs from it.
fn push_origins(selection: &VertexSelection, origins: Option<&FloatingOrigins>, bytes: &mut Vec<u8>) -> [f64; 3] {
    let scene = &selection.scene;
    let meters = |origin: [f64; 3]| std::array::from_fn(|axis| scene.origin[axis] + scene.unit * origin[axis]);
    let Some(origins) = origins else { return scene.origin };
    let own =
        || selection.domains.iter().map(|domain| origins.origin_of(scene.transform_roots.root_of(*domain as usize)));
    if own().any(|origin| origin != origins.shared_origin()) {
        bytes.extend(own().map(meters).flat_map(|origin: [f64; 3]| origin.map(f64::to_le_bytes)).flatten());
    }
    meters(origins.shared_origin())
}

fn pack(surface: &DeformedSurface, selection: &VertexSelection) -> Vec<u8> {
    let (layout, wanted): (&Layout, VertexAttributes) = (&selection.scene.layout, selection.wanted);
    let corners: usize = if wanted.normals { selection.corners().map(|count| count as usize).sum() } else { 0 };
    let others = selection.position_bytes() + selection.displacement_bytes() + selection.box_bytes();
    let mut bytes = Vec::with_capacity(12 * corners + others as usize);
    let mut put = |wanted: bool, numbers: &[f32], range: &dyn Fn(&DomainLayout) -> (usize, usize)| {
        for domain in selection.domains.iter().filter(|_| wanted) {
            let (first, count) = range(&layout.domains[*domain as usize]);
            bytes.extend_from_slice(bytemuck::cast_slice(&numbers[3 * first..][..3 * count]));
        }
    };
    let (vertices, corners) = (
        |slot: &DomainLayout| (slot.first_vertex, slot.vertices),
        |slot: &DomainLayout| (slot.first_corner, slot.corners),
    );
    put(wanted.positions, &surface.positions, &vertices);
    put(wanted.normals, &surface.normals, &corners);
    put(wanted.displacements, &surface.displacements, &vertices);
    for domain in selection.domains.iter().filter(|_| wanted.boxes) {
        let BoundingBox { min, max } = surface.boxes[*domain as usize];
        // The bounds are f32 values stored as f64, so the conversion is exact.
        let sides = [min, max].map(|corner| corner.map(|number| number as f32));
        bytes.extend_from_slice(bytemuck::cast_slice(&sides));
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

    #[test]
    fn a_selection_packs_positions_then_normals_of_its_domains_in_order() {
        let scene = testing::two_strips();
        let count = |from: f32, len: usize| (0..len).map(|at| from + at as f32).collect::<Vec<_>>();
        let surface =
            DeformedSurface { positions: count(0.0, 24), normals: count(100.0, 24), ..DeformedSurface::default() };
        let selection = VertexSelection::new(&scene, vec![1], VertexAttributes::VERTICES).expect("in range");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &selection));
        assert_eq!(floats, [count(12.0, 12), count(112.0, 12)].concat());
        assert_eq!(selection.position_bytes(), 48);
        let positions = VertexAttributes { positions: true, ..VertexAttributes::default() };
        let bare = VertexSelection::new(&scene, vec![1, 0], positions).expect("in range");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &bare));
        assert_eq!(floats, [count(12.0, 12), count(0.0, 12)].concat());
    }

    #[test]
    fn indices_out_of_range_and_lists_longer_than_the_scene_are_refused() {
        let scene = testing::two_strips();
        let refusal =
            VertexSelection::new(&scene, vec![0, 2], VertexAttributes::VERTICES).expect_err("out of range").to_string();
        assert!(refusal.starts_with("selection.domains[1]: expected an index below 2, got 2"), "{refusal}");
        assert!(VertexSelection::new(&scene, vec![0; 3], VertexAttributes::VERTICES).is_err());
    }

    #[test]
    fn displacements_and_boxes_follow_the_normals_and_are_refused_where_the_scene_keeps_none() {
        let (bare, kept) = (testing::two_strips(), testing::strips_with_attributes());
        let count = |from: f32, len: usize| (0..len).map(|at| from + at as f32).collect::<Vec<_>>();
        let side = |from: f64| BoundingBox { min: [from; 3], max: [from + 1.0, from + 2.0, from + 3.0] };
        let surface = DeformedSurface {
            displacements: count(50.0, 24),
            boxes: vec![side(7.0), side(-3.5)],
            positions: count(0.0, 24),
            ..DeformedSurface::default()
        };
        let wanted = VertexAttributes { normals: false, ..VertexAttributes::ALL };
        let selection = VertexSelection::new(&kept, vec![1], wanted).expect("kept");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &selection));
        let sides = vec![-3.5, -3.5, -3.5, -2.5, -1.5, -0.5];
        assert_eq!(floats, [count(12.0, 12), count(62.0, 12), sides.clone()].concat());
        assert_eq!((selection.displacement_bytes(), selection.box_bytes()), (48, 24));
        let boxes = VertexAttributes { boxes: true, ..VertexAttributes::default() };
        let alone = VertexSelection::new(&kept, vec![1], boxes).expect("kept");
        assert_eq!(bytemuck::pod_collect_to_vec::<u8, f32>(&pack(&surface, &alone)), sides);
        assert_eq!((alone.position_bytes(), alone.displacement_bytes()), (0, 0));
        for (wanted, field) in [(boxes, "boxes"), (VertexAttributes { displacements: true, ..boxes }, "displacements")]
        {
            let refusal = VertexSelection::new(&bare, vec![1], wanted).expect_err("not kept").to_string();
            assert!(refusal.starts_with(&format!("selection.{field}: ")), "{refusal}");
            assert!(refusal.contains(&format!("deform.{field} = true")), "{refusal}");
        }
        assert!(VertexSelection::new(&kept, vec![1], VertexAttributes::default()).is_err());
    }
}
