//! The sun's view of the deformed scene: a box in light space, and the matrix from the world into it (section 3.3.1).
//!
//! The z axis of light space is v_l, the direction to the sun, and its y axis points up in the world. The box is the
//! axis-aligned box there of the world-space bounds, symmetric about their centre in x and y. Its four side facets run
//! along the light, so they are lengthened until they meet the ground: then the whole shadow on it lies inside.

use nalgebra::{Matrix4, Vector3};

use crate::scene::{Bounds, UpAxis};

/// How far below the box the ground may pull the far plane, in diagonals: a grazing sun would pull it to infinity, and a
/// receiver beyond the far plane is still shaded rightly.
const REACH: f64 = 8.0;

/// The fitted shadow map.
#[derive(Debug, Clone, Copy)]
pub(super) struct LightBox {
    /// World to the map: x and y are 0 to 1 across it, z is 0 at the plane nearest to the sun and 1 at the farthest.
    pub(super) map_from_world: Matrix4<f64>,
    /// Depth of the ground at (x, y) of the map: a x + b y + c; (0, 0, 1) when there is none.
    pub(super) ground: [f64; 3],
}

/// What the box is fitted to.
#[derive(Debug, Clone, Copy)]
pub(super) struct Fit {
    pub(super) to_sun: Vector3<f64>,
    pub(super) up: UpAxis,
    pub(super) bounds: Bounds,
    /// Height of the ground along up.
    pub(super) ground: Option<f64>,
    /// Side of the map and the empty rim that the blur needs, both in texels.
    pub(super) size: f64,
    pub(super) rim: f64,
}

impl LightBox {
    pub(super) fn fit(fit: &Fit) -> Self {
        let axes = axes(fit.to_sun, fit.up);
        let centre = fit.bounds.centre().coords;
        let corners = fit.bounds.corners().map(|corner| corner.coords);
        let diagonal = fit.bounds.diagonal().max(1e-6);
        let (mut low, mut half) = ([0.0; 2], [0.0; 2]);
        for axis in 0..2 {
            let reach = corners.iter().map(|corner| axes[axis].dot(&(corner - centre)).abs()).fold(0.0, f64::max);
            // Whole steps keep the texels where they are while the scene sways a little.
            let step = diagonal / 64.0;
            half[axis] = ((reach / step).ceil() + 1.0) * step * fit.size / (fit.size - 2.0 * fit.rim).max(1.0);
            let texel = 2.0 * half[axis] / fit.size;
            low[axis] = (axes[axis].dot(&centre) / texel).round() * texel - half[axis];
        }
        let depths = corners.map(|corner| axes[2].dot(&corner));
        let near = depths.iter().copied().fold(f64::NEG_INFINITY, f64::max) + 0.01 * diagonal;
        let mut far = depths.iter().copied().fold(f64::INFINITY, f64::min);
        let plane = fit.ground.and_then(|height| ground_plane(&axes, fit.up, height));
        for side in 0..4 {
            let at = |axis: usize| low[axis] + if side >> axis & 1 == 0 { 0.0 } else { 2.0 * half[axis] };
            let meets = plane.map_or(far, |[a, b, c]| a * at(0) + b * at(1) + c);
            far = far.min(meets.max(near - REACH * diagonal));
        }
        far -= 0.01 * diagonal;
        let range = near - far;
        let mut map_from_world = Matrix4::identity();
        for axis in 0..2 {
            let scale = 1.0 / (2.0 * half[axis]);
            map_from_world.fixed_view_mut::<1, 3>(axis, 0).copy_from(&(axes[axis] * scale).transpose());
            map_from_world[(axis, 3)] = -low[axis] * scale;
        }
        map_from_world.fixed_view_mut::<1, 3>(2, 0).copy_from(&(-axes[2] / range).transpose());
        map_from_world[(2, 3)] = near / range;
        let ground = plane.map_or([0.0, 0.0, 1.0], |[a, b, c]| {
            let depth = |x: f64, y: f64| (near - (a * x + b * y + c)) / range;
            let origin = depth(low[0], low[1]);
            let along_x = depth(low[0] + 2.0 * half[0], low[1]) - origin;
            [along_x, depth(low[0], low[1] + 2.0 * half[1]) - origin, origin]
        });
        Self { map_from_world, ground }
    }
}

