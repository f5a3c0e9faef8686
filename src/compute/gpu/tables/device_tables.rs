//! All constant tables of a scene on the device. The plan counts their bytes, and the launchers upload them. A quad is
//! four consecutive vertices or corners of a domain.

use super::box_segments::box_segments;
use super::change_list::max_change_entries;
use super::input_packing::{InputSizes, transform_links};
use super::layout::{BoxSegment, NormalSlot, TransformLink};
use super::normal_tables;
use super::rings::{RingTables, normal_slots};
use super::work::{CoordinateLayout, WorkList, rest_directions, rest_positions};
use modalcast_model::backend_settings::BatchPolicy;
use modalcast_model::deform::BoundingAxes;
use modalcast_model::scene::Scene;

/// Settings of a CUDA deformer that its scene does not contain. The default is automatic batching and no bounding axes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct CudaDeformerOptions {
    /// Whether domains that share a shape are deformed in batches.
    pub batches: BatchPolicy,
    /// Axes along which every step bounds the positions, in addition to the world's axes.
    pub bounding_axes: Option<BoundingAxes>,
}

impl CudaDeformerOptions {
    /// Default options with these bounding axes.
    pub fn with_bounding_axes(bounding_axes: Option<BoundingAxes>) -> Self {
        Self { bounding_axes, ..Self::default() }
    }
}

/// The constant tables of a scene, built once for the plan and the upload. U itself is packed during its upload,
/// because it is large.
#[derive(Debug)]
pub struct DeviceTables {
    pub(crate) coordinates: CoordinateLayout,
    pub(crate) work: WorkList,
    /// The parts of domains that `bounds` reduces to boxes.
    pub(crate) segments: Vec<BoxSegment>,
    /// x0, three float4 per quad.
    pub(crate) rest_positions: Vec<[f32; 4]>,
    /// Normals at rest, three float4 per quad; empty if `deform` computes no normals.
    pub(crate) rest_normals: Vec<[f32; 4]>,
    /// Tangents at rest, four float4 per quad; empty if `deform` computes no tangents.
    pub(crate) rest_tangents: Vec<[f32; 4]>,
    /// The tables of `normals`; only if normals follow the surface.
    pub(crate) normals: Option<NormalTables>,
    pub(crate) transform_links: Vec<TransformLink>,
    /// Sizes of the values of a step.
    pub(crate) inputs: InputSizes,
    /// Capacity of the list of tiles that a partial step computes, a step that changes few domains. 0 for a scene whose
    /// steps always compute all tiles.
    pub(crate) tile_list_capacity: usize,
    /// Axes along which `bounds` reduces the boxes in addition to the world's axes.
    pub(crate) bounding_axes: Option<BoundingAxes>,
}

impl DeviceTables {
    /// Builds the tables of a scene.
    pub fn new(scene: &Scene, options: CudaDeformerOptions) -> Self {
        let coordinates = CoordinateLayout::new(scene);
        let work = WorkList::new(scene, &coordinates, options.batches);
        let [rest_normals, rest_tangents] = rest_directions(scene, &work);
        Self {
            bounding_axes: options.bounding_axes,
            segments: box_segments(scene, &work),
            rest_positions: rest_positions(scene, &work),
            rest_normals,
            rest_tangents,
            normals: scene.features.exact_normals.then(|| NormalTables::new(scene)),
            transform_links: transform_links(scene),
            inputs: InputSizes::of(scene, &coordinates),
            tile_list_capacity: if max_change_entries(scene) > 0 { work.tiles.len() } else { 0 },
            work,
            coordinates,
        }
    }
}

/// The tables of `normals`.
#[derive(Debug)]
pub(crate) struct NormalTables {
    pub slots: Vec<NormalSlot>,
    /// For each block of threads of `normals`, the domain of the first corner that the block computes. One more entry,
    /// the last domain, ends the list.
    pub first_domains: Vec<u32>,
    /// All x, then all y, then all z, unlike [`DeviceTables::rest_normals`].
    pub rest_normals: Vec<f32>,
    /// Empty without normal maps.
    pub rest_tangents: Vec<[f32; 4]>,
    /// The neighbors of each vertex in the order around it.
    pub rings: RingTables,
}

impl NormalTables {
    fn new(scene: &Scene) -> Self {
        let slots = normal_slots(scene);
        let first_corners = slots.iter().map(|slot| slot.first_corner);
        Self {
            first_domains: normal_tables::first_domains(first_corners, scene.layout.corners),
            rest_normals: normal_tables::rest_normals(scene),
            rest_tangents: if scene.features.normal_maps { normal_tables::rest_tangents(scene) } else { Vec::new() },
            rings: RingTables::new(scene),
            slots,
        }
    }
}
