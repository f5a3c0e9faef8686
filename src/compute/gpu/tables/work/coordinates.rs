//! Layout of modal coordinates on the device. Pure.

use crate::storage::modes_per_chunk;
use modalcast_model::scene::{Scene, StorageType};

/// Offsets of the domains' coordinates on the device, padded to whole chunks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CoordinateLayout {
    /// Per domain.
    pub first: Vec<u32>,
    /// Number of all coordinates, a multiple of four.
    pub total: usize,
    /// Whether the layout equals the scene's own packing.
    pub is_scene_order: bool,
}

impl CoordinateLayout {
    pub(crate) fn new(scene: &Scene) -> Self {
        let storage = scene.deformation.storage;
        // Factors belong to a shape and lists of kept modes to a domain, so domains that share coordinates cannot share
        // these.
        if storage == StorageType::F32 && !scene.features.truncation {
            let first = scene.layout.domains.iter().map(|slot| slot.first_q as u32).collect();
            return Self { first, total: scene.layout.coordinates.next_multiple_of(4), is_scene_order: true };
        }
        let mut total = 0;
        let place = |slot: &modalcast_model::scene::DomainLayout| {
            let first = total;
            total += slot.rank.next_multiple_of(modes_per_chunk(storage));
            first as u32
        };
        let first = scene.layout.domains.iter().map(place).collect();
        Self { first, total: total.next_multiple_of(4), is_scene_order: false }
    }
}
