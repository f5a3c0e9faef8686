//! Which section of a beam moves each vertex of an organ's mesh, and which vertices describe the motion of a joint.
//!
//! A vertex moves with the section whose center is nearest. Around each point of the organ's polyline, the vertices within
//! a fraction of the radius move with the section at the point, so that the rings of a tube remain rigid. Clients fit
//! the motion of a joint to its attachment vertices. These vertices move with one section, so the fit is exact.

use modalcast_beam::{Beam, Station};
use nalgebra::{Matrix3, Vector3};

/// A vertex moves with the section at a point of the polyline if its own section is nearer to it than this fraction of
/// the radius. Where a polyline bends, the nearest sections of the vertices of a ring differ by less.
const RING_HALF_WIDTH: f64 = 0.6;

/// Vertices span a plane if their second largest extent is at least this fraction of the largest.
const MIN_EXTENT_RATIO: f64 = 0.1;

/// Most attachment vertices of a joint.
const MAX_ATTACHMENT_VERTICES: usize = 32;

/// A point of an organ's polyline on its beam.
#[derive(Debug, Clone, Copy)]
pub(super) struct RingCenter {
    /// Distance along the beam, meters.
    pub(super) arc_length: f64,
    /// Radius there, meters.
    pub(super) radius: f64,
}

/// The stations of the vertices of a mesh.
#[derive(Debug)]
pub(super) struct Skin {
    /// One per vertex.
    pub(super) stations: Vec<Station>,
    /// Distances of the stations along the beam, meters.
    arc_lengths: Vec<f64>,
    /// Per vertex, the index in `sections` of the section that it shares with others.
    section_of_vertex: Vec<Option<usize>>,
    /// Distances along the beam of sections that several vertices share.
    sections: Vec<f64>,
}

/// A joint: the section of the parent, and the vertices that describe its motion.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Joint {
    pub(super) station: Station,
    pub(super) vertices: Vec<u32>,
}

impl Skin {
    /// The stations of vertices at `positions` in the frame of the beam.
    pub(super) fn new(beam: &Beam, rings: &[RingCenter], positions: &[[f32; 3]]) -> Self {
        let mut skin = Self {
            stations: Vec::with_capacity(positions.len()),
            arc_lengths: Vec::with_capacity(positions.len()),
            section_of_vertex: vec![None; positions.len()],
            sections: rings.iter().map(|ring| ring.arc_length).collect(),
        };
        let ring_stations: Vec<Station> = rings.iter().map(|ring| beam.station_at(ring.arc_length)).collect();
        for (vertex, position) in positions.iter().enumerate() {
            let (station, _) = beam.nearest_station(&Vector3::from(*position).cast());
            let arc_length = beam.arc_length(station);
            let distance = |ring: &usize| (rings[*ring].arc_length - arc_length).abs();
            let nearest = (0..rings.len()).min_by(|a, b| distance(a).total_cmp(&distance(b)));
            let ring = nearest.filter(|ring| distance(ring) <= RING_HALF_WIDTH * rings[*ring].radius);
            skin.section_of_vertex[vertex] = ring;
            skin.stations.push(ring.map_or(station, |ring| ring_stations[ring]));
            skin.arc_lengths.push(ring.map_or(arc_length, |ring| rings[ring].arc_length));
        }
        skin
    }

    /// Makes vertices move rigidly with the section at `station`.
    pub(super) fn fix_to_section(&mut self, vertices: &[u32], beam: &Beam, station: Station) {
        self.sections.push(beam.arc_length(station));
        for vertex in vertices {
            self.stations[*vertex as usize] = station;
            self.arc_lengths[*vertex as usize] = beam.arc_length(station);
            self.section_of_vertex[*vertex as usize] = Some(self.sections.len() - 1);
        }
    }

