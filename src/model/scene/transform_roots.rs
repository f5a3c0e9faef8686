//! Transform roots and followers. A root is a domain with a transform of its own, which steps can set. A follower moves
//! with its root: a constant transform, its frame, maps coordinates of the follower to the root.

use nalgebra::{Matrix4, Vector3};

use crate::domain::{ComposedTransform, Domain, Shape, Transform};
use crate::error::{Result, invalid};

/// The transform roots of a scene, and the root and frame of every follower. [`super::SceneState::transforms`] has one
/// transform per root, in this order.
#[derive(Debug, Clone, PartialEq)]
pub struct TransformRoots {
    count: usize,
    /// Per root, the origin of the rest positions of its shape ([`Shape::origin`]). Empty if all are zero.
    pivots: Vec<[f64; 3]>,
    /// `None` if the scene has no followers; every domain is then its own root.
    table: Option<FollowTable>,
}

/// The followers of a scene, and their roots and frames.
#[derive(Debug, Clone, PartialEq, Default)]
struct FollowTable {
    /// Per root, its domain.
    domains: Vec<u32>,
    /// Per domain, the index of its root, and the index of its frame or [`TransformRoots::NO_FRAME`].
    root_and_frame_indices: Vec<[u32; 2]>,
    /// `root_from_domain` of each follower.
    frames: Vec<Transform>,
    /// Start offsets into `followers`, one per domain and one for the end. The range of a follower is empty.
    offsets: Vec<u32>,
    /// The followers of all roots, grouped by the domain of their root.
    followers: Vec<u32>,
}

impl TransformRoots {
    /// Frame index of a domain that follows no other.
    pub const NO_FRAME: u32 = u32::MAX;

    /// Flattens chains of followers to their roots, and sets each follower's placement to the root's placement times
    /// the follower's frame. The caller has checked that every parent precedes its children. Products of frames are
    /// computed in f64 and rounded once.
    ///
    /// Let p be the pivot of a root, and c the origin of the shape of its follower. The frame of the follower that
    /// deformers use maps v = x0 - c to F x0 - p, because their transform of the root acts on x0 - p.
    ///
    /// # Errors
    /// `Invalid` with the domain whose frame or placement exceeds the range of f32.
    pub(super) fn new(shapes: &[Shape], domains: &mut [Domain]) -> Result<Self> {
        if domains.iter().all(|domain| domain.follows.is_none()) {
            let pivots = non_zero(domains.iter().map(|domain| shapes[domain.shape].origin()).collect());
            return Ok(Self { count: domains.len(), pivots, table: None });
        }
        let mut table = FollowTable::default();
        // Unrounded frames, for followers of followers.
        let mut frames_f64: Vec<Matrix4<f64>> = Vec::new();
        for index in 0..domains.len() {
            let Some(constraint) = domains[index].follows else {
                table.root_and_frame_indices.push([table.domains.len() as u32, Self::NO_FRAME]);
                table.domains.push(index as u32);
                continue;
            };
            let [root, parent_frame_index] = table.root_and_frame_indices[constraint.parent];
            let (parent, domain) = (&domains[constraint.parent], &domains[index]);
            let is_centered = [parent, domain].iter().any(|domain| shapes[domain.shape].is_centered());
            let exact_frame = is_centered.then(|| exact_frame(parent, domain, constraint.frame)).flatten();
            let parent_from_domain = exact_frame.unwrap_or_else(|| constraint.frame.to_matrix());
            // A parent that is a root has no frame: `NO_FRAME` is beyond the end of `frames_f64`.
            let frame = frames_f64
                .get(parent_frame_index as usize)
                .map_or(parent_from_domain, |parent_frame| parent_frame * parent_from_domain);
            let root_domain = &domains[table.domains[root as usize] as usize];
            let (pivot, origin) = (shapes[root_domain.shape].origin(), shapes[domains[index].shape].origin());
            let rounded_frame = centered_frame(&frame, pivot, origin);
            let exact_placement = root_domain.placement_matrix() * frame;
            let uncentered_frame = Some(Transform::from_matrix(&frame));
            let placement = ComposedTransform { root: root_domain.placement, frame: uncentered_frame }.to_f32();
            for (field, transform) in [("follows.frame", rounded_frame), ("placement", placement)] {
                Transform::new(transform.0).map_err(|error| error.prefix_field(&format!("domain {index}: {field}")))?;
            }
            domains[index].set_rounded_placement(placement, &exact_placement);
            table.root_and_frame_indices.push([root, frames_f64.len() as u32]);
            table.frames.push(rounded_frame);
            frames_f64.push(frame);
        }
        table.list_followers();
        let pivot = |root: &u32| shapes[domains[*root as usize].shape].origin();
        let pivots = non_zero(table.domains.iter().map(pivot).collect());
        Ok(Self { count: table.domains.len(), pivots, table: Some(table) })
    }

