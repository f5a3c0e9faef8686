//! Layout of modal coordinates on the device.

use crate::storage::modes_per_chunk;
use modalcast_model::scene::{DomainLayout, Scene, StorageType};

/// Offsets of the coordinates of each domain on the device. The coordinates of a domain are padded to whole chunks of
/// modes, unless the layout is that of the scene's state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CoordinateLayout {
    /// Per domain, the offset of its first coordinate.
    pub first_q: Vec<u32>,
    /// Number of all coordinates with padding, a multiple of four.
    pub total: usize,
    /// Whether the layout equals that of the scene's state.
    pub is_scene_order: bool,
}

impl CoordinateLayout {
    pub(crate) fn new(scene: &Scene) -> Self {
        let storage = scene.deformation.storage;
        // Domains may share coordinates. Factors belong to a shape, so with factors each domain has its own coordinates
        // on the device.
        if storage == StorageType::F32 {
            let first_q = scene.layout.domains.iter().map(|layout| layout.first_q as u32).collect();
            return Self { first_q, total: scene.layout.coordinates.next_multiple_of(4), is_scene_order: true };
        }
        let mut total = 0;
        let allocate_q = |layout: &DomainLayout| {
            let first_q = total;
            total += layout.rank.next_multiple_of(modes_per_chunk(storage));
            first_q as u32
        };
        let first_q = scene.layout.domains.iter().map(allocate_q).collect();
        Self { first_q, total: total.next_multiple_of(4), is_scene_order: false }
    }
}
