//! Seeded pseudo-random numbers, identical on every machine.

/// `SplitMix64` (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014).
#[derive(Debug, Clone)]
pub(super) struct SplitMix64(u64);

impl SplitMix64 {
    pub(super) const fn new(seed: u64) -> Self {
        Self(seed)
    }

    /// The next 64 bits.
    pub(super) const fn next_bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        mix64(self.0)
    }

    /// Uniform in `[0, 1)`.
    pub(super) fn next_unit(&mut self) -> f64 {
        (self.next_bits() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Uniform in `[low, high)`.
    pub(super) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.next_unit()
    }

    /// Uniform in `[-limit, limit)`.
    pub(super) fn uniform_symmetric(&mut self, limit: f64) -> f64 {
        self.uniform(-limit, limit)
    }

    /// An independent generator. With one generator per part, a part that draws more numbers does not change others.
    pub(super) const fn fork(&mut self) -> Self {
        Self(self.next_bits())
    }
}

/// The finalizer of `SplitMix64`: every input bit affects about half of the output bits.
pub(super) const fn mix64(mut bits: u64) -> u64 {
    bits = (bits ^ (bits >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    bits = (bits ^ (bits >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    bits ^ (bits >> 31)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn equal_seeds_give_equal_numbers() {
        let draw = |seed| {
            (0..4).map(|_| 0).scan(SplitMix64::new(seed), |random, _| Some(random.next_bits())).collect::<Vec<_>>()
        };
        assert_eq!(draw(1), draw(1));
        assert_ne!(draw(1), draw(2));
        // The published first output for seed 0.
        assert_eq!(SplitMix64::new(0).next_bits(), 0xE220_A839_7B1D_CDAF);
    }

    #[test]
    fn unit_numbers_are_in_range_with_a_mean_of_one_half() {
        let mut random = SplitMix64::new(3);
        let draws: Vec<f64> = (0..4000).map(|_| random.next_unit()).collect();
        assert!(draws.iter().all(|draw| (0.0..1.0).contains(draw)));
        let mean = draws.iter().sum::<f64>() / 4000.0;
        assert!((mean - 0.5).abs() < 0.02, "mean {mean}");
    }
}
