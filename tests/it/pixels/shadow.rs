//! The variance shadow map, as it appears on the ground.

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Camera, Ground, Lens, ShadowSettings, UpAxis, View};

use super::harness::{
    RenderedFrame, SceneBuilder, facing_rectangle, floor_mesh, is_close, open_renderer, render_square,
};

/// A stage for a camera at height 20 that looks down, with ten pixels per unit on the ground. The sun is straight above
/// unless a test moves it.
pub(super) fn create_builder() -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.sun = [0.0, 1.0, 0.0];
    builder.parts.look.ground = Some(Ground { color: [0.8; 3] });
    builder.parts.look.shadow = Some(ShadowSettings { size: 512, bleeding: 0.0, ..ShadowSettings::default() });
    // Two pegs outside of the picture keep the ground at height 0 and widen the bounds.
    builder
        .add_domain(facing_rectangle(5.0, 0.0, 5.1, 0.1, 5.0), Material::default())
        .add_domain(facing_rectangle(-5.1, 0.0, -5.0, 0.1, -5.0), Material::default())
}

fn from_above(builder: SceneBuilder) -> RenderedFrame {
    let camera = Camera {
        view: View::LookAt { eye: [0.0, 20.0, 0.0], target: [0.0; 3], up: [0.0, 0.0, -1.0] },
        lens: Lens::Intrinsics { fx: 200.0, fy: 200.0, cx: 32.0, cy: 32.0 },
        near: 0.0,
        far: 0.0,
    };
    render_square(&mut open_renderer(), &builder.build(), camera, 64)
}

/// A picture from above of a floating square of two units and its shadow. The sun comes from the side, so the square
/// does not hide its shadow.
fn aside(builder: SceneBuilder, alpha_mode: AlphaMode, alpha: f32) -> RenderedFrame {
    from_above(with_square(builder, alpha_mode, alpha))
}

/// Adds the square, whose shadow on the ground covers x and z of -1 to 1.
pub(super) fn with_square(mut builder: SceneBuilder, alpha_mode: AlphaMode, alpha: f32) -> SceneBuilder {
    builder.parts.look.sun = [3.0, 4.0, 0.0];
    let hole = |x: u32, y: u32| (16..48).contains(&x) && (16..48).contains(&y);
    let image = builder.add_texture(64, 64, |x, y| [255, 255, 255, if hole(x, y) { 0 } else { 255 }]);
    let material =
        Material { alpha_mode, alpha, color_texture: Some(image), double_sided: true, ..Material::default() };
    let mut square = floor_mesh(1.0, 4.0).rest().to_vec();
    square.iter_mut().for_each(|vertex| vertex[0] += 3.0);
    let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    let mesh =
        modalcast_model::domain::Mesh::from_indexed(square, vec![[0.0, 1.0, 0.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]]);
    builder.add_domain(mesh.expect("expected a valid mesh"), material)
}

/// Linear color of the ground near the center, where the haze is negligible; the horizon is black here.
fn ground(sun: f64, facing: f64) -> [f64; 3] {
    [0.8 * (0.25 + 0.5 * sun * facing); 3]
}

/// Controls: without the caster, or without a shadow map, the ground is lit.
#[test]
fn shadow_of_a_floating_square_has_only_ambient_light() {
    let shaded = aside(create_builder(), AlphaMode::Opaque, 1.0);
    assert!(is_close(shaded.pixel(32, 32), ground(0.0, 0.8), 2.0), "umbra: {:?}", shaded.pixel(32, 32));
    assert!(is_close(shaded.pixel(32, 12), ground(1.0, 0.8), 2.0), "beside it: {:?}", shaded.pixel(32, 12));
    assert!(is_close(shaded.pixel(12, 32), ground(1.0, 0.8), 2.0), "beside it: {:?}", shaded.pixel(12, 32));
    let dark = shaded.count_pixels(|[r, ..]| f64::from(r) < 150.0);
    assert!((330..=470).contains(&dark), "a shadow of 20 x 20 pixels has {dark}");

    let mut off = create_builder();
    off.parts.look.shadow = None;
    let unshaded = aside(off, AlphaMode::Opaque, 1.0);
    assert!(is_close(unshaded.pixel(32, 32), ground(1.0, 0.8), 2.0), "control: shadows off");
    assert!(!unshaded.stats.passes.contains(&"shadow") && shaded.stats.passes.contains(&"shadow"));
    let mut empty = create_builder();
    empty.parts.look.sun = [3.0, 4.0, 0.0];
    assert!(is_close(from_above(empty).pixel(32, 32), ground(1.0, 0.8), 2.0), "control: no caster");
}

