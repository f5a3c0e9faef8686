//! Fits the shadow map to the deformed scene: a box in light space, and the matrix from world space to the map (section
//! 3.3.1).
//!
//! The z axis of light space is v_l, the direction to the sun; its y axis points up in the world. The box is
//! axis-aligned in light space and symmetric about its center in x and y. It encloses the vertices as the deformer
//! measured them; a frame without that measurement uses the corners of the world-space bounds, as in the thesis. The
//! four side facets run along the light and are lengthened until they meet the ground, so that the whole shadow on the
//! ground lies inside. All sides are quantized to steps that are fixed in the world, so that shadow edges do not crawl
//! while the scene sways.

use nalgebra::{Matrix4, Vector3};

use modalcast_model::scene::{BoundingBox, OrientedBounds, UpAxis, light_axes};

/// Maximum distance by which the ground may push the far plane below the box, in diagonals of the bounds. A grazing sun
/// would push it to infinity. Receivers beyond the far plane are still shaded correctly.
const MAX_GROUND_PULL: f64 = 8.0;

/// The fitted shadow map.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LightBox {
    /// World space to the map: x and y are 0 to 1 across the map, z is 0 at the plane nearest to the sun and 1 at the
    /// farthest.
    pub(crate) shadow_from_world: Matrix4<f64>,
    /// Depth of the ground at (x, y) of the map: a x + b y + c; (0, 0, 1) without a ground.
    pub(crate) ground: [f64; 3],
    /// Axes x, y and z of light space.
    pub(crate) axes: [Vector3<f64>; 3],
    /// Extent of the map along x and y of light space.
    pub(crate) sides: [TexelSpan; 2],
}

/// Inputs of the fit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LightBoxParams {
    pub(crate) to_sun: Vector3<f64>,
    pub(crate) up: UpAxis,
    pub(crate) bounds: BoundingBox,
    /// Light-space bounds of the same vertices; without them, the corners of `bounds` are used.
    pub(crate) light: Option<OrientedBounds>,
    /// Height of the ground along the up axis.
    pub(crate) ground: Option<f64>,
    /// Side of the map and the empty rim that the blur needs, both in texels.
    pub(crate) size: f64,
    pub(crate) rim: f64,
}

/// One side of a map on a texel grid that is fixed in the world: its lower end and half its length. When the fitted
/// bounds grow or move, the length changes in few discrete steps and the side moves by whole texels, so that shadows do
/// not crawl.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TexelSpan {
    pub(crate) low: f64,
    pub(crate) half: f64,
}

impl TexelSpan {
    /// Covers `reach` to each side of the center, inside the rim.
    pub(crate) fn snap(center: f64, reach: f64, fit: &LightBoxParams) -> Self {
        let half = next_length_step(reach) * fit.size / (fit.size - 2.0 * fit.rim).max(1.0);
        let texel = 2.0 * half / fit.size;
        Self { low: (center / texel).round() * texel - half, half }
    }
}

/// The next larger quantized length, in sixteenths of the next lower power of two.
fn next_length_step(length: f64) -> f64 {
    let step = length.log2().floor().exp2() / 16.0;
    ((length / step).floor() + 1.0) * step
}

impl LightBox {
    pub(crate) fn fit(fit: &LightBoxParams) -> Self {
        let axes = light_axes(fit.to_sun, fit.up);
        let OrientedBounds(held) = fit.light.unwrap_or_else(|| OrientedBounds::enclosing(&axes, &fit.bounds));
        let diagonal = diagonal(fit);
        let sides = [0, 1].map(|axis: usize| {
            let (center, reach) = (0.5 * (held.min[axis] + held.max[axis]), 0.5 * (held.max[axis] - held.min[axis]));
            TexelSpan::snap(center, reach.max(diagonal / 64.0), fit)
        });
        let plane = fit.ground.and_then(|height| ground_plane(&axes, fit.up, height));
        let (near, far) = depth_range(fit, [held.min[2], held.max[2]], &sides, plane);
        let range = near - far;
        let mut shadow_from_world = Matrix4::identity();
        for (axis, side) in sides.iter().enumerate() {
            let scale = 1.0 / (2.0 * side.half);
            shadow_from_world.fixed_view_mut::<1, 3>(axis, 0).copy_from(&(axes[axis] * scale).transpose());
            shadow_from_world[(axis, 3)] = -side.low * scale;
        }
        shadow_from_world.fixed_view_mut::<1, 3>(2, 0).copy_from(&(-axes[2] / range).transpose());
        shadow_from_world[(2, 3)] = near / range;
        let ground = plane.map_or([0.0, 0.0, 1.0], |[a, b, c]| {
            let depth = |x: f64, y: f64| (near - (a * x + b * y + c)) / range;
            let [x, y] = sides;
            let origin = depth(x.low, y.low);
            [depth(x.low + 2.0 * x.half, y.low) - origin, depth(x.low, y.low + 2.0 * y.half) - origin, origin]
        });
        Self { shadow_from_world, ground, axes, sides }
    }

