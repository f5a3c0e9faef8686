//! Error metrics of an f32 surface against its reference: meters, fractions of the diagonal, pixels, degrees.

use nalgebra::{Matrix4, Point3, Vector3};
use rayon::prelude::*;
use serde::Serialize;

use super::exact_positions::ReferenceVertex;
use modalcast_model::scene::{Camera, Scene};

/// Image size in which pixel errors are measured: width, height.
pub const IMAGE_SIZE: (u32, u32) = (1920, 1080);

/// Conversion of errors in scene units into meters and pixels.
#[derive(Debug, Clone)]
pub struct ErrorScale {
    /// Meters per scene unit.
    unit: f64,
    /// Diagonal of the scene at rest, meters.
    diagonal: f64,
    /// Projection of the camera in whose image pixel errors are measured.
    clip_from_world: Matrix4<f64>,
}

impl ErrorScale {
    /// Conversion for a scene seen by a camera in an image of [`IMAGE_SIZE`] pixels.
    pub fn new(scene: &Scene, camera: &Camera) -> Self {
        let clip = camera.clip_from_camera(IMAGE_SIZE.0, IMAGE_SIZE.1, &scene.rest_bounds) * camera.camera_from_world();
        Self { unit: scene.unit, diagonal: scene.unit * scene.rest_bounds.diagonal(), clip_from_world: clip }
    }

    /// Meters per scene unit.
    pub const fn unit(&self) -> f64 {
        self.unit
    }

    /// Pixels between the projections of two points; `None` when one is not in front of the camera.
    fn pixel_distance(&self, first: [f64; 3], second: [f64; 3]) -> Option<f64> {
        let project = |point: [f64; 3]| {
            let clip = self.clip_from_world * Point3::from(point).to_homogeneous();
            let half_size = [f64::from(IMAGE_SIZE.0) / 2.0, f64::from(IMAGE_SIZE.1) / 2.0];
            (clip.w > 0.0).then(|| [clip.x / clip.w * half_size[0], clip.y / clip.w * half_size[1]])
        };
        let (first, second) = (project(first)?, project(second)?);
        Some((first[0] - second[0]).hypot(first[1] - second[1]))
    }
}

/// Maximum and root mean square of a quantity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ErrorNorms {
    pub largest: f64,
    pub rms: f64,
}

/// Accumulator for [`ErrorNorms`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct NormAccumulator {
    largest: f64,
    sum_of_squares: f64,
    count: f64,
}

impl NormAccumulator {
    pub(super) fn add(&mut self, value: f64) {
        self.largest = self.largest.max(value);
        self.sum_of_squares += value * value;
        self.count += 1.0;
    }

    pub(super) fn join(self, other: Self) -> Self {
        Self {
            largest: self.largest.max(other.largest),
            sum_of_squares: self.sum_of_squares + other.sum_of_squares,
            count: self.count + other.count,
        }
    }

    /// The norms, times `scale`; `None` when no value was added.
    pub(super) fn norms(self, scale: f64) -> Option<ErrorNorms> {
        let rms = (self.sum_of_squares / self.count).sqrt();
        (self.count > 0.0).then_some(ErrorNorms { largest: self.largest * scale, rms: rms * scale })
    }
}

/// Position errors over all vertices and all validated states.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PositionErrors {
    /// Lengths of the error vectors.
    #[serde(rename = "metres")]
    pub meters: ErrorNorms,
    /// `meters` divided by the diagonal of the scene at rest.
    pub of_diagonal: ErrorNorms,
    /// Projected errors in an image of [`IMAGE_SIZE`] pixels that frames the scene.
    pub pixels: Option<ErrorNorms>,
    /// Mean signed error along each axis, meters.
    #[serde(rename = "bias_metres")]
    pub bias_meters: [f64; 3],
    /// Largest a-priori bound, meters.
    #[serde(rename = "bound_metres")]
    pub bound_meters: f64,
    /// Largest quotient of a vertex's error and its own bound; the variant fails if it exceeds 1.
    pub of_bound: f64,
    /// Coordinates that are not finite.
    pub not_finite: u64,
    /// Validated states.
    pub states: usize,
}