#[test]
fn shadow_removes_everything_but_ambient_light() {
    let floor = Material { ambient: [0.9, 0.5, 0.2], specular: [0.5; 3], shininess: 1.0, ..Material::default() };
    let shaded = aside(create_builder().add_domain(floor_mesh(3.0, 0.0), floor), AlphaMode::Opaque, 1.0);
    assert!(is_close(shaded.pixel(32, 32), [0.25 * 0.9, 0.25 * 0.5, 0.25 * 0.2], 1.0), "{:?}", shaded.pixel(32, 32));
    let [r, g, b] = shaded.pixel(32, 8);
    assert!(r > 190 && g > 190 && b > 190, "control: lit beside the shadow, {:?}", [r, g, b]);
}

/// The printed ambient term equals this one only in sunlight that has the color of the sky; in the shadow the printed
/// term is black.
#[test]
fn ambient_term_is_lit_by_the_sky_and_not_as_printed() {
    // Without a highlight, equation 3.12 as printed is s_f I_l (C_a + (n . v_l) C_d): the sun also lights C_a, and the
    // shadow removes that light. In this renderer the sky lights C_a, and the shadow does not remove it.
    let (ambient, diffuse, facing) = ([0.4, 0.2, 0.1], [0.3_f32, 0.5, 0.7], 0.8);
    let color = |ambient_light: f64, sunlight: f64| {
        std::array::from_fn(|channel| {
            let [a, d] = [ambient, diffuse].map(|color| f64::from(color[channel]));
            ambient_light * a + sunlight * facing * d
        })
    };
    for skylight in [0.5, 0.2] {
        let mut builder = create_builder();
        (builder.parts.look.skylight, builder.parts.look.sunlight) = ([skylight as f32; 3], [0.5; 3]);
        let floor = Material { ambient, diffuse, specular: [0.0; 3], ..Material::default() };
        let shown = aside(builder.add_domain(floor_mesh(3.0, 0.0), floor), AlphaMode::Opaque, 1.0);
        for (share, pixel) in [(1.0, shown.pixel(32, 8)), (0.0, shown.pixel(32, 32))] {
            let (printed, ours) = (color(share * 0.5, share * 0.5), color(skylight, share * 0.5));
            assert!(is_close(pixel, ours, 1.0), "sky {skylight}, sun {share}: {pixel:?}, expected {ours:?}");
            let same = skylight == 0.5 && share == 1.0;
            assert_eq!(
                is_close(pixel, printed, 1.0),
                same,
                "sky {skylight}, sun {share}: {pixel:?}, printed {printed:?}"
            );
        }
    }
}

#[test]
fn shadow_of_a_cut_out_has_its_hole() {
    let cut = aside(create_builder(), AlphaMode::Mask { cutoff: 0.5 }, 1.0);
    assert!(is_close(cut.pixel(32, 32), ground(1.0, 0.8), 4.0), "the hole: {:?}", cut.pixel(32, 32));
    assert!(is_close(cut.pixel(24, 32), ground(0.0, 0.8), 4.0), "the rim: {:?}", cut.pixel(24, 32));
    let solid = aside(create_builder(), AlphaMode::Opaque, 1.0);
    assert!(is_close(solid.pixel(32, 32), ground(0.0, 0.8), 4.0), "control: opaque fills it");
}

#[test]
fn blended_surface_casts_above_the_alpha_threshold() {
    let dense = aside(create_builder(), AlphaMode::Blend, 0.6);
    assert!(
        is_close(dense.pixel(24, 32), ground(0.0, 0.8), 4.0) && is_close(dense.pixel(32, 32), ground(1.0, 0.8), 4.0)
    );
    let thin = aside(create_builder(), AlphaMode::Blend, 0.4);
    assert!(is_close(thin.pixel(24, 32), ground(1.0, 0.8), 4.0), "{:?}", thin.pixel(24, 32));
}

/// Light bleeding reduction is applied to the bound.
#[test]
fn unblurred_texel_gives_the_chebyshev_bound() {
    // A square at height 4 that covers the whole map. The near and far planes of the light lie 1 % of the diagonal of
    // 14.97 beyond square and ground, rounded outwards to multiples of 1/8.
    let shown = |least_variance: f32, bleeding: f32| {
        let mut builder = create_builder();
        builder.parts.look.shadow =
            Some(ShadowSettings { size: 64, blur: 0.0, least_variance, bleeding, ..ShadowSettings::default() });
        let cover = Material { alpha_mode: AlphaMode::Blend, alpha: 0.0, ..Material::default() };
        builder.parts.look.shadow =
            builder.parts.look.shadow.map(|shadow| ShadowSettings { alpha_threshold: 0.0, ..shadow });
        from_above(builder.add_domain(floor_mesh(5.1, 4.0), cover)).pixel(32, 32)
    };
    let behind = 4.0 / (4.25 + 0.25);
    for (least_variance, bleeding) in [(0.5_f32, 0.0_f32), (0.1, 0.0), (0.5, 0.2), (0.02, 0.3)] {
        let variance = f64::from(least_variance);
        let bound = variance / (variance + behind * behind);
        let bleeding_share = f64::from(bleeding);
        let share = ((bound - bleeding_share) / (1.0 - bleeding_share)).max(0.0);
        let seen = shown(least_variance, bleeding);
        assert!(is_close(seen, ground(share, 1.0), 2.0), "{least_variance} {bleeding}: {seen:?}, share {share}");
        assert!(!is_close(seen, ground(share + 0.05, 1.0), 2.0), "control: the judge sees five parts in a hundred");
    }
}

