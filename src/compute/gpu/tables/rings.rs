//! Tables of `normals` for smoothing groups (the corners of one vertex that share a normal): the ring of vertices
//! around each group. [`SmoothingGroups`] describes groups and rings.

use super::layout::{NO_GROUPS, NormalSlot};
use super::normal_tables::{self, CornerSlot};
use modalcast_model::domain::{Domain, Shape, SmoothingGroups};
use modalcast_model::scene::{DomainLayout, Scene};

/// Smoothing groups of all shapes, numbered consecutively over the shapes.
#[derive(Debug, Default)]
pub(crate) struct RingTables {
    /// The group of each corner of the shapes that have groups.
    pub corner_groups: Vec<u32>,
    /// Offset of each group's ring in `rings`, and the end of the last ring.
    pub ring_offsets: Vec<u32>,
    /// Entries of the rings of all groups: vertices of their shape, some with the flag `RING_START`.
    pub rings: Vec<u32>,
    /// Geometric normal of each group at rest, one plane per axis.
    pub group_normals: Vec<f32>,
}

/// The smoothing groups of each shape that has groups.
fn smoothing_groups(scene: &Scene) -> impl Iterator<Item = &SmoothingGroups> {
    scene.shapes.iter().filter_map(Shape::smoothing)
}

/// Bytes that [`RingTables::corner_groups`] would need in a scene with exact normals. The size of its rings is unknown
/// until they are built.
pub(crate) fn possible_corner_group_bytes(scene: &Scene) -> u64 {
    let shapes = scene.shapes.iter().filter(|shape| shape.modes.rank() > 0);
    shapes.map(|shape| 4 * shape.mesh.corners().vertices.len() as u64).sum()
}

impl RingTables {
    pub(crate) fn new(scene: &Scene) -> Self {
        let mut tables = Self::default();
        for groups in smoothing_groups(scene) {
            // Every index fits in u32, because a scene has at most `MAX_RING_TRIANGLES` triangles in rings.
            let (first_group, first_entry) = (tables.ring_offsets.len() as u32, tables.rings.len() as u32);
            tables.corner_groups.extend(groups.corner_groups().iter().map(|group| first_group + group));
            tables
                .ring_offsets
                .extend(groups.ring_offsets()[..groups.group_count()].iter().map(|offset| first_entry + offset));
            tables.rings.extend_from_slice(groups.rings());
        }
        tables.ring_offsets.push(tables.rings.len() as u32);
        let plane =
            |axis: usize| smoothing_groups(scene).flat_map(SmoothingGroups::normals).map(move |normal| normal[axis]);
        tables.group_normals = (0..3).flat_map(plane).collect();
        tables
    }
}

/// The slots of `normals`, one per domain.
pub(crate) fn normal_slots(scene: &Scene) -> Vec<NormalSlot> {
    let mut corner_count = 0;
    let first_corner_group = |shape: &Shape| {
        shape.smoothing().map_or(NO_GROUPS, |groups| {
            let first = corner_count;
            corner_count += groups.corner_groups().len() as u32;
            first
        })
    };
    let first_corner_groups: Vec<u32> = scene.shapes.iter().map(first_corner_group).collect();
    let normal_slot = |(corners, (domain, layout)): (CornerSlot, (&Domain, &DomainLayout))| NormalSlot {
        first_corner: corners.first_corner,
        first_normal: corners.first_normal,
        first_tangent: corners.first_tangent,
        first_vertex: layout.first_vertex as u32,
        first_corner_group: first_corner_groups[domain.shape],
    };
    let domains = scene.domains.iter().zip(&scene.layout.domains);
    normal_tables::corner_slots(scene).into_iter().zip(domains).map(normal_slot).collect()
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::scene_with_exact_normals;
    use super::*;

    #[test]
    fn corners_have_rings_and_normals_of_their_groups() {
        // Domains 2 s and 2 s + 1 use shape s.
        let scene = scene_with_exact_normals(&[(7, 2), (300, 0), (8, 5), (513, 1)]);
        let (tables, slots) = (RingTables::new(&scene), normal_slots(&scene));
        let group_count = tables.ring_offsets.len() - 1;
        assert_eq!(tables.group_normals.len(), 3 * group_count);
        assert_eq!(tables.ring_offsets[group_count] as usize, tables.rings.len());
        assert_eq!(slots[2].first_corner_group, NO_GROUPS, "a shape without modes");
        assert_eq!(slots[4].first_corner_group, slots[5].first_corner_group, "domains of one shape share its groups");
        for (domain, slot) in slots.iter().enumerate() {
            assert_eq!(slot.first_vertex as usize, scene.layout.domains[domain].first_vertex);
            let Some(shape_groups) = scene.shape_of(domain).smoothing() else { continue };
            for (corner, shape_group) in shape_groups.corner_groups().iter().enumerate() {
                let group = tables.corner_groups[slot.first_corner_group as usize + corner] as usize;
                let ring = &tables.rings[tables.ring_offsets[group] as usize..tables.ring_offsets[group + 1] as usize];
                assert_eq!(ring, shape_groups.ring(*shape_group as usize));
                let normal = [0, 1, 2].map(|axis| tables.group_normals[axis * group_count + group]);
                assert_eq!(normal, shape_groups.normals()[*shape_group as usize]);
            }
        }
    }
}
