//! The PNG encoder in CUDA: its files are those of the CPU encoder, byte by byte, for every kind and size of picture.

use std::num::NonZero;
use std::sync::Arc;

use modalcast::frame::encode_png;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_compute::gpu::{CudaPictureMemory, Device, DevicePicture, EncodedPng, PngChannels, PngEncoder};
use modalcast_model::error::Error;
use modalcast_model::shared_memory::{CopiedPixels, CopyRequest, PictureMemory, PngRequest};

/// A picture on the host.
struct Picture {
    width: u32,
    height: u32,
    rgba: Vec<u8>,
}

/// Content of a picture.
#[derive(Debug, Clone, Copy)]
enum Content {
    Flat,
    Gradient,
    Noise,
    /// Runs of random length, of colors that differ in the bits of a mask.
    Runs,
    /// Flat areas, smooth gradients and textures, as in a rendered frame.
    Frame,
}

const CONTENTS: [Content; 5] = [Content::Flat, Content::Gradient, Content::Noise, Content::Runs, Content::Frame];

impl Picture {
    fn new([width, height]: [u32; 2], content: Content, random: &mut fastrand::Rng) -> Self {
        let (max_run, mask) = (random.u32(1..2000), random.u32(..));
        let (mut run, mut color) = (0, 0);
        let mut pixel = |x: u32, y: u32| match content {
            Content::Flat => [77, 78, 79],
            Content::Gradient => [x as u8, y as u8, (x + y) as u8],
            Content::Noise => [random.u8(..), random.u8(..), random.u8(..)],
            Content::Runs => {
                if run == 0 {
                    (run, color) = (random.u32(1..=max_run), random.u32(..) & mask);
                }
                run -= 1;
                [color as u8, (color >> 8) as u8, (color >> 16) as u8]
            }
            Content::Frame => {
                let wave = (f64::from(x) / 40.0).sin() * (f64::from(y) / 30.0).cos();
                match (wave * 4.0) as i32 {
                    0 => [200, 210, (y / 4) as u8],
                    1 | -1 => [(128.0 + 100.0 * wave) as u8, (x / 3) as u8, 90],
                    _ => [random.u8(100..140), random.u8(90..120), random.u8(0..8)],
                }
            }
        };
        let rgba = (0..width * height).flat_map(|index| {
            let [red, green, blue] = pixel(index % width, index / width);
            [red, green, blue, 255]
        });
        Self { width, height, rgba: rgba.collect() }
    }

    /// The same picture with one translucent pixel.
    fn with_translucent_pixel(mut self, pixel: usize) -> Self {
        self.rgba[4 * pixel + 3] = 254;
        self
    }

    fn upload(&self, device: &Device) -> (DeviceBuffer, DevicePicture) {
        let memory = DeviceBuffer::upload(device, &self.rgba).expect("expected device memory");
        let (address, pitch) = (memory.address(), 4 * i64::from(self.width));
        (memory, DevicePicture { address, pitch, width: self.width, height: self.height })
    }

    fn encode_on_cpu(&self) -> Vec<u8> {
        encode_png(self.width, self.height, &self.rgba).expect("expected a PNG")
    }
}

fn encoder(device: &Arc<Device>, size: [u32; 2], channels: PngChannels, slot_count: usize) -> PngEncoder {
    let slot_count = NonZero::new(slot_count).expect("expected a positive number");
    PngEncoder::new(device, size, channels, slot_count).expect("expected an encoder")
}

/// Encodes a picture whose memory outlives the call. `None` if the file would need an alpha channel.
fn encode(encoder: &mut PngEncoder, picture: &DevicePicture) -> Option<EncodedPng> {
    // SAFETY: the callers keep the picture's memory until this returns, and nothing writes it.
    let pending = unsafe { encoder.encode(picture) }.expect("expected the encoding to start");
    pending.expect("expected a free slot").wait().expect("expected the encoding to succeed")
}

