//! Cameras of the figures. Scenes are Y up, in meters, with the sun to the viewer's right.

use nalgebra::Vector3;

use crate::render::harness::Size;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{Camera, Lens, Scene, View};

/// Fraction of the half image that a scene may fill; the rest is for shadows.
const MARGIN: f64 = 0.86;
const DEGREES: f64 = 28.0;

fn looking(eye: Vector3<f64>, target: Vector3<f64>, degrees: f64) -> Camera {
    let view = View::LookAt { eye: eye.into(), target: target.into(), up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::FieldOfView(degrees), near: 0.0, far: 0.0 }
}

/// Frames a whole scene, from slightly to the right and from above by a slope of `elevation`.
pub(super) fn whole(scene: &Scene, size: Size, elevation: f64) -> Camera {
    let aside = Vector3::new(0.30, elevation, 0.95).normalize();
    let right = Vector3::y().cross(&aside).normalize();
    let above = aside.cross(&right);
    let slope = MARGIN * (0.5 * DEGREES).to_radians().tan();
    let aspect = f64::from(size.width) / f64::from(size.height);
    let center = scene.rest_bounds.center().coords;
    // Use vertices rather than the corners of their bounding box, where a tree has no leaves.
    let distance = |point: Vector3<f64>| {
        let offset = point - center;
        let wide = (offset.dot(&right) / (slope * aspect)).abs();
        offset.dot(&aside) + wide.max((offset.dot(&above) / slope).abs())
    };
    let distance = points(scene).map(distance).fold(0.0, f64::max);
    looking(center + aside * distance, center, DEGREES)
}

/// Rest positions of all vertices.
fn points(scene: &Scene) -> impl Iterator<Item = Vector3<f64>> + '_ {
    scene.domains.iter().flat_map(|domain| {
        let place = domain.placement.to_matrix();
        let rest = scene.shapes[domain.shape].mesh.rest();
        rest.iter().map(move |point| place.transform_point(&nalgebra::Point3::from(point.map(f64::from))).coords)
    })
}

/// A trunk at the origin, from nearby.
pub(super) fn trunk() -> Camera {
    looking(Vector3::new(0.25, 1.0, 0.72), Vector3::new(0.0, 0.92, 0.0), 34.0)
}

/// The shadow of a tree at the origin, and the foot of its trunk.
pub(super) fn shadow(scene: &Scene) -> Camera {
    let to_sun = scene.look.to_sun(scene.up);
    let height = scene.rest_bounds.max[1];
    // The shadow of the center of the crown on the ground.
    let middle = Vector3::new(-to_sun.x, 0.0, -to_sun.z) * (0.55 * height / to_sun.y);
    looking(middle + Vector3::new(1.2, 4.2, 6.4), middle + Vector3::new(0.3, 0.0, 0.4), 38.0)
}

/// The leaves nearest to the viewer, from a distance of about 1.4 m.
///
/// # Errors
/// `Fault` when the scene has no leaves.
pub(super) fn bough(scene: &Scene) -> Result<Camera> {
    let towards = Vector3::new(0.30, -0.15, 0.95).normalize();
    let places = scene.domains.iter().filter(|domain| domain.name.starts_with("leaf"));
    let nearest = places
        .map(|domain| domain.placement.translation())
        .max_by(|a, b| a.dot(&towards).total_cmp(&b.dot(&towards)))
        .ok_or_else(|| fault_in("figures")("the tree has no leaves"))?;
    Ok(looking(nearest + Vector3::new(0.25, 0.25, 1.35), nearest, 36.0))
}
