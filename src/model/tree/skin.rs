//! Skin geometry under construction, with the beam station of every vertex: tubes around centerlines, and leaf blades.

use nalgebra::Vector3;

use super::centerline::Centerline;
use super::skin_modes::Station;
use crate::domain::{Corners, Mesh, smooth_normals};
use crate::error::Result;

/// A mesh under construction. Positions are in the part's own frame, in meters; every vertex has a station.
#[derive(Debug, Clone, Default)]
pub(super) struct SkinBuilder {
    pub(super) rest: Vec<[f32; 3]>,
    pub(super) stations: Vec<Station>,
    corners: Vec<u32>,
    uvs: Vec<[f32; 2]>,
    triangles: Vec<[u32; 3]>,
}

/// The skin of a branch.
#[derive(Debug)]
pub(super) struct Tube<'a> {
    pub(super) centerline: &'a Centerline,
    /// One radius per ring, meters.
    pub(super) radii: &'a [f64],
    pub(super) sides: usize,
    pub(super) wrap: UvMapping,
}

/// How a texture is mapped to a tube.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum UvMapping {
    /// A whole number of repeats around the tube, and as many along it as keep the texels square.
    Bark { repeats: u32 },
    /// One column of the image, from top to bottom.
    Strip { u: f32 },
}

/// A leaf blade: a card that is folded along its midrib and curled along its length.
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
    /// Angle in radians by which each half is raised.
    pub(super) fold: f64,
    /// Left and right texture coordinate of the leaf in the image.
    pub(super) span: [f32; 2],
}

/// Number of quads along a blade; there are two across.
const BLADE_ROWS: usize = 2;

/// The bark texture scales with the radius of a branch, but not below this radius (meters).
const MIN_RADIUS: f64 = 0.012;

impl SkinBuilder {
    /// The finished mesh with smooth normals.
    ///
    /// # Errors
    /// `Invalid` if a position is not finite.
    pub(super) fn mesh(&self) -> Result<Mesh> {
        let normals = smooth_normals(&self.rest, &self.corners, &self.triangles);
        let corners = Corners { vertices: self.corners.clone(), normals, uvs: self.uvs.clone() };
        Mesh::new(self.rest.clone(), corners, self.triangles.clone())
    }

    /// Adds a tube with one ring per sample of its centerline and a closed tip. `swell` returns a radius factor for an
    /// arc length and an angle; the rings remain centered on the line for any `swell`.
    pub(super) fn add_tube(&mut self, tube: &Tube, swell: impl Fn(f64, f64) -> f64) {
        let (centerline, sides) = (tube.centerline, tube.sides);
        let last = centerline.points.len() - 1;
        let first_vertex = self.rest.len() as u32;
        let first_corner = self.corners.len() as u32;
        let mut along = 0.0;
        for ring in 0..=last {
            if ring > 0 {
                let radius = (0.5 * (tube.radii[ring] + tube.radii[ring - 1])).max(MIN_RADIUS);
                along += (centerline.arc_lengths[ring] - centerline.arc_lengths[ring - 1])
                    / (std::f64::consts::TAU * radius);
            }
            self.add_ring(tube, ring, &swell);
            for side in 0..=sides {
                self.corners.push(first_vertex + (ring * sides + side % sides) as u32);
                self.uvs.push(tube.wrap.at(side as f64 / sides as f64, along, centerline.fraction(ring)));
            }
        }
        let tip = centerline.points[last] + centerline.tangents[last] * tube.radii[last];
        self.add_vertex(&tip, station(centerline, last));
        for ring in 0..last {
            for side in 0..sides {
                let corner = |ring: usize, side: usize| first_corner + (ring * (sides + 1) + side) as u32;
                let [a, b] = [corner(ring, side), corner(ring, side + 1)];
                let [d, c] = [corner(ring + 1, side), corner(ring + 1, side + 1)];
                self.triangles.extend([[a, b, c], [a, c, d]]);
            }
        }
        let edge = first_corner + (last * (sides + 1)) as u32;
        let along = along + tube.radii[last] / (std::f64::consts::TAU * MIN_RADIUS);
        for side in 0..sides {
            let tip = self.corners.len() as u32;
            self.corners.push(self.rest.len() as u32 - 1);
            self.uvs.push(tube.wrap.at((side as f64 + 0.5) / sides as f64, along, 1.0));
            self.triangles.push([edge + side as u32, edge + side as u32 + 1, tip]);
        }
    }

