//! Cascades of a split shadow map (parallel-split shadow maps, Zhang et al. 2006). The view volume is split by depth.
//! Each part has a cascade: a map of the part of the light box (`light_box`) that casts shadows there. The last cascade
//! covers the whole light box. All depths are distances from the camera along the view axis, in scene units.

use bytemuck::{Pod, Zeroable};
use nalgebra::{Point3, Vector3};

use super::MIN_SIZE;
use super::light_box::{LightBox, LightBoxParams, TexelSpan};
use crate::types::FrameParams;
use modalcast_model::scene::{Camera, Scene};

/// Weight of the logarithmic split scheme; the uniform scheme has the remaining weight.
const SPLIT_LAMBDA: f64 = 0.5;
/// Minimum depth at which the first part begins, relative to the depth of the farthest point.
const MIN_NEAR_FRACTION: f64 = 1e-3;

/// Uniform block of the cascades. Twin of `CascadeBlock` in `shaders/shared/shadow_cascades.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct ShadowCascades {
    /// Per cascade: the map from coordinates of the whole map to those of the cascade. x, y: scale. z, w: offset.
    scale_offsets: [[f32; 4]; 4],
    /// Per cascade: depth at which it ends; infinite for the last cascade.
    end_depths: [f32; 4],
}

const _: () =
    assert!(size_of::<ShadowCascades>() == 80, "ShadowCascades differs from shaders/shared/shadow_cascades.glsl");

impl ShadowCascades {
    /// Fits the cascades of one frame. `box_params` and the positions are relative to `origin`.
    pub(crate) fn new(scene: &Scene, params: &FrameParams, box_params: &LightBoxParams, origin: [f64; 3]) -> Self {
        let count = scene.look.shadow.unwrap_or_default().cascades as usize;
        let whole_box = LightBox::fit(box_params);
        let camera = params.camera.relative_to(origin);
        let (min_depth, max_depth) = visible_depth_range(&camera, box_params);
        let depths = split_depths(min_depth, max_depth, count);
        let mut cascades = Self { scale_offsets: [[1.0, 1.0, 0.0, 0.0]; 4], end_depths: [f32::INFINITY; 4] };
        let mut near_depth = min_depth;
        for (cascade, far_depth) in depths.into_iter().enumerate() {
            cascades.end_depths[cascade] = far_depth as f32;
            if let Some(sides) = fit_cascade(
                &whole_box,
                box_params,
                &bounding_sphere(&camera, params, near_depth, far_depth, box_params),
            ) {
                cascades.scale_offsets[cascade] = cascade_transform(&whole_box.sides, &sides);
            }
            near_depth = far_depth;
        }
        cascades
    }
}

/// Minimum and maximum depth at which the camera can see a point of the bounds.
fn visible_depth_range(camera: &Camera, box_params: &LightBoxParams) -> (f64, f64) {
    let view = camera.camera_from_world();
    let depths = box_params.bounds.corners().map(|corner| -view.transform_point(&corner).z);
    let mut near = depths.into_iter().fold(f64::INFINITY, f64::min);
    // Positive, as the logarithmic scheme needs it.
    let mut far = depths.into_iter().fold(f64::NEG_INFINITY, f64::max).max(MIN_SIZE);
    // A camera with far = 0 has no far plane; the cascades cover the bounds.
    if camera.far > 0.0 {
        (near, far) = (near.max(camera.near), far.min(camera.far).max(camera.near));
    }
    (near.clamp(MIN_NEAR_FRACTION * far, far), far)
}

/// Practical split scheme: the mean of logarithmic and uniform splits. Returns the depths between the parts.
fn split_depths(near: f64, far: f64, count: usize) -> Vec<f64> {
    let split_depth = |part: usize| {
        let fraction = part as f64 / count as f64;
        SPLIT_LAMBDA * near * (far / near).powf(fraction) + (1.0 - SPLIT_LAMBDA) * (near + (far - near) * fraction)
    };
    (1..count).map(split_depth).collect()
}

