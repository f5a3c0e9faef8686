//! The ray-cast scene of the references: deformed triangles in a bounding volume hierarchy (BVH), and ray queries.
//!
//! Triangle tests are f64. Boxes are f32 and padded, so that a box test may give false positives but no false
//! negatives. Positions in the BVH are relative to the center of the scene, and rays begin near the scene. Rounding
//! errors are therefore below the padding.

use nalgebra::Vector3;
use obvhs::aabb::Aabb;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2;
use obvhs::ray::{Ray as BoxRay, RayHit};
use obvhs::{Boundable, BvhBuildParams};
use rayon::prelude::*;

use super::reference_material::{AlphaKind, ReferenceMaterial};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::Mesh;
use modalcast_model::scene::{BoundingBox, Scene};

/// Padding of boxes as a fraction of the scene's radius. f32 rounds a coordinate of up to two radii by at most 6e-8
/// radii; the padding also covers the rounding of the box test.
const PADDING: f64 = 2e-6;

/// Minimum number of triangles per parallel task.
const MIN_TASK_TRIANGLES: usize = 4096;

/// The points `origin + t direction`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub(super) origin: Vector3<f64>,
    pub(super) direction: Vector3<f64>,
}

impl Ray {
    pub(super) fn point_at(&self, t: f64) -> Vector3<f64> {
        self.origin + self.direction * t
    }
}

/// One triangle: the position of a corner and the two edges that start there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Triangle {
    pub(super) first_corner: Vector3<f64>,
    pub(super) edges: [Vector3<f64>; 2],
    /// Indices of the corners in [`RayScene::normals`], in winding order.
    pub(super) corner_indices: [u32; 3],
    /// Index in the triangles of all domains in order. It breaks depth ties.
    pub(super) packed_index: u32,
    /// Index into [`RayScene::materials`].
    pub(super) material: u32,
}

/// Intersection of a ray and a triangle; the barycentric weights of the corners are 1 - u - v, u and v.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Hit {
    pub(super) t: f64,
    pub(super) u: f64,
    pub(super) v: f64,
    /// Index into [`RayScene::triangles`].
    pub(super) triangle: usize,
    /// Whether the ray hits the side on which the winding is counter-clockwise.
    pub(super) is_front: bool,
}

/// The ray-cast scene.
pub(super) struct RayScene {
    pub(super) triangles: Vec<Triangle>,
    pub(super) materials: Vec<ReferenceMaterial>,
    /// One normal per corner.
    pub(super) normals: Vec<Vector3<f64>>,
    /// One tangent per corner: direction, and sign of the bitangent. Empty without normal maps.
    pub(super) tangents: Vec<[f64; 4]>,
    /// Texture coordinates per corner.
    pub(super) uvs: Vec<[f64; 2]>,
    /// Center and radius of a bounding sphere.
    pub(super) center: Vector3<f64>,
    pub(super) radius: f64,
    /// Whether any triangle is blended.
    pub(super) has_blended: bool,
    bvh: Bvh2,
}

/// A triangle whose box is relative to `center` and padded by `padding` on each side.
struct PaddedTriangle<'a> {
    triangle: &'a Triangle,
    center: &'a Vector3<f64>,
    padding: f64,
}

impl Boundable for PaddedTriangle<'_> {
    fn aabb(&self) -> Aabb {
        let Self { triangle, center, padding } = self;
        let [a, b, c] = triangle.points().map(|point| point - *center);
        let (min_corner, max_corner) = (a.inf(&b).inf(&c).add_scalar(-padding), a.sup(&b).sup(&c).add_scalar(*padding));
        let to_f32 = |point: Vector3<f64>| glam::Vec3A::new(point.x as f32, point.y as f32, point.z as f32);
        Aabb::new(to_f32(min_corner), to_f32(max_corner))
    }
}

impl Triangle {
    fn points(&self) -> [Vector3<f64>; 3] {
        [self.first_corner, self.first_corner + self.edges[0], self.first_corner + self.edges[1]]
    }

