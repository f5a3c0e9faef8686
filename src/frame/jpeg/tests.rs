//! Tests of whole files: `image` decodes them to the expected pixels, with and without restart markers.

use image::RgbImage;

use super::*;

/// Opaque pixels of a pattern.
fn picture(width: u32, height: u32, mut color: impl FnMut(u32, u32) -> [u8; 3]) -> Vec<u8> {
    let pixel = |[red, green, blue]: [u8; 3]| [red, green, blue, 255];
    (0..width * height).flat_map(|index| pixel(color(index % width, index / width))).collect()
}

/// A rendered frame has flat areas, smooth gradients and textures.
fn frame(width: u32, height: u32) -> Vec<u8> {
    let mut random = fastrand::Rng::with_seed(4);
    picture(width, height, |x, y| {
        let wave = (f64::from(x) / 40.0).sin() * (f64::from(y) / 30.0).cos();
        match (wave * 4.0) as i32 {
            0 => [200, 210, 190],
            1 | -1 => [(128.0 + 100.0 * wave) as u8, (x / 3) as u8, 90],
            _ => [random.u8(100..140), random.u8(90..120), random.u8(0..8)],
        }
    })
}

fn noise(width: u32, height: u32, seed: u64) -> Vec<u8> {
    let mut random = fastrand::Rng::with_seed(seed);
    picture(width, height, |_, _| [random.u8(..), random.u8(..), random.u8(..)])
}

fn decode(file: &[u8]) -> RgbImage {
    image::load_from_memory(file).expect("expected a decodable JPEG").into_rgb8()
}

/// Encodes with strips of this number of pixels.
fn encode_strips(size: [u32; 2], rgba: &[u8], quality: u8, strip_pixels: usize) -> (Vec<Vec<u8>>, Vec<u8>) {
    let layout = JpegLayout::with_strip_pixels(size[0], size[1], quality, strip_pixels).expect("expected a layout");
    let mut buffers = JpegBuffers::default();
    let strips = (0..layout.strip_count()).map(|index| layout.encode_strip(rgba, index, &mut buffers));
    let strips: Vec<Vec<u8>> = strips.collect::<Result<_>>().expect("expected strips");
    let file = layout.assemble(&strips);
    (strips, file)
}

/// Root mean square and maximum of the differences of the channels, in levels.
fn errors(decoded: &RgbImage, rgba: &[u8]) -> [f64; 2] {
    let expected = rgba.as_chunks::<4>().0.iter().flat_map(|pixel| &pixel[..3]);
    let differences = || decoded.as_raw().iter().zip(expected.clone()).map(|(a, b)| f64::from(a.abs_diff(*b)));
    let squares: f64 = differences().map(|difference| difference * difference).sum();
    [(squares / decoded.as_raw().len() as f64).sqrt(), differences().fold(0.0, f64::max)]
}

/// The file of another encoder with the same tables, chroma resolution and averages.
fn reference(size: [u32; 2], rgba: &[u8], quality: u8) -> Vec<u8> {
    let mut file = Vec::new();
    let mut encoder = jpeg_encoder::Encoder::new(&mut file, quality);
    encoder.set_chroma_subsampling_method(jpeg_encoder::ChromaSubsamplingMethod::Average);
    let [width, height] = size.map(|side| side as u16);
    encoder.encode(rgba, width, height, jpeg_encoder::ColorType::Rgba).expect("expected a JPEG");
    file
}

/// Encodes, decodes and compares with the reference encoder. Returns the file.
fn check(size: [u32; 2], rgba: &[u8], quality: u8) -> Vec<u8> {
    let file = encode(size[0], size[1], rgba, quality).expect("expected a JPEG");
    let decoded = decode(&file);
    assert_eq!(decoded.dimensions(), (size[0], size[1]));
    let [rms, largest] = errors(&decoded, rgba);
    let [reference_rms, reference_largest] = errors(&decode(&reference(size, rgba, quality)), rgba);
    let is_close = rms <= 1.05 * reference_rms + 1.0 && largest <= 1.3 * reference_largest + 5.0;
    assert!(is_close, "{size:?} {quality}: RMS {rms}, {reference_rms}; largest {largest}, {reference_largest}");
    file
}