/// Center and radius of the bounding sphere of the view volume between two depths. The radius does not depend on the
/// direction of the camera.
fn bounding_sphere(
    camera: &Camera,
    params: &FrameParams,
    near_depth: f64,
    far_depth: f64,
    box_params: &LightBoxParams,
) -> (Point3<f64>, f64) {
    let clip_from_camera = camera.clip_from_camera(params.width, params.height, &box_params.bounds);
    let world_from_camera = camera.camera_from_world().try_inverse().unwrap_or_default();
    let corners: [Point3<f64>; 8] = std::array::from_fn(|corner| {
        let sign = |bit: usize| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
        let depth = if corner < 4 { near_depth } else { far_depth };
        // Inverse of the projection matrix P = clip_from_camera, with ndc = -1 or 1:
        // depth * ndc = P[axis][axis] * coordinate - P[axis][2] * depth.
        let coordinate =
            |axis: usize| depth * (sign(axis) + clip_from_camera[(axis, 2)]) / clip_from_camera[(axis, axis)];
        world_from_camera.transform_point(&Point3::new(coordinate(0), coordinate(1), -depth))
    });
    let center = Point3::from(corners.iter().map(|corner| corner.coords).sum::<Vector3<f64>>() / 8.0);
    (center, corners.iter().map(|corner| (corner - center).norm()).fold(0.0, f64::max))
}

/// Sides of a cascade that encloses a sphere, given by center and radius. None if the cascade would not be finer than
/// the whole map, or if the sphere is not finite.
fn fit_cascade(
    whole_box: &LightBox,
    box_params: &LightBoxParams,
    (center, radius): &(Point3<f64>, f64),
) -> Option<[TexelSpan; 2]> {
    let is_finite = *radius > 0.0 && radius.is_finite() && center.coords.iter().all(|number| number.is_finite());
    let sides = is_finite.then(|| {
        [0, 1].map(|axis: usize| TexelSpan::snap(whole_box.axes[axis].dot(&center.coords), *radius, box_params))
    });
    sides.filter(|sides| {
        sides.iter().zip(&whole_box.sides).all(|(side, whole_side)| side.half_length < whole_side.half_length)
    })
}

