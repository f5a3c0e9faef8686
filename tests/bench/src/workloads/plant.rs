//! Builds the plants of table 4.5 with arbitrary shapes. The counts are those of the table: v, f (triangles), d
//! (domains), d' (domains with modes), number of modes, and u.
//!
//! u counts the rows of all U: three per vertex with modes. v counts the render vertices, which are a different set.
//! Domains with modes are branches. They have u / 3 vertices in total; their render vertices are corners that are
//! distributed evenly over these vertices. Domains without modes are leaves: small rigid meshes with one vertex per
//! render vertex.

use fastrand::Rng;
use rayon::prelude::*;

use super::patch::{PatchSpec, PatchTopology, QUICK_DIVISOR, build_patch_scene, build_shape, part_seed};
use super::{Size, Workload, WorkloadKind};
use crate::thesis::{PLANTS, ThesisPlant};
use modalcast_model::domain::FollowConstraint;
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;

/// Maximum number of render vertices of a leaf. A leaf has fewer if the plant's total is too small.
const MAX_LEAF_VERTICES: usize = 4;
/// Maximum number of triangles of a leaf. A leaf has fewer if the plant's total is too small.
const MAX_LEAF_TRIANGLES: usize = 2;

/// Builds plant `index` of the thesis.
pub(super) fn build_plant(index: usize, size: Size) -> Result<Workload> {
    let table_row = PLANTS[index];
    let counts = if size == Size::Quick { reduce_counts(&table_row) } else { table_row };
    let patches = random_patches(&counts);
    let shapes = patches.par_iter().map(|patch| build_shape(patch, false)).collect::<Result<Vec<_>>>()?;
    let name = format!("plant-{}", index + 1);
    let scene = build_patch_scene(name.clone(), shapes, counts.domains, false)?;
    Ok(Workload {
        thesis_plant: Some(index),
        remarks: describe_counts(&table_row, &counts),
        ..Workload::new(name, scene)
    })
}

/// The same plant with its leaves distributed over its branches. Each leaf follows a branch and keeps its placement at
/// rest. A step then has transforms for branches only, and the device computes those of the leaves.
pub(super) fn build_following_plant(index: usize, size: Size) -> Result<Workload> {
    let workload = build_plant(index, size)?;
    let branch_count =
        workload.scene.domains.iter().filter(|domain| workload.scene.shapes[domain.shape].modes.rank() > 0).count();
    let name = WorkloadKind::FollowingPlant(index).name();
    let mut parts = workload.scene.parts();
    parts.name.clone_from(&name);
    for leaf in branch_count..parts.domains.len() {
        let parent = leaf % branch_count;
        let placement = parts.domains[leaf].placement;
        let frame =
            parts.domains[parent].placement.inverse().map(|parent_from_world| parent_from_world.compose(placement));
        parts.domains[leaf].follows = frame.map(|frame| FollowConstraint { parent, frame });
    }
    let leaf_count = parts.domains.len() - branch_count;
    let mut remarks = workload.remarks;
    remarks
        .push(format!("{leaf_count} leaves follow {branch_count} branches: {} bytes of T per step", 48 * branch_count));
    // Not comparable with the thesis, which sends a transform for every leaf.
    Ok(Workload { name, scene: Scene::new(parts)?, thesis_plant: None, remarks, ..workload })
}

/// All counts divided by [`QUICK_DIVISOR`], but not below the minimum that the domains need.
fn reduce_counts(table_row: &ThesisPlant) -> ThesisPlant {
    let reduce = |number: usize, minimum: usize| number.div_ceil(QUICK_DIVISOR).max(minimum);
    let deformable = reduce(table_row.deformable, 1);
    let domains = reduce(table_row.domains, deformable);
    ThesisPlant {
        deformable,
        domains,
        vertices: reduce(table_row.vertices, MAX_LEAF_VERTICES * domains),
        faces: reduce(table_row.faces, MAX_LEAF_TRIANGLES * domains),
        modes: reduce(table_row.modes, deformable),
        // Three vertices per branch, with three rows each.
        rows: reduce(table_row.rows, 9 * deformable),
        ..*table_row
    }
}

/// Describes the plant and its differences from its row in the table.
fn describe_counts(table_row: &ThesisPlant, counts: &ThesisPlant) -> Vec<String> {
    let mut remarks = vec![format!("{} of table 4.5", table_row.name)];
    if counts != table_row {
        let ThesisPlant { vertices, faces, domains, deformable, modes, rows, .. } = counts;
        remarks.push(format!(
            "quick: about 1/{QUICK_DIVISOR} of every count: v {vertices}, f {faces}, d {domains}, d' {deformable}, r {modes}, u {rows}"
        ));
    }
    let remainder = counts.rows % 3;
    if remainder != 0 {
        let rounded_rows = counts.rows.next_multiple_of(3);
        remarks.push(format!("u = {} is no multiple of 3: rounded up to {rounded_rows}", counts.rows));
    }
    if table_row.unfolded != 3 * table_row.faces {
        remarks.push(format!("v' is printed as {}, three times f is {}", table_row.unfolded, 3 * table_row.faces));
    }
    let (vertices, faces) = leaf_size(counts);
    remarks.push(format!("each rigid domain is a leaf of {vertices} vertices and {faces} triangles"));
    remarks
}

/// Numbers of render vertices and triangles of one leaf. All leaves together have at most four fifths of those of the
/// plant, unless a leaf would then have none.
fn leaf_size(counts: &ThesisPlant) -> (usize, usize) {
    let leaves = counts.domains - counts.deformable;
    let leaf_share = |total: usize, maximum: usize| (4 * total / 5).checked_div(leaves).unwrap_or(0).clamp(1, maximum);
    (leaf_share(counts.vertices, MAX_LEAF_VERTICES), leaf_share(counts.faces, MAX_LEAF_TRIANGLES))
}

