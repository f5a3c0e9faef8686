//! The group concept of chapter 3.2.2: domains of different ranks are brought into one layout, so that one kernel
//! computes all of them. No I/O.
//!
//! Notation of the text: n_vr is the number of float4 per row of U' ([`fours`]); a warp holds n_g groups of w_g lanes;
//! a group holds n_gg rows of one domain at a time. U'' (equations 3.5 and 3.6) has w_g columns and n' = ceil(3n /
//! n_gg) rows. The text prints floor(3n / n_gg), which omits up to n_gg - 1 rows of U.

use serde::Serialize;

use modalcast_model::scene::{Scene, SceneState};

/// Lanes per warp, and threads per block.
pub(super) const WARP: usize = 32;
pub(super) const BLOCK: usize = 256;

/// The largest rank that the text's groups support.
pub(super) const LARGEST_RANK: usize = 32;

/// Output index in the metadata of an idle lane.
pub(super) const IDLE: u32 = u32::MAX;

/// Number of kernels over which the domains are distributed by n_vr (figures 3.5 and 3.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum KernelSplit {
    /// All with w_g = 8.
    One,
    /// n_vr of 3, 5 and 6 with w_g = 6, the others with 8: the fastest in the text.
    Two,
    /// n_vr of 3 and 6 with w_g = 6, 5 with 5, 7 with 7, the others with 8: no lane of a group is idle.
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
    pub const fn width_of(self, fours: usize) -> usize {
        match (self, fours) {
            (Self::Two, 3 | 5 | 6) | (Self::Four, 3 | 6) => 6,
            (Self::Four, 5 | 7) => fours,
            _ => 8,
        }
    }
}

/// n_vr: float4 per row of U'.
pub(super) const fn fours(rank: usize) -> usize {
    rank.div_ceil(4)
}

/// n_g: groups per warp.
const fn groups_of_warp(width: usize) -> usize {
    WARP / width
}

/// n_gg: rows of U that a group computes at a time.
const fn rows_of_group(width: usize, fours: usize) -> usize {
    width / fours
}

/// n': rows of U'' for `rows` = 3n rows of U.
const fn reshaped_rows(rows: usize, width: usize, fours: usize) -> usize {
    rows.div_ceil(rows_of_group(width, fours))
}

/// Idle lanes of a full warp, for groups of `width` lanes on rows of `fours` float4.
pub const fn idle_lanes_per_warp(width: usize, fours: usize) -> usize {
    WARP - groups_of_warp(width) * rows_of_group(width, fours) * fours
}

/// Lanes that one kernel launches, and the number of idle ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct LaneCounts {
    /// w_g.
    pub width: usize,
    pub all: u64,
    pub idle: u64,
}

/// The lanes of each kernel of a split, computed from sizes alone.
pub fn count_lanes(scene: &Scene, split: KernelSplit) -> Vec<LaneCounts> {
    let of_width = |width: &usize| {
        let (mut groups, mut busy) = (0, 0);
        for slot in scene.layout.slots.iter().filter(|slot| is_of_width(split, *width, slot.rank)) {
            groups += reshaped_rows(3 * slot.vertices, *width, fours(slot.rank));
            busy += (3 * slot.vertices * fours(slot.rank)) as u64;
        }
        let all = (groups.div_ceil(groups_of_warp(*width)) * WARP).next_multiple_of(BLOCK) as u64;
        LaneCounts { width: *width, all, idle: all - busy }
    };
    split.widths().iter().map(of_width).filter(|count_lanes| count_lanes.all > 0).collect()
}

const fn is_of_width(split: KernelSplit, width: usize, rank: usize) -> bool {
    rank > 0 && split.width_of(fours(rank)) == width
}

/// First vertex of each domain's u, `None` without modes, and the total of vertices with a u.
pub(super) fn places_of_u(scene: &Scene) -> (Vec<Option<u32>>, usize) {
    let mut total = 0;
    let place = |slot: &modalcast_model::scene::DomainLayout| {
        let first = total;
        total += if slot.rank > 0 { slot.vertices } else { 0 };
        (slot.rank > 0).then_some(first as u32)
    };
    let places = scene.layout.slots.iter().map(place).collect();
    (places, total)
}

/// q'': the coordinates of each domain, padded to whole float4.
pub(super) fn packed_q(scene: &Scene, state: &SceneState) -> Vec<f32> {
    let mut packed = Vec::with_capacity(scene.layout.coordinates + 3 * scene.domains.len());
    for domain in 0..scene.domains.len() {
        packed.extend_from_slice(state.q_of(scene, domain));
        packed.resize(packed.len().next_multiple_of(4), 0.0);
    }
    packed
}

