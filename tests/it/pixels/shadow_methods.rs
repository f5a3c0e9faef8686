//! Every kind of shadow map compared with the same arithmetic: the shadow of a straight edge on the ground.

use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Camera, Lens, MomentFormat, Scene, ShadowMethod, ShadowSettings, View};
use modalcast_render::{BlurMethod, Pass, plan};

use super::harness::{RenderedFrame, floor_mesh, is_close, open_renderer, planned_passes_above_ground, render_square};
use super::shadow::{create_builder, with_square};

/// Pixels per unit of the ground in the picture of the edge.
const SCALE: f64 = 100.0;
/// Half the extent of the light box across the edge: the bounds reach 5 there, rounded up to the next larger multiple
/// of 4 / 16.
const HALF: f64 = 5.25;

fn variance() -> ShadowSettings {
    ShadowSettings { size: 256, blur: 2.0, bleeding: 0.0, ..ShadowSettings::default() }
}

/// Side of a texel across the edge, in units. `rim` texels at each border of the map contain no caster.
fn texel(shadow: &ShadowSettings) -> f64 {
    let rim = f64::from(shadow.reach()) + 1.0;
    2.0 * HALF / (f64::from(shadow.size) - 2.0 * rim)
}

fn scene(shadow: ShadowSettings) -> std::sync::Arc<Scene> {
    let mut builder = create_builder();
    builder.parts.look.shadow = Some(shadow);
    with_square(builder, AlphaMode::Opaque, 1.0).build()
}

/// Picture from straight above of the edge at z = 1 of the shadow of the square.
fn edge(shadow: ShadowSettings) -> RenderedFrame {
    edge_blurred_by(BlurMethod::Auto, shadow)
}

/// [`edge`] with this implementation of the blur.
fn edge_blurred_by(method: BlurMethod, shadow: ShadowSettings) -> RenderedFrame {
    let mut renderer = open_renderer();
    renderer.set_blur_method(method);
    let view = View::LookAt { eye: [0.0, 20.0, 1.0], target: [0.0, 0.0, 1.0], up: [0.0, 0.0, -1.0] };
    let lens = Lens::Intrinsics { fx: 20.0 * SCALE, fy: 20.0 * SCALE, cx: 32.0, cy: 32.0 };
    render_square(&mut renderer, &scene(shadow), Camera { view, lens, near: 0.0, far: 0.0 }, 64)
}

/// z of the ground at the center of a row.
fn z_of(row: u32) -> f64 {
    1.0 + (f64::from(row) + 0.5 - 32.0) / SCALE
}

/// Fraction of the sun's light that reaches the ground in a pixel.
fn share([byte, ..]: [u8; 3]) -> f64 {
    let encoded = f64::from(byte) / 255.0;
    let linear = if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) };
    (linear / 0.8 - 0.25) / (0.5 * 0.8)
}

fn profile(picture: &RenderedFrame, column: u32) -> Vec<f64> {
    (0..64).map(|row| share(picture.pixel(column, row))).collect()
}

/// Expected fraction of sunlight at z: texels whose center the square covers are dark. The result is blurred with the
/// Gaussian and interpolated linearly between texels.
fn expected(shadow: &ShadowSettings, z: f64) -> f64 {
    let (texel, reach) = (texel(shadow), shadow.reach() as i64);
    let bell = |step: i64| if step == 0 { 1.0 } else { (-0.5 * (step as f64 / f64::from(shadow.blur)).powi(2)).exp() };
    let sum: f64 = (-reach..=reach).map(bell).sum();
    // The grid starts at the center; texel edges are at multiples of a texel.
    let open = |index: i64| f64::from(u8::from((index as f64 + 0.5) * texel > 1.0));
    let blurred = |index: i64| (-reach..=reach).map(|step| bell(step) / sum * open(index + step)).sum::<f64>();
    let place = z / texel - 0.5;
    let past = place - place.floor();
    (1.0 - past) * blurred(place.floor() as i64) + past * blurred(place.floor() as i64 + 1)
}

/// The fraction of sunlight is correct to about a hundredth, for every way of blurring.
#[test]
fn filtered_and_variance_maps_give_the_blurred_edge() {
    let base = variance();
    let kinds = [
        (BlurMethod::Auto, ShadowSettings { method: ShadowMethod::PercentageCloser, ..base }),
        (BlurMethod::Auto, ShadowSettings { method: ShadowMethod::PercentageCloser, blur: 0.7, ..base }),
        (BlurMethod::Rows, base),
        (BlurMethod::Tiles, base),
        (BlurMethod::Tiles, ShadowSettings { blur: 0.0, ..base }),
        (BlurMethod::Tiles, ShadowSettings { blur: 4.0, ..base }),
        (BlurMethod::Fragments, base),
    ];
    for (method, shadow) in kinds {
        let seen = profile(&edge_blurred_by(method, shadow), 32);
        let wrong = |shift: f64| {
            let error = |row: u32| (seen[row as usize] - expected(&shadow, z_of(row) + shift)).abs();
            (0..64).map(error).fold(0.0, f64::max)
        };
        assert!(wrong(0.0) < 0.012, "{method:?}, {shadow:?}: {} at the worst", wrong(0.0));
        assert!(wrong(0.5 * texel(&shadow)) > 0.02, "control: half a texel aside is seen");
    }
}

