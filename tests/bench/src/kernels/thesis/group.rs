//! The groups of chapter 3.2.2: one layout of U for domains of different ranks, so that one kernel computes all of
//! them. Pure functions.
//!
//! Notation of the thesis, for a domain of n vertices:
//! * U' is U with every row padded to n_vr float4 ([`vectors_per_row`]).
//! * A warp has n_g groups of w_g lanes. A lane multiplies one float4, so a group computes n_gg rows of U' at a time.
//! * U'' (equations 3.5 and 3.6) has n' = ceil(3n / n_gg) rows of w_g float4, one row per group. Row i of U'' holds the
//!   rows i, i + n', i + 2 n', ... of U'. The thesis prints n' = floor(3n / n_gg), which omits up to n_gg - 1 rows.

use serde::Serialize;

use modalcast_model::scene::{Scene, SceneState};

/// Lanes per warp.
pub(super) const WARP: usize = 32;
/// Threads per block.
pub(super) const BLOCK: usize = 256;

/// Maximum rank that groups support: a row of U' has at most eight float4, one for each lane of the widest group.
pub(super) const MAX_RANK: usize = 32;

/// Output index of an idle lane, which multiplies nothing.
pub(super) const IDLE: u32 = u32::MAX;

/// Number of kernels. Each kernel has one group width w_g. The n_vr of a domain determines its kernel (figures 3.5 and
/// 3.6).
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum KernelSplit {
    /// w_g is 8 for all n_vr.
    One,
    /// w_g is 6 for an n_vr of 3, 5 or 6, and otherwise 8. The fastest split in the thesis.
    Two,
    /// w_g is 6 for an n_vr of 3 or 6, 5 for 5, 7 for 7, and otherwise 8. No lane of a group is idle.
    Four,
}

impl KernelSplit {
    /// All splits.
    pub const ALL: [Self; 3] = [Self::One, Self::Two, Self::Four];

    /// The group widths w_g, one per kernel.
    pub const fn widths(self) -> &'static [usize] {
        match self {
            Self::One => &[8],
            Self::Two => &[6, 8],
            Self::Four => &[5, 6, 7, 8],
        }
    }

    /// w_g of a domain, from its n_vr (1 to 8).
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

/// n_gg: rows of U' that a group computes at a time.
const fn rows_per_group(width: usize, n_vr: usize) -> usize {
    width / n_vr
}

/// n': rows of U'' for `rows` = 3n rows of U. It is also the number of groups.
const fn reshaped_rows(rows: usize, width: usize, n_vr: usize) -> usize {
    rows.div_ceil(rows_per_group(width, n_vr))
}

/// Idle lanes of a full warp, for groups of `width` lanes and rows of `n_vr` float4: 32 - n_g n_gg n_vr.
pub const fn idle_lanes_per_warp(width: usize, n_vr: usize) -> usize {
    WARP - groups_per_warp(width) * rows_per_group(width, n_vr) * n_vr
}

/// Numbers of lanes that one kernel launches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct LaneCounts {
    /// w_g, lanes per group.
    pub width: usize,
    /// All lanes, including those that fill up the last warp and block.
    pub all: u64,
    /// Lanes that multiply nothing.
    pub idle: u64,
}

/// The lane counts of each kernel of a split, computed without packing U. Kernels without domains are omitted.
pub fn count_lanes(scene: &Scene, split: KernelSplit) -> Vec<LaneCounts> {
    let count_for_width = |width: &usize| {
        let (mut groups, mut busy_lanes) = (0, 0);
        for domain_layout in
            scene.layout.domains.iter().filter(|domain_layout| belongs_to_width(split, *width, domain_layout.rank))
        {
            groups += reshaped_rows(3 * domain_layout.vertices, *width, vectors_per_row(domain_layout.rank));
            busy_lanes += (3 * domain_layout.vertices * vectors_per_row(domain_layout.rank)) as u64;
        }
        let all = (groups.div_ceil(groups_per_warp(*width)) * WARP).next_multiple_of(BLOCK) as u64;
        LaneCounts { width: *width, all, idle: all - busy_lanes }
    };
    split.widths().iter().map(count_for_width).filter(|counts| counts.all > 0).collect()
}

const fn belongs_to_width(split: KernelSplit, width: usize, rank: usize) -> bool {
    rank > 0 && split.width_of(vectors_per_row(rank)) == width
}

/// Layout of u: one float4 per vertex of the domains with modes, one domain after the other.
#[derive(Debug)]
pub(super) struct DisplacementLayout {
    /// Index of each domain's first vertex in u; `None` for domains without modes.
    pub first_vertices: Vec<Option<u32>>,
    /// Number of vertices of the domains with modes.
    pub vertex_count: usize,
}

