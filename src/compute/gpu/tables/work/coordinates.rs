//! Layout of modal coordinates on the device.

use crate::storage::modes_per_chunk;
use modalcast_model::scene::{DomainLayout, Scene, StorageType};

/// The coordinates of a domain with modes, in a layout that differs from that of the scene's state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct CoordinateRange {
    /// Offset of the first coordinate in the scene's state.
    pub scene_first_q: usize,
    /// Offset of the first coordinate on the device.
    pub first_q: usize,
    pub rank: usize,
}

/// Offsets of the coordinates of each domain on the device. The coordinates of a domain are padded to whole chunks of
/// modes, unless the layout is that of the scene's state.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct CoordinateLayout {
    /// Per domain, the offset of its first coordinate.
    pub first_q: Vec<u32>,
    /// The ranges of all domains with modes, in the order of the device; empty if the layout is that of the scene's
    /// state. The other domains, often most of them, are rigid.
    pub ranges: Vec<CoordinateRange>,
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
            let total = scene.layout.coordinates.next_multiple_of(4);
            return Self { first_q, ranges: Vec::new(), total, is_scene_order: true };
        }
        let mut total = 0;
        let allocate_q = |layout: &DomainLayout| {
            let range = CoordinateRange { scene_first_q: layout.first_q, first_q: total, rank: layout.rank };
            total += layout.rank.next_multiple_of(modes_per_chunk(storage));
            range
        };
        let mut ranges: Vec<CoordinateRange> = scene.layout.domains.iter().map(allocate_q).collect();
        let first_q = ranges.iter().map(|range| range.first_q as u32).collect();
        ranges.retain(|range| range.rank > 0);
        ranges.shrink_to_fit();
        Self { first_q, ranges, total: total.next_multiple_of(4), is_scene_order: false }
    }

    /// Number of coordinates of a domain on the device.
    pub(crate) fn padded_rank(&self, scene: &Scene, rank: usize) -> usize {
        if self.is_scene_order { rank } else { rank.next_multiple_of(modes_per_chunk(scene.deformation.storage)) }
    }

    /// The factors of all coordinates of the device, from the factors of each shape's modes; zero for padding. Empty
    /// unless the storage type has factors.
    pub(crate) fn spread_factors(&self, scene: &Scene, shape_factors: &[Vec<f32>]) -> Vec<f32> {
        if shape_factors.iter().all(Vec::is_empty) {
            return Vec::new();
        }
        let mut factors = vec![0.0; self.total];
        for (domain, first_q) in scene.domains.iter().zip(&self.first_q) {
            let domain_factors = &shape_factors[domain.shape];
            factors[*first_q as usize..][..domain_factors.len()].copy_from_slice(domain_factors);
        }
        factors
    }
}
