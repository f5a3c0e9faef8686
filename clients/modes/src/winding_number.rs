//! The generalized winding number of a surface with holes (Jacobson, Kavan, Sorkine-Hornung 2013: "Robust inside-outside
//! segmentation using generalized winding numbers"), with a tree of dipoles for distant triangles (Barill et al. 2018:
//! "Fast winding numbers for soups and clouds").

use std::f64::consts::PI;

use nalgebra::Vector3;

use crate::surface::{Surface, divide_triangle};

/// The largest number of triangles in a leaf of the tree.
const LEAF_TRIANGLES: usize = 8;
/// A node is replaced by its dipole at distances beyond this multiple of its radius.
const DISTANCE_FACTOR: f64 = 2.0;

/// The tree of a surface.
#[derive(Debug)]
pub struct WindingNumber {
    /// Corners of triangles. Long triangles are divided, because compact ones are soon far away.
    corners: Vec<[Vector3<f64>; 3]>,
    nodes: Vec<Node>,
    /// Triangles in the order of the leaves.
    triangles: Vec<u32>,
}

/// A set of triangles that are close together.
#[derive(Debug)]
struct Node {
    /// The centroid, weighted by area.
    center: Vector3<f64>,
    /// The largest distance of a corner from the center.
    radius: f64,
    /// The sum of the area vectors.
    dipole: Vector3<f64>,
    /// The range in the list of triangles.
    triangles: std::ops::Range<usize>,
    /// The indices of both children; `None` for a leaf.
    children: Option<[usize; 2]>,
}

impl WindingNumber {
    /// Builds the tree.
    pub fn new(surface: &Surface) -> Self {
        /// The longest edge, as a share of the diagonal of the bounding box.
        const MAX_EDGE: f64 = 1.0 / 64.0;
        let (low, high) = surface.bounds();
        let max_length = MAX_EDGE * (high - low).norm();
        let mut corners = Vec::new();
        for triangle in 0..surface.triangles.len() {
            divide_triangle(surface.corners(triangle), max_length, |part| corners.push(part));
        }
        let count = corners.len();
        let mut tree = Self { corners, nodes: Vec::new(), triangles: (0..count as u32).collect() };
        if count > 0 {
            tree.add_node(0..count);
        }
        tree
    }

    /// The corners of the triangles that the tree contains: those of the surface, or parts of them.
    pub fn triangle_corners(&self) -> &[[Vector3<f64>; 3]] {
        &self.corners
    }

    /// The winding number at a point: 1 inside a closed surface, 0 outside.
    pub fn at(&self, point: Vector3<f64>) -> f64 {
        let mut sum = 0.0;
        let mut stack = if self.nodes.is_empty() { vec![] } else { vec![0] };
        while let Some(index) = stack.pop() {
            let node = &self.nodes[index];
            let offset = node.center - point;
            let distance = offset.norm();
            if distance > DISTANCE_FACTOR * node.radius {
                sum += node.dipole.dot(&offset) / (4.0 * PI * distance.powi(3));
            } else if let Some(children) = node.children {
                stack.extend(children);
            } else {
                let triangles = &self.triangles[node.triangles.clone()];
                sum += triangles.iter().map(|triangle| self.solid_angle(*triangle as usize, point)).sum::<f64>();
            }
        }
        sum
    }

    /// The signed solid angle of a triangle divided by 4 pi (Van Oosterom, Strackee 1983).
    fn solid_angle(&self, triangle: usize, point: Vector3<f64>) -> f64 {
        let [a, b, c] = self.corners[triangle].map(|corner| corner - point);
        let [length_a, length_b, length_c] = [a.norm(), b.norm(), c.norm()];
        let numerator = a.dot(&b.cross(&c));
        let denominator =
            length_a * length_b * length_c + a.dot(&b) * length_c + b.dot(&c) * length_a + c.dot(&a) * length_b;
        numerator.atan2(denominator) / (2.0 * PI)
    }

