//! Converts cameras.

use modalcast_proto::v1;

use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Camera, Lens, Scene, View};

/// Parses and validates a camera. An unset view or lens is that of `default_camera`, and an unset up direction the up
/// axis of the scene.
pub(super) fn parse_camera(scene: &Scene, default_camera: Camera, camera: v1::Camera) -> Result<Camera> {
    let view = match camera.view {
        None => default_camera.view,
        Some(v1::camera::View::LookAt(look_at)) => View::LookAt {
            eye: parse_numbers("camera.look_at.eye", &look_at.eye)?,
            target: parse_numbers("camera.look_at.target", &look_at.target)?,
            up: match look_at.up.is_empty() {
                true => scene.up.vector().into(),
                false => parse_numbers("camera.look_at.up", &look_at.up)?,
            },
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

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::domain::{Domain, Material, Mesh, Modes, Shape};
    use modalcast_model::scene::{SceneParts, UpAxis};

    #[test]
    fn unset_up_direction_is_the_up_axis_of_the_scene() {
        let positions = vec![[0.0; 3], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]];
        let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 3], vec![], vec![[0, 1, 2]]).expect("a mesh");
        let scene = Scene::new(SceneParts {
            up: UpAxis::Z,
            shapes: vec![Shape::new(mesh, Modes::rigid()).expect("a shape")],
            materials: vec![Material::default()],
            domains: vec![Domain::new("triangle", 0)],
            ..SceneParts::named("triangle")
        });
        let scene = scene.expect("a scene");
        let default_camera = Camera::fit_to_scene(&scene, 8, 8);
        let up_of = |up: Vec<f64>| {
            let look_at = v1::LookAt { eye: vec![5.0, 0.0, 0.0], target: vec![0.0; 3], up };
            let camera = v1::Camera { view: Some(v1::camera::View::LookAt(look_at)), ..v1::Camera::default() };
            match parse_camera(&scene, default_camera, camera).map(|camera| camera.view) {
                Ok(View::LookAt { up, .. }) => Ok(up),
                other => Err(format!("{other:?}")),
            }
        };
        assert_eq!(up_of(vec![]), Ok([0.0, 0.0, 1.0]));
        assert_eq!(up_of(vec![0.0, 2.0, 0.0]), Ok([0.0, 2.0, 0.0]));
        assert!(up_of(vec![1.0]).is_err());
    }
}