/// x, y and z of light space. With the sun straight up, "up in the world" says nothing, and any y will do.
fn axes(to_sun: Vector3<f64>, up: UpAxis) -> [Vector3<f64>; 3] {
    let across = up.vector().cross(&to_sun);
    let x = across.try_normalize(1e-6).unwrap_or_else(|| {
        let other = if to_sun.x.abs() < 0.9 { Vector3::x() } else { Vector3::y() };
        other.cross(&to_sun).normalize()
    });
    [x, to_sun.cross(&x), to_sun]
}

/// The z of the ground in light space at (x, y): a x + b y + c; none when the sun is as good as on the horizon.
fn ground_plane(axes: &[Vector3<f64>; 3], up: UpAxis, height: f64) -> Option<[f64; 3]> {
    let [x, y, z] = axes.map(|axis| axis[up.index()]);
    (z.abs() > 0.02).then(|| [-x / z, -y / z, height / z])
}

#[cfg(test)]
mod tests {
    use nalgebra::Point3;

    use super::*;

    fn fit(to_sun: Vector3<f64>, ground: Option<f64>) -> Fit {
        let bounds = Bounds { min: [-1.0, 0.0, -2.0], max: [1.0, 3.0, 2.0] };
        Fit { to_sun: to_sun.normalize(), up: UpAxis::Y, bounds, ground, size: 1024.0, rim: 6.0 }
    }

    #[test]
    fn the_box_holds_the_bounds_and_their_shadow_and_depth_grows_away_from_the_sun() {
        for sun in [Vector3::new(0.4, 0.8, 0.5), Vector3::y(), Vector3::new(1.0, 0.3, 0.0)] {
            let fit = fit(sun, Some(-0.5));
            let light = LightBox::fit(&fit);
            for corner in fit.bounds.corners() {
                let inside = light.map_from_world.transform_point(&corner);
                let shadow = corner - fit.to_sun * ((corner.y + 0.5) / fit.to_sun.y);
                let shadow = light.map_from_world.transform_point(&shadow);
                for point in [inside, shadow] {
                    assert!(point.iter().all(|number| (0.0..=1.0).contains(number)), "{sun} {point}");
                }
                assert!(shadow.z > inside.z && (shadow.xy() - inside.xy()).norm() < 1e-9);
                let [a, b, c] = light.ground;
                assert!((a * shadow.x + b * shadow.y + c - shadow.z).abs() < 1e-9, "the ground's own depth");
            }
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
            assert!(light.map_from_world.iter().chain(&light.ground).all(|number| number.is_finite()), "{sun}");
        }
        let point = Bounds { min: [5.0; 3], max: [5.0; 3] };
        let light = LightBox::fit(&Fit { bounds: point, ..fit(Vector3::y(), Some(5.0)) });
        let centre = light.map_from_world.transform_point(&Point3::new(5.0, 5.0, 5.0));
        assert!(centre.iter().all(|number| (0.0..=1.0).contains(number)), "{centre}");
    }

    #[test]
    fn a_small_sway_does_not_move_the_texels() {
        let still = fit(Vector3::new(0.4, 0.8, 0.5), Some(0.0));
        let mut swayed = still;
        swayed.bounds.max[0] += 1e-4;
        let (still, swayed) = (LightBox::fit(&still), LightBox::fit(&swayed));
        let shift = (still.map_from_world.column(0) - swayed.map_from_world.column(0)).norm();
        assert!(shift < 1e-3 * still.map_from_world.column(0).norm(), "{shift}");
    }
}
