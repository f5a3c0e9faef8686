//! The edge of a shadow on the ground, for every shadow method, equals the edge that the tests compute in f64. The edge
//! is the line z = 1, where the shadow of the square of [`with_square`] ends.

use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Camera, Lens, MomentFormat, Scene, ShadowMethod, ShadowSettings, View};
use modalcast_render::{BlurMethod, Pass, plan};

use super::harness::{RenderedFrame, decode_srgb, floor_mesh, is_close, open_renderer, render_square};
use super::shadow::{create_builder, with_square};

/// Pixels per unit of the ground in the image of the edge.
const PIXELS_PER_UNIT: f64 = 100.0;
/// Half the extent of the light box along z, across the edge. The bounds extend to z = 5. Half extents from 4 to 8 are
/// quantized to multiples of 4 / 16 = 0.25. The value 5, which is a multiple itself, becomes the next one, 5.25.
const LIGHT_BOX_HALF_EXTENT: f64 = 5.25;

/// A variance shadow map with a blur of 2 texels. Without the fallback to filtered depths, which would hide errors of
/// the moments.
fn variance_settings() -> ShadowSettings {
    ShadowSettings { size: 256, blur: 2.0, bleeding: 0.0, pcf_fallback: false, ..ShadowSettings::default() }
}

/// Side of a shadow map texel along z, in scene units. The light box covers the map except for its empty border.
fn texel_size(shadow: &ShadowSettings) -> f64 {
    // Texels at each border that contain no caster.
    let empty_border = f64::from(shadow.blur_radius()) + 1.0;
    2.0 * LIGHT_BOX_HALF_EXTENT / (f64::from(shadow.size) - 2.0 * empty_border)
}

fn square_scene(shadow: ShadowSettings) -> std::sync::Arc<Scene> {
    let mut builder = create_builder();
    builder.parts.look.shadow = Some(shadow);
    with_square(builder, AlphaMode::Opaque, 1.0).build()
}

/// Renders the edge from straight above. Row 32 of the image begins at the edge. Clip planes of 0 are fitted to the
/// bounds, here and below.
fn render_edge(shadow: ShadowSettings) -> RenderedFrame {
    render_edge_with_blur(BlurMethod::Auto, shadow)
}

/// [`render_edge`] with the given blur method.
fn render_edge_with_blur(blur_method: BlurMethod, shadow: ShadowSettings) -> RenderedFrame {
    let mut renderer = open_renderer();
    renderer.set_blur_method(blur_method);
    let view = View::LookAt { eye: [0.0, 20.0, 1.0], target: [0.0, 0.0, 1.0], up: [0.0, 0.0, -1.0] };
    let lens = Lens::Intrinsics { fx: 20.0 * PIXELS_PER_UNIT, fy: 20.0 * PIXELS_PER_UNIT, cx: 32.0, cy: 32.0 };
    render_square(&mut renderer, &square_scene(shadow), Camera { view, lens, near: 0.0, far: 0.0 }, 64)
}

/// z of the ground at the center of a row.
fn ground_z(row: u32) -> f64 {
    1.0 + (f64::from(row) + 0.5 - 32.0) / PIXELS_PER_UNIT
}

/// Fraction of the sun's light that reaches the ground in a pixel. The color of the ground is 0.8, skylight is 0.25,
/// sunlight 0.5, and the cosine of the angle of incidence 0.8.
fn sun_visibility([level, ..]: [u8; 3]) -> f64 {
    let (ground_color, cosine) = (0.8, 0.8);
    (decode_srgb(level) / ground_color - 0.25) / (0.5 * cosine)
}

/// Sun visibility of the pixels of an image column, from top to bottom.
fn visibility_profile(frame: &RenderedFrame, column: u32) -> Vec<f64> {
    (0..64).map(|row| sun_visibility(frame.pixel(column, row))).collect()
}

/// Expected fraction of sunlight at z. A texel is dark if the square covers its center. The texels are blurred with the
/// Gaussian and interpolated linearly.
fn expected_visibility(shadow: &ShadowSettings, z: f64) -> f64 {
    let (texel_size, radius) = (texel_size(shadow), shadow.blur_radius() as i64);
    let gaussian =
        |step: i64| if step == 0 { 1.0 } else { (-0.5 * (step as f64 / f64::from(shadow.blur)).powi(2)).exp() };
    let sum: f64 = (-radius..=radius).map(gaussian).sum();
    // 1 if the center of a texel is beyond the edge at z = 1, else 0. Texel borders are at multiples of the texel size.
    let is_lit = |index: i64| f64::from(u8::from((index as f64 + 0.5) * texel_size > 1.0));
    let blurred = |index: i64| (-radius..=radius).map(|step| gaussian(step) / sum * is_lit(index + step)).sum::<f64>();
    let texel_position = z / texel_size - 0.5;
    let fraction = texel_position - texel_position.floor();
    (1.0 - fraction) * blurred(texel_position.floor() as i64) + fraction * blurred(texel_position.floor() as i64 + 1)
}

