//! The lists of a partial step, which `apply` reads from pinned memory: changed domains with their new transforms and
//! coordinates, and the tiles to compute. Pure.
//!
//! ```text
//! [changes][transforms: 12 words each][q][tiles]
//! ```

use super::input_packing::InputPacker;
use super::layout::Change;
use modalcast_model::scene::{Scene, SceneState};

/// A partial step pays off up to 1 / `MAX_CHANGED_DIVISOR` of the domains; beyond that the whole state is copied.
const MAX_CHANGED_DIVISOR: usize = 4;

/// Lengths of the lists of a step.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct ChangeListLengths {
    pub changed: u32,
    pub dirty_tiles: u32,
}

/// Words of a [`Change`] and of a transform.
const CHANGE_WORDS: usize = size_of::<Change>() / 4;
const TRANSFORM_WORDS: usize = 12;

/// Maximum number of changed domains in a partial step; 0 where steps are always full: when the scene has too few
/// domains, or when it truncates modes. The set of truncated modes depends on q and is uploaded only with the whole
/// state.
pub(crate) const fn max_changed_domains(scene: &Scene) -> usize {
    if scene.features.truncation { 0 } else { scene.domains.len() / MAX_CHANGED_DIVISOR }
}

/// Maximum number of entries of such a list: silent domains have none.
pub(crate) fn max_change_entries(scene: &Scene) -> usize {
    let silent = (0..scene.domains.len()).filter(|domain| needs_no_entry(scene, *domain)).count();
    max_changed_domains(scene).min(scene.domains.len() - silent)
}

/// Whether a step never has to send a change of this domain: the domain follows another domain's transform, has no
/// coordinates, and the scene keeps neither exact normals nor boxes, which read the step of its last change. Its tiles
/// are recomputed nevertheless.
fn needs_no_entry(scene: &Scene, domain: usize) -> bool {
    let features = scene.features;
    features.followers
        && !(features.exact_normals || features.boxes)
        && scene.layout.domains[domain].rank == 0
        && scene.transform_roots.frame_of(domain).is_some()
}

/// Where each list begins in the memory of a partial step, in words, and the number of all words.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ChangeListLayout {
    pub transforms: usize,
    pub q: usize,
    pub tiles: usize,
    pub end: usize,
}

impl ChangeListLayout {
    /// `entries`: maximum number of changed domains; `coordinates` and `tiles`: numbers of all of a scene.
    pub(crate) const fn new(entries: usize, coordinates: usize, tiles: usize) -> Self {
        let transforms = CHANGE_WORDS * entries;
        let q = transforms + TRANSFORM_WORDS * entries;
        Self { transforms, q, tiles: q + coordinates, end: q + coordinates + tiles }
    }

    /// Bytes of the lists.
    pub(crate) const fn bytes(self) -> u64 {
        4 * self.end as u64
    }
}

/// The domains of a partial step.
#[derive(Debug, Clone, Copy)]
pub struct ChangedDomains<'a> {
    /// Domains that the step changes.
    pub changed: &'a [u32],
    /// Further domains that the output lacks. Their values are already on the device.
    pub outdated: &'a [u32],
}

/// Writes the lists of partial steps.
#[derive(Debug)]
pub(crate) struct ChangeListWriter {
    layout: ChangeListLayout,
    /// Per tile, the number of the last list that contains it; and the number of lists written.
    named: Vec<u32>,
    lists: u32,
}

impl ChangeListWriter {
    pub(crate) fn new(packing: &InputPacker) -> Self {
        let (entries, tiles) = (max_change_entries(&packing.scene), packing.dirty_tile_layout.tiles);
        let layout = ChangeListLayout::new(entries, packing.coordinates.total, tiles);
        Self { layout, named: vec![0; tiles], lists: 0 }
    }

    pub(crate) const fn layout(&self) -> ChangeListLayout {
        self.layout
    }

