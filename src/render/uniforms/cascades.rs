//! Cascades of a split shadow map. The view is cut by distance; each part but the last has a map of its own within the
//! box of the whole shadow map, and the last map is the whole box (parallel-split shadow maps, Zhang et al. 2006).

use bytemuck::{Pod, Zeroable};
use nalgebra::{Point3, Vector3};

use super::light_box::{LightBox, LightBoxParams, TexelSpan};
use crate::types::FrameParams;
use modalcast_model::scene::{Camera, Scene};

/// Weight of the logarithmic split scheme; the rest is the uniform scheme.
const SPLIT_LAMBDA: f64 = 0.5;
/// Smallest distance at which the first part begins, relative to the farthest point.
const MIN_NEAR_FRACTION: f64 = 1e-3;

/// Uniform block of the cascades. Twin of `SplitBlock` in `shaders/shared/shadow_cascades.glsl`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub(crate) struct ShadowCascades {
    scale_offsets: [[f32; 4]; 4],
    end_depths: [f32; 4],
}

const _: () =
    assert!(size_of::<ShadowCascades>() == 80, "ShadowCascades differs from shaders/shared/shadow_cascades.glsl");

impl ShadowCascades {
    /// Fits the cascades of one frame. `fit` is the input of the whole box, relative to `origin` like the positions.
    pub(crate) fn new(scene: &Scene, params: &FrameParams, fit: &LightBoxParams, origin: [f64; 3]) -> Self {
        let count = scene.look.shadow.unwrap_or_default().splits as usize;
        let whole = LightBox::fit(fit);
        let camera = params.camera.relative_to(origin);
        let (near, far) = visible_depth_range(&camera, fit);
        let ends = split_depths(near, far, count);
        let mut splits = Self { scale_offsets: [[1.0, 1.0, 0.0, 0.0]; 4], end_depths: [f32::INFINITY; 4] };
        let mut begin = near;
        for (part, end) in ends.into_iter().enumerate() {
            splits.end_depths[part] = end as f32;
            if let Some(sides) = fit_cascade(&whole, fit, &bounding_sphere(&camera, params, begin, end, fit)) {
                splits.scale_offsets[part] = cascade_transform(&whole.sides, &sides);
            }
            begin = end;
        }
        splits
    }
}

/// Nearest and farthest distance at which the camera can see a point of the bounds.
fn visible_depth_range(camera: &Camera, fit: &LightBoxParams) -> (f64, f64) {
    let view = camera.camera_from_world();
    let depths = fit.bounds.corners().map(|corner| -view.transform_point(&corner).z);
    let mut near = depths.into_iter().fold(f64::INFINITY, f64::min);
    let mut far = depths.into_iter().fold(f64::NEG_INFINITY, f64::max).max(1e-6);
    if camera.far > 0.0 {
        (near, far) = (near.max(camera.near), far.min(camera.far).max(camera.near));
    }
    (near.clamp(MIN_NEAR_FRACTION * far, far), far)
}

/// Practical split scheme: the mean of logarithmic and uniform splits. Returns the cuts between the parts.
fn split_depths(near: f64, far: f64, count: usize) -> Vec<f64> {
    let cut = |part: usize| {
        let share = part as f64 / count as f64;
        SPLIT_LAMBDA * near * (far / near).powf(share) + (1.0 - SPLIT_LAMBDA) * (near + (far - near) * share)
    };
    (1..count).map(cut).collect()
}

/// Bounding sphere of the view volume between two distances; its size does not change when the camera turns.
fn bounding_sphere(
    camera: &Camera,
    params: &FrameParams,
    begin: f64,
    end: f64,
    fit: &LightBoxParams,
) -> (Point3<f64>, f64) {
    let clip = camera.clip_from_camera(params.width, params.height, &fit.bounds);
    let world = camera.camera_from_world().try_inverse().unwrap_or_default();
    let corners: [Point3<f64>; 8] = std::array::from_fn(|corner| {
        let sign = |bit: usize| if corner >> bit & 1 == 0 { -1.0 } else { 1.0 };
        let depth = if corner < 4 { begin } else { end };
        let at = |axis: usize| depth * (sign(axis) + clip[(axis, 2)]) / clip[(axis, axis)];
        world.transform_point(&Point3::new(at(0), at(1), -depth))
    });
    let center = Point3::from(corners.iter().map(|corner| corner.coords).sum::<Vector3<f64>>() / 8.0);
    (center, corners.iter().map(|corner| (corner - center).norm()).fold(0.0, f64::max))
}

/// Sides of a cascade that encloses a sphere; none if it would not be finer than the whole map, or has no size.
fn fit_cascade(
    whole: &LightBox,
    fit: &LightBoxParams,
    (center, radius): &(Point3<f64>, f64),
) -> Option<[TexelSpan; 2]> {
    let sound = *radius > 0.0 && radius.is_finite() && center.coords.iter().all(|number| number.is_finite());
    let sides =
        sound.then(|| [0, 1].map(|axis: usize| TexelSpan::snap(whole.axes[axis].dot(&center.coords), *radius, fit)));
    sides.filter(|sides| sides.iter().zip(&whole.sides).all(|(part, whole)| part.half < whole.half))
}