    /// The longer side of a texel, in scene units.
    pub(crate) fn texel(&self, size: f64) -> f64 {
        2.0 * self.sides[0].half.max(self.sides[1].half) / size
    }
}

/// Reference length of the box. Bounds without extent get one that f32 can still resolve at their position.
fn diagonal(fit: &LightBoxParams) -> f64 {
    fit.bounds.diagonal().max(1e-6).max(1e-6 * fit.bounds.center().coords.amax())
}

/// z of light space at the planes nearest to the sun and farthest from it, quantized like the sides.
fn depth_range(
    fit: &LightBoxParams,
    [mut far, nearest]: [f64; 2],
    sides: &[TexelSpan; 2],
    plane: Option<[f64; 3]>,
) -> (f64, f64) {
    let diagonal = diagonal(fit);
    let near = nearest + 0.01 * diagonal;
    for corner in 0..4 {
        let at = |axis: usize| sides[axis].low + if corner >> axis & 1 == 0 { 0.0 } else { 2.0 * sides[axis].half };
        let meets = plane.map_or(far, |[a, b, c]| a * at(0) + b * at(1) + c);
        far = far.min(meets.max(near - MAX_GROUND_PULL * diagonal));
    }
    let step = diagonal.log2().floor().exp2() / 64.0;
    ((near / step).ceil() * step, ((far - 0.01 * diagonal) / step).floor() * step)
}

