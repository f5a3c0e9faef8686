//! Quantization: the tables of Annex K.1 of ITU-T T.81, scaled by a quality, and the rounding of a block.

use super::dct;
use super::lanes::{Block, Lanes, round_to_i16};
use super::mcu::{Component, Subsampling};
use pulp::f32x8;

/// Steps of luma and chroma, row by row from low to high vertical frequencies.
#[rustfmt::skip]
const LUMA_STEPS: [u8; 64] = [
    16, 11, 10, 16, 24, 40, 51, 61,
    12, 12, 14, 19, 26, 58, 60, 55,
    14, 13, 16, 24, 40, 57, 69, 56,
    14, 17, 22, 29, 51, 87, 80, 62,
    18, 22, 37, 56, 68, 109, 103, 77,
    24, 35, 55, 64, 81, 104, 113, 92,
    49, 64, 78, 87, 103, 121, 120, 101,
    72, 92, 95, 98, 112, 100, 103, 99,
];
#[rustfmt::skip]
const CHROMA_STEPS: [u8; 64] = [
    17, 18, 24, 47, 99, 99, 99, 99,
    18, 21, 26, 66, 99, 99, 99, 99,
    24, 26, 56, 99, 99, 99, 99, 99,
    47, 66, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
    99, 99, 99, 99, 99, 99, 99, 99,
];

/// Steps of luma and chroma at a quality, row-major.
#[derive(Debug, Clone)]
pub(super) struct QuantizationTables {
    pub(super) luma: [u8; 64],
    pub(super) chroma: [u8; 64],
}

/// Factors from the result of [`dct::forward`] to quantized coefficients. Transposed like that result.
#[derive(Debug, Clone)]
pub(super) struct QuantizationFactors {
    luma: [f32x8; 8],
    chroma: [f32x8; 8],
}

impl QuantizationTables {
    /// The tables of a quality of 1 to 100, with the scale of libjpeg: 50 keeps the steps, 100 sets all of them to 1.
    pub(super) fn of_quality(quality: u8) -> Self {
        let quality = u32::from(quality.clamp(1, 100));
        let percent = if quality < 50 { 5000 / quality } else { 200 - 2 * quality };
        let scale = |step: u8| ((u32::from(step) * percent + 50) / 100).clamp(1, 255) as u8;
        Self { luma: LUMA_STEPS.map(scale), chroma: CHROMA_STEPS.map(scale) }
    }
}

impl QuantizationFactors {
    /// The factors also contain the scale of the samples that [`super::mcu`] returns.
    pub(super) fn new(tables: &QuantizationTables, subsampling: Subsampling) -> Self {
        let factors = |steps: &[u8; 64], sample_scale: f64| {
            let factor = |u: usize, v: usize| {
                let transform_scale = 8.0 * dct::SCALES[u] * dct::SCALES[v];
                (sample_scale / (f64::from(steps[8 * v + u]) * transform_scale)) as f32
            };
            let rows: [[f32; 8]; 8] = std::array::from_fn(|u| std::array::from_fn(|v| factor(u, v)));
            pulp::cast::<_, [f32x8; 8]>(rows)
        };
        let mean = 1.0 / subsampling.summed_pixels() as f64;
        Self { luma: factors(&tables.luma, 1.0), chroma: factors(&tables.chroma, mean) }
    }

    #[inline(always)]
    pub(super) const fn of(&self, component: Component) -> &[f32x8; 8] {
        match component {
            Component::Luma => &self.luma,
            Component::Cb | Component::Cr => &self.chroma,
        }
    }
}

/// Quantizes the coefficients of a block.
#[inline(always)]
pub(super) fn quantize<L: Lanes>(lanes: L, mut spectrum: [f32x8; 8], factors: &[f32x8; 8]) -> Block {
    for (row, factors) in spectrum.iter_mut().zip(factors) {
        *row = lanes.mul_f32s(*row, *factors);
    }
    lanes.round(spectrum)
}

/// The quantized DC coefficient of a block whose samples are equal: that of [`quantize`], because the sums of the
/// transform are exact.
#[inline(always)]
pub(super) fn quantize_constant(sample: f32, factors: &[f32x8; 8]) -> i16 {
    round_to_i16(64.0 * sample * factors[0].0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quality_scales_the_steps() {
        let tables = [1, 50, 90, 100].map(QuantizationTables::of_quality);
        assert!(tables[0].luma.iter().chain(&tables[0].chroma).all(|step| *step == 255));
        assert_eq!((tables[1].luma, tables[1].chroma), (LUMA_STEPS, CHROMA_STEPS));
        assert_eq!((tables[2].luma[..4].to_vec(), tables[2].chroma[63]), (vec![3, 2, 2, 3], 20));
        assert!(tables[3].luma.iter().chain(&tables[3].chroma).all(|step| *step == 1));
    }

    #[test]
    fn constant_block_has_the_coefficient_of_the_transform() {
        let lanes = pulp::Scalar256b;
        for quality in 1..=100 {
            let tables = QuantizationTables::of_quality(quality);
            for (subsampling, scale) in [(Subsampling::Full, 1.0), (Subsampling::Half, 4.0)] {
                let factors = QuantizationFactors::new(&tables, subsampling);
                for sample in -128_i16..=128 {
                    let sample = scale * f32::from(sample);
                    let spectrum = dct::forward(lanes, [pulp::cast([sample; 8]); 8]);
                    let block = quantize(lanes, spectrum, factors.of(Component::Cb));
                    let dc = quantize_constant(sample, factors.of(Component::Cb));
                    assert_eq!((block.values[0], block.nonzeros), (dc, u64::from(dc != 0)), "{quality} {sample}");
                }
            }
        }
    }
}
