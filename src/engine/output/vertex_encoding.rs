//! How vectors of vertex attributes are stored in bytes. The errors of the encodings are stated in `vertices.proto`.

use bytemuck::NoUninit;
use bytes::Bytes;
use half::f16;
use half::slice::{HalfBitsSliceExt as _, HalfFloatSliceExt as _};
use rayon::prelude::*;

/// How the vectors of an attribute are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Encoding {
    /// 3 f32.
    F32,
    /// 3 f16, rounded to nearest.
    F16,
    /// 3 u16 relative to a box (minimum and maximum, 6 f32) that 256 consecutive vectors share. All boxes come first.
    U16Box,
    /// 2 i16: the octahedral projection of a unit vector.
    OctahedralI16,
    /// f64 numbers; for origins only.
    F64,
}

/// Number of consecutive vectors that share a box.
const BOX_VECTORS: usize = 256;

/// Number of consecutive vectors that one task encodes: 64 boxes.
const TASK_VECTORS: usize = 64 * BOX_VECTORS;

/// Numbers whose bytes in memory are sent unchanged.
struct NumberBytes<T>(Vec<T>);

impl<T: NoUninit> AsRef<[u8]> for NumberBytes<T> {
    fn as_ref(&self) -> &[u8] {
        bytemuck::cast_slice(&self.0)
    }
}

/// The bytes of a list in memory, without a copy.
pub(in crate::engine) fn into_bytes<T: NoUninit + Send>(numbers: Vec<T>) -> Bytes {
    Bytes::from_owner(NumberBytes(numbers))
}

/// Encodes vectors, three numbers each, on all threads of the current rayon pool. Returns their bytes in parts.
pub(super) fn encode_vectors(encoding: Encoding, numbers: &[f32]) -> Vec<Bytes> {
    match encoding {
        Encoding::F32 => vec![into_bytes(numbers.to_vec())],
        Encoding::F16 => vec![encode_f16(numbers)],
        Encoding::U16Box => encode_u16_boxes(numbers),
        Encoding::OctahedralI16 => vec![encode_octahedral(numbers)],
        // A selection contains no f64 numbers.
        Encoding::F64 => vec![into_bytes(numbers.iter().map(|number| f64::from(*number)).collect())],
    }
}

fn encode_f16(numbers: &[f32]) -> Bytes {
    let mut codes = vec![0_u16; numbers.len()];
    let tasks = codes.par_chunks_mut(3 * TASK_VECTORS).zip(numbers.par_chunks(3 * TASK_VECTORS));
    tasks.for_each(|(codes, numbers)| codes.reinterpret_cast_mut::<f16>().convert_from_f32_slice(numbers));
    into_bytes(codes)
}

fn encode_u16_boxes(numbers: &[f32]) -> Vec<Bytes> {
    let mut boxes = vec![[[0.0_f32; 3]; 2]; numbers.len().div_ceil(3 * BOX_VECTORS)];
    let mut codes = vec![0_u16; numbers.len()];
    let blocks = numbers.par_chunks(3 * BOX_VECTORS).zip(codes.par_chunks_mut(3 * BOX_VECTORS)).zip(&mut boxes);
    blocks.with_min_len(TASK_VECTORS / BOX_VECTORS).for_each(|((numbers, codes), bounds)| {
        *bounds = bounds_of(numbers);
        encode_u16_block(numbers, bounds, codes);
    });
    vec![into_bytes(boxes), into_bytes(codes)]
}

/// Encodes the vectors of one box.
fn encode_u16_block(numbers: &[f32], [min, max]: &[[f32; 3]; 2], codes: &mut [u16]) {
    // In f64, so that the error is only that of rounding to an integer.
    let min = min.map(f64::from);
    let scale: [f64; 3] = std::array::from_fn(|axis| {
        let extent = f64::from(max[axis]) - min[axis];
        if extent > 0.0 { f64::from(u16::MAX) / extent } else { 0.0 }
    });
    for (code, vector) in codes.as_chunks_mut::<3>().0.iter_mut().zip(numbers.as_chunks::<3>().0) {
        // Adding one half before the conversion, which truncates, rounds to nearest.
        *code = std::array::from_fn(|axis| ((f64::from(vector[axis]) - min[axis]) * scale[axis] + 0.5) as u16);
    }
}

/// Minimum and maximum of vectors, of which there is at least one.
fn bounds_of(numbers: &[f32]) -> [[f32; 3]; 2] {
    let mut bounds = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
    for vector in numbers.as_chunks::<3>().0 {
        for axis in 0..3 {
            bounds[0][axis] = bounds[0][axis].min(vector[axis]);
            bounds[1][axis] = bounds[1][axis].max(vector[axis]);
        }
    }
    bounds
}

