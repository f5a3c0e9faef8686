//! Builds the plants of table 4.5 with the same v, f, d, d', number of modes and u, but with arbitrary shapes.
//!
//! u counts the rows of all U, so three per vertex that carries modes, and v the render vertices; these are different
//! sets. Domains with modes have u / 3 vertices in total; their render vertices are corners, distributed evenly over
//! these. Domains without modes are leaves: small rigid meshes with one vertex per render vertex.

use fastrand::Rng;
use rayon::prelude::*;

use super::patch::{PatchSpec, PatchTopology, QUICK, scene, seed_of, shape};
use super::{Size, Workload, WorkloadKind};
use crate::thesis::{PLANTS, ThesisPlant};
use modalcast_model::domain::FollowConstraint;
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;

/// Upper limit of a leaf's render vertices and triangles; fewer where the table's totals are too small.
const LEAF: (usize, usize) = (4, 2);

/// Builds plant `index` of the thesis.
pub(super) fn build_plant(index: usize, size: Size) -> Result<Workload> {
    let printed = PLANTS[index];
    let counts = if size == Size::Quick { reduced(&printed) } else { printed };
    let patches = patches(&counts);
    let shapes = patches.par_iter().map(|patch| shape(patch, false)).collect::<Result<Vec<_>>>()?;
    let name = format!("plant-{}", index + 1);
    let scene = scene(name.clone(), shapes, counts.domains, false)?;
    Ok(Workload { species: Some(index), remarks: remarks(&printed, &counts), ..Workload::new(name, scene) })
}

/// The same plant with its leaves distributed over its branches. Each leaf follows its branch by the frame that keeps
/// it in place, so a step has transforms for the branches alone and the device multiplies.
pub(super) fn build_following_plant(index: usize, size: Size) -> Result<Workload> {
    let grown = build_plant(index, size)?;
    let branches =
        grown.scene.domains.iter().filter(|domain| grown.scene.shapes[domain.shape].modes.rank() > 0).count();
    let name = WorkloadKind::Follows(index).name();
    let mut parts = grown.scene.parts();
    parts.name.clone_from(&name);
    for leaf in branches..parts.domains.len() {
        let parent = leaf % branches;
        let own = parts.domains[leaf].placement;
        let frame = parts.domains[parent].placement.inverse().map(|parent_from_world| parent_from_world.compose(own));
        parts.domains[leaf].follows = frame.map(|frame| FollowConstraint { parent, frame });
    }
    let leaves = parts.domains.len() - branches;
    let mut remarks = grown.remarks;
    remarks.push(format!("{leaves} leaves follow {branches} branches: {} bytes of T a step", 48 * branches));
    // Not comparable with the thesis, which sends a transform for every leaf.
    Ok(Workload { name, scene: Scene::new(parts)?, species: None, remarks, ..grown })
}

/// All counts divided by [`QUICK`], but not below the minimum for the domains.
fn reduced(printed: &ThesisPlant) -> ThesisPlant {
    let cut = |number: usize, least: usize| number.div_ceil(QUICK).max(least);
    let deformable = cut(printed.deformable, 1);
    let domains = cut(printed.domains, deformable);
    ThesisPlant {
        deformable,
        domains,
        vertices: cut(printed.vertices, 4 * domains),
        faces: cut(printed.faces, 2 * domains),
        modes: cut(printed.modes, deformable),
        rows: cut(printed.rows, 9 * deformable),
        ..*printed
    }
}

/// Descriptions of the differences from the printed row.
fn remarks(printed: &ThesisPlant, counts: &ThesisPlant) -> Vec<String> {
    let mut remarks = vec![format!("{} of table 4.5", printed.name)];
    if counts != printed {
        let ThesisPlant { vertices, faces, domains, deformable, modes, rows, .. } = counts;
        remarks.push(format!(
            "quick: about 1/{QUICK} of every count: v {vertices}, f {faces}, d {domains}, d' {deformable}, r {modes}, u {rows}"
        ));
    }
    let rest = counts.rows % 3;
    if rest != 0 {
        let rounded = counts.rows.next_multiple_of(3);
        remarks.push(format!("u = {} is no multiple of 3: rounded up to {rounded}", counts.rows));
    }
    if printed.unfolded != 3 * printed.faces {
        remarks.push(format!("v' is printed as {}, three times f is {}", printed.unfolded, 3 * printed.faces));
    }
    let (vertices, faces) = leaf(counts);
    remarks.push(format!("each rigid domain is a leaf of {vertices} vertices and {faces} triangles"));
    remarks
}

/// Render vertices and triangles of one leaf: all leaves together get at most four fifths of the plant's.
fn leaf(counts: &ThesisPlant) -> (usize, usize) {
    let leaves = counts.domains - counts.deformable;
    let share = |total: usize, most: usize| (4 * total / 5).checked_div(leaves).unwrap_or(0).clamp(1, most);
    (share(counts.vertices, LEAF.0), share(counts.faces, LEAF.1))
}

