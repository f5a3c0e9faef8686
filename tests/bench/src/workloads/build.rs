//! Builds the synthetic workloads.

use fastrand::Rng;
use rayon::prelude::*;

use super::patch::{PatchSpec, PatchTopology, QUICK_DIVISOR, build_patch_scene, build_shape, part_seed};
use super::{Size, Workload, WorkloadKind, plant};
use modalcast_model::error::Result;

/// Builds a workload of any kind. Plants are built in [`plant`].
pub(super) fn build(kind: WorkloadKind, size: Size) -> Result<Workload> {
    let reduce_if_quick = |number: usize| if size == Size::Quick { number.div_ceil(QUICK_DIVISOR) } else { number };
    // The patch of a workload with one shape. It has one corner per vertex.
    let sheet_patch = |vertices, rank| PatchSpec {
        vertices,
        rank,
        corners: vertices,
        triangles: PatchTopology::Cells,
        size: 1.0,
        seed: part_seed(&kind.name(), 0),
    };
    // A workload that measures only positions has one triangle, because a mesh needs at least one.
    let with_one_triangle =
        |patch: PatchSpec| PatchSpec { corners: 3, triangles: PatchTopology::SingleTriangle, ..patch };
    let (patches, has_normal_map) = match kind {
        WorkloadKind::Single { power, rank } => {
            (vec![with_one_triangle(sheet_patch(reduce_if_quick(1 << power), rank))], false)
        }
        WorkloadKind::OneDomain { has_normal_map: true } => (vec![sheet_patch(reduce_if_quick(1_500_000), 32)], true),
        WorkloadKind::OneDomain { has_normal_map: false } => {
            (vec![with_one_triangle(sheet_patch(reduce_if_quick(1_500_000), 32))], false)
        }
        WorkloadKind::Batch => (vec![with_one_triangle(sheet_patch(reduce_if_quick(1 << 18), 32))], false),
        WorkloadKind::Cancelling => (vec![with_one_triangle(sheet_patch(reduce_if_quick(1 << 16), 32))], false),
        WorkloadKind::ManyDomains => {
            (random_patches(kind, reduce_if_quick(1_000), |rng| (1_500, mixed_rank(rng))), false)
        }
        WorkloadKind::TinyDomains => {
            (random_patches(kind, reduce_if_quick(200_000), |rng| (7, mostly_rigid_rank(rng))), false)
        }
        WorkloadKind::Plant(index) => return plant::build_plant(index, size),
        WorkloadKind::FollowingPlant(index) => return plant::build_following_plant(index, size),
    };
    let mut remarks = Vec::new();
    if size == Size::Quick {
        remarks
            .push(format!("quick: 1/{QUICK_DIVISOR} of the vertices (one domain) or of the domains (several domains)"));
    }
    let has_cancelling_mode_pairs = kind == WorkloadKind::Cancelling;
    let shapes =
        patches.par_iter().map(|patch| build_shape(patch, has_cancelling_mode_pairs)).collect::<Result<Vec<_>>>()?;
    let domains = if kind == WorkloadKind::Batch { 16 } else { shapes.len() };
    let scene = build_patch_scene(kind.name(), shapes, domains, has_normal_map)?;
    Ok(Workload { has_cancelling_mode_pairs, remarks, ..Workload::new(kind.name(), scene) })
}

/// `count` patches. `random_size` returns the number of vertices and the rank of a patch.
fn random_patches(
    kind: WorkloadKind,
    count: usize,
    random_size: impl Fn(&mut Rng) -> (usize, usize),
) -> Vec<PatchSpec> {
    let patch = |index: usize| {
        let seed = part_seed(&kind.name(), index);
        let (vertices, rank) = random_size(&mut Rng::with_seed(seed));
        PatchSpec { vertices, rank, corners: vertices, triangles: PatchTopology::Cells, size: 0.1, seed }
    };
    (0..count).map(patch).collect()
}

/// Rank 0 to 64, 17 on average. With x uniform in [0, 1), 65 x^p has the mean 65 / (p + 1), here 17.5, and rounding
/// down subtracts one half on average.
fn mixed_rank(rng: &mut Rng) -> usize {
    (65.0 * rng.f64().powf(65.0 / 17.5 - 1.0)) as usize
}

/// Rank 0 with a probability of 95 %, else 1 to 16.
fn mostly_rigid_rank(rng: &mut Rng) -> usize {
    if rng.usize(0..100) < 95 { 0 } else { rng.usize(1..=16) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn workload_b_ranks_span_0_to_64_with_mean_17() {
        let patches = random_patches(WorkloadKind::ManyDomains, 1_000, |rng| (1_500, mixed_rank(rng)));
        let ranks: Vec<usize> = patches.iter().map(|patch| patch.rank).collect();
        let mean = ranks.iter().sum::<usize>() as f64 / 1e3;
        assert!((16.0..18.0).contains(&mean), "mean {mean}");
        assert_eq!((ranks.iter().min(), ranks.iter().max()), (Some(&0), Some(&64)));
    }

    #[test]
    fn workload_c_has_7_vertices_per_domain_and_95_percent_rigid() {
        let patches = random_patches(WorkloadKind::TinyDomains, 200_000, |rng| (7, mostly_rigid_rank(rng)));
        let rigid_fraction = patches.iter().filter(|patch| patch.rank == 0).count() as f64 / 2e5;
        assert!((rigid_fraction - 0.95).abs() < 0.002, "{rigid_fraction}");
        assert!(patches.iter().all(|patch| patch.vertices == 7));
    }

    #[test]
    fn workload_a_has_tangents_and_a_positions_has_none() {
        let build_scene = |kind: WorkloadKind| kind.build(Size::Quick).expect("a workload").scene;
        let scene = build_scene(WorkloadKind::OneDomain { has_normal_map: true });
        // 1.5 M vertices divided by QUICK_DIVISOR.
        assert!(scene.features.normal_maps && scene.layout.corners == 30_000 && scene.layout.vertices == 30_000);
        assert!(scene.layout.triangles > 59_000, "expected two triangles per cell, got {}", scene.layout.triangles);
        let positions_only = build_scene(WorkloadKind::OneDomain { has_normal_map: false });
        assert!(!positions_only.features.normal_maps);
        assert_eq!((positions_only.layout.corners, positions_only.layout.vertices), (3, 30_000));
        let single_domain = build_scene(WorkloadKind::Single { power: 14, rank: 20 });
        assert_eq!(
            (single_domain.layout.vertices, single_domain.rank_of(0)),
            ((1_usize << 14).div_ceil(QUICK_DIVISOR), 20)
        );
    }

    #[test]
    fn full_single_workloads_have_the_size_in_their_name() {
        let scene = WorkloadKind::Single { power: 14, rank: 10 }.build(Size::Full).expect("a workload").scene;
        assert_eq!((scene.layout.vertices, scene.rank_of(0)), (1 << 14, 10));
    }

    #[test]
    fn batch_has_16_domains_and_one_shape() {
        let scene = WorkloadKind::Batch.build(Size::Quick).expect("a workload").scene;
        assert_eq!((scene.domains.len(), scene.shapes.len(), scene.layout.coordinates), (16, 1, 16 * 32));
    }
}
