//! The lists of a partial step (a step that changes few domains), which `apply` reads from pinned memory. They contain
//! the changed domains with their new transforms and coordinates, and the dirty tiles, which `deform` then computes.
//!
//! ```text
//! [changes][new transforms: 12 words each][new q][dirty tiles]
//! ```

use super::input_packing::InputPacker;
use super::layout::Change;
use modalcast_model::scene::{Scene, SceneState};

/// A partial step changes at most 1 / `MAX_CHANGED_DIVISOR` of the domains. With more changes, a full step is faster,
/// although it copies the values of all domains.
const MAX_CHANGED_DIVISOR: usize = 4;

/// Lengths of the lists of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ChangeListLengths {
    pub change_count: u32,
    pub dirty_tile_count: u32,
}

/// Words of a [`Change`] and of a transform.
const CHANGE_WORDS: usize = size_of::<Change>() / 4;
const TRANSFORM_WORDS: usize = 12;

/// Maximum number of changed domains in a partial step; 0 in a scene with too few domains, whose steps are all full.
pub(crate) const fn max_changed_domains(scene: &Scene) -> usize {
    scene.domains.len() / MAX_CHANGED_DIVISOR
}

/// Maximum number of [`Change`]s of a partial step.
pub(crate) fn max_change_entries(scene: &Scene) -> usize {
    let domain_count = (0..scene.domains.len()).filter(|domain| needs_entry(scene, *domain)).count();
    max_changed_domains(scene).min(domain_count)
}

/// Whether a changed domain needs a [`Change`]. A follower (a domain that uses the transform of its root) without modes
/// has neither a transform nor coordinates of its own, so only its tiles are listed. But with exact normals or boxes,
/// the kernels need the number of the step that last changed the follower, and only an entry makes `apply` record it.
fn needs_entry(scene: &Scene, domain: usize) -> bool {
    let features = scene.features;
    let has_own_values =
        || scene.layout.domains[domain].rank > 0 || scene.transform_roots.root_from_domain(domain).is_none();
    !features.followers || features.exact_normals || features.boxes || has_own_values()
}

/// Offsets of the lists in the memory of a partial step, in words. The changes have offset 0.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ChangeListLayout {
    pub transforms: usize,
    pub q: usize,
    pub tiles: usize,
    /// Number of words of all lists.
    pub word_count: usize,
}

impl ChangeListLayout {
    /// A layout with capacity for `max_changes` [`Change`]s, and for all coordinates and tiles of the scene.
    pub(crate) const fn new(max_changes: usize, coordinate_count: usize, tile_count: usize) -> Self {
        let transforms = CHANGE_WORDS * max_changes;
        let q = transforms + TRANSFORM_WORDS * max_changes;
        let tiles = q + coordinate_count;
        Self { transforms, q, tiles, word_count: tiles + tile_count }
    }

    /// Bytes of the lists.
    pub(crate) const fn bytes(self) -> u64 {
        4 * self.word_count as u64
    }
}

/// The domains of a partial step.
#[derive(Debug, Clone, Copy)]
pub struct ChangedDomains<'a> {
    /// Domains that the step changes.
    pub changed: &'a [u32],
    /// Other domains, which earlier steps changed but which are outdated in the output buffers of this step. Their
    /// transforms and coordinates are already on the device.
    pub outdated: &'a [u32],
}

/// Writes the lists of partial steps.
#[derive(Debug)]
pub(crate) struct ChangeListWriter {
    layout: ChangeListLayout,
    /// Per tile, the number of the last tile list that contains the tile; 0 if there is none.
    last_lists: Vec<u32>,
    /// Number of the current tile list, counted from 1.
    list_number: u32,
}

impl ChangeListWriter {
    pub(crate) fn new(packer: &InputPacker) -> Self {
        let (max_changes, tiles) = (max_change_entries(&packer.scene), packer.dirty_tile_layout.tile_count);
        let layout = ChangeListLayout::new(max_changes, packer.coordinates.total, tiles);
        Self { layout, last_lists: vec![0; tiles], list_number: 0 }
    }

    pub(crate) const fn layout(&self) -> ChangeListLayout {
        self.layout
    }

