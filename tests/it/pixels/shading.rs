//! Coverage, Phong shading, normal maps, cut-outs, blending, the sky, and image orientation.

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Camera, Lens, RenderSettings, Transparency, View};
use nalgebra::Vector3;

use super::harness::{
    SceneBuilder, decode_srgb, facing_rectangle, front_camera, is_close, open_renderer, render, render_square,
};

/// A material without highlight. A surface that faces the sun has 0.25 (skylight) + 0.5 (sunlight) = 0.75 of its color.
fn matte_material(diffuse: [f32; 3]) -> Material {
    Material { diffuse, ambient: diffuse, ..Material::default() }
}

/// The sRGB level of linear 0.5 is 187.5.
#[test]
fn is_close_rejects_other_colors_and_nan() {
    assert!(is_close([188, 188, 188], [0.5; 3], 1.0));
    assert!(!is_close([186, 188, 188], [0.5; 3], 1.0));
    assert!(!is_close([0, 0, 0], [f64::NAN; 3], 1.0));
}

#[test]
fn square_covers_exactly_its_pixels() {
    let frame = render(
        &SceneBuilder::new().add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), matte_material([1.0; 3])).build(),
    );
    assert_eq!(frame.count_pixels(|pixel| pixel != [0; 3]), 400);
    assert_eq!((frame.pixel(21, 32), frame.pixel(42, 32)), ([0; 3], [0; 3]));
    for corner in [(22, 22), (41, 22), (22, 41), (41, 41)] {
        assert!(is_close(frame.pixel(corner.0, corner.1), [0.75; 3], 1.0), "{corner:?}");
    }
    assert_eq!(frame.image.rgba.len(), 4 * 64 * 64);
}

#[test]
fn first_row_is_the_top_and_first_column_the_left() {
    let red = facing_rectangle(-3.2, 2.2, -2.2, 3.2, 0.0);
    let green = facing_rectangle(2.2, -3.2, 3.2, -2.2, 0.0);
    let frame = render(
        &SceneBuilder::new()
            .add_domain(red, matte_material([1.0, 0.0, 0.0]))
            .add_domain(green, matte_material([0.0, 1.0, 0.0]))
            .build(),
    );
    assert!(is_close(frame.pixel(2, 2), [0.75, 0.0, 0.0], 1.0));
    assert!(is_close(frame.pixel(61, 61), [0.0, 0.75, 0.0], 1.0));
    assert_eq!((frame.pixel(61, 2), frame.pixel(2, 61)), ([0; 3], [0; 3]));
}

#[test]
fn first_texture_row_is_the_top_of_the_surface() {
    let mut builder = SceneBuilder::new();
    let image = builder.add_texture(2, 2, |x, y| [255 * x as u8, 255 * y as u8, 0, 255]);
    let material = Material { color_texture: Some(image), ..Material::default() };
    let frame = render(&builder.add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), material).build());
    // These four pixels show the centers of the four texels. In a texel, red and green are each 0 or 255. Light changes
    // level 255 to 225.
    for (x, y, has_red, has_green) in
        [(17, 17, false, false), (46, 17, true, false), (17, 46, false, true), (46, 46, true, true)]
    {
        let [r, g, b] = frame.pixel(x, y);
        assert!(b == 0, "{x} {y}");
        assert!((r > 150) == has_red && (g > 150) == has_green, "{x} {y}");
    }
}

/// Equation 3.12 of the thesis in f64, with clamped dot products and unshadowed ambient light, for a surface that faces
/// +Z.
fn expected_phong(look: &RenderSettings, material: &Material, point: Vector3<f64>, eye: Vector3<f64>) -> [f64; 3] {
    let sun = Vector3::from(look.sun).cast::<f64>().normalize();
    let normal = Vector3::z();
    let to_eye = (eye - point).normalize();
    let reflected = 2.0 * to_eye.dot(&normal) * normal - to_eye;
    let cosine = normal.dot(&sun).max(0.0);
    let specular_factor =
        if cosine > 0.0 { reflected.dot(&sun).max(0.0).powf(f64::from(material.shininess)) } else { 0.0 };
    std::array::from_fn(|channel| {
        let component = |color: [f32; 3]| f64::from(color[channel]);
        component(look.skylight) * component(material.ambient)
            + component(look.sunlight)
                * (cosine * component(material.diffuse) + specular_factor * component(material.specular))
    })
}