/// The z of the ground in light space at (x, y): a x + b y + c; none when the sun is almost on the horizon.
fn ground_plane(axes: &[Vector3<f64>; 3], up: UpAxis, height: f64) -> Option<[f64; 3]> {
    let [x, y, z] = axes.map(|axis| axis[up.index()]);
    (z.abs() > 0.02).then(|| [-x / z, -y / z, height / z])
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    fn fit(to_sun: Vector3<f64>, ground: Option<f64>) -> LightBoxParams {
        let bounds = BoundingBox { min: [-1.0, 0.0, -2.0], max: [1.0, 3.0, 2.0] };
        LightBoxParams {
            to_sun: to_sun.normalize(),
            up: UpAxis::Y,
            bounds,
            light: None,
            ground,
            size: 1024.0,
            rim: 6.0,
        }
    }

    #[test]
    fn the_box_holds_the_bounds_and_their_shadow_and_depth_grows_away_from_the_sun() {
        for sun in [Vector3::new(0.4, 0.8, 0.5), Vector3::y(), Vector3::new(1.0, 0.3, 0.0)] {
            let fit = fit(sun, Some(-0.5));
            let light = LightBox::fit(&fit);
            for corner in fit.bounds.corners() {
                let inside = light.shadow_from_world.transform_point(&corner);
                let shadow = corner - fit.to_sun * ((corner.y + 0.5) / fit.to_sun.y);
                let shadow = light.shadow_from_world.transform_point(&shadow);
                for point in [inside, shadow] {
                    assert!(point.iter().all(|number| (0.0..=1.0).contains(number)), "{sun} {point}");
                }
                assert!(shadow.z > inside.z && (shadow.xy() - inside.xy()).norm() < 1e-9);
                let [a, b, c] = light.ground;
                assert!((a * shadow.x + b * shadow.y + c - shadow.z).abs() < 1e-9, "the ground's own depth");
            }
        }
    }

    /// Points of an ellipsoid inside the bounds of [`fit`]; each axis is scaled.
    fn ball(scale: [f64; 3]) -> Vec<Point3<f64>> {
        let point = |at: u32| {
            let (turn, height) = (2.4 * f64::from(at), f64::from(at) / 250.0 - 1.0);
            let round = (1.0 - height * height).max(0.0).sqrt();
            Point3::new(scale[0] * round * turn.cos(), 1.5 + scale[1] * height, scale[2] * round * turn.sin())
        };
        (0..=500).map(point).collect()
    }

    fn held(fit: &LightBoxParams, points: &[Point3<f64>]) -> Option<OrientedBounds> {
        let axes = light_axes(fit.to_sun, fit.up);
        let one = |point: &Point3<f64>| {
            OrientedBounds::enclosing(&axes, &BoundingBox { min: (*point).into(), max: (*point).into() })
        };
        Some(points.iter().map(one).fold(OrientedBounds::EMPTY, OrientedBounds::union))
    }

    #[test]
    fn a_box_around_what_was_measured_holds_it_and_its_shadow_and_is_smaller_than_one_around_the_corners() {
        for sun in [Vector3::new(0.4, 0.8, 0.5), Vector3::new(1.0, 0.3, 0.0), Vector3::new(-0.5, 0.6, 0.7)] {
            let (corners, points) = (fit(sun, Some(-0.5)), ball([0.9, 1.4, 1.9]));
            let fit = LightBoxParams { light: held(&corners, &points), ..corners };
            let (light, by_corners) = (LightBox::fit(&fit), LightBox::fit(&corners));
            for point in points {
                let shadow = point - fit.to_sun * ((point.y + 0.5) / fit.to_sun.y);
                for point in [point, shadow] {
                    let at = light.shadow_from_world.transform_point(&point);
                    let rim = fit.rim / fit.size;
                    assert!(at.xy().iter().all(|number| (rim..=1.0 - rim).contains(number)), "{sun} {at}");
                    assert!((0.0..=1.0).contains(&at.z), "{sun} {at}");
                }
            }
            let area = |light: &LightBox| light.sides[0].half * light.sides[1].half;
            assert!(area(&light) < 0.9 * area(&by_corners), "{sun}");
        }
    }

    #[test]
    fn a_ground_far_below_and_a_sun_on_the_horizon_stay_finite() {
        for (sun, ground) in [
            (Vector3::x(), Some(-0.5)),
            (Vector3::new(1.0, 0.021, 0.0), Some(-1e9)),
            (-Vector3::y(), Some(0.0)),
            (Vector3::y(), None),
        ] {
            let light = LightBox::fit(&fit(sun, ground));
            assert!(light.shadow_from_world.iter().chain(&light.ground).all(|number| number.is_finite()), "{sun}");
        }
        let point = BoundingBox { min: [5.0; 3], max: [5.0; 3] };
        let light = LightBox::fit(&LightBoxParams { bounds: point, ..fit(Vector3::y(), Some(5.0)) });
        let center = light.shadow_from_world.transform_point(&Point3::new(5.0, 5.0, 5.0));
        assert!(center.iter().all(|number| (0.0..=1.0).contains(number)), "{center}");
    }

    /// Tracks a fixed point in the texel grid of the map while the bounds sway and grow slowly. Returns its largest
    /// movement between steps, in fractions of a texel, and the number of steps at which the map changed its quantized
    /// size, which are excluded from the movement.
    fn crawl(is_lit: bool, place: impl Fn(&LightBoxParams) -> [f64; 2]) -> (f64, usize) {
        let mut fit = fit(Vector3::new(0.4, 0.8, 0.5), Some(0.0));
        let (mut last, mut most, mut jumps): (Option<([f64; 2], f64)>, f64, usize) = (None, 0.0, 0);
        for step in 0..400 {
            let sway = f64::from(step) * 0.3;
            fit.bounds.max = [1.0 + 0.05 * sway.sin(), 3.0 + 0.02 * (0.7 * sway).cos(), 2.0 + 1e-4 * f64::from(step)];
            let [x, y, z] = fit.bounds.max;
            // A size that does not oscillate around a quantization step.
            fit.light = held(&fit, &ball([x, 0.5 * y, z].map(|scale| 0.95 * scale))).filter(|_| is_lit);
            let at = place(&fit).map(|number| number * fit.size);
            let width = LightBox::fit(&fit).sides[0].half + LightBox::fit(&fit).sides[1].half;
            if let Some((before, was)) = last {
                let moved = |axis: usize| (at[axis] - before[axis] - (at[axis] - before[axis]).round()).abs();
                if was == width { most = most.max(moved(0)).max(moved(1)) } else { jumps += 1 }
            }
            last = Some((at, width));
        }
        (most, jumps)
    }

    #[test]
    fn texels_stay_where_they_are_in_the_world_while_the_scene_sways_and_grows() {
        let point = Point3::new(0.3, 1.1, -0.7);
        for is_lit in [false, true] {
            let (most, jumps) = crawl(is_lit, |fit| {
                let at = LightBox::fit(fit).shadow_from_world.cast::<f32>().cast::<f64>().transform_point(&point);
                [at.x, at.y]
            });
            assert!(most < 1e-3 && jumps <= 8, "{most} texels, {jumps} rungs, measured {is_lit}");
        }
        let (most, _) = crawl(false, |fit| {
            let axes = light_axes(fit.to_sun, fit.up);
            [0, 1].map(|axis| {
                let ends = fit.bounds.corners().map(|corner| axes[axis].dot(&corner.coords));
                let low = ends.into_iter().fold(f64::INFINITY, f64::min);
                let high = ends.into_iter().fold(f64::NEG_INFINITY, f64::max);
                (axes[axis].dot(&point.coords) - low) / (high - low)
            })
        });
        assert!(most > 0.3, "control: a box fitted tightly moves its texels by {most}");
    }

    #[test]
    fn a_box_holds_what_it_is_fitted_to_whatever_its_length_and_wastes_a_sixteenth() {
        for step in -200..200 {
            let length = 1.37_f64.powi(step);
            assert!(
                next_length_step(length) > length && next_length_step(length) <= length * 1.0626,
                "{length}: {}",
                next_length_step(length)
            );
        }
    }
}