#[test]
fn all_blur_implementations_agree() {
    // Blurs of up to 8 texels use strips, which are taller in larger maps; wider blurs use tiles.
    for (blur, size) in [(0.0, 200), (1.5, 200), (4.0, 200), (8.0, 200), (9.0, 200), (16.0, 200), (2.3, 1100)] {
        let [tiles, rows, fragments] = [BlurMethod::Tiles, BlurMethod::Rows, BlurMethod::Fragments]
            .map(|method| edge_blurred_by(method, ShadowSettings { size, blur, ..variance() }).image.rgba);
        let most = |other: &[u8]| tiles.iter().zip(other).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
        assert!(most(&rows) <= 1 && most(&fragments) <= 1, "blur {blur}: {} {}", most(&rows), most(&fragments));
        let wider = edge(ShadowSettings { size, blur: (blur + 1.0).min(15.0), ..variance() }).image.rgba;
        assert!(most(&wider) > 1, "control: another blur is seen");
    }
}

/// z where half of the sunlight arrives.
fn crossing(profile: &[f64]) -> f64 {
    let row = profile.iter().position(|share| *share > 0.5).expect("the picture has a lit side");
    let (dark, light) = (profile[row - 1], profile[row]);
    z_of(row as u32) - (light - 0.5) / (light - dark) / SCALE
}

#[test]
fn shadow_edges_are_within_their_stated_distance() {
    let base = variance();
    // The tolerance is half a texel, for the sampling of the caster. Bleeding reduction moves the edge outwards by
    // 0.2533 standard deviations of the blur.
    let kinds = [
        (ShadowSettings { method: ShadowMethod::Standard, ..base }, 0.0),
        (ShadowSettings { method: ShadowMethod::PercentageCloser, ..base }, 0.0),
        (base, 0.0),
        (ShadowSettings { bleeding: 0.2, ..base }, 0.2533 * 2.0),
        (ShadowSettings { moments: MomentFormat::F16, ..base }, 0.0),
    ];
    for size in [64, 100, 256] {
        for (shadow, outwards) in kinds {
            let shadow = ShadowSettings { size, ..shadow };
            let off = (crossing(&profile(&edge(shadow), 32)) - 1.0) / texel(&shadow);
            let pixel = 1.0 / SCALE / texel(&shadow);
            assert!((off - outwards).abs() <= 0.5 + pixel, "{shadow:?}: {off} texels");
        }
    }
    let narrow = expected(&base, 1.0 + 4.0 * texel(&base));
    assert!(narrow > 0.95, "control: four texels aside is no edge, {narrow} arrive there");
}

#[test]
fn only_standard_maps_have_hard_edges() {
    let between = |shadow: ShadowSettings| {
        let picture = edge(shadow);
        (0..64).flat_map(|column| profile(&picture, column)).filter(|share| (0.05..0.95).contains(share)).count()
    };
    assert_eq!(between(ShadowSettings { method: ShadowMethod::Standard, ..variance() }), 0);
    for method in [ShadowMethod::PercentageCloser, ShadowMethod::Variance] {
        assert!(between(ShadowSettings { method, ..variance() }) > 500, "control: {method:?} is soft");
    }
}

/// Number of pixels of a lit square of six units per side that are darker than the sun makes them; the square casts and
/// receives.
fn self_shadowed(over: &[Mesh], shadow: ShadowSettings, sun: [f32; 3]) -> usize {
    let mut builder = create_builder();
    (builder.parts.look.shadow, builder.parts.look.sun) = (Some(shadow), sun);
    let builder = over.iter().fold(builder, |builder, mesh| builder.add_domain(mesh.clone(), Material::default()));
    let scene = builder.add_domain(floor_mesh(3.0, 2.0), Material::default()).build();
    let view = View::LookAt { eye: [0.0, 20.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, -1.0] };
    let lens = Lens::Intrinsics { fx: 200.0, fy: 200.0, cx: 32.0, cy: 32.0 };
    let shown = render_square(&mut open_renderer(), &scene, Camera { view, lens, near: 0.0, far: 0.0 }, 64);
    let facing = nalgebra::Vector3::from(sun).cast::<f64>().normalize().y;
    let inner = (8..56).flat_map(|y| (8..56).map(move |x| (x, y)));
    inner.filter(|(x, y)| !is_close(shown.pixel(*x, *y), [0.25 + 0.5 * facing; 3], 2.0)).count()
}