    /// Geometric normal of the counter-clockwise side; zero for triangles without area.
    pub(super) fn geometric_normal(&self) -> Vector3<f64> {
        self.edges[0].cross(&self.edges[1]).try_normalize(0.0).unwrap_or_default()
    }

    /// Intersection test by Möller and Trumbore. Points on an edge are inside. `index` is the index of this triangle in
    /// [`RayScene::triangles`].
    fn intersect(&self, index: usize, ray: &Ray) -> Option<Hit> {
        let direction_cross_edge = ray.direction.cross(&self.edges[1]);
        let determinant = self.edges[0].dot(&direction_cross_edge);
        if determinant == 0.0 {
            return None;
        }
        let from_corner = ray.origin - self.first_corner;
        let u = from_corner.dot(&direction_cross_edge) / determinant;
        if !(0.0..=1.0).contains(&u) {
            return None;
        }
        let corner_cross_edge = from_corner.cross(&self.edges[0]);
        let v = ray.direction.dot(&corner_cross_edge) / determinant;
        if v < 0.0 || u + v > 1.0 {
            return None;
        }
        let t = self.edges[1].dot(&corner_cross_edge) / determinant;
        Some(Hit { t, u, v, triangle: index, is_front: determinant > 0.0 })
    }
}

impl RayScene {
    /// Builds the BVH of a surface. Triangles with a corner that is not finite are skipped, because they are not
    /// visible.
    pub(super) fn new(scene: &Scene, surface: &DeformedSurface) -> Self {
        let materials = ReferenceMaterial::from_scene(scene);
        let triangles = triangles(scene, surface);
        let (center, radius) = bounding_sphere(&triangles);
        let padded_triangles: Vec<PaddedTriangle<'_>> = triangles
            .iter()
            .map(|triangle| PaddedTriangle { triangle, center: &center, padding: PADDING * radius })
            .collect();
        let bvh = build_bvh2(&padded_triangles, BvhBuildParams::medium_build(), &mut std::time::Duration::default());
        // Triangles are stored in BVH order, so that those of a leaf are contiguous.
        let ordered_triangles = bvh.primitive_indices.iter().map(|index| triangles[*index as usize]).collect();
        Self {
            triangles: ordered_triangles,
            normals: normals(surface),
            tangents: tangents(surface),
            uvs: uvs(scene),
            has_blended: triangles
                .iter()
                .any(|triangle| materials[triangle.material as usize].alpha_kind == AlphaKind::Blend),
            materials,
            center,
            radius,
            bvh,
        }
    }

    /// Updates the scene to the vertices of another step. The BVH is refitted and keeps its topology. Queries give the
    /// same results as with a rebuilt BVH, but are slower where triangles moved far.
    pub(super) fn refit(self, scene: &Scene, surface: &DeformedSurface) -> Self {
        let triangles = triangles(scene, surface);
        // If the number of finite triangles changed, the BVH must be rebuilt.
        if triangles.len() != self.triangles.len() {
            return Self::new(scene, surface);
        }
        let (center, radius) = bounding_sphere(&triangles);
        let mut bvh = self.bvh;
        let ordered_triangles: Vec<Triangle> =
            bvh.primitive_indices.par_iter().map(|index| triangles[*index as usize]).collect();
        bvh.nodes.par_iter_mut().filter(|node| node.is_leaf()).for_each(|leaf| {
            let leaf_triangles = &ordered_triangles[leaf.first_index as usize..][..leaf.prim_count as usize];
            let boxes = leaf_triangles
                .iter()
                .map(|triangle| PaddedTriangle { triangle, center: &center, padding: PADDING * radius }.aabb());
            leaf.set_aabb(boxes.fold(Aabb::empty(), |union, triangle_box| union.union(&triangle_box)));
        });
        bvh.refit_all();
        let (normals, tangents) = (normals(surface), tangents(surface));
        Self { triangles: ordered_triangles, normals, tangents, center, radius, bvh, ..self }
    }

