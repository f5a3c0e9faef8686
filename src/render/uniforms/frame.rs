//! Per-frame uniforms, computed in f64 and rounded to f32 at the end.

use bytemuck::{Pod, Zeroable};
use nalgebra::{Matrix4, Vector3};

use super::MIN_SIZE;
use super::light_box::{LightBox, LightBoxParams};
use crate::types::FrameParams;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{BoundingBox, OrientedBounds, RenderSettings, Scene};
use modalcast_model::views::ViewCamera;

/// Uniform block of a frame; matrices are column-major. Twin of `FrameBlock` in `shaders/shared/frame.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct FrameUniforms {
    clip_from_world: [[f32; 4]; 4],
    shadow_from_world: [[f32; 4]; 4],
    world_from_ndc: [[f32; 4]; 4],
    /// xyz: position of the camera. w: 1 if the scene has a ground and the camera is above it, else 0.
    eye: [f32; 4],
    /// xyz: direction to the sun. w: radius of the ambient occlusion, in scene units.
    to_sun: [f32; 4],
    sunlight: [f32; 4],
    skylight: [f32; 4],
    zenith: [f32; 4],
    horizon: [f32; 4],
    /// xyz: up axis. w: height of the ground.
    up: [f32; 4],
    /// xyz: color. w: fade distance.
    ground: [f32; 4],
    /// xyz: center. w: half the side of the ground's square.
    ground_center: [f32; 4],
    /// Minimum variance, light bleeding reduction, alpha threshold, side of the map in texels.
    shadow: [f32; 4],
    /// xyz: [`LightBox::ground`]. w: side of a shadow map texel in scene units.
    shadow_ground_plane: [f32; 4],
    /// xyz: center, w: squared radius of the sphere outside of which the ambient light is not occluded.
    occlusion_sphere: [f32; 4],
    /// xyz: color of the lines along mesh edges. w: their width in pixels.
    edges: [f32; 4],
}

const _: () = assert!(size_of::<FrameUniforms>() == 400, "FrameUniforms differs from shaders/shared/frame.glsl");

/// Half the side of the ground's square, in multiples of the fade distance D. The ground's weight is exp(-(d / D)^2) at
/// distance d. At the border it is exp(-36), so the rounded color is that of the horizon.
const GROUND_EXTENT: f64 = 6.0;

/// Upper bound of the squared radius of [`FrameUniforms::occlusion_sphere`], which must be finite in f32.
const MAX_SQUARED_REACH: f64 = 1e38;

/// Vertices that lie less than this fraction of the diagonal below the ground count as on the ground: the largest error
/// of deformed vertices.
const GROUND_TOLERANCE: f64 = 1e-5;

impl FrameUniforms {
    /// Computes the uniforms of one frame. `look`: the scene's look with the shadow map for the renderer. Positions are
    /// relative to `origin`, a point in scene units from the scene's origin; it is subtracted from the camera in f64.
    ///
    /// # Errors
    /// `Invalid` if the camera's matrices overflow.
    pub(crate) fn new(scene: &Scene, look: &RenderSettings, params: &FrameParams, origin: [f64; 3]) -> Result<Self> {
        let bounds = finite_bounds(scene, params);
        let rest_bounds = rebased_rest_bounds(scene, bounds, origin);
        let to_sun = look.to_sun(scene.up);
        let ground_height = rest_bounds.min[scene.up.index()];
        let shadow = look.shadow.unwrap_or_default();
        let ambient_radius = look
            .ambient_occlusion
            .map_or(0.0, |occlusion| f64::from(occlusion.radius) * scene.rest_bounds.diagonal().max(MIN_SIZE));
        let occlusion_reach = 0.5 * bounds.diagonal() + ambient_radius;
        let light_box = LightBox::fit(&light_box_params(scene, look, params, origin));
        let rebased_camera = params.camera.relative_to(origin);
        let camera_from_world = rebased_camera.camera_from_world();
        let clip_from_camera = clip_from_camera(scene, params, origin);
        let (center, fade_distance) = ground_center_and_fade(scene.up.index(), rest_bounds, rebased_camera.eye());
        let color = |[r, g, b]: [f32; 3], w: f64| [r, g, b, w as f32];
        let frame = Self {
            clip_from_world: (clip_from_camera * camera_from_world).cast().into(),
            shadow_from_world: light_box.shadow_from_world.cast().into(),
            world_from_ndc: world_from_ndc(&clip_from_camera, &camera_from_world).cast().into(),
            eye: vec4_of(rebased_camera.eye(), flag(look.ground.is_some() && camera_is_above_ground(scene, params))),
            to_sun: vec4_of(to_sun, ambient_radius),
            sunlight: color(look.sunlight, 0.0),
            skylight: color(look.skylight, 0.0),
            zenith: color(look.zenith, 0.0),
            horizon: color(look.horizon, 0.0),
            up: vec4_of(scene.up.vector(), ground_height),
            ground: color(look.ground_color(scene.up).unwrap_or_default(), fade_distance),
            ground_center: vec4_of(center, GROUND_EXTENT * fade_distance),
            shadow: [
                shadow.least_variance.max(shadow.variance_floor()),
                shadow.bleeding,
                shadow.alpha_threshold,
                shadow.size as f32,
            ],
            shadow_ground_plane: vec4_of(light_box.ground.into(), light_box.texel_side(f64::from(shadow.size))),
            occlusion_sphere: vec4_of(bounds.center().coords, occlusion_reach.powi(2).min(MAX_SQUARED_REACH)),
            edges: params.edges.map_or([0.0; 4], |edges| color(edges.color, edges.width.into())),
        };
        let numbers: &[f32] = bytemuck::cast_slice(std::slice::from_ref(&frame));
        match numbers.iter().all(|number| number.is_finite()) {
            true => Ok(frame),
            false => Err(invalid("camera", "a camera whose matrices are finite", format!("{:?}", params.camera))),
        }
    }

