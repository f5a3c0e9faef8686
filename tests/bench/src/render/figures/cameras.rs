//! Cameras of the figures. Scenes are Y up and in meters. Cameras look towards -z, with the sun to their right.

use nalgebra::Vector3;

use crate::render::harness::Size;
use modalcast_model::error::{Result, fault};
use modalcast_model::scene::{Camera, Lens, Scene, View};

/// Fraction of the image that a scene may fill; the rest is for shadows.
const FILL_FRACTION: f64 = 0.86;
/// Vertical field of view of [`frame_scene`], degrees.
const FIELD_OF_VIEW: f64 = 28.0;

fn look_at(eye: Vector3<f64>, target: Vector3<f64>, field_of_view: f64) -> Camera {
    let view = View::LookAt { eye: eye.into(), target: target.into(), up: [0.0, 1.0, 0.0] };
    // A near and far plane of 0 are fitted to the scene.
    Camera { view, lens: Lens::FieldOfView(field_of_view), near: 0.0, far: 0.0 }
}

/// Frames a scene from the front, slightly from the right. `elevation` is the approximate ratio of the height of the
/// eye to its horizontal distance.
pub(super) fn frame_scene(scene: &Scene, size: Size, elevation: f64) -> Camera {
    let to_eye = Vector3::new(0.30, elevation, 0.95).normalize();
    let right = Vector3::y().cross(&to_eye).normalize();
    let view_up = to_eye.cross(&right);
    // Half of the framed height at distance 1.
    let framed_half_height = FILL_FRACTION * (0.5 * FIELD_OF_VIEW).to_radians().tan();
    let aspect = f64::from(size.width) / f64::from(size.height);
    let center = scene.rest_bounds.center().coords;
    // Frame the vertices, because a tree has no leaves at the corners of its bounding box.
    let min_distance = |point: Vector3<f64>| {
        let offset = point - center;
        let horizontal = (offset.dot(&right) / (framed_half_height * aspect)).abs();
        offset.dot(&to_eye) + horizontal.max((offset.dot(&view_up) / framed_half_height).abs())
    };
    let distance = world_positions(scene).map(min_distance).fold(0.0, f64::max);
    look_at(center + to_eye * distance, center, FIELD_OF_VIEW)
}

/// World positions of all vertices at rest.
fn world_positions(scene: &Scene) -> impl Iterator<Item = Vector3<f64>> + '_ {
    scene.domains.iter().flat_map(|domain| {
        let placement = domain.placement.to_matrix();
        let positions = scene.shapes[domain.shape].mesh.rest_positions();
        positions
            .iter()
            .map(move |point| placement.transform_point(&nalgebra::Point3::from(point.map(f64::from))).coords)
    })
}

/// A close-up of a trunk at the origin.
pub(super) fn trunk_closeup() -> Camera {
    look_at(Vector3::new(0.25, 1.0, 0.72), Vector3::new(0.0, 0.92, 0.0), 34.0)
}

/// Frames the shadow of a tree at the origin and the base of its trunk.
pub(super) fn frame_shadow(scene: &Scene) -> Camera {
    let to_sun = scene.look.to_sun(scene.up);
    let height = scene.rest_bounds.max[1];
    // The shadow of the center of the crown, which is at about 0.55 of the tree's height, on the ground.
    let crown_shadow = Vector3::new(-to_sun.x, 0.0, -to_sun.z) * (0.55 * height / to_sun.y);
    look_at(crown_shadow + Vector3::new(1.2, 4.2, 6.4), crown_shadow + Vector3::new(0.3, 0.0, 0.4), 38.0)
}

/// A close-up, from a distance of about 1.4 m, of the leaf at the front of the tree: the leaf that is farthest in the
/// direction `to_front`.
///
/// # Errors
/// `Fault` when the scene has no leaves.
pub(super) fn leaf_closeup(scene: &Scene) -> Result<Camera> {
    // Towards the front, slightly to the right and down.
    let to_front = Vector3::new(0.30, -0.15, 0.95).normalize();
    let leaves = scene.domains.iter().filter(|domain| domain.name.starts_with("leaf"));
    let front_leaf = leaves
        .map(|domain| domain.placement.translation())
        .max_by(|a, b| a.dot(&to_front).total_cmp(&b.dot(&to_front)))
        .ok_or_else(|| fault("figures", "expected a tree with leaves"))?;
    Ok(look_at(front_leaf + Vector3::new(0.25, 0.25, 1.35), front_leaf, 36.0))
}
