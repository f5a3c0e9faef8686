//! Tone curves, bloom, antialiasing and dithering give the colors that the tests compute.

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Antialiasing, Bloom, Camera, Lens, RenderSettings, SceneState, ToneMapping};
use modalcast_render::{FrameParams, Pass, plan};

use super::harness::{
    RenderedFrame, SceneBuilder, decode_srgb, encode_srgb, facing_rectangle, front_camera, is_close, open_renderer,
    render, render_sized, render_square,
};

/// A builder with one sample per pixel. Surfaces of [`white_material`] have the linear color `light`. `modify_look`
/// changes the render settings.
fn builder_with_light(light: [f32; 3], modify_look: impl FnOnce(RenderSettings) -> RenderSettings) -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.skylight = light;
    builder.parts.look.samples = 1;
    builder.parts.look = modify_look(builder.parts.look);
    builder
}

/// A material lit by skylight alone.
fn white_material() -> Material {
    Material { ambient: [1.0; 3], diffuse: [0.0; 3], ..Material::default() }
}

/// The curve of [`ToneMapping::Reinhard`].
fn reinhard(light: f64) -> f64 {
    light / (1.0 + light)
}

/// The curve of [`ToneMapping::Aces`].
fn aces(light: f64) -> f64 {
    light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
}

#[test]
fn tone_curves_have_their_known_values() {
    let render_with = |light: [f32; 3], look: &dyn Fn(RenderSettings) -> RenderSettings| {
        render(
            &builder_with_light(light, look)
                .add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), white_material())
                .build(),
        )
        .pixel(32, 32)
    };
    // For light below the threshold, the bloom pass only inverts the tone curve and applies it again. Light of 1e30
    // exceeds the threshold and remains white.
    let idle_bloom = Some(Bloom { threshold: 1000.0, ..Bloom::default() });
    for light in [[0.01, 0.18, 0.5], [1.0, 2.0, 8.0], [0.0, 30.0, 1e30]] {
        let linear_light = light.map(f64::from);
        for bloom in [None, idle_bloom] {
            for (tone, expected) in [
                (ToneMapping::Reinhard, linear_light.map(reinhard)),
                (ToneMapping::Aces, linear_light.map(aces)),
                (ToneMapping::None, linear_light),
            ] {
                let pixel = render_with(light, &|look| RenderSettings { tone, bloom, ..look });
                assert!(is_close(pixel, expected, 1.0), "{tone:?}, {bloom:?}, {light:?}: {pixel:?}");
            }
        }
    }
    let pixel =
        render_with([0.09, 0.25, 1.0], &|look| RenderSettings { tone: ToneMapping::Aces, exposure: 2.0, ..look });
    assert!(is_close(pixel, [0.18, 0.5, 2.0].map(aces), 1.0), "{pixel:?}");
    assert!(
        !is_close(pixel, [0.09, 0.25, 1.0].map(aces), 10.0),
        "negative control: expected exposure to change the color"
    );
    assert!(
        !is_close(pixel, [0.18, 0.5, 2.0].map(reinhard), 10.0),
        "negative control: expected another color with the other curve"
    );
}

/// The sum of the linear red values of all pixels, and the centroid (x, y) of the red light in pixels from the top
/// left.
fn sum_and_centroid(frame: &RenderedFrame) -> (f64, [f64; 2]) {
    let (mut sum, mut moment) = (0.0, [0.0; 2]);
    for y in 0..frame.image.height {
        for x in 0..frame.image.width {
            let light = decode_srgb(frame.pixel(x, y)[0]);
            sum += light;
            moment = [moment[0] + light * (f64::from(x) + 0.5), moment[1] + light * (f64::from(y) + 0.5)];
        }
    }
    (sum, moment.map(|moment| moment / sum))
}

