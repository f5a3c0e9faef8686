//! Error metrics of an image against its reference. Colors are compared in sRGB, 0 to 255; the error of a pixel is the
//! largest difference of its three channels. Shadows are compared as sun visibility, the fraction of the unshadowed
//! sunlight that reaches the surface.

use serde::Serialize;

/// A reference pixel is in the penumbra when its sun visibility is between this value and 1 minus this value. The value
/// is above 1/64 = 0.016, so that a single shadowed sample of 64 does not make a penumbra.
const MIN_PENUMBRA_VISIBILITY: f32 = 0.02;
/// A reference pixel is in the umbra when its sun visibility is at most this value, which allows for rounding. It is
/// outside of shadows when its sun visibility is at least 1 minus this value.
const MAX_UMBRA_VISIBILITY: f32 = 1e-6;

/// Mean, 99th percentile and maximum of a set of numbers; all 0 for an empty set.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct ErrorDistribution {
    pub mean: f64,
    pub p99: f64,
    #[serde(rename = "largest")]
    pub max: f64,
    pub count: usize,
}

impl ErrorDistribution {
    fn from_values(mut values: Vec<f32>) -> Self {
        let count = values.len();
        let Some(max_value) = values.iter().copied().max_by(f32::total_cmp) else { return Self::default() };
        let mean = values.iter().map(|value| f64::from(*value)).sum::<f64>() / count as f64;
        // Nearest-rank percentile: the smallest number that at least 99 % of the numbers do not exceed.
        let rank = (99 * count).div_ceil(100).clamp(1, count);
        let (_, p99, _) = values.select_nth_unstable_by(rank - 1, f32::total_cmp);
        Self { mean, p99: f64::from(*p99), max: f64::from(max_value), count }
    }
}

/// Color errors of all pixels, on a scale of 0 to 255. `rendered` is RGBA; `reference` is sRGB on the same scale.
pub fn compare_colors(rendered: &[u8], reference: &[[f32; 3]]) -> ErrorDistribution {
    ErrorDistribution::from_values(differences(rendered, reference).collect())
}

/// Color errors of the pixels for which `is_counted` is true.
pub fn compare_colors_where(rendered: &[u8], reference: &[[f32; 3]], is_counted: &[bool]) -> ErrorDistribution {
    let errors = differences(rendered, reference).zip(is_counted);
    ErrorDistribution::from_values(errors.filter_map(|(error, is_counted)| is_counted.then_some(error)).collect())
}

/// The largest difference of the three color channels, per pixel.
pub fn differences<'a>(rendered: &'a [u8], reference: &'a [[f32; 3]]) -> impl Iterator<Item = f32> + 'a {
    let largest_difference = |(pixel, expected): (&[u8], &[f32; 3])| {
        pixel.iter().zip(expected).map(|(byte, value)| (f32::from(*byte) - value).abs()).fold(0.0, f32::max)
    };
    rendered.chunks_exact(4).zip(reference).map(largest_difference)
}

/// Errors of the sun visibility over the pixels where both images define it.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct LightErrors {
    #[serde(rename = "all")]
    pub all_pixels: ErrorDistribution,
    /// Over the pixels in the reference's penumbra only.
    pub penumbra: ErrorDistribution,
    /// Light bleeding: mean sun visibility in the reference's umbra. `None` without such pixels.
    #[serde(rename = "in_umbra")]
    pub umbra_visibility: Option<f64>,
    pub umbra_pixels: usize,
    /// Largest rendered minus reference, 0 if no pixel is too bright: the brightest light that bleeds into a shadow.
    #[serde(rename = "leak")]
    pub max_leak: f64,
    /// Mean missing sun visibility where the reference has no shadow. `None` without such pixels.
    #[serde(rename = "lost")]
    pub lost_visibility: Option<f64>,
    /// Mean of rendered minus reference; positive when the image is too bright.
    pub bias: f64,
}