    /// Writes the lists of a step to `words`, which has the length of the layout. Returns `None` when the lists have no
    /// capacity for the changes, or when a full step is less work.
    pub(crate) fn write(
        &mut self,
        words: &mut [u32],
        packer: &InputPacker,
        state: &SceneState,
        domains: ChangedDomains<'_>,
    ) -> Option<ChangeListLengths> {
        let (scene, layout) = (&packer.scene, self.layout);
        if domains.changed.len() > max_changed_domains(scene) {
            return None;
        }
        let (words, tiles) = words.split_at_mut(layout.tiles);
        let (words, q) = words.split_at_mut(layout.q);
        let (changes, transforms) = words.split_at_mut(layout.transforms);
        let (mut q_count, mut change_count) = (0, 0);
        let domains_with_entry = domains.changed.iter().filter(|domain| needs_entry(scene, **domain as usize));
        for (index, domain_id) in domains_with_entry.enumerate() {
            let (domain, first_new_q) = (*domain_id as usize, q_count);
            // In the entry of a follower, the kernel ignores the transform. The transform of its root fills the place.
            let root = scene.transform_roots.root_of(domain);
            let transform: [u32; TRANSFORM_WORDS] = bytemuck::cast(state.transforms[root].0);
            transforms[TRANSFORM_WORDS * index..][..TRANSFORM_WORDS].copy_from_slice(&transform);
            let domain_q = state.q_of(scene, domain);
            if q_count + domain_q.len().next_multiple_of(4) > q.len() {
                // Domains can share coordinates, so the changes may need more coordinates than the scene has.
                return None;
            }
            let first_q = packer.coordinates.first_q[domain];
            q_count += packer.put_q(first_q as usize, domain_q, bytemuck::cast_slice_mut(&mut q[q_count..]));
            let change = Change {
                domain: *domain_id,
                first_q,
                q_count: (q_count - first_new_q) as u32,
                first_new_q: first_new_q as u32,
            };
            changes[CHANGE_WORDS * index..][..CHANGE_WORDS].copy_from_slice(bytemuck::cast_slice(&[change]));
            change_count += 1;
        }
        let dirty_domains = domains.changed.iter().chain(domains.outdated);
        let dirty_tile_count = self.list_tiles(packer, dirty_domains, tiles);
        if dirty_tile_count as usize > packer.dirty_tile_layout.full_step_cost {
            return None;
        }
        Some(ChangeListLengths { change_count, dirty_tile_count })
    }

    /// Lists the tiles of the domains, each tile once. Returns the number of tiles.
    fn list_tiles<'a>(
        &mut self,
        packer: &InputPacker,
        domains: impl Iterator<Item = &'a u32>,
        tiles: &mut [u32],
    ) -> u32 {
        if self.list_number == u32::MAX {
            self.last_lists.fill(0);
            self.list_number = 0;
        }
        self.list_number += 1;
        let mut tile_count = 0;
        for domain in domains {
            let domain_tiles = packer.dirty_tile_layout.domain_tiles[*domain as usize];
            for span in [domain_tiles.vertices, domain_tiles.corners] {
                for tile in span.first..span.first + span.count {
                    let last_list = &mut self.last_lists[tile as usize];
                    if *last_list != self.list_number {
                        *last_list = self.list_number;
                        tiles[tile_count] = tile;
                        tile_count += 1;
                    }
                }
            }
        }
        tile_count as u32
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::{scene_with_deformation, scene_with_followers};
    use super::*;
    use modalcast_model::scene::{DeformationSettings, NormalMethod};

    #[test]
    fn rigid_followers_have_entries_only_for_their_change_steps() {
        let defaults = DeformationSettings::default();
        let exact = DeformationSettings { normals: NormalMethod::Exact, ..defaults };
        let boxes = DeformationSettings { boxes: true, ..defaults };
        let displacements = DeformationSettings { displacements: true, ..defaults };
        let mut sizes = [(7, 0); 8];
        // In a scene without modes, exact normals would not be computed.
        sizes[7].1 = 1;
        let max_entries = |deformation| max_change_entries(&scene_with_followers(&sizes, deformation));
        // A quarter of sixteen domains may change. Without exact normals and boxes, only three domains need entries:
        // the transform root, and the two domains of the last shape, which have coordinates.
        assert_eq!([defaults, exact, boxes, displacements].map(max_entries), [3, 4, 4, 3]);
        assert_eq!(max_change_entries(&scene_with_deformation(&sizes, defaults)), 4, "a scene without followers");
        assert_eq!(max_changed_domains(&scene_with_followers(&sizes, defaults)), 4, "followers also change");
    }
}