#[test]
fn every_small_size_is_decoded() {
    for width in 1..=34 {
        for height in [1, 2, 7, 8, 9, 15, 16, 17, 24, 33] {
            let rgba = picture(width, height, |x, y| [(7 * x) as u8, (7 * y) as u8, (90 + x + y) as u8]);
            for quality in [75, 100] {
                check([width, height], &rgba, quality);
            }
        }
    }
}

#[test]
fn strips_decode_to_the_pixels_of_one_strip() {
    for (size, quality) in [([100, 90], 90), ([100, 90], 50), ([33, 200], 100), ([17, 47], 1), ([8, 160], 95)] {
        for rgba in [frame(size[0], size[1]), noise(size[0], size[1], 1)] {
            let (one, whole) = encode_strips(size, &rgba, quality, usize::MAX);
            let (mut strips, file) = encode_strips(size, &rgba, quality, 1);
            assert_eq!((one.len(), strips.len()), (1, (size[1] as usize).div_ceil(if quality < 90 { 16 } else { 8 })));
            assert!(decode(&file) == decode(&whole), "{size:?} {quality}");
            // Negative control. Strips of a flat area are equal.
            strips.swap(0, 1);
            let layout = JpegLayout::with_strip_pixels(size[0], size[1], quality, 1).expect("expected a layout");
            let is_changed = decode(&layout.assemble(&strips)) != decode(&whole);
            assert!(is_changed || strips[0] == strips[1], "{size:?} {quality}");
        }
    }
}

#[test]
fn strips_do_not_depend_on_their_order() {
    let rgba = frame(640, 360);
    let layout = JpegLayout::new(640, 360, 90).expect("expected a layout");
    assert!(layout.strip_count() > 4, "expected several strips, got {}", layout.strip_count());
    let mut buffers = JpegBuffers::default();
    let mut encode_strip = |index| layout.encode_strip(&rgba, index, &mut buffers).expect("expected a strip");
    let mut strips: Vec<Vec<u8>> = (0..layout.strip_count()).rev().map(&mut encode_strip).collect();
    strips.reverse();
    assert_eq!(layout.assemble(&strips), encode(640, 360, &rgba, 90).expect("expected a JPEG"));
}

#[test]
fn portable_operations_write_the_same_strip() {
    for quality in [1, 60, 90, 100] {
        for rgba in [frame(203, 61), noise(203, 61, 2)] {
            let (strips, _) = encode_strips([203, 61], &rgba, quality, usize::MAX);
            let layout = JpegLayout::with_strip_pixels(203, 61, quality, usize::MAX).expect("expected a layout");
            let strip = Strip { layout: &layout, pixels: &rgba, rows: 61, bytes: &mut Vec::new() };
            assert!(strip.encode(pulp::Scalar256b) == strips[0], "{quality}");
        }
    }
}

#[test]
fn frames_have_the_bytes_and_errors_of_another_encoder() {
    for quality in [30, 75, 90, 95, 100] {
        let (size, rgba) = ([640, 360], frame(640, 360));
        let file = encode(size[0], size[1], &rgba, quality).expect("expected a JPEG");
        let reference = reference(size, &rgba, quality);
        assert!(100 * file.len() <= 101 * reference.len(), "{quality}: {} {}", file.len(), reference.len());
        let [[rms, _], [reference_rms, _]] = [file, reference].map(|file| errors(&decode(&file), &rgba));
        assert!(rms <= 1.003 * reference_rms, "{quality}: {rms} {reference_rms}");
    }
}