/// The k-th float4 of a row of U, padded with zeros.
pub(super) fn entry(scene: &Scene, domain: usize, row: usize, k: usize) -> [f32; 4] {
    let modes = &scene.shape_of(domain).modes;
    [0, 1, 2, 3].map(|part| match 4 * k + part {
        mode if mode < modes.rank() => modes.at(row / 3, row % 3, mode),
        _ => 0.0,
    })
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
pub(super) fn pack(scene: &Scene, split: KernelSplit, width: usize) -> PackedGroups {
    let (places, _) = places_of_u(scene);
    let mut packed = PackedGroups { width, entries: Vec::new(), meta: Vec::new() };
    let mut first_q = 0;
    for (domain, slot) in scene.layout.slots.iter().enumerate() {
        let wide = fours(slot.rank);
        if let Some(first_u) = places[domain].filter(|_| is_of_width(split, width, slot.rank)) {
            let rows = 3 * slot.vertices;
            let reshaped = reshaped_rows(rows, width, wide);
            for group in 0..reshaped {
                packed.begin_group();
                for lane in 0..width {
                    let (part, k) = (lane / wide, lane % wide);
                    let row = part * reshaped + group;
                    let busy = part < rows_of_group(width, wide) && row < rows;
                    packed.push(busy.then(|| {
                        let place = 4 * (first_u + row as u32 / 3) + row as u32 % 3;
                        (entry(scene, domain, row, k), [place, first_q + k as u32, wide as u32, 0])
                    }));
                }
            }
        }
        first_q += wide as u32;
    }
    while !packed.meta.len().is_multiple_of(BLOCK) {
        packed.push(None);
    }
    packed
}

impl PackedGroups {
    fn push(&mut self, lane: Option<([f32; 4], [u32; 4])>) {
        let (entry, meta) = lane.unwrap_or(([0.0; 4], [IDLE, 0, 1, 0]));
        self.entries.push(entry);
        self.meta.push(meta);
    }

    /// Pads so that the next group lies in one warp.
    fn begin_group(&mut self) {
        while self.meta.len() % WARP >= groups_of_warp(self.width) * self.width {
            self.push(None);
        }
    }

    /// Lanes that multiply.
    pub(super) fn busy(&self) -> u64 {
        self.meta.iter().filter(|meta| meta[0] != IDLE).count() as u64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_compute::testing::scene_and_state;

    #[test]
    fn only_four_kernels_leave_no_idle_lane_in_groups() {
        let idle_in_group = |split: KernelSplit, fours: usize| split.width_of(fours) % fours;
        for fours in 1..=8 {
            assert_eq!(idle_in_group(KernelSplit::Four, fours), 0, "n_vr {fours}");
        }
        let idle = |split: KernelSplit| (1..=8).filter(|fours| idle_in_group(split, *fours) > 0).collect::<Vec<_>>();
        assert_eq!(idle(KernelSplit::Two), [5, 7]);
        assert_eq!(idle(KernelSplit::One), [3, 5, 6, 7]);
        // Lanes outside of groups count as idle too: with w_g = 6 two per warp, as the text says of widths that do not
        // divide 32.
        assert_eq!([1, 2, 4, 8].map(|fours| idle_lanes_per_warp(8, fours)), [0; 4]);
        assert_eq!([3, 6].map(|fours| idle_lanes_per_warp(6, fours)), [2, 2]);
        assert_eq!([idle_lanes_per_warp(6, 5), idle_lanes_per_warp(8, 5), idle_lanes_per_warp(5, 5)], [7, 12, 2]);
        assert_eq!([idle_lanes_per_warp(8, 7), idle_lanes_per_warp(7, 7), idle_lanes_per_warp(8, 3)], [4, 4, 8]);
    }

    #[test]
    fn floor_drops_rows_of_u_that_ceil_keeps() {
        let covered = |rows: usize, reshaped: usize, parts: usize| {
            (0..parts)
                .flat_map(|part| (0..reshaped).map(move |row| part * reshaped + row))
                .filter(|r| *r < rows)
                .count()
        };
        // Four vertices of rank 4 (n_vr = 1) in groups of eight: 12 rows of U fill one and a half rows of U''.
        let parts = rows_of_group(8, 1);
        assert_eq!((covered(12, 12 / parts, parts), covered(12, 12_usize.div_ceil(parts), parts)), (8, 12));
        assert_eq!(reshaped_rows(12, 8, 1), 2);
        let mut dropped = 0;
        for (vertices, wide) in (1..50).flat_map(|vertices| (1..=8).map(move |wide| (vertices, wide))) {
            for split in KernelSplit::ALL {
                let (rows, width) = (3 * vertices, split.width_of(wide));
                let parts = rows_of_group(width, wide);
                assert_eq!(covered(rows, reshaped_rows(rows, width, wide), parts), rows);
                dropped += usize::from(covered(rows, rows / parts, parts) < rows);
            }
        }
        assert!(dropped > 100, "floor drops rows in {dropped} cases");
    }

    #[test]
    fn lane_counts_match_the_packing() {
        let shapes: Vec<_> = (0..40).map(|index| (1 + index * 7 % 50, index % 33, 1)).collect();
        let (scene, _) = scene_and_state(&shapes);
        for split in KernelSplit::ALL {
            let counted = count_lanes(&scene, split);
            assert_eq!(counted.len(), split.widths().len());
            for count_lanes in counted {
                let packed = pack(&scene, split, count_lanes.width);
                assert_eq!(
                    (packed.meta.len() as u64, packed.busy()),
                    (count_lanes.all, count_lanes.all - count_lanes.idle)
                );
                assert_eq!(packed.meta.len(), packed.entries.len());
            }
        }
        let share = |split: KernelSplit| {
            let all = count_lanes(&scene, split);
            all.iter().map(|count_lanes| count_lanes.idle).sum::<u64>() as f64
                / all.iter().map(|count_lanes| count_lanes.all).sum::<u64>() as f64
        };
        assert!(share(KernelSplit::Two) < share(KernelSplit::One), "two kernels leave fewer lanes idle than one");
    }
}
