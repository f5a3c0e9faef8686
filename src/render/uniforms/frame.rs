//! Per-frame uniforms, computed in f64 and rounded to f32 at the end.

use bytemuck::{Pod, Zeroable};
use nalgebra::{Matrix4, Vector3};

use super::light_box::{LightBox, LightBoxParams};
use crate::types::FrameParams;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{BoundingBox, OrientedBounds, Scene};

/// Uniform block of a frame; matrices are column-major. Twin of `FrameBlock` in `shaders/shared/frame.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct FrameUniforms {
    clip_from_world: [[f32; 4]; 4],
    shadow_from_world: [[f32; 4]; 4],
    world_from_ndc: [[f32; 4]; 4],
    eye: [f32; 4],
    to_sun: [f32; 4],
    sunlight: [f32; 4],
    skylight: [f32; 4],
    zenith: [f32; 4],
    horizon: [f32; 4],
    up: [f32; 4],
    ground: [f32; 4],
    ground_center: [f32; 4],
    shadow: [f32; 4],
    shadow_ground_plane: [f32; 4],
}

const _: () = assert!(size_of::<FrameUniforms>() == 368, "FrameUniforms differs from shaders/shared/frame.glsl");

/// The ground fades by exp(-(d / D)^2) and is drawn up to this multiple of D, where it equals the horizon color to the
/// last bit.
const GROUND_EXTENT: f64 = 6.0;

/// Tolerance for vertices that count as lying on the ground, in f32::EPSILON of the largest coordinate: positions are
/// sums in f32. The rasterized ground is drawn behind surfaces in its plane by as many roundings of depth plus its
/// depth slope per pixel (`PipelineState::behind`).
const GROUND_TOLERANCE_EPSILONS: f64 = 4.0;