    /// The camera of a small view with the same picture.
    pub(crate) fn view_camera(&self) -> ViewCamera {
        let xyz = |[x, y, z, _]: [f32; 4]| [x, y, z];
        ViewCamera {
            clip_from_world: std::array::from_fn(|entry| self.clip_from_world[entry % 4][entry / 4]),
            world_from_ndc: std::array::from_fn(|entry| self.world_from_ndc[entry % 3][entry / 3]),
            eye: xyz(self.eye),
            ground_center: xyz(self.ground_center),
            ground_half_side: self.ground_center[3],
            ground_fade: self.ground[3],
            sees_ground: u32::from(self.eye[3] > 0.0),
        }
    }

    /// Whether the view ray through a point in normalized device coordinates hits the ground. Used for samples without
    /// an id. Twin of `ray_hits_ground` in `shaders/shared/ground_plane.glsl`.
    pub(crate) fn ray_hits_ground(&self, ndc: [f64; 2]) -> bool {
        let to_vector3 = |vector4: [f32; 4]| Vector3::new(vector4[0], vector4[1], vector4[2]).cast::<f64>();
        let [x, y, forward] = [0, 1, 2].map(|column| to_vector3(self.world_from_ndc[column]));
        let (direction, eye, up) = (x * ndc[0] + y * ndc[1] + forward, to_vector3(self.eye), to_vector3(self.up));
        let (descent, eye_height) = (-direction.dot(&up), eye.dot(&up) - f64::from(self.up[3]));
        let offset = eye - to_vector3(self.ground_center) + direction * (eye_height / descent);
        let offset = offset - up * offset.dot(&up);
        let is_in_square = offset.iter().all(|side| side.abs() <= f64::from(self.ground_center[3]));
        self.eye[3] > 0.0 && descent > 0.0 && eye_height > 0.0 && is_in_square
    }
}

