//! The Adler-32 checksum of a zlib stream (RFC 1950), from the checksums of its parts.

/// The largest prime below 2^16.
const MODULUS: u64 = 65_521;

/// The checksum of no bytes.
pub(super) const EMPTY: u32 = 1;

/// The checksum of bytes with the checksum `first`, followed by `second_bytes` bytes with the checksum `second`.
///
/// The low half of a checksum is 1 + the sum of the bytes. The high half is the sum of the low halves after each byte.
/// Preceding bytes with the sum s therefore add s to the low half of the second checksum, and s times the number of its
/// bytes to the high half.
pub(super) fn combine(first: u32, second: u32, second_bytes: usize) -> u32 {
    let halves = |checksum: u32| (u64::from(checksum & 0xffff), u64::from(checksum >> 16));
    let ((first_sum, first_sums), (second_sum, second_sums)) = (halves(first), halves(second));
    let sum_before = (first_sum + MODULUS - 1) % MODULUS;
    let sum = (sum_before + second_sum) % MODULUS;
    let sums = (first_sums + second_sums + second_bytes as u64 % MODULUS * sum_before) % MODULUS;
    (sums << 16 | sum) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn combined_checksum_is_that_of_all_bytes() {
        let mut random = fastrand::Rng::with_seed(4);
        let bytes: Vec<u8> = (0..200_000).map(|_| random.u8(128..)).collect();
        let expected = simd_adler32::adler32(&&bytes[..]);
        for part_bytes in [1, 1000, 65_521, 65_522, 150_000, 200_000] {
            let add = |sum, part: &[u8]| combine(sum, simd_adler32::adler32(&part), part.len());
            assert_eq!(bytes.chunks(part_bytes).fold(EMPTY, add), expected, "parts of {part_bytes}");
        }
    }
}