    /// The pivot of each root ([`Self::pivot_of`]). Empty if all are zero.
    pub fn pivots(&self) -> &[[f64; 3]] {
        &self.pivots
    }

    /// p, the point of a root's frame that the root's transform in a state maps to its translation: the origin of the
    /// rest positions of its shape. With T = (A, t) as steps contain it, the state has (A, A p + t). `None` if p is
    /// zero.
    pub fn pivot_of(&self, root: usize) -> Option<[f64; 3]> {
        self.pivots.get(root).copied().filter(|pivot| *pivot != [0.0; 3])
    }

    /// The number of transform roots, which is the length of [`super::SceneState::transforms`].
    pub const fn count(&self) -> usize {
        self.count
    }

    /// The index in [`super::SceneState::transforms`] of a domain's root. A domain that follows no other is its own
    /// root.
    pub fn root_of(&self, domain: usize) -> usize {
        self.table.as_ref().map_or(domain, |table| table.root_and_frame_indices[domain][0] as usize)
    }

    /// `root_from_domain` of a follower; `None` for a root.
    pub fn root_from_domain(&self, domain: usize) -> Option<Transform> {
        self.table
            .as_ref()
            .and_then(|table| table.frames.get(table.root_and_frame_indices[domain][1] as usize).copied())
    }

    /// The domain of each root, in the order of [`super::SceneState::transforms`].
    pub fn domains(&self) -> impl ExactSizeIterator<Item = u32> + '_ {
        (0..self.count).map(|root| self.domain(root))
    }

    /// The domain of a root.
    pub fn domain(&self, root: usize) -> u32 {
        self.table.as_ref().map_or(root as u32, |table| table.domains[root])
    }

    /// The followers of a domain, ascending, without the domain itself. Empty for a follower.
    pub fn followers_of(&self, domain: usize) -> &[u32] {
        self.table
            .as_ref()
            .map_or(&[], |table| &table.followers[table.offsets[domain] as usize..table.offsets[domain + 1] as usize])
    }

    /// Per domain, the index of its root and the index of its frame or [`Self::NO_FRAME`]. Empty if the scene has no
    /// followers.
    pub fn root_and_frame_indices(&self) -> &[[u32; 2]] {
        self.table.as_ref().map_or(&[], |table| &table.root_and_frame_indices)
    }

    /// `root_from_domain` of every follower. Empty if the scene has no followers.
    pub fn follower_frames(&self) -> &[Transform] {
        self.table.as_ref().map_or(&[], |table| &table.frames)
    }
}

/// The list, or an empty list if all points are zero.
fn non_zero(points: Vec<[f64; 3]>) -> Vec<[f64; 3]> {
    if points.iter().all(|point| *point == [0.0; 3]) { Vec::new() } else { points }
}

/// The frame of a follower in f64 from the placements of both domains, which are exact; `None` if they do not have the
/// frame `rounded`. In coordinates of a map, f32 rounds the translation of the frame too coarsely.
fn exact_frame(parent: &Domain, domain: &Domain, rounded: Transform) -> Option<Matrix4<f64>> {
    let rounded = rounded.to_matrix();
    let exact = parent.placement_matrix().try_inverse()? * domain.placement_matrix();
    let is_rounding =
        |(exact, rounded): (&f64, &f64)| (exact - rounded).abs() <= f64::from(f32::EPSILON) * rounded.abs() + 1e-12;
    exact.iter().zip(rounded.iter()).all(is_rounding).then_some(exact)
}