/// Projection matrix of the camera for positions relative to `origin`. The bounds are those of both the deformed and
/// the rest state, so that the fitted near plane changes rarely when the scene deforms.
fn clip_from_camera(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> Matrix4<f64> {
    let bounds = finite_bounds(scene, params);
    let rebased_camera = params.camera.relative_to(origin);
    rebased_camera.clip_from_camera(
        params.width,
        params.height,
        &bounds.union(rebased_rest_bounds(scene, bounds, origin)),
    )
}

/// Matrix from positions relative to `origin` to the clip space of a frame.
pub(crate) fn clip_from_positions(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> Matrix4<f64> {
    clip_from_camera(scene, params, origin) * params.camera.relative_to(origin).camera_from_world()
}

/// Matrix from positions relative to `origin` to the clip space of the shadow map; z is 1 nearest to the sun and 0 at
/// the far plane.
pub(crate) fn shadow_clip_from_positions(
    scene: &Scene,
    look: &RenderSettings,
    params: &FrameParams,
    origin: [f64; 3],
) -> Matrix4<f64> {
    let shadow_from_world = LightBox::fit(&light_box_params(scene, look, params, origin)).shadow_from_world;
    let clip_from_shadow = Matrix4::new_nonuniform_scaling(&Vector3::new(2.0, 2.0, -1.0));
    Matrix4::new_translation(&Vector3::new(-1.0, -1.0, 1.0)) * clip_from_shadow * shadow_from_world
}

/// Bounds of a frame, or the rest bounds if they overflowed: shadow map and near plane need finite bounds.
fn finite_bounds(scene: &Scene, params: &FrameParams) -> BoundingBox {
    let has_valid_bounds = params.bounds.is_finite() && params.bounds.min[0] <= params.bounds.max[0];
    if has_valid_bounds { params.bounds } else { scene.rest_bounds }
}

/// Light-space bounds of a frame; none if they or the world-space bounds overflowed.
fn finite_light_bounds(params: &FrameParams) -> Option<OrientedBounds> {
    params.light_bounds.filter(|light_bounds| light_bounds.is_valid() && params.bounds.is_finite())
}

/// Inputs of the light box, for positions relative to `origin`. `look`: as for [`FrameUniforms::new`].
pub(crate) fn light_box_params(
    scene: &Scene,
    look: &RenderSettings,
    params: &FrameParams,
    origin: [f64; 3],
) -> LightBoxParams {
    let bounds = finite_bounds(scene, params);
    let ground_height = rebased_rest_bounds(scene, bounds, origin).min[scene.up.index()];
    let shadow = look.shadow.unwrap_or_default();
    LightBoxParams {
        to_sun: look.to_sun(scene.up),
        up: scene.up,
        bounds,
        light_bounds: finite_light_bounds(params),
        ground: look.ground.map(|_| ground_height),
        size: f64::from(shadow.size),
        margin: f64::from(shadow.blur_radius()) + 1.0,
    }
}

/// Sides of a shadow map texel in world space: two vectors along x and y of the map, in scene units. None if the look
/// has no shadow. Valid for positions relative to the scene's origin, and for the map of `scene.look`, which the
/// renderer draws if the look leaves nothing to a preset.
pub fn shadow_texel_axes(scene: &Scene, params: &FrameParams) -> Option<[Vector3<f64>; 2]> {
    let shadow = scene.look.shadow?;
    let shadow_from_world = LightBox::fit(&light_box_params(scene, &scene.look, params, [0.0; 3])).shadow_from_world;
    // One texel is a step of 1 / size in a map coordinate, which is the product of a matrix row and the position.
    let texel_axis = |row: usize| {
        let row_vector = shadow_from_world.fixed_view::<1, 3>(row, 0).transpose();
        row_vector / (row_vector.norm_squared() * f64::from(shadow.size))
    };
    Some([texel_axis(0), texel_axis(1)])
}

/// Matrix from world space to the clip space of the shadow map; z is 1 nearest to the sun. None if the look has no
/// shadow. Valid as [`shadow_texel_axes`].
pub fn shadow_clip_from_world(scene: &Scene, params: &FrameParams) -> Option<Matrix4<f64>> {
    scene.look.shadow.map(|_| shadow_clip_from_positions(scene, &scene.look, params, [0.0; 3]))
}

/// Whether the camera is above the ground; the ground is not visible from below.
fn camera_is_above_ground(scene: &Scene, params: &FrameParams) -> bool {
    let up = scene.up.index();
    params.camera.eye()[up] > scene.rest_bounds.min[up]
}

/// How far the lowest vertex of a frame lies below the ground in meters; see [`crate::FrameInfo::below_ground`].
/// `origin`: origin of the bounds, in scene units from the scene's origin. Bounds that are empty or not finite give 0.
pub(crate) fn depth_below_ground(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> f64 {
    let up = scene.up.index();
    let depth = scene.rest_bounds.min[up] - (params.bounds.min[up] + origin[up]);
    let is_below = scene.look.ground.is_some()
        && params.bounds.is_finite()
        && depth > GROUND_TOLERANCE * scene.rest_bounds.diagonal();
    if is_below { depth * scene.unit } else { 0.0 }
}

/// Distance of the origin from the scene at rest, in diagonals of the rest bounds, from which the ground is centered at
/// the current bounds. It is large, because the fade of the ground changes there.
const GROUND_FOLLOW_DISTANCE: f64 = 4096.0;

/// Rest bounds relative to `origin`. If the scene moved far away ([`GROUND_FOLLOW_DISTANCE`]), the rest bounds are
/// moved horizontally to the center of the current bounds. Their height above the world's origin does not change,
/// because the ground is at their lower end.
fn rebased_rest_bounds(scene: &Scene, bounds: BoundingBox, origin: [f64; 3]) -> BoundingBox {
    let rest_bounds = scene.rest_bounds;
    let mut shift = -Vector3::from(origin);
    if (rest_bounds.center().coords + shift).amax() > GROUND_FOLLOW_DISTANCE * rest_bounds.diagonal() {
        shift = bounds.center() - rest_bounds.center();
        shift[scene.up.index()] = -origin[scene.up.index()];
    }
    let shifted = |corner: [f64; 3]| std::array::from_fn(|axis| corner[axis] + shift[axis]);
    BoundingBox { min: shifted(rest_bounds.min), max: shifted(rest_bounds.max) }
}

/// Center of the ground below the scene, and the distance D over which the ground fades. D is 3.5 times the diagonal of
/// the scene or the camera's horizontal distance, whichever is larger. So the ground keeps at least exp(-(1 / 3.5)^2) =
/// 92 % of its color up to that distance. `up`: index of the up axis.
fn ground_center_and_fade(up: usize, rest_bounds: BoundingBox, eye: Vector3<f64>) -> (Vector3<f64>, f64) {
    let mut center = rest_bounds.center().coords;
    center[up] = rest_bounds.min[up];
    let mut offset = eye - center;
    offset[up] = 0.0;
    (center, 3.5 * rest_bounds.diagonal().max(offset.norm()).max(MIN_SIZE))
}

/// Matrix from (x, y, 1) in normalized device coordinates to the direction of a view ray in world space.
fn world_from_ndc(clip_from_camera: &Matrix4<f64>, camera_from_world: &Matrix4<f64>) -> Matrix4<f64> {
    let world_from_camera =
        camera_from_world.fixed_view::<3, 3>(0, 0).try_inverse().unwrap_or_else(nalgebra::Matrix3::identity);
    let mut camera_from_ndc = nalgebra::Matrix3::zeros();
    camera_from_ndc[(0, 0)] = 1.0 / clip_from_camera[(0, 0)];
    camera_from_ndc[(1, 1)] = 1.0 / clip_from_camera[(1, 1)];
    camera_from_ndc[(0, 2)] = clip_from_camera[(0, 2)] / clip_from_camera[(0, 0)];
    camera_from_ndc[(1, 2)] = clip_from_camera[(1, 2)] / clip_from_camera[(1, 1)];
    camera_from_ndc[(2, 2)] = -1.0;
    (world_from_camera * camera_from_ndc).to_homogeneous()
}

/// Boolean as a number for shaders.
const fn flag(condition: bool) -> f64 {
    if condition { 1.0 } else { 0.0 }
}

fn vec4_of(vector: Vector3<f64>, w: f64) -> [f32; 4] {
    [vector.x as f32, vector.y as f32, vector.z as f32, w as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::tests::squares;
    use modalcast_model::domain::Material;
    use modalcast_model::scene::{Camera, Lens, View};

    #[test]
    fn view_ray_passes_through_the_projected_point() {
        let view = View::LookAt { eye: [1.0, 2.0, 3.0], target: [0.2, 0.1, -0.4], up: [0.0, 1.0, 0.0] };
        let lens = Lens::Intrinsics { fx: 300.0, fy: 250.0, cx: 100.0, cy: 130.0 };
        let camera = Camera { view, lens, near: 0.1, far: 100.0 };
        let (clip_from_camera, camera_from_world) =
            (camera.clip_from_camera(320, 200, &BoundingBox::EMPTY), camera.camera_from_world());
        let point = nalgebra::Point3::new(0.3, -0.2, 0.7);
        let clip = clip_from_camera * camera_from_world * point.to_homogeneous();
        let ndc = Vector3::new(clip.x / clip.w, clip.y / clip.w, 1.0);
        let direction = world_from_ndc(&clip_from_camera, &camera_from_world).fixed_view::<3, 3>(0, 0) * ndc;
        let expected = (point.coords - camera.eye()).normalize();
        assert!((direction.normalize() - expected).norm() < 1e-12, "expected {expected}, got {direction}");
    }

    #[test]
    fn rest_bounds_follow_the_bounds_but_keep_their_height() {
        let scene = Scene::new(squares(vec![Material::default()])).expect("a valid scene");
        let rest_bounds = scene.rest_bounds;
        let shifted = |corner: [f64; 3]| [corner[0] + 3.0, corner[1] + 5.0, corner[2] - 7.0];
        let bounds = BoundingBox { min: shifted(rest_bounds.min), max: shifted(rest_bounds.max) };
        assert_eq!(rebased_rest_bounds(&scene, bounds, [0.0; 3]), rest_bounds, "expected no shift without an origin");
        let near_bounds = rebased_rest_bounds(&scene, bounds, [4.0, 8.0, -16.0]);
        let expected = |corner: [f64; 3]| [corner[0] - 4.0, corner[1] - 8.0, corner[2] + 16.0];
        assert_eq!(near_bounds, BoundingBox { min: expected(rest_bounds.min), max: expected(rest_bounds.max) });
        let rebased_rest_bounds = rebased_rest_bounds(&scene, bounds, [1024.0, 1e6, 0.0]);
        // y is the up axis.
        let expected = |corner: [f64; 3]| [corner[0] + 3.0, corner[1] - 1e6, corner[2] - 7.0];
        assert_eq!(rebased_rest_bounds, BoundingBox { min: expected(rest_bounds.min), max: expected(rest_bounds.max) });
    }

    #[test]
    fn depth_below_ground_is_exact_above_the_vertex_error() {
        let mut parts = squares(vec![Material::default()]);
        parts.unit = Some(0.5);
        let scene = Scene::new(parts.clone()).expect("a valid scene");
        parts.look.ground = None;
        let without_ground = Scene::new(parts).expect("a valid scene");
        let (bounds, tolerance) = (scene.rest_bounds, 1e-5 * scene.rest_bounds.diagonal());
        let params = |bounds| FrameParams {
            camera: Camera::fit_to_scene(&scene, 64, 64),
            width: 64,
            height: 64,
            bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        };
        // y is the up axis.
        let lowered = |depth: f64| BoundingBox { min: [bounds.min[0], bounds.min[1] - depth, bounds.min[2]], ..bounds };
        let depth = |bounds, origin| depth_below_ground(&scene, &params(bounds), origin);
        for (lowered_by, expected) in [(0.0, 0.0), (-1.0, 0.0), (0.9 * tolerance, 0.0), (3.0, 1.5)] {
            let got = depth(lowered(lowered_by), [0.0; 3]);
            assert!((got - expected).abs() < 1e-12, "{lowered_by} scene units: expected {expected} m, got {got} m");
        }
        assert!(depth(lowered(1.1 * tolerance), [0.0; 3]) > 0.0);
        // Bounds relative to an origin.
        assert_eq!([2.0, -2.0].map(|height| depth(bounds, [7.0, height, 7.0])), [0.0, 1.0]);
        assert_eq!(depth_below_ground(&without_ground, &params(lowered(3.0)), [0.0; 3]), 0.0);
        let not_finite = BoundingBox { min: [f64::NEG_INFINITY; 3], max: [f64::NAN; 3] };
        assert_eq!([depth(BoundingBox::EMPTY, [0.0; 3]), depth(not_finite, [0.0; 3])], [0.0; 2]);
    }

    #[test]
    fn replaces_overflowed_bounds_and_rejects_overflowed_cameras() {
        let scene = Scene::new(squares(vec![Material::default()])).expect("a valid scene");
        let mut params = FrameParams {
            camera: Camera::fit_to_scene(&scene, 64, 64),
            width: 64,
            height: 64,
            bounds: scene.rest_bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        };
        let uniforms = FrameUniforms::new(&scene, &scene.look, &params, [0.0; 3]).expect("finite uniforms");
        assert!(uniforms.eye[3] > 0.0, "expected a camera above the ground");
        for bounds in [BoundingBox::EMPTY, BoundingBox { min: [f64::NAN; 3], max: [f64::INFINITY; 3] }] {
            let replaced_uniforms =
                FrameUniforms::new(&scene, &scene.look, &FrameParams { bounds, ..params }, [0.0; 3])
                    .expect("finite uniforms");
            assert_eq!(replaced_uniforms, uniforms, "expected the rest bounds in place of overflowed ones");
        }
        let light_bounds = OrientedBounds(BoundingBox { min: [-0.25; 3], max: [0.25; 3] });
        let uniforms_with = |light_bounds| {
            FrameUniforms::new(
                &scene,
                &scene.look,
                &FrameParams { light_bounds: Some(light_bounds), ..params },
                [0.0; 3],
            )
            .expect("finite uniforms")
        };
        assert_ne!(uniforms_with(light_bounds), uniforms, "expected an effect of valid light bounds");
        for invalid_bounds in
            [OrientedBounds::EMPTY, light_bounds.expanded_by(f64::NAN), light_bounds.expanded_by(f64::INFINITY)]
        {
            assert_eq!(uniforms_with(invalid_bounds), uniforms, "{invalid_bounds:?}");
        }
        params.camera.view = View::LookAt { eye: [1e300, 0.0, 0.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        let error = FrameUniforms::new(&scene, &scene.look, &params, [0.0; 3]).expect_err("an overflow").to_string();
        assert!(error.starts_with("camera:"), "{error}");
    }
}
