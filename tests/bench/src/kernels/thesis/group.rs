//! The group concept of chapter 3.2.2: one layout for domains of different ranks, so that one kernel computes all of
//! them. No I/O.
//!
//! Notation of the text: a row of U' has n_vr float4 ([`vectors_per_row`]). A warp holds n_g groups of w_g lanes. A
//! group holds n_gg rows of one domain at a time. U'' (equations 3.5 and 3.6) has w_g columns and n' = ceil(3n / n_gg)
//! rows. The text prints floor(3n / n_gg), which omits up to n_gg - 1 rows of U.

use serde::Serialize;

use modalcast_model::scene::{Scene, SceneState};

/// Lanes per warp, and threads per block.
pub(super) const WARP: usize = 32;
pub(super) const BLOCK: usize = 256;

/// Maximum rank that the text's groups support.
pub(super) const MAX_RANK: usize = 32;

/// Output index in the metadata of an idle lane.
pub(super) const IDLE: u32 = u32::MAX;

/// Number of kernels; n_vr determines which of them computes a domain (figures 3.5 and 3.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum KernelSplit {
    /// w_g is 8 for all n_vr.
    One,
    /// w_g is 6 for an n_vr of 3, 5 or 6, and otherwise 8. The fastest split in the text.
    Two,
    /// w_g is 6 for an n_vr of 3 or 6, 5 for 5, 7 for 7, and otherwise 8. No lane of a group is idle.
    Four,
}

impl KernelSplit {
    /// All variants.
    pub const ALL: [Self; 3] = [Self::One, Self::Two, Self::Four];

    /// The group widths w_g, one per kernel.
    pub const fn widths(self) -> &'static [usize] {
        match self {
            Self::One => &[8],
            Self::Two => &[6, 8],
            Self::Four => &[5, 6, 7, 8],
        }
    }

    /// w_g of a domain whose rows are n_vr (1 to 8) float4.
    pub const fn width_of(self, n_vr: usize) -> usize {
        match (self, n_vr) {
            (Self::Two, 3 | 5 | 6) | (Self::Four, 3 | 6) => 6,
            (Self::Four, 5 | 7) => n_vr,
            _ => 8,
        }
    }
}

/// n_vr: float4 per row of U'.
pub(super) const fn vectors_per_row(rank: usize) -> usize {
    rank.div_ceil(4)
}

/// n_g: groups per warp.
const fn groups_per_warp(width: usize) -> usize {
    WARP / width
}

/// n_gg: rows of U that a group computes at a time.
const fn rows_per_group(width: usize, n_vr: usize) -> usize {
    width / n_vr
}

/// n': rows of U'' for `rows` = 3n rows of U.
const fn reshaped_rows(rows: usize, width: usize, n_vr: usize) -> usize {
    rows.div_ceil(rows_per_group(width, n_vr))
}

/// Idle lanes of a full warp, for groups of `width` lanes on rows of `n_vr` float4.
pub const fn idle_lanes_per_warp(width: usize, n_vr: usize) -> usize {
    WARP - groups_per_warp(width) * rows_per_group(width, n_vr) * n_vr
}

/// Lanes that one kernel launches, and the number of idle ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct LaneCounts {
    /// w_g.
    pub width: usize,
    /// Launched lanes.
    pub all: u64,
    pub idle: u64,
}

/// The lane counts of each kernel of a split, computed without packing.
pub fn count_lanes(scene: &Scene, split: KernelSplit) -> Vec<LaneCounts> {
    let count_for_width = |width: &usize| {
        let (mut groups, mut busy_lanes) = (0, 0);
        for slot in scene.layout.domains.iter().filter(|slot| belongs_to_width(split, *width, slot.rank)) {
            groups += reshaped_rows(3 * slot.vertices, *width, vectors_per_row(slot.rank));
            busy_lanes += (3 * slot.vertices * vectors_per_row(slot.rank)) as u64;
        }
        let all = (groups.div_ceil(groups_per_warp(*width)) * WARP).next_multiple_of(BLOCK) as u64;
        LaneCounts { width: *width, all, idle: all - busy_lanes }
    };
    split.widths().iter().map(count_for_width).filter(|counts| counts.all > 0).collect()
}

const fn belongs_to_width(split: KernelSplit, width: usize, rank: usize) -> bool {
    rank > 0 && split.width_of(vectors_per_row(rank)) == width
}

