//! The order in which the coefficients of a block are stored: figure A.6 of ITU-T T.81.

/// Index of each coefficient of the zigzag sequence in a row-major block.
#[rustfmt::skip]
pub(super) const ZIGZAG: [u8; 64] = [
    0, 1, 8, 16, 9, 2, 3, 10, 17, 24, 32, 25, 18, 11, 4, 5,
    12, 19, 26, 33, 40, 48, 41, 34, 27, 20, 13, 6, 7, 14, 21, 28,
    35, 42, 49, 56, 57, 50, 43, 36, 29, 22, 15, 23, 30, 37, 44, 51,
    58, 59, 52, 45, 38, 31, 39, 46, 53, 60, 61, 54, 47, 55, 62, 63,
];

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zigzag_visits_every_coefficient_by_diagonals() {
        let mut indices = ZIGZAG;
        indices.sort_unstable();
        assert!(indices.iter().enumerate().all(|(index, entry)| index == usize::from(*entry)));
        let diagonal = |index: &u8| index / 8 + index % 8;
        assert!(ZIGZAG.is_sorted_by_key(diagonal));
    }
}
