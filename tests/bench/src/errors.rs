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
    fn pixels(&self, one: [f64; 3], other: [f64; 3]) -> Option<f64> {
        let place = |point: [f64; 3]| {
            let clip = self.clip_from_world * Point3::from(point).to_homogeneous();
            let half = [f64::from(IMAGE_SIZE.0) / 2.0, f64::from(IMAGE_SIZE.1) / 2.0];
            (clip.w > 0.0).then(|| [clip.x / clip.w * half[0], clip.y / clip.w * half[1]])
        };
        let (one, other) = (place(one)?, place(other)?);
        Some((one[0] - other[0]).hypot(one[1] - other[1]))
    }
}

/// Maximum and root mean square of a quantity.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ErrorNorms {
    pub largest: f64,
    pub rms: f64,
}

/// Accumulator for a [`ErrorNorms`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct NormAccumulator {
    largest: f64,
    squares: f64,
    count: f64,
}

impl NormAccumulator {
    pub(super) fn add(&mut self, value: f64) {
        self.largest = self.largest.max(value);
        self.squares += value * value;
        self.count += 1.0;
    }

    pub(super) fn join(self, other: Self) -> Self {
        Self {
            largest: self.largest.max(other.largest),
            squares: self.squares + other.squares,
            count: self.count + other.count,
        }
    }

    /// The result, times `scale`; `None` when no value was added.
    pub(super) fn spread(self, scale: f64) -> Option<ErrorNorms> {
        let rms = (self.squares / self.count).sqrt();
        (self.count > 0.0).then_some(ErrorNorms { largest: self.largest * scale, rms: rms * scale })
    }
}

/// Position errors over all vertices and all validated states.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PositionErrors {
    /// Lengths of the error vectors.
    #[serde(rename = "metres")]
    pub meters: ErrorNorms,
    /// The same as fractions of the diagonal of the scene at rest.
    pub of_diagonal: ErrorNorms,
    /// The same in pixels of an image of [`IMAGE_SIZE`] pixels that frames the scene.
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
    length: NormAccumulator,
    pixels: NormAccumulator,
    bias: [f64; 3],
    bound: f64,
    of_bound: f64,
    not_finite: u64,
    states: usize,
}

impl PositionErrorAccumulator {
    /// Adds one state. `got`: three f32 per vertex; `want`: reference and bound per vertex.
    pub fn add(&mut self, yardstick: &ErrorScale, got: &[f32], want: &[ReferenceVertex]) {
        let got = got.as_chunks::<3>().0;
        let vertex = |at: usize, tally: &mut Self| tally.vertex(yardstick, got[at], &want[at]);
        let sum = in_pieces(got.len().min(want.len()), vertex, Self::join);
        *self = Self { states: 1, ..sum }.join(*self);
    }

    fn vertex(&mut self, yardstick: &ErrorScale, got: [f32; 3], want: &ReferenceVertex) {
        let got = got.map(f64::from);
        let broken = got.iter().filter(|number| !number.is_finite()).count();
        self.not_finite += broken as u64;
        if broken > 0 {
            return;
        }
        let error: [f64; 3] = std::array::from_fn(|axis| got[axis] - want.at[axis]);
        let length = norm(error);
        self.length.add(length);
        self.bias = std::array::from_fn(|axis| self.bias[axis] + error[axis]);
        self.bound = self.bound.max(want.bound);
        self.of_bound = self.of_bound.max(length / want.bound);
        if let Some(pixels) = yardstick.pixels(got, want.at) {
            self.pixels.add(pixels);
        }
    }

    fn join(self, other: Self) -> Self {
        Self {
            length: self.length.join(other.length),
            pixels: self.pixels.join(other.pixels),
            bias: std::array::from_fn(|axis| self.bias[axis] + other.bias[axis]),
            bound: self.bound.max(other.bound),
            of_bound: self.of_bound.max(other.of_bound),
            not_finite: self.not_finite + other.not_finite,
            states: self.states + other.states,
        }
    }