    /// The section that carries a child whose base is at `base`: the nearest one along the beam that has at least three
    /// vertices that are not collinear. If vertices without a common section are nearer, these vertices get one. `None`
    /// if the vertices are collinear.
    pub(super) fn attach(&mut self, beam: &Beam, positions: &[[f32; 3]], base: &Vector3<f64>) -> Option<Joint> {
        let place = beam.arc_length(beam.nearest_station(base).0);
        let shared = self.nearest_section(positions, place);
        let free = self.nearest_free_vertices(positions, place);
        let (vertices, _) = match (shared, free) {
            (Some(shared), Some(free)) if shared.1 > free.1 => free,
            (Some(shared), _) => shared,
            (None, free) => free?,
        };
        let first_vertex = *vertices.first()? as usize;
        if self.section_of_vertex[first_vertex].is_none() {
            let arc_lengths = vertices.iter().map(|vertex| self.arc_lengths[*vertex as usize]);
            let station = beam.station_at(arc_lengths.sum::<f64>() / vertices.len() as f64);
            self.fix_to_section(&vertices, beam, station);
        }
        Some(Joint { station: self.stations[first_vertex], vertices })
    }

    /// Vertices of the nearest common section that span a plane, and the distance of the section along the beam.
    fn nearest_section(&self, positions: &[[f32; 3]], place: f64) -> Option<(Vec<u32>, f64)> {
        let mut order: Vec<usize> = (0..self.sections.len()).collect();
        let distance = |section: &usize| (self.sections[*section] - place).abs();
        order.sort_by(|a, b| distance(a).total_cmp(&distance(b)));
        order.into_iter().find_map(|section| {
            let is_member = |vertex: &u32| self.section_of_vertex[*vertex as usize] == Some(section);
            let members = distinct((0..positions.len() as u32).filter(is_member), positions);
            spans_plane(&members, positions).then(|| (members, distance(&section)))
        })
    }

    /// The nearest vertices without a common section that span a plane, and the largest distance along the beam.
    fn nearest_free_vertices(&self, positions: &[[f32; 3]], place: f64) -> Option<(Vec<u32>, f64)> {
        let distance = |vertex: u32| (self.arc_lengths[vertex as usize] - place).abs();
        let free = (0..positions.len() as u32).filter(|vertex| self.section_of_vertex[*vertex as usize].is_none());
        let mut order: Vec<(u32, f64)> = free.map(|vertex| (vertex, distance(vertex))).collect();
        order.sort_by(|a, b| a.1.total_cmp(&b.1));
        let mut chosen = Vec::new();
        for (vertex, distance) in order {
            if chosen.iter().any(|other: &u32| positions[*other as usize] == positions[vertex as usize]) {
                continue;
            }
            chosen.push(vertex);
            if spans_plane(&chosen, positions) {
                chosen.sort_unstable();
                return Some((chosen, distance));
            }
            if chosen.len() == MAX_ATTACHMENT_VERTICES {
                return None;
            }
        }
        None
    }
}

/// The first of the vertices at each position, at most [`MAX_ATTACHMENT_VERTICES`], evenly chosen.
fn distinct(vertices: impl Iterator<Item = u32>, positions: &[[f32; 3]]) -> Vec<u32> {
    let mut seen = std::collections::HashSet::new();
    let bits = |vertex: &u32| positions[*vertex as usize].map(f32::to_bits);
    let distinct: Vec<u32> = vertices.filter(|vertex| seen.insert(bits(vertex))).collect();
    let count = distinct.len().min(MAX_ATTACHMENT_VERTICES);
    (0..count).map(|index| distinct[index * distinct.len() / count]).collect()
}

/// Whether there are at least three vertices, and they are not nearly collinear.
fn spans_plane(vertices: &[u32], positions: &[[f32; 3]]) -> bool {
    if vertices.len() < 3 {
        return false;
    }
    let points: Vec<Vector3<f64>> =
        vertices.iter().map(|vertex| Vector3::from(positions[*vertex as usize]).cast()).collect();
    let mean = points.iter().sum::<Vector3<f64>>() / points.len() as f64;
    let spread = points.iter().map(|point| (point - mean) * (point - mean).transpose()).sum::<Matrix3<f64>>();
    let mut squared_extents: [f64; 3] = spread.symmetric_eigenvalues().into();
    squared_extents.sort_by(f64::total_cmp);
    squared_extents[2] > 0.0 && squared_extents[1] >= MIN_EXTENT_RATIO.powi(2) * squared_extents[2]
}