/// Octahedral projection (Cigolle et al., "A Survey of Efficient Representations for Independent Unit Vectors", JCGT
/// 2014): onto the octahedron |x| + |y| + |z| = 1, whose lower half is folded over the diagonals of the square.
fn encode_octahedral(numbers: &[f32]) -> Bytes {
    let project = |[x, y, z]: &[f32; 3]| {
        let norm = x.abs() + y.abs() + z.abs();
        let [x, y, z] = if norm > 0.0 { [x / norm, y / norm, z / norm] } else { [0.0, 0.0, 1.0] };
        let folded = if z < 0.0 { [(1.0 - y.abs()).copysign(x), (1.0 - x.abs()).copysign(y)] } else { [x, y] };
        // The conversion truncates, so adding one half with the number's sign rounds to nearest.
        folded.map(|number| (number * f32::from(i16::MAX) + 0.5_f32.copysign(number)) as i16)
    };
    let vectors = numbers.as_chunks::<3>().0.par_iter().with_min_len(TASK_VECTORS);
    into_bytes(vectors.map(project).collect::<Vec<[i16; 2]>>())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Vectors of random numbers up to `magnitude`.
    fn random_vectors(count: usize, magnitude: f32) -> Vec<f32> {
        let mut random = fastrand::Rng::with_seed(3);
        (0..3 * count).map(|_| magnitude * (2.0 * random.f32() - 1.0)).collect()
    }

    fn encoded(encoding: Encoding, numbers: &[f32]) -> Vec<u8> {
        encode_vectors(encoding, numbers).concat()
    }

    #[test]
    fn f16_error_is_within_its_bound() {
        // Also the largest f16, and a number that is rounded to 0.
        let numbers = [random_vectors(1000, 1000.0), random_vectors(100, 1e-6), vec![0.0, 65504.0, -2e-8]].concat();
        let bytes = encoded(Encoding::F16, &numbers);
        assert_eq!(bytes.len(), 2 * numbers.len());
        let mut max_relative_error = 0.0_f32;
        for (number, code) in numbers.iter().zip(bytes.as_chunks::<2>().0) {
            let error = (f16::from_le_bytes(*code).to_f32() - number).abs();
            assert!(error <= (number.abs() * 2.0_f32.powi(-11)).max(2.0_f32.powi(-25)), "{number}: {error}");
            max_relative_error = max_relative_error.max(error / number.abs().max(1.0));
        }
        assert!(max_relative_error > 2.0_f32.powi(-12), "expected an error near the bound, got {max_relative_error}");
    }

    #[test]
    fn u16_error_is_within_half_a_step_of_its_box() {
        // Boxes of more than one task, and one of a single vector; the second box is far from the first.
        let mut numbers = random_vectors(TASK_VECTORS + BOX_VECTORS + 1, 3.0);
        numbers[3 * BOX_VECTORS..].iter_mut().for_each(|number| *number += 4096.0);
        let bytes = encoded(Encoding::U16Box, &numbers);
        let (boxes, codes) = bytes.split_at(24 * (TASK_VECTORS / BOX_VECTORS + 2));
        assert_eq!(codes.len(), 2 * numbers.len());
        let boxes: Vec<[[f32; 3]; 2]> = bytemuck::pod_collect_to_vec(boxes);
        let mut max_error_in_steps = 0.0_f64;
        for (index, code) in codes.as_chunks::<2>().0.iter().enumerate() {
            let ([min, max], axis) = (boxes[index / (3 * BOX_VECTORS)], index % 3);
            let step = (f64::from(max[axis]) - f64::from(min[axis])) / 65535.0;
            let decoded = f64::from(min[axis]) + f64::from(u16::from_le_bytes(*code)) * step;
            let error = (decoded - f64::from(numbers[index])).abs();
            assert!(error <= step * 0.500_001, "number {index}: {error}, step {step}");
            max_error_in_steps = max_error_in_steps.max(if step > 0.0 { error / step } else { 0.0 });
        }
        assert!(max_error_in_steps > 0.49, "expected an error near the bound, got {max_error_in_steps}");
    }

    #[test]
    fn octahedral_error_is_at_most_4_thousandths_of_a_degree() {
        let mut max_angle = 0.0_f64;
        let axes = [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0]].concat();
        for vector in [random_vectors(20_000, 1.0), axes].concat().as_chunks::<3>().0 {
            let exact = nalgebra::Vector3::from(vector.map(f64::from)).normalize();
            let unit = [exact.x as f32, exact.y as f32, exact.z as f32];
            let bytes = encoded(Encoding::OctahedralI16, &unit);
            let [x, y] =
                [[bytes[0], bytes[1]], [bytes[2], bytes[3]]].map(|code| f64::from(i16::from_le_bytes(code)) / 32767.0);
            let z = 1.0 - x.abs() - y.abs();
            let [x, y] = if z < 0.0 { [(1.0 - y.abs()).copysign(x), (1.0 - x.abs()).copysign(y)] } else { [x, y] };
            let decoded = nalgebra::Vector3::new(x, y, z).normalize();
            max_angle = max_angle.max(decoded.cross(&exact).norm().asin().to_degrees());
        }
        assert!(max_angle <= 0.004 && max_angle > 0.002, "{max_angle} degrees");
        assert_eq!(encoded(Encoding::OctahedralI16, &[0.0; 3]), [0; 4], "the zero vector becomes (0, 0, 1)");
    }

    #[test]
    fn constant_vectors_and_no_vectors_are_exact() {
        for numbers in [vec![], [1e18_f32, -7.0, 0.0].repeat(300)] {
            let bytes = encoded(Encoding::U16Box, &numbers);
            let box_count = numbers.len().div_ceil(3 * BOX_VECTORS);
            assert_eq!(bytes.len(), 24 * box_count + 2 * numbers.len());
            assert!(bytes[24 * box_count..].iter().all(|byte| *byte == 0));
            if let Some(first_box) = bytes.get(..24) {
                assert_eq!(bytemuck::pod_collect_to_vec::<u8, f32>(first_box), [1e18, -7.0, 0.0, 1e18, -7.0, 0.0]);
            }
        }
    }
}