#[test]
fn bloom_of_one_pixel_keeps_its_light_and_centroid() {
    let render_with = |light: f32, bloom: Option<Bloom>, size: [u32; 2]| {
        // A square that covers one pixel: x = 33, and y = 30 from the top.
        let square = facing_rectangle(0.1, 0.1, 0.2, 0.2, 0.0);
        let scene = builder_with_light([light; 3], |look| RenderSettings { bloom, ..look })
            .add_domain(square, white_material())
            .build();
        render_sized(&mut open_renderer(), &scene, front_camera(64), size)
    };
    let full_bloom = |threshold: f32, levels: u32| Some(Bloom { threshold, strength: 1.0, levels });
    // Blurred pixels stay below white, so that no light is clipped. Rounding to 8 bits changes the sum by less than 1
    // %.
    for (size, levels, light, threshold) in
        [([64, 64], 3, 8.0, 0.0), ([61, 67], 3, 8.0, 0.0), ([64, 64], 1, 8.0, 0.0), ([64, 64], 2, 1.2, 0.6)]
    {
        let (sum, centroid) = sum_and_centroid(&render_with(light, full_bloom(threshold, levels), size));
        assert!((sum / f64::from(light) - 1.0).abs() < 0.01, "{size:?}, {levels} levels: a sum of {sum}");
        let (_, source_centroid) = sum_and_centroid(&render_with(light, None, size));
        let shift = [centroid[0] - source_centroid[0], centroid[1] - source_centroid[1]];
        assert!(
            shift.iter().all(|shift| shift.abs() < 0.05),
            "{size:?}, {levels} levels: {shift:?} from {source_centroid:?}"
        );
    }
    let (sum, _) = sum_and_centroid(&render_with(8.0, None, [64, 64]));
    assert!((sum - 1.0).abs() < 1e-9, "negative control: expected one white pixel without bloom, got a sum of {sum}");
    // One level spreads the pixel to 2 x 2 texels of half the resolution, and these to 6 x 6 pixels.
    let count_lit = |levels| render_with(8.0, full_bloom(0.0, levels), [64, 64]).count_pixels(|pixel| pixel != [0; 3]);
    assert!(count_lit(1) == 36 && count_lit(3) > 200, "{} and {} pixels", count_lit(1), count_lit(3));
}

#[test]
fn bloom_is_symmetric_and_respects_its_threshold() {
    let square = facing_rectangle(-0.1, -0.1, 0.1, 0.1, 0.0);
    let builder = |threshold: f32| {
        let bloom = Some(Bloom { threshold, strength: 0.8, levels: 4 });
        builder_with_light([30.0, 12.0, 5.0], |look| RenderSettings { bloom, ..look })
    };
    let frame = render(&builder(1.0).add_domain(square.clone(), white_material()).build());
    for (x, y) in (0..32).flat_map(|x| (0..32).map(move |y| (x, y))) {
        let pixel = frame.pixel(x, y);
        for mirrored_pixel in [frame.pixel(63 - x, y), frame.pixel(x, 63 - y), frame.pixel(y, x)] {
            assert!(
                (0..3).all(|channel| pixel[channel].abs_diff(mirrored_pixel[channel]) <= 1),
                "({x}, {y}): {pixel:?}, {mirrored_pixel:?}"
            );
        }
    }
    // Pixel (36, 32) is beside the square, which covers columns 31 and 32.
    let [r, g, b] = frame.pixel(36, 32);
    assert!(r > g && g > b && b > 0, "expected bloom with the hue of its light, got {r} {g} {b}");
    let unbloomed_frame = render(
        &builder_with_light([30.0, 12.0, 5.0], |look| look).add_domain(square.clone(), white_material()).build(),
    );
    assert!(
        render(&builder(30.5).add_domain(square, white_material()).build()).image.rgba == unbloomed_frame.image.rgba,
        "expected no bloom below the threshold"
    );
    assert!(frame.image.rgba != unbloomed_frame.image.rgba, "negative control: expected bloom to change the image");
}