    /// Adds a leaf blade whose vertices are all fixed to one section of the stem.
    pub(super) fn add_blade(&mut self, blade: &Blade, station: Station) {
        let side = blade.forward.cross(&blade.normal);
        let step = blade.length / BLADE_ROWS as f64;
        let mut place = blade.base;
        let first = self.corners.len() as u32;
        for row in 0..=BLADE_ROWS {
            let along = row as f64 / BLADE_ROWS as f64;
            let (sin, cos) = (blade.curl * along).sin_cos();
            let normal = blade.normal * cos + blade.forward * sin;
            for column in [-1.0, 0.0, 1.0] {
                let half = 0.5 * blade.width * column;
                let lifted = normal * (half.abs() * blade.fold.sin());
                self.corners.push(self.rest.len() as u32);
                self.add_vertex(&(place + side * (half * blade.fold.cos()) + lifted), station);
                let u = blade.span[0] + (blade.span[1] - blade.span[0]) * (0.5 + 0.5 * column as f32);
                self.uvs.push([u, 1.0 - along as f32]);
            }
            let (sin, cos) = (blade.curl * (along + 0.5 / BLADE_ROWS as f64)).sin_cos();
            place += (blade.forward * cos - blade.normal * sin) * step;
        }
        for row in 0..BLADE_ROWS as u32 {
            for column in 0..2 {
                let a = first + 3 * row + column;
                self.triangles.extend([[a, a + 1, a + 4], [a, a + 4, a + 3]]);
            }
        }
    }

    fn add_ring(&mut self, tube: &Tube, ring: usize, swell: &impl Fn(f64, f64) -> f64) {
        let (centerline, sides) = (tube.centerline, tube.sides);
        let (across, over) = (centerline.sides[ring], centerline.tangents[ring].cross(&centerline.sides[ring]));
        let offset = |side: usize| {
            let angle = std::f64::consts::TAU * side as f64 / sides as f64;
            (across * angle.cos() + over * angle.sin())
                * (tube.radii[ring] * swell(centerline.arc_lengths[ring], angle))
        };
        let offsets: Vec<_> = (0..sides).map(offset).collect();
        // A joint computes the section's center as the mean of its ring, so the mean must be on the centerline.
        let mean = offsets.iter().sum::<Vector3<f64>>() / sides as f64;
        for offset in offsets {
            self.add_vertex(&(centerline.points[ring] + offset - mean), station(centerline, ring));
        }
    }

    fn add_vertex(&mut self, place: &Vector3<f64>, station: Station) {
        self.rest.push(place.cast::<f32>().into());
        self.stations.push(station);
    }
}

/// The beam station of a ring.
pub(super) fn station(centerline: &Centerline, ring: usize) -> Station {
    if ring + 1 == centerline.points.len() {
        return Station { element: ring / centerline.rings - 1, fraction: 1.0 };
    }
    Station { element: ring / centerline.rings, fraction: (ring % centerline.rings) as f64 / centerline.rings as f64 }
}

/// The beam station, position and unit tangent at a fraction of the length.
pub(super) fn between(centerline: &Centerline, along: f64) -> (Station, Vector3<f64>, Vector3<f64>) {
    let arc = along * centerline.length();
    let after = centerline.arc_lengths.partition_point(|at| *at < arc).clamp(1, centerline.arc_lengths.len() - 1);
    let part =
        (arc - centerline.arc_lengths[after - 1]) / (centerline.arc_lengths[after] - centerline.arc_lengths[after - 1]);
    let mut station = station(centerline, after - 1);
    station.fraction += part / centerline.rings as f64;
    let place = centerline.points[after - 1].lerp(&centerline.points[after], part);
    (station, place, centerline.tangents[after - 1].lerp(&centerline.tangents[after], part).normalize())
}