    /// The accumulated position errors in the units of [`PositionErrors`].
    pub fn errors(&self, yardstick: &ErrorScale) -> PositionErrors {
        let meters = self.length.spread(yardstick.unit).unwrap_or_default();
        let share = |length: f64| if yardstick.diagonal > 0.0 { length / yardstick.diagonal } else { 0.0 };
        PositionErrors {
            meters,
            of_diagonal: ErrorNorms { largest: share(meters.largest), rms: share(meters.rms) },
            pixels: self.pixels.spread(1.0),
            bias_meters: self.bias.map(|sum| yardstick.unit * sum / self.length.count.max(1.0)),
            bound_meters: self.bound * yardstick.unit,
            of_bound: self.of_bound,
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

/// Error of the displacement x(k + 1) - x(k) between consecutive states, scene units.
pub(super) fn step_errors(got: [&[f32]; 2], want: [&[ReferenceVertex]; 2]) -> NormAccumulator {
    let [before, after] = got.map(|got| got.as_chunks::<3>().0);
    let [from, to] = want;
    let error = |at: usize| -> f64 {
        let step = |axis: usize| {
            f64::from(after[at][axis]) - f64::from(before[at][axis]) - (to[at].at[axis] - from[at].at[axis])
        };
        norm(std::array::from_fn(step))
    };
    let count = before.len().min(after.len()).min(from.len()).min(to.len());
    in_pieces(count, |at, collect: &mut NormAccumulator| collect.add(error(at)), NormAccumulator::join)
}

/// Parallel reduction of items 0 to `count`. Pieces have a fixed size and are joined in order, so that the result does
/// not depend on the thread count.
pub(super) fn in_pieces<T: Default + Send>(
    count: usize,
    add: impl Fn(usize, &mut T) + Sync,
    join: impl Fn(T, T) -> T,
) -> T {
    let piece = |piece: usize| {
        let mut sum = T::default();
        (PIECE * piece..count.min(PIECE * (piece + 1))).for_each(|at| add(at, &mut sum));
        sum
    };
    let pieces: Vec<T> = (0..count.div_ceil(PIECE)).into_par_iter().map(piece).collect();
    pieces.into_iter().fold(T::default(), join)
}

/// Items per piece of a reduction.
const PIECE: usize = 4096;

/// Errors of normals and tangents, in degrees.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct OrientationErrors {
    /// Against the normals that the variant's deformation defines: rigid ones (by T), or those of the deformed surface.
    pub normals_degrees: Option<ErrorNorms>,
    /// Against the normals of the deformed surface, whichever normals the variant defines.
    pub normals_to_surface_degrees: Option<ErrorNorms>,
    pub tangents_degrees: Option<ErrorNorms>,
    /// |n . t|, which is 0 when they are orthogonal.
    pub normal_dot_tangent: Option<ErrorNorms>,
    /// Directions that are not finite or have a length of at most 0.5, and bitangent signs that are wrong.
    pub broken: u64,
}

/// Accumulator for [`OrientationErrors`].
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct OrientationErrorAccumulator {
    normals: NormAccumulator,
    to_surface: NormAccumulator,
    tangents: NormAccumulator,
    dots: NormAccumulator,
    broken: u64,
}

impl OrientationErrorAccumulator {
    /// Adds normals, three f32 per corner. Does nothing when `got` is empty.
    pub fn add_normals(&mut self, got: &[f32], want: &[[f64; 3]]) {
        let got = got.as_chunks::<3>().0;
        let corner = |at: usize, sum: &mut Self| match degrees(got[at].map(f64::from), want[at]) {
            Some(angle) => sum.normals.add(angle),
            None => sum.broken += 1,
        };
        *self = self.join(in_pieces(got.len().min(want.len()), corner, Self::join));
    }

    /// Adds the angles between normals and those of the deformed surface.
    pub fn add_to_surface(&mut self, got: &[f32], want: &[[f64; 3]]) {
        let got = got.as_chunks::<3>().0;
        let corner = |at: usize, sum: &mut Self| {
            degrees(got[at].map(f64::from), want[at]).into_iter().for_each(|angle| sum.to_surface.add(angle));
        };
        *self = self.join(in_pieces(got.len().min(want.len()), corner, Self::join));
    }

    /// Adds tangents, four f32 per corner, and their dot products with the normals. Reference tangents of shapes
    /// without tangents are zero; these corners are skipped.
    pub fn add_tangents(&mut self, got: &[f32], want: &[[f64; 4]], normals: &[f32]) {
        let (got, normals) = (got.as_chunks::<4>().0, normals.as_chunks::<3>().0);
        let corner = |at: usize, sum: &mut Self| {
            if want[at][3] != 0.0 {
                sum.add_tangent(got[at].map(f64::from), want[at], normals.get(at));
            }
        };
        *self = self.join(in_pieces(got.len().min(want.len()), corner, Self::join));
    }

    fn add_tangent(&mut self, [x, y, z, sign]: [f64; 4], want: [f64; 4], normal: Option<&[f32; 3]>) {
        match degrees([x, y, z], [want[0], want[1], want[2]]) {
            Some(angle) if sign == want[3] => self.tangents.add(angle),
            _ => self.broken += 1,
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
            broken: self.broken + other.broken,
        }
    }

    /// The accumulated errors of directions.
    pub fn orientation(&self) -> OrientationErrors {
        OrientationErrors {
            normals_degrees: self.normals.spread(1.0),
            normals_to_surface_degrees: self.to_surface.spread(1.0),
            tangents_degrees: self.tangents.spread(1.0),
            normal_dot_tangent: self.dots.spread(1.0),
            broken: self.broken,
        }
    }
}

/// The angle between two directions; `None` when it is not finite or either is no longer than 0.5. Uses atan2, which is
/// accurate for small angles, where the arc cosine loses precision.
fn degrees(one: [f64; 3], other: [f64; 3]) -> Option<f64> {
    let (one, other) = (Vector3::from(one), Vector3::from(other));
    let angle = one.cross(&other).norm().atan2(one.dot(&other)).to_degrees();
    (angle.is_finite() && one.norm() > 0.5 && other.norm() > 0.5).then_some(angle)
}

fn norm(vector: [f64; 3]) -> f64 {
    vector.iter().map(|number| number * number).sum::<f64>().sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::scene::{Lens, View};

    /// A yardstick for which one pixel is a hundredth of a unit at the target.
    fn yardstick() -> ErrorScale {
        let scene = modalcast_model::load::open("tree").expect("the tree").scene;
        let view = View::LookAt { eye: [0.0, 0.0, 10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        let (width, height) = (f64::from(IMAGE_SIZE.0), f64::from(IMAGE_SIZE.1));
        let lens = Lens::Intrinsics { fx: 1000.0, fy: 1000.0, cx: width / 2.0, cy: height / 2.0 };
        let yardstick = ErrorScale::new(&scene, &Camera { view, lens, near: 1.0, far: 100.0 });
        ErrorScale { unit: 2.0, diagonal: 20.0, ..yardstick }
    }

    fn judged(at: [f64; 3], bound: f64) -> ReferenceVertex {
        ReferenceVertex { at, bound, condition: 1.0 }
    }

    #[test]
    fn hand_made_surface_has_the_expected_errors() {
        let yardstick = yardstick();
        let mut tally = PositionErrorAccumulator::default();
        // The error vectors are (3, 4, 0) and zero: lengths 5 and 0.
        tally.add(&yardstick, &[3.0, 4.0, 0.0, 1.0, 1.0, 1.0], &[judged([0.0; 3], 10.0), judged([1.0; 3], 1.0)]);
        let errors = tally.errors(&yardstick);
        assert_eq!((errors.meters.largest, errors.meters.rms), (10.0, 2.0 * 12.5_f64.sqrt()));
        assert_eq!(errors.of_diagonal.largest, 0.5);
        assert_eq!(errors.bias_meters, [3.0, 4.0, 0.0]);
        assert_eq!((errors.bound_meters, errors.of_bound, errors.states), (20.0, 0.5, 1));
        assert!((errors.pixels.expect("in sight").largest - 500.0).abs() < 1e-9, "{errors:?}");
        assert!(errors.passed());
        // The mirrored error cancels the bias and changes nothing else.
        tally.add(&yardstick, &[-3.0, -4.0, 0.0, 1.0, 1.0, 1.0], &[judged([0.0; 3], 10.0), judged([1.0; 3], 1.0)]);
        let both = tally.errors(&yardstick);
        assert_eq!((both.bias_meters, both.meters, both.states), ([0.0; 3], errors.meters, 2));
    }

    #[test]
    fn error_above_its_own_bound_fails_despite_larger_bounds() {
        let yardstick = yardstick();
        let mut tally = PositionErrorAccumulator::default();
        let want = [judged([0.0; 3], 1.0), judged([0.0; 3], 100.0)];
        tally.add(&yardstick, &[1.1, 0.0, 0.0, 0.0, 0.0, 0.0], &want);
        assert!(!tally.errors(&yardstick).passed());
        let mut broken = PositionErrorAccumulator::default();
        broken.add(&yardstick, &[f32::NAN, 0.0, 0.0, 0.0, f32::INFINITY, 0.0], &want);
        assert_eq!((broken.errors(&yardstick).not_finite, broken.errors(&yardstick).passed()), (2, false));
    }

    #[test]
    fn point_behind_camera_has_no_pixel_error() {
        let yardstick = yardstick();
        assert_eq!(yardstick.pixels([0.0, 0.0, 11.0], [0.0; 3]), None);
        let apart = yardstick.pixels([0.01, 0.0, 0.0], [0.0; 3]).expect("before it");
        assert!((apart - 1.0).abs() < 1e-12, "{apart}");
    }

    #[test]
    fn constant_offset_gives_no_step_error() {
        let want = [[judged([0.0; 3], 1.0)], [judged([1.0, 0.0, 0.0], 1.0)]];
        let steps = |got: [[f32; 3]; 2]| step_errors([&got[0], &got[1]], [&want[0], &want[1]]).spread(1.0);
        assert_eq!(steps([[5.0, 0.0, 0.0], [6.0, 0.0, 0.0]]), Some(ErrorNorms::default()));
        assert_eq!(steps([[0.0; 3], [1.5, 0.0, 0.0]]).map(|spread| spread.largest), Some(0.5));
    }

    #[test]
    fn measures_tiny_angles_in_degrees() {
        let mut turned = OrientationErrorAccumulator::default();
        turned.add_normals(&[0.0, 1.0, 0.0, 1.0, 1e-7, 0.0], &[[1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]);
        let normals = turned.orientation().normals_degrees.expect("two");
        assert_eq!(normals.largest, 90.0);
        let mut small = OrientationErrorAccumulator::default();
        small.add_normals(&[1.0, 1e-7, 0.0], &[[1.0, 0.0, 0.0]]);
        let angle = small.orientation().normals_degrees.expect("one").largest;
        assert!((angle / 1e-7f64.to_degrees() - 1.0).abs() < 1e-6, "{angle}");
    }

    #[test]
    fn counts_broken_directions_but_not_absent_tangents() {
        let mut turned = OrientationErrorAccumulator::default();
        let want = [[1.0, 0.0, 0.0, 1.0], [1.0, 0.0, 0.0, -1.0], [0.0; 4]];
        let got = [1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0];
        turned.add_tangents(&got, &want, &[0.6, 0.8, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        turned.add_normals(&[f32::NAN, 0.0, 0.0], &[[1.0, 0.0, 0.0]]);
        let found = turned.orientation();
        assert_eq!((found.broken, found.tangents_degrees), (2, Some(ErrorNorms::default())));
        let dot = found.normal_dot_tangent.expect("dots").largest;
        assert!((dot - f64::from(0.6_f32)).abs() < 1e-12, "{dot}");
    }
}
