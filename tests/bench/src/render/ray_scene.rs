//! The ray-cast scene of the references: deformed triangles in a bounding volume hierarchy (BVH), and ray queries.
//!
//! Boxes are f32 and padded, triangle tests are f64, so a box may give false positives but no false negatives.
//! Positions in the BVH are relative to the center of the scene and rays begin near it, so that the padding of two
//! millionths of the scene's radius covers all rounding.

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

/// Padding of boxes as a fraction of the scene's radius.
const PADDING: f64 = 2e-6;

/// Minimum of triangles per parallel task.
const LEAST: usize = 4096;

/// Points `from + t along`.
#[derive(Debug, Clone, Copy)]
pub(super) struct Ray {
    pub(super) from: Vector3<f64>,
    pub(super) along: Vector3<f64>,
}

impl Ray {
    pub(super) fn at(&self, t: f64) -> Vector3<f64> {
        self.from + self.along * t
    }
}

/// One triangle: a corner and the two edges that start there.
#[derive(Debug, Clone, Copy)]
pub(super) struct Triangle {
    pub(super) corner: Vector3<f64>,
    pub(super) edges: [Vector3<f64>; 2],
    /// Indices of its corners in the packed normals, in winding order.
    pub(super) corners: [u32; 3],
    /// Its index in the packed triangles, which breaks depth ties.
    pub(super) number: u32,
    pub(super) paint: u32,
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
    pub(super) front: bool,
}

/// The ray-cast scene.
pub(super) struct RayScene {
    pub(super) triangles: Vec<Triangle>,
    pub(super) paints: Vec<ReferenceMaterial>,
    pub(super) normals: Vec<Vector3<f64>>,
    pub(super) tangents: Vec<[f64; 4]>,
    pub(super) uvs: Vec<[f64; 2]>,
    pub(super) center: Vector3<f64>,
    pub(super) radius: f64,
    /// Whether any triangle is blended.
    pub(super) has_blended: bool,
    boxes: Bvh2,
}

struct Padded<'a>(&'a Triangle, &'a Vector3<f64>, f64);

impl Boundable for Padded<'_> {
    fn aabb(&self) -> Aabb {
        let Self(triangle, center, padding) = self;
        let [a, b, c] = triangle.points().map(|point| point - *center);
        let (low, high) = (a.inf(&b).inf(&c).add_scalar(-padding), a.sup(&b).sup(&c).add_scalar(*padding));
        let wide = |v: Vector3<f64>| glam::Vec3A::new(v.x as f32, v.y as f32, v.z as f32);
        Aabb::new(wide(low), wide(high))
    }
}

impl Triangle {
    fn points(&self) -> [Vector3<f64>; 3] {
        [self.corner, self.corner + self.edges[0], self.corner + self.edges[1]]
    }

    /// Geometric normal of the counter-clockwise side; zero for triangles without area.
    pub(super) fn facet(&self) -> Vector3<f64> {
        self.edges[0].cross(&self.edges[1]).try_normalize(0.0).unwrap_or_default()
    }

    /// Möller and Trumbore's intersection test: (t, u, v, front). Edges count as inside.
    fn meet(&self, ray: &Ray) -> Option<(f64, f64, f64, bool)> {
        let across = ray.along.cross(&self.edges[1]);
        let volume = self.edges[0].dot(&across);
        if volume == 0.0 {
            return None;
        }
        let away = ray.from - self.corner;
        let u = away.dot(&across) / volume;
        if !(0.0..=1.0).contains(&u) {
            return None;
        }
        let beside = away.cross(&self.edges[0]);
        let v = ray.along.dot(&beside) / volume;
        if v < 0.0 || u + v > 1.0 {
            return None;
        }
        Some((self.edges[1].dot(&beside) / volume, u, v, volume > 0.0))
    }
}

