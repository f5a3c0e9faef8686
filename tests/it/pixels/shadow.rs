//! Shadows on the ground with the default method, a variance shadow map.

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Camera, Ground, Lens, ShadowSettings, UpAxis, View};

use modalcast_render::Pass;

use super::harness::{
    RenderedFrame, SceneBuilder, facing_rectangle, floor_mesh, is_close, open_renderer, render_square,
};

/// A builder with ground, a shadow map without light-bleeding reduction, and the sun straight above.
pub(super) fn create_builder() -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.sun = [0.0, 1.0, 0.0];
    builder.parts.look.ground = Some(Ground { color: Some([0.8; 3]) });
    builder.parts.look.shadow = Some(ShadowSettings { size: 512, bleeding: 0.0, ..ShadowSettings::default() });
    // Two small squares outside the image of `render_from_above`. Their lower edges set the height of the ground to 0.
    // They extend the bounds to -5.1 and 5.1 in x and to -5 and 5 in z.
    builder
        .add_domain(facing_rectangle(5.0, 0.0, 5.1, 0.1, 5.0), Material::default())
        .add_domain(facing_rectangle(-5.1, 0.0, -5.0, 0.1, -5.0), Material::default())
}

/// Renders with a camera at height 20 that looks down, with ten pixels per unit on the ground. Clip planes of 0
/// are fitted to the bounds.
fn render_from_above(builder: SceneBuilder) -> RenderedFrame {
    let camera = Camera {
        view: View::LookAt { eye: [0.0, 20.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, -1.0] },
        lens: Lens::Intrinsics { fx: 200.0, fy: 200.0, cx: 32.0, cy: 32.0 },
        near: 0.0,
        far: 0.0,
    };
    render_square(&mut open_renderer(), &builder.build(), camera, 64)
}

/// Adds the square of [`with_square`] and renders its shadow from above. The sun shines obliquely, so that the square
/// does not hide its shadow.
fn render_square_shadow(builder: SceneBuilder, alpha_mode: AlphaMode, alpha: f32) -> RenderedFrame {
    render_from_above(with_square(builder, alpha_mode, alpha))
}

/// Adds a square with a side of two units at height 4, and tilts the sun so that the shadow of the square on the ground
/// extends from -1 to 1 in x and z. The cosine between the sun and the up axis is 4/5. For materials that use alpha,
/// the center of the square is a hole of half its side.
pub(super) fn with_square(mut builder: SceneBuilder, alpha_mode: AlphaMode, alpha: f32) -> SceneBuilder {
    builder.parts.look.sun = [3.0, 4.0, 0.0];
    let is_in_hole = |x: u32, y: u32| (16..48).contains(&x) && (16..48).contains(&y);
    let image = builder.add_texture(64, 64, |x, y| [255, 255, 255, if is_in_hole(x, y) { 0 } else { 255 }]);
    let material =
        Material { alpha_mode, alpha, color_texture: Some(image), double_sided: true, ..Material::default() };
    let mut positions = floor_mesh(1.0, 4.0).rest_positions().to_vec();
    positions.iter_mut().for_each(|vertex| vertex[0] += 3.0);
    let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    let mesh = modalcast_model::domain::Mesh::from_indexed(
        positions,
        vec![[0.0, 1.0, 0.0]; 4],
        uvs,
        vec![[0, 1, 2], [0, 2, 3]],
    );
    builder.add_domain(mesh.expect("expected a valid mesh"), material)
}

/// Linear color of the ground near the center, where the blend into the color of the horizon is negligible. The ground
/// has the color 0.8, skylight is 0.25 and sunlight 0.5. `visibility` is the fraction of sunlight that arrives, and
/// `cosine` is the cosine of its angle of incidence.
fn ground_color(visibility: f64, cosine: f64) -> [f64; 3] {
    [0.8 * (0.25 + 0.5 * visibility * cosine); 3]
}