/// Each sample is tone-mapped (here clamped to 1) before the samples of a pixel are averaged. Bloom uses the light of
/// the samples before tone mapping.
#[test]
fn bright_edges_stay_antialiased_with_bloom() {
    let render_with = |bloom: Option<Bloom>| {
        let builder = builder_with_light([50.0; 3], |look| RenderSettings { bloom, samples: 4, ..look });
        let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.25, ambient: [0.0; 3], ..white_material() };
        // A bright square whose left edge halves the pixels of column 32. The upper half of the square is behind dark
        // glass, but still brighter than white.
        let scene = builder
            .add_domain(facing_rectangle(0.05, -2.0, 2.0, 2.0, 0.0), white_material())
            .add_domain(facing_rectangle(-2.0, 0.0, 2.0, 2.0, 0.1), glass);
        render(&scene.build())
    };
    let unbloomed_frame = render_with(None);
    let zero_bloom_frame = render_with(Some(Bloom { strength: 0.0, ..Bloom::default() }));
    assert_eq!(unbloomed_frame.stats.samples, 4);
    assert!(unbloomed_frame.image.rgba == zero_bloom_frame.image.rgba, "expected no change by bloom of strength 0");
    for y in [20, 40] {
        assert!(
            is_close(unbloomed_frame.pixel(32, y), [0.5; 3], 1.0) && unbloomed_frame.pixel(33, y) == [255; 3],
            "{:?}",
            unbloomed_frame.pixel(32, y)
        );
    }
    assert!(
        unbloomed_frame.image.rgba != render_with(Some(Bloom::default())).image.rgba,
        "negative control: expected bloom to change the image"
    );
}

/// Renders a white rhombus with slanted edges in front of a gray background. The image has `scale` times 64 pixels per
/// side.
fn render_rhombus(antialias: Antialiasing, samples: u32, scale: u32) -> RenderedFrame {
    let positions = vec![[-2.1, -1.37, 0.0], [1.63, -2.23, 0.0], [2.17, 1.41, 0.0], [-1.57, 2.29, 0.0]];
    let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]])
        .expect("expected a valid mesh");
    let mut builder = builder_with_light([0.9; 3], |look| RenderSettings { antialias, samples, ..look });
    (builder.parts.look.zenith, builder.parts.look.horizon) = ([0.1; 3], [0.1; 3]);
    let center = f64::from(32 * scale);
    let focal_length = f64::from(100 * scale);
    let lens = Lens::Intrinsics { fx: focal_length, fy: focal_length, cx: center, cy: center };
    render_square(
        &mut open_renderer(),
        &builder.add_domain(mesh, white_material()).build(),
        Camera { lens, ..front_camera(64) },
        64 * scale,
    )
}

/// Mean difference from a reference image of 8 times the resolution, in levels. A pixel is compared with the average
/// linear light of its 8 x 8 reference pixels.
fn mean_error(frame: &RenderedFrame, reference: &RenderedFrame) -> f64 {
    let expected_level = |x: u32, y: u32| {
        let light = |i: u32| decode_srgb(reference.pixel(8 * x + i % 8, 8 * y + i / 8)[0]);
        encode_srgb((0..64).map(light).sum::<f64>() / 64.0)
    };
    let error = |(x, y): (u32, u32)| (f64::from(frame.pixel(x, y)[0]) - expected_level(x, y)).abs();
    (0..64).flat_map(|y| (0..64).map(move |x| (x, y))).map(error).sum::<f64>() / (64.0 * 64.0)
}

#[test]
fn fxaa_smooths_slanted_edges_and_keeps_flat_areas() {
    let reference = render_rhombus(Antialiasing::None, 1, 8);
    let (aliased_frame, fxaa_frame) =
        (render_rhombus(Antialiasing::None, 1, 1), render_rhombus(Antialiasing::Fxaa, 4, 1));
    let [aliased_error, fxaa_error, msaa_error] =
        [&aliased_frame, &fxaa_frame, &render_rhombus(Antialiasing::Msaa, 4, 1)]
            .map(|frame| mean_error(frame, &reference));
    // FXAA draws one sample per pixel, although the scene has 4.
    assert_eq!((aliased_frame.stats.samples, fxaa_frame.stats.samples), (1, 1));
    // FXAA must remove at least 55 % of the error, MSAA at least 40 %.
    assert!(
        fxaa_error < 0.45 * aliased_error,
        "error in levels: one sample {aliased_error}, FXAA {fxaa_error}, MSAA {msaa_error}"
    );
    assert!(msaa_error < 0.6 * aliased_error, "error in levels: one sample {aliased_error}, MSAA {msaa_error}");
    assert!(
        render_rhombus(Antialiasing::Msaa, 1, 1).image.rgba == aliased_frame.image.rgba,
        "expected no antialiasing by MSAA with one sample"
    );
    let mut changed_pixels = 0;
    for (x, y) in (1..63).flat_map(|x| (1..63).map(move |y| (x, y))) {
        let pixel = aliased_frame.pixel(x, y);
        // The pixel and its 8 neighbors have one color.
        let is_flat = (0..9).all(|i| aliased_frame.pixel(x + i % 3 - 1, y + i / 3 - 1) == pixel);
        assert!(!is_flat || fxaa_frame.pixel(x, y) == pixel, "({x}, {y}): expected no change in a uniform area");
        changed_pixels += usize::from(fxaa_frame.pixel(x, y) != pixel);
    }
    assert!(changed_pixels > 100, "negative control: expected changed edges, got {changed_pixels} pixels");
}

