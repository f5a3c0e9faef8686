//! Bindings, phases and counters of the fragment lists of order-independent transparency.
//!
//! The gather program (`shaders/oit_gather.frag`) draws the blended triangles in three phases. Each pixel may store a
//! maximum number of fragments, which is called the limit below ([`OitCounters::per_pixel_limit`]).

use bytemuck::{Pod, Zeroable};

use crate::types::OitStats;

/// Side of the square of pixels that a workgroup adds to the histogram.
pub(crate) const HISTOGRAM_TILE: u32 = 16;
/// Bins of the histogram over fragments per pixel; the last bin also counts pixels with more fragments.
pub(crate) const BINS: usize = 256;
/// Bytes of a record, which stores a fragment: a word of depth, and a word of id and coverage.
pub(crate) const RECORD_BYTES: u64 = 8;
/// Storage bindings.
pub(crate) const RECORDS_BINDING: u32 = 2;
pub(crate) const OIT_COUNTERS_BINDING: u32 = 3;
/// Image units.
pub(crate) const FRAGMENT_COUNTS_IMAGE: u32 = 1;
pub(crate) const CURSORS_IMAGE: u32 = 2;
pub(crate) const BLEND_LAYERS_IMAGE: u32 = 3;
/// Phase of the gather program that counts fragments.
pub(crate) const PHASE_COUNT: i32 = 0;
/// Phase of the gather program that stores the fragments of all pixels with at most as many fragments as the limit. For
/// pixels with more, it stores only the depths of the nearest fragments.
pub(crate) const PHASE_FILL: i32 = 1;
/// Phase of the gather program for pixels with more fragments than the limit. It writes the triangle ids into the
/// records whose depths [`PHASE_FILL`] has stored.
pub(crate) const PHASE_FILL_IDS: i32 = 2;

/// Counters and indirect draws of a frame. Twin of `OitCounters` in `shaders/shared/oit_lists.glsl` without its last
/// member, the bins.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
pub(crate) struct OitCounters {
    /// Number of blended fragments of the frame, low word first.
    pub(crate) fragment_total: [u32; 2],
    /// Maximum number of fragments of a pixel.
    pub(crate) max_per_pixel: u32,
    /// Maximum number of stored fragments per pixel; `u32::MAX` without a limit.
    pub(crate) per_pixel_limit: u32,
    /// Number of allocated records.
    pub(crate) allocated: u32,
    /// Maximum number of records.
    pub(crate) budget: u32,
    /// Indirect draws of [`PHASE_FILL_IDS`], for the blended triangles with and without culling of back faces. Numbers
    /// of a draw: index count, instances, first index, base vertex, base instance.
    pub(crate) commands: [[u32; 5]; 2],
}

/// Bytes of the counters buffer before the bins.
pub(crate) const OIT_HEADER_BYTES: usize = size_of::<OitCounters>();
/// Byte offset of `commands` in [`OitCounters`], after six words.
pub(crate) const COMMANDS_OFFSET: usize = 24;
/// Bytes of the counters buffer.
pub(crate) const COUNTERS_BYTES: usize = OIT_HEADER_BYTES + 4 * BINS;
const _: () = assert!(OIT_HEADER_BYTES == 64, "OitCounters differs from shaders/shared/oit_lists.glsl");

/// Parses the fragment statistics of a frame from the bytes of its [`OitCounters`].
pub(crate) fn parse_counters(bytes: &[u8]) -> OitStats {
    let mut counters = OitCounters::zeroed();
    // Copy bytes, because `bytes` may be unaligned.
    bytemuck::bytes_of_mut(&mut counters).iter_mut().zip(bytes).for_each(|(target, source)| *target = *source);
    let [low_word, high_word] = counters.fragment_total.map(u64::from);
    let per_pixel_limit = (counters.per_pixel_limit != u32::MAX).then_some(counters.per_pixel_limit);
    OitStats {
        fragments: high_word << 32 | low_word,
        stored: counters.allocated.into(),
        max_per_pixel: counters.max_per_pixel,
        per_pixel_limit,
    }
}
