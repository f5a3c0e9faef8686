//! Parses a camera from the wire. Unset parts are taken from the camera that frames the scene.

use modalcast_proto::v1;

use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Camera, Lens, View};

/// Parses and validates a camera.
pub(super) fn parse(framing: Camera, camera: v1::Camera) -> Result<Camera> {
    let view = match camera.view {
        None => framing.view,
        Some(v1::camera::View::LookAt(look)) => View::LookAt {
            eye: exactly("camera.look_at.eye", &look.eye)?,
            target: exactly("camera.look_at.target", &look.target)?,
            up: exactly("camera.look_at.up", &look.up)?,
        },
        Some(v1::camera::View::Pose(pose)) => View::Pose(exactly("camera.pose", &pose.world_from_camera)?),
    };
    let lens = match camera.lens {
        None => framing.lens,
        Some(v1::camera::Lens::FieldOfView(degrees)) => Lens::FieldOfView(degrees),
        Some(v1::camera::Lens::Intrinsics(v1::Intrinsics { fx, fy, cx, cy })) => Lens::Intrinsics { fx, fy, cx, cy },
    };
    Camera { view, lens, near: camera.near, far: camera.far }.validated()
}

fn exactly<const N: usize>(field: &str, list: &[f64]) -> Result<[f64; N]> {
    list.try_into().map_err(|_| invalid(field, format!("{N} numbers"), list.len()))
}