/// Linear colors of the sky. They are close to each other, and each channel is between two levels.
const SKY_ZENITH: [f64; 3] = [0.2985, 0.06, 0.41];
const SKY_HORIZON: [f64; 3] = [0.2988, 0.0601, 0.4103];

/// Renders the sky from [`SKY_HORIZON`] to [`SKY_ZENITH`].
fn render_sky(dither: bool) -> RenderedFrame {
    let mut builder = builder_with_light([0.0; 3], |look| RenderSettings { dither, ..look });
    let look = &mut builder.parts.look;
    (look.zenith, look.horizon) = (SKY_ZENITH.map(|channel| channel as f32), SKY_HORIZON.map(|channel| channel as f32));
    render(&builder.add_domain(facing_rectangle(-0.1, -3.2, 0.1, -3.1, 0.0), white_material()).build())
}

/// Unrounded level of a channel of [`render_sky`], by the formula of `shaders/shared/sky.glsl`.
fn exact_sky_level(x: u32, y: u32, channel: usize) -> f64 {
    let direction =
        nalgebra::Vector3::new((f64::from(x) - 31.5) / 100.0, (31.5 - f64::from(y)) / 100.0, -1.0).normalize();
    let sine = direction.y.max(0.0);
    let weight = 1.0 - (-6.0 * sine * sine / (sine + 0.06)).exp();
    let (horizon, zenith) = (SKY_HORIZON[channel], SKY_ZENITH[channel]);
    encode_srgb(horizon + weight * (zenith - horizon))
}

#[test]
fn dithering_stays_within_one_level_and_keeps_the_mean() {
    let (undithered_frame, dithered_frame) = (render_sky(false), render_sky(true));
    let pixels = || (0..64).flat_map(|y| (0..64).map(move |x| (x, y)));
    for (x, y) in pixels() {
        let (a, b) = (undithered_frame.pixel(x, y), dithered_frame.pixel(x, y));
        assert!((0..3).all(|channel| a[channel].abs_diff(b[channel]) <= 1), "({x}, {y})");
    }
    // Largest mean error of a block of 8 x 8 pixels, the size of the dither pattern, in levels. Only blocks of the
    // upper half of the image are used, because the sky below the horizon has one color.
    let max_block_bias = |frame: &RenderedFrame, channel: usize| {
        let block_bias = |(block_x, block_y): (u32, u32)| {
            let error = |i: u32| {
                let (x, y) = (8 * block_x + i % 8, 8 * block_y + i / 8);
                f64::from(frame.pixel(x, y)[channel]) - exact_sky_level(x, y, channel)
            };
            ((0..64).map(error).sum::<f64>() / 64.0).abs()
        };
        (0..4).flat_map(|y| (0..8).map(move |x| (x, y))).map(block_bias).fold(0.0, f64::max)
    };
    for channel in 0..3 {
        let (undithered_bias, dithered_bias) =
            (max_block_bias(&undithered_frame, channel), max_block_bias(&dithered_frame, channel));
        assert!(
            dithered_bias < 0.1 && undithered_bias > 0.2,
            "channel {channel}: {dithered_bias} levels with dithering, {undithered_bias} without"
        );
    }
    // Black and white are exact levels; 2 is clamped to white.
    let render_representable = |dither| {
        let builder = builder_with_light([1.0, 0.0, 2.0], |look| RenderSettings { dither, ..look });
        render(&builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), white_material()).build()).image.rgba
    };
    assert!(render_representable(true) == render_representable(false), "expected no change of representable levels");
}

/// Enables all post-processing.
fn with_all_effects(look: RenderSettings) -> RenderSettings {
    let bloom = Some(Bloom { threshold: 0.3, ..Bloom::default() });
    RenderSettings {
        bloom,
        tone: ToneMapping::Aces,
        exposure: 1.3,
        antialias: Antialiasing::Fxaa,
        dither: true,
        ..look
    }
}