/// Compares the sun visibility pixel by pixel; pixels where either is undefined are skipped.
pub fn compare_light(rendered: &[Option<f32>], reference: &[Option<f32>]) -> LightErrors {
    // Per pixel: the rendered and the reference visibility.
    let pairs: Vec<(f32, f32)> =
        rendered.iter().zip(reference).filter_map(|(rendered, reference)| rendered.zip(*reference)).collect();
    let error = |(rendered, reference): &(f32, f32)| (rendered - reference).abs();
    let is_penumbra =
        |(_, reference): &&(f32, f32)| (MIN_PENUMBRA_VISIBILITY..=1.0 - MIN_PENUMBRA_VISIBILITY).contains(reference);
    let umbra_visibilities: Vec<f64> =
        pairs.iter().filter(|pair| pair.1 <= MAX_UMBRA_VISIBILITY).map(|pair| f64::from(pair.0)).collect();
    let sunlit_pairs = pairs.iter().filter(|pair| pair.1 >= 1.0 - MAX_UMBRA_VISIBILITY);
    let missing_visibilities: Vec<f64> = sunlit_pairs.map(|pair| f64::from(pair.1 - pair.0)).collect();
    let mean = |values: &[f64]| (!values.is_empty()).then(|| values.iter().sum::<f64>() / values.len() as f64);
    let bias = pairs.iter().map(|(rendered, reference)| f64::from(rendered - reference)).sum::<f64>();
    LightErrors {
        all_pixels: ErrorDistribution::from_values(pairs.iter().map(error).collect()),
        penumbra: ErrorDistribution::from_values(pairs.iter().filter(is_penumbra).map(error).collect()),
        umbra_visibility: mean(&umbra_visibilities),
        umbra_pixels: umbra_visibilities.len(),
        max_leak: f64::from(pairs.iter().map(|(rendered, reference)| rendered - reference).fold(0.0, f32::max)),
        lost_visibility: mean(&missing_visibilities),
        bias: bias / pairs.len().max(1) as f64,
    }
}

/// Measures the flicker of a moving scene: how much a pixel's error changes from frame to frame, on a scale of 0 to
/// 255. The channel with the largest change counts. A constant error does not flicker.
#[derive(Debug, Default)]
pub struct FlickerMeter {
    /// Signed error of each pixel of the last frame; rendered minus reference.
    last_errors: Vec<[f32; 3]>,
    /// Absolute changes of the errors of all pixels and frames.
    changes: Vec<f32>,
}

impl FlickerMeter {
    /// Adds the next frame and its reference.
    pub fn add_frame(&mut self, rendered: &[u8], reference: &[[f32; 3]]) {
        let error = |(pixel, expected): (&[u8], &[f32; 3])| {
            std::array::from_fn(|channel| f32::from(pixel[channel]) - expected[channel])
        };
        let errors: Vec<[f32; 3]> = rendered.chunks_exact(4).zip(reference).map(error).collect();
        let change = |(current, last): (&[f32; 3], &[f32; 3])| {
            current.iter().zip(last).map(|(current, last)| (current - last).abs()).fold(0.0, f32::max)
        };
        self.changes.extend(errors.iter().zip(&self.last_errors).map(change));
        self.last_errors = errors;
    }

