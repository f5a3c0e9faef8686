//! Worlds: copies of a scene, each with its own coordinates and transforms.

use std::sync::Arc;

use super::{MAX_DOMAINS, RenderSettings, Scene, SceneParts};
use crate::domain::{Domain, FollowConstraint, Metadata};
use crate::error::{Result, invalid};

impl Scene {
    /// One scene that consists of `count` worlds. Domain d of world w has the index w D + d in a scene of D domains, and
    /// vertices, corners, coordinates and transforms of the worlds follow one another. All worlds share the shapes. What
    /// only clients need is missing: attachments and metadata. So are shadows, because worlds would cast them on each
    /// other.
    ///
    /// # Errors
    /// `Invalid` with the field `worlds` if there are too many domains, or if a domain is so far away that the rest
    /// state needs floating origins; `Invalid` with the field `scene.size` if there are too many vertices.
    pub fn worlds(&self, count: usize) -> Result<Arc<Self>> {
        let max_count = MAX_DOMAINS / self.domains.len();
        if !(1..=max_count).contains(&count) {
            let expected = format!("1 to {max_count} worlds of {} domains", self.domains.len());
            return Err(invalid("worlds", expected, count));
        }
        if self.is_far {
            let expected = "a scene whose domains are near its origin";
            return Err(invalid("worlds", expected, "domains that are too far away for f32"));
        }
        let domain_count = self.domains.len();
        let domains = (0..count)
            .flat_map(|world| self.domains.iter().map(move |domain| domain_of_world(domain, world * domain_count)));
        Self::new(SceneParts {
            domains: domains.collect(),
            look: RenderSettings { shadow: None, ambient_occlusion: None, ..self.look },
            remarks: vec![],
            ..self.parts()
        })
    }
}

/// A domain whose references are to domains from `first_domain` on.
fn domain_of_world(domain: &Domain, first_domain: usize) -> Domain {
    let follow =
        |constraint: FollowConstraint| FollowConstraint { parent: constraint.parent + first_domain, ..constraint };
    Domain {
        follows: domain.follows.map(follow),
        shares_q_with: domain.shares_q_with.map(|other| other + first_domain),
        attachment: None,
        metadata: Metadata::default(),
        ..domain.clone()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Material, Mesh, Modes, Shape, Transform};
    use crate::scene::{RawStepUpdate, SceneState, StepUpdate};

    /// A root, a follower that shares the root's coordinate, and another root.
    fn scene() -> Arc<Scene> {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 3], vec![], vec![[0, 1, 2]]);
        let modes = Modes::from_columns(9, 1, vec![0.5; 9]).expect("modes");
        let shape = Shape::new(mesh.expect("a triangle"), modes).expect("a shape");
        let frame = Transform([1.0, 0.0, 0.0, 2.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        let follower = Domain {
            follows: Some(FollowConstraint { parent: 0, frame }),
            shares_q_with: Some(0),
            ..Domain::new("follower", 0)
        };
        Scene::new(SceneParts {
            shapes: vec![shape],
            materials: vec![Material::default()],
            domains: vec![Domain::new("root", 0), follower, Domain::new("other", 0)],
            ..SceneParts::named("three")
        })
        .expect("a scene")
    }

    #[test]
    fn worlds_follow_one_another_and_refer_to_themselves() {
        let (scene, count) = (scene(), 3);
        let worlds = scene.worlds(count).expect("worlds");
        assert_eq!(worlds.domains.len(), 3 * count);
        assert_eq!((worlds.layout.vertices, worlds.layout.coordinates), (9 * count, 2 * count));
        assert_eq!(worlds.transform_roots.domains().collect::<Vec<_>>(), [0, 2, 3, 5, 6, 8]);
        assert_eq!(worlds.layout.domains[4].first_q, 2, "expected the follower to share q with its own world");
        assert_eq!(worlds.transform_roots.followers_of(3), [4]);
        // A step of the second world.
        let mut state = SceneState::rest(&worlds);
        let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&[0.25f32]));
        let update = RawStepUpdate { number: 1, q_domains: vec![3], q, ..RawStepUpdate::default() };
        state.apply(&worlds, &StepUpdate::parse(&worlds, &update).expect("a step"));
        assert_eq!(state.q, [0.0, 0.0, 0.25, 0.0, 0.0, 0.0]);
    }

    #[test]
    fn numbers_of_worlds_out_of_range_are_rejected() {
        for count in [0, MAX_DOMAINS / 3 + 1] {
            let error = scene().worlds(count).expect_err("an invalid number").to_string();
            assert!(error.starts_with("worlds: expected 1 to 349525"), "{error}");
        }
    }
}