fn patches(counts: &ThesisPlant) -> Vec<PatchSpec> {
    let mut rng = Rng::with_seed(seed_of(counts.name, 0));
    let (leaves, branches) = (counts.domains - counts.deformable, counts.deformable);
    let (leaf_vertices, leaf_faces) = leaf(counts);
    let mut share = |total: usize| share(total, branches, &mut rng);
    let rows = share(counts.rows.div_ceil(3));
    let ranks = share(counts.modes);
    let corners = share(counts.vertices - leaves * leaf_vertices);
    let faces = share(counts.faces - leaves * leaf_faces);
    let branch = |at: usize| PatchSpec {
        vertices: rows[at],
        rank: ranks[at],
        corners: corners[at],
        triangles: PatchTopology::Strip(faces[at]),
        size: 0.1,
        seed: seed_of(counts.name, 1 + at),
    };
    let leaf = |at: usize| PatchSpec {
        vertices: leaf_vertices,
        rank: 0,
        corners: leaf_vertices,
        triangles: PatchTopology::Strip(leaf_faces),
        size: 0.05,
        seed: seed_of(counts.name, 1 + branches + at),
    };
    (0..branches).map(branch).chain((0..leaves).map(leaf)).collect()
}

/// Splits `total` into `parts` random parts of at least 1, the largest about three times the smallest.
fn share(total: usize, parts: usize, rng: &mut Rng) -> Vec<usize> {
    let weights: Vec<f64> = (0..parts).map(|_| 0.5 + rng.f64()).collect();
    let (free, whole) = (total - parts, weights.iter().sum::<f64>());
    let (mut sum, mut before) = (0.0, 0);
    let part = |(index, weight): (usize, &f64)| {
        sum += weight;
        let until = if index + 1 == parts { free } else { (free as f64 * (sum / whole)) as usize };
        let part = 1 + until - before;
        before = until;
        part
    };
    weights.iter().enumerate().map(part).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// v, f, d, d', r and u of a scene, counted.
    fn census(load: &Workload) -> [usize; 6] {
        let layout = &load.scene.layout;
        let bent: Vec<_> = layout.domains.iter().filter(|slot| slot.rank > 0).collect();
        let rows = bent.iter().map(|slot| 3 * slot.vertices).sum();
        [layout.corners, layout.triangles, layout.domains.len(), bent.len(), layout.coordinates, rows]
    }

    #[test]
    fn plants_have_the_counts_of_table_4_5() {
        for (index, plant) in PLANTS.iter().enumerate() {
            let load = build_plant(index, Size::Full).expect("grown");
            let ThesisPlant { vertices, faces, domains, deformable, modes, rows, .. } = *plant;
            let printed = [vertices, faces, domains, deformable, modes, rows.next_multiple_of(3)];
            assert_eq!(census(&load), printed, "{}", plant.name);
            let rounded = load.remarks.iter().any(|remark| remark.contains("rounded up"));
            assert_eq!(rounded, !rows.is_multiple_of(3), "{}: every rounding is on record", plant.name);
        }
    }

    #[test]
    fn following_leaves_keep_placements_and_need_no_transforms() {
        for (index, plant) in PLANTS.iter().enumerate() {
            let (own, follows) = (build_plant(index, Size::Quick), build_following_plant(index, Size::Quick));
            let (own, follows) = (own.expect("grown"), follows.expect("grown"));
            assert_eq!(census(&own), census(&follows), "{}", plant.name);
            let [_, _, domains, branches, ..] = census(&own);
            assert_eq!((own.scene.transform_roots.count(), follows.scene.transform_roots.count()), (domains, branches));
            for (own, follows) in own.scene.domains.iter().zip(&follows.scene.domains) {
                let apart = own.placement.0.iter().zip(follows.placement.0).map(|(own, other)| (own - other).abs());
                assert!(apart.fold(0.0, f32::max) < 1e-5, "{}", own.name);
            }
            assert!(!follows.scene.features.shear && follows.species.is_none());
        }
    }

    #[test]
    fn quick_plants_are_smaller_and_have_a_remark() {
        for (index, plant) in PLANTS.iter().enumerate() {
            let load = build_plant(index, Size::Quick).expect("grown");
            assert!(census(&load).iter().all(|count| *count > 0), "{}", load.name);
            assert!(load.scene.layout.vertices <= plant.rows / 20, "{}", load.name);
            assert!(load.remarks.iter().any(|remark| remark.contains("quick")), "{:?}", load.remarks);
        }
    }

    #[test]
    fn shares_sum_to_the_total_and_are_not_empty() {
        for (total, parts) in [(7, 7), (1_000, 3), (524_640 / 3, 1_582), (5, 1)] {
            let shares = share(total, parts, &mut Rng::with_seed(1));
            assert_eq!((shares.len(), shares.iter().sum::<usize>()), (parts, total));
            assert!(shares.iter().all(|share| *share >= 1));
        }
    }
}