#[cfg(test)]
mod tests {
    use modalcast_beam::ElasticConstants;
    use nalgebra::Matrix6xX;

    use super::*;
    use crate::beam_shape::lift_modes;
    use crate::domain::Modes;

    const WOOD: ElasticConstants = ElasticConstants { youngs_modulus: 1e10, shear_modulus: 6e8, density: 900.0 };

    /// A bent shoot of 0.5 m with 6 points, and its rings.
    fn shoot() -> (Beam, Vec<Vector3<f64>>, Vec<RingCenter>) {
        let points: Vec<_> = (0..6)
            .map(|index| 0.1 * f64::from(index))
            .map(|s| Vector3::new(0.3 * s * s, 0.05 * (9.0 * s).sin(), s))
            .collect();
        let beam = Beam::along(&points, &[0.01; 6], WOOD, 12).expect("a valid beam");
        let mut arc_length = 0.0;
        let mut rings = vec![RingCenter { arc_length: 0.0, radius: 0.01 }];
        for ends in points.windows(2) {
            arc_length += (ends[1] - ends[0]).norm();
            rings.push(RingCenter { arc_length, radius: 0.01 });
        }
        (beam, points, rings)
    }

    /// Rings of eight vertices around the points, in planes that halve the bends, each vertex twice.
    fn tube(points: &[Vector3<f64>]) -> Vec<[f32; 3]> {
        let last = points.len() - 1;
        let ring = |index: usize| {
            let tangent = (points[(index + 1).min(last)] - points[index.saturating_sub(1)]).normalize();
            let x = tangent.cross(&Vector3::y()).normalize();
            let y = tangent.cross(&x);
            (0..16).map(move |side| {
                let angle = std::f64::consts::TAU * f64::from(side % 8) / 8.0;
                (points[index] + (x * angle.cos() + y * angle.sin()) * 0.01).cast::<f32>().into()
            })
        };
        (0..points.len()).flat_map(ring).collect()
    }

    /// The rigid motion per mode (6 x r) that fits the displacements of vertices best: the motion of their center, and
    /// the rotation by least squares, about `point`.
    fn fitted_motions(modes: &Modes, positions: &[[f32; 3]], vertices: &[u32], point: &Vector3<f64>) -> Matrix6xX<f64> {
        let place = |vertex: &u32| Vector3::from(positions[*vertex as usize]).cast::<f64>();
        let center = vertices.iter().map(place).sum::<Vector3<f64>>() / vertices.len() as f64;
        let arms: Vec<_> = vertices.iter().map(|vertex| place(vertex) - center).collect();
        let spread: Matrix3<f64> =
            arms.iter().map(|arm| Matrix3::identity() * arm.norm_squared() - arm * arm.transpose()).sum();
        let mut motions = Matrix6xX::zeros(modes.rank());
        for mode in 0..modes.rank() {
            let displacement =
                |vertex: &u32| Vector3::from_fn(|axis, _| f64::from(modes.entry(*vertex as usize, axis, mode)));
            let mean = vertices.iter().map(displacement).sum::<Vector3<f64>>() / vertices.len() as f64;
            let moment: Vector3<f64> =
                arms.iter().zip(vertices).map(|(arm, vertex)| arm.cross(&displacement(vertex))).sum();
            let rotation = spread.try_inverse().expect("vertices that are not collinear") * moment;
            motions.fixed_view_mut::<3, 1>(0, mode).copy_from(&(mean + rotation.cross(&(point - center))));
            motions.fixed_view_mut::<3, 1>(3, mode).copy_from(&rotation);
        }
        motions
    }