/// Scale and offset from coordinates of the whole map to those of the cascade.
fn cascade_transform(whole: &[TexelSpan; 2], part: &[TexelSpan; 2]) -> [f32; 4] {
    let scale = [0, 1].map(|axis: usize| whole[axis].half / part[axis].half);
    let offset = [0, 1].map(|axis: usize| (whole[axis].low - part[axis].low) / (2.0 * part[axis].half));
    [scale[0] as f32, scale[1] as f32, offset[0] as f32, offset[1] as f32]
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::{BoundingBox, Lens, UpAxis, View};

    fn fit() -> LightBoxParams {
        let bounds = BoundingBox { min: [-50.0, 0.0, -50.0], max: [50.0, 5.0, 50.0] };
        let to_sun = Vector3::new(0.4, 0.8, 0.5).normalize();
        LightBoxParams { to_sun, up: UpAxis::Y, bounds, light: None, ground: Some(0.0), size: 512.0, rim: 6.0 }
    }

    fn params(turn: f64) -> FrameParams {
        let eye = [0.0, 2.0, 20.0];
        let view = View::LookAt { eye, target: [turn.sin(), 2.0, 20.0 - turn.cos()], up: [0.0, 1.0, 0.0] };
        let camera = Camera { view, lens: Lens::FieldOfView(40.0), near: 0.1, far: 80.0 };
        FrameParams { camera, width: 160, height: 90, bounds: fit().bounds, light: None }
    }

    #[test]
    fn the_view_is_cut_half_by_ratios_and_half_by_lengths() {
        assert_eq!(split_depths(1.0, 16.0, 2), [6.25], "the mean of 4 and 8.5");
        let split_depths = split_depths(1.0, 81.0, 4);
        let want = [3.0, 9.0, 27.0].iter().zip([21.0, 41.0, 61.0]).map(|(ratio, even)| 0.5 * (ratio + even));
        assert!(split_depths.iter().zip(want).all(|(cut, want)| (cut - want).abs() < 1e-12), "{split_depths:?}");
    }

    #[test]
    fn a_part_holds_all_that_is_seen_of_it_and_keeps_its_texels_when_the_camera_turns_and_walks() {
        let (fit, whole) = (fit(), LightBox::fit(&fit()));
        let place = |params: &FrameParams| {
            fit_cascade(&whole, &fit, &bounding_sphere(&params.camera, params, 2.0, 8.0, &fit)).expect("smaller")
        };
        let first = place(&params(0.0));
        for step in 0..100 {
            let mut params = params(0.03 * f64::from(step));
            let (center, radius) = bounding_sphere(&params.camera, &params, 2.0, 8.0, &fit);
            let View::LookAt { eye, target, .. } = &mut params.camera.view else { continue };
            (eye[0], target[0]) = (eye[0] + 0.013 * f64::from(step), target[0] + 0.013 * f64::from(step));
            let moved = place(&params);
            for axis in 0..2 {
                assert_eq!(moved[axis].half, first[axis].half, "the size of a ball does not hang on where it is");
                let texel = 2.0 * first[axis].half / fit.size;
                let shift = (moved[axis].low - first[axis].low) / texel;
                assert!((shift - shift.round()).abs() < 1e-6, "moves by {shift} texels");
                let across = whole.axes[axis].dot(&center.coords);
                let still = fit_cascade(&whole, &fit, &(center, radius)).expect("smaller")[axis];
                assert!((across - still.low - still.half).abs() + radius < still.half);
            }
        }
    }

    #[test]
    fn extreme_cameras_leave_finite_parts_inside_the_whole() {
        let scene = |splits: u32| {
            let mut parts =
                crate::scene_data::geometry::tests::squares(vec![modalcast_model::domain::Material::default()]);
            parts.look.shadow = Some(modalcast_model::scene::ShadowSettings { splits, ..Default::default() });
            Scene::new(parts).expect("good")
        };
        let turned = |near: f64, far: f64, eye: [f64; 3]| {
            let view = View::LookAt { eye, target: [eye[0], eye[1], eye[2] - 1.0], up: [0.0, 1.0, 0.0] };
            FrameParams { camera: Camera { view, lens: Lens::FieldOfView(100.0), near, far }, ..params(0.0) }
        };
        let point = BoundingBox { min: [5.0; 3], max: [5.0; 3] };
        for params in [turned(1e-6, 1e9, [0.0; 3]), turned(0.0, 0.0, [0.0, 0.0, -900.0]), turned(0.0, 0.0, [1e9; 3])] {
            for bounds in [fit().bounds, point] {
                let splits = ShadowCascades::new(&scene(4), &params, &LightBoxParams { bounds, ..fit() }, [0.0; 3]);
                assert!(splits.scale_offsets.iter().flatten().all(|number| number.is_finite()), "{splits:?}");
                assert!(
                    splits.end_depths[..3].iter().all(|depth| depth.is_finite()) && splits.end_depths[..3].is_sorted()
                );
                assert_eq!(splits.scale_offsets[3], [1.0, 1.0, 0.0, 0.0], "the last is the whole");
            }
        }
    }
}
