//! The view of a reference image: camera rays, ground, sky and light.

use nalgebra::{Matrix3, Vector3};

use super::ray_scene::Ray;
use modalcast_model::scene::{Lens, Scene};
use modalcast_render::FrameParams;

/// Parameters of one frame. Colors are linear, lengths are scene units.
#[derive(Debug, Clone)]
pub(super) struct View {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) eye: Vector3<f64>,
    /// Depths of the near and far plane along the camera's axis.
    pub(super) depth_range: (f64, f64),
    pub(super) to_sun: Vector3<f64>,
    pub(super) sunlight: Vector3<f64>,
    pub(super) skylight: Vector3<f64>,
    pub(super) up: Vector3<f64>,
    pub(super) ground: Option<GroundPlane>,
    zenith: Vector3<f64>,
    horizon: Vector3<f64>,
    world_from_camera: Matrix3<f64>,
    /// Focal lengths and principal point [fx, fy, cx, cy] in pixels, from the top left.
    lens: [f64; 4],
}

/// The ground: a plane that fades into the horizon.
#[derive(Debug, Clone, Copy)]
pub(super) struct GroundPlane {
    height: f64,
    center: Vector3<f64>,
    /// Distance from `center` at which exp(-1) of the ground color is left.
    fade: f64,
    color: Vector3<f64>,
}

impl View {
    /// The view of a frame of a scene. Positions are relative to the scene's origin.
    pub(super) fn new(scene: &Scene, frame_params: &FrameParams) -> Self {
        let look = &scene.look;
        let to_f64 = |color: [f32; 3]| Vector3::from(color).cast::<f64>();
        let (width, height) = (f64::from(frame_params.width), f64::from(frame_params.height));
        let lens = match frame_params.camera.lens {
            Lens::FieldOfView(degrees) => {
                let focal = 0.5 * height / (0.5 * degrees).to_radians().tan();
                [focal, focal, 0.5 * width, 0.5 * height]
            }
            Lens::Intrinsics { fx, fy, cx, cy } => [fx, fy, cx, cy],
        };
        let rotation = frame_params.camera.camera_from_world().fixed_view::<3, 3>(0, 0).into_owned();
        let clip = frame_params.camera.clip_from_camera(
            frame_params.width,
            frame_params.height,
            &frame_params.bounds.union(scene.rest_bounds),
        );
        let (scale, shift) = (clip[(2, 2)], clip[(2, 3)]);
        let eye = frame_params.camera.eye();
        let up = scene.up.index();
        let is_above_ground = eye[up] > scene.rest_bounds.min[up];
        Self {
            width: frame_params.width,
            height: frame_params.height,
            eye,
            depth_range: (shift / (scale - 1.0), shift / (scale + 1.0)),
            to_sun: look.to_sun(scene.up),
            sunlight: to_f64(look.sunlight),
            skylight: to_f64(look.skylight),
            up: scene.up.vector(),
            ground: look
                .ground
                .filter(|_| is_above_ground)
                .map(|ground| GroundPlane::new(scene, eye, to_f64(ground.color))),
            zenith: to_f64(look.zenith),
            horizon: to_f64(look.horizon),
            world_from_camera: rotation.try_inverse().unwrap_or_else(Matrix3::identity),
            lens,
        }
    }

    /// The ray through a point of the image, in pixels from the top left. Its t is the depth along the camera's axis.
    pub(super) fn ray(&self, x: f64, y: f64) -> Ray {
        let [fx, fy, cx, cy] = self.lens;
        let direction = Vector3::new((x - cx) / fx, (cy - y) / fy, -1.0);
        Ray { origin: self.eye, direction: self.world_from_camera * direction }
    }

    /// The sky color in a direction: interpolated from horizon to zenith by 1 - exp(-6 s s / (s + 0.06)), with s the
    /// sine of the elevation.
    pub(super) fn sky_color(&self, direction: &Vector3<f64>) -> Vector3<f64> {
        let sine = direction.normalize().dot(&self.up).max(0.0);
        let share = 1.0 - (-6.0 * sine * sine / (sine + 0.06)).exp();
        self.horizon.lerp(&self.zenith, share)
    }

    /// The t where a ray hits the ground in front of its origin.
    pub(super) fn intersect_ground(&self, ray: &Ray) -> Option<f64> {
        let plane = self.ground?;
        let slope = self.up.dot(&ray.direction);
        let t = (plane.height - self.up.dot(&ray.origin)) / slope;
        (slope < 0.0 && t > 0.0 && t.is_finite()).then_some(t)
    }

    /// Fraction of the ground color that the haze leaves, from 1 under the scene to 0 far away.
    pub(super) fn ground_visibility(&self, point: &Vector3<f64>) -> f64 {
        let squared_distance = |plane: GroundPlane| (point - plane.center).norm_squared() / (plane.fade * plane.fade);
        self.ground.map_or(0.0, |plane| (-squared_distance(plane)).exp())
    }

    /// The colors of the ground and of the haze.
    pub(super) fn ground_colors(&self) -> (Vector3<f64>, Vector3<f64>) {
        (self.ground.map_or(Vector3::zeros(), |plane| plane.color), self.horizon)
    }
}

impl GroundPlane {
    /// A plane at the lowest rest position. The fade distance is 3.5 times the scene's diagonal or the horizontal
    /// distance of the eye, whichever is larger.
    fn new(scene: &Scene, eye: Vector3<f64>, color: Vector3<f64>) -> Self {
        let (rest, up) = (scene.rest_bounds, scene.up.index());
        let height = rest.min[up];
        let mut center = rest.center().coords;
        center[up] = height;
        let mut horizontal = eye - center;
        horizontal[up] = 0.0;
        Self { height, center, fade: 3.5 * rest.diagonal().max(horizontal.norm()).max(1e-6), color }
    }
}