    /// The part of a ray from `min_t` to `max_t` in f32, relative to the center of the scene, and the t at the start of
    /// this part. A ray from afar starts 1.5 radii before its point that is closest to the center. This start is still
    /// outside of the scene.
    fn box_ray(&self, ray: &Ray, min_t: f64, max_t: f64) -> (BoxRay, f64) {
        let length_squared = ray.direction.norm_squared();
        let closest_t = ray.direction.dot(&(self.center - ray.origin)) / length_squared;
        let begin_t = (closest_t - 1.5 * self.radius / length_squared.sqrt()).max(min_t);
        let origin = (ray.point_at(begin_t) - self.center).cast::<f32>();
        let (origin, direction) = (<[f32; 3]>::from(origin), <[f32; 3]>::from(ray.direction.cast::<f32>()));
        (BoxRay::new(origin.into(), direction.into(), 0.0, (max_t - begin_t).max(0.0) as f32), begin_t)
    }

    /// The nearest hit with t from `min_t` to `max_t` for which `accepts` is true.
    pub(super) fn nearest_hit(
        &self,
        ray: &Ray,
        (min_t, max_t): (f64, f64),
        accepts: impl Fn(&Hit) -> bool,
    ) -> Option<Hit> {
        let (box_ray, begin_t) = self.box_ray(ray, min_t, max_t);
        let mut nearest: Option<Hit> = None;
        // The closure returns the distance of an accepted hit, which shortens the BVH's ray, or infinity.
        self.bvh.ray_traverse(box_ray, &mut RayHit::none(), |_, index| {
            let is_in_range = |t: f64| t >= min_t && t <= max_t && nearest.is_none_or(|nearest| t <= nearest.t);
            let Some(hit) = self.triangles[index].intersect(index, ray).filter(|hit| is_in_range(hit.t)) else {
                return f32::INFINITY;
            };
            // `is_in_range` excludes hit.t > other.t, so the index decides only between equal distances.
            let precedes = |other: Hit| hit.t < other.t || self.packed_index(&hit) < self.packed_index(&other);
            if !nearest.is_none_or(precedes) || !accepts(&hit) {
                return f32::INFINITY;
            }
            nearest = Some(hit);
            // Round up, so that the BVH does not skip hits at the same distance.
            ((hit.t - begin_t) as f32).next_up()
        });
        nearest
    }

    /// All hits with t from `min_t` to below `max_t` for which `accepts` is true, farthest first. Hits with equal t are
    /// ordered by descending packed index. A hit on a shared edge of two triangles counts once.
    pub(super) fn all_hits(&self, ray: &Ray, (min_t, max_t): (f64, f64), accepts: impl Fn(&Hit) -> bool) -> Vec<Hit> {
        let (box_ray, _) = self.box_ray(ray, min_t, max_t);
        let mut hits = Vec::new();
        self.bvh.ray_traverse_anyhit(box_ray, |_, index| {
            hits.extend(self.triangles[index].intersect(index, ray).filter(|hit| hit.t >= min_t && hit.t < max_t));
        });
        hits.retain(accepts);
        hits.sort_by(|a, b| b.t.total_cmp(&a.t).then(self.packed_index(b).cmp(&self.packed_index(a))));
        hits.dedup_by(|first, second| self.are_same_hit(first, second));
        hits
    }

    /// Whether two hits are the same point on a shared edge of their triangles. The tolerances of 1e-9 allow for
    /// rounding.
    fn are_same_hit(&self, first: &Hit, second: &Hit) -> bool {
        let is_on_edge = |hit: &Hit| hit.u.min(hit.v).min(1.0 - hit.u - hit.v) < 1e-9;
        if (first.t - second.t).abs() > 1e-9 * first.t.abs() || !is_on_edge(first) || !is_on_edge(second) {
            return false;
        }
        let [first_points, second_points] = [first, second].map(|hit| self.triangles[hit.triangle].points());
        let is_equal = |a: &Vector3<f64>, b: &Vector3<f64>| (a - b).norm() <= 1e-9 * self.radius;
        first_points.iter().filter(|point| second_points.iter().any(|second| is_equal(point, second))).count() >= 2
    }