    /// Adds the node of a range of triangles and its descendants. Returns its index.
    fn add_node(&mut self, range: std::ops::Range<usize>) -> usize {
        let corners = &self.corners;
        let centroid = |triangle: u32| corners[triangle as usize].iter().sum::<Vector3<f64>>() / 3.0;
        let area_vector = |triangle: u32| {
            let [a, b, c] = corners[triangle as usize];
            (b - a).cross(&(c - a)) / 2.0
        };
        let members = &self.triangles[range.clone()];
        let areas = members.iter().map(|triangle| area_vector(*triangle));
        let (dipole, area) =
            areas.fold((Vector3::zeros(), 0.0), |(sum, area), vector| (sum + vector, area + vector.norm()));
        let weighted = members.iter().map(|triangle| centroid(*triangle) * area_vector(*triangle).norm());
        let center = match area > 0.0 {
            true => weighted.sum::<Vector3<f64>>() / area,
            false => centroid(members[0]),
        };
        let all_corners = members.iter().flat_map(|triangle| corners[*triangle as usize]);
        let radius = all_corners.map(|corner| (corner - center).norm()).fold(0.0, f64::max);
        let index = self.nodes.len();
        self.nodes.push(Node { center, radius, dipole, triangles: range.clone(), children: None });
        if range.len() > LEAF_TRIANGLES {
            let members = &mut self.triangles[range.clone()];
            let centroids = members.iter().map(|triangle| centroid(*triangle));
            let (low, high) = centroids
                .fold((Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)), |(low, high), center| {
                    (low.inf(&center), high.sup(&center))
                });
            let axis = (high - low).imax();
            let middle = range.len() / 2;
            members.select_nth_unstable_by(middle, |a, b| {
                centroid(*a)[axis].total_cmp(&centroid(*b)[axis]).then(a.cmp(b))
            });
            let split = range.start + middle;
            let children = [self.add_node(range.start..split), self.add_node(split..range.end)];
            self.nodes[index].children = Some(children);
        }
        index
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    /// An ellipsoid of latitude-longitude triangles.
    pub(crate) fn ellipsoid(semi_axes: [f64; 3], rings: usize) -> (Vec<Vector3<f64>>, Vec<[u32; 3]>) {
        let sectors = 2 * rings;
        let mut positions = vec![];
        for ring in 0..=rings {
            let polar = PI * ring as f64 / rings as f64;
            for sector in 0..sectors {
                let azimuth = 2.0 * PI * sector as f64 / sectors as f64;
                let unit = [polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()];
                // All vertices of a pole have the same position.
                let is_pole = ring == 0 || ring == rings;
                let unit = if is_pole { [0.0, 0.0, unit[2].signum()] } else { unit };
                positions.push(Vector3::from_fn(|axis, _| semi_axes[axis] * unit[axis]));
            }
        }
        let vertex = |ring: usize, sector: usize| (ring * sectors + sector % sectors) as u32;
        let quads = (0..rings).flat_map(|ring| (0..sectors).map(move |sector| (ring, sector)));
        let triangles = quads.flat_map(|(ring, sector)| {
            let [a, b] = [vertex(ring, sector), vertex(ring + 1, sector)];
            let [c, d] = [vertex(ring + 1, sector + 1), vertex(ring, sector + 1)];
            [[a, b, c], [a, c, d]]
        });
        (positions, triangles.collect())
    }

    #[test]
    fn winding_number_is_one_inside_despite_missing_triangles() {
        let (positions, mut triangles) = ellipsoid([0.5, 0.35, 0.2], 40);
        let mut random = fastrand::Rng::with_seed(1);
        triangles.retain(|_| random.f64() > 0.05);
        let surface = Surface::new(&positions, &triangles, &vec![0; triangles.len()]);
        let tree = WindingNumber::new(&surface);
        for index in 0..200 {
            let point = Vector3::from_fn(|_, _| random.f64() - 0.5);
            let level = (point.x / 0.5).powi(2) + (point.y / 0.35).powi(2) + (point.z / 0.2).powi(2);
            let direct: f64 = (0..tree.corners.len()).map(|triangle| tree.solid_angle(triangle, point)).sum();
            let fast = tree.at(point);
            assert!((fast - direct).abs() < 0.08, "point {index}: tree {fast}, sum {direct}");
            if !(0.9..1.1).contains(&level) {
                assert_eq!(fast > 0.5, level < 1.0, "point {index}: {fast} at level {level}");
            }
        }
    }
}
