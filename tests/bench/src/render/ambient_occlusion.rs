//! Ray-traced ambient occlusion: the definition of `modalcast_model::scene::AmbientOcclusion`, without the horizon
//! angles of the renderer.

use nalgebra::Vector3;

use super::ray_scene::{Hit, Ray, RayScene};
use super::reference_view::ReferenceView;
use super::shade::ShadedPoint;

/// The fraction of the ambient light that reaches a point on an opaque surface or on the ground, 0 to 1. `directions`
/// are cosine-distributed unit vectors around the z axis. They are rotated to the geometric normal.
///
/// An occluder at the distance d < R blocks 1 - (d / R)^2 of the light from its direction. Occluders are opaque and
/// cut-out triangles, from either side, and the ground. The visibility is 1 for the sky and without ambient occlusion.
pub(super) fn ambient_visibility(
    ray_scene: &RayScene,
    view: &ReferenceView,
    point: &ShadedPoint,
    directions: &[[f64; 3]],
) -> f64 {
    let normal = point.visible_normal;
    let Some(radius) = view.occlusion_radius.filter(|_| normal != Vector3::zeros()) else { return 1.0 };
    // Most points of the ground need no rays, because no triangle is within the radius.
    let is_near = (point.point - ray_scene.center).norm() < ray_scene.radius + radius;
    if point.triangle.is_none() && !is_near {
        return 1.0;
    }
    let tangent = normal.cross(&Vector3::ith(normal.iamin(), 1.0)).normalize();
    let bitangent = normal.cross(&tangent);
    let visibility = |[x, y, z]: &[f64; 3]| {
        let ray = Ray { origin: point.point, direction: tangent * *x + bitangent * *y + normal * *z };
        let distance = occluder_distance(ray_scene, view, &ray, radius, point.triangle);
        (distance / radius) * (distance / radius)
    };
    directions.iter().map(visibility).sum::<f64>() / directions.len() as f64
}

/// Distance of the nearest occluder along a ray with a unit direction, at most `radius`. The triangle `receiver` does
/// not occlude itself. The ground does not occlude its own points, because their rays point up.
fn occluder_distance(
    ray_scene: &RayScene,
    view: &ReferenceView,
    ray: &Ray,
    radius: f64,
    receiver: Option<usize>,
) -> f64 {
    let ground_distance = view.intersect_ground(ray).map_or(radius, |t| t.min(radius));
    // The offset of 1e-9 radii of the scene excludes hits at the origin.
    let range = (1e-9 * ray_scene.radius, ground_distance);
    let is_occluder = |hit: &Hit| receiver != Some(hit.triangle) && ray_scene.is_solid(hit);
    ray_scene.nearest_hit(ray, range, is_occluder).map_or(ground_distance, |hit| hit.t)
}

#[cfg(test)]
mod tests {
    use super::super::ray_scene::Triangle;
    use super::super::rigid_domain::add_rigid_domain;
    use super::super::sample_pattern::cosine_samples;
    use super::super::tests::{Viewpoint, deform_at_rest, empty_parts, frame_params};
    use super::super::workloads::quad;
    use super::*;
    use modalcast_model::domain::{AlphaMode, Material, Mesh};
    use modalcast_model::scene::{AmbientOcclusion, Ground, Scene, SceneParts};
    use std::f64::consts::FRAC_1_PI;

    /// Side of the largest squares of the tests.
    const SIDE: f32 = 8.0;
    /// The radius in scene units is more than 0.1 and less than `SIDE / 8` in all scenes.
    const OCCLUSION: AmbientOcclusion = AmbientOcclusion { radius: 0.05 };

    /// Ray-cast scene and view of a scene of one domain per mesh.
    fn build(
        meshes: Vec<Mesh>,
        material: &Material,
        adjust: impl FnOnce(&mut SceneParts),
    ) -> (RayScene, ReferenceView) {
        let mut parts = empty_parts();
        parts.look.ambient_occlusion = Some(OCCLUSION);
        for mesh in meshes {
            add_rigid_domain(&mut parts, "part", mesh, material.clone()).expect("a domain");
        }
        adjust(&mut parts);
        let scene = Scene::new(parts).expect("a valid scene");
        let (surface, bounds) = deform_at_rest(&scene);
        let view = ReferenceView::new(&scene, &frame_params(bounds, 8, Viewpoint::Above));
        (RayScene::new(&scene, &surface), view)
    }