/// The frame of a follower for rest positions relative to `origin`, and for a root with a pivot.
fn centered_frame(frame: &Matrix4<f64>, pivot: [f64; 3], origin: [f64; 3]) -> Transform {
    if pivot == [0.0; 3] && origin == [0.0; 3] {
        return Transform::from_matrix(frame);
    }
    let to_pivot = Matrix4::new_translation(&-Vector3::from(pivot));
    Transform::from_matrix(&(to_pivot * frame * Matrix4::new_translation(&origin.into())))
}

impl FollowTable {
    /// Groups followers by their root, ascending within a group (counting sort).
    fn list_followers(&mut self) {
        let mut offsets = vec![0_u32; self.root_and_frame_indices.len() + 1];
        let enumerate_followers = || {
            self.root_and_frame_indices.iter().enumerate().filter(|(_, [_, frame])| *frame != TransformRoots::NO_FRAME)
        };
        for (_, [root, _]) in enumerate_followers() {
            offsets[self.domains[*root as usize] as usize + 1] += 1;
        }
        for domain in 1..offsets.len() {
            offsets[domain] += offsets[domain - 1];
        }
        let mut next_offsets = offsets.clone();
        let mut grouped_followers = vec![0; self.frames.len()];
        for (domain, [root, _]) in enumerate_followers() {
            let next_offset = &mut next_offsets[self.domains[*root as usize] as usize];
            grouped_followers[*next_offset as usize] = domain as u32;
            *next_offset += 1;
        }
        (self.offsets, self.followers) = (offsets, grouped_followers);
    }
}

