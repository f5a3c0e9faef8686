//! Tone curves, bloom, antialiasing and dithering, compared with arithmetic.

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Antialiasing, Bloom, Camera, Lens, RenderSettings, SceneState, ToneMapping};
use modalcast_render::FrameParams;

use super::harness::{
    RenderedFrame, SceneBuilder, encode_srgb, facing_rectangle, front_camera, is_close, open_renderer,
    planned_passes_above_ground, render, render_sized, render_square,
};

/// A stage with one sample per pixel whose white surfaces emit this linear light.
fn glowing(light: [f32; 3], change: impl FnOnce(RenderSettings) -> RenderSettings) -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.skylight = light;
    builder.parts.look.samples = 1;
    builder.parts.look = change(builder.parts.look);
    builder
}

fn white() -> Material {
    Material { ambient: [1.0; 3], diffuse: [0.0; 3], ..Material::default() }
}

fn linear(byte: u8) -> f64 {
    let shown = f64::from(byte) / 255.0;
    if shown <= 0.040_45 { shown / 12.92 } else { ((shown + 0.055) / 1.055).powf(2.4) }
}

fn reinhard(light: f64) -> f64 {
    light / (1.0 + light)
}

fn aces(light: f64) -> f64 {
    light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14)
}

#[test]
fn tone_curves_have_their_known_values() {
    let shown = |light: [f32; 3], look: &dyn Fn(RenderSettings) -> RenderSettings| {
        render(&glowing(light, look).add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), white()).build())
            .pixel(32, 32)
    };
    // A threshold that only the light of 1e30 exceeds. The bloom pass inverts the tone curve and applies it again.
    let idle = Some(Bloom { threshold: 1000.0, ..Bloom::default() });
    for light in [[0.01, 0.18, 0.5], [1.0, 2.0, 8.0], [0.0, 30.0, 1e30]] {
        let wide = light.map(f64::from);
        for bloom in [None, idle] {
            for (tone, want) in [
                (ToneMapping::Reinhard, wide.map(reinhard)),
                (ToneMapping::Aces, wide.map(aces)),
                (ToneMapping::None, wide),
            ] {
                let want = want.map(|value| if value.is_finite() { value } else { 1.0 });
                let got = shown(light, &|look| RenderSettings { tone, bloom, ..look });
                assert!(is_close(got, want, 1.0), "{tone:?}, {bloom:?}, {light:?}: {got:?}");
            }
        }
    }
    let got = shown([0.09, 0.25, 1.0], &|look| RenderSettings { tone: ToneMapping::Aces, exposure: 2.0, ..look });
    assert!(is_close(got, [0.18, 0.5, 2.0].map(aces), 1.0), "{got:?}");
    assert!(!is_close(got, [0.09, 0.25, 1.0].map(aces), 10.0), "control: exposure is seen");
    assert!(!is_close(got, [0.18, 0.5, 2.0].map(reinhard), 10.0), "control: the curves differ");
}

/// Sum and centroid of the red light; the centroid is in pixels from the top left.
fn sum_and_centroid(shown: &RenderedFrame) -> (f64, [f64; 2]) {
    let (mut sum, mut moment) = (0.0, [0.0; 2]);
    for y in 0..shown.image.height {
        for x in 0..shown.image.width {
            let light = linear(shown.pixel(x, y)[0]);
            sum += light;
            moment = [moment[0] + light * (f64::from(x) + 0.5), moment[1] + light * (f64::from(y) + 0.5)];
        }
    }
    (sum, moment.map(|moment| moment / sum))
}