impl UvMapping {
    /// Texture coordinates at a fraction of the circumference, an arc length in circumferences, and a fraction of the
    /// length.
    fn at(self, around: f64, along: f64, fraction: f64) -> [f32; 2] {
        match self {
            Self::Bark { repeats } => {
                let repeats = f64::from(repeats);
                [(around * repeats) as f32, (-along * repeats) as f32]
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

    fn winding() -> Centerline {
        Centerline::grow(
            &GrowthParameters { wander: 0.3, rise: 0.5, ..straight_growth(1.5, 6, 2) },
            &mut SplitMix64::new(4),
        )
    }

    #[test]
    fn a_tube_is_centred_on_its_line_and_its_normals_point_outwards() {
        let centerline = winding();
        let radii: Vec<f64> = (0..13).map(|ring| 0.06 - 0.004 * f64::from(ring)).collect();
        let mut sheet = SkinBuilder::default();
        let tube = Tube { centerline: &centerline, radii: &radii, sides: 9, wrap: UvMapping::Bark { repeats: 2 } };
        sheet.add_tube(&tube, |_, angle| 1.0 + 0.3 * angle.cos());
        let mesh = sheet.mesh().expect("finite");
        assert_eq!(mesh.rest_positions().len(), 13 * 9 + 1);
        assert_eq!(mesh.triangles().len(), 12 * 9 * 2 + 9);
        for ring in 0..13 {
            let places = mesh.rest_positions()[9 * ring..][..9].iter().map(|place| Vector3::from(*place).cast::<f64>());
            let mean = places.sum::<Vector3<f64>>() / 9.0;
            assert!((mean - centerline.points[ring]).norm() < 1e-6);
        }
        for (corner, normal) in mesh.corners().vertices.iter().zip(&mesh.corners().normals) {
            let (place, ring) =
                (Vector3::from(mesh.rest_positions()[*corner as usize]).cast::<f64>(), *corner as usize / 9);
            let center = if ring > 12 { centerline.points[12] } else { centerline.points[ring] };
            let outwards = (place - center).normalize().dot(&Vector3::from(*normal).cast());
            assert!(outwards > 0.3, "normal {normal:?} looks inwards: {outwards}");
        }
    }

    #[test]
    fn bark_repeats_a_whole_number_of_times_around_with_square_texels() {
        let centerline = Centerline::grow(&straight_growth(1.0, 4, 2), &mut SplitMix64::new(1));
        let mut sheet = SkinBuilder::default();
        let tube = Tube { centerline: &centerline, radii: &[0.05; 9], sides: 8, wrap: UvMapping::Bark { repeats: 3 } };
        sheet.add_tube(&tube, |_, _| 1.0);
        let seam = |ring: usize| (sheet.uvs[9 * ring], sheet.uvs[9 * ring + 8]);
        for ring in 0..9 {
            let (left, right) = seam(ring);
            assert_eq!((left[0], right[0], left[1]), (0.0, 3.0, right[1]));
        }
        let texels_along = f64::from(seam(0).0[1] - seam(8).0[1]);
        let texels_around = 3.0 / (std::f64::consts::TAU * 0.05);
        assert!((texels_along / texels_around - 1.0).abs() < 1e-5);
    }

    #[test]
    fn places_between_rings_lie_on_the_line_at_their_station() {
        let centerline = winding();
        let (at_ring, place, _) = between(&centerline, centerline.fraction(5));
        assert!((place - centerline.points[5]).norm() < 1e-12);
        assert!((at_ring.element, at_ring.fraction) == (2, 0.5));
        let (end, place, tangent) = between(&centerline, 1.0);
        assert!((end.element, end.fraction) == (5, 1.0));
        assert!((place - centerline.points[12]).norm() < 1e-12);
        assert!((tangent - centerline.tangents[12]).norm() < 1e-12);
    }

    #[test]
    fn a_blade_after_a_tube_uses_its_own_corners_and_faces_its_normal() {
        let centerline = winding();
        let mut sheet = SkinBuilder::default();
        sheet.add_tube(
            &Tube { centerline: &centerline, radii: &[0.01; 13], sides: 4, wrap: UvMapping::Strip { u: 0.97 } },
            |_, _| 1.0,
        );
        let (before, corners) = (sheet.triangles.len(), sheet.corners.len() as u32);
        let blade = Blade {
            base: Vector3::new(1.0, 0.0, 0.0),
            forward: Vector3::y(),
            normal: Vector3::z(),
            length: 0.2,
            width: 0.1,
            curl: 0.5,
            fold: 0.3,
            span: [0.0, 0.9],
        };
        sheet.add_blade(&blade, station(&centerline, 6));
        assert!(sheet.triangles[before..].as_flattened().iter().all(|corner| *corner >= corners));
        let mesh = sheet.mesh().expect("finite");
        for corner in corners as usize..mesh.corners().vertices.len() {
            assert!(mesh.corners().normals[corner][2] > 0.5);
            assert!(mesh.rest_positions()[mesh.corners().vertices[corner] as usize][0] > 0.9);
        }
    }
}