/// Patches of all branches, followed by those of all leaves.
fn random_patches(counts: &ThesisPlant) -> Vec<PatchSpec> {
    let mut rng = Rng::with_seed(part_seed(counts.name, 0));
    let (leaves, branches) = (counts.domains - counts.deformable, counts.deformable);
    let (leaf_vertices, leaf_faces) = leaf_size(counts);
    let mut split = |total: usize| split_randomly(total, branches, &mut rng);
    let branch_vertices = split(counts.rows.div_ceil(3));
    let branch_ranks = split(counts.modes);
    let branch_corners = split(counts.vertices - leaves * leaf_vertices);
    let branch_faces = split(counts.faces - leaves * leaf_faces);
    let branch_patch = |index: usize| PatchSpec {
        vertices: branch_vertices[index],
        rank: branch_ranks[index],
        corners: branch_corners[index],
        triangles: PatchTopology::Strip(branch_faces[index]),
        size: 0.1,
        seed: part_seed(counts.name, 1 + index),
    };
    let leaf_patch = |index: usize| PatchSpec {
        vertices: leaf_vertices,
        rank: 0,
        corners: leaf_vertices,
        triangles: PatchTopology::Strip(leaf_faces),
        size: 0.05,
        seed: part_seed(counts.name, 1 + branches + index),
    };
    (0..branches).map(branch_patch).chain((0..leaves).map(leaf_patch)).collect()
}

/// Splits `total` into `part_count` random parts of at least 1. The largest part is about three times the smallest.
fn split_randomly(total: usize, part_count: usize, rng: &mut Rng) -> Vec<usize> {
    let weights: Vec<f64> = (0..part_count).map(|_| 0.5 + rng.f64()).collect();
    // Each part has at least 1; the remaining total is split by the weights.
    let (remaining_total, weight_sum) = (total - part_count, weights.iter().sum::<f64>());
    let (mut partial_weight, mut previous_end) = (0.0, 0);
    let next_part = |(index, weight): (usize, &f64)| {
        partial_weight += weight;
        let end = if index + 1 == part_count {
            remaining_total
        } else {
            (remaining_total as f64 * (partial_weight / weight_sum)) as usize
        };
        let part = 1 + end - previous_end;
        previous_end = end;
        part
    };
    weights.iter().enumerate().map(next_part).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Counts v, f, d, d', r and u of a scene.
    fn count_contents(workload: &Workload) -> [usize; 6] {
        let layout = &workload.scene.layout;
        let deformable_layouts: Vec<_> = layout.domains.iter().filter(|domain_layout| domain_layout.rank > 0).collect();
        let rows = deformable_layouts.iter().map(|domain_layout| 3 * domain_layout.vertices).sum();
        [layout.corners, layout.triangles, layout.domains.len(), deformable_layouts.len(), layout.coordinates, rows]
    }

    #[test]
    fn plants_have_the_counts_of_table_4_5() {
        for (index, plant) in PLANTS.iter().enumerate() {
            let workload = build_plant(index, Size::Full).expect("a plant");
            let ThesisPlant { vertices, faces, domains, deformable, modes, rows, .. } = *plant;
            let expected_counts = [vertices, faces, domains, deformable, modes, rows.next_multiple_of(3)];
            assert_eq!(count_contents(&workload), expected_counts, "{}", plant.name);
            let has_rounding_remark = workload.remarks.iter().any(|remark| remark.contains("rounded up"));
            assert_eq!(
                has_rounding_remark,
                !rows.is_multiple_of(3),
                "{}: expected a remark if and only if u is rounded",
                plant.name
            );
        }
    }

    #[test]
    fn following_leaves_keep_placements_and_need_no_transforms() {
        for (index, plant) in PLANTS.iter().enumerate() {
            let independent = build_plant(index, Size::Quick).expect("a plant");
            let following = build_following_plant(index, Size::Quick).expect("a plant");
            assert_eq!(count_contents(&independent), count_contents(&following), "{}", plant.name);
            let [_, _, domains, branches, ..] = count_contents(&independent);
            let root_counts = [&independent, &following].map(|workload| workload.scene.transform_roots.count());
            assert_eq!(root_counts, [domains, branches]);
            for (domain, follower) in independent.scene.domains.iter().zip(&following.scene.domains) {
                let differences =
                    domain.placement.0.iter().zip(follower.placement.0).map(|(entry, other)| (entry - other).abs());
                assert!(differences.fold(0.0, f32::max) < 1e-5, "{}", domain.name);
            }
            assert!(!following.scene.features.shear && following.thesis_plant.is_none());
        }
    }

    #[test]
    fn quick_plants_are_smaller_and_have_a_remark() {
        for (index, plant) in PLANTS.iter().enumerate() {
            let workload = build_plant(index, Size::Quick).expect("a plant");
            assert!(count_contents(&workload).iter().all(|count| *count > 0), "{}", workload.name);
            // The branches of a full plant have rows / 3 vertices. The limit is less than a sixth of this number.
            assert!(workload.scene.layout.vertices <= plant.rows / 20, "{}", workload.name);
            assert!(workload.remarks.iter().any(|remark| remark.contains("quick")), "{:?}", workload.remarks);
        }
    }

    #[test]
    fn random_parts_sum_to_the_total_and_are_not_empty() {
        for (total, part_count) in [(7, 7), (1_000, 3), (524_640 / 3, 1_582), (5, 1)] {
            let parts = split_randomly(total, part_count, &mut Rng::with_seed(1));
            assert_eq!((parts.len(), parts.iter().sum::<usize>()), (part_count, total));
            assert!(parts.iter().all(|part| *part >= 1));
        }
    }
}
