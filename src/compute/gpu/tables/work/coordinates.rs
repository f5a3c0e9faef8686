//! Layout of modal coordinates on the device. Pure.

use crate::storage::modes_per_chunk;
use modalcast_model::scene::{Scene, StorageType};

/// Offsets of the coordinates of each domain on the device. The coordinates of a domain are padded to whole chunks unless
/// the scene's own order is kept.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CoordinateLayout {
    /// Per domain, the offset of its first coordinate.
    pub first: Vec<u32>,
    /// Number of all coordinates, a multiple of four.
    pub total: usize,
    /// Whether the layout equals the scene's own packing.
    pub is_scene_order: bool,
}

impl CoordinateLayout {
    pub(crate) fn new(scene: &Scene) -> Self {
        let storage = scene.deformation.storage;
        // Domains may share coordinates. Factors belong to a shape and retained chunks to a domain, so with either of them
        // each domain has its own coordinates on the device.
        if storage == StorageType::F32 && !scene.features.truncation {
            let first = scene.layout.domains.iter().map(|slot| slot.first_q as u32).collect();
            return Self { first, total: scene.layout.coordinates.next_multiple_of(4), is_scene_order: true };
        }
        let mut total = 0;
        let place_domain = |slot: &modalcast_model::scene::DomainLayout| {
            let first = total;
            total += slot.rank.next_multiple_of(modes_per_chunk(storage));
            first as u32
        };
        let first = scene.layout.domains.iter().map(place_domain).collect();
        Self { first, total: total.next_multiple_of(4), is_scene_order: false }
    }
}