impl RayScene {
    /// Builds the BVH of a surface. Triangles with a corner that is not finite are skipped, because they are not
    /// visible.
    pub(super) fn new(scene: &Scene, surface: &DeformedSurface) -> Self {
        let paints = ReferenceMaterial::all(scene);
        let triangles = triangles(scene, surface);
        let (center, radius) = ball(&triangles);
        let padded: Vec<Padded<'_>> =
            triangles.iter().map(|triangle| Padded(triangle, &center, PADDING * radius)).collect();
        let boxes = build_bvh2(&padded, BvhBuildParams::medium_build(), &mut std::time::Duration::default());
        // In BVH order, so that the triangles of a leaf are contiguous.
        let ordered = boxes.primitive_indices.iter().map(|index| triangles[*index as usize]).collect();
        Self {
            triangles: ordered,
            normals: normals(surface),
            tangents: tangents(surface),
            uvs: uvs(scene),
            has_blended: triangles.iter().any(|triangle| paints[triangle.paint as usize].kind == AlphaKind::Blend),
            paints,
            center,
            radius,
            boxes,
        }
    }

    /// Updates the scene to another step by refitting the BVH; its topology, images and texture coordinates remain.
    /// Queries give the same results as with a rebuilt BVH, but are slower where triangles moved far.
    pub(super) fn moved(self, scene: &Scene, surface: &DeformedSurface) -> Self {
        let triangles = triangles(scene, surface);
        // The set of finite triangles changed, so the BVH must be rebuilt.
        if triangles.len() != self.triangles.len() {
            return Self::new(scene, surface);
        }
        let (center, radius) = ball(&triangles);
        let mut boxes = self.boxes;
        let ordered: Vec<Triangle> =
            boxes.primitive_indices.par_iter().map(|index| triangles[*index as usize]).collect();
        boxes.nodes.par_iter_mut().filter(|node| node.is_leaf()).for_each(|leaf| {
            let own = &ordered[leaf.first_index as usize..][..leaf.prim_count as usize];
            let each = own.iter().map(|triangle| Padded(triangle, &center, PADDING * radius).aabb());
            leaf.set_aabb(each.fold(Aabb::empty(), |whole, own| whole.union(&own)));
        });
        boxes.refit_all();
        let (normals, tangents) = (normals(surface), tangents(surface));
        Self { triangles: ordered, normals, tangents, center, radius, boxes, ..self }
    }

    /// The ray relative to the BVH's center in f32, and the parameter t where it begins.
    fn boxed(&self, ray: &Ray, least: f64, most: f64) -> (BoxRay, f64) {
        let squared = ray.along.norm_squared();
        let nearest = ray.along.dot(&(self.center - ray.from)) / squared;
        let begin = (nearest - 1.5 * self.radius / squared.sqrt()).max(least);
        let from = (ray.at(begin) - self.center).cast::<f32>();
        let (from, along) = (<[f32; 3]>::from(from), <[f32; 3]>::from(ray.along.cast::<f32>()));
        (BoxRay::new(from.into(), along.into(), 0.0, (most - begin).max(0.0) as f32), begin)
    }

    /// The nearest hit with t between `least` and `most` that `sees` accepts.
    pub(super) fn nearest(&self, ray: &Ray, (least, most): (f64, f64), sees: impl Fn(&Hit) -> bool) -> Option<Hit> {
        let (boxed, begin) = self.boxed(ray, least, most);
        let mut best: Option<Hit> = None;
        self.boxes.ray_traverse(boxed, &mut RayHit::none(), |_, index| {
            let nearer = |t: f64| t >= least && t <= most && best.is_none_or(|best| t <= best.t);
            let Some((t, u, v, front)) = self.triangles[index].meet(ray).filter(|meets| nearer(meets.0)) else {
                return f32::INFINITY;
            };
            let hit = Hit { t, u, v, triangle: index, front };
            let earlier = |best: Hit| t < best.t || self.number(&hit) < self.number(&best);
            if !best.is_none_or(earlier) || !sees(&hit) {
                return f32::INFINITY;
            }
            best = Some(hit);
            // Rounded up, so that the BVH does not skip hits at the same distance.
            ((t - begin) as f32).next_up()
        });
        best
    }

