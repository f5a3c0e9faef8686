//! Builds the synthetic loads.

use fastrand::Rng;
use rayon::prelude::*;

use super::patch::{PatchSpec, PatchTopology, QUICK, scene, seed_of, shape};
use super::{Size, Workload, WorkloadKind, plant};
use modalcast_model::error::Result;

/// Builds any load.
pub(super) fn build(kind: WorkloadKind, size: Size) -> Result<Workload> {
    let cut = |number: usize| if size == Size::Quick { number.div_ceil(QUICK) } else { number };
    let sheet = |vertices, rank| PatchSpec {
        vertices,
        rank,
        corners: vertices,
        triangles: PatchTopology::Cells,
        size: 1.0,
        seed: seed_of(&kind.name(), 0),
    };
    let bare = |patch: PatchSpec| PatchSpec { corners: 3, triangles: PatchTopology::One, ..patch };
    let (patches, dressed) = match kind {
        WorkloadKind::Single { power, rank } => (vec![bare(sheet(cut(1 << power), rank))], false),
        WorkloadKind::OneDomain { dressed: true } => (vec![sheet(cut(1_500_000), 32)], true),
        WorkloadKind::OneDomain { dressed: false } => (vec![bare(sheet(cut(1_500_000), 32))], false),
        WorkloadKind::Batch => (vec![bare(sheet(cut(1 << 18), 32))], false),
        WorkloadKind::Cancelling => (vec![bare(sheet(cut(1 << 16), 32))], false),
        WorkloadKind::ManyDomains => (many(kind, cut(1_000), |rng| (1_500, mixed_rank(rng))), false),
        WorkloadKind::TinyDomains => (many(kind, cut(200_000), |rng| (7, rare_rank(rng))), false),
        WorkloadKind::Plant(index) => return plant::build_plant(index, size),
        WorkloadKind::Follows(index) => return plant::build_following_plant(index, size),
    };
    let mut remarks = Vec::new();
    if size == Size::Quick {
        remarks.push(format!("quick: 1/{QUICK} of the vertices of one domain, or of the domains"));
    }
    let paired = kind == WorkloadKind::Cancelling;
    let shapes = patches.par_iter().map(|patch| shape(patch, paired)).collect::<Result<Vec<_>>>()?;
    let instances = if kind == WorkloadKind::Batch { 16 } else { shapes.len() };
    let scene = scene(kind.name(), shapes, instances, dressed)?;
    Ok(Workload { paired, remarks, ..Workload::new(kind.name(), scene) })
}

fn many(kind: WorkloadKind, count: usize, size_of: impl Fn(&mut Rng) -> (usize, usize)) -> Vec<PatchSpec> {
    let patch = |index: usize| {
        let seed = seed_of(&kind.name(), index);
        let (vertices, rank) = size_of(&mut Rng::with_seed(seed));
        PatchSpec { vertices, rank, corners: vertices, triangles: PatchTopology::Cells, size: 0.1, seed }
    };
    (0..count).map(patch).collect()
}

/// Rank 0 to 64, 17 on average: 65 x^p has the mean 65 / (p + 1), and rounding down subtracts one half.
fn mixed_rank(rng: &mut Rng) -> usize {
    (65.0 * rng.f64().powf(65.0 / 17.5 - 1.0)) as usize
}

/// Rank 0 with a probability of 95 %, else 1 to 16.
fn rare_rank(rng: &mut Rng) -> usize {
    if rng.usize(0..100) < 95 { 0 } else { rng.usize(1..=16) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn load_b_ranks_span_0_to_64_with_mean_17() {
        let patches = many(WorkloadKind::ManyDomains, 1_000, |rng| (1_500, mixed_rank(rng)));
        let ranks: Vec<usize> = patches.iter().map(|patch| patch.rank).collect();
        let mean = ranks.iter().sum::<usize>() as f64 / 1e3;
        assert!((16.0..18.0).contains(&mean), "mean {mean}");
        assert_eq!((ranks.iter().min(), ranks.iter().max()), (Some(&0), Some(&64)));
    }

    #[test]
    fn load_c_has_7_vertices_per_domain_and_95_percent_rigid() {
        let patches = many(WorkloadKind::TinyDomains, 200_000, |rng| (7, rare_rank(rng)));
        let rigid = patches.iter().filter(|patch| patch.rank == 0).count() as f64 / 2e5;
        assert!((rigid - 0.95).abs() < 0.002, "{rigid}");
        assert!(patches.iter().all(|patch| patch.vertices == 7));
    }

    #[test]
    fn only_dressed_load_a_has_normals_and_tangents() {
        let of = |kind: WorkloadKind| kind.build(Size::Quick).expect("built").scene;
        let dressed = of(WorkloadKind::OneDomain { dressed: true });
        assert!(dressed.features.normal_maps && dressed.layout.corners == 30_000 && dressed.layout.vertices == 30_000);
        assert!(dressed.layout.triangles > 59_000, "two for each cell");
        let plain = of(WorkloadKind::OneDomain { dressed: false });
        assert!(!plain.features.normal_maps && plain.layout.corners == 3 && plain.layout.vertices == 30_000);
        let single = of(WorkloadKind::Single { power: 14, rank: 20 });
        assert_eq!((single.layout.vertices, single.rank_of(0)), ((1_usize << 14).div_ceil(QUICK), 20));
    }

    #[test]
    fn full_single_loads_have_the_size_in_their_name() {
        let scene = WorkloadKind::Single { power: 14, rank: 10 }.build(Size::Full).expect("built").scene;
        assert_eq!((scene.layout.vertices, scene.rank_of(0)), (1 << 14, 10));
    }

    #[test]
    fn batch_has_16_domains_and_one_shape() {
        let scene = WorkloadKind::Batch.build(Size::Quick).expect("built").scene;
        assert_eq!((scene.domains.len(), scene.shapes.len(), scene.layout.coordinates), (16, 1, 16 * 32));
    }
}