/// Negative control: without the caster, or without a shadow map, the ground is lit.
#[test]
fn shadow_of_a_floating_square_has_only_ambient_light() {
    let frame = render_square_shadow(create_builder(), AlphaMode::Opaque, 1.0);
    assert!(
        is_close(frame.pixel(32, 32), ground_color(0.0, 0.8), 2.0),
        "expected ambient light in the umbra, got {:?}",
        frame.pixel(32, 32)
    );
    assert!(
        is_close(frame.pixel(32, 12), ground_color(1.0, 0.8), 2.0),
        "expected sunlight beside the shadow, got {:?}",
        frame.pixel(32, 12)
    );
    assert!(
        is_close(frame.pixel(12, 32), ground_color(1.0, 0.8), 2.0),
        "expected sunlight beside the shadow, got {:?}",
        frame.pixel(12, 32)
    );
    // Level 150 is between the ground in the shadow, level 124, and the lit ground, level 191.
    let dark_pixels = frame.count_pixels(|[r, ..]| f64::from(r) < 150.0);
    assert!((330..=470).contains(&dark_pixels), "expected about 20 x 20 dark pixels, got {dark_pixels}");

    let mut builder_without_shadow = create_builder();
    builder_without_shadow.parts.look.shadow = None;
    let unshadowed_frame = render_square_shadow(builder_without_shadow, AlphaMode::Opaque, 1.0);
    assert!(
        is_close(unshadowed_frame.pixel(32, 32), ground_color(1.0, 0.8), 2.0),
        "negative control: expected sunlight without a shadow map"
    );
    assert!(!unshadowed_frame.stats.passes.contains(&Pass::Shadow) && frame.stats.passes.contains(&Pass::Shadow));
    let mut builder_without_caster = create_builder();
    builder_without_caster.parts.look.sun = [3.0, 4.0, 0.0];
    assert!(
        is_close(render_from_above(builder_without_caster).pixel(32, 32), ground_color(1.0, 0.8), 2.0),
        "negative control: expected sunlight without a caster"
    );
}

#[test]
fn shadow_removes_diffuse_and_specular_light() {
    let floor = Material { ambient: [0.9, 0.5, 0.2], specular: [0.5; 3], shininess: 1.0, ..Material::default() };
    let frame = render_square_shadow(create_builder().add_domain(floor_mesh(3.0, 0.0), floor), AlphaMode::Opaque, 1.0);
    // Only skylight, 0.25, remains.
    assert!(is_close(frame.pixel(32, 32), [0.25 * 0.9, 0.25 * 0.5, 0.25 * 0.2], 1.0), "{:?}", frame.pixel(32, 32));
    let [r, g, b] = frame.pixel(32, 8);
    assert!(
        r > 190 && g > 190 && b > 190,
        "negative control: expected sunlight beside the shadow, got {:?}",
        [r, g, b]
    );
}

/// Outside the shadow, the ambient term that the thesis prints equals that of the renderer only if sunlight and
/// skylight have the same color. In the shadow, the printed term is black.
#[test]
fn ambient_term_is_lit_by_the_sky_and_not_as_printed() {
    // Without a highlight, equation 3.12 as printed is s_f I_l (C_a + (n . v_l) C_d), with the sun visibility s_f, the
    // sunlight I_l, and the ambient and diffuse colors C_a and C_d. There, sunlight times s_f lights C_a. In this
    // renderer, skylight lights C_a, independent of s_f.
    let (ambient, diffuse, cosine) = ([0.4, 0.2, 0.1], [0.3_f32, 0.5, 0.7], 0.8);
    let color = |ambient_light: f64, sunlight: f64| {
        std::array::from_fn(|channel| {
            let [ambient, diffuse] = [ambient, diffuse].map(|color| f64::from(color[channel]));
            ambient_light * ambient + sunlight * cosine * diffuse
        })
    };
    for skylight in [0.5, 0.2] {
        let mut builder = create_builder();
        (builder.parts.look.skylight, builder.parts.look.sunlight) = ([skylight as f32; 3], [0.5; 3]);
        let floor = Material { ambient, diffuse, specular: [0.0; 3], ..Material::default() };
        let frame = render_square_shadow(builder.add_domain(floor_mesh(3.0, 0.0), floor), AlphaMode::Opaque, 1.0);
        for (visibility, pixel) in [(1.0, frame.pixel(32, 8)), (0.0, frame.pixel(32, 32))] {
            let (printed_color, expected_color) =
                (color(visibility * 0.5, visibility * 0.5), color(skylight, visibility * 0.5));
            assert!(
                is_close(pixel, expected_color, 1.0),
                "sky {skylight}, sun {visibility}: {pixel:?}, expected {expected_color:?}"
            );
            let is_printed_color = skylight == 0.5 && visibility == 1.0;
            assert_eq!(
                is_close(pixel, printed_color, 1.0),
                is_printed_color,
                "sky {skylight}, sun {visibility}: {pixel:?}, printed {printed_color:?}"
            );
        }
    }
}

