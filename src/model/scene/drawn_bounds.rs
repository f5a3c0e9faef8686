//! Bounds of the drawn vertices of each domain, computed on the host from a few numbers per shape. Drawn vertices are
//! those that triangles use.
//!
//! A deformer bounds all vertices that it computes. A vertex that no triangle uses can widen these bounds, and so the
//! shadow map. [`DrawnBounds::clip`] removes that part. The bounds also tell which domains a camera sees
//! ([`super::Framing`]).

use std::sync::OnceLock;

use nalgebra::{Matrix4, Vector3};

use super::far_domains::{drawn_bounds, transform_bounds};
use super::{BoundingBox, OrientedBounds, Scene, SceneState};
use crate::domain::Shape;

/// An undrawn vertex widens the bounds if it is outside of the bounds of the drawn ones by more than this fraction of
/// their diagonal.
const WIDENING_TOLERANCE: f64 = 1e-3;

/// Margin for the f32 rounding of positions, relative to the largest coordinate of the bounds.
const ROUNDING_MARGIN: f64 = 1e-6;

/// The bounds of a deformed state, relative to the origin of its positions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameBounds {
    pub world: BoundingBox,
    /// Along the axes of light space. `None` if no shadow map is fitted to the vertices.
    pub light: Option<OrientedBounds>,
}

/// The bounds of the drawn vertices of all shapes of a scene, relative to the origins of the shapes.
#[derive(Debug)]
pub struct DrawnBounds {
    shapes: Vec<ShapeBounds>,
    /// Whether a vertex that no triangle uses widens the bounds of a shape.
    has_outside_vertices: bool,
}

#[derive(Debug)]
struct ShapeBounds {
    rest: BoundingBox,
    /// Per mode and axis, the largest magnitude in U of the drawn vertices. Computed on first use, because it needs a
    /// pass over U.
    mode_reach: OnceLock<Vec<[f64; 3]>>,
}

impl DrawnBounds {
    pub(super) fn new(shapes: &[Shape]) -> Self {
        let bounds =
            |shape: &Shape| ShapeBounds { rest: drawn_bounds(&shape.mesh, [0.0; 3]), mode_reach: OnceLock::new() };
        let bounds: Vec<ShapeBounds> = shapes.iter().map(bounds).collect();
        let has_outside_vertices = shapes.iter().zip(&bounds).any(|(shape, bounds)| {
            let all = BoundingBox::from_positions(shape.mesh.rest_positions().as_flattened());
            let tolerance = WIDENING_TOLERANCE * bounds.rest.diagonal();
            let is_wider = |axis: usize| {
                all.min[axis] < bounds.rest.min[axis] - tolerance || all.max[axis] > bounds.rest.max[axis] + tolerance
            };
            (0..3).any(is_wider)
        });
        Self { shapes: bounds, has_outside_vertices }
    }

    /// Bounds that contain the drawn vertices of a domain in the frame of its shape: x0 - c + U q.
    fn local_bounds(&self, scene: &Scene, state: &SceneState, domain: usize) -> BoundingBox {
        let shape = &self.shapes[scene.domains[domain].shape];
        let q = state.q_of(scene, domain);
        if q.iter().all(|coordinate| *coordinate == 0.0) {
            return shape.rest;
        }
        let reach_of_modes = shape.mode_reach.get_or_init(|| mode_reach(scene.shape_of(domain)));
        let mut reach = [0.0; 3];
        for (coordinate, mode) in q.iter().zip(reach_of_modes) {
            (0..3).for_each(|axis| reach[axis] += f64::from(coordinate.abs()) * mode[axis]);
        }
        BoundingBox {
            min: std::array::from_fn(|axis| shape.rest.min[axis] - reach[axis]),
            max: std::array::from_fn(|axis| shape.rest.max[axis] + reach[axis]),
        }
    }

    /// Bounds that contain the drawn vertices of a domain, relative to its floating origin ([`SceneState::origin_of`]),
    /// in scene units. They are tight for a rigid domain that is not rotated.
    pub fn domain_bounds(&self, scene: &Scene, state: &SceneState, domain: usize) -> BoundingBox {
        transform_bounds(&world_from_shape(scene, state, domain), self.local_bounds(scene, state, domain))
    }

    /// Whether [`Self::clip`] changes bounds: a vertex that no triangle uses is outside of the surfaces.
    pub const fn clips(&self) -> bool {
        self.has_outside_vertices
    }

