//! Camera rays, and the parts of a frame that are not triangles: ground, sky and light.

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
    /// Depth range along the camera's axis in which triangles are visible.
    pub(super) range: (f64, f64),
    pub(super) to_sun: Vector3<f64>,
    pub(super) sunlight: Vector3<f64>,
    pub(super) skylight: Vector3<f64>,
    pub(super) up: Vector3<f64>,
    pub(super) ground: Option<GroundPlane>,
    zenith: Vector3<f64>,
    horizon: Vector3<f64>,
    world_from_camera: Matrix3<f64>,
    /// Focal lengths and principal point in pixels, from the top left.
    lens: [f64; 4],
}

/// The ground: a plane that fades into the horizon.
#[derive(Debug, Clone, Copy)]
pub(super) struct GroundPlane {
    height: f64,
    center: Vector3<f64>,
    fade: f64,
    color: Vector3<f64>,
}

impl View {
    /// The parameters of a shot of a scene. Positions are relative to the scene's origin.
    pub(super) fn new(scene: &Scene, shot: &FrameParams) -> Self {
        let look = &scene.look;
        let wide = |color: [f32; 3]| Vector3::from(color).cast::<f64>();
        let (width, height) = (f64::from(shot.width), f64::from(shot.height));
        let lens = match shot.camera.lens {
            Lens::FieldOfView(degrees) => {
                let focal = 0.5 * height / (0.5 * degrees).to_radians().tan();
                [focal, focal, 0.5 * width, 0.5 * height]
            }
            Lens::Intrinsics { fx, fy, cx, cy } => [fx, fy, cx, cy],
        };
        let rotation = shot.camera.camera_from_world().fixed_view::<3, 3>(0, 0).into_owned();
        let clip = shot.camera.clip_from_camera(shot.width, shot.height, &shot.bounds.union(scene.rest_bounds));
        let (scale, shift) = (clip[(2, 2)], clip[(2, 3)]);
        let eye = shot.camera.eye();
        let up = scene.up.index();
        let above = eye[up] > scene.rest_bounds.min[up];
        Self {
            width: shot.width,
            height: shot.height,
            eye,
            range: (shift / (scale - 1.0), shift / (scale + 1.0)),
            to_sun: look.to_sun(scene.up),
            sunlight: wide(look.sunlight),
            skylight: wide(look.skylight),
            up: scene.up.vector(),
            ground: look.ground.filter(|_| above).map(|ground| GroundPlane::new(scene, eye, wide(ground.color))),
            zenith: wide(look.zenith),
            horizon: wide(look.horizon),
            world_from_camera: rotation.try_inverse().unwrap_or_else(Matrix3::identity),
            lens,
        }
    }

    /// The ray through a point of the image, in pixels from the top left. Its t is the depth along the camera's axis.
    pub(super) fn ray(&self, x: f64, y: f64) -> Ray {
        let [fx, fy, cx, cy] = self.lens;
        let along = Vector3::new((x - cx) / fx, (cy - y) / fy, -1.0);
        Ray { from: self.eye, along: self.world_from_camera * along }
    }

    /// The sky color in a direction: interpolated from horizon to zenith by 1 - exp(-6 s s / (s + 0.06)), with s the
    /// sine of the elevation.
    pub(super) fn sky(&self, along: &Vector3<f64>) -> Vector3<f64> {
        let sine = along.normalize().dot(&self.up).max(0.0);
        let share = 1.0 - (-6.0 * sine * sine / (sine + 0.06)).exp();
        self.horizon.lerp(&self.zenith, share)
    }

    /// The t where a ray hits the ground in front of its origin.
    pub(super) fn ground_at(&self, ray: &Ray) -> Option<f64> {
        let plane = self.ground?;
        let fall = self.up.dot(&ray.along);
        let t = (plane.height - self.up.dot(&ray.from)) / fall;
        (fall < 0.0 && t > 0.0 && t.is_finite()).then_some(t)
    }

    /// Fraction of the ground's own color in the haze, from 1 under the scene to 0 far away.
    pub(super) fn clear(&self, point: &Vector3<f64>) -> f64 {
        let share = |plane: GroundPlane| (point - plane.center).norm_squared() / (plane.fade * plane.fade);
        self.ground.map_or(0.0, |plane| (-share(plane)).exp())
    }

    /// The color of the ground, and that of the haze.
    pub(super) fn ground_colors(&self) -> (Vector3<f64>, Vector3<f64>) {
        (self.ground.map_or(Vector3::zeros(), |plane| plane.color), self.horizon)
    }
}

impl GroundPlane {
    /// A plane at the lowest rest position. It fades over 3.5 times the scene's diagonal or the eye's horizontal
    /// distance, whichever is larger.
    fn new(scene: &Scene, eye: Vector3<f64>, color: Vector3<f64>) -> Self {
        let (rest, up) = (scene.rest_bounds, scene.up.index());
        let height = rest.min[up];
        let mut center = rest.center().coords;
        center[up] = height;
        let mut aside = eye - center;
        aside[up] = 0.0;
        Self { height, center, fade: 3.5 * rest.diagonal().max(aside.norm()).max(1e-6), color }
    }
}
