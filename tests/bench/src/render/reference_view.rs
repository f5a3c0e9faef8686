//! The view of a reference image: camera rays, ground, sky and light.

use nalgebra::{Matrix3, Vector3};

use super::ray_scene::Ray;
use modalcast_model::scene::{Camera, Lens, Scene};
use modalcast_render::FrameParams;

/// Camera, ground, sky and light of a reference image, derived from the scene and its [`FrameParams`]. Colors are
/// linear, lengths are scene units.
#[derive(Debug, Clone)]
pub(super) struct ReferenceView {
    pub(super) width: u32,
    pub(super) height: u32,
    pub(super) eye: Vector3<f64>,
    /// Depths of the near and of the far plane along the camera's axis; 0 and infinity if the camera clips nothing.
    pub(super) depth_range: (f64, f64),
    pub(super) to_sun: Vector3<f64>,
    pub(super) sunlight: Vector3<f64>,
    /// Fill light at the camera; 0 outdoors.
    pub(super) fill: Vector3<f64>,
    pub(super) up: Vector3<f64>,
    pub(super) ground: Option<GroundPlane>,
    /// Radius of the ambient occlusion; `None` without it.
    pub(super) occlusion_radius: Option<f64>,
    ambient_light: AmbientLight,
    zenith: Vector3<f64>,
    horizon: Vector3<f64>,
    world_from_camera: Matrix3<f64>,
    /// Focal lengths and principal point [fx, fy, cx, cy] in pixels, from the top left.
    lens: [f64; 4],
}

/// Ambient light on surfaces.
#[derive(Debug, Clone, Copy)]
enum AmbientLight {
    /// The same on every side.
    Uniform(Vector3<f64>),
    /// Ambient cube: the colors of the sides +x, -x, +y, -y, +z and -z.
    Cube([Vector3<f64>; 6]),
}

/// The ground: a plane that fades into the horizon.
#[derive(Debug, Clone, Copy)]
pub(super) struct GroundPlane {
    height: f64,
    center: Vector3<f64>,
    /// Distance from `center` at which the fraction exp(-1) of the ground color remains.
    fade_distance: f64,
    color: Vector3<f64>,
}

impl ReferenceView {
    /// The view of a frame of a scene. Positions are relative to the scene's origin.
    pub(super) fn new(scene: &Scene, frame_params: &FrameParams) -> Self {
        let settings = &scene.look;
        let to_f64 = |color: [f32; 3]| Vector3::from(color).cast::<f64>();
        let (width, height) = (f64::from(frame_params.width), f64::from(frame_params.height));
        let lens = match frame_params.camera.lens {
            Lens::FieldOfView(degrees) => {
                let focal_length = 0.5 * height / (0.5 * degrees).to_radians().tan();
                [focal_length, focal_length, 0.5 * width, 0.5 * height]
            }
            Lens::Intrinsics { fx, fy, cx, cy } => [fx, fy, cx, cy],
        };
        let rotation = frame_params.camera.camera_from_world().fixed_view::<3, 3>(0, 0).into_owned();
        let Camera { near, far, .. } = frame_params.camera;
        let eye = frame_params.camera.eye();
        let up_axis = scene.up.index();
        let is_above_ground = eye[up_axis] > scene.rest_bounds.min[up_axis];
        let studio_light = settings.studio_light(scene.up);
        Self {
            width: frame_params.width,
            height: frame_params.height,
            eye,
            depth_range: if far > 0.0 { (near, far) } else { (0.0, f64::INFINITY) },
            to_sun: settings.to_sun(scene.up),
            sunlight: to_f64(settings.sunlight),
            fill: studio_light.map_or(Vector3::zeros(), |light| to_f64(light.fill)),
            up: scene.up.vector(),
            ground: settings
                .ground_color(scene.up)
                .filter(|_| is_above_ground)
                .map(|color| GroundPlane::new(scene, eye, to_f64(color))),
            occlusion_radius: settings
                .ambient_occlusion
                .map(|occlusion| f64::from(occlusion.radius) * scene.rest_bounds.diagonal()),
            ambient_light: studio_light.map_or(AmbientLight::Uniform(to_f64(settings.skylight)), |light| {
                AmbientLight::Cube(light.ambient_cube.map(to_f64))
            }),
            zenith: to_f64(settings.zenith),
            horizon: to_f64(settings.horizon),
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

    /// The sky color in a direction, as in `shaders/shared/sky.glsl`: interpolated from horizon to zenith by
    /// 1 - exp(-6 s s / (s + 0.06)), with s the sine of the elevation.
    pub(super) fn sky_color(&self, direction: &Vector3<f64>) -> Vector3<f64> {
        let sine = direction.normalize().dot(&self.up).max(0.0);
        let zenith_weight = 1.0 - (-6.0 * sine * sine / (sine + 0.06)).exp();
        self.horizon.lerp(&self.zenith, zenith_weight)
    }

    /// The ambient light of a surface with this unit normal.
    pub(super) fn ambient_light(&self, normal: &Vector3<f64>) -> Vector3<f64> {
        match self.ambient_light {
            AmbientLight::Uniform(color) => color,
            AmbientLight::Cube(sides) => (0..3)
                .map(|axis| sides[2 * axis + usize::from(normal[axis] < 0.0)] * (normal[axis] * normal[axis]))
                .sum(),
        }
    }

    /// The parameter t at which a ray hits the ground in front of its origin.
    pub(super) fn intersect_ground(&self, ray: &Ray) -> Option<f64> {
        let plane = self.ground?;
        let slope = self.up.dot(&ray.direction);
        let t = (plane.height - self.up.dot(&ray.origin)) / slope;
        (slope < 0.0 && t > 0.0 && t.is_finite()).then_some(t)
    }

    /// Fraction of the ground color that remains in the haze: exp(-(d / fade distance)^2) at distance d from the center
    /// of the ground. It is 1 below the scene and 0 at the horizon.
    pub(super) fn ground_visibility(&self, point: &Vector3<f64>) -> f64 {
        let relative_distance_squared =
            |plane: GroundPlane| (point - plane.center).norm_squared() / (plane.fade_distance * plane.fade_distance);
        self.ground.map_or(0.0, |plane| (-relative_distance_squared(plane)).exp())
    }

    /// The colors of the ground and of the haze.
    pub(super) fn ground_colors(&self) -> (Vector3<f64>, Vector3<f64>) {
        (self.ground.map_or(Vector3::zeros(), |plane| plane.color), self.horizon)
    }
}

impl GroundPlane {
    /// A plane at the lowest rest position. As in the renderer, the fade distance is 3.5 times the larger of the
    /// scene's diagonal and the horizontal distance of the eye.
    fn new(scene: &Scene, eye: Vector3<f64>, color: Vector3<f64>) -> Self {
        let (rest_bounds, up_axis) = (scene.rest_bounds, scene.up.index());
        let height = rest_bounds.min[up_axis];
        let mut center = rest_bounds.center().coords;
        center[up_axis] = height;
        let mut horizontal_offset = eye - center;
        horizontal_offset[up_axis] = 0.0;
        Self {
            height,
            center,
            fade_distance: 3.5 * rest_bounds.diagonal().max(horizontal_offset.norm()).max(1e-15),
            color,
        }
    }
}