    /// All hits in between that `sees` accepts, farthest first; ties by descending number. A ray through a shared edge
    /// of two triangles counts one hit.
    pub(super) fn every(&self, ray: &Ray, (least, most): (f64, f64), sees: impl Fn(&Hit) -> bool) -> Vec<Hit> {
        let (boxed, _) = self.boxed(ray, least, most);
        let mut hits = Vec::new();
        self.boxes.ray_traverse_anyhit(boxed, |_, index| {
            if let Some((t, u, v, front)) =
                self.triangles[index].meet(ray).filter(|meets| meets.0 >= least && meets.0 < most)
            {
                hits.push(Hit { t, u, v, triangle: index, front });
            }
        });
        hits.retain(sees);
        hits.sort_by(|a, b| b.t.total_cmp(&a.t).then(self.number(b).cmp(&self.number(a))));
        hits.dedup_by(|one, other| self.are_one(one, other));
        hits
    }

    /// Whether two hits lie on a shared edge of their triangles.
    fn are_one(&self, one: &Hit, other: &Hit) -> bool {
        let on_rim = |hit: &Hit| hit.u.min(hit.v).min(1.0 - hit.u - hit.v) < 1e-9;
        if (one.t - other.t).abs() > 1e-9 * one.t.abs() || !on_rim(one) || !on_rim(other) {
            return false;
        }
        let [own, theirs] = [one, other].map(|hit| self.triangles[hit.triangle].points());
        let near = |a: &Vector3<f64>, b: &Vector3<f64>| (a - b).norm() <= 1e-9 * self.radius;
        own.iter().filter(|point| theirs.iter().any(|other| near(point, other))).count() >= 2
    }

    /// Whether any shadow caster other than triangle `own` lies beyond `least`.
    pub(super) fn is_dark(&self, ray: &Ray, least: f64, own: Option<usize>) -> bool {
        let (boxed, _) = self.boxed(ray, least, f64::MAX);
        let boxed = BoxRay { tmax: f32::MAX, ..boxed };
        let blocks = |index: usize| {
            let (t, u, v, front) = self.triangles[index].meet(ray).filter(|meets| meets.0 > least)?;
            let casts = own != Some(index) && self.casts(&Hit { t, u, v, triangle: index, front });
            casts.then_some(())
        };
        !self.boxes.ray_traverse_miss(boxed, |_, index| blocks(index).map_or(f32::INFINITY, |()| 0.0))
    }

    /// Intersection of a ray with one triangle.
    #[cfg(test)]
    pub(super) fn meet(&self, triangle: usize, ray: &Ray) -> Option<Hit> {
        let (t, u, v, front) = self.triangles[triangle].meet(ray).filter(|meets| meets.0 >= 0.0)?;
        Some(Hit { t, u, v, triangle, front })
    }

    pub(super) fn number(&self, hit: &Hit) -> u32 {
        self.triangles[hit.triangle].number
    }

    pub(super) fn paint(&self, hit: &Hit) -> &ReferenceMaterial {
        &self.paints[self.triangles[hit.triangle].paint as usize]
    }

    /// Whether a hit is opaque: not a culled back face, not cut out, not blended.
    pub(super) fn is_solid(&self, hit: &Hit) -> bool {
        let paint = self.paint(hit);
        let faces = hit.front || paint.double_sided;
        faces
            && match paint.kind {
                AlphaKind::Opaque => true,
                AlphaKind::Mask => self.alpha(hit) >= paint.cutoff,
                AlphaKind::Blend => false,
            }
    }

    /// Whether a hit is blended over the surfaces behind it.
    pub(super) fn is_blended(&self, hit: &Hit) -> bool {
        let paint = self.paint(hit);
        paint.kind == AlphaKind::Blend && (hit.front || paint.double_sided)
    }

    /// Whether a hit casts a shadow: both sides do, except where alpha is below the caster threshold.
    fn casts(&self, hit: &Hit) -> bool {
        let paint = self.paint(hit);
        paint.kind == AlphaKind::Opaque || self.alpha(hit) >= paint.caster
    }

    pub(super) fn alpha(&self, hit: &Hit) -> f64 {
        let paint = self.paint(hit);
        paint.alpha * paint.color.as_ref().map_or(1.0, |image| image.alpha(self.uv(hit)))
    }