#[test]
fn phong_shading_equals_its_formula_in_f64() {
    let material = Material {
        ambient: [0.9, 0.2, 0.1],
        diffuse: [0.1, 0.5, 0.3],
        specular: [0.3, 0.2, 0.6],
        shininess: 12.0,
        ..Material::default()
    };
    for (sun, has_highlight) in [([0.3, -0.5, 0.8], true), ([-0.4, 0.1, 0.9], true), ([0.3, 0.5, -0.8], false)] {
        let mut builder = SceneBuilder::new();
        builder.parts.look.sun = sun;
        builder.parts.look.sunlight = [0.6, 0.7, 0.8];
        let look = builder.parts.look;
        let frame = render(&builder.add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), material.clone()).build());
        let mut highlights = 0;
        for (x, y) in [(32, 32), (12, 20), (50, 45), (20, 50)] {
            let point = Vector3::new((f64::from(x) + 0.5 - 32.0) / 10.0, (32.0 - f64::from(y) - 0.5) / 10.0, 0.0);
            let expected = expected_phong(&look, &material, point, Vector3::new(0.0, 0.0, 10.0));
            assert!(is_close(frame.pixel(x, y), expected, 1.0), "{sun:?} ({x}, {y}): {:?}", frame.pixel(x, y));
            // The pixel has a highlight if its color differs from that of a matte material.
            let matte = Material { specular: [0.0; 3], ..material.clone() };
            let matte_color = expected_phong(&look, &matte, point, Vector3::new(0.0, 0.0, 10.0));
            highlights += usize::from(!is_close(frame.pixel(x, y), matte_color, 1.0));
        }
        assert_eq!(highlights > 0, has_highlight, "{sun:?}: {highlights} pixels with a highlight");
    }
}

/// The formula is that of `shaders/shared/sky.glsl`.
#[test]
fn sky_gradient_equals_its_formula() {
    let mut builder = SceneBuilder::new();
    builder.parts.look.zenith = [0.1, 0.3, 0.8];
    builder.parts.look.horizon = [0.7, 0.8, 0.9];
    let frame =
        render(&builder.add_domain(facing_rectangle(-0.1, -0.1, 0.1, 0.1, 0.0), matte_material([0.0; 3])).build());
    for (x, y) in [(5, 3), (60, 20), (32, 60)] {
        let direction = Vector3::new((f64::from(x) - 31.5) / 100.0, (31.5 - f64::from(y)) / 100.0, -1.0).normalize();
        let sine = direction.y.max(0.0);
        let weight = 1.0 - (-6.0 * sine * sine / (sine + 0.06)).exp();
        let mix = |low: f64, high: f64| low + weight * (high - low);
        assert!(
            is_close(frame.pixel(x, y), [mix(0.7, 0.1), mix(0.8, 0.3), mix(0.9, 0.8)], 1.0),
            "{:?}",
            frame.pixel(x, y)
        );
    }
    assert!(frame.pixel(32, 3) != frame.pixel(32, 60), "expected a gradient");
}

#[test]
fn normal_map_changes_shading_and_a_flat_one_does_not() {
    let render_with = |pixel: Option<[u8; 4]>| {
        let mut builder = SceneBuilder::new();
        builder.parts.look.sun = [0.6, 0.0, 0.8];
        let image = pixel.map(|pixel| builder.add_texture(4, 4, |_, _| pixel));
        let material = Material { normal_texture: image, ..matte_material([1.0; 3]) };
        render(&builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), material).build())
    };
    // Color for a cosine between the normal and the direction to the sun, (0.6, 0, 0.8).
    let expected = |cosine: f64| [0.25 + 0.5 * cosine; 3];
    assert!(is_close(render_with(None).pixel(32, 32), expected(0.8), 1.0));
    assert!(
        is_close(render_with(Some([128, 128, 255, 255])).pixel(32, 32), expected(0.8), 1.0),
        "expected no effect of a flat normal map"
    );
    // Tangent space: x along u, y against v, z along the normal. A component n is encoded as 128 + 127 n, so 204 is
    // 0.6, 52 is -0.6, and 230 is 0.8. The cosine is 0.36 + 0.64 = 1 for a normal (0.6, 0, 0.8), -0.36 + 0.64 = 0.28
    // for (-0.6, 0, 0.8), and 0.64 for (0, 0.6, 0.8).
    assert!(
        is_close(render_with(Some([204, 128, 230, 255])).pixel(32, 32), expected(1.0), 1.0),
        "expected a brighter surface with the normal tilted towards the sun"
    );
    assert!(
        is_close(render_with(Some([52, 128, 230, 255])).pixel(32, 32), expected(0.28), 2.0),
        "expected a darker surface with the normal tilted away from the sun"
    );
    let tilted_up = render_with(Some([128, 204, 230, 255]));
    assert!(
        is_close(tilted_up.pixel(32, 32), expected(0.64), 2.0),
        "expected a darker surface with the normal tilted up"
    );
}