    /// Removes the space that only vertices without triangles need from the bounds of a deformed state, in the world
    /// and along the light axes. Does nothing in a scene without such vertices outside of its surfaces.
    #[must_use]
    pub fn clip(&self, scene: &Scene, state: &SceneState, computed: FrameBounds) -> FrameBounds {
        if !self.has_outside_vertices {
            return computed;
        }
        let (mut bounds, mut light_bounds) = (BoundingBox::EMPTY, BoundingBox::EMPTY);
        let light_axes = scene.light_axes().unwrap_or_default();
        for domain in 0..scene.domains.len() {
            let matrix = world_from_shape(scene, state, domain);
            for corner in self.local_bounds(scene, state, domain).corners() {
                let corner = matrix.transform_point(&corner).coords;
                bounds.include(corner.into());
                light_bounds.include(light_axes.map(|axis: Vector3<f64>| axis.dot(&corner)));
            }
        }
        let clip_light = |OrientedBounds(computed)| OrientedBounds(intersect(computed, with_margin(light_bounds)));
        FrameBounds { world: intersect(computed.world, with_margin(bounds)), light: computed.light.map(clip_light) }
    }

    /// As [`Self::clip`], for bounds that are relative to `reference_point`, in scene units from the scene's origin.
    #[must_use]
    pub fn clip_rebased(
        &self,
        scene: &Scene,
        state: &SceneState,
        bounds: BoundingBox,
        reference_point: [f64; 3],
    ) -> BoundingBox {
        if !self.has_outside_vertices {
            return bounds;
        }
        let rebased_bounds = |domain: usize| {
            let origin = state.origin_of(scene.transform_roots.root_of(domain));
            let bounds = self.domain_bounds(scene, state, domain);
            let rebased =
                |corner: [f64; 3]| std::array::from_fn(|axis| corner[axis] + origin[axis] - reference_point[axis]);
            BoundingBox { min: rebased(bounds.min), max: rebased(bounds.max) }
        };
        let limit = (0..scene.domains.len()).map(rebased_bounds).fold(BoundingBox::EMPTY, BoundingBox::union);
        intersect(bounds, with_margin(limit))
    }
}

/// The matrix from positions x0 - c + U q of a domain to positions relative to its floating origin.
fn world_from_shape(scene: &Scene, state: &SceneState, domain: usize) -> Matrix4<f64> {
    let entries = state.composed_transform(scene, domain).to_f64();
    let mut matrix = Matrix4::identity();
    for (index, entry) in entries.into_iter().enumerate() {
        matrix[(index / 4, index % 4)] = entry;
    }
    matrix
}

/// Per mode and axis, the largest magnitude in U of the drawn vertices.
fn mode_reach(shape: &Shape) -> Vec<[f64; 3]> {
    let drawn_vertices = shape.mesh.drawn_vertices();
    let reach_of = |mode: usize| {
        let mut reach = [0.0_f64; 3];
        let rows = shape.modes.column(mode).as_chunks::<3>().0;
        for row in drawn_vertices.iter().map(|vertex| rows[*vertex as usize]) {
            (0..3).for_each(|axis| reach[axis] = reach[axis].max(f64::from(row[axis].abs())));
        }
        reach
    };
    (0..shape.modes.rank()).map(reach_of).collect()
}

/// A box that is larger by the rounding error of f32 positions.
fn with_margin(bounds: BoundingBox) -> BoundingBox {
    let largest = bounds.min.iter().chain(&bounds.max).fold(0.0, |largest: f64, number| largest.max(number.abs()));
    let margin = ROUNDING_MARGIN * largest;
    BoundingBox { min: bounds.min.map(|number| number - margin), max: bounds.max.map(|number| number + margin) }
}

