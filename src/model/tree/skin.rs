//! Builder of a part's skin: tubes around centerlines, and leaf blades. Every vertex has a station: the position along
//! the beam whose section moves the vertex.

use modalcast_beam::{RigidInertia, Station};
use nalgebra::{Matrix3, Rotation3, Vector3};

use super::centerline::Centerline;
use crate::domain::{Corners, Mesh, smooth_normals};
use crate::error::Result;

/// A mesh under construction. Positions are in the part's own frame, in meters.
#[derive(Debug, Clone, Default)]
pub(super) struct SkinBuilder {
    pub(super) rest_positions: Vec<[f32; 3]>,
    /// One station per vertex.
    pub(super) stations: Vec<Station>,
    /// The vertex of each corner.
    corners: Vec<u32>,
    uvs: Vec<[f32; 2]>,
    triangles: Vec<[u32; 3]>,
}

/// A tube around a centerline.
#[derive(Debug)]
pub(super) struct Tube<'a> {
    pub(super) centerline: &'a Centerline,
    /// One radius per ring, meters.
    pub(super) radii: &'a [f64],
    pub(super) sides: usize,
    pub(super) uv_mapping: UvMapping,
}

/// How a texture is mapped to a tube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum UvMapping {
    /// The image repeats a whole number of times around the tube. Along the tube, it repeats such that texels are
    /// square.
    Bark { repeats: u32 },
    /// One column of the image, along the tube from near the bottom of the image to near its top.
    Strip { u: f32 },
}

/// A leaf blade: a textured rectangle that is folded along its midrib and curled along its length.
#[derive(Debug, Clone, Copy)]
pub(super) struct Blade {
    pub(super) base: Vector3<f64>,
    /// Unit vector from the base along the midrib.
    pub(super) forward: Vector3<f64>,
    /// Unit normal of the upper face.
    pub(super) normal: Vector3<f64>,
    pub(super) length: f64,
    pub(super) width: f64,
    /// Angle in radians by which the tip points below the base.
    pub(super) curl: f64,
    /// Angle in radians by which each half is raised from the midrib outwards.
    pub(super) fold: f64,
    /// Left and right texture coordinate of the leaf in the image.
    pub(super) u_range: [f32; 2],
}

/// Number of rows of quadrilaterals along a blade. A row has two quadrilaterals, one on each side of the midrib.
const BLADE_ROWS: usize = 2;

/// The bark texture scales with the radius of a branch, but not below this radius (meters).
const MIN_TEXTURE_RADIUS: f64 = 0.012;

impl Blade {
    /// The inertia of the blade with `mass` in kg about `point`: a flat rectangle. The curl and the fold are neglected.
    pub(super) fn inertia(&self, mass: f64, point: &Vector3<f64>) -> RigidInertia {
        let right = self.forward.cross(&self.normal);
        let square = |vector: Vector3<f64>, side: f64| vector * vector.transpose() * (side * side / 12.0);
        // The second moments of the mass about its center, in three directions.
        let spread = square(right, self.width) + square(self.forward, self.length);
        let tensor = (Matrix3::identity() * spread.trace() - spread) * mass;
        let center = self.base + self.forward * (0.5 * self.length) - point;
        RigidInertia::body(mass, Vector3::zeros(), tensor).seen_from(&Rotation3::identity(), &center)
    }
}

impl SkinBuilder {
    /// Builds the mesh, with smooth normals.
    ///
    /// # Errors
    /// `Invalid` if a position is not finite.
    pub(super) fn build_mesh(&self) -> Result<Mesh> {
        let normals = smooth_normals(&self.rest_positions, &self.corners, &self.triangles);
        let corners = Corners { vertices: self.corners.clone(), normals, uvs: self.uvs.clone() };
        Mesh::new(self.rest_positions.clone(), corners, self.triangles.clone())
    }

