//! Fits the shadow map to the deformed scene: a box in light space, and the matrix from world space to the map (section
//! 3.3.1 of the thesis).
//!
//! The z axis of light space is v_l, the direction to the sun; its y axis points up in the world. The box is
//! axis-aligned in light space and symmetric about its center in x and y. It encloses the light-space bounds of the
//! vertices, or, in frames without these bounds, the corners of the world-space bounds, as in the thesis. The far plane
//! is moved until the box contains the whole shadow on the ground. All sides are quantized to steps that are fixed in
//! the world, so that shadow edges do not crawl while the scene sways.

use nalgebra::{Matrix4, Vector3};

use super::MIN_SIZE;
use modalcast_model::scene::{BoundingBox, OrientedBounds, UpAxis, light_axes};

/// Maximum distance from the near plane to the ground at the corners of the map, in diagonals of the bounds. Without
/// this limit, a grazing sun would move the far plane to infinity. Points beyond the far plane are still shaded
/// correctly.
const MAX_GROUND_DEPTH: f64 = 8.0;

/// The fitted shadow map.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LightBox {
    /// World space to the map: x and y are 0 to 1 across the map; z is 0 at the plane nearest to the sun and 1 at the
    /// farthest plane.
    pub(crate) shadow_from_world: Matrix4<f64>,
    /// Coefficients a, b and c of the depth of the ground at (x, y) of the map: a x + b y + c; (0, 0, 1) without a
    /// ground.
    pub(crate) ground: [f64; 3],
    /// Axes x, y and z of light space.
    pub(crate) axes: [Vector3<f64>; 3],
    /// Extent of the map along x and y of light space.
    pub(crate) sides: [TexelSpan; 2],
}

/// Inputs of [`LightBox::fit`].
#[derive(Debug, Clone, Copy)]
pub(crate) struct LightBoxParams {
    pub(crate) to_sun: Vector3<f64>,
    pub(crate) up: UpAxis,
    pub(crate) bounds: BoundingBox,
    /// Light-space bounds of the same vertices; without them, the corners of `bounds` are used.
    pub(crate) light_bounds: Option<OrientedBounds>,
    /// Height of the ground along the up axis.
    pub(crate) ground: Option<f64>,
    /// Side of the map in texels.
    pub(crate) size: f64,
    /// Empty margin of the map that the blur needs, in texels.
    pub(crate) margin: f64,
}

/// Extent of a map along one axis, on a texel grid that is fixed in the world. When the bounds grow or move, the length
/// changes in few discrete steps, and the span moves by whole texels. So shadows do not crawl.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TexelSpan {
    /// Lower end, as a coordinate along the axis in scene units.
    pub(crate) low: f64,
    pub(crate) half_length: f64,
}

impl TexelSpan {
    /// The smallest quantized span whose part inside the margin covers `half_extent` to each side of `center`.
    pub(crate) fn snap(center: f64, half_extent: f64, params: &LightBoxParams) -> Self {
        let half_length = next_length_step(half_extent) * params.size / (params.size - 2.0 * params.margin).max(1.0);
        let texel_side = 2.0 * half_length / params.size;
        Self { low: (center / texel_side).round() * texel_side - half_length, half_length }
    }
}

/// Next larger quantized length. The step is a sixteenth of the largest power of two that is at most `length`.
fn next_length_step(length: f64) -> f64 {
    let step = length.log2().floor().exp2() / 16.0;
    ((length / step).floor() + 1.0) * step
}