#[test]
fn plus_y_of_a_normal_map_points_up_the_image() {
    let render_with = |green: u8| {
        let mut builder = SceneBuilder::new();
        builder.parts.look.sun = [0.0, 0.6, 0.8];
        let image = builder.add_texture(1, 1, |_, _| [128, green, 230, 255]);
        let material = Material { normal_texture: Some(image), ..matte_material([1.0; 3]) };
        render(&builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), material).build()).pixel(32, 32)
    };
    // Green 204 encodes the normal (0, 0.6, 0.8), towards the sun. Green 52 encodes (0, -0.6, 0.8), whose cosine with
    // the sun is -0.36 + 0.64 = 0.28.
    assert!(is_close(render_with(204), [0.75; 3], 1.0) && is_close(render_with(52), [0.25 + 0.5 * 0.28; 3], 2.0));
}

/// A red leaf in front of a black background, with a hole of half its side length in the center.
fn render_leaf(alpha_mode: AlphaMode) -> super::harness::RenderedFrame {
    let mut builder = SceneBuilder::new();
    let is_in_hole = |x: u32, y: u32| (16..48).contains(&x) && (16..48).contains(&y);
    let image = builder.add_texture(64, 64, |x, y| [255, 0, 0, if is_in_hole(x, y) { 0 } else { 255 }]);
    let material = Material { color_texture: Some(image), alpha_mode, ..Material::default() };
    render(&builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), material).build())
}

#[test]
fn cut_out_shows_the_background_and_opaque_does_not() {
    let cut_out = render_leaf(AlphaMode::Mask { cutoff: 0.5 });
    assert_eq!(cut_out.pixel(32, 32), [0; 3]);
    assert!(is_close(cut_out.pixel(15, 15), [0.75, 0.0, 0.0], 1.0));
    // The leaf covers 40 x 40 = 1600 pixels.
    let hole_pixels = cut_out.count_pixels(|pixel| pixel == [0; 3]) - (64 * 64 - 1600);
    assert!((360..=440).contains(&hole_pixels), "expected a hole of about 20 x 20 pixels, got {hole_pixels}");
    let opaque = render_leaf(AlphaMode::Opaque);
    assert!(is_close(opaque.pixel(32, 32), [0.75, 0.0, 0.0], 1.0), "negative control: expected no hole");
    assert_eq!(opaque.count_pixels(|pixel| pixel == [0; 3]), 64 * 64 - 1600);
}

#[test]
fn two_blended_layers_have_the_computed_color() {
    let render_layers = |near_alpha: f32, far_alpha: f32, alpha_mode: AlphaMode| {
        let layer = |diffuse, alpha| Material { alpha, alpha_mode, ..matte_material(diffuse) };
        let scene = SceneBuilder::new()
            .add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, -2.0), matte_material([0.2, 0.2, 1.0]))
            .add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, -1.0), layer([0.0, 1.0, 0.0], far_alpha))
            .add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), layer([1.0, 0.0, 0.0], near_alpha))
            .build();
        render(&scene)
    };
    // The blue background, then the green far layer, then the red near layer.
    let expected = |near_alpha: f64, far_alpha: f64| {
        let [r, g, b] = [0.2, 0.2, 1.0].map(|channel| channel * (1.0 - far_alpha));
        let [r, g, b] = [r, g + far_alpha, b].map(|channel| channel * (1.0 - near_alpha));
        [r + near_alpha, g, b].map(|channel| 0.75 * channel)
    };
    let frame = render_layers(0.25, 0.5, AlphaMode::Blend);
    assert!(is_close(frame.pixel(32, 32), expected(0.25, 0.5), 1.0), "{:?}", frame.pixel(32, 32));
    assert!(
        !is_close(frame.pixel(32, 32), expected(0.5, 0.25), 4.0),
        "negative control: expected other colors for other alphas"
    );
    assert!(is_close(render_layers(0.5, 0.25, AlphaMode::Blend).pixel(32, 32), expected(0.5, 0.25), 1.0));
    assert!(
        is_close(render_layers(0.25, 0.5, AlphaMode::Opaque).pixel(32, 32), [0.75, 0.0, 0.0], 1.0),
        "expected opaque materials to ignore alpha"
    );
}