/// Accumulator for [`PositionErrors`], in scene units.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct PositionErrorAccumulator {
    /// Lengths of the error vectors.
    length: NormAccumulator,
    /// Projected errors.
    pixels: NormAccumulator,
    /// Sum of the error vectors.
    error_sum: [f64; 3],
    /// Largest bound of a vertex.
    max_bound: f64,
    /// Largest quotient of a vertex's error and its own bound.
    max_of_bound: f64,
    not_finite: u64,
    states: usize,
}

impl PositionErrorAccumulator {
    /// Adds one state. `got`: three f32 per vertex; `want`: reference and bound per vertex.
    pub fn add(&mut self, error_scale: &ErrorScale, got: &[f32], want: &[ReferenceVertex]) {
        let got = got.as_chunks::<3>().0;
        let add_vertex = |index: usize, sums: &mut Self| sums.add_vertex(error_scale, got[index], &want[index]);
        let sums = reduce_parallel(got.len().min(want.len()), add_vertex, Self::join);
        *self = Self { states: 1, ..sums }.join(*self);
    }

    /// Adds a vertex. A position that is not finite only counts as such.
    fn add_vertex(&mut self, error_scale: &ErrorScale, got: [f32; 3], want: &ReferenceVertex) {
        let got = got.map(f64::from);
        let not_finite = got.iter().filter(|number| !number.is_finite()).count();
        self.not_finite += not_finite as u64;
        if not_finite > 0 {
            return;
        }
        let error: [f64; 3] = std::array::from_fn(|axis| got[axis] - want.position[axis]);
        let length = norm(error);
        self.length.add(length);
        self.error_sum = std::array::from_fn(|axis| self.error_sum[axis] + error[axis]);
        self.max_bound = self.max_bound.max(want.bound);
        self.max_of_bound = self.max_of_bound.max(length / want.bound);
        if let Some(pixels) = error_scale.pixel_distance(got, want.position) {
            self.pixels.add(pixels);
        }
    }

    fn join(self, other: Self) -> Self {
        Self {
            length: self.length.join(other.length),
            pixels: self.pixels.join(other.pixels),
            error_sum: std::array::from_fn(|axis| self.error_sum[axis] + other.error_sum[axis]),
            max_bound: self.max_bound.max(other.max_bound),
            max_of_bound: self.max_of_bound.max(other.max_of_bound),
            not_finite: self.not_finite + other.not_finite,
            states: self.states + other.states,
        }
    }

    /// The accumulated position errors in the units of [`PositionErrors`].
    pub fn errors(&self, error_scale: &ErrorScale) -> PositionErrors {
        let meters = self.length.norms(error_scale.unit).unwrap_or_default();
        let share = |length: f64| if error_scale.diagonal > 0.0 { length / error_scale.diagonal } else { 0.0 };
        PositionErrors {
            meters,
            of_diagonal: ErrorNorms { largest: share(meters.largest), rms: share(meters.rms) },
            pixels: self.pixels.norms(1.0),
            bias_meters: self.error_sum.map(|sum| error_scale.unit * sum / self.length.count.max(1.0)),
            bound_meters: self.max_bound * error_scale.unit,
            of_bound: self.max_of_bound,
            not_finite: self.not_finite,
            states: self.states,
        }
    }
}

impl PositionErrors {
    /// Whether every number is finite and every error is within its vertex's own bound.
    pub fn passed(&self) -> bool {
        self.not_finite == 0 && self.of_bound <= 1.0
    }
}

/// Error of the displacement x(k + 1) - x(k) between consecutive states k and k + 1, scene units.
pub(super) fn step_errors(got: [&[f32]; 2], want: [&[ReferenceVertex]; 2]) -> NormAccumulator {
    let [got_before, got_after] = got.map(|got| got.as_chunks::<3>().0);
    let [want_before, want_after] = want;
    let error = |index: usize| -> f64 {
        let axis_error = |axis: usize| {
            f64::from(got_after[index][axis])
                - f64::from(got_before[index][axis])
                - (want_after[index].position[axis] - want_before[index].position[axis])
        };
        norm(std::array::from_fn(axis_error))
    };
    let count = got_before.len().min(got_after.len()).min(want_before.len()).min(want_after.len());
    reduce_parallel(count, |index, norms: &mut NormAccumulator| norms.add(error(index)), NormAccumulator::join)
}