#[test]
fn bloom_of_one_pixel_keeps_its_light_and_centroid() {
    let shown = |light: f32, bloom: Option<Bloom>, size: [u32; 2]| {
        // One pixel, the second from the center: x = 33, and y = 30 from the top.
        let pixel = facing_rectangle(0.1, 0.1, 0.2, 0.2, 0.0);
        let scene = glowing([light; 3], |look| RenderSettings { bloom, ..look }).add_domain(pixel, white()).build();
        render_sized(&mut open_renderer(), &scene, front_camera(64), size)
    };
    let all = |threshold: f32, levels: u32| Some(Bloom { threshold, strength: 1.0, levels });
    // The blurred pixels end below white, so that the picture contains all of their light.
    for (size, levels, light, above) in
        [([64, 64], 3, 8.0, 0.0), ([61, 67], 3, 8.0, 0.0), ([64, 64], 1, 8.0, 0.0), ([64, 64], 2, 1.2, 0.6)]
    {
        let (sum, centroid) = sum_and_centroid(&shown(light, all(above, levels), size));
        assert!((sum / f64::from(light) - 1.0).abs() < 0.01, "{size:?}, {levels} levels: a sum of {sum}");
        let (_, own) = sum_and_centroid(&shown(light, None, size));
        let off = [centroid[0] - own[0], centroid[1] - own[1]];
        assert!(off.iter().all(|off| off.abs() < 0.05), "{size:?}, {levels} levels: {off:?} from {own:?}");
    }
    let (sum, _) = sum_and_centroid(&shown(8.0, None, [64, 64]));
    assert!((sum - 1.0).abs() < 1e-9, "control: without glow a pixel is white and no more, {sum}");
    let spread = |levels| shown(8.0, all(0.0, levels), [64, 64]).count_pixels(|pixel| pixel != [0; 3]);
    assert!(spread(1) == 36 && spread(3) > 200, "{} and {} pixels", spread(1), spread(3));
}

#[test]
fn bloom_is_symmetric_and_respects_its_threshold() {
    let four = facing_rectangle(-0.1, -0.1, 0.1, 0.1, 0.0);
    let bloom = |threshold| {
        RenderSettings { bloom: Some(Bloom { threshold, strength: 0.8, levels: 4 }), ..RenderSettings::default() }.bloom
    };
    let builder = |threshold| glowing([30.0, 12.0, 5.0], |look| RenderSettings { bloom: bloom(threshold), ..look });
    let shown = render(&builder(1.0).add_domain(four.clone(), white()).build());
    for (x, y) in (0..32).flat_map(|x| (0..32).map(move |y| (x, y))) {
        let here = shown.pixel(x, y);
        for other in [shown.pixel(63 - x, y), shown.pixel(x, 63 - y), shown.pixel(y, x)] {
            assert!(
                (0..3).all(|channel| here[channel].abs_diff(other[channel]) <= 1),
                "({x}, {y}): {here:?}, {other:?}"
            );
        }
    }
    let [r, g, b] = shown.pixel(36, 32);
    assert!(r > g && g > b && b > 0, "a glow has the hue of its light: {r} {g} {b}");
    let plain = render(&glowing([30.0, 12.0, 5.0], |look| look).add_domain(four.clone(), white()).build());
    assert!(
        render(&builder(30.5).add_domain(four, white()).build()).image.rgba == plain.image.rgba,
        "nothing is above 30.5"
    );
    assert!(shown.image.rgba != plain.image.rgba, "control");
}

/// Each sample goes through the tone curve, a clamp here, before the samples of a pixel are averaged. The light for the
/// bloom is extracted from each sample before that.
#[test]
fn bright_edges_stay_antialiased_with_bloom() {
    let shown = |bloom: Option<Bloom>| {
        let builder = glowing([50.0; 3], |look| RenderSettings { bloom, samples: 4, ..look });
        let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.25, ambient: [0.0; 3], ..white() };
        // The lamp covers the right half of the pixels of column 32. Its upper half is behind dark glass.
        let scene = builder
            .add_domain(facing_rectangle(0.05, -2.0, 2.0, 2.0, 0.0), white())
            .add_domain(facing_rectangle(-2.0, 0.0, 2.0, 2.0, 0.1), glass);
        render(&scene.build())
    };
    let plain = shown(None);
    let idle = shown(Some(Bloom { strength: 0.0, ..Bloom::default() }));
    assert_eq!(plain.stats.samples, 4);
    assert!(plain.image.rgba == idle.image.rgba, "a glow of no strength changes nothing");
    for y in [20, 40] {
        assert!(
            is_close(plain.pixel(32, y), [0.5; 3], 1.0) && plain.pixel(33, y) == [255; 3],
            "{:?}",
            plain.pixel(32, y)
        );
    }
    assert!(plain.image.rgba != shown(Some(Bloom::default())).image.rgba, "control");
}