    /// The visibility by 65,536 rays of a point of a surface with this normal, which need not be a triangle.
    fn visibility((ray_scene, view): &(RayScene, ReferenceView), point: [f64; 3], normal: [f64; 3]) -> f64 {
        let (point, normal) = (Vector3::from(point), Vector3::from(normal));
        let zero = Vector3::zeros();
        let is_in_plane = |triangle: &Triangle| {
            (point - triangle.first_corner).dot(&normal).abs() < 1e-6
                && triangle.geometric_normal().dot(&normal).abs() > 0.99
        };
        let shaded_point = ShadedPoint {
            point,
            geometric_normal: normal,
            visible_normal: normal,
            triangle: ray_scene.triangles.iter().position(is_in_plane),
            ambient: zero,
            unoccluded: zero,
            sun: zero,
            cosine: 0.0,
            alpha: 1.0,
        };
        ambient_visibility(ray_scene, view, &shaded_point, &cosine_samples(1 << 16, [0.5, 0.5]))
    }

    /// A square of [`SIDE`] in the plane y = 0 that faces up.
    fn floor() -> Mesh {
        let half_side = SIDE / 2.0;
        let point = |x: f32, z: f32| [x * half_side, 0.0, z * half_side];
        quad([point(-1.0, 1.0), point(1.0, 1.0), point(1.0, -1.0), point(-1.0, -1.0)], [0.0, 1.0, 0.0])
            .expect("a floor")
    }

    /// A square in the plane x = `x` that faces +x and stands on the floor.
    fn wall(x: f32) -> Mesh {
        let half_side = SIDE / 2.0;
        let point = |y: f32, z: f32| [x, y * SIDE, z * half_side];
        quad([point(0.0, 1.0), point(0.0, -1.0), point(1.0, -1.0), point(1.0, 1.0)], [1.0, 0.0, 0.0]).expect("a wall")
    }

    fn two_sided() -> Material {
        Material { double_sided: true, ..Material::default() }
    }

    fn assert_near(actual: f64, expected: f64, case: &str) {
        assert!((actual - expected).abs() < 2e-3, "{case}: expected {expected}, got {actual}");
    }

    /// Visibility beside an infinite wall at the distance k R. With a the component of a direction towards the wall,
    /// the occlusion is (2 / pi) times the integral of sqrt(1 - a^2) (1 - (k / a)^2) from a = k to 1.
    fn visibility_beside_wall(k: f64) -> f64 {
        1.0 - FRAC_1_PI * ((1.0 + 2.0 * k * k) * k.acos() - 3.0 * k * (1.0 - k * k).sqrt())
    }

    #[test]
    fn open_plane_is_fully_visible() {
        let plane = build(vec![floor()], &two_sided(), |_| {});
        for point in [[0.0; 3], [0.3, 0.0, -0.7], [4.0, 0.0, 4.0]] {
            assert_eq!(visibility(&plane, point, [0.0, 1.0, 0.0]), 1.0, "{point:?}");
        }
    }

    #[test]
    fn wall_halves_visibility_at_its_edge_and_less_with_distance() {
        let corner = build(vec![floor(), wall(-1.0)], &two_sided(), |_| {});
        let radius = corner.1.occlusion_radius.expect("a radius");
        assert!(radius > 0.1 && radius < f64::from(SIDE / 8.0), "control: the wall is large, {radius}");
        let at_distance = |distance: f64| visibility(&corner, [distance - 1.0, 0.0, 0.1], [0.0, 1.0, 0.0]);
        assert_near(at_distance(1e-6 * radius), 0.5, "at the edge");
        for k in [0.1, 0.25, 0.5, 0.75] {
            assert_near(at_distance(k * radius), visibility_beside_wall(k), &format!("{k} radii from the wall"));
        }
        assert_eq!(at_distance(1.01 * radius), 1.0);
        // Both planes are equivalent at their edge.
        let of_wall = visibility(&corner, [-1.0, 0.25 * radius, 0.1], [1.0, 0.0, 0.0]);
        assert_near(of_wall, visibility_beside_wall(0.25), "on the wall");
    }

    /// At the edge of two perpendicular walls on a floor, a quarter of the hemisphere is open.
    #[test]
    fn corner_of_three_planes_has_a_quarter_of_the_light() {
        let side_wall = |z: f32| {
            let point = |x: f32, y: f32| [x * SIDE / 2.0, y * SIDE, z];
            quad([point(-1.0, 0.0), point(1.0, 0.0), point(1.0, 1.0), point(-1.0, 1.0)], [0.0, 0.0, 1.0])
        };
        let meshes = vec![floor(), wall(-1.0), side_wall(-1.0).expect("a wall")];
        let corner = build(meshes, &two_sided(), |_| {});
        assert_near(visibility(&corner, [1e-6 - 1.0, 0.0, 1e-6 - 1.0], [0.0, 1.0, 0.0]), 0.25, "in the corner");
    }