#[test]
fn no_method_shadows_a_lit_surface() {
    let base = ShadowSettings { size: 512, ..ShadowSettings::default() };
    for sun in [[0.0, 1.0, 0.0], [3.0, 4.0, 0.0], [1.0, 0.4, 0.6], [1.0, 0.15, 0.3]] {
        let kinds = [
            base,
            ShadowSettings { method: ShadowMethod::Standard, ..base },
            ShadowSettings { method: ShadowMethod::PercentageCloser, ..base },
            ShadowSettings { method: ShadowMethod::PercentageCloser, blur: 4.0, ..base },
            ShadowSettings { splits: 4, ..base },
        ];
        for shadow in kinds {
            assert_eq!(self_shadowed(&[], shadow, sun), 0, "{sun:?} {shadow:?}");
        }
    }
    let over = self_shadowed(&[floor_mesh(0.5, 3.0)], base, [1.0, 0.4, 0.6]);
    assert!(over > 20, "control: a caster over it darkens {over} pixels only");
}

/// Number of lit pixels in a strip of ground that is fully in the shadow of a square just above it.
fn lit_in_the_umbra(moments: MomentFormat) -> usize {
    let mut builder = create_builder();
    builder.parts.look.shadow = Some(ShadowSettings { size: 2048, blur: 0.5, moments, ..ShadowSettings::default() });
    builder.parts.look.sun = [3.0, 1.0, 0.0];
    // Far from the center of the depth range, where f16 is coarse. The shadow extends 0.09 beyond the square.
    let mut rest = floor_mesh(1.0, 0.03).rest().to_vec();
    rest.iter_mut().for_each(|vertex| vertex[0] -= 2.5);
    let mesh = Mesh::from_indexed(rest, vec![[0.0, 1.0, 0.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]])
        .expect("expected a valid mesh");
    let scene = builder.add_domain(mesh, Material { double_sided: true, ..Material::default() }).build();
    let view = View::LookAt { eye: [-3.545, 20.0, 0.0], target: [-3.545, 0.0, 0.0], up: [0.0, 0.0, -1.0] };
    let lens = Lens::Intrinsics { fx: 2e4, fy: 2e4, cx: 32.0, cy: 32.0 };
    let shown = render_square(&mut open_renderer(), &scene, Camera { view, lens, near: 0.0, far: 0.0 }, 64);
    let dark = [0.8 * 0.25; 3];
    (0..64 * 64).filter(|pixel| !is_close(shown.pixel(pixel % 64, pixel / 64), dark, 3.0)).count()
}

/// Moments in f32 leak none.
#[test]
fn f16_moments_leak_light_near_the_caster() {
    assert_eq!(lit_in_the_umbra(MomentFormat::F32), 0);
    let failed = lit_in_the_umbra(MomentFormat::F16);
    assert!(failed > 400, "f16 spoils {failed} of 4096 pixels only");
}

/// Number of half-lit pixels in the middle column of a close-up of the edge of the shadow.
fn half_lit(splits: u32) -> usize {
    let view = View::LookAt { eye: [0.0, 2.0, 4.0], target: [0.0, 0.0, 1.0], up: [0.0, 1.0, 0.0] };
    let lens = Lens::Intrinsics { fx: 400.0, fy: 400.0, cx: 64.0, cy: 64.0 };
    let scene = scene(ShadowSettings { size: 64, splits, ..variance() });
    let shown = render_square(&mut open_renderer(), &scene, Camera { view, lens, near: 0.0, far: 0.0 }, 128);
    let column: Vec<f64> = (0..128).map(|row| share(shown.pixel(64, row))).collect();
    assert!(column[0] < 0.1 && column[127] > 0.9, "dark behind the edge and lit before it, {splits} maps: {column:?}");
    column.iter().filter(|share| (0.1..0.9).contains(*share)).count()
}

#[test]
fn splits_give_near_shadows_finer_texels() {
    let (one, four) = (half_lit(1), half_lit(4));
    assert!(one > 30 && four > 0 && 3 * four <= one, "{one} pixels with one map, {four} with four");
}

#[test]
fn unused_shadow_resources_are_not_allocated() {
    let made = |shadow: ShadowSettings| {
        let scene = scene(shadow);
        let (shown, plan) = (edge(shadow), plan(&scene));
        assert_eq!(shown.stats.passes, planned_passes_above_ground(&scene), "what is planned is what runs");
        let textures: Vec<String> = plan.textures.iter().map(|part| part.name.clone()).collect();
        let maps: Vec<String> = textures.into_iter().filter(|name| name.starts_with("shadow")).collect();
        let splits = shown.allocations.iter().any(|part| part.name == "shadow cascades");
        (shown.stats.passes.contains(&Pass::Blur), maps, splits)
    };
    let base = ShadowSettings { size: 64, ..ShadowSettings::default() };
    let depth = vec!["shadow depth".to_string()];
    for method in [ShadowMethod::Standard, ShadowMethod::PercentageCloser] {
        assert_eq!(made(ShadowSettings { method, ..base }), (false, depth.clone(), false));
    }
    let both = vec!["shadow depth".to_string(), "shadow moments".to_string()];
    assert_eq!(made(base), (true, both.clone(), false));
    assert_eq!(made(ShadowSettings { splits: 2, ..base }), (true, both, true));
}
