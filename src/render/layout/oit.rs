//! Fragment lists of order-independent transparency.

use bytemuck::{Pod, Zeroable};

use crate::types::OitStats;

/// Side of the square of pixels whose fragments a workgroup counts.
pub(crate) const HISTOGRAM_TILE: u32 = 16;
/// Bins of the histogram over fragments per pixel; the last bin also counts pixels with more fragments.
pub(crate) const BINS: usize = 256;
/// Bytes of a fragment: depth, then id and coverage.
pub(crate) const RECORD_BYTES: u64 = 8;
/// Storage bindings.
pub(crate) const RECORDS_BINDING: u32 = 2;
pub(crate) const COUNTERS_BINDING: u32 = 3;
/// Image units.
pub(crate) const COUNTS_IMAGE: u32 = 1;
pub(crate) const CURSORS_IMAGE: u32 = 2;
pub(crate) const LAYERS_IMAGE: u32 = 3;
/// Phases of the gather program: count, fill, and add ids to the kept depths.
pub(crate) const PHASE_COUNT: i32 = 0;
pub(crate) const PHASE_FILL: i32 = 1;
pub(crate) const PHASE_JOIN_IDS: i32 = 2;

/// Counters and indirect draws of a frame. Twin of `OitCounters` in `shaders/shared/oit_lists.glsl`, up to its bins.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct OitCounters {
    pub(crate) total: [u32; 2],
    pub(crate) max_per_pixel: u32,
    pub(crate) per_pixel_limit: u32,
    pub(crate) used: u32,
    pub(crate) budget: u32,
    /// Indirect draws: index count, instances, first index, base vertex, base instance.
    pub(crate) commands: [[u32; 5]; 2],
}

pub(crate) const COUNTERS_HEADER_BYTES: usize = size_of::<OitCounters>();
pub(crate) const COMMANDS_OFFSET: usize = 24;
pub(crate) const COUNTERS_BYTES: usize = COUNTERS_HEADER_BYTES + 4 * BINS;
const _: () = assert!(COUNTERS_HEADER_BYTES == 64, "OitCounters differs from shaders/shared/oit_lists.glsl");

/// Fragment statistics of a frame, from the head of its ledger.
pub(crate) fn parse_counters(head: &[u8]) -> OitStats {
    let mut counters = OitCounters::zeroed();
    // A byte copy, because `head` may be unaligned; it has the length of the ledger.
    bytemuck::bytes_of_mut(&mut counters).iter_mut().zip(head).for_each(|(to, from)| *to = *from);
    let [low, high] = counters.total.map(u64::from);
    let per_pixel_limit = (counters.per_pixel_limit != u32::MAX).then_some(counters.per_pixel_limit);
    OitStats {
        fragments: high << 32 | low,
        stored: counters.used.into(),
        max_per_pixel: counters.max_per_pixel,
        per_pixel_limit,
    }
}