/// Tests percentage-closer filtering, and variance maps with every blur method.
#[test]
fn filtered_and_variance_maps_give_the_blurred_edge() {
    let base = variance_settings();
    let cases = [
        (BlurMethod::Auto, ShadowSettings { method: ShadowMethod::PercentageCloser, ..base }),
        (BlurMethod::Auto, ShadowSettings { method: ShadowMethod::PercentageCloser, blur: 0.7, ..base }),
        (BlurMethod::Rows, base),
        (BlurMethod::Tiles, base),
        (BlurMethod::Auto, ShadowSettings { pcf_fallback: true, ..base }),
        (BlurMethod::Tiles, ShadowSettings { blur: 0.0, ..base }),
        (BlurMethod::Tiles, ShadowSettings { blur: 4.0, ..base }),
        (BlurMethod::Fragments, base),
    ];
    for (method, shadow) in cases {
        let visibility = visibility_profile(&render_edge_with_blur(method, shadow), 32);
        // Largest error of the middle column, compared with an edge at z = 1 - shift.
        let max_error = |shift: f64| {
            let error =
                |row: u32| (visibility[row as usize] - expected_visibility(&shadow, ground_z(row) + shift)).abs();
            (0..64).map(error).fold(0.0, f64::max)
        };
        // One level of 255 is at most 0.019 of the sunlight, so rounding to a level causes an error of at most 0.0095.
        assert!(
            max_error(0.0) < 0.012,
            "{method:?}, {shadow:?}: expected a maximum error below 0.012, got {}",
            max_error(0.0)
        );
        let control = max_error(0.5 * texel_size(&shadow));
        assert!(control > 0.02, "negative control, edge shifted by half a texel: expected an error, got {control}");
    }
}

#[test]
fn all_blur_methods_agree() {
    // `BlurMethod::Tiles` processes blurs of up to 8 texels in strips, which are taller in larger maps, and wider blurs
    // in tiles.
    for (blur, size) in [(0.0, 200), (1.5, 200), (4.0, 200), (8.0, 200), (9.0, 200), (16.0, 200), (2.3, 1100)] {
        let [tiles, rows, fragments] = [BlurMethod::Tiles, BlurMethod::Rows, BlurMethod::Fragments].map(|method| {
            render_edge_with_blur(method, ShadowSettings { size, blur, ..variance_settings() }).image.rgba
        });
        let max_difference = |other: &[u8]| tiles.iter().zip(other).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0);
        assert!(
            max_difference(&rows) <= 1 && max_difference(&fragments) <= 1,
            "blur {blur}: rows differ from tiles by {} levels, fragments by {}",
            max_difference(&rows),
            max_difference(&fragments)
        );
        // The other blur is one texel wider. For 16, the largest blur, it is one texel narrower.
        let other_blur =
            render_edge(ShadowSettings { size, blur: (blur + 1.0).min(15.0), ..variance_settings() }).image.rgba;
        assert!(max_difference(&other_blur) > 1, "negative control: expected a different image with another blur");
    }
}

/// z where half of the sunlight reaches the ground, interpolated linearly between two rows.
fn edge_z(visibility_profile: &[f64]) -> f64 {
    let row = visibility_profile
        .iter()
        .position(|sun_visibility| *sun_visibility > 0.5)
        .expect("expected a lit side of the edge");
    let (dark_value, light_value) = (visibility_profile[row - 1], visibility_profile[row]);
    ground_z(row as u32) - (light_value - 0.5) / (light_value - dark_value) / PIXELS_PER_UNIT
}

#[test]
fn shadow_edges_are_at_their_expected_distance() {
    let base = variance_settings();
    // Expected distances of the edge from z = 1, in texels. Without bleeding reduction, the Chebyshev bound equals the
    // blurred fraction of lit texels, because the depths are those of the square and of the ground. Bleeding reduction
    // by 0.2 maps the bound 0.6 to half of the sunlight. The normal distribution reaches 0.6 at 0.2533 standard
    // deviations, and the standard deviation of the blur is 2 texels.
    let cases = [
        (ShadowSettings { method: ShadowMethod::Standard, ..base }, 0.0),
        (ShadowSettings { method: ShadowMethod::PercentageCloser, ..base }, 0.0),
        (base, 0.0),
        (ShadowSettings { bleeding: 0.2, ..base }, 0.2533 * 2.0),
        (ShadowSettings { pcf_fallback: true, ..base }, 0.0),
        (ShadowSettings { bleeding: 0.2, pcf_fallback: true, ..base }, 0.2533 * 2.0),
        (ShadowSettings { moments: MomentFormat::F16, ..base }, 0.0),
    ];
    for size in [64, 100, 256] {
        for (shadow, expected_offset) in cases {
            let shadow = ShadowSettings { size, ..shadow };
            let offset = (edge_z(&visibility_profile(&render_edge(shadow), 32)) - 1.0) / texel_size(&shadow);
            // The tolerance is one pixel, plus half a texel because the shadow map samples the square at texel centers.
            let pixel = 1.0 / PIXELS_PER_UNIT / texel_size(&shadow);
            assert!(
                (offset - expected_offset).abs() <= 0.5 + pixel,
                "{shadow:?}: expected {expected_offset} texels, got {offset}"
            );
        }
    }
    let far_visibility = expected_visibility(&base, 1.0 + 4.0 * texel_size(&base));
    assert!(far_visibility > 0.95, "expected nearly full visibility 4 texels from the edge, got {far_visibility}");
}