#[test]
fn extreme_pixels_are_decoded() {
    let size = [40, 24];
    for quality in [1, 89, 90, 100] {
        let flat = |level| picture(size[0], size[1], |_, _| [level; 3]);
        for level in [0, 255] {
            let decoded = decode(&check(size, &flat(level), quality));
            assert!(decoded.as_raw().iter().all(|channel| channel.abs_diff(level) <= 4), "{level} {quality}");
        }
        let colors = [[255, 0, 0], [0, 255, 0], [0, 0, 255], [255, 255, 0], [255, 0, 255], [0, 255, 255]];
        // The largest differences of DC coefficients, of AC coefficients, and both.
        check(size, &picture(size[0], size[1], |x, _| [if x / 8 % 2 == 0 { 0 } else { 255 }; 3]), quality);
        check(size, &picture(size[0], size[1], |x, y| [if (x + y) % 2 == 0 { 0 } else { 255 }; 3]), quality);
        check(size, &picture(size[0], size[1], |x, y| colors[((x / 16 + y / 8) % 6) as usize]), quality);
        check(size, &picture(size[0], size[1], |x, y| colors[((x + 5 * y) % 6) as usize]), quality);
        check(size, &noise(size[0], size[1], 3), quality);
    }
}

/// Noise of the smallest and largest level in each channel.
#[test]
fn largest_segments_fit_and_contain_no_markers() {
    let mut random = fastrand::Rng::with_seed(5);
    let mut bit = || if random.bool() { 255 } else { 0 };
    let rgba = picture(256, 128, |_, _| [bit(), bit(), bit()]);
    let (strips, _) = encode_strips([256, 128], &rgba, 100, usize::MAX);
    assert!(strips[0].len() > 256 * 128 * 3, "expected more bytes than pixels, got {}", strips[0].len());
    let stuffed = strips[0].windows(2).filter(|pair| pair[0] == 0xff);
    assert!(stuffed.clone().count() > 100 && stuffed.clone().all(|pair| pair[1] == 0));
    check([256, 128], &rgba, 100);
}

#[test]
fn gray_remains_gray_and_alpha_is_ignored() {
    let mut random = fastrand::Rng::with_seed(6);
    for quality in [50, 95] {
        let gray = picture(50, 30, |x, y| [(4 * x + 3 * y) as u8; 3]);
        let decoded = decode(&check([50, 30], &gray, quality));
        assert!(decoded.pixels().all(|pixel| pixel.0[0] == pixel.0[1] && pixel.0[1] == pixel.0[2]), "{quality}");
        let mut translucent = gray.clone();
        translucent.iter_mut().skip(3).step_by(4).for_each(|alpha| *alpha = random.u8(..));
        assert_ne!(gray, translucent);
        assert_eq!(encode(50, 30, &gray, quality), encode(50, 30, &translucent, quality));
    }
}

#[test]
fn longest_sides_are_decoded() {
    for size in [[65_535, 9], [9, 65_535]] {
        for quality in [80, 90] {
            let rgba = picture(size[0], size[1], |x, y| [(x / 256) as u8, (y / 256) as u8, ((x + y) / 512) as u8]);
            let (strips, file) = encode_strips(size, &rgba, quality, usize::MAX);
            assert!(strips.len() == 1 || size[1] > 9, "{}", strips.len());
            assert_eq!(decode(&file).dimensions(), (size[0], size[1]));
            check(size, &rgba, quality);
        }
    }
    // A restart interval has at most 65,535 MCU.
    let layout = JpegLayout::with_strip_pixels(65_535, 100, 90, usize::MAX).expect("expected a layout");
    assert_eq!((layout.strip_mcu_rows, layout.strip_count()), (7, 2));
}

#[test]
fn wrong_sizes_are_faults() {
    assert!(encode(0, 1, &[], 90).is_err() && encode(1, 0, &[], 90).is_err());
    assert!(encode(2, 2, &[255; 15], 90).is_err());
    assert!(encode(65_536, 1, &[255; 4], 90).is_err() && encode(1, 65_536, &[255; 4], 90).is_err());
    let layout = JpegLayout::new(2, 2, 90).expect("expected a layout");
    assert!(layout.encode_strip(&[255; 16], 1, &mut JpegBuffers::default()).is_err());
}
