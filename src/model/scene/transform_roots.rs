//! Transform roots (domains with a transform of their own in each step) and followers (domains that move with a root by
//! a constant frame).

use nalgebra::Matrix4;

use crate::domain::{ComposedTransform, Domain, Transform};
use crate::error::{Result, invalid};

/// The transform roots of a scene, and the root and frame of every follower. [`super::SceneState::transforms`] has one
/// transform per root, in this order.
#[derive(Debug, Clone, PartialEq)]
pub struct TransformRoots {
    count: usize,
    /// `None` if the scene has no followers; every domain is then its own root.
    table: Option<FollowTable>,
}

#[derive(Debug, Clone, PartialEq, Default)]
struct FollowTable {
    /// Per root, its domain.
    domains: Vec<u32>,
    /// Per domain, the index of its root, and the index of its frame or [`TransformRoots::NO_FRAME`].
    following: Vec<[u32; 2]>,
    /// `root_from_domain` of each follower.
    frames: Vec<Transform>,
    /// Start offsets into `followers`, one per domain and one for the end. The range of a follower is empty.
    offsets: Vec<u32>,
    followers: Vec<u32>,
}

impl TransformRoots {
    /// Frame index of a domain that follows no other.
    pub const NO_FRAME: u32 = u32::MAX;

    /// Flattens chains of followers to their roots, and sets the placement of each follower accordingly. The domains
    /// are validated, and parents precede their children. Products of frames are computed in f64 and rounded once.
    ///
    /// # Errors
    /// `Invalid` with the domain whose frame or placement exceeds the range of f32.
    pub(super) fn new(domains: &mut [Domain]) -> Result<Self> {
        if domains.iter().all(|domain| domain.follows.is_none()) {
            return Ok(Self { count: domains.len(), table: None });
        }
        let mut table = FollowTable::default();
        // Has entries for followers only, so that many independent domains need no memory here.
        let mut exact: Vec<Matrix4<f64>> = Vec::new();
        for index in 0..domains.len() {
            let Some(follow) = domains[index].follows else {
                table.following.push([table.domains.len() as u32, Self::NO_FRAME]);
                table.domains.push(index as u32);
                continue;
            };
            let [root, above] = table.following[follow.parent];
            let frame = follow.frame.to_matrix();
            let frame = exact.get(above as usize).map_or(frame, |above| above * frame);
            let to_f32 = Transform::from_matrix(&frame);
            let placement = domains[table.domains[root as usize] as usize].placement;
            let placement = ComposedTransform { root: placement, frame: Some(to_f32) }.to_f32();
            for (field, transform) in [("follows.frame", to_f32), ("placement", placement)] {
                Transform::new(transform.0).map_err(|error| error.prefix_field(&format!("domain {index}: {field}")))?;
            }
            domains[index].placement = placement;
            table.following.push([root, exact.len() as u32]);
            table.frames.push(to_f32);
            exact.push(frame);
        }
        table.list_followers();
        Ok(Self { count: table.domains.len(), table: Some(table) })
    }

    /// The number of transform roots, which is the length of [`super::SceneState::transforms`].
    pub const fn count(&self) -> usize {
        self.count
    }

    /// The index in [`super::SceneState::transforms`] of the transform of a domain's root. A domain that follows no other is
    /// its own root.
    pub fn root_of(&self, domain: usize) -> usize {
        self.table.as_ref().map_or(domain, |table| table.following[domain][0] as usize)
    }