#[test]
fn only_standard_maps_have_hard_edges() {
    let count_penumbra_pixels = |shadow: ShadowSettings| {
        let frame = render_edge(shadow);
        (0..64)
            .flat_map(|column| visibility_profile(&frame, column))
            .filter(|sun_visibility| (0.05..0.95).contains(sun_visibility))
            .count()
    };
    assert_eq!(count_penumbra_pixels(ShadowSettings { method: ShadowMethod::Standard, ..variance_settings() }), 0);
    for method in [ShadowMethod::PercentageCloser, ShadowMethod::Variance] {
        assert!(
            count_penumbra_pixels(ShadowSettings { method, ..variance_settings() }) > 500,
            "negative control: expected a soft edge with {method:?}"
        );
    }
}

/// Number of pixels that are not fully lit, on a square with a side of six units at height 2. The square casts a shadow
/// and receives shadows. `casters` are added to the scene.
fn count_self_shadowed(casters: &[Mesh], shadow: ShadowSettings, sun: [f32; 3]) -> usize {
    let mut builder = create_builder();
    (builder.parts.look.shadow, builder.parts.look.sun) = (Some(shadow), sun);
    let builder = casters.iter().fold(builder, |builder, mesh| builder.add_domain(mesh.clone(), Material::default()));
    let scene = builder.add_domain(floor_mesh(3.0, 2.0), Material::default()).build();
    let view = View::LookAt { eye: [0.0, 20.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, -1.0] };
    let lens = Lens::Intrinsics { fx: 200.0, fy: 200.0, cx: 32.0, cy: 32.0 };
    let frame = render_square(&mut open_renderer(), &scene, Camera { view, lens, near: 0.0, far: 0.0 }, 64);
    let cosine = nalgebra::Vector3::from(sun).cast::<f64>().normalize().y;
    let inner_pixels = (8..56).flat_map(|y| (8..56).map(move |x| (x, y)));
    inner_pixels.filter(|(x, y)| !is_close(frame.pixel(*x, *y), [0.25 + 0.5 * cosine; 3], 2.0)).count()
}

#[test]
fn no_method_shadows_a_lit_surface() {
    let base = ShadowSettings { size: 512, ..ShadowSettings::default() };
    for sun in [[0.0, 1.0, 0.0], [3.0, 4.0, 0.0], [1.0, 0.4, 0.6], [1.0, 0.15, 0.3]] {
        let cases = [
            base,
            ShadowSettings { method: ShadowMethod::Standard, ..base },
            ShadowSettings { method: ShadowMethod::PercentageCloser, ..base },
            ShadowSettings { method: ShadowMethod::PercentageCloser, blur: 4.0, ..base },
            ShadowSettings { cascades: 4, ..base },
        ];
        for shadow in cases {
            assert_eq!(count_self_shadowed(&[], shadow, sun), 0, "{sun:?} {shadow:?}");
        }
    }
    let shadowed_pixels = count_self_shadowed(&[floor_mesh(0.5, 3.0)], base, [1.0, 0.4, 0.6]);
    assert!(
        shadowed_pixels > 20,
        "negative control: expected the shadow of a caster, got {shadowed_pixels} dark pixels"
    );
}