/// The intersection of two boxes that contain the same points. Returns `computed` if the other one is not finite.
fn intersect(computed: BoundingBox, limit: BoundingBox) -> BoundingBox {
    if !limit.is_finite() || !computed.is_finite() {
        return computed;
    }
    BoundingBox {
        min: std::array::from_fn(|axis| computed.min[axis].max(limit.min[axis])),
        max: std::array::from_fn(|axis| computed.max[axis].min(limit.max[axis])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Domain, Material, Mesh, Modes, Transform};
    use crate::scene::SceneParts;

    /// A triangle with two modes and a vertex at `stray`, which no triangle uses.
    fn scene_with(stray: [f32; 3]) -> std::sync::Arc<Scene> {
        scene_with_rest_q(stray, vec![])
    }

    fn scene_with_rest_q(stray: [f32; 3], rest_q: Vec<f32>) -> std::sync::Arc<Scene> {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.5], stray];
        let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2]]).expect("a mesh");
        // The first mode moves the drawn vertices along x, and the second one only the stray vertex.
        let columns = [[1.0, 0.0, 0.0].repeat(3), vec![0.0; 3], vec![0.0; 9], vec![5.0; 3]].concat();
        let modes = Modes::from_columns(12, 2, columns).expect("modes");
        let mut parts = SceneParts::named("stray");
        parts.shapes.push(Shape::new(mesh, modes).expect("a shape"));
        parts.materials.push(Material::default());
        parts.domains.push(Domain { rest_q, ..Domain::new("body", 0) });
        Scene::new(parts).expect("a scene")
    }

    fn state(scene: &Scene, q: [f32; 2]) -> SceneState {
        let mut state = SceneState::rest(scene);
        state.q.copy_from_slice(&q);
        let rotation = nalgebra::Rotation3::from_euler_angles(0.3, -0.7, 1.2).into_inner();
        state.transforms[0] = Transform::from_parts(&rotation, &Vector3::new(4.0, 5.0, -6.0));
        state
    }

    /// The bounds of the vertices below `count`, in the world and in light space.
    fn bounds_of(scene: &Scene, state: &SceneState, count: usize) -> FrameBounds {
        let shape = scene.shape_of(0);
        let matrix = world_from_shape(scene, state, 0);
        let (mut bounds, mut light) = (BoundingBox::EMPTY, BoundingBox::EMPTY);
        for vertex in 0..count {
            let entry = |axis: usize, mode: usize| f64::from(shape.modes.entry(vertex, axis, mode));
            let local = Vector3::from_fn(|axis, _| {
                let u = entry(axis, 0) * f64::from(state.q[0]) + entry(axis, 1) * f64::from(state.q[1]);
                f64::from(shape.mesh.rest_positions()[vertex][axis]) + u
            });
            let world = matrix.transform_point(&local.into()).coords;
            bounds.include(world.into());
            light.include(scene.light_axes().unwrap_or_default().map(|axis| axis.dot(&world)));
        }
        FrameBounds { world: bounds, light: Some(OrientedBounds(light)) }
    }

    fn contains(outer: BoundingBox, inner: BoundingBox) -> bool {
        (0..3).all(|axis| outer.min[axis] <= inner.min[axis] && outer.max[axis] >= inner.max[axis])
    }

    #[test]
    fn clipped_bounds_contain_the_drawn_vertices_and_little_more() {
        let scene = scene_with([1000.0, -20.0, 3.0]);
        for q in [[0.0, 0.0], [0.5, 0.0], [-0.5, 300.0]] {
            let state = state(&scene, q);
            let (all, drawn) = (bounds_of(&scene, &state, 4), bounds_of(&scene, &state, 3));
            let clipped = scene.drawn_bounds.clip(&scene, &state, all);
            let light = |bounds: &FrameBounds| bounds.light.expect("light bounds").0;
            assert!(contains(clipped.world, drawn.world) && contains(light(&clipped), light(&drawn)), "{q:?}");
            for (clipped, drawn) in [(clipped.world, drawn.world), (light(&clipped), light(&drawn))] {
                assert!(clipped.diagonal() < 3.0 * drawn.diagonal(), "{q:?}: {clipped:?}");
            }
            assert!(all.world.diagonal() > 100.0, "control");
        }
    }

    /// The first mode moves the triangle along x.
    #[test]
    fn rest_bounds_include_the_coordinates_of_the_rest_state() {
        let bounds = |rest_q: &[f32]| scene_with_rest_q([0.0; 3], rest_q.to_vec()).rest_bounds;
        assert_eq!(bounds(&[2.0, 7.0]), BoundingBox { min: [2.0, 0.0, 0.0], max: [3.0, 1.0, 0.5] });
        for undeformed in [&[][..], &[0.0, 7.0]] {
            assert_eq!(bounds(undeformed), BoundingBox { min: [0.0; 3], max: [1.0, 1.0, 0.5] });
        }
    }

    #[test]
    fn bounds_without_outside_vertices_are_unchanged() {
        let scene = scene_with([0.5, 0.5, 0.1]);
        let state = state(&scene, [0.25, 1.0]);
        let all = bounds_of(&scene, &state, 4);
        assert_eq!(scene.drawn_bounds.clip(&scene, &state, all), all);
    }
}