impl LightBox {
    /// Fits the box to the bounds of the vertices and their shadow on the ground.
    pub(crate) fn fit(params: &LightBoxParams) -> Self {
        let axes = light_axes(params.to_sun, params.up);
        let OrientedBounds(light_bounds) =
            params.light_bounds.unwrap_or_else(|| OrientedBounds::enclosing(&axes, &params.bounds));
        let diagonal = diagonal(params);
        let sides = [0, 1].map(|axis: usize| {
            let (center, half_extent) = (
                0.5 * (light_bounds.min[axis] + light_bounds.max[axis]),
                0.5 * (light_bounds.max[axis] - light_bounds.min[axis]),
            );
            // The minimum gives the map an extent even if the scene is flat or a point.
            TexelSpan::snap(center, half_extent.max(diagonal / 64.0), params)
        });
        let ground_plane = params.ground.and_then(|height| ground_plane(&axes, params.up, height));
        let (near, far) = depth_range(params, [light_bounds.min[2], light_bounds.max[2]], &sides, ground_plane);
        let depth_extent = near - far;
        let mut shadow_from_world = Matrix4::identity();
        for (axis, side) in sides.iter().enumerate() {
            let scale = 1.0 / (2.0 * side.half_length);
            shadow_from_world.fixed_view_mut::<1, 3>(axis, 0).copy_from(&(axes[axis] * scale).transpose());
            shadow_from_world[(axis, 3)] = -side.low * scale;
        }
        shadow_from_world.fixed_view_mut::<1, 3>(2, 0).copy_from(&(-axes[2] / depth_extent).transpose());
        shadow_from_world[(2, 3)] = near / depth_extent;
        // The depth is linear in x and y of the map, so its values at three corners determine the coefficients.
        let ground = ground_plane.map_or([0.0, 0.0, 1.0], |[a, b, c]| {
            let depth = |x: f64, y: f64| (near - (a * x + b * y + c)) / depth_extent;
            let [x, y] = sides;
            let origin_depth = depth(x.low, y.low);
            [
                depth(x.low + 2.0 * x.half_length, y.low) - origin_depth,
                depth(x.low, y.low + 2.0 * y.half_length) - origin_depth,
                origin_depth,
            ]
        });
        Self { shadow_from_world, ground, axes, sides }
    }

    /// Longer side of a texel, in scene units.
    pub(crate) fn texel_side(&self, size: f64) -> f64 {
        2.0 * self.sides[0].half_length.max(self.sides[1].half_length) / size
    }
}

/// Diagonal of the bounds, at least a length that f32 can resolve at their position.
fn diagonal(params: &LightBoxParams) -> f64 {
    params.bounds.diagonal().max(MIN_SIZE).max(1e-6 * params.bounds.center().coords.amax())
}

/// z of the near and the far plane in light space, with a margin of 1 % of the diagonal. Both are quantized to a 64th
/// of the largest power of two that is at most the diagonal. The near plane is nearest to the sun. `far` and `nearest`:
/// smallest and largest z of the bounds.
fn depth_range(
    params: &LightBoxParams,
    [mut far, nearest]: [f64; 2],
    sides: &[TexelSpan; 2],
    ground_plane: Option<[f64; 3]>,
) -> (f64, f64) {
    let diagonal = diagonal(params);
    let near = nearest + 0.01 * diagonal;
    for corner in 0..4 {
        let coordinate =
            |axis: usize| sides[axis].low + if corner >> axis & 1 == 0 { 0.0 } else { 2.0 * sides[axis].half_length };
        let ground_z = ground_plane.map_or(far, |[a, b, c]| a * coordinate(0) + b * coordinate(1) + c);
        far = far.min(ground_z.max(near - MAX_GROUND_DEPTH * diagonal));
    }
    let step = diagonal.log2().floor().exp2() / 64.0;
    ((near / step).ceil() * step, ((far - 0.01 * diagonal) / step).floor() * step)
}