/// Layout of u: the vertices of all domains with modes.
#[derive(Debug)]
pub(super) struct DisplacementLayout {
    /// First vertex of each domain's u; `None` without modes.
    pub first_vertices: Vec<Option<u32>>,
    /// Number of vertices that have a u.
    pub vertex_count: usize,
}

impl DisplacementLayout {
    pub(super) fn of(scene: &Scene) -> Self {
        let mut vertex_count = 0;
        let mut append_domain = |slot: &modalcast_model::scene::DomainLayout| {
            let first = vertex_count;
            vertex_count += if slot.rank > 0 { slot.vertices } else { 0 };
            (slot.rank > 0).then_some(first as u32)
        };
        let first_vertices = scene.layout.domains.iter().map(&mut append_domain).collect();
        Self { first_vertices, vertex_count }
    }
}

/// q'': the coordinates of each domain, padded to whole float4.
pub(super) fn pack_q(scene: &Scene, state: &SceneState) -> Vec<f32> {
    let mut packed = Vec::with_capacity(scene.layout.coordinates + 3 * scene.domains.len());
    for domain in 0..scene.domains.len() {
        packed.extend_from_slice(state.q_of(scene, domain));
        packed.resize(packed.len().next_multiple_of(4), 0.0);
    }
    packed
}

/// The k-th float4 of a row of U, padded with zeros.
pub(super) fn pack_row_vector(scene: &Scene, domain: usize, row: usize, k: usize) -> [f32; 4] {
    let modes = &scene.shape_of(domain).modes;
    [0, 1, 2, 3].map(|component| match 4 * k + component {
        mode if mode < modes.rank() => modes.entry(row / 3, row % 3, mode),
        _ => 0.0,
    })
}

/// A float4 of U'' and the metadata of one lane.
struct Lane {
    entry: [f32; 4],
    meta: [u32; 4],
}

/// Inputs of one kernel: a float4 of U'' and the metadata of each lane.
#[derive(Debug)]
pub(super) struct PackedGroups {
    pub width: usize,
    pub entries: Vec<[f32; 4]>,
    /// Per lane: output index in u (floats) or [`IDLE`], input index in q (float4), n_vr, unused.
    pub meta: Vec<[u32; 4]>,
}

/// Packs all domains whose groups are `width` lanes wide.
pub(super) fn pack_groups(scene: &Scene, split: KernelSplit, width: usize) -> PackedGroups {
    let displacements = DisplacementLayout::of(scene);
    let mut packed = PackedGroups { width, entries: Vec::new(), meta: Vec::new() };
    // Index of the domain's first float4 of q.
    let mut first_q = 0;
    for (domain, slot) in scene.layout.domains.iter().enumerate() {
        let n_vr = vectors_per_row(slot.rank);
        let first_u = displacements.first_vertices[domain].filter(|_| belongs_to_width(split, width, slot.rank));
        if let Some(first_u) = first_u {
            let rows = 3 * slot.vertices;
            let reshaped = reshaped_rows(rows, width, n_vr);
            for group in 0..reshaped {
                packed.begin_group();
                for lane in 0..width {
                    let (row_of_group, k) = (lane / n_vr, lane % n_vr);
                    let row = row_of_group * reshaped + group;
                    let is_busy = row_of_group < rows_per_group(width, n_vr) && row < rows;
                    packed.push_lane(is_busy.then(|| {
                        let output = 4 * (first_u + row as u32 / 3) + row as u32 % 3;
                        let meta = [output, first_q + k as u32, n_vr as u32, 0];
                        Lane { entry: pack_row_vector(scene, domain, row, k), meta }
                    }));
                }
            }
        }
        first_q += n_vr as u32;
    }
    while !packed.meta.len().is_multiple_of(BLOCK) {
        packed.push_lane(None);
    }
    packed
}

impl PackedGroups {
    /// Appends a lane; `None` appends an idle one.
    fn push_lane(&mut self, lane: Option<Lane>) {
        let Lane { entry, meta } = lane.unwrap_or(Lane { entry: [0.0; 4], meta: [IDLE, 0, 1, 0] });
        self.entries.push(entry);
        self.meta.push(meta);
    }

    /// Appends idle lanes so that the next group lies in one warp.
    fn begin_group(&mut self) {
        while self.meta.len() % WARP >= groups_per_warp(self.width) * self.width {
            self.push_lane(None);
        }
    }

