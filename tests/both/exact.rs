//! Samples where two rasterizers may see different triangles, found in f64: samples on an edge, and samples where
//! depths tie.

use nalgebra::{Matrix3, Matrix4, Vector3, Vector4};

/// Grid spacing of snapped corners in pixels.
const EDGE: f64 = 1.0 / 256.0;

/// A triangle in homogeneous window coordinates, exact up to f64.
pub(crate) struct Exact {
    edges: [Vector3<f64>; 3],
    depths: Vector3<f64>,
    weights: Vector3<f64>,
    turn: f64,
}

impl Exact {
    pub(crate) fn new(clip: &Matrix4<f64>, size: [u32; 2], corners: [[f32; 3]; 3]) -> Self {
        let clips =
            corners.map(|corner| clip * Vector4::new(corner[0].into(), corner[1].into(), corner[2].into(), 1.0));
        let [half_width, half_height] = size.map(|side| 0.5 * f64::from(side));
        let [a, b, c] = clips.map(|v| Vector3::new(half_width * (v.x + v.w), half_height * (v.w - v.y), v.w));
        let of = |pick: fn(&Vector4<f64>) -> f64| Vector3::from(clips.each_ref().map(pick));
        let turn = Matrix3::from_columns(&[a, b, c]).determinant();
        Self { edges: [b.cross(&c), c.cross(&a), a.cross(&b)], depths: of(|v| v.z), weights: of(|v| v.w), turn }
    }

    /// Distances to the edges in pixels, positive inside.
    pub(crate) fn distances(&self, sample: Vector3<f64>) -> [f64; 3] {
        self.edges.map(|edge| self.turn.signum() * edge.dot(&sample) / edge.xy().norm())
    }

    /// Whether a sample lies within one snapping step of an edge.
    fn is_on_edge(&self, sample: Vector3<f64>) -> bool {
        let distances = self.distances(sample);
        distances.iter().all(|own| *own >= -EDGE) && distances.iter().any(|own| own.abs() <= EDGE)
    }

    /// Window depth at a sample.
    pub(crate) fn depth(&self, sample: Vector3<f64>) -> f64 {
        let shares = Vector3::from(self.edges.map(|edge| edge.dot(&sample)));
        0.5 * shares.dot(&self.depths) / shares.dot(&self.weights) + 0.5
    }
}

/// Numbers of differing samples: on an edge, at a depth tie, and unexplained.
#[derive(Debug, Default, PartialEq)]
pub(crate) struct Differences {
    pub(crate) edges: usize,
    pub(crate) ties: usize,
    pub(crate) wrong: usize,
}

/// Compares two lists of ids. Depths tie if they differ by `least` or less.
pub(crate) fn compare(
    got: &[Option<u32>],
    want: &[Option<u32>],
    exact: &[Exact],
    (size, least): ([u32; 2], f64),
) -> Differences {
    let mut found = Differences::default();
    for (at, (got, want)) in got.iter().zip(want).enumerate().filter(|(_, (got, want))| got != want) {
        let (x, y) = (at % size[0] as usize, at / size[0] as usize);
        let sample = Vector3::new(x as f64 + 0.5, y as f64 + 0.5, 1.0);
        let both: Vec<&Exact> = [got, want].into_iter().flatten().map(|id| &exact[*id as usize]).collect();
        let tie = |a: &Exact, b: &Exact| (a.depth(sample) - b.depth(sample)).abs() <= least;
        if both.iter().any(|own| own.is_on_edge(sample)) {
            found.edges += 1;
        } else if both.len() == 2 && tie(both[0], both[1]) {
            found.ties += 1;
        } else {
            found.wrong += 1;
        }
    }
    found
}