#[test]
fn two_pass_blending_writes_no_depth() {
    let layer = |diffuse| Material { alpha: 0.5, alpha_mode: AlphaMode::Blend, ..matte_material(diffuse) };
    let render_with = |second_z: f32| {
        let first_pane = facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0);
        let mut builder = SceneBuilder::new();
        builder.parts.look.transparency = Transparency::TwoPass;
        let scene = builder
            .add_domain(first_pane, layer([1.0, 0.0, 0.0]))
            .add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, second_z), layer([0.0, 1.0, 0.0]))
            .build();
        render(&scene).pixel(32, 32)
    };
    // The green pane is blended over the red pane, even if it is behind: 0.5 of green, and 0.5 x 0.5 of red.
    for second_z in [-1.0, 1.0] {
        assert!(
            is_close(render_with(second_z), [0.75 * 0.25, 0.75 * 0.5, 0.0], 1.0),
            "{second_z}: {:?}",
            render_with(second_z)
        );
    }
}

/// A back face is shaded with a normal that points to the camera.
#[test]
fn only_double_sided_back_faces_are_drawn() {
    let render_from_behind = |double_sided: bool| {
        let mut builder = SceneBuilder::new();
        builder.parts.look.sun = [0.0, 0.0, -1.0];
        let scene = builder
            .add_domain(
                facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0),
                Material { double_sided, ..matte_material([1.0; 3]) },
            )
            .build();
        let view = View::LookAt { eye: [0.0, 0.0, -10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
        render_square(&mut open_renderer(), &scene, Camera { view, ..front_camera(64) }, 64).pixel(32, 32)
    };
    assert!(is_close(render_from_behind(true), [0.75; 3], 1.0));
    assert_eq!(render_from_behind(false), [0; 3]);
}

#[test]
fn textures_of_many_sizes_keep_their_materials() {
    let mut builder = SceneBuilder::new();
    let mut colors = Vec::new();
    for index in 0..9_u32 {
        let shade = 20 + 25 * index as u8;
        let image = builder.add_texture(3 + 5 * index, 40 - 4 * index, |_, _| [shade, 255 - shade, 0, 255]);
        let material = Material { color_texture: Some(image), ..Material::default() };
        let left = -2.7 + 0.6 * index as f32;
        builder = builder.add_domain(facing_rectangle(left, -1.0, left + 0.6, 1.0, 0.0), material);
        colors.push([shade, 255 - shade, 0]);
    }
    let frame = render_square(&mut open_renderer(), &builder.build(), front_camera(64), 64);

    for (index, [r, g, _]) in colors.into_iter().enumerate() {
        // Each rectangle is 6 pixels wide. The first rectangle begins at column 5.
        let pixel = frame.pixel(5 + 6 * index as u32 + 3, 32);
        let expected = [0.75 * decode_srgb(r), 0.75 * decode_srgb(g), 0.0];
        assert!(is_close(pixel, expected, 1.0), "texture {index}: {pixel:?}");
    }
}

#[test]
fn intrinsics_set_principal_point_and_scale_per_axis() {
    let scene =
        SceneBuilder::new().add_domain(facing_rectangle(0.0, 0.0, 1.0, 1.0, 0.0), matte_material([1.0; 3])).build();
    let lens = Lens::Intrinsics { fx: 200.0, fy: 100.0, cx: 10.0, cy: 50.0 };
    let frame = render_square(&mut open_renderer(), &scene, Camera { lens, ..front_camera(64) }, 64);
    // At distance 10, a unit is 20 pixels wide and 10 pixels high.
    assert_eq!(frame.count_pixels(|pixel| pixel != [0; 3]), 20 * 10);
    assert!(frame.pixel(10, 49) != [0; 3] && frame.pixel(29, 40) != [0; 3]);
    assert!(frame.pixel(9, 49) == [0; 3] && frame.pixel(10, 50) == [0; 3] && frame.pixel(30, 40) == [0; 3]);
}