#[test]
fn shadow_of_a_cut_out_has_its_hole() {
    let cut_out_frame = render_square_shadow(create_builder(), AlphaMode::Mask { cutoff: 0.5 }, 1.0);
    assert!(
        is_close(cut_out_frame.pixel(32, 32), ground_color(1.0, 0.8), 4.0),
        "expected sunlight in the hole, got {:?}",
        cut_out_frame.pixel(32, 32)
    );
    assert!(
        is_close(cut_out_frame.pixel(24, 32), ground_color(0.0, 0.8), 4.0),
        "expected shadow around the hole, got {:?}",
        cut_out_frame.pixel(24, 32)
    );
    let opaque_frame = render_square_shadow(create_builder(), AlphaMode::Opaque, 1.0);
    assert!(
        is_close(opaque_frame.pixel(32, 32), ground_color(0.0, 0.8), 4.0),
        "negative control: expected shadow under an opaque square"
    );
}

/// The default threshold, [`ShadowSettings::alpha_threshold`], is 0.5.
#[test]
fn blended_surface_casts_above_the_alpha_threshold() {
    let frame_above_threshold = render_square_shadow(create_builder(), AlphaMode::Blend, 0.6);
    assert!(
        is_close(frame_above_threshold.pixel(24, 32), ground_color(0.0, 0.8), 4.0)
            && is_close(frame_above_threshold.pixel(32, 32), ground_color(1.0, 0.8), 4.0),
        "expected a shadow with a hole, got {:?} in the shadow and {:?} in the hole",
        frame_above_threshold.pixel(24, 32),
        frame_above_threshold.pixel(32, 32)
    );
    let frame_below_threshold = render_square_shadow(create_builder(), AlphaMode::Blend, 0.4);
    assert!(
        is_close(frame_below_threshold.pixel(24, 32), ground_color(1.0, 0.8), 4.0),
        "{:?}",
        frame_below_threshold.pixel(24, 32)
    );
}

/// Chebyshev's inequality bounds the visible fraction of a texel by variance / (variance + d^2), with d the depth of
/// the ground minus the mean depth of the texel. Light-bleeding reduction maps the bound linearly, so that `bleeding`
/// becomes 0 and 1 remains 1.
#[test]
fn unblurred_texel_gives_the_chebyshev_bound() {
    // The caster is a square at height 4 that covers the whole map. With an alpha of 0 and an alpha threshold of 0, the
    // square casts a shadow, but the camera sees the ground through it.
    let render_with = |least_variance: f32, bleeding: f32| {
        let mut builder = create_builder();
        builder.parts.look.shadow = Some(ShadowSettings {
            size: 64,
            blur: 0.0,
            least_variance,
            bleeding,
            alpha_threshold: 0.0,
            pcf_fallback: false,
            ..ShadowSettings::default()
        });
        let transparent_material = Material { alpha_mode: AlphaMode::Blend, alpha: 0.0, ..Material::default() };
        render_from_above(builder.add_domain(floor_mesh(5.1, 4.0), transparent_material)).pixel(32, 32)
    };
    // Height of the square as a fraction of the depth range. The margin above the square and below the ground is 1 % of
    // the diagonal of the bounds, 0.15. The near and the far plane are then rounded outwards to multiples of 1/8:
    // heights 4.25 and -0.25.
    let depth_difference = 4.0 / (4.25 + 0.25);
    for (least_variance, bleeding) in [(0.5_f32, 0.0_f32), (0.1, 0.0), (0.5, 0.2), (0.02, 0.3)] {
        let variance = f64::from(least_variance);
        let bound = variance / (variance + depth_difference * depth_difference);
        let bleeding_f64 = f64::from(bleeding);
        let visibility = ((bound - bleeding_f64) / (1.0 - bleeding_f64)).max(0.0);
        let pixel = render_with(least_variance, bleeding);
        assert!(
            is_close(pixel, ground_color(visibility, 1.0), 2.0),
            "least_variance {least_variance}, bleeding {bleeding}: expected a visibility of {visibility}, got {pixel:?}"
        );
        assert!(!is_close(pixel, ground_color(visibility + 0.05, 1.0), 2.0), "negative control: expected others");
    }
}