/// The elements with these indices.
pub(super) fn select<T: Copy + Send + Sync>(elements: &[T], indices: &[u32]) -> Vec<T> {
    indices.par_iter().map(|index| elements[*index as usize]).collect()
}

/// Parallel reduction of items 0 to `count`. Blocks have a fixed size and are joined in order, so that the result does
/// not depend on the thread count.
pub(super) fn reduce_parallel<T: Default + Send>(
    count: usize,
    add: impl Fn(usize, &mut T) + Sync,
    join: impl Fn(T, T) -> T,
) -> T {
    let reduce_block = |block: usize| {
        let mut sum = T::default();
        (BLOCK * block..count.min(BLOCK * (block + 1))).for_each(|index| add(index, &mut sum));
        sum
    };
    let sums: Vec<T> = (0..count.div_ceil(BLOCK)).into_par_iter().map(reduce_block).collect();
    sums.into_iter().fold(T::default(), join)
}

/// Items per block of a reduction.
const BLOCK: usize = 4096;

/// Errors of normals and tangents, in degrees.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct OrientationErrors {
    /// Against the normals that the variant's deformation defines: rest normals rotated by T, or those of the deformed
    /// surface.
    pub normals_degrees: Option<ErrorNorms>,
    /// Against the normals of the deformed surface, whichever normals the variant defines.
    pub normals_to_surface_degrees: Option<ErrorNorms>,
    pub tangents_degrees: Option<ErrorNorms>,
    /// |n . t| of normal and tangent, which should be 0.
    pub normal_dot_tangent: Option<ErrorNorms>,
    /// Number of normals and tangents that are not finite, have a length of at most 0.5 or a wrong bitangent sign.
    #[serde(rename = "broken")]
    pub invalid_directions: u64,
}

/// Accumulator for [`OrientationErrors`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct OrientationErrorAccumulator {
    normals: NormAccumulator,
    /// Normals against those of the deformed surface.
    to_surface: NormAccumulator,
    tangents: NormAccumulator,
    dots: NormAccumulator,
    invalid_directions: u64,
}

impl OrientationErrorAccumulator {
    /// Adds normals, three f32 per corner. Does nothing if `got` is empty.
    pub fn add_normals(&mut self, got: &[f32], want: &[[f64; 3]]) {
        let got = got.as_chunks::<3>().0;
        let add_corner = |corner: usize, sums: &mut Self| match angle_degrees(got[corner].map(f64::from), want[corner])
        {
            Some(angle) => sums.normals.add(angle),
            None => sums.invalid_directions += 1,
        };
        *self = self.join(reduce_parallel(got.len().min(want.len()), add_corner, Self::join));
    }

    /// Adds the angles between normals, three f32 per corner, and the normals of the deformed surface.
    pub fn add_normals_to_surface(&mut self, got: &[f32], want: &[[f64; 3]]) {
        let got = got.as_chunks::<3>().0;
        let add_corner = |corner: usize, sums: &mut Self| {
            angle_degrees(got[corner].map(f64::from), want[corner])
                .into_iter()
                .for_each(|angle| sums.to_surface.add(angle));
        };
        *self = self.join(reduce_parallel(got.len().min(want.len()), add_corner, Self::join));
    }

    /// Adds tangents, four f32 per corner, and their dot products with the normals. Reference tangents of shapes
    /// without tangents are zero; these corners are skipped.
    pub fn add_tangents(&mut self, got: &[f32], want: &[[f64; 4]], normals: &[f32]) {
        let (got, normals) = (got.as_chunks::<4>().0, normals.as_chunks::<3>().0);
        let add_corner = |corner: usize, sums: &mut Self| {
            if want[corner][3] != 0.0 {
                sums.add_tangent(got[corner].map(f64::from), want[corner], normals.get(corner));
            }
        };
        *self = self.join(reduce_parallel(got.len().min(want.len()), add_corner, Self::join));
    }