/// Number of lit pixels in a strip of ground that is fully in the shadow of a square just above it.
fn count_lit_in_umbra(moments: MomentFormat, pcf_fallback: bool) -> usize {
    let mut builder = create_builder();
    builder.parts.look.shadow =
        Some(ShadowSettings { size: 2048, blur: 0.5, moments, pcf_fallback, ..ShadowSettings::default() });
    builder.parts.look.sun = [3.0, 1.0, 0.0];
    // The depth of the square is far from the center of the depth range, so that f16 is coarse there. With the sun at
    // (3, 1, 0) and the square at height 0.03, the shadow extends 0.09 units beyond the edge of the square at x = -3.5.
    // The camera shows the middle of these 0.09 units: 64 pixels of 0.001 units around x = -3.545.
    let mut positions = floor_mesh(1.0, 0.03).rest_positions().to_vec();
    positions.iter_mut().for_each(|vertex| vertex[0] -= 2.5);
    let mesh = Mesh::from_indexed(positions, vec![[0.0, 1.0, 0.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]])
        .expect("expected a valid mesh");
    let scene = builder.add_domain(mesh, Material { double_sided: true, ..Material::default() }).build();
    let view = View::LookAt { eye: [-3.545, 20.0, 0.0], target: [-3.545, 0.0, 0.0], up: [0.0, 0.0, -1.0] };
    let lens = Lens::Intrinsics { fx: 2e4, fy: 2e4, cx: 32.0, cy: 32.0 };
    let frame = render_square(&mut open_renderer(), &scene, Camera { view, lens, near: 0.0, far: 0.0 }, 64);
    let umbra_color = [0.8 * 0.25; 3];
    (0..64 * 64).filter(|pixel| !is_close(frame.pixel(pixel % 64, pixel / 64), umbra_color, 3.0)).count()
}

/// Moments in f32 leak no light, and neither do moments in f16 with filtered depths.
#[test]
fn f16_moments_alone_leak_light_near_the_caster() {
    assert_eq!(count_lit_in_umbra(MomentFormat::F32, false), 0);
    assert_eq!(count_lit_in_umbra(MomentFormat::F32, true), 0);
    assert_eq!(count_lit_in_umbra(MomentFormat::F16, true), 0);
    let lit_pixels = count_lit_in_umbra(MomentFormat::F16, false);
    assert!(lit_pixels > 400, "expected more than 400 lit pixels of 4096, got {lit_pixels}");
}

/// Number of half-lit pixels in the middle column of a close-up of the edge, with `cascades` cascades.
fn count_half_lit(cascades: u32) -> usize {
    let view = View::LookAt { eye: [0.0, 2.0, 4.0], target: [0.0, 0.0, 1.0], up: [0.0, 1.0, 0.0] };
    let lens = Lens::Intrinsics { fx: 400.0, fy: 400.0, cx: 64.0, cy: 64.0 };
    let scene = square_scene(ShadowSettings { size: 64, cascades, ..variance_settings() });
    let frame = render_square(&mut open_renderer(), &scene, Camera { view, lens, near: 0.0, far: 0.0 }, 128);
    let column: Vec<f64> = (0..128).map(|row| sun_visibility(frame.pixel(64, row))).collect();
    assert!(
        column[0] < 0.1 && column[127] > 0.9,
        "{cascades} cascades: expected a dark first row and a lit last row, got {column:?}"
    );
    column.iter().filter(|sun_visibility| (0.1..0.9).contains(*sun_visibility)).count()
}

#[test]
fn cascades_give_near_shadows_finer_texels() {
    let (pixels_of_one_map, pixels_of_four_maps) = (count_half_lit(1), count_half_lit(4));
    assert!(
        pixels_of_one_map > 30 && pixels_of_four_maps > 0 && 3 * pixels_of_four_maps <= pixels_of_one_map,
        "{pixels_of_one_map} half-lit pixels with one map, {pixels_of_four_maps} with four"
    );
}

/// Passes and allocations of a scene that depend on its shadow method.
#[derive(Debug, PartialEq)]
struct ShadowResources {
    has_blur_pass: bool,
    textures: Vec<String>,
    has_cascades: bool,
}

#[test]
fn unused_shadow_resources_are_not_allocated() {
    let resources_of = |shadow: ShadowSettings| {
        let scene = square_scene(shadow);
        let (frame, plan) = (render_edge(shadow), plan(&scene));
        assert_eq!(frame.stats.passes, plan.passes, "expected the planned passes");
        let names = plan.textures.iter().map(|allocation| allocation.name.clone());
        ShadowResources {
            has_blur_pass: frame.stats.passes.contains(&Pass::Blur),
            textures: names.filter(|name| name.starts_with("shadow")).collect(),
            has_cascades: frame.allocations.iter().any(|allocation| allocation.name == "shadow cascades"),
        }
    };
    let base = ShadowSettings { size: 64, ..ShadowSettings::default() };
    for method in [ShadowMethod::Standard, ShadowMethod::PercentageCloser] {
        let expected =
            ShadowResources { has_blur_pass: false, textures: vec!["shadow depth".into()], has_cascades: false };
        assert_eq!(resources_of(ShadowSettings { method, ..base }), expected);
    }
    for (cascades, has_cascades) in [(1, false), (2, true)] {
        let textures = vec!["shadow depth".into(), "shadow moments".into()];
        let expected = ShadowResources { has_blur_pass: true, textures, has_cascades };
        assert_eq!(resources_of(ShadowSettings { cascades, ..base }), expected);
    }
}