    /// Visibility below a parallel plane at the distance k R: k^2 - 2 k^2 ln(k), the integral of 2 c min((k / c)^2, 1)
    /// over the cosine c from 0 to 1.
    fn visibility_below_plane(k: f64) -> f64 {
        k * k - 2.0 * k * k * k.ln()
    }

    #[test]
    fn ground_occludes_triangles_but_not_itself() {
        let with_ground = |parts: &mut SceneParts| parts.look.ground = Some(Ground::default());
        // The ground is at the lowest vertex, which is the wall's.
        let above_ground = build(vec![wall(-1.0)], &two_sided(), with_ground);
        let radius = above_ground.1.occlusion_radius.expect("a radius");
        for k in [0.05, 0.25, 0.5, 0.9] {
            let height = k * radius;
            let facing_down = visibility(&above_ground, [1.0, height, 0.0], [0.0, -1.0, 0.0]);
            assert_near(facing_down, visibility_below_plane(k), &format!("facing down, {k} radii above the ground"));
            let upright = visibility(&above_ground, [1.0, height, 0.0], [1.0, 0.0, 0.0]);
            assert_near(upright, visibility_beside_wall(k), &format!("upright, {k} radii above the ground"));
        }
        assert_eq!(visibility(&above_ground, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]), 1.0, "the ground");
        // The wall occludes the ground.
        let beside_wall = visibility(&above_ground, [0.25 * radius - 1.0, 0.0, 0.1], [0.0, 1.0, 0.0]);
        assert_near(beside_wall, visibility_beside_wall(0.25), "the ground beside the wall");
        let without_ground = build(vec![wall(-1.0)], &two_sided(), |_| {});
        assert_eq!(visibility(&without_ground, [1.0, 0.01, 0.0], [0.0, -1.0, 0.0]), 1.0, "control: no ground");
    }

    #[test]
    fn cavity_is_darker_than_the_space_below_its_lid() {
        let half_side = 0.05_f32;
        let lid = quad(
            [[-1.0, half_side, 1.0], [1.0, half_side, 1.0], [1.0, half_side, -1.0], [-1.0, half_side, -1.0]],
            [0.0, 1.0, 0.0],
        );
        let meshes = vec![floor(), lid.expect("a lid"), wall(-half_side), wall(half_side)];
        let cavity = build(meshes, &two_sided(), |_| {});
        let radius = cavity.1.occlusion_radius.expect("a radius");
        let in_cavity = visibility(&cavity, [0.0; 3], [0.0, 1.0, 0.0]);
        // Every ray hits the lid, or a wall before the lid.
        let below_lid = visibility_below_plane(f64::from(half_side) / radius);
        assert!(in_cavity > 0.0 && in_cavity < below_lid, "expected less than {below_lid}, got {in_cavity}");
    }

    #[test]
    fn blended_and_cut_out_surfaces_occlude_nothing() {
        let visible = |material: &Material| {
            let corner = build(vec![floor(), wall(-1.0)], material, |_| {});
            visibility(&corner, [1e-6 - 1.0, 0.0, 0.1], [0.0, 1.0, 0.0])
        };
        let glass = |alpha_mode: AlphaMode, alpha: f32| Material { alpha_mode, alpha, ..two_sided() };
        assert_eq!(visible(&glass(AlphaMode::Blend, 0.9)), 1.0);
        assert_eq!(visible(&glass(AlphaMode::Mask { cutoff: 0.5 }, 0.4)), 1.0);
        assert_near(visible(&glass(AlphaMode::Mask { cutoff: 0.5 }, 0.6)), 0.5, "a cut-out's solid part");
        // One-sided surfaces occlude from both sides.
        let behind = build(vec![floor(), wall(1.0)], &Material::default(), |_| {});
        assert_near(visibility(&behind, [1.0 - 1e-6, 0.0, 0.1], [0.0, 1.0, 0.0]), 0.5, "behind a wall");
    }

    #[test]
    fn nothing_is_occluded_without_ambient_occlusion() {
        let corner = build(vec![floor(), wall(-1.0)], &two_sided(), |parts| parts.look.ambient_occlusion = None);
        assert_eq!(visibility(&corner, [-1.0, 0.0, 0.1], [0.0, 1.0, 0.0]), 1.0);
    }
}