impl DisplacementLayout {
    pub(super) fn of(scene: &Scene) -> Self {
        let mut vertex_count = 0;
        let mut append_domain = |domain_layout: &modalcast_model::scene::DomainLayout| {
            let first = vertex_count;
            vertex_count += if domain_layout.rank > 0 { domain_layout.vertices } else { 0 };
            (domain_layout.rank > 0).then_some(first as u32)
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

/// The inputs of one lane.
struct Lane {
    /// A float4 of U''.
    entry: [f32; 4],
    /// As in [`PackedGroups::meta`].
    meta: [u32; 4],
}

/// The inputs of all lanes of one kernel.
#[derive(Debug)]
pub(super) struct PackedGroups {
    /// w_g, lanes per group.
    pub width: usize,
    /// Per lane a float4 of U''.
    pub entries: Vec<[f32; 4]>,
    /// Per lane: index of its result in u (in floats) or [`IDLE`], index of its input in q (in float4), n_vr, unused.
    pub meta: Vec<[u32; 4]>,
}

/// Packs the domains that `split` assigns to groups of `width` lanes.
pub(super) fn pack_groups(scene: &Scene, split: KernelSplit, width: usize) -> PackedGroups {
    let displacements = DisplacementLayout::of(scene);
    let mut packed = PackedGroups { width, entries: Vec::new(), meta: Vec::new() };
    // Index of the domain's first float4 of q.
    let mut first_q = 0;
    for (domain, domain_layout) in scene.layout.domains.iter().enumerate() {
        let n_vr = vectors_per_row(domain_layout.rank);
        let first_u =
            displacements.first_vertices[domain].filter(|_| belongs_to_width(split, width, domain_layout.rank));
        if let Some(first_u) = first_u {
            let rows = 3 * domain_layout.vertices;
            let group_count = reshaped_rows(rows, width, n_vr);
            for group in 0..group_count {
                packed.begin_group();
                for lane in 0..width {
                    let (row_of_group, k) = (lane / n_vr, lane % n_vr);
                    let row = row_of_group * group_count + group;
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

    /// Appends idle lanes if the warp has no room for another group.
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
    fn only_the_split_into_four_leaves_no_idle_lane_in_groups() {
        let idle_in_group = |split: KernelSplit, n_vr: usize| split.width_of(n_vr) % n_vr;
        for n_vr in 1..=8 {
            assert_eq!(idle_in_group(KernelSplit::Four, n_vr), 0, "n_vr {n_vr}");
        }
        let n_vr_with_idle_lanes =
            |split: KernelSplit| (1..=8).filter(|n_vr| idle_in_group(split, *n_vr) > 0).collect::<Vec<_>>();
        assert_eq!(n_vr_with_idle_lanes(KernelSplit::Two), [5, 7]);
        assert_eq!(n_vr_with_idle_lanes(KernelSplit::One), [3, 5, 6, 7]);
        // If w_g does not divide 32, a warp also has lanes outside of groups, which are idle: two with a w_g of 5 or 6,
        // four with 7.
        assert_eq!([1, 2, 4, 8].map(|n_vr| idle_lanes_per_warp(8, n_vr)), [0; 4]);
        assert_eq!([3, 6].map(|n_vr| idle_lanes_per_warp(6, n_vr)), [2, 2]);
        // With an n_vr of 5, a group has one row: 32 - 5 x 5, 32 - 4 x 5 and 32 - 6 x 5 idle lanes.
        assert_eq!([idle_lanes_per_warp(6, 5), idle_lanes_per_warp(8, 5), idle_lanes_per_warp(5, 5)], [7, 12, 2]);
        // 32 - 4 x 7 idle lanes with an n_vr of 7. With 3, a group of eight lanes has two rows: 32 - 4 x 2 x 3.
        assert_eq!([idle_lanes_per_warp(8, 7), idle_lanes_per_warp(7, 7), idle_lanes_per_warp(8, 3)], [4, 4, 8]);
    }

    #[test]
    fn floor_drops_rows_of_u_that_ceil_keeps() {
        // Number of rows of U in a U'' of `group_count` rows.
        let covered_rows = |rows: usize, group_count: usize, n_gg: usize| {
            (0..n_gg)
                .flat_map(|row_of_group| (0..group_count).map(move |group| row_of_group * group_count + group))
                .filter(|row| *row < rows)
                .count()
        };
        // Four vertices of rank 4 (n_vr = 1) in groups of eight: 12 rows of U fill one and a half rows of U''.
        let n_gg = rows_per_group(8, 1);
        assert_eq!(covered_rows(12, 12 / n_gg, n_gg), 8, "with floor");
        assert_eq!(covered_rows(12, 12_usize.div_ceil(n_gg), n_gg), 12, "with ceil");
        assert_eq!(reshaped_rows(12, 8, 1), 2);
        let mut dropped_cases = 0;
        for (vertices, n_vr) in (1..50).flat_map(|vertices| (1..=8).map(move |n_vr| (vertices, n_vr))) {
            for split in KernelSplit::ALL {
                let (rows, width) = (3 * vertices, split.width_of(n_vr));
                let n_gg = rows_per_group(width, n_vr);
                assert_eq!(covered_rows(rows, reshaped_rows(rows, width, n_vr), n_gg), rows);
                dropped_cases += usize::from(covered_rows(rows, rows / n_gg, n_gg) < rows);
            }
        }
        // Of 49 x 8 x 3 cases.
        assert!(dropped_cases > 100, "expected floor to drop rows in over 100 cases, got {dropped_cases}");
    }

    #[test]
    fn lane_counts_match_the_packing() {
        // Vertices, modes and triangles of each domain.
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
            "expected a smaller share of idle lanes with two kernels, got {two_kernels} and {one_kernel}"
        );
    }
}