    /// The distribution over all pixels of all pairs of consecutive frames.
    pub fn into_distribution(self) -> ErrorDistribution {
        ErrorDistribution::from_values(self.changes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn gray(levels: impl IntoIterator<Item = u8>) -> Vec<u8> {
        levels.into_iter().flat_map(|level| [level, level, level, 255]).collect()
    }

    #[test]
    fn one_wrong_pixel_in_a_hundred_gives_known_errors() {
        let reference = vec![[100.0; 3]; 100];
        assert_eq!(compare_colors(&gray([100; 100]), &reference).max, 0.0, "control: equal images");
        let one_wrong = gray((0..100).map(|pixel| if pixel == 7 { 150 } else { 100 }));
        let errors = compare_colors(&one_wrong, &reference);
        assert_eq!((errors.mean, errors.p99, errors.max, errors.count), (0.5, 0.0, 50.0, 100));
        let two_wrong = gray((0..100).map(|pixel| if pixel < 2 { 150 } else { 100 }));
        assert_eq!(
            compare_colors(&two_wrong, &reference).p99,
            50.0,
            "two wrong pixels in a hundred reach the 99th percentile"
        );
        let mut tinted = gray([100; 100]);
        tinted[1] = 90;
        assert_eq!(compare_colors(&tinted, &reference).max, 10.0, "an error in one channel is counted");
        assert_eq!(compare_colors(&[], &[]), ErrorDistribution::default());
        let is_counted: Vec<bool> = (0..100).map(|pixel| pixel < 10).collect();
        let counted_errors = compare_colors_where(&one_wrong, &reference, &is_counted);
        assert_eq!((counted_errors.mean, counted_errors.count), (5.0, 10), "one wrong pixel in ten");
    }

    #[test]
    fn shifted_ramp_errs_by_its_slope_only_on_the_ramp() {
        // The sun visibility rises from 0 at pixel 40 + shift to 1 at pixel 60 + shift, by 1/20 per pixel.
        let ramp = |shift: i32| -> Vec<Option<f32>> {
            (0..100).map(|pixel| Some(((pixel - 40 - shift) as f32 / 20.0).clamp(0.0, 1.0))).collect()
        };
        // Pixels 41 to 59 are in the penumbra.
        let unshifted_errors = compare_light(&ramp(0), &ramp(0));
        assert_eq!(
            (unshifted_errors.all_pixels.max, unshifted_errors.penumbra.count, unshifted_errors.bias),
            (0.0, 19, 0.0),
            "control: the same ramp"
        );
        // A shift by two pixels changes the visibility on the ramp by 2/20.
        let shifted_errors = compare_light(&ramp(2), &ramp(0));
        assert!(
            (shifted_errors.penumbra.max - 0.1).abs() < 1e-6 && shifted_errors.penumbra.mean > 0.09,
            "{shifted_errors:?}"
        );
        // The shift darkens the 100 pixels by 2 in total.
        assert!(
            (shifted_errors.all_pixels.mean - 0.02).abs() < 1e-6 && (shifted_errors.bias + 0.02).abs() < 1e-6,
            "{shifted_errors:?}"
        );
        assert_eq!(shifted_errors.umbra_visibility, Some(0.0), "a displaced shadow does not bleed");
    }

    #[test]
    fn only_light_in_the_umbra_counts_as_bleeding() {
        let reference: Vec<Option<f32>> = (0..10).map(|pixel| Some(if pixel < 4 { 0.0 } else { 1.0 })).collect();
        let mut leaking_image = reference.clone();
        leaking_image[1] = Some(0.2);
        let errors = compare_light(&leaking_image, &reference);
        assert!((errors.umbra_visibility.expect("umbra pixels") - 0.05).abs() < 1e-7 && errors.umbra_pixels == 4);
        let mut dark_image = reference.clone();
        dark_image[9] = Some(0.5);
        let errors = compare_light(&dark_image, &reference);
        assert_eq!(errors.umbra_visibility, Some(0.0), "control: an error in the light");
        assert!((errors.lost_visibility.expect("fully lit pixels") - 0.5 / 6.0).abs() < 1e-7, "{errors:?}");
        assert_eq!(
            compare_light(&leaking_image, &reference).lost_visibility,
            Some(0.0),
            "control: an error in the umbra"
        );
        assert_eq!(
            compare_light(&[Some(0.5)], &[Some(1.0)]).umbra_visibility,
            None,
            "bleeding is undefined without umbra pixels"
        );
        assert_eq!(
            compare_light(&[None, Some(1.0)], &[Some(0.0), None]).all_pixels.count,
            0,
            "pixels that either image leaves undefined are skipped"
        );
    }

    #[test]
    fn only_changes_of_the_error_are_flicker() {
        let flicker = |rendered: &dyn Fn(usize) -> u8, reference: &dyn Fn(usize) -> f32| {
            let mut flicker = FlickerMeter::default();
            (0..60).for_each(|step| flicker.add_frame(&gray([rendered(step); 4]), &[[reference(step); 3]; 4]));
            flicker.into_distribution()
        };
        let constant_error = flicker(&|_| 90, &|_| 100.0);
        assert_eq!((constant_error.max, constant_error.count), (0.0, 59 * 4), "a constant error does not flicker");
        let following_image = flicker(&|step| 3 * step as u8, &|step| 3.0 * step as f32);
        assert_eq!(following_image.max, 0.0, "an image that follows its reference does not flicker");
        let alternating_image = flicker(&|step| 100 + 10 * (step % 2) as u8, &|_| 100.0);
        assert_eq!((alternating_image.mean, alternating_image.max), (10.0, 10.0));
        let constant_image = flicker(&|_| 100, &|step| 100.0 + 10.0 * (step % 2) as f32);
        assert_eq!(constant_image.mean, 10.0, "an image that misses a change of the reference flickers");
    }
}
