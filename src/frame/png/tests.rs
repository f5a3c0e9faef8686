//! Tests of whole files: `image` and `png` decode them to the same pixels, and their size is bounded.

use super::*;

/// Pixels of a pattern.
fn picture(width: u32, height: u32, mut pixel: impl FnMut(u32, u32) -> [u8; 4]) -> Vec<u8> {
    (0..width * height).flat_map(|index| pixel(index % width, index / width)).collect()
}

/// Encodes a picture and checks that it decodes to the same pixels. Returns the file.
fn encode_and_check(width: u32, height: u32, rgba: &[u8]) -> Vec<u8> {
    let file = encode(width, height, rgba).expect("expected a PNG");
    let decoded = image::load_from_memory(&file).expect("expected a decodable PNG");
    let is_opaque = rgba.iter().skip(3).step_by(4).all(|alpha| *alpha == 255);
    assert_eq!(decoded.color().has_alpha(), !is_opaque, "{width} x {height}");
    let decoded = decoded.into_rgba8();
    assert_eq!(decoded.dimensions(), (width, height));
    assert!(decoded.as_raw() == rgba, "expected the same pixels of {width} x {height}");
    // `image` does not check the checksum of the zlib stream. It is the content of the last IDAT chunk.
    let channels = if is_opaque { Channels::Rgb } else { Channels::Rgba };
    let mut filtered = vec![0; height as usize * (1 + channels.count() * width as usize)];
    filter::filter_rows(rgba, width as usize, channels, &mut filtered);
    let adler = simd_adler32::adler32(&filtered.as_slice()).to_be_bytes();
    assert_eq!(file[file.len() - 24..file.len() - 16], [*b"IDAT", adler].concat(), "{width} x {height}");
    file
}

/// The bound of a file's size in the documentation of the module.
fn max_file_bytes(width: u32, height: u32, channels: Channels) -> usize {
    let layout = PngLayout::new(width, height, channels).expect("expected a layout");
    let row_bytes = 1 + channels.count() * width as usize;
    let stored_blocks = (layout.strip_rows * row_bytes).div_ceil(65_535);
    row_bytes * height as usize + layout.strip_count() * (12 + 5 * stored_blocks) + 76
}

/// The size of the file that the png crate writes with the filter Sub and `Compression::Fast`.
fn png_crate_bytes(width: u32, height: u32, rgba: &[u8]) -> usize {
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fast);
    encoder.set_filter(png::Filter::Sub);
    let rgb: Vec<u8> = rgba.as_chunks::<4>().0.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
    let mut writer = encoder.write_header().expect("expected a header");
    writer.write_image_data(&rgb).expect("expected pixels");
    writer.finish().expect("expected an end");
    bytes.len()
}

/// A rendered frame has flat areas, smooth gradients and textures.
fn frame_pixel(x: u32, y: u32, random: &mut fastrand::Rng) -> [u8; 4] {
    let wave = (f64::from(x) / 40.0).sin() * (f64::from(y) / 30.0).cos();
    match (wave * 4.0) as i32 {
        0 => [200, 210, (y / 4) as u8, 255],
        1 | -1 => [(128.0 + 100.0 * wave) as u8, (x / 3) as u8, 90, 255],
        _ => [random.u8(100..140), random.u8(90..120), random.u8(0..8), 255],
    }
}

#[test]
fn every_size_of_noise_is_decoded() {
    let mut random = fastrand::Rng::with_seed(1);
    for (width, height) in [(1, 1), (1, 300), (300, 1), (2, 7), (7, 2), (5, 5), (33, 17), (65_535, 2), (1, 70_000)] {
        for alpha in [255, 0] {
            let rgba = picture(width, height, |_, _| [random.u8(..), random.u8(..), random.u8(..), random.u8(alpha..)]);
            let channels = if alpha == 255 { Channels::Rgb } else { Channels::Rgba };
            let bytes = encode_and_check(width, height, &rgba).len();
            assert!(bytes <= max_file_bytes(width, height, channels), "{width} x {height}: {bytes} bytes");
        }
    }
}