    /// Whether a shadow caster other than triangle `receiver` intersects the ray beyond `min_t`.
    pub(super) fn is_occluded(&self, ray: &Ray, min_t: f64, receiver: Option<usize>) -> bool {
        let (box_ray, _) = self.box_ray(ray, min_t, f64::MAX);
        // Casters at any distance count. `box_ray` has rounded f64::MAX to infinity; the BVH gets a finite limit.
        let box_ray = BoxRay { tmax: f32::MAX, ..box_ray };
        let occludes = |index: usize| {
            let hit = self.triangles[index].intersect(index, ray).filter(|hit| hit.t > min_t);
            receiver != Some(index) && hit.is_some_and(|hit| self.casts_shadow(&hit))
        };
        // Any finite distance ends the traversal.
        !self.bvh.ray_traverse_miss(box_ray, |_, index| if occludes(index) { 0.0 } else { f32::INFINITY })
    }

    /// Intersection of a ray with one triangle.
    #[cfg(test)]
    pub(super) fn intersect(&self, triangle: usize, ray: &Ray) -> Option<Hit> {
        self.triangles[triangle].intersect(triangle, ray).filter(|hit| hit.t >= 0.0)
    }

    pub(super) fn packed_index(&self, hit: &Hit) -> u32 {
        self.triangles[hit.triangle].packed_index
    }

    pub(super) fn material(&self, hit: &Hit) -> &ReferenceMaterial {
        &self.materials[self.triangles[hit.triangle].material as usize]
    }

    /// Whether a hit is opaque: not on the back of a single-sided material, not cut out and not blended.
    pub(super) fn is_opaque(&self, hit: &Hit) -> bool {
        (hit.is_front || self.material(hit).double_sided) && self.is_solid(hit)
    }

    /// Whether a hit, from either side, is neither cut out nor blended.
    pub(super) fn is_solid(&self, hit: &Hit) -> bool {
        let material = self.material(hit);
        match material.alpha_kind {
            AlphaKind::Opaque => true,
            AlphaKind::Mask => self.alpha(hit) >= material.alpha_cutoff,
            AlphaKind::Blend => false,
        }
    }

    /// Whether a hit is blended over the surfaces behind it.
    pub(super) fn is_blended(&self, hit: &Hit) -> bool {
        let material = self.material(hit);
        material.alpha_kind == AlphaKind::Blend && (hit.is_front || material.double_sided)
    }

    /// Whether a hit casts a shadow. Both sides of a triangle do, except where alpha is below the shadow's alpha
    /// cutoff.
    fn casts_shadow(&self, hit: &Hit) -> bool {
        let material = self.material(hit);
        material.alpha_kind == AlphaKind::Opaque || self.alpha(hit) >= material.shadow_alpha_cutoff
    }

    pub(super) fn alpha(&self, hit: &Hit) -> f64 {
        let material = self.material(hit);
        material.alpha * material.color_texture.as_ref().map_or(1.0, |texture| texture.sample_alpha(self.uv(hit)))
    }

    pub(super) fn uv(&self, hit: &Hit) -> [f64; 2] {
        let [a, b, c] = self.triangles[hit.triangle].corner_indices.map(|corner| self.uvs[corner as usize]);
        [0, 1].map(|axis| (1.0 - hit.u - hit.v) * a[axis] + hit.u * b[axis] + hit.v * c[axis])
    }
}

/// Center and radius of a bounding sphere; the radius is always positive.
fn bounding_sphere(triangles: &[Triangle]) -> (Vector3<f64>, f64) {
    let include = |mut bounds: BoundingBox, triangle: &Triangle| {
        triangle.points().iter().for_each(|point| bounds.include((*point).into()));
        bounds
    };
    let partial_bounds = triangles.par_iter().with_min_len(MIN_TASK_TRIANGLES).fold(|| BoundingBox::EMPTY, include);
    let bounds = partial_bounds.reduce(|| BoundingBox::EMPTY, BoundingBox::union);
    match triangles.is_empty() {
        true => (Vector3::zeros(), 1.0),
        false => (bounds.center().coords, (0.5 * bounds.diagonal()).max(1e-9)),
    }
}