    /// The largest difference of a fitted motion from the section's motion, as a fraction of the largest entry of the
    /// same kind (translation or rotation).
    fn fit_error(beam: &Beam, skin: &Skin, positions: &[[f32; 3]], joint: &Joint) -> f64 {
        let modes = beam.solve_modes(12).expect("a converged solution");
        let lifted = lift_modes(beam, &modes, positions, &skin.stations).expect("valid modes");
        let exact = beam.section_motions(&modes, joint.station);
        let fitted = fitted_motions(&lifted, positions, &joint.vertices, &beam.center(joint.station));
        let error = |row: usize| {
            (exact.fixed_rows::<3>(row) - fitted.fixed_rows::<3>(row)).amax() / exact.fixed_rows::<3>(row).amax()
        };
        error(0).max(error(3))
    }

    #[test]
    fn rings_of_a_bent_tube_are_rigid_and_fits_are_exact() {
        let (beam, points, rings) = shoot();
        let positions = tube(&points);
        let mut skin = Skin::new(&beam, &rings, &positions);
        for (ring, point) in points.iter().enumerate().skip(1) {
            let base = point + Vector3::new(0.012, 0.003, 0.002);
            let joint = skin.attach(&beam, &positions, &base).expect("a joint");
            assert_eq!(joint.vertices, (0..8).map(|side| (16 * ring + side) as u32).collect::<Vec<_>>());
            assert!((beam.center(joint.station) - point).norm() < 1e-9);
            let error = fit_error(&beam, &skin, &positions, &joint);
            assert!(error < 1e-4, "ring {ring}: {error}");
        }
        // Counterexample: the nearest sections of the vertices of a ring differ where the polyline bends.
        let bare = Skin::new(&beam, &[], &positions);
        let joint = Joint { station: beam.station_at(rings[2].arc_length), vertices: (32..40).collect() };
        assert!(fit_error(&beam, &bare, &positions, &joint) > 1e-3);
    }

    #[test]
    fn vertices_without_rings_get_a_common_section() {
        let (beam, points, _) = shoot();
        // Single vertices along a spiral.
        let positions: Vec<[f32; 3]> = (0..200)
            .map(|index| {
                let station = beam.station_at(beam.length() * f64::from(index) / 200.0);
                let angle = 2.4 * f64::from(index);
                (beam.center(station) + Vector3::new(angle.cos(), angle.sin(), 0.0) * 0.01).cast::<f32>().into()
            })
            .collect();
        let mut skin = Skin::new(&beam, &[], &positions);
        let before = skin.stations.clone();
        let joint = skin.attach(&beam, &positions, &points[3]).expect("a joint");
        assert!(joint.vertices.len() >= 3 && (beam.center(joint.station) - points[3]).norm() < 0.01);
        assert!(fit_error(&beam, &skin, &positions, &joint) < 1e-4);
        let moved = (0..200).filter(|vertex| before[*vertex] != skin.stations[*vertex]).count();
        assert!(moved <= joint.vertices.len());
        // A second child at the same place shares the section; one elsewhere has another one.
        assert_eq!(skin.attach(&beam, &positions, &points[3]), Some(joint.clone()));
        let other = skin.attach(&beam, &positions, &points[1]).expect("a joint");
        assert!(other.station != joint.station && fit_error(&beam, &skin, &positions, &other) < 1e-4);
    }

    #[test]
    fn collinear_vertices_carry_no_joint() {
        let (beam, points, rings) = shoot();
        let line: Vec<[f32; 3]> = (0..50).map(|index| [0.01, 0.0, 0.01 * index as f32]).collect();
        for positions in [line, vec![], vec![[0.0; 3]; 9]] {
            assert_eq!(Skin::new(&beam, &rings, &positions).attach(&beam, &positions, &points[2]), None);
        }
        let positions = tube(&points);
        assert!(Skin::new(&beam, &rings, &positions).attach(&beam, &positions, &points[2]).is_some());
    }
}