#[test]
fn noise_of_several_strips_is_stored() {
    let mut random = fastrand::Rng::with_seed(2);
    let rgba = picture(300, 400, |_, _| [random.u8(..), random.u8(..), random.u8(..), 255]);
    let bytes = encode_and_check(300, 400, &rgba).len();
    assert!((901 * 400..=max_file_bytes(300, 400, Channels::Rgb)).contains(&bytes), "{bytes} bytes");
}

#[test]
fn random_patterns_are_decoded() {
    let mut random = fastrand::Rng::with_seed(3);
    for _ in 0..300 {
        let (width, height) = (random.u32(1..200), random.u32(1..60));
        // Runs of random length, of colors that differ in few or many bits.
        let (max_run, mask, alpha) = (random.u32(1..2000), random.u32(..), (random.u32(..2) * random.u32(..)) << 24);
        let (mut run, mut color) = (0, 0);
        let rgba = picture(width, height, |_, _| {
            if run == 0 {
                (run, color) = (random.u32(1..=max_run), random.u32(..) & mask);
            }
            run -= 1;
            (color | 0xff00_0000 ^ alpha).to_le_bytes()
        });
        encode_and_check(width, height, &rgba);
    }
}

#[test]
fn gradients_are_decoded_and_flat_pictures_are_small() {
    let gradient = picture(700, 300, |x, y| [x as u8, y as u8, (x + y) as u8, 255]);
    encode_and_check(700, 300, &gradient);
    let flat = picture(1920, 1080, |_, _| [77, 78, 79, 255]);
    let bytes = encode_and_check(1920, 1080, &flat).len();
    assert!(bytes < 14_000, "expected a small file, got {bytes} bytes");
}

#[test]
fn frames_have_at_most_eleven_tenths_of_the_bytes_of_the_png_crate() {
    for (width, height) in [(640, 360), (320, 180), (1280, 720)] {
        let mut random = fastrand::Rng::with_seed(4);
        let rgba = picture(width, height, |x, y| frame_pixel(x, y, &mut random));
        let (bytes, expected) = (encode_and_check(width, height, &rgba).len(), png_crate_bytes(width, height, &rgba));
        assert!(10 * bytes <= 11 * expected, "{width} x {height}: {bytes} bytes, png crate: {expected}");
    }
}

#[test]
fn one_translucent_pixel_keeps_the_alpha_channel() {
    let opaque = picture(640, 360, |x, y| [x as u8, y as u8, 0, 255]);
    encode_and_check(640, 360, &opaque);
    for pixel in [0, 640 * 180 + 333, 640 * 360 - 1] {
        let mut rgba = opaque.clone();
        rgba[4 * pixel + 3] = 254;
        encode_and_check(640, 360, &rgba);
    }
}

#[test]
fn strips_in_any_order_give_the_same_file() {
    let mut random = fastrand::Rng::with_seed(5);
    let rgba = picture(640, 360, |x, y| frame_pixel(x, y, &mut random));
    let layout = PngLayout::opaque(640, 360).expect("expected a layout");
    assert!(layout.strip_count() > 4, "expected several strips, got {}", layout.strip_count());
    let mut buffers = StripBuffers::default();
    let mut encode_strip = |index| {
        let strip = layout.encode_strip(&rgba, index, &mut buffers).expect("expected a strip");
        strip.expect("expected opaque pixels")
    };
    let mut strips: Vec<EncodedStrip> = (0..layout.strip_count()).rev().map(&mut encode_strip).collect();
    strips.reverse();
    assert_eq!(layout.assemble(&strips), encode_and_check(640, 360, &rgba));
}

#[test]
fn wrong_sizes_are_faults() {
    assert!(encode(0, 1, &[]).is_err() && encode(1, 0, &[]).is_err());
    assert!(encode(2, 2, &[255; 15]).is_err());
    assert!(encode(u32::MAX, 1, &[255; 4]).is_err() && encode(1, u32::MAX, &[255; 4]).is_err());
    let layout = PngLayout::opaque(2, 2).expect("expected a layout");
    assert!(layout.encode_strip(&[255; 16], 1, &mut StripBuffers::default()).is_err());
}
