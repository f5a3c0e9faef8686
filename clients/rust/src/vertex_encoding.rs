//! Decodes the vectors of vertex attributes. `vertices.proto` defines the encodings and their errors.

use half::f16;
use half::slice::HalfFloatSliceExt as _;
use modalcast_proto::v1::Encoding;

use crate::assemble::decode;
use crate::error::{Result, malformed_reply};

/// Number of consecutive vectors that share a box in [`Encoding::U16Box`].
const BOX_VECTORS: usize = 256;

/// Size of a box in bytes: 6 f32.
const BOX_BYTES: usize = 24;

/// Checks the size of a section with `vector_count` vectors. `field` names the section in errors.
///
/// # Errors
/// `Malformed` when the size does not fit the encoding and the number of vectors, or the encoding is not for vectors.
pub(crate) fn check_section_bytes(field: &str, encoding: Encoding, vector_count: usize, bytes: u64) -> Result<()> {
    let expected_bytes = match encoding {
        // Saturating, because the server may claim any number of vectors.
        Encoding::Unspecified | Encoding::F32 => vector_count.saturating_mul(12),
        Encoding::F16 => vector_count.saturating_mul(6),
        Encoding::U16Box => {
            let box_bytes = vector_count.div_ceil(BOX_VECTORS).saturating_mul(BOX_BYTES);
            box_bytes.saturating_add(vector_count.saturating_mul(6))
        }
        Encoding::OctahedralI16 => vector_count.saturating_mul(4),
        Encoding::F64 => return Err(malformed_reply(field, "an encoding of vectors", "F64")),
    };
    if bytes != expected_bytes as u64 {
        return Err(malformed_reply(format!("{field}.bytes"), expected_bytes, bytes));
    }
    Ok(())
}

/// Decodes `vector_count` vectors, three numbers each. `field` names the section in errors.
///
/// # Errors
/// As for [`check_section_bytes`].
pub(crate) fn decode_vectors(field: &str, encoding: Encoding, vector_count: usize, bytes: &[u8]) -> Result<Vec<f32>> {
    check_section_bytes(field, encoding, vector_count, bytes.len() as u64)?;
    match encoding {
        Encoding::F16 => decode_f16(field, bytes),
        Encoding::U16Box => decode_u16_boxes(field, vector_count, bytes),
        Encoding::OctahedralI16 => decode_octahedral(field, bytes),
        Encoding::Unspecified | Encoding::F32 | Encoding::F64 => decode(field, bytes),
    }
}

fn decode_f16(field: &str, bytes: &[u8]) -> Result<Vec<f32>> {
    let codes: Vec<f16> = decode::<u16>(field, bytes)?.into_iter().map(f16::from_bits).collect();
    let mut numbers = vec![0.0; codes.len()];
    codes.convert_to_f32_slice(&mut numbers);
    Ok(numbers)
}

fn decode_u16_boxes(field: &str, vector_count: usize, bytes: &[u8]) -> Result<Vec<f32>> {
    let (boxes, codes) = bytes.split_at(BOX_BYTES * vector_count.div_ceil(BOX_VECTORS));
    let boxes: Vec<[[f32; 3]; 2]> = decode(field, boxes)?;
    let mut numbers = vec![0.0; 3 * vector_count];
    let (vectors, _) = numbers.as_chunks_mut::<3>();
    let blocks = codes.chunks(6 * BOX_VECTORS).zip(vectors.chunks_mut(BOX_VECTORS));
    for ((codes, vectors), [min, max]) in blocks.zip(&boxes) {
        let min = min.map(f64::from);
        let step: [f64; 3] = std::array::from_fn(|axis| (f64::from(max[axis]) - min[axis]) / f64::from(u16::MAX));
        let (codes, _) = codes.as_chunks::<6>();
        for (vector, [x0, x1, y0, y1, z0, z1]) in vectors.iter_mut().zip(codes) {
            let code = [[*x0, *x1], [*y0, *y1], [*z0, *z1]].map(|bytes| f64::from(u16::from_le_bytes(bytes)));
            *vector = std::array::from_fn(|axis| (min[axis] + code[axis] * step[axis]) as f32);
        }
    }
    Ok(numbers)
}

fn decode_octahedral(field: &str, bytes: &[u8]) -> Result<Vec<f32>> {
    let codes: Vec<[i16; 2]> = decode(field, bytes)?;
    let unit_vector = |code: &[i16; 2]| {
        let [x, y] = code.map(|number| f32::from(number) / f32::from(i16::MAX));
        let z = 1.0 - x.abs() - y.abs();
        // The lower half of the octahedron is folded over the diagonals of the square.
        let [x, y] = if z < 0.0 { [(1.0 - y.abs()).copysign(x), (1.0 - x.abs()).copysign(y)] } else { [x, y] };
        let norm = (x * x + y * y + z * z).sqrt();
        [x / norm, y / norm, z / norm]
    };
    Ok(codes.iter().flat_map(unit_vector).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn decodes_each_encoding() {
        let f16_bytes = [f16::from_f32(1.5), f16::from_f32(-2.0), f16::from_f32(0.25)].map(f16::to_le_bytes).concat();
        assert_eq!(decode_vectors("p", Encoding::F16, 1, &f16_bytes).expect("expected a vector"), [1.5, -2.0, 0.25]);
        let unit_box = [-1.0_f32, 0.0, 2.0, 1.0, 0.0, 2.0].map(f32::to_le_bytes).concat();
        let codes = [65535_u16, 7, 0].map(u16::to_le_bytes).concat();
        let bytes = [unit_box, codes].concat();
        assert_eq!(decode_vectors("p", Encoding::U16Box, 1, &bytes).expect("expected a vector"), [1.0, 0.0, 2.0]);
        // The corner of the square is the pole of the lower half.
        for (code, vector) in
            [([0, 0], [0.0, 0.0, 1.0]), ([32767, 32767], [0.0, 0.0, -1.0]), ([-32767, 0], [-1.0, 0.0, 0.0])]
        {
            let bytes = code.map(i16::to_le_bytes).concat();
            assert_eq!(decode_vectors("n", Encoding::OctahedralI16, 1, &bytes).expect("expected a vector"), vector);
        }
    }

    #[test]
    fn second_box_begins_after_256_vectors() {
        let boxes = [[0.0_f32, 0.0, 0.0, 0.0, 0.0, 0.0], [5.0, 6.0, 7.0, 5.0, 6.0, 7.0]].concat();
        let mut bytes: Vec<u8> = boxes.iter().flat_map(|number| number.to_le_bytes()).collect();
        bytes.extend(vec![0; 6 * 257]);
        let numbers = decode_vectors("p", Encoding::U16Box, 257, &bytes).expect("expected vectors");
        assert_eq!(
            (numbers[3 * 255..3 * 256].to_vec(), numbers[3 * 256..].to_vec()),
            (vec![0.0; 3], vec![5.0, 6.0, 7.0])
        );
    }

    #[test]
    fn sections_of_a_wrong_size_are_rejected() {
        for encoding in [Encoding::F32, Encoding::F16, Encoding::U16Box, Encoding::OctahedralI16, Encoding::F64] {
            assert!(decode_vectors("p", encoding, 2, &[0; 7]).is_err(), "{encoding:?}");
            assert!(decode_vectors("p", encoding, usize::MAX, &[0; 7]).is_err(), "{encoding:?}");
        }
    }
}