/// Rejects a step that sets the transform of a follower. `targets` are the domains whose transforms the step sets.
pub(super) fn check_transform_targets(
    transform_roots: &TransformRoots,
    domains: &[Domain],
    field: &str,
    targets: &[u32],
) -> Result<()> {
    if transform_roots.table.is_none() {
        return Ok(());
    }
    match targets.iter().position(|domain| domains[*domain as usize].follows.is_some()) {
        None => Ok(()),
        Some(position) => {
            let name = |domain: u32| &domains[domain as usize].name;
            let root = transform_roots.domain(transform_roots.root_of(targets[position] as usize));
            let actual =
                format!("{} ('{}'), which follows '{}'", targets[position], name(targets[position]), name(root));
            Err(invalid(format!("{field}[{position}]"), "a domain with a transform of its own", actual))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{FollowConstraint, Material, Mesh, Modes, Shape};
    use crate::scene::{Scene, SceneParts};

    fn translate_x(x: f32) -> Transform {
        let mut transform = Transform::IDENTITY;
        transform.0[3] = x;
        transform
    }

    fn point_domain(index: usize) -> Domain {
        Domain::new(format!("point {index}"), 0)
    }

    /// Five domains of one vertex. Each pair (child, parent) makes a domain a follower. The frame of the first pair is
    /// a translation by x = 1, the frame of the second by x = 2, and so on.
    fn scene_with_followers(pairs: &[(usize, usize)]) -> SceneParts {
        let mut parts = SceneParts::named("points");
        let mesh =
            Mesh::from_indexed(vec![[0.5, 0.25, 1.0]], vec![[0.0, 0.0, 1.0]], vec![], vec![[0; 3]]).expect("a point");
        parts.shapes.push(Shape::new(mesh, Modes::rigid()).expect("rigid"));
        parts.materials.push(Material::default());
        parts.domains = (0..5).map(point_domain).collect();
        for (index, (child, parent)) in pairs.iter().enumerate() {
            parts.domains[*child].follows =
                Some(FollowConstraint { parent: *parent, frame: translate_x(1.0 + index as f32) });
        }
        parts
    }

    #[test]
    fn chains_of_followers_are_flattened_to_their_root() {
        let mut parts = scene_with_followers(&[(1, 0), (2, 1), (4, 3)]);
        parts.domains[0].placement = translate_x(10.0);
        let scene = Scene::new(parts).expect("a scene");
        let transform_roots = &scene.transform_roots;
        assert_eq!((transform_roots.count(), transform_roots.domains().collect::<Vec<_>>()), (2, vec![0, 3]));
        assert_eq!([0, 1, 2, 3, 4].map(|domain| transform_roots.root_of(domain)), [0, 0, 0, 1, 1]);
        // Domain 2 follows domain 1, so its frame relative to domain 0 is 1 + 2. Domain 4 has the frame of the third
        // pair.
        let frames = [0, 1, 2, 3, 4].map(|domain| transform_roots.root_from_domain(domain));
        assert_eq!(frames, [None, Some(translate_x(1.0)), Some(translate_x(3.0)), None, Some(translate_x(3.0))]);
        assert_eq!(
            [0, 1, 2, 3, 4].map(|domain| transform_roots.followers_of(domain).to_vec()),
            [vec![1, 2], vec![], vec![], vec![4], vec![]]
        );
        assert_eq!((scene.domains[1].placement, scene.domains[2].placement), (translate_x(11.0), translate_x(13.0)));
        assert!(scene.features.followers);
    }

    #[test]
    fn frames_of_chained_followers_are_rounded_once() {
        let mut parts = scene_with_followers(&[(1, 0), (2, 1)]);
        let frame = Transform(Transform::IDENTITY.0.map(|entry| entry / 3.0));
        for child in [1, 2] {
            parts.domains[child].follows = Some(FollowConstraint { parent: child - 1, frame });
        }
        let scene = Scene::new(parts).expect("a scene");
        let expected = (f64::from(1.0_f32 / 3.0) * f64::from(1.0_f32 / 3.0)) as f32;
        assert_eq!(scene.transform_roots.root_from_domain(2).expect("a follower").0[0], expected);
    }

    #[test]
    fn scene_without_followers_has_no_table() {
        let scene = Scene::new(scene_with_followers(&[])).expect("a scene");
        assert_eq!((scene.transform_roots.table.as_ref(), scene.transform_roots.count()), (None, 5));
        assert_eq!(
            (
                scene.transform_roots.root_of(3),
                scene.transform_roots.root_from_domain(3),
                scene.transform_roots.domain(3)
            ),
            (3, None, 3)
        );
        assert!(scene.transform_roots.followers_of(3).is_empty() && !scene.features.followers);
    }

    #[test]
    fn later_parents_and_overflowing_frames_are_rejected() {
        let build_error = |child: usize, parent: usize, scale: f32| {
            let mut parts = scene_with_followers(&[(1, 0)]);
            let frame = Transform(Transform::IDENTITY.0.map(|entry| entry * scale));
            parts.domains[1].follows = Some(FollowConstraint { parent: 0, frame });
            parts.domains[child].follows = Some(FollowConstraint { parent, frame });
            Scene::new(parts).map(drop).expect_err("an invalid follower").to_string()
        };
        for (child, parent) in [(2, 2), (2, 4), (2, 9)] {
            let message = build_error(child, parent, 1.0);
            assert!(message.starts_with("domain 2: follows.parent: expected an index below 2"), "{message}");
        }
        // The frame of domain 2 relative to domain 0 has the entry 1e30^2, which overflows f32.
        assert!(
            build_error(2, 1, 1e30).starts_with("domain 2: follows.frame: transform[0]"),
            "{}",
            build_error(2, 1, 1e30)
        );
        assert!(build_error(2, 1, f32::NAN).starts_with("domain 1: follows.frame: transform[0]"));
    }

    #[test]
    fn sheared_frame_sets_the_shear_feature() {
        let scene = |frame: Transform| {
            let mut parts = scene_with_followers(&[(1, 0)]);
            parts.rigid_transforms = true;
            parts.domains[1].follows = Some(FollowConstraint { parent: 0, frame });
            Scene::new(parts).expect("a scene")
        };
        let (mut sheared, mut mirrored) = (Transform::IDENTITY, Transform::IDENTITY);
        (sheared.0[1], mirrored.0[0]) = (0.5, -1.0);
        assert!(scene(sheared).features.shear);
        assert!(!scene(mirrored).features.shear);
    }
}
