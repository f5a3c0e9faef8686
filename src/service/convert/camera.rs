//! Converts cameras.

use modalcast_proto::v1;

use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Camera, Lens, View};

/// Parses and validates a camera. An unset view or lens is that of `default_camera`.
pub(super) fn parse_camera(default_camera: Camera, camera: v1::Camera) -> Result<Camera> {
    let view = match camera.view {
        None => default_camera.view,
        Some(v1::camera::View::LookAt(look_at)) => View::LookAt {
            eye: parse_numbers("camera.look_at.eye", &look_at.eye)?,
            target: parse_numbers("camera.look_at.target", &look_at.target)?,
            up: parse_numbers("camera.look_at.up", &look_at.up)?,
        },
        Some(v1::camera::View::Pose(pose)) => {
            View::Pose(parse_numbers("camera.pose.world_from_camera", &pose.world_from_camera)?)
        }
    };
    let lens = match camera.lens {
        None => default_camera.lens,
        Some(v1::camera::Lens::FieldOfView(degrees)) => Lens::FieldOfView(degrees),
        Some(v1::camera::Lens::Intrinsics(v1::Intrinsics { fx, fy, cx, cy })) => Lens::Intrinsics { fx, fy, cx, cy },
    };
    // If `near` and `far` are 0, the renderer clips nothing in front of the camera.
    Camera { view, lens, near: camera.near, far: camera.far }.validated()
}

/// A camera with its view and lens.
pub(super) fn wire_camera(camera: &Camera) -> v1::Camera {
    let view = match camera.view {
        View::LookAt { eye, target, up } => {
            v1::camera::View::LookAt(v1::LookAt { eye: eye.into(), target: target.into(), up: up.into() })
        }
        View::Pose(pose) => v1::camera::View::Pose(v1::Pose { world_from_camera: pose.into() }),
    };
    let lens = match camera.lens {
        Lens::FieldOfView(degrees) => v1::camera::Lens::FieldOfView(degrees),
        Lens::Intrinsics { fx, fy, cx, cy } => v1::camera::Lens::Intrinsics(v1::Intrinsics { fx, fy, cx, cy }),
    };
    v1::Camera { view: Some(view), lens: Some(lens), near: camera.near, far: camera.far }
}

/// Converts a list to an array of N numbers.
fn parse_numbers<const N: usize>(field: &str, list: &[f64]) -> Result<[f64; N]> {
    list.try_into().map_err(|_| invalid(field, format!("{N} numbers"), list.len()))
}