/// Coefficients a, b and c of the ground's z in light space: a x + b y + c. None if the sun is within about 1 degree of
/// the horizon.
fn ground_plane(axes: &[Vector3<f64>; 3], up: UpAxis, height: f64) -> Option<[f64; 3]> {
    // A point (x, y, z) in light space has the height x * x_rise + y * y_rise + z * z_rise.
    let [x_rise, y_rise, z_rise] = axes.map(|axis| axis[up.index()]);
    // `z_rise` is the sine of the sun's elevation.
    (z_rise.abs() > 0.02).then(|| [-x_rise / z_rise, -y_rise / z_rise, height / z_rise])
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    fn test_params(to_sun: Vector3<f64>, ground: Option<f64>) -> LightBoxParams {
        let bounds = BoundingBox { min: [-1.0, 0.0, -2.0], max: [1.0, 3.0, 2.0] };
        LightBoxParams {
            to_sun: to_sun.normalize(),
            up: UpAxis::Y,
            bounds,
            light_bounds: None,
            ground,
            size: 1024.0,
            margin: 6.0,
        }
    }

    #[test]
    fn box_contains_the_bounds_and_their_shadow() {
        for sun in [Vector3::new(0.4, 0.8, 0.5), Vector3::y(), Vector3::new(1.0, 0.3, 0.0)] {
            let params = test_params(sun, Some(-0.5));
            let light_box = LightBox::fit(&params);
            for corner in params.bounds.corners() {
                let map_position = light_box.shadow_from_world.transform_point(&corner);
                let shadow_position = corner - params.to_sun * ((corner.y + 0.5) / params.to_sun.y);
                let shadow_position = light_box.shadow_from_world.transform_point(&shadow_position);
                for point in [map_position, shadow_position] {
                    assert!(point.iter().all(|number| (0.0..=1.0).contains(number)), "{sun} {point}");
                }
                assert!(shadow_position.z > map_position.z && (shadow_position.xy() - map_position.xy()).norm() < 1e-9);
                let [a, b, c] = light_box.ground;
                assert!(
                    (a * shadow_position.x + b * shadow_position.y + c - shadow_position.z).abs() < 1e-9,
                    "expected the depth of the ground"
                );
            }
        }
    }

    /// Points of an ellipsoid around the center of the bounds of [`test_params`]. `scale`: its half axes. The points
    /// form a spiral with steps of about the golden angle, 2.4 radians.
    fn ellipsoid_points(scale: [f64; 3]) -> Vec<Point3<f64>> {
        let point = |index: u32| {
            let (angle, height) = (2.4 * f64::from(index), f64::from(index) / 250.0 - 1.0);
            let radius = (1.0 - height * height).max(0.0).sqrt();
            Point3::new(scale[0] * radius * angle.cos(), 1.5 + scale[1] * height, scale[2] * radius * angle.sin())
        };
        (0..=500).map(point).collect()
    }

    fn measure_light_bounds(params: &LightBoxParams, points: &[Point3<f64>]) -> Option<OrientedBounds> {
        let axes = light_axes(params.to_sun, params.up);
        let bounds_of = |point: &Point3<f64>| {
            OrientedBounds::enclosing(&axes, &BoundingBox { min: (*point).into(), max: (*point).into() })
        };
        Some(points.iter().map(bounds_of).fold(OrientedBounds::EMPTY, OrientedBounds::union))
    }

    #[test]
    fn light_bounds_give_a_smaller_box_that_contains_the_shadow() {
        for sun in [Vector3::new(0.4, 0.8, 0.5), Vector3::new(1.0, 0.3, 0.0), Vector3::new(-0.5, 0.6, 0.7)] {
            let (corner_params, points) = (test_params(sun, Some(-0.5)), ellipsoid_points([0.9, 1.4, 1.9]));
            let params =
                LightBoxParams { light_bounds: measure_light_bounds(&corner_params, &points), ..corner_params };
            let (light_box, corner_box) = (LightBox::fit(&params), LightBox::fit(&corner_params));
            for point in points {
                let shadow = point - params.to_sun * ((point.y + 0.5) / params.to_sun.y);
                for point in [point, shadow] {
                    let map_position = light_box.shadow_from_world.transform_point(&point);
                    let margin = params.margin / params.size;
                    assert!(
                        map_position.xy().iter().all(|number| (margin..=1.0 - margin).contains(number)),
                        "{sun} {map_position}"
                    );
                    assert!((0.0..=1.0).contains(&map_position.z), "{sun} {map_position}");
                }
            }
            let quarter_area = |light_box: &LightBox| light_box.sides[0].half_length * light_box.sides[1].half_length;
            assert!(quarter_area(&light_box) < 0.9 * quarter_area(&corner_box), "{sun}");
        }
    }

    #[test]
    fn distant_ground_and_horizontal_sun_give_a_finite_box() {
        for (sun, ground) in [
            (Vector3::x(), Some(-0.5)),
            // Slightly above the elevation at which `ground_plane` gives none.
            (Vector3::new(1.0, 0.021, 0.0), Some(-1e9)),
            (-Vector3::y(), Some(0.0)),
            (Vector3::y(), None),
        ] {
            let light_box = LightBox::fit(&test_params(sun, ground));
            assert!(
                light_box.shadow_from_world.iter().chain(&light_box.ground).all(|number| number.is_finite()),
                "{sun}"
            );
        }
        let point = BoundingBox { min: [5.0; 3], max: [5.0; 3] };
        let light_box = LightBox::fit(&LightBoxParams { bounds: point, ..test_params(Vector3::y(), Some(5.0)) });
        let center = light_box.shadow_from_world.transform_point(&Point3::new(5.0, 5.0, 5.0));
        assert!(center.iter().all(|number| (0.0..=1.0).contains(number)), "{center}");
    }

    /// Tracks a fixed point in the texel grid of the map while the bounds sway, and grow by 0.04 along z.
    /// `map_position` gives the position of the point in the map, 0 to 1. Returns the largest movement of the point
    /// between two steps, in texels without whole texels, and the number of steps at which the map changed its
    /// quantized size. These steps do not count as movement.
    fn measure_crawl(uses_light_bounds: bool, map_position: impl Fn(&LightBoxParams) -> [f64; 2]) -> (f64, usize) {
        let mut params = test_params(Vector3::new(0.4, 0.8, 0.5), Some(0.0));
        let (mut previous, mut max_movement, mut size_changes): (Option<([f64; 2], f64)>, f64, usize) = (None, 0.0, 0);
        for step in 0..400 {
            let phase = f64::from(step) * 0.3;
            params.bounds.max =
                [1.0 + 0.05 * phase.sin(), 3.0 + 0.02 * (0.7 * phase).cos(), 2.0 + 1e-4 * f64::from(step)];
            let [x, y, z] = params.bounds.max;
            // The factor 0.95 keeps the size from oscillating around a quantization step.
            params.light_bounds =
                measure_light_bounds(&params, &ellipsoid_points([x, 0.5 * y, z].map(|scale| 0.95 * scale)))
                    .filter(|_| uses_light_bounds);
            let texel_position = map_position(&params).map(|number| number * params.size);
            let half_length_sum =
                LightBox::fit(&params).sides[0].half_length + LightBox::fit(&params).sides[1].half_length;
            if let Some((previous_position, previous_half_length_sum)) = previous {
                let movement = |axis: usize| {
                    (texel_position[axis]
                        - previous_position[axis]
                        - (texel_position[axis] - previous_position[axis]).round())
                    .abs()
                };
                // The sum of the half lengths changes with the size.
                if previous_half_length_sum == half_length_sum {
                    max_movement = max_movement.max(movement(0)).max(movement(1))
                } else {
                    size_changes += 1
                }
            }
            previous = Some((texel_position, half_length_sum));
        }
        (max_movement, size_changes)
    }

    #[test]
    fn texel_grid_is_fixed_in_the_world_while_the_scene_sways() {
        let point = Point3::new(0.3, 1.1, -0.7);
        for uses_light_bounds in [false, true] {
            let (max_movement, size_changes) = measure_crawl(uses_light_bounds, |params| {
                let map_position =
                    LightBox::fit(params).shadow_from_world.cast::<f32>().cast::<f64>().transform_point(&point);
                [map_position.x, map_position.y]
            });
            assert!(
                max_movement < 1e-3 && size_changes <= 8,
                "{max_movement} texels, {size_changes} size changes, light bounds: {uses_light_bounds}"
            );
        }
        let (max_movement, _) = measure_crawl(false, |params| {
            let axes = light_axes(params.to_sun, params.up);
            [0, 1].map(|axis| {
                let projections = params.bounds.corners().map(|corner| axes[axis].dot(&corner.coords));
                let low = projections.into_iter().fold(f64::INFINITY, f64::min);
                let high = projections.into_iter().fold(f64::NEG_INFINITY, f64::max);
                (axes[axis].dot(&point.coords) - low) / (high - low)
            })
        });
        // A movement without whole texels is at most 0.5.
        assert!(max_movement > 0.3, "expected an unquantized box to move its texels, got {max_movement}");
    }

    #[test]
    fn quantized_length_exceeds_the_length_by_at_most_a_sixteenth() {
        // A sixteenth is 0.0625; the rest is rounding.
        let max_ratio = 1.0626;
        for step in -200..200 {
            let length = 1.37_f64.powi(step);
            assert!(
                next_length_step(length) > length && next_length_step(length) <= length * max_ratio,
                "{length}: {}",
                next_length_step(length)
            );
        }
    }
}