#[test]
fn blur_widens_the_edge_of_a_shadow() {
    let count_penumbra_pixels = |blur: f32| {
        let mut builder = create_builder();
        builder.parts.look.shadow =
            Some(ShadowSettings { size: 256, blur, bleeding: 0.0, ..ShadowSettings::default() });
        let frame = render_square_shadow(builder, AlphaMode::Opaque, 1.0);
        // Rows 8 to 55 of the image column through the center of the shadow, which is in row 32.
        let levels: Vec<f64> = (8..56).map(|y| f64::from(frame.pixel(32, y)[0])).collect();
        let (dark_level, light_level) = (levels[32 - 8], levels[0]);
        let penumbra_pixels =
            levels.iter().filter(|level| **level > dark_level + 4.0 && **level < light_level - 4.0).count();
        assert!(
            levels[..20].windows(2).all(|pair| pair[0] >= pair[1] - 1.0),
            "expected decreasing light towards the center of the shadow, got {levels:?}"
        );
        penumbra_pixels
    };
    let (unblurred_pixels, blurred_pixels) = (count_penumbra_pixels(0.0), count_penumbra_pixels(4.0));
    assert!(
        blurred_pixels >= unblurred_pixels + 6,
        "expected a wider penumbra with blur, got {unblurred_pixels} and {blurred_pixels} pixels"
    );
}

#[test]
fn lit_surface_does_not_shadow_itself() {
    for sun in [[0.0, 1.0, 0.0], [3.0, 4.0, 0.0], [1.0, 0.4, 0.6]] {
        let mut builder = create_builder();
        builder.parts.look.sun = sun;
        let frame = render_from_above(builder.add_domain(floor_mesh(1.5, 2.0), Material::default()));
        let cosine = nalgebra::Vector3::from(sun).cast::<f64>().normalize().y;
        for (x, y) in [(32, 32), (22, 24), (40, 42)] {
            let pixel = frame.pixel(x, y);
            assert!(is_close(pixel, [0.25 + 0.5 * cosine; 3], 2.0), "{sun:?} ({x}, {y}): {pixel:?}");
        }
    }
}

#[test]
fn floor_in_the_plane_of_the_ground_covers_it() {
    for height in [0.0, 1e-7] {
        let frame = render_from_above(
            create_builder()
                .add_domain(floor_mesh(1.5, height), Material { ambient: [1.0, 0.0, 0.0], ..unlit_material() }),
        );
        let floor_pixels = frame.count_pixels(|[r, g, b]| r > 100 && g < 10 && b < 10);
        assert_eq!(floor_pixels, 30 * 30, "floor at height {height}");
    }
}

/// A material lit by ambient light alone.
fn unlit_material() -> Material {
    Material { diffuse: [0.0; 3], ..Material::default() }
}

#[test]
fn every_up_axis_gives_the_same_picture() {
    let render_with = |up: UpAxis| {
        let rotation = up.rotation_from_y_up();
        let mut builder = SceneBuilder::new();
        builder.parts.up = up;
        builder.parts.look = modalcast_model::scene::RenderSettings::default();
        let mesh = floor_mesh(1.0, 1.0);
        let rotate =
            |vector: &[f32; 3]| (rotation * nalgebra::Vector3::from(*vector).cast::<f64>()).cast::<f32>().into();
        let positions: Vec<[f32; 3]> =
            mesh.rest_positions().iter().chain(floor_mesh(0.4, 0.0).rest_positions()).map(rotate).collect();
        let normals = vec![rotate(&[0.0, 1.0, 0.0]); 8];
        let triangles = vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]];
        let mesh = modalcast_model::domain::Mesh::from_indexed(positions, normals, vec![], triangles)
            .expect("expected a valid mesh");
        let scene = builder.add_domain(mesh, Material { double_sided: true, ..Material::default() }).build();
        render_square(&mut open_renderer(), &scene, Camera::fit_to_scene(&scene, 64, 64), 64)
    };
    let y_up_frame = render_with(UpAxis::Y);
    for up in [UpAxis::X, UpAxis::Z] {
        let rotated_frame = render_with(up);
        let different_bytes =
            y_up_frame.image.rgba.iter().zip(&rotated_frame.image.rgba).filter(|(a, b)| a.abs_diff(**b) > 4).count();
        assert!(different_bytes < 60, "{up:?}: {different_bytes} bytes differ");
    }
    let ground_pixel = y_up_frame.pixel(32, 60);
    assert!(
        y_up_frame.count_pixels(|pixel| pixel == ground_pixel) < 4000,
        "expected other colors than that of the ground in the 64 x 64 pixels"
    );
}
