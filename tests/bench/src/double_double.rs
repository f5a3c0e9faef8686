//! Sums of products in twice the precision of f64 (double-double), for sums that cancel.
//!
//! Uses the error-free transformations of Ogita, Rump and Oishi, "Accurate sum and dot product", SIAM J. Sci. Comput.
//! 26 (2005). The result is as if computed with 106 bits and rounded once.

/// a + b as a rounded sum and its exact error (Knuth).
pub(super) fn two_sum(a: f64, b: f64) -> (f64, f64) {
    let sum = a + b;
    // The parts of a and b that the rounded sum contains.
    let b_part = sum - a;
    let a_part = sum - b_part;
    (sum, (a - a_part) + (b - b_part))
}

/// a b as a rounded product and its exact error.
pub(super) fn two_prod(a: f64, b: f64) -> (f64, f64) {
    let product = a * b;
    (product, a.mul_add(b, -product))
}

/// A running sum of products in double-double.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct DoubleDouble {
    high: f64,
    low: f64,
}

impl DoubleDouble {
    /// Adds the product a b.
    pub(super) fn add(&mut self, a: f64, b: f64) {
        let (product, product_error) = two_prod(a, b);
        let (high, sum_error) = two_sum(self.high, product);
        self.high = high;
        self.low += sum_error + product_error;
    }

    /// The sum, rounded once.
    pub(super) fn value(self) -> f64 {
        self.high + self.low
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The sum of products a b in double-double, and in f64.
    fn sum_products(terms: &[(f64, f64)]) -> (f64, f64) {
        let mut double_double = DoubleDouble::default();
        terms.iter().for_each(|(a, b)| double_double.add(*a, *b));
        (double_double.value(), terms.iter().map(|(a, b)| a * b).sum())
    }

    #[test]
    fn cancelling_sum_is_exact() {
        let (double_double, plain) = sum_products(&[(1e20, 1.0), (3.0, 1.0), (-1e20, 1.0)]);
        assert_eq!((double_double, plain), (3.0, 0.0));
        // (1 + e)(1 - e) - 1 is -e^2, which the rounded product has lost.
        let small = f64::EPSILON;
        let (double_double, plain) = sum_products(&[(1.0 + small, 1.0 - small), (-1.0, 1.0)]);
        assert_eq!(double_double, -small * small);
        assert_ne!(plain, double_double);
    }

    #[test]
    fn rounded_part_and_error_add_up() {
        assert_eq!(two_sum(1.0, 2f64.powi(-60)), (1.0, 2f64.powi(-60)));
        let (product, error) = two_prod(1.0 + f64::EPSILON, 1.0 + f64::EPSILON);
        assert_eq!((product, error), (1.0 + 2.0 * f64::EPSILON, f64::EPSILON * f64::EPSILON));
    }
}