#[test]
fn blur_widens_the_edge_of_a_shadow() {
    let penumbra = |blur: f32| {
        let mut builder = create_builder();
        builder.parts.look.shadow =
            Some(ShadowSettings { size: 256, blur, bleeding: 0.0, ..ShadowSettings::default() });
        let shown = aside(builder, AlphaMode::Opaque, 1.0);
        let row: Vec<f64> = (8..56).map(|y| f64::from(shown.pixel(32, y)[0])).collect();
        let (dark, light) = (row[24], row[0]);
        let between = row.iter().filter(|byte| **byte > dark + 4.0 && **byte < light - 4.0).count();
        assert!(row[..20].windows(2).all(|pair| pair[0] >= pair[1] - 1.0), "falls towards the middle: {row:?}");
        between
    };
    let (hard, soft) = (penumbra(0.0), penumbra(4.0));
    assert!(soft >= hard + 6, "blur widens the edge: {hard} and {soft} pixels");
}

#[test]
fn lit_surface_does_not_shadow_itself() {
    for sun in [[0.0, 1.0, 0.0], [3.0, 4.0, 0.0], [1.0, 0.4, 0.6]] {
        let mut builder = create_builder();
        builder.parts.look.sun = sun;
        let shown = from_above(builder.add_domain(floor_mesh(1.5, 2.0), Material::default()));
        let lit = nalgebra::Vector3::from(sun).cast::<f64>().normalize().y;
        for (x, y) in [(32, 32), (22, 24), (40, 42)] {
            let seen = shown.pixel(x, y);
            assert!(is_close(seen, [0.25 + 0.5 * lit; 3], 2.0), "{sun:?} ({x}, {y}): {seen:?}");
        }
    }
}

#[test]
fn floor_in_the_plane_of_the_ground_covers_it() {
    for height in [0.0, 1e-7] {
        let shown = from_above(
            create_builder().add_domain(floor_mesh(1.5, height), Material { ambient: [1.0, 0.0, 0.0], ..paint() }),
        );
        let floor = shown.count_pixels(|[r, g, b]| r > 100 && g < 10 && b < 10);
        assert_eq!(floor, 900, "at {height}");
    }
}

/// A material lit by ambient light alone.
fn paint() -> Material {
    Material { diffuse: [0.0; 3], ..Material::default() }
}

#[test]
fn every_up_axis_gives_the_same_picture() {
    let shown = |up: UpAxis| {
        let turn = up.rotation_from_y_up();
        let mut builder = SceneBuilder::new();
        builder.parts.up = up;
        builder.parts.look = modalcast_model::scene::RenderSettings::default();
        let mesh = floor_mesh(1.0, 1.0);
        let rotate = |vector: &[f32; 3]| (turn * nalgebra::Vector3::from(*vector).cast::<f64>()).cast::<f32>().into();
        let rest: Vec<[f32; 3]> = mesh.rest().iter().chain(floor_mesh(0.4, 0.0).rest()).map(rotate).collect();
        let normals = vec![rotate(&[0.0, 1.0, 0.0]); 8];
        let triangles = vec![[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]];
        let mesh = modalcast_model::domain::Mesh::from_indexed(rest, normals, vec![], triangles).expect("two squares");
        let scene = builder.add_domain(mesh, Material { double_sided: true, ..Material::default() }).build();
        render_square(&mut open_renderer(), &scene, Camera::fit_to_scene(&scene, 64, 64), 64)
    };
    let upright = shown(UpAxis::Y);
    for up in [UpAxis::X, UpAxis::Z] {
        let other = shown(up);
        let differ = upright.image.rgba.iter().zip(&other.image.rgba).filter(|(a, b)| a.abs_diff(**b) > 4).count();
        assert!(differ < 60, "{up:?}: {differ} bytes differ");
    }
    let flat = upright.pixel(32, 60);
    assert!(upright.count_pixels(|pixel| pixel == flat) < 4000, "there is something to see");
}