    /// Writes the lists of a step to `words`, which has the words of the layout. Returns `None` when the lists have no
    /// capacity for the changes, or when a full step is less work.
    pub(crate) fn write(
        &mut self,
        words: &mut [u32],
        packing: &InputPacker,
        state: &SceneState,
        domains: ChangedDomains<'_>,
    ) -> Option<ChangeListLengths> {
        let (scene, layout) = (&packing.scene, self.layout);
        if domains.changed.len() > max_changed_domains(scene) {
            return None;
        }
        let (words, tiles) = words.split_at_mut(layout.tiles);
        let (words, q) = words.split_at_mut(layout.q);
        let (changes, transforms) = words.split_at_mut(layout.transforms);
        let (mut source, mut count) = (0, 0);
        let entries = domains.changed.iter().filter(|domain| !needs_no_entry(scene, **domain as usize));
        for (index, domain) in entries.enumerate() {
            let (at, first) = (*domain as usize, source);
            // The kernel does not read the transform of a follower.
            let transform: [u32; TRANSFORM_WORDS] =
                bytemuck::cast(state.transforms[scene.transform_roots.root_of(at)].0);
            transforms[TRANSFORM_WORDS * index..][..TRANSFORM_WORDS].copy_from_slice(&transform);
            let own = state.q_of(scene, at);
            if source + own.len().next_multiple_of(4) > q.len() {
                // Domains can share coordinates, so the entries may need more coordinates than the scene has.
                return None;
            }
            packing.put_q(at, own, |number| {
                q[source] = number.to_bits();
                source += 1;
            });
            let change = Change {
                domain: *domain,
                first_q: packing.coordinates.first[at],
                count: (source - first) as u32,
                source: first as u32,
            };
            changes[CHANGE_WORDS * index..][..CHANGE_WORDS].copy_from_slice(bytemuck::cast_slice(&[change]));
            count += 1;
        }
        if self.lists == u32::MAX {
            self.named.fill(0);
            self.lists = 0;
        }
        self.lists += 1;
        let all = domains.changed.iter().chain(domains.outdated);
        let dirty_tiles = self.list_tiles(packing, all, tiles);
        if dirty_tiles as usize > packing.dirty_tile_layout.whole {
            return None;
        }
        Some(ChangeListLengths { changed: count, dirty_tiles })
    }

    /// Lists the tiles of these domains, each once. Returns their number.
    fn list_tiles<'a>(
        &mut self,
        packing: &InputPacker,
        domains: impl Iterator<Item = &'a u32>,
        tiles: &mut [u32],
    ) -> u32 {
        let mut count = 0;
        for domain in domains {
            for (first, length) in packing.dirty_tile_layout.spans[*domain as usize] {
                for tile in first..first + length {
                    let mark = &mut self.named[tile as usize];
                    if *mark != self.lists {
                        *mark = self.lists;
                        tiles[count] = tile;
                        count += 1;
                    }
                }
            }
        }
        count as u32
    }
}

#[cfg(test)]
mod tests {
    use super::super::test_scenes::{deformed, followed};
    use super::*;
    use modalcast_model::scene::{DeformationSettings, NormalMethod};

    #[test]
    fn followers_without_coordinates_have_entries_where_somebody_asks_for_their_stamps_alone() {
        let plain = DeformationSettings::default();
        let exact = DeformationSettings { normals: NormalMethod::Exact, ..plain };
        let boxes = DeformationSettings { boxes: true, ..plain };
        let displacements = DeformationSettings { displacements: true, ..plain };
        let mut sizes = [(7, 0); 8];
        // Without modes, normals would not follow the surface.
        sizes[7].1 = 1;
        let entries = |deformation| max_change_entries(&followed(&sizes, deformation));
        // A quarter of sixteen domains may change; one is the transform root, and two have coordinates.
        assert_eq!([plain, exact, boxes, displacements].map(entries), [3, 4, 4, 3]);
        assert_eq!(max_change_entries(&deformed(&sizes, plain)), 4, "nobody follows");
        assert_eq!(max_changed_domains(&followed(&sizes, plain)), 4, "followers count among what changes");
        let truncated = DeformationSettings { truncation: Some(0.1), ..plain };
        assert_eq!(max_change_entries(&followed(&sizes, truncated)), 0);
    }
}