/// Scale and offset from coordinates of the whole map to those of the cascade, as in [`ShadowCascades`]. A point at p
/// on an axis has the map coordinate (p - low) / (2 half_length).
fn cascade_transform(whole_sides: &[TexelSpan; 2], cascade_sides: &[TexelSpan; 2]) -> [f32; 4] {
    let scale = [0, 1].map(|axis: usize| whole_sides[axis].half_length / cascade_sides[axis].half_length);
    let offset = [0, 1]
        .map(|axis: usize| (whole_sides[axis].low - cascade_sides[axis].low) / (2.0 * cascade_sides[axis].half_length));
    [scale[0] as f32, scale[1] as f32, offset[0] as f32, offset[1] as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::{BoundingBox, Lens, UpAxis, View};

    fn box_params() -> LightBoxParams {
        let bounds = BoundingBox { min: [-50.0, 0.0, -50.0], max: [50.0, 5.0, 50.0] };
        let to_sun = Vector3::new(0.4, 0.8, 0.5).normalize();
        LightBoxParams {
            to_sun,
            up: UpAxis::Y,
            bounds,
            light_bounds: None,
            ground: Some(0.0),
            size: 512.0,
            margin: 6.0,
        }
    }

    fn params(angle: f64) -> FrameParams {
        let eye = [0.0, 2.0, 20.0];
        let view = View::LookAt { eye, target: [angle.sin(), 2.0, 20.0 - angle.cos()], up: [0.0, 1.0, 0.0] };
        let camera = Camera { view, lens: Lens::FieldOfView(40.0), near: 0.1, far: 80.0 };
        FrameParams {
            camera,
            width: 160,
            height: 90,
            bounds: box_params().bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        }
    }

    #[test]
    fn split_depths_are_the_mean_of_both_split_schemes() {
        assert_eq!(split_depths(1.0, 16.0, 2), [6.25], "the mean of 4 and 8.5");
        let split_depths = split_depths(1.0, 81.0, 4);
        let (logarithmic, uniform) = ([3.0, 9.0, 27.0], [21.0, 41.0, 61.0]);
        let expected = logarithmic.iter().zip(uniform).map(|(a, b)| 0.5 * (a + b));
        assert!(
            split_depths.iter().zip(expected).all(|(depth, expected)| (depth - expected).abs() < 1e-12),
            "{split_depths:?}"
        );
    }

    #[test]
    fn cascade_encloses_its_part_and_moves_by_whole_texels() {
        let (box_params, whole_box) = (box_params(), LightBox::fit(&box_params()));
        let fit_at = |params: &FrameParams| {
            fit_cascade(&whole_box, &box_params, &bounding_sphere(&params.camera, params, 2.0, 8.0, &box_params))
                .expect("a cascade")
        };
        let first_sides = fit_at(&params(0.0));
        // A camera that turns, and moves along x.
        for step in 0..100 {
            let mut params = params(0.03 * f64::from(step));
            let (center, radius) = bounding_sphere(&params.camera, &params, 2.0, 8.0, &box_params);
            let View::LookAt { eye, target, .. } = &mut params.camera.view else { continue };
            (eye[0], target[0]) = (eye[0] + 0.013 * f64::from(step), target[0] + 0.013 * f64::from(step));
            let sides = fit_at(&params);
            for axis in 0..2 {
                assert_eq!(
                    sides[axis].half_length, first_sides[axis].half_length,
                    "expected the same size for all camera positions"
                );
                let texel = 2.0 * first_sides[axis].half_length / box_params.size;
                let shift = (sides[axis].low - first_sides[axis].low) / texel;
                assert!((shift - shift.round()).abs() < 1e-6, "expected a whole number of texels, got {shift}");
                // The sphere of the camera before its move must lie inside its cascade.
                let center_coordinate = whole_box.axes[axis].dot(&center.coords);
                let unmoved_side = fit_cascade(&whole_box, &box_params, &(center, radius)).expect("a cascade")[axis];
                assert!(
                    (center_coordinate - unmoved_side.low - unmoved_side.half_length).abs() + radius
                        < unmoved_side.half_length
                );
            }
        }
    }

    #[test]
    fn extreme_cameras_give_finite_cascades() {
        let scene = |cascades: u32| {
            let mut parts =
                crate::scene_data::geometry::tests::squares(vec![modalcast_model::domain::Material::default()]);
            parts.look.shadow = Some(modalcast_model::scene::ShadowSettings { cascades, ..Default::default() });
            Scene::new(parts).expect("a valid scene")
        };
        let params_with = |near: f64, far: f64, eye: [f64; 3]| {
            let view = View::LookAt { eye, target: [eye[0], eye[1], eye[2] - 1.0], up: [0.0, 1.0, 0.0] };
            FrameParams { camera: Camera { view, lens: Lens::FieldOfView(100.0), near, far }, ..params(0.0) }
        };
        let point = BoundingBox { min: [5.0; 3], max: [5.0; 3] };
        // Near and far 0: the planes are fitted to the bounds.
        for params in [
            params_with(1e-6, 1e9, [0.0; 3]),
            params_with(0.0, 0.0, [0.0, 0.0, -900.0]),
            params_with(0.0, 0.0, [1e9; 3]),
        ] {
            for bounds in [box_params().bounds, point] {
                let cascades =
                    ShadowCascades::new(&scene(4), &params, &LightBoxParams { bounds, ..box_params() }, [0.0; 3]);
                assert!(cascades.scale_offsets.iter().flatten().all(|number| number.is_finite()), "{cascades:?}");
                assert!(
                    cascades.end_depths[..3].iter().all(|depth| depth.is_finite())
                        && cascades.end_depths[..3].is_sorted()
                );
                assert_eq!(
                    cascades.scale_offsets[3],
                    [1.0, 1.0, 0.0, 0.0],
                    "expected the whole box in the last cascade"
                );
            }
        }
    }
}