/// Repeated frames are bit-identical, and only the post-processing passes that the scene enables run.
#[test]
fn post_processing_is_deterministic() {
    let scene = |look: RenderSettings| {
        let mut builder = SceneBuilder::new();
        builder.parts.look = look;
        builder
            .add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.3), white_material())
            .add_domain(facing_rectangle(-2.0, 0.5, 2.0, 0.6, 0.5), white_material())
            .build()
    };
    let all_effects = scene(with_all_effects(RenderSettings::default()));
    let mut renderer = open_renderer();
    let first_frame = render_square(&mut renderer, &all_effects, front_camera(96), 96);
    assert_eq!(first_frame.stats.passes, plan(&all_effects).passes);
    assert!(first_frame.stats.passes.contains(&Pass::Bloom));
    let plain_frame = render_square(&mut renderer, &scene(RenderSettings::default()), front_camera(96), 96);
    assert!(!plain_frame.stats.passes.contains(&Pass::Bloom));
    assert!(render_square(&mut renderer, &all_effects, front_camera(96), 96).image.rgba == first_frame.image.rgba);
    assert!(
        render_square(&mut open_renderer(), &all_effects, front_camera(96), 96).image.rgba == first_frame.image.rgba,
        "expected the same image in another context"
    );
    assert!(plain_frame.image.rgba != first_frame.image.rgba, "negative control: expected bloom to change the image");
}

#[test]
fn nan_and_infinite_light_affect_no_other_pixel() {
    for tone in [ToneMapping::None, ToneMapping::Reinhard, ToneMapping::Aces] {
        for bloom in [None, Some(Bloom { threshold: 0.9, strength: 1.0, levels: 8 })] {
            let mut builder = builder_with_light([0.25; 3], |look| RenderSettings { tone, bloom, ..look });
            // Diffuse and specular light together overflow to infinity on the lamp. The white square faces the sun, but
            // reflects skylight alone.
            builder.parts.look.sunlight = [3e38; 3];
            let lamp = Material { diffuse: [1.0; 3], specular: [1.0; 3], shininess: 1.0, ..white_material() };
            let scene = builder
                .add_domain(facing_rectangle(-3.0, -3.0, -2.0, -2.0, 0.0), lamp.clone())
                .add_domain(facing_rectangle(-0.5, -0.5, 0.5, 0.5, 0.0), white_material())
                .build();
            let mut renderer = open_renderer();
            let mut deformer = ReferenceDeformer::new(&scene);
            let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
            let rest_surface = deformer.surface().expect("expected a surface").clone();
            // Renders the scene with `normal` at the four corners of the lamp.
            let mut render_with = |normal: [f32; 3]| {
                let mut surface = DeformedSurface { normals: rest_surface.normals.clone(), ..rest_surface.clone() };
                surface.normals[..12].copy_from_slice(&normal.repeat(4));
                let buffers = renderer.load(&scene).expect("expected the scene to load");
                renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
                let params = FrameParams {
                    camera: front_camera(64),
                    width: 64,
                    height: 64,
                    bounds,
                    light_bounds: None,
                    edges: None,
                    samples: None,
                };
                let image = renderer.draw(&buffers, &params).expect("expected a frame");
                RenderedFrame { image, stats: renderer.stats().clone(), allocations: vec![] }
            };

            let lit_frame = render_with([0.0, 0.0, 1.0]);
            // Pixel (7, 57) shows the lamp, (32, 32) the white square, and (60, 3) the black sky.
            assert!(
                lit_frame.pixel(7, 57).iter().all(|level| *level > 250),
                "{tone:?} {bloom:?}: {:?}",
                lit_frame.pixel(7, 57)
            );
            let nan_frame = render_with([f32::NAN; 3]);
            let expected = match tone {
                ToneMapping::None => 0.25,
                ToneMapping::Reinhard => reinhard(0.25),
                ToneMapping::Aces => aces(0.25),
            };
            assert!(
                is_close(nan_frame.pixel(32, 32), [expected; 3], 1.0),
                "{tone:?} {bloom:?}: {:?}",
                nan_frame.pixel(32, 32)
            );
            assert_eq!(nan_frame.pixel(60, 3), [0; 3], "{tone:?} {bloom:?}");
        }
    }
}