    fn add_tangent(&mut self, [x, y, z, sign]: [f64; 4], want: [f64; 4], normal: Option<&[f32; 3]>) {
        match angle_degrees([x, y, z], [want[0], want[1], want[2]]) {
            Some(angle) if sign == want[3] => self.tangents.add(angle),
            _ => self.invalid_directions += 1,
        }
        if let Some(normal) = normal {
            self.dots.add(Vector3::from(normal.map(f64::from)).dot(&Vector3::new(x, y, z)).abs());
        }
    }

    fn join(self, other: Self) -> Self {
        Self {
            normals: self.normals.join(other.normals),
            to_surface: self.to_surface.join(other.to_surface),
            tangents: self.tangents.join(other.tangents),
            dots: self.dots.join(other.dots),
            invalid_directions: self.invalid_directions + other.invalid_directions,
        }
    }

    /// The accumulated orientation errors.
    pub fn orientation(&self) -> OrientationErrors {
        OrientationErrors {
            normals_degrees: self.normals.norms(1.0),
            normals_to_surface_degrees: self.to_surface.norms(1.0),
            tangents_degrees: self.tangents.norms(1.0),
            normal_dot_tangent: self.dots.norms(1.0),
            invalid_directions: self.invalid_directions,
        }
    }
}

/// The angle between two directions, which should be unit vectors. `None` when it is not finite, or when a length is at
/// most 0.5, such as that of a zero vector. Uses atan2, because the arc cosine is inaccurate for small angles.
fn angle_degrees(first: [f64; 3], second: [f64; 3]) -> Option<f64> {
    let (first, second) = (Vector3::from(first), Vector3::from(second));
    let angle = first.cross(&second).norm().atan2(first.dot(&second)).to_degrees();
    (angle.is_finite() && first.norm() > 0.5 && second.norm() > 0.5).then_some(angle)
}