impl FrameUniforms {
    /// Computes the uniforms of one frame. Positions are relative to `origin`, a point in scene units from the scene's
    /// origin; it is subtracted from the camera in f64.
    ///
    /// # Errors
    /// `Invalid` when the camera's matrices overflow.
    pub(crate) fn new(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> Result<Self> {
        let bounds = finite_bounds(scene, params);
        let rebased_rest_bounds = rebased_rest_bounds(scene, bounds, origin);
        let look = &scene.look;
        let to_sun = look.to_sun(scene.up);
        let height = rebased_rest_bounds.min[scene.up.index()];
        let shadow = look.shadow.unwrap_or_default();
        let light = LightBox::fit(&light_box_params(scene, params, origin));
        let viewer = params.camera.relative_to(origin);
        let camera = viewer.camera_from_world();
        let clip = clip_from_camera(scene, params, origin);
        let (center, fade) = ground_disc(scene.up.index(), rebased_rest_bounds, viewer.eye());
        let color = |[r, g, b]: [f32; 3], fourth: f64| [r, g, b, fourth as f32];
        let frame = Self {
            clip_from_world: (clip * camera).cast().into(),
            shadow_from_world: light.shadow_from_world.cast().into(),
            world_from_ndc: world_from_ndc(&clip, &camera).cast().into(),
            eye: vec4_of(viewer.eye(), flag(look.ground.is_some() && camera_is_above_ground(scene, params))),
            to_sun: vec4_of(to_sun, flag(!ground_is_behind_scene(scene, params, origin))),
            sunlight: color(look.sunlight, 0.0),
            skylight: color(look.skylight, 0.0),
            zenith: color(look.zenith, 0.0),
            horizon: color(look.horizon, 0.0),
            up: vec4_of(scene.up.vector(), height),
            ground: color(look.ground.unwrap_or_default().color, fade),
            ground_center: vec4_of(center, GROUND_EXTENT * fade),
            shadow: [
                shadow.least_variance.max(shadow.variance_floor()),
                shadow.bleeding,
                shadow.alpha_threshold,
                shadow.size as f32,
            ],
            shadow_ground_plane: vec4_of(light.ground.into(), light.texel(f64::from(shadow.size))),
        };
        let numbers: &[f32] = bytemuck::cast_slice(std::slice::from_ref(&frame));
        match numbers.iter().all(|number| number.is_finite()) {
            true => Ok(frame),
            false => Err(invalid("camera", "a camera whose matrices are finite", format!("{:?}", params.camera))),
        }
    }

    /// Whether the view ray through (x, y) in normalized device coordinates meets the ground. Used for samples without
    /// an id, whose ground was not rasterized. Twin of `ray_hits_ground` in `shaders/shared/ground_plane.glsl`.
    pub(crate) fn ray_hits_ground(&self, image: [f64; 2]) -> bool {
        let vector = |four: [f32; 4]| Vector3::new(four[0], four[1], four[2]).cast::<f64>();
        let [x, y, one] = [0, 1, 2].map(|column| vector(self.world_from_ndc[column]));
        let (direction, eye, up) = (x * image[0] + y * image[1] + one, vector(self.eye), vector(self.up));
        let (fall, above) = (-direction.dot(&up), eye.dot(&up) - f64::from(self.up[3]));
        let aside = eye - vector(self.ground_center) + direction * (above / fall);
        let aside = aside - up * aside.dot(&up);
        let in_square = aside.iter().all(|side| side.abs() <= f64::from(self.ground_center[3]));
        self.eye[3] > 0.0 && fall > 0.0 && above > 0.0 && in_square
    }
}

/// The camera's projection matrix for positions relative to `origin`. The depth range covers both the deformed and the
/// rest state, so that the clip planes do not jump when a branch bends.
fn clip_from_camera(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> Matrix4<f64> {
    let bounds = finite_bounds(scene, params);
    let viewer = params.camera.relative_to(origin);
    viewer.clip_from_camera(params.width, params.height, &bounds.union(rebased_rest_bounds(scene, bounds, origin)))
}

/// Clip space of a frame from positions relative to `origin`.
pub(crate) fn clip_from_positions(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> Matrix4<f64> {
    clip_from_camera(scene, params, origin) * params.camera.relative_to(origin).camera_from_world()
}

/// Clip space of the shadow map from positions relative to `origin`. The sun looks along z; z = -1 is nearest to it.
pub(crate) fn shadow_clip_from_positions(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> Matrix4<f64> {
    let map = LightBox::fit(&light_box_params(scene, params, origin)).shadow_from_world;
    Matrix4::new_translation(&Vector3::repeat(-1.0)) * Matrix4::new_scaling(2.0) * map
}

/// The bounds of a frame, or the rest bounds when those overflowed: overflowed bounds fit no shadow map and no depth
/// range.
fn finite_bounds(scene: &Scene, params: &FrameParams) -> BoundingBox {
    let finite_bounds = params.bounds.is_finite() && params.bounds.min[0] <= params.bounds.max[0];
    if finite_bounds { params.bounds } else { scene.rest_bounds }
}

/// Light-space bounds of a frame; none when they or the world-space bounds overflowed.
fn finite_light_bounds(params: &FrameParams) -> Option<OrientedBounds> {
    params.light.filter(|light| light.is_valid() && params.bounds.is_finite())
}

/// Inputs of the shadow map fit, relative to `origin` like the positions.
pub(crate) fn light_box_params(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> LightBoxParams {
    let bounds = finite_bounds(scene, params);
    let height = rebased_rest_bounds(scene, bounds, origin).min[scene.up.index()];
    let shadow = scene.look.shadow.unwrap_or_default();
    LightBoxParams {
        to_sun: scene.look.to_sun(scene.up),
        up: scene.up,
        bounds,
        light: finite_light_bounds(params),
        ground: scene.look.ground.map(|_| height),
        size: f64::from(shadow.size),
        rim: f64::from(shadow.blur_radius()) + 1.0,
    }
}

/// Texel of the shadow map in world space: two vectors perpendicular to the light, along x and y of the map, in scene
/// units. None when the look has no shadow. Valid for positions relative to the scene's origin.
pub fn shadow_texel_axes(scene: &Scene, params: &FrameParams) -> Option<[Vector3<f64>; 2]> {
    let shadow = scene.look.shadow?;
    let map = LightBox::fit(&light_box_params(scene, params, [0.0; 3])).shadow_from_world;
    let texel = |row: usize| {
        let across = map.fixed_view::<1, 3>(row, 0).transpose();
        across / (across.norm_squared() * f64::from(shadow.size))
    };
    Some([texel(0), texel(1)])
}

/// Matrix from world space to the clip space of the shadow map. The sun looks along z; z = -1 is nearest to it. None
/// when the look has no shadow. Valid for positions relative to the scene's origin.
pub fn shadow_clip_from_world(scene: &Scene, params: &FrameParams) -> Option<Matrix4<f64>> {
    scene.look.shadow.map(|_| shadow_clip_from_positions(scene, params, [0.0; 3]))
}

/// Whether the camera is above the ground; the ground is not visible from below.
pub(crate) fn camera_is_above_ground(scene: &Scene, params: &FrameParams) -> bool {
    let up = scene.up.index();
    params.camera.eye()[up] > scene.rest_bounds.min[up]
}

/// Whether the ground is behind everything else: the camera is above it and no vertex is below it. Samples without an
/// id that look down then see the ground, and it need not be rasterized.
pub(crate) fn ground_is_behind_scene(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> bool {
    let (up, bounds) = (scene.up.index(), params.bounds);
    let height = rebased_rest_bounds(scene, bounds, origin).min[up];
    let largest = [height, bounds.min[up], bounds.max[up]].map(f64::abs).into_iter().fold(0.0, f64::max);
    let lowest = bounds.min[up] + GROUND_TOLERANCE_EPSILONS * f64::from(f32::EPSILON) * largest;
    scene.look.ground.is_some() && camera_is_above_ground(scene, params) && bounds.is_finite() && lowest >= height
}

/// The rest bounds in the coordinates of the positions. When positions have another origin than the scene, because the
/// scene moved far from its origin, the rest bounds move along to the current center; the ground keeps its height.
fn rebased_rest_bounds(scene: &Scene, bounds: BoundingBox, origin: [f64; 3]) -> BoundingBox {
    let rest = scene.rest_bounds;
    if origin == [0.0; 3] {
        return rest;
    }
    let mut shift = bounds.center() - rest.center();
    shift[scene.up.index()] = -origin[scene.up.index()];
    let moved = |corner: [f64; 3]| std::array::from_fn(|axis| corner[axis] + shift[axis]);
    BoundingBox { min: moved(rest.min), max: moved(rest.max) }
}

/// Center of the ground below the scene, and the distance D over which it fades.
fn ground_disc(up: usize, rebased_rest_bounds: BoundingBox, eye: Vector3<f64>) -> (Vector3<f64>, f64) {
    let mut center = rebased_rest_bounds.center().coords;
    center[up] = rebased_rest_bounds.min[up];
    let mut aside = eye - center;
    aside[up] = 0.0;
    (center, 3.5 * rebased_rest_bounds.diagonal().max(aside.norm()).max(1e-6))
}

/// Normalized device coordinates (x, y, 1) to a direction in world space.
fn world_from_ndc(clip: &Matrix4<f64>, camera: &Matrix4<f64>) -> Matrix4<f64> {
    let world_from_camera = camera.fixed_view::<3, 3>(0, 0).try_inverse().unwrap_or_else(nalgebra::Matrix3::identity);
    let mut camera_from_image = nalgebra::Matrix3::zeros();
    camera_from_image[(0, 0)] = 1.0 / clip[(0, 0)];
    camera_from_image[(1, 1)] = 1.0 / clip[(1, 1)];
    camera_from_image[(0, 2)] = clip[(0, 2)] / clip[(0, 0)];
    camera_from_image[(1, 2)] = clip[(1, 2)] / clip[(1, 1)];
    camera_from_image[(2, 2)] = -1.0;
    (world_from_camera * camera_from_image).to_homogeneous()
}

const fn flag(on: bool) -> f64 {
    if on { 1.0 } else { 0.0 }
}

fn vec4_of(vector: Vector3<f64>, fourth: f64) -> [f32; 4] {
    [vector.x as f32, vector.y as f32, vector.z as f32, fourth as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::tests::squares;
    use modalcast_model::domain::Material;
    use modalcast_model::scene::{Camera, Lens, View};

    #[test]
    fn a_direction_through_a_pixel_meets_the_point_that_projects_there() {
        let view = View::LookAt { eye: [1.0, 2.0, 3.0], target: [0.2, 0.1, -0.4], up: [0.0, 1.0, 0.0] };
        let lens = Lens::Intrinsics { fx: 300.0, fy: 250.0, cx: 100.0, cy: 130.0 };
        let camera = Camera { view, lens, near: 0.1, far: 100.0 };
        let (clip, from_world) = (camera.clip_from_camera(320, 200, &BoundingBox::EMPTY), camera.camera_from_world());
        let point = nalgebra::Point3::new(0.3, -0.2, 0.7);
        let image = (clip * from_world * point.to_homogeneous()).scale(1.0);
        let image = Vector3::new(image.x / image.w, image.y / image.w, 1.0);
        let direction = world_from_ndc(&clip, &from_world).fixed_view::<3, 3>(0, 0) * image;
        let expected = (point.coords - camera.eye()).normalize();
        assert!((direction.normalize() - expected).norm() < 1e-12, "{direction} is not {expected}");
    }

    #[test]
    fn a_scene_that_left_for_good_rests_where_it_is_and_its_ground_stays_at_its_height() {
        let scene = Scene::new(squares(vec![Material::default()])).expect("good");
        let rest = scene.rest_bounds;
        let moved = |corner: [f64; 3]| [corner[0] + 3.0, corner[1] + 5.0, corner[2] - 7.0];
        let bounds = BoundingBox { min: moved(rest.min), max: moved(rest.max) };
        assert_eq!(rebased_rest_bounds(&scene, bounds, [0.0; 3]), rest, "a scene at its origin rests where it rested");
        let rebased_rest_bounds = rebased_rest_bounds(&scene, bounds, [1024.0, 2048.0, 0.0]);
        let want = |corner: [f64; 3]| [corner[0] + 3.0, corner[1] - 2048.0, corner[2] - 7.0];
        assert_eq!(rebased_rest_bounds, BoundingBox { min: want(rest.min), max: want(rest.max) });
    }

    #[test]
    fn the_ground_is_last_where_nothing_lies_below_it_by_more_than_rounding_and_the_camera_is_above() {
        let scene = Scene::new(squares(vec![Material::default()])).expect("good");
        let (rest, up) = (scene.rest_bounds, scene.up.index());
        let largest = rest.min[up].abs().max(rest.max[up].abs());
        let is_last = |lowered: f64, raised: f64, origin: f64| {
            let camera = Camera::fit_to_scene(&scene, 64, 64);
            let mut params = FrameParams { camera, width: 64, height: 64, bounds: rest, light: None };
            params.bounds.min[up] -= lowered + origin;
            params.bounds.max[up] -= origin;
            let mut eye = [0.3, 0.4, 0.5];
            eye[up] = rest.min[up] + raised;
            params.camera.view = View::LookAt { eye, target: [0.1; 3], up: [0.6, 0.8, 0.0] };
            let mut from = [0.0; 3];
            from[up] = origin;
            ground_is_behind_scene(&scene, &params, from)
        };
        assert!(is_last(0.0, 1.0, 0.0) && is_last(-0.1, 1.0, 0.0) && is_last(0.0, 1.0, 4096.0));
        assert!(is_last(2e-7 * largest, 1.0, 0.0), "rounding");
        assert!(!is_last(1e-6 * largest, 1.0, 0.0) && !is_last(1e-2, 1.0, 4096.0), "below");
        assert!(!is_last(0.0, 0.0, 0.0) && !is_last(0.0, -1.0, 0.0), "the camera is not above");
    }

    #[test]
    fn bounds_that_overflowed_are_replaced_and_a_camera_that_overflows_is_refused() {
        let scene = Scene::new(squares(vec![Material::default()])).expect("good");
        let mut params = FrameParams {
            camera: Camera::fit_to_scene(&scene, 64, 64),
            width: 64,
            height: 64,
            bounds: scene.rest_bounds,
            light: None,
        };
        let good = FrameUniforms::new(&scene, &params, [0.0; 3]).expect("good");
        let [x, y, z, may_hide] = good.to_sun;
        assert!(may_hide == 0.0 && good.eye[3] > 0.0, "nothing is below the ground");
        for bounds in [BoundingBox::EMPTY, BoundingBox { min: [f64::NAN; 3], max: [f64::INFINITY; 3] }] {
            let replaced = FrameUniforms::new(&scene, &FrameParams { bounds, ..params }, [0.0; 3]).expect("replaced");
            assert_eq!(replaced, FrameUniforms { to_sun: [x, y, z, 1.0], ..good }, "what overflowed may be below it");
        }
        let measured = OrientedBounds(BoundingBox { min: [-0.25; 3], max: [0.25; 3] });
        let with =
            |light| FrameUniforms::new(&scene, &FrameParams { light: Some(light), ..params }, [0.0; 3]).expect("good");
        assert_ne!(with(measured), good, "control: what was measured decides");
        for lost in [OrientedBounds::EMPTY, measured.expanded_by(f64::NAN), measured.expanded_by(f64::INFINITY)] {
            assert_eq!(with(lost), good, "{lost:?}");
        }
        params.camera.view = View::LookAt { eye: [1e300, 0.0, 0.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        let refusal = FrameUniforms::new(&scene, &params, [0.0; 3]).expect_err("overflows").to_string();
        assert!(refusal.starts_with("camera:"), "{refusal}");
    }
}