/// A white rhombus with slanted edges on gray, `scale` times 64 pixels per side.
fn slanted(antialias: Antialiasing, samples: u32, scale: u32) -> RenderedFrame {
    let rest = vec![[-2.1, -1.37, 0.0], [1.63, -2.23, 0.0], [2.17, 1.41, 0.0], [-1.57, 2.29, 0.0]];
    let mesh = Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]])
        .expect("expected a valid mesh");
    let mut builder = glowing([0.9; 3], |look| RenderSettings { antialias, samples, ..look });
    (builder.parts.look.zenith, builder.parts.look.horizon) = ([0.1; 3], [0.1; 3]);
    let middle = f64::from(32 * scale);
    let focal = f64::from(100 * scale);
    let lens = Lens::Intrinsics { fx: focal, fy: focal, cx: middle, cy: middle };
    render_square(
        &mut open_renderer(),
        &builder.add_domain(mesh, white()).build(),
        Camera { lens, ..front_camera(64) },
        64 * scale,
    )
}

/// Mean difference from the average light of 8 x 8 fine pixels, in levels.
fn error(shown: &RenderedFrame, fine: &RenderedFrame) -> f64 {
    let exact = |x: u32, y: u32| {
        let light = |i: u32| linear(fine.pixel(8 * x + i % 8, 8 * y + i / 8)[0]);
        encode_srgb((0..64).map(light).sum::<f64>() / 64.0)
    };
    let off = |(x, y): (u32, u32)| (f64::from(shown.pixel(x, y)[0]) - exact(x, y)).abs();
    (0..64).flat_map(|y| (0..64).map(move |x| (x, y))).map(off).sum::<f64>() / 4096.0
}

#[test]
fn fxaa_smooths_slanted_edges_and_keeps_flat_areas() {
    let fine = slanted(Antialiasing::None, 1, 8);
    let (none, fxaa) = (slanted(Antialiasing::None, 1, 1), slanted(Antialiasing::Fxaa, 4, 1));
    let [one, smoothed, four] = [&none, &fxaa, &slanted(Antialiasing::Msaa, 4, 1)].map(|shown| error(shown, &fine));
    assert_eq!((none.stats.samples, fxaa.stats.samples), (1, 1));
    assert!(smoothed < 0.45 * one, "one sample {one}, smoothed {smoothed}, four samples {four} levels");
    assert!(four < 0.6 * one, "control: the judge favours four samples, {four} against {one}");
    assert!(slanted(Antialiasing::Msaa, 1, 1).image.rgba == none.image.rgba);
    let mut changed = 0;
    for (x, y) in (1..63).flat_map(|x| (1..63).map(move |y| (x, y))) {
        let own = none.pixel(x, y);
        let flat = (0..9).all(|i| none.pixel(x + i % 3 - 1, y + i / 3 - 1) == own);
        assert!(!flat || fxaa.pixel(x, y) == own, "({x}, {y}) is flat");
        changed += usize::from(fxaa.pixel(x, y) != own);
    }
    assert!(changed > 100, "control: {changed} pixels were smoothed");
}

/// A sky whose values lie between two levels in each channel.
fn sky(dither: bool) -> RenderedFrame {
    let mut builder = glowing([0.0; 3], |look| RenderSettings { dither, ..look });
    (builder.parts.look.zenith, builder.parts.look.horizon) = ([0.2985, 0.06, 0.41], [0.2988, 0.0601, 0.4103]);
    render(&builder.add_domain(facing_rectangle(-0.1, -3.2, 0.1, -3.1, 0.0), white()).build())
}

/// Exact level of a channel of that sky.
fn exact(x: u32, y: u32, channel: usize) -> f64 {
    let away = nalgebra::Vector3::new((f64::from(x) - 31.5) / 100.0, (31.5 - f64::from(y)) / 100.0, -1.0).normalize();
    let sine = away.y.max(0.0);
    let share = 1.0 - (-6.0 * sine * sine / (sine + 0.06)).exp();
    let (low, high) = ([0.2988, 0.0601, 0.4103][channel], [0.2985, 0.06, 0.41][channel]);
    encode_srgb(low + share * (high - low))
}