    /// Adds a tube with one ring per sample of its centerline and a closed tip. `radius_factor` maps an arc length and
    /// an angle to a factor of the radius. Each ring remains centered on the centerline.
    pub(super) fn add_tube(&mut self, tube: &Tube, radius_factor: impl Fn(f64, f64) -> f64) {
        let (centerline, sides) = (tube.centerline, tube.sides);
        let last_ring = centerline.points.len() - 1;
        let first_vertex = self.rest_positions.len() as u32;
        let first_corner = self.corners.len() as u32;
        // Arc length in units of the local circumference.
        let mut circumferences = 0.0;
        for ring in 0..=last_ring {
            if ring > 0 {
                let radius = (0.5 * (tube.radii[ring] + tube.radii[ring - 1])).max(MIN_TEXTURE_RADIUS);
                circumferences += (centerline.arc_lengths[ring] - centerline.arc_lengths[ring - 1])
                    / (std::f64::consts::TAU * radius);
            }
            self.add_ring(tube, ring, &radius_factor);
            for side in 0..=sides {
                self.corners.push(first_vertex + (ring * sides + side % sides) as u32);
                self.uvs.push(tube.uv_mapping.uv_at(
                    side as f64 / sides as f64,
                    circumferences,
                    centerline.fraction(ring),
                ));
            }
        }
        let tip = centerline.points[last_ring] + centerline.tangents[last_ring] * tube.radii[last_ring];
        self.add_vertex(&tip, station(centerline, last_ring));
        for ring in 0..last_ring {
            for side in 0..sides {
                let corner = |ring: usize, side: usize| first_corner + (ring * (sides + 1) + side) as u32;
                let [a, b] = [corner(ring, side), corner(ring, side + 1)];
                let [d, c] = [corner(ring + 1, side), corner(ring + 1, side + 1)];
                self.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        let last_ring_corner = first_corner + (last_ring * (sides + 1)) as u32;
        let circumferences = circumferences + tube.radii[last_ring] / (std::f64::consts::TAU * MIN_TEXTURE_RADIUS);
        for side in 0..sides {
            let tip_corner = self.corners.len() as u32;
            self.corners.push(self.rest_positions.len() as u32 - 1);
            self.uvs.push(tube.uv_mapping.uv_at((side as f64 + 0.5) / sides as f64, circumferences, 1.0));
            self.triangles.push([last_ring_corner + side as u32, last_ring_corner + side as u32 + 1, tip_corner]);
        }
    }

    /// Adds a leaf blade whose vertices are all fixed to one section of the stem.
    pub(super) fn add_blade(&mut self, blade: &Blade, station: Station) {
        let right = blade.forward.cross(&blade.normal);
        let step = blade.length / BLADE_ROWS as f64;
        let mut position = blade.base;
        let first_corner = self.corners.len() as u32;
        for row in 0..=BLADE_ROWS {
            let fraction = row as f64 / BLADE_ROWS as f64;
            let (sin, cos) = (blade.curl * fraction).sin_cos();
            let normal = blade.normal * cos + blade.forward * sin;
            // Left edge, midrib and right edge.
            for column in [-1.0, 0.0, 1.0] {
                let offset = 0.5 * blade.width * column;
                let lift = normal * (offset.abs() * blade.fold.sin());
                self.corners.push(self.rest_positions.len() as u32);
                self.add_vertex(&(position + right * (offset * blade.fold.cos()) + lift), station);
                let u = blade.u_range[0] + (blade.u_range[1] - blade.u_range[0]) * (0.5 + 0.5 * column as f32);
                self.uvs.push([u, 1.0 - fraction as f32]);
            }
            // The direction of a row is the direction at its middle.
            let (sin, cos) = (blade.curl * (fraction + 0.5 / BLADE_ROWS as f64)).sin_cos();
            position += (blade.forward * cos - blade.normal * sin) * step;
        }
        for row in 0..BLADE_ROWS as u32 {
            for column in 0..2 {
                let a = first_corner + 3 * row + column;
                self.triangles.extend([[a, a + 1, a + 4], [a, a + 4, a + 3]]);
            }
        }
    }

    fn add_ring(&mut self, tube: &Tube, ring: usize, radius_factor: &impl Fn(f64, f64) -> f64) {
        let (centerline, sides) = (tube.centerline, tube.sides);
        let x_axis = centerline.side_vectors[ring];
        let z_axis = centerline.tangents[ring].cross(&x_axis);
        let offset = |side: usize| {
            let angle = std::f64::consts::TAU * side as f64 / sides as f64;
            (x_axis * angle.cos() + z_axis * angle.sin())
                * (tube.radii[ring] * radius_factor(centerline.arc_lengths[ring], angle))
        };
        let offsets: Vec<_> = (0..sides).map(offset).collect();
        // Clients compute the center of a joint as the mean of its ring, so the mean must be on the centerline.
        let mean = offsets.iter().sum::<Vector3<f64>>() / sides as f64;
        for offset in offsets {
            self.add_vertex(&(centerline.points[ring] + offset - mean), station(centerline, ring));
        }
    }

    fn add_vertex(&mut self, position: &Vector3<f64>, station: Station) {
        self.rest_positions.push(position.cast::<f32>().into());
        self.stations.push(station);
    }
}

/// The beam station of a ring: rings are the nodes of the beam.
pub(super) fn station(centerline: &Centerline, ring: usize) -> Station {
    if ring + 1 == centerline.points.len() {
        return Station { element: ring - 1, fraction: 1.0 };
    }
    Station { element: ring, fraction: 0.0 }
}

/// The beam station, position and unit tangent at a fraction of the length.
pub(super) fn sample_at(centerline: &Centerline, fraction: f64) -> (Station, Vector3<f64>, Vector3<f64>) {
    let arc_length = fraction * centerline.length();
    let next_ring = centerline
        .arc_lengths
        .partition_point(|ring_arc_length| *ring_arc_length < arc_length)
        .clamp(1, centerline.arc_lengths.len() - 1);
    let weight = (arc_length - centerline.arc_lengths[next_ring - 1])
        / (centerline.arc_lengths[next_ring] - centerline.arc_lengths[next_ring - 1]);
    let station = Station { element: next_ring - 1, fraction: weight };
    let position = centerline.points[next_ring - 1].lerp(&centerline.points[next_ring], weight);
    (station, position, centerline.tangents[next_ring - 1].lerp(&centerline.tangents[next_ring], weight).normalize())
}

impl UvMapping {
    /// Texture coordinates at a fraction of the circumference, an arc length in units of the circumference, and a
    /// fraction of the length.
    fn uv_at(self, circumference_fraction: f64, circumferences: f64, fraction: f64) -> [f32; 2] {
        match self {
            Self::Bark { repeats } => {
                let repeats = f64::from(repeats);
                [(circumference_fraction * repeats) as f32, (-circumferences * repeats) as f32]
            }
            Self::Strip { u } => [u, 0.95 - 0.9 * fraction as f32],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::centerline::{GrowthParameters, tests::straight_growth};
    use super::super::random::SplitMix64;
    use super::*;

    fn winding_centerline() -> Centerline {
        Centerline::grow(
            &GrowthParameters { wander: 0.3, rise: 0.5, ..straight_growth(1.5, 6, 2) },
            &mut SplitMix64::new(4),
        )
    }

    #[test]
    fn tube_is_centered_and_its_normals_point_outwards() {
        let centerline = winding_centerline();
        let radii: Vec<f64> = (0..13).map(|ring| 0.06 - 0.004 * f64::from(ring)).collect();
        let mut skin = SkinBuilder::default();
        let tube =
            Tube { centerline: &centerline, radii: &radii, sides: 9, uv_mapping: UvMapping::Bark { repeats: 2 } };
        skin.add_tube(&tube, |_, angle| 1.0 + 0.3 * angle.cos());
        let mesh = skin.build_mesh().expect("a valid mesh");
        assert_eq!(mesh.rest_positions().len(), 13 * 9 + 1);
        assert_eq!(mesh.triangles().len(), 12 * 9 * 2 + 9);
        for ring in 0..13 {
            let ring_positions =
                mesh.rest_positions()[9 * ring..][..9].iter().map(|position| Vector3::from(*position).cast::<f64>());
            let mean = ring_positions.sum::<Vector3<f64>>() / 9.0;
            assert!((mean - centerline.points[ring]).norm() < 1e-6);
        }
        for (vertex, normal) in mesh.corners().vertices.iter().zip(&mesh.corners().normals) {
            let (position, ring) =
                (Vector3::from(mesh.rest_positions()[*vertex as usize]).cast::<f64>(), *vertex as usize / 9);
            let center = if ring > 12 { centerline.points[12] } else { centerline.points[ring] };
            let outward_component = (position - center).normalize().dot(&Vector3::from(*normal).cast());
            assert!(outward_component > 0.3, "expected an outward normal, got {normal:?}");
        }
    }

    #[test]
    fn bark_texels_are_square_and_repeat_around_the_tube() {
        let centerline = Centerline::grow(&straight_growth(1.0, 4, 2), &mut SplitMix64::new(1));
        let mut skin = SkinBuilder::default();
        let tube =
            Tube { centerline: &centerline, radii: &[0.05; 9], sides: 8, uv_mapping: UvMapping::Bark { repeats: 3 } };
        skin.add_tube(&tube, |_, _| 1.0);
        // A ring of 8 sides has 9 corners, because the seam repeats a corner.
        let seam_uvs = |ring: usize| (skin.uvs[9 * ring], skin.uvs[9 * ring + 8]);
        for ring in 0..9 {
            let (left, right) = seam_uvs(ring);
            assert_eq!((left[0], right[0], left[1]), (0.0, 3.0, right[1]));
        }
        // Repetitions of the image per meter. The tube is 1 m long, and its circumference is 2 pi 0.05 m.
        let repeats_along = f64::from(seam_uvs(0).0[1] - seam_uvs(8).0[1]);
        let repeats_around = 3.0 / (std::f64::consts::TAU * 0.05);
        assert!((repeats_along / repeats_around - 1.0).abs() < 1e-5);
    }

    #[test]
    fn sample_at_a_fraction_is_on_the_centerline() {
        let centerline = winding_centerline();
        let middle_fraction = 0.5 * (centerline.fraction(4) + centerline.fraction(5));
        let (station, position, _) = sample_at(&centerline, middle_fraction);
        assert!((position - 0.5 * (centerline.points[4] + centerline.points[5])).norm() < 1e-12);
        assert!(station.element == 4 && (station.fraction - 0.5).abs() < 1e-12, "{station:?}");
        // The tip is ring 12, at the end of the last element.
        let (end_station, position, tangent) = sample_at(&centerline, 1.0);
        assert!((end_station.element, end_station.fraction) == (11, 1.0));
        assert!((position - centerline.points[12]).norm() < 1e-12);
        assert!((tangent - centerline.tangents[12]).norm() < 1e-12);
    }

    #[test]
    fn inertia_of_a_blade_is_that_of_its_points() {
        let orientation = Rotation3::from_euler_angles(0.3, 0.7, -0.2);
        let blade = Blade {
            base: Vector3::new(0.1, 0.2, -0.3),
            forward: orientation * Vector3::y(),
            normal: orientation * Vector3::z(),
            length: 0.2,
            width: 0.1,
            curl: 0.0,
            fold: 0.0,
            u_range: [0.0, 1.0],
        };
        let point = Vector3::new(0.05, 0.0, 0.1);
        let count = 100;
        let masses = (0..count * count).map(|index| {
            let [row, column] = [index / count, index % count].map(|index| (f64::from(index) + 0.5) / f64::from(count));
            let local = Vector3::new(blade.width * (column - 0.5), blade.length * row, 0.0);
            let place = blade.base + orientation * local - point;
            let mass = RigidInertia::point_mass(2.0 / f64::from(count * count));
            mass.seen_from(&Rotation3::identity(), &place)
        });
        let expected = masses.sum::<RigidInertia>();
        let difference = blade.inertia(2.0, &point).matrix() - expected.matrix();
        assert!(difference.norm() < 1e-4 * expected.tensor().norm(), "{difference}");
    }

    #[test]
    fn blade_has_its_own_corners_and_faces_its_normal() {
        let centerline = winding_centerline();
        let mut skin = SkinBuilder::default();
        skin.add_tube(
            &Tube { centerline: &centerline, radii: &[0.01; 13], sides: 4, uv_mapping: UvMapping::Strip { u: 0.97 } },
            |_, _| 1.0,
        );
        let (tube_triangles, tube_corners) = (skin.triangles.len(), skin.corners.len() as u32);
        let blade = Blade {
            base: Vector3::new(1.0, 0.0, 0.0),
            forward: Vector3::y(),
            normal: Vector3::z(),
            length: 0.2,
            width: 0.1,
            curl: 0.5,
            fold: 0.3,
            u_range: [0.0, 0.9],
        };
        skin.add_blade(&blade, station(&centerline, 6));
        assert!(skin.triangles[tube_triangles..].as_flattened().iter().all(|corner| *corner >= tube_corners));
        let mesh = skin.build_mesh().expect("a valid mesh");
        for corner in tube_corners as usize..mesh.corners().vertices.len() {
            assert!(mesh.corners().normals[corner][2] > 0.5);
            assert!(mesh.rest_positions()[mesh.corners().vertices[corner] as usize][0] > 0.9);
        }
    }
}