    /// `root_from_domain` of a follower; `None` for a root.
    pub fn frame_of(&self, domain: usize) -> Option<Transform> {
        self.table.as_ref().and_then(|table| table.frames.get(table.following[domain][1] as usize).copied())
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
    pub fn following(&self) -> &[[u32; 2]] {
        self.table.as_ref().map_or(&[], |table| &table.following)
    }

    /// `root_from_domain` of every follower. Empty if the scene has no followers.
    pub fn frames(&self) -> &[Transform] {
        self.table.as_ref().map_or(&[], |table| &table.frames)
    }
}

impl FollowTable {
    /// Groups followers by their root, ascending within a group (counting sort).
    fn list_followers(&mut self) {
        let mut offsets = vec![0_u32; self.following.len() + 1];
        let followers =
            || self.following.iter().enumerate().filter(|(_, [_, frame])| *frame != TransformRoots::NO_FRAME);
        for (_, [root, _]) in followers() {
            offsets[self.domains[*root as usize] as usize + 1] += 1;
        }
        for at in 1..offsets.len() {
            offsets[at] += offsets[at - 1];
        }
        let mut next = offsets.clone();
        let mut list = vec![0; self.frames.len()];
        for (index, [root, _]) in followers() {
            let place = &mut next[self.domains[*root as usize] as usize];
            list[*place as usize] = index as u32;
            *place += 1;
        }
        (self.offsets, self.followers) = (offsets, list);
    }
}

/// Rejects a step that sets the transform of a follower.
pub(super) fn check_transform_targets(
    transform_roots: &TransformRoots,
    domains: &[Domain],
    (field, list): (&str, &[u32]),
) -> Result<()> {
    if transform_roots.table.is_none() {
        return Ok(());
    }
    match list.iter().position(|domain| domains[*domain as usize].follows.is_some()) {
        None => Ok(()),
        Some(at) => {
            let name = |domain: u32| &domains[domain as usize].name;
            let root = transform_roots.domain(transform_roots.root_of(list[at] as usize));
            let given = format!("{} ('{}'), which follows '{}'", list[at], name(list[at]), name(root));
            Err(invalid(format!("{field}[{at}]"), "a domain with a transform of its own", given))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{FollowConstraint, Material, Mesh, Metadata, Modes, Shape};
    use crate::scene::{Scene, SceneParts};

    fn moved(x: f32) -> Transform {
        let mut transform = Transform::IDENTITY;
        transform.0[3] = x;
        transform
    }

    fn point(at: usize) -> Domain {
        Domain {
            name: format!("point {at}"),
            shape: 0,
            material: 0,
            material_ranges: vec![],
            placement: Transform::IDENTITY,
            attachment: None,
            follows: None,
            rest_q: vec![],
            shares_q_with: None,
            metadata: Metadata::default(),
        }
    }

    /// Five domains of one vertex. Each pair (child, parent) adds a follower with a frame at x = 1, 2, 3, ...
    fn following(pairs: &[(usize, usize)]) -> SceneParts {
        let mut parts = SceneParts::named("points");
        let mesh =
            Mesh::from_indexed(vec![[0.5, 0.25, 1.0]], vec![[0.0, 0.0, 1.0]], vec![], vec![[0; 3]]).expect("a point");
        parts.shapes.push(Shape::new(mesh, Modes::rigid()).expect("rigid"));
        parts.materials.push(Material::default());
        parts.domains = (0..5).map(point).collect();
        for (at, (child, parent)) in pairs.iter().enumerate() {
            parts.domains[*child].follows = Some(FollowConstraint { parent: *parent, frame: moved(1.0 + at as f32) });
        }
        parts
    }

    #[test]
    fn chains_are_flattened_to_their_mover_and_placements_follow() {
        let mut parts = following(&[(1, 0), (2, 1), (4, 3)]);
        parts.domains[0].placement = moved(10.0);
        let scene = Scene::new(parts).expect("a scene");
        let transform_roots = &scene.transform_roots;
        assert_eq!((transform_roots.count(), transform_roots.domains().collect::<Vec<_>>()), (2, vec![0, 3]));
        assert_eq!([0, 1, 2, 3, 4].map(|domain| transform_roots.root_of(domain)), [0, 0, 0, 1, 1]);
        let frames = [0, 1, 2, 3, 4].map(|domain| transform_roots.frame_of(domain));
        assert_eq!(frames, [None, Some(moved(1.0)), Some(moved(3.0)), None, Some(moved(3.0))]);
        assert_eq!(
            [0, 1, 2, 3, 4].map(|domain| transform_roots.followers_of(domain).to_vec()),
            [vec![1, 2], vec![], vec![], vec![4], vec![]]
        );
        assert_eq!((scene.domains[1].placement, scene.domains[2].placement), (moved(11.0), moved(13.0)));
        assert!(scene.features.followers);
    }

    #[test]
    fn frames_of_frames_are_rounded_once() {
        let mut parts = following(&[(1, 0), (2, 1)]);
        let third = Transform(Transform::IDENTITY.0.map(|entry| entry / 3.0));
        for child in [1, 2] {
            parts.domains[child].follows = Some(FollowConstraint { parent: child - 1, frame: third });
        }
        let scene = Scene::new(parts).expect("a scene");
        let once = (f64::from(1.0_f32 / 3.0) * f64::from(1.0_f32 / 3.0)) as f32;
        assert_eq!(scene.transform_roots.frame_of(2).expect("follows").0[0], once);
    }

    #[test]
    fn where_nobody_follows_there_is_no_table() {
        let scene = Scene::new(following(&[])).expect("a scene");
        assert_eq!((scene.transform_roots.table.as_ref(), scene.transform_roots.count()), (None, 5));
        assert_eq!(
            (scene.transform_roots.root_of(3), scene.transform_roots.frame_of(3), scene.transform_roots.domain(3)),
            (3, None, 3)
        );
        assert!(scene.transform_roots.followers_of(3).is_empty() && !scene.features.followers);
    }

    #[test]
    fn later_parents_and_frames_that_leave_f32_are_refused_by_name() {
        let with = |child: usize, parent: usize, scale: f32| {
            let mut parts = following(&[(1, 0)]);
            let frame = Transform(Transform::IDENTITY.0.map(|entry| entry * scale));
            parts.domains[1].follows = Some(FollowConstraint { parent: 0, frame });
            parts.domains[child].follows = Some(FollowConstraint { parent, frame });
            Scene::new(parts).map(drop).expect_err("refused").to_string()
        };
        for (child, parent) in [(2, 2), (2, 4), (2, 9)] {
            let refusal = with(child, parent, 1.0);
            assert!(refusal.starts_with("domain 2: follows.parent: expected an index below 2"), "{refusal}");
        }
        assert!(with(2, 1, 1e30).starts_with("domain 2: follows.frame: transform[0]"), "{}", with(2, 1, 1e30));
        assert!(with(2, 1, f32::NAN).starts_with("domain 1: follows.frame: transform[0]"));
    }

    #[test]
    fn a_sheared_frame_makes_the_scene_need_the_inverse_transpose() {
        let scene = |frame: Transform| {
            let mut parts = following(&[(1, 0)]);
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