    /// Number of lanes that multiply.
    pub(super) fn busy_lanes(&self) -> u64 {
        self.meta.iter().filter(|meta| meta[0] != IDLE).count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_compute::testing::scene_and_state;

    #[test]
    fn only_four_kernels_leave_no_idle_lane_in_groups() {
        let idle_in_group = |split: KernelSplit, n_vr: usize| split.width_of(n_vr) % n_vr;
        for n_vr in 1..=8 {
            assert_eq!(idle_in_group(KernelSplit::Four, n_vr), 0, "n_vr {n_vr}");
        }
        let widths_with_idle_lanes =
            |split: KernelSplit| (1..=8).filter(|n_vr| idle_in_group(split, *n_vr) > 0).collect::<Vec<_>>();
        assert_eq!(widths_with_idle_lanes(KernelSplit::Two), [5, 7]);
        assert_eq!(widths_with_idle_lanes(KernelSplit::One), [3, 5, 6, 7]);
        // Lanes outside of groups are idle too. With w_g = 6 there are two per warp, because 6 does not divide 32.
        assert_eq!([1, 2, 4, 8].map(|n_vr| idle_lanes_per_warp(8, n_vr)), [0; 4]);
        assert_eq!([3, 6].map(|n_vr| idle_lanes_per_warp(6, n_vr)), [2, 2]);
        assert_eq!([idle_lanes_per_warp(6, 5), idle_lanes_per_warp(8, 5), idle_lanes_per_warp(5, 5)], [7, 12, 2]);
        assert_eq!([idle_lanes_per_warp(8, 7), idle_lanes_per_warp(7, 7), idle_lanes_per_warp(8, 3)], [4, 4, 8]);
    }

    #[test]
    fn floor_drops_rows_of_u_that_ceil_keeps() {
        let covered_rows = |rows: usize, reshaped: usize, rows_of_group: usize| {
            (0..rows_of_group)
                .flat_map(|row_of_group| (0..reshaped).map(move |row| row_of_group * reshaped + row))
                .filter(|row| *row < rows)
                .count()
        };
        // Four vertices of rank 4 (n_vr = 1) in groups of eight: 12 rows of U fill one and a half rows of U''.
        let rows_of_group = rows_per_group(8, 1);
        assert_eq!(
            (
                covered_rows(12, 12 / rows_of_group, rows_of_group),
                covered_rows(12, 12_usize.div_ceil(rows_of_group), rows_of_group)
            ),
            (8, 12)
        );
        assert_eq!(reshaped_rows(12, 8, 1), 2);
        let mut dropped_cases = 0;
        for (vertices, n_vr) in (1..50).flat_map(|vertices| (1..=8).map(move |n_vr| (vertices, n_vr))) {
            for split in KernelSplit::ALL {
                let (rows, width) = (3 * vertices, split.width_of(n_vr));
                let rows_of_group = rows_per_group(width, n_vr);
                assert_eq!(covered_rows(rows, reshaped_rows(rows, width, n_vr), rows_of_group), rows);
                dropped_cases += usize::from(covered_rows(rows, rows / rows_of_group, rows_of_group) < rows);
            }
        }
        assert!(dropped_cases > 100, "expected floor to drop rows in over 100 cases, got {dropped_cases}");
    }

    #[test]
    fn lane_counts_match_the_packing() {
        let shapes: Vec<_> = (0..40).map(|index| (1 + index * 7 % 50, index % 33, 1)).collect();
        let (scene, _) = scene_and_state(&shapes);
        for split in KernelSplit::ALL {
            let all_counts = count_lanes(&scene, split);
            assert_eq!(all_counts.len(), split.widths().len());
            for counts in all_counts {
                let packed = pack_groups(&scene, split, counts.width);
                assert_eq!((packed.meta.len() as u64, packed.busy_lanes()), (counts.all, counts.all - counts.idle));
                assert_eq!(packed.meta.len(), packed.entries.len());
            }
        }
        let idle_share = |split: KernelSplit| {
            let all_counts = count_lanes(&scene, split);
            all_counts.iter().map(|counts| counts.idle).sum::<u64>() as f64
                / all_counts.iter().map(|counts| counts.all).sum::<u64>() as f64
        };
        let [one_kernel, two_kernels] = [KernelSplit::One, KernelSplit::Two].map(idle_share);
        assert!(
            two_kernels < one_kernel,
            "expected fewer idle lanes with two kernels, got {two_kernels} and {one_kernel}"
        );
    }
}