/// Compares the file with that of the CPU. A picture that is not opaque is refused without an alpha channel.
fn check(device: &Arc<Device>, picture: &Picture, description: &str) {
    let size = [picture.width, picture.height];
    let (_memory, device_picture) = picture.upload(device);
    let is_opaque = picture.rgba.iter().skip(3).step_by(4).all(|alpha| *alpha == 255);
    let rgb = encode(&mut encoder(device, size, PngChannels::Rgb, 1), &device_picture);
    assert_eq!(rgb.is_some(), is_opaque, "{description}");
    let file = rgb.or_else(|| encode(&mut encoder(device, size, PngChannels::Rgba, 1), &device_picture));
    let file = file.unwrap_or_else(|| panic!("expected a file with alpha of {description}"));
    assert!(file.as_ref() == picture.encode_on_cpu(), "expected the file of the CPU: {description}");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_png_equals_the_cpu_png_for_all_contents_and_sizes() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut random = fastrand::Rng::with_seed(1);
    let sizes = [
        [1, 1],
        [1, 300],
        [300, 1],
        [2, 7],
        [7, 2],
        [5, 5],
        [33, 17],
        [641, 359],
        [8192, 40],
        [65_535, 2],
        [1, 70_000],
    ];
    for size in sizes {
        for content in CONTENTS {
            let description = format!("{content:?} of {size:?}");
            check(&device, &Picture::new(size, content, &mut random), &description);
            let picture = Picture::new(size, content, &mut random);
            let pixel = random.usize(..picture.rgba.len() / 4);
            check(
                &device,
                &picture.with_translucent_pixel(pixel),
                &format!("{description}, pixel {pixel} translucent"),
            );
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_png_equals_the_cpu_png_for_random_pictures() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut random = fastrand::Rng::with_seed(2);
    for case in 0..60 {
        let size = [random.u32(1..700), random.u32(1..400)];
        let content = CONTENTS[random.usize(..CONTENTS.len())];
        check(&device, &Picture::new(size, content, &mut random), &format!("case {case}: {content:?} of {size:?}"));
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_png_of_one_encoder_does_not_depend_on_earlier_pictures() {
    let device = Device::open(0).expect("expected a CUDA device");
    let mut random = fastrand::Rng::with_seed(3);
    let size = [1280, 720];
    let mut encoder = encoder(&device, size, PngChannels::Rgb, 3);
    let pictures = CONTENTS.map(|content| Picture::new(size, content, &mut random));
    let files = pictures.each_ref().map(Picture::encode_on_cpu);
    let uploads = pictures.each_ref().map(|picture| picture.upload(&device));
    let (_memory, translucent) =
        Picture::new(size, Content::Frame, &mut random).with_translucent_pixel(7).upload(&device);
    for _ in 0..40 {
        let index = random.usize(..pictures.len());
        if random.bool() {
            assert!(encode(&mut encoder, &translucent).is_none(), "expected a refusal of the translucent picture");
        }
        let file = encode(&mut encoder, &uploads[index].1).expect("expected an opaque picture");
        assert!(file.as_ref() == files[index], "{:?}", CONTENTS[index]);
    }
    assert_ne!(files[2], files[4], "control: expected different files of different pictures");
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_png_reads_padded_and_ascending_rows() {
    let device = Device::open(0).expect("expected a CUDA device");
    let picture = Picture::new([333, 222], Content::Frame, &mut fastrand::Rng::with_seed(4));
    let (row_bytes, padded_bytes) = (4 * 333, 4 * 333 + 52);
    let mut padded: Vec<u8> = Vec::new();
    for row in picture.rgba.chunks_exact(row_bytes) {
        padded.extend(row);
        padded.resize(padded.len() + padded_bytes - row_bytes, 99);
    }
    let ascending: Vec<u8> = picture.rgba.chunks_exact(row_bytes).rev().flatten().copied().collect();
    let mut encoder = encoder(&device, [333, 222], PngChannels::Rgb, 1);
    let layouts = [(padded, padded_bytes as i64, 0), (ascending, -(row_bytes as i64), 221 * row_bytes as u64)];
    for (bytes, pitch, offset) in layouts {
        let memory = DeviceBuffer::upload(&device, &bytes).expect("expected device memory");
        let address = memory.address() + offset;
        let file = encode(&mut encoder, &DevicePicture { address, pitch, width: 333, height: 222 });
        assert!(file.is_some_and(|file| file.as_ref() == picture.encode_on_cpu()), "pitch {pitch}");
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_png_slots_bound_the_files_in_flight() {
    let device = Device::open(0).expect("expected a CUDA device");
    let picture = Picture::new([640, 360], Content::Frame, &mut fastrand::Rng::with_seed(5));
    let (memory, device_picture) = picture.upload(&device);
    let mut encoder = encoder(&device, [640, 360], PngChannels::Rgb, 2);
    let mut start = || {
        // SAFETY: the memory of the picture outlives all encodings, and nothing writes it.
        unsafe { encoder.encode(&device_picture) }.expect("expected no error")
    };
    let (first, second) = (start().expect("expected a slot"), start().expect("expected a second slot"));
    assert!(start().is_none(), "expected no third slot");
    let first_file = first.wait().expect("expected the first file").expect("expected an opaque picture");
    assert!(start().is_none(), "expected no slot while a reader holds the first file");
    drop(second);
    let third_file = start().expect("expected the dropped slot").wait().expect("expected the third file");
    let third_file = third_file.expect("expected an opaque picture");
    drop(encoder);
    drop(memory);
    assert!(first_file.as_ref() == picture.encode_on_cpu() && third_file.as_ref() == first_file.as_ref());
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_png_rejects_other_sizes_and_unaligned_pictures() {
    let device = Device::open(0).expect("expected a CUDA device");
    let picture = Picture::new([16, 9], Content::Flat, &mut fastrand::Rng::with_seed(6));
    let (_memory, valid) = picture.upload(&device);
    let mut encoder = encoder(&device, [16, 9], PngChannels::Rgb, 1);
    let invalid_pictures = [
        DevicePicture { width: 15, ..valid },
        DevicePicture { height: 10, ..valid },
        DevicePicture { address: valid.address + 1, ..valid },
        DevicePicture { pitch: 62, ..valid },
        DevicePicture { pitch: 60, ..valid },
        DevicePicture { pitch: -60, ..valid },
    ];
    for picture in invalid_pictures {
        // SAFETY: the encoder refuses the picture before it reads it.
        let error = unsafe { encoder.encode(&picture) }.expect_err("expected an error");
        assert!(matches!(error, Error::Invalid { .. }), "{picture:?}: {error}");
    }
    assert!(encode(&mut encoder, &valid).is_some());
}

/// Fills a shared picture with a pixel, and copies it with its PNG file. 16 further bytes follow the pixels.
fn copy_filled(memory: &CudaPictureMemory, size: [u32; 2], pixel: [u8; 4], copies_pixels: bool) -> CopiedPixels {
    let bytes = 4 * size[0] as usize * size[1] as usize + 16;
    let mut picture = memory.create_picture(bytes).expect("expected device memory").picture;
    picture.fill(u32::from_le_bytes(pixel)).expect("expected a filled picture");
    let request = CopyRequest { bytes, png: Some(PngRequest { size, copies_pixels }) };
    picture.start_copy(request).expect("expected the copy to start");
    picture.finish_copy().expect("expected the copy to succeed")
}

/// Also with more sizes than encoders, so that encoders are replaced.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shared_pictures_have_the_png_of_the_cpu() {
    let device = Device::open(0).expect("expected a CUDA device");
    let memory = CudaPictureMemory::new(&device).expect("expected streams");
    memory.prepare_encoder().expect("expected an encoder");
    for round in 0..2 {
        for side in 1..9_u32 {
            let (size, pixel) = ([40 * side, 7 * side], [round, side as u8, 9, 255]);
            let rgba = pixel.repeat((size[0] * size[1]) as usize);
            let expected = encode_png(size[0], size[1], &rgba).expect("expected a PNG");
            for copies_pixels in [false, true] {
                let copied = copy_filled(&memory, size, pixel, copies_pixels);
                let png = copied.png.expect("expected a file");
                assert!(png.file.bytes() == expected, "expected the file of the CPU for {size:?}");
                assert_eq!(png.has_pixels, copies_pixels);
                let (pixels, rest) = copied.pixels.bytes().split_at(rgba.len());
                assert_eq!(pixels == rgba, copies_pixels, "expected pixels only on request");
                assert_eq!(rest, pixel.repeat(4), "expected the bytes behind the pixels");
            }
        }
    }
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_translucent_shared_pictures_are_copied_without_a_file() {
    let device = Device::open(0).expect("expected a CUDA device");
    let memory = CudaPictureMemory::new(&device).expect("expected streams");
    for copies_pixels in [false, true] {
        let copied = copy_filled(&memory, [50, 30], [1, 2, 3, 254], copies_pixels);
        assert!(copied.png.is_none());
        assert_eq!(copied.pixels.bytes(), [1, 2, 3, 254].repeat(50 * 30 + 4));
    }
}

/// Readers that keep all files of a size get pixels instead, and files again once they have dropped them.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shared_picture_without_a_free_file_is_copied() {
    let device = Device::open(0).expect("expected a CUDA device");
    let memory = CudaPictureMemory::new(&device).expect("expected streams");
    let copy = || copy_filled(&memory, [50, 30], [1, 2, 3, 255], false);
    let mut files = Vec::new();
    let copied = loop {
        let copied = copy();
        let Some(png) = copied.png else { break copied };
        files.push(png);
        assert!(files.len() < 100, "expected a limit");
    };
    assert_eq!(copied.pixels.bytes(), [1, 2, 3, 255].repeat(50 * 30 + 4));
    files.pop();
    assert!(copy().png.is_some());
}
