//! Comparison of the triangle ids that two rasterizers draw. The ids may differ at samples on an edge and at samples
//! where two triangles have equal depths. This module finds these samples in f64.

use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

/// Grid spacing of snapped corners in pixels: rasterizers round corners to 8 sub-pixel bits.
const SNAP_STEP: f64 = 1.0 / 256.0;

/// A triangle in homogeneous window coordinates (x w, y w, w), with x and y in pixels, y downwards.
pub(crate) struct ExactTriangle {
    /// Edge functions as vectors: the dot product with a sample (x, y, 1) is zero on the edge.
    edges: [Vector3<f64>; 3],
    /// Clip-space z of the corners.
    clip_z: Vector3<f64>,
    /// Clip-space w of the corners.
    clip_w: Vector3<f64>,
    /// Determinant of the corners; its sign is the winding order.
    signed_area: f64,
}

impl ExactTriangle {
    /// `size` is the width and height of the viewport in pixels.
    pub(crate) fn new(clip_from_scene: &Matrix4<f64>, size: [u32; 2], corners: [[f32; 3]; 3]) -> Self {
        let clip_corners = corners
            .map(|corner| clip_from_scene * Vector4::new(corner[0].into(), corner[1].into(), corner[2].into(), 1.0));
        let [half_width, half_height] = size.map(|side| 0.5 * f64::from(side));
        let [a, b, c] = clip_corners.map(|v| Vector3::new(half_width * (v.x + v.w), half_height * (v.w - v.y), v.w));
        let component_of_corners =
            |component: fn(&Vector4<f64>) -> f64| Vector3::from(clip_corners.each_ref().map(component));
        let signed_area = Matrix3::from_columns(&[a, b, c]).determinant();
        Self {
            edges: [b.cross(&c), c.cross(&a), a.cross(&b)],
            clip_z: component_of_corners(|corner| corner.z),
            clip_w: component_of_corners(|corner| corner.w),
            signed_area,
        }
    }

    /// Signed distances of a sample (x, y, 1) to the edges in pixels, positive inside.
    pub(crate) fn distances(&self, sample: Vector3<f64>) -> [f64; 3] {
        self.edges.map(|edge| self.signed_area.signum() * edge.dot(&sample) / edge.xy().norm())
    }

    /// Whether a sample lies within one snapping step of an edge.
    fn is_on_edge(&self, sample: Vector3<f64>) -> bool {
        let distances = self.distances(sample);
        distances.iter().all(|distance| *distance >= -SNAP_STEP)
            && distances.iter().any(|distance| distance.abs() <= SNAP_STEP)
    }

    /// Depth at a sample, from 1 (near) to 0 (far).
    pub(crate) fn depth(&self, sample: Vector3<f64>) -> f64 {
        // The edge values are the barycentric weights of the corners times a common factor, which the quotient removes.
        // The quotient is z / w in clip space.
        let edge_values = Vector3::from(self.edges.map(|edge| edge.dot(&sample)));
        edge_values.dot(&self.clip_z) / edge_values.dot(&self.clip_w)
    }
}

/// Number of samples with different ids, by reason.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Differences {
    /// Samples on an edge of either triangle.
    pub(crate) edges: usize,
    /// Samples where both triangles have the same depth within the tolerance.
    pub(crate) ties: usize,
    /// Samples without either reason: one rasterizer is wrong.
    pub(crate) wrong: usize,
}

/// Compares the ids that two rasterizers draw in a viewport of `width` pixels. An id is an index in `triangles`, and
/// `None` is the background. Depths tie if they differ by at most `depth_tolerance`.
pub(crate) fn compare_ids(
    actual_ids: &[Option<u32>],
    expected_ids: &[Option<u32>],
    triangles: &[ExactTriangle],
    width: u32,
    depth_tolerance: f64,
) -> Differences {
    let mut differences = Differences::default();
    let pairs = actual_ids.iter().zip(expected_ids).enumerate();
    for (index, (actual, expected)) in pairs.filter(|(_, (actual, expected))| actual != expected) {
        let (x, y) = (index % width as usize, index / width as usize);
        let sample = Vector3::new(x as f64 + 0.5, y as f64 + 0.5, 1.0);
        let triangles_at_sample: Vec<&ExactTriangle> =
            [actual, expected].into_iter().flatten().map(|id| &triangles[*id as usize]).collect();
        let is_tie =
            |a: &ExactTriangle, b: &ExactTriangle| (a.depth(sample) - b.depth(sample)).abs() <= depth_tolerance;
        if triangles_at_sample.iter().any(|triangle| triangle.is_on_edge(sample)) {
            differences.edges += 1;
        } else if triangles_at_sample.len() == 2 && is_tie(triangles_at_sample[0], triangles_at_sample[1]) {
            differences.ties += 1;
        } else {
            differences.wrong += 1;
        }
    }
    differences
}