fn normals(surface: &DeformedSurface) -> Vec<Vector3<f64>> {
    let vector = |components: &[f32]| Vector3::new(components[0], components[1], components[2]).cast::<f64>();
    surface.normals.par_chunks_exact(3).map(vector).collect()
}

fn tangents(surface: &DeformedSurface) -> Vec<[f64; 4]> {
    surface.tangents.par_chunks_exact(4).map(|tangent| [0, 1, 2, 3].map(|axis| f64::from(tangent[axis]))).collect()
}

/// Texture coordinates per corner; (0, 0) where a mesh has none.
fn uvs(scene: &Scene) -> Vec<[f64; 2]> {
    let mut uvs = Vec::with_capacity(scene.layout.corners);
    for (domain, domain_layout) in scene.domains.iter().zip(&scene.layout.domains) {
        let mesh_uvs = &scene.shapes[domain.shape].mesh.corners().uvs;
        uvs.extend(mesh_uvs.iter().map(|uv| uv.map(f64::from)));
        uvs.resize(domain_layout.first_corner + domain_layout.corners, [0.0; 2]);
    }
    uvs
}

fn triangles(scene: &Scene, surface: &DeformedSurface) -> Vec<Triangle> {
    let domain_triangles = |index: usize| {
        let (domain, domain_layout) = (&scene.domains[index], scene.layout.domains[index]);
        let mesh = &scene.shape_of(index).mesh;
        let is_mirrored = domain.placement.linear().determinant() < 0.0;
        let vertices = &mesh.corners().vertices;
        mesh.triangles().par_iter().with_min_len(MIN_TASK_TRIANGLES).enumerate().filter_map(
            move |(triangle, corners)| {
                let range = domain.material_ranges.iter().rev().find(|range| range.first_triangle <= triangle);
                let material = range.map_or(domain.material, |range| range.material);
                // The front side of a double-sided triangle is the side that its rest normals point to.
                let is_reversed = scene.materials[material].double_sided && is_winding_reversed(mesh, *corners);
                let [a, b, c] = *corners;
                // A mirrored placement reverses the winding too; both reversals cancel.
                let corners = if is_mirrored == is_reversed { [a, b, c] } else { [a, c, b] };
                let point = |corner: u32| {
                    let first_coordinate = 3 * (domain_layout.first_vertex + vertices[corner as usize] as usize);
                    let position = &surface.positions[first_coordinate..first_coordinate + 3];
                    Vector3::new(position[0], position[1], position[2]).cast::<f64>()
                };
                let [a, b, c] = corners.map(point);
                let is_finite = [a, b, c].iter().all(|point| point.iter().all(|coordinate| coordinate.is_finite()));
                is_finite.then(|| Triangle {
                    first_corner: a,
                    edges: [b - a, c - a],
                    corner_indices: corners.map(|corner| corner + domain_layout.first_corner as u32),
                    packed_index: (domain_layout.first_triangle + triangle) as u32,
                    material: material as u32,
                })
            },
        )
    };
    (0..scene.domains.len()).into_par_iter().flat_map(domain_triangles).collect()
}

/// Whether the rest normals point to the clockwise side of a triangle.
fn is_winding_reversed(mesh: &Mesh, [a, b, c]: [u32; 3]) -> bool {
    let corners = mesh.corners();
    let rest_position =
        |corner: u32| Vector3::from(mesh.rest_positions()[corners.vertices[corner as usize] as usize]).cast::<f64>();
    let normal_sum: Vector3<f64> =
        [a, b, c].iter().map(|corner| Vector3::from(corners.normals[*corner as usize]).cast::<f64>()).sum();
    (rest_position(b) - rest_position(a)).cross(&(rest_position(c) - rest_position(a))).dot(&normal_sum) < 0.0
}