#[test]
fn dithering_stays_within_one_level_and_keeps_the_mean() {
    let (rounded, mixed) = (sky(false), sky(true));
    let pixels = || (0..64).flat_map(|y| (0..64).map(move |x| (x, y)));
    for (x, y) in pixels() {
        let (one, other) = (rounded.pixel(x, y), mixed.pixel(x, y));
        assert!((0..3).all(|channel| one[channel].abs_diff(other[channel]) <= 1), "({x}, {y})");
    }
    // Only the upper half, because the sky has one color below the horizon.
    let bias = |shown: &RenderedFrame, channel: usize| {
        let block = |corner: (u32, u32)| {
            let off = |i: u32| {
                let (x, y) = (8 * corner.0 + i % 8, 8 * corner.1 + i / 8);
                f64::from(shown.pixel(x, y)[channel]) - exact(x, y, channel)
            };
            ((0..64).map(off).sum::<f64>() / 64.0).abs()
        };
        (0..4).flat_map(|y| (0..8).map(move |x| (x, y))).map(block).fold(0.0, f64::max)
    };
    for channel in 0..3 {
        let (lost, kept) = (bias(&rounded, channel), bias(&mixed, channel));
        assert!(kept < 0.1 && lost > 0.2, "channel {channel}: {kept} levels with dithering, {lost} without");
    }
    let flat = |dither| {
        let builder = glowing([1.0, 0.0, 2.0], |look| RenderSettings { dither, ..look });
        render(&builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), white()).build()).image.rgba
    };
    assert!(flat(true) == flat(false), "what lies on a level stays");
}

fn everything(look: RenderSettings) -> RenderSettings {
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

/// Only the post-processing passes that the scene names run.
#[test]
fn post_processing_is_deterministic() {
    let scene = |look: RenderSettings| {
        let mut builder = SceneBuilder::new();
        builder.parts.look = look;
        builder
            .add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.3), white())
            .add_domain(facing_rectangle(-2.0, 0.5, 2.0, 0.6, 0.5), white())
            .build()
    };
    let rich = scene(everything(RenderSettings::default()));
    let mut renderer = open_renderer();
    let first = render_square(&mut renderer, &rich, front_camera(96), 96);
    assert_eq!(first.stats.passes, planned_passes_above_ground(&rich));
    assert!(first.stats.passes.contains(&"bloom"));
    let plain = render_square(&mut renderer, &scene(RenderSettings::default()), front_camera(96), 96);
    assert!(!plain.stats.passes.contains(&"bloom"));
    assert!(render_square(&mut renderer, &rich, front_camera(96), 96).image.rgba == first.image.rgba);
    assert!(
        render_square(&mut open_renderer(), &rich, front_camera(96), 96).image.rgba == first.image.rgba,
        "another context"
    );
    assert!(plain.image.rgba != first.image.rgba, "control");
}

#[test]
fn nan_and_infinite_light_affect_no_other_pixel() {
    for tone in [ToneMapping::None, ToneMapping::Reinhard, ToneMapping::Aces] {
        for bloom in [None, Some(Bloom { threshold: 0.9, strength: 1.0, levels: 8 })] {
            let mut builder = glowing([0.25; 3], |look| RenderSettings { tone, bloom, ..look });
            builder.parts.look.sunlight = [3e38; 3];
            let lamp = Material { diffuse: [1.0; 3], specular: [1.0; 3], shininess: 1.0, ..white() };
            let scene = builder
                .add_domain(facing_rectangle(-3.0, -3.0, -2.0, -2.0, 0.0), lamp.clone())
                .add_domain(facing_rectangle(-0.5, -0.5, 0.5, 0.5, 0.0), white())
                .build();
            let mut renderer = open_renderer();
            let mut deformer = ReferenceDeformer::new(&scene);
            let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
            let rest = deformer.surface().expect("there").clone();
            let shown = |normal: [f32; 3]| {
                let mut surface = DeformedSurface { normals: rest.normals.clone(), ..rest.clone() };
                surface.normals[..12].copy_from_slice(&normal.repeat(4));
                let buffers = renderer.load(&scene).expect("expected the scene to load");
                renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
                let shot = FrameParams { camera: front_camera(64), width: 64, height: 64, bounds, light: None };
                let image = renderer.draw(&buffers, &shot).expect("expected a frame");
                RenderedFrame { image, stats: renderer.stats().clone(), allocations: vec![] }
            };
            let mut shown = shown;
            let lit = shown([0.0, 0.0, 1.0]);
            assert!(lit.pixel(7, 57).iter().all(|level| *level > 250), "{tone:?} {bloom:?}: {:?}", lit.pixel(7, 57));
            let dark = shown([f32::NAN; 3]);
            let want = match tone {
                ToneMapping::None => 0.25,
                ToneMapping::Reinhard => reinhard(0.25),
                ToneMapping::Aces => aces(0.25),
            };
            assert!(is_close(dark.pixel(32, 32), [want; 3], 1.0), "{tone:?} {bloom:?}: {:?}", dark.pixel(32, 32));
            assert_eq!(dark.pixel(60, 3), [0; 3], "{tone:?} {bloom:?}");
        }
    }
}