    pub(super) fn uv(&self, hit: &Hit) -> [f64; 2] {
        let [a, b, c] = self.triangles[hit.triangle].corners.map(|corner| self.uvs[corner as usize]);
        [0, 1].map(|axis| (1.0 - hit.u - hit.v) * a[axis] + hit.u * b[axis] + hit.v * c[axis])
    }
}

/// Center and radius of a bounding sphere.
fn ball(triangles: &[Triangle]) -> (Vector3<f64>, f64) {
    let held = |mut bounds: BoundingBox, triangle: &Triangle| {
        triangle.points().iter().for_each(|point| bounds.include((*point).into()));
        bounds
    };
    let each = triangles.par_iter().with_min_len(LEAST).fold(|| BoundingBox::EMPTY, held);
    let bounds = each.reduce(|| BoundingBox::EMPTY, BoundingBox::union);
    match triangles.is_empty() {
        true => (Vector3::zeros(), 1.0),
        false => (bounds.center().coords, (0.5 * bounds.diagonal()).max(1e-9)),
    }
}

fn normals(surface: &DeformedSurface) -> Vec<Vector3<f64>> {
    let vector = |three: &[f32]| Vector3::new(three[0], three[1], three[2]).cast::<f64>();
    surface.normals.par_chunks_exact(3).map(vector).collect()
}

fn tangents(surface: &DeformedSurface) -> Vec<[f64; 4]> {
    surface.tangents.par_chunks_exact(4).map(|four| [0, 1, 2, 3].map(|at| f64::from(four[at]))).collect()
}

/// Texture coordinates per corner; (0, 0) where a mesh has none.
fn uvs(scene: &Scene) -> Vec<[f64; 2]> {
    let mut uvs = Vec::with_capacity(scene.layout.corners);
    for (domain, slot) in scene.domains.iter().zip(&scene.layout.domains) {
        let own = &scene.shapes[domain.shape].mesh.corners().uvs;
        uvs.extend(own.iter().map(|uv| uv.map(f64::from)));
        uvs.resize(slot.first_corner + slot.corners, [0.0; 2]);
    }
    uvs
}

fn triangles(scene: &Scene, surface: &DeformedSurface) -> Vec<Triangle> {
    let of_domain = |index: usize| {
        let (domain, slot) = (&scene.domains[index], scene.layout.domains[index]);
        let mesh = &scene.shape_of(index).mesh;
        let mirrored = domain.placement.linear().determinant() < 0.0;
        let vertices = &mesh.corners().vertices;
        mesh.triangles().par_iter().with_min_len(LEAST).enumerate().filter_map(move |(at, corners)| {
            let run = domain.material_ranges.iter().rev().find(|run| run.first_triangle <= at);
            let material = run.map_or(domain.material, |run| run.material);
            // The front side of a double-sided triangle is the one that its rest normals point to.
            let turned = scene.materials[material].double_sided && disagrees(mesh, *corners);
            let [a, b, c] = *corners;
            let corners = if mirrored == turned { [a, b, c] } else { [a, c, b] };
            let point = |corner: u32| {
                let first = 3 * (slot.first_vertex + vertices[corner as usize] as usize);
                let three = &surface.positions[first..first + 3];
                Vector3::new(three[0], three[1], three[2]).cast::<f64>()
            };
            let [a, b, c] = corners.map(point);
            let sound = [a, b, c].iter().all(|point| point.iter().all(|number| number.is_finite()));
            sound.then(|| Triangle {
                corner: a,
                edges: [b - a, c - a],
                corners: corners.map(|corner| corner + slot.first_corner as u32),
                number: (slot.first_triangle + at) as u32,
                paint: material as u32,
            })
        })
    };
    (0..scene.domains.len()).into_par_iter().flat_map(of_domain).collect()
}

fn disagrees(mesh: &Mesh, [a, b, c]: [u32; 3]) -> bool {
    let corners = mesh.corners();
    let at = |corner: u32| Vector3::from(mesh.rest()[corners.vertices[corner as usize] as usize]).cast::<f64>();
    let mean: Vector3<f64> =
        [a, b, c].iter().map(|corner| Vector3::from(corners.normals[*corner as usize]).cast::<f64>()).sum();
    (at(b) - at(a)).cross(&(at(c) - at(a))).dot(&mean) < 0.0
}