fn norm(vector: [f64; 3]) -> f64 {
    vector.iter().map(|number| number * number).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::{Lens, View};

    /// A scale with 2 meters and 100 pixels per scene unit. At the target, one pixel is 0.01 scene units: the distance
    /// of 10 from the eye divided by the focal length of 1000 pixels.
    fn scale_of_2_meters_and_100_pixels() -> ErrorScale {
        let scene = modalcast_model::load::open("tree").expect("the tree").scene;
        let view = View::LookAt { eye: [0.0, 0.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        let (width, height) = (f64::from(IMAGE_SIZE.0), f64::from(IMAGE_SIZE.1));
        let lens = Lens::Intrinsics { fx: 1000.0, fy: 1000.0, cx: width / 2.0, cy: height / 2.0 };
        let error_scale = ErrorScale::new(&scene, &Camera { view, lens, near: 1.0, far: 100.0 });
        ErrorScale { unit: 2.0, diagonal: 20.0, ..error_scale }
    }

    fn reference(position: [f64; 3], bound: f64) -> ReferenceVertex {
        ReferenceVertex { position, bound, condition: 1.0 }
    }

    #[test]
    fn given_surface_has_the_expected_errors() {
        let error_scale = scale_of_2_meters_and_100_pixels();
        let mut accumulator = PositionErrorAccumulator::default();
        // The error vectors are (3, 4, 0) and zero. Their lengths are 5 and 0 scene units, or 10 m and 0. The length of
        // 5 takes 500 pixels.
        accumulator.add(
            &error_scale,
            &[3.0, 4.0, 0.0, 1.0, 1.0, 1.0],
            &[reference([0.0; 3], 10.0), reference([1.0; 3], 1.0)],
        );
        let errors = accumulator.errors(&error_scale);
        // The mean square of the lengths is (25 + 0) / 2 = 12.5.
        assert_eq!((errors.meters.largest, errors.meters.rms), (10.0, 2.0 * 12.5_f64.sqrt()));
        // 10 m of the diagonal of 20 m.
        assert_eq!(errors.of_diagonal.largest, 0.5);
        // The mean error vector, 2 m * (3, 4, 0) / 2.
        assert_eq!(errors.bias_meters, [3.0, 4.0, 0.0]);
        assert_eq!((errors.bound_meters, errors.of_bound, errors.states), (20.0, 0.5, 1));
        assert!((errors.pixels.expect("expected a pixel error").largest - 500.0).abs() < 1e-9, "{errors:?}");
        assert!(errors.passed());
        // The mirrored error cancels the bias and changes nothing else.
        accumulator.add(
            &error_scale,
            &[-3.0, -4.0, 0.0, 1.0, 1.0, 1.0],
            &[reference([0.0; 3], 10.0), reference([1.0; 3], 1.0)],
        );
        let both = accumulator.errors(&error_scale);
        assert_eq!((both.bias_meters, both.meters, both.states), ([0.0; 3], errors.meters, 2));
    }

    #[test]
    fn error_above_its_own_bound_fails_despite_larger_bounds() {
        let error_scale = scale_of_2_meters_and_100_pixels();
        let mut accumulator = PositionErrorAccumulator::default();
        // The error of the first vertex is 1.1. It exceeds the vertex's own bound of 1, but not the other bound of 100.
        let want = [reference([0.0; 3], 1.0), reference([0.0; 3], 100.0)];
        accumulator.add(&error_scale, &[1.1, 0.0, 0.0, 0.0, 0.0, 0.0], &want);
        assert!(!accumulator.errors(&error_scale).passed());
        let mut not_finite = PositionErrorAccumulator::default();
        not_finite.add(&error_scale, &[f32::NAN, 0.0, 0.0, 0.0, f32::INFINITY, 0.0], &want);
        assert_eq!((not_finite.errors(&error_scale).not_finite, not_finite.errors(&error_scale).passed()), (2, false));
    }

    #[test]
    fn point_behind_camera_has_no_pixel_error() {
        let error_scale = scale_of_2_meters_and_100_pixels();
        assert_eq!(error_scale.pixel_distance([0.0, 0.0, 11.0], [0.0; 3]), None);
        let distance = error_scale.pixel_distance([0.01, 0.0, 0.0], [0.0; 3]).expect("expected a distance");
        assert!((distance - 1.0).abs() < 1e-12, "{distance}");
    }

    #[test]
    fn constant_offset_gives_no_step_error() {
        let want = [[reference([0.0; 3], 1.0)], [reference([1.0, 0.0, 0.0], 1.0)]];
        let steps = |got: [[f32; 3]; 2]| step_errors([&got[0], &got[1]], [&want[0], &want[1]]).norms(1.0);
        assert_eq!(steps([[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]]), Some(ErrorNorms::default()));
        assert_eq!(steps([[0.0; 3], [1.5, 0.0, 0.0]]).map(|norms| norms.largest), Some(0.5));
    }

    #[test]
    fn measures_tiny_angles_in_degrees() {
        let mut orthogonal = OrientationErrorAccumulator::default();
        orthogonal.add_normals(&[0.0, 1.0, 0.0, 1.0, 1e-7, 0.0], &[[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]);
        let normals = orthogonal.orientation().normals_degrees.expect("expected two normals");
        assert_eq!(normals.largest, 90.0);
        let mut small = OrientationErrorAccumulator::default();
        small.add_normals(&[1.0, 1e-7, 0.0], &[[1.0, 0.0, 0.0]]);
        let angle = small.orientation().normals_degrees.expect("expected a normal").largest;
        assert!((angle / 1e-7f64.to_degrees() - 1.0).abs() < 1e-6, "{angle}");
    }

    #[test]
    fn counts_invalid_directions_but_not_absent_tangents() {
        let mut accumulator = OrientationErrorAccumulator::default();
        let want = [[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, -1.0], [0.0; 4]];
        let got = [1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        accumulator.add_tangents(&got, &want, &[0.6, 0.8, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        accumulator.add_normals(&[f32::NAN, 0.0, 0.0], &[[1.0, 0.0, 0.0]]);
        // Invalid: the sign of the second tangent, and the normal. The third corner has no reference tangent.
        let found = accumulator.orientation();
        assert_eq!((found.invalid_directions, found.tangents_degrees), (2, Some(ErrorNorms::default())));
        let dot = found.normal_dot_tangent.expect("expected dot products").largest;
        // The first normal and tangent: (0.6, 0.8, 0) . (1, 0, 0).
        assert!((dot - f64::from(0.6_f32)).abs() < 1e-12, "{dot}");
    }
}
