//! Tables of `normals` for smoothing groups: the ring of vertices around each group. Pure.

use super::layout::{NO_GROUPS, NormalSlot};
use super::normal_tables::{self, CornerSlot};
use modalcast_model::domain::{Domain, Shape, SmoothingGroups};
use modalcast_model::scene::{DomainLayout, Scene};

/// The tables; groups are numbered through all shapes.
#[derive(Debug, Default)]
pub(crate) struct RingTables {
    /// The group of each corner of the shapes that have groups.
    pub members: Vec<u32>,
    /// Offset of each group's ring, and the end of the last one.
    pub ring_offsets: Vec<u32>,
    pub rings: Vec<u32>,
    /// Geometric normals at rest, one plane per axis.
    pub normals: Vec<f32>,
}

fn smoothings(scene: &Scene) -> impl Iterator<Item = &SmoothingGroups> {
    scene.shapes.iter().filter_map(Shape::smoothing)
}

/// Bytes that [`RingTables::members`] would need in a scene with exact normals. The size of its rings is unknown until
/// they are built.
pub(crate) fn possible_corner_group_bytes(scene: &Scene) -> u64 {
    let shapes = scene.shapes.iter().filter(|shape| shape.modes.rank() > 0);
    shapes.map(|shape| 4 * shape.mesh.corners().vertices.len() as u64).sum()
}

impl RingTables {
    pub(crate) fn new(scene: &Scene) -> Self {
        let mut all = Self::default();
        for smoothing in smoothings(scene) {
            // Every index fits: a scene has at most `MAX_RING_TRIANGLES` triangles in rings.
            let (group, ring) = (all.ring_offsets.len() as u32, all.rings.len() as u32);
            all.members.extend(smoothing.corner_groups().iter().map(|member| member + group));
            all.ring_offsets.extend(smoothing.ring_offsets()[..smoothing.groups()].iter().map(|begin| begin + ring));
            all.rings.extend_from_slice(smoothing.rings());
        }
        all.ring_offsets.push(all.rings.len() as u32);
        let plane = |axis: usize| smoothings(scene).flat_map(SmoothingGroups::normals).map(move |normal| normal[axis]);
        all.normals = (0..3).flat_map(plane).collect();
        all
    }
}

/// The slots of `normals`, one per domain.
pub(crate) fn slots(scene: &Scene) -> Vec<NormalSlot> {
    let mut members = 0;
    let first_member = |shape: &Shape| {
        shape.smoothing().map_or(NO_GROUPS, |smoothing| {
            let first = members;
            members += smoothing.corner_groups().len() as u32;
            first
        })
    };
    let first_members: Vec<u32> = scene.shapes.iter().map(first_member).collect();
    let slot = |(corner, (domain, slot)): (CornerSlot, (&Domain, &DomainLayout))| NormalSlot {
        first: corner.first,
        first_normal: corner.first_normal,
        first_tangent: corner.first_tangent,
        first_vertex: slot.first_vertex as u32,
        first_member: first_members[domain.shape],
    };
    let domains = scene.domains.iter().zip(&scene.layout.domains);
    normal_tables::corner_slots(scene).into_iter().zip(domains).map(slot).collect()
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::exact;
    use super::*;

    #[test]
    fn every_corner_finds_the_ring_and_the_normal_of_its_group_and_rigid_shapes_have_none() {
        let scene = exact(&[(7, 2), (300, 0), (8, 5), (513, 1)]);
        let (rings, slots) = (RingTables::new(&scene), slots(&scene));
        let groups = rings.ring_offsets.len() - 1;
        assert_eq!((rings.normals.len(), rings.ring_offsets[groups] as usize), (3 * groups, rings.rings.len()));
        assert_eq!(slots[2].first_member, NO_GROUPS);
        assert_eq!(slots[4].first_member, slots[5].first_member, "instances share");
        for (domain, slot) in slots.iter().enumerate() {
            assert_eq!(slot.first_vertex as usize, scene.layout.domains[domain].first_vertex);
            let Some(smoothing) = scene.shape_of(domain).smoothing() else { continue };
            for (corner, member) in smoothing.corner_groups().iter().enumerate() {
                let group = rings.members[slot.first_member as usize + corner] as usize;
                let ring = &rings.rings[rings.ring_offsets[group] as usize..rings.ring_offsets[group + 1] as usize];
                assert_eq!(ring, smoothing.ring(*member as usize));
                let normal = [0, 1, 2].map(|axis| rings.normals[axis * groups + group]);
                assert_eq!(normal, smoothing.normals()[*member as usize]);
            }
        }
    }
}
