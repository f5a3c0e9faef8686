//! The visibility buffer: sample coverage, texture derivatives, ids, and degenerate triangles.

use std::sync::Arc;

use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Camera, Ground, Lens, Scene, View};
use modalcast_render::{FrameParams, VisibilityId};
use nalgebra::Vector3;

use super::harness::{
    RenderedFrame, SceneBuilder, encode_srgb, facing_rectangle, front_camera, is_close, open_renderer, render,
    render_square,
};

/// A material lit by ambient light alone, so that a texel of value v appears as v.
fn painted(color_texture: Option<usize>) -> Material {
    Material { ambient: [1.0; 3], diffuse: [0.0; 3], color_texture, ..Material::default() }
}

fn create_builder() -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.skylight = [1.0; 3];
    builder
}

/// Linear light of an sRGB byte.
fn linear(byte: u8) -> f64 {
    let encoded = f64::from(byte) / 255.0;
    if encoded <= 0.040_45 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

#[test]
fn edge_covers_the_samples_on_its_side() {
    // The four samples lie at 1/8, 3/8, 5/8 and 7/8 across a pixel, in some order.
    for (edge, share) in [(0.25_f32, 0.25), (0.5, 0.5), (0.75, 0.75)] {
        let shown = |samples: u32| {
            let mut builder = create_builder();
            builder.parts.look.samples = samples;
            render(&builder.add_domain(facing_rectangle(-1.0, -1.0, 0.1 * edge, 1.0, 0.0), painted(None)).build())
        };
        let four = shown(4);
        assert_eq!(four.stats.samples, 4);
        assert!(is_close(four.pixel(32, 30), [share; 3], 1.0), "{edge}: {:?}", four.pixel(32, 30));
        let one = shown(1);
        assert_eq!(one.stats.samples, 1);
        assert!([[0; 3], [255; 3]].contains(&one.pixel(32, 30)), "{edge}: {:?}", one.pixel(32, 30));
    }
}

#[test]
fn cut_out_edge_is_resolved_per_sample() {
    // Alpha rises by 1/40 per pixel from left to right, so that each of the 40 rows crosses each cutoff once.
    let shown = |cutoff: f32, samples: u32| {
        let mut builder = create_builder();
        builder.parts.look.samples = samples;
        let image = builder.add_texture(256, 1, |x, _| [255, 255, 255, x as u8]);
        let alpha_mode = AlphaMode::Mask { cutoff };
        let cut = Material { alpha_mode, ..painted(Some(image)) };
        render(&builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), cut).build())
    };
    let sum = |shown: &RenderedFrame| (14..50).map(|x| linear(shown.pixel(x, 30)[0])).sum::<f64>();
    for quarter in 0..4 {
        // The edge lies `quarter` quarters of a pixel plus 0.01 into a pixel.
        let across = f64::from(20 + 12 - 12) + 0.25 * f64::from(quarter) + 0.01;
        let cutoff = ((across / 40.0 * 256.0 - 0.5) / 255.0) as f32;
        let (four, one) = (shown(cutoff, 4), shown(cutoff, 1));
        let covered = 50.0 - 12.0 - across;
        assert!((sum(&four) - covered).abs() < 0.3, "{quarter}: {} of {covered} pixels", sum(&four));
        let between = |shown: &RenderedFrame| shown.count_pixels(|[red, ..]| red > 4 && red < 251);
        assert!(between(&one) == 0 && between(&four) <= 2 * 40, "{quarter}: {} and {}", between(&one), between(&four));
    }
    assert!((sum(&shown(0.25, 4)) - sum(&shown(0.75, 4))).abs() > 15.0, "control: the judge sees the cutoff");
}

/// Stripes of two texels on a square of 40 x 40 pixels, with texture coordinates from 0 to `turns`.
fn stripes(size: u32, turns: f32) -> RenderedFrame {
    let mut builder = create_builder();
    let image = builder.add_texture(size, size, |x, _| if x % 4 < 2 { [255; 4] } else { [0, 0, 0, 255] });
    let rest = facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0).rest().to_vec();
    let uvs = vec![[0.0, turns], [turns, turns], [turns, 0.0], [0.0, 0.0]];
    let mesh = Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]])
        .expect("expected a valid mesh");
    render(&builder.add_domain(mesh, painted(Some(image))).build())
}

/// Pixels of the square that are not on its rim or diagonal, so that one triangle fills each pixel.
fn inner() -> impl Iterator<Item = (u32, u32)> {
    (13..51_u32).flat_map(|y| (13..51_u32).map(move |x| (x, y))).filter(|(x, y)| (x + y).abs_diff(63) > 1)
}

/// One texel per pixel reads level 0; four texels per pixel read level 2, their mean.
#[test]
fn mip_level_follows_texels_per_pixel() {
    let fine = stripes(40, 1.0);
    for (x, y) in inner() {
        let white = (x - 12) % 4 < 2;
        assert!(is_close(fine.pixel(x, y), [f64::from(u8::from(white)); 3], 3.0), "({x}, {y}): {:?}", fine.pixel(x, y));
    }
    let coarse = stripes(160, 1.0);
    assert!(
        inner().all(|(x, y)| is_close(coarse.pixel(x, y), [0.5; 3], 3.0)),
        "level 2 is even grey: {:?}",
        coarse.pixel(20, 20)
    );
    assert!(!is_close(fine.pixel(20, 20), [0.5; 3], 3.0), "control: level 0 is not");
}

#[test]
fn repeating_image_has_no_mip_seam() {
    // Two repeats of 20 texels: derivatives of wrapped coordinates would jump at the middle and blur a line there.
    let shown = stripes(20, 2.0);
    for (x, y) in inner() {
        let white = (x - 12) % 4 < 2;
        assert!(
            is_close(shown.pixel(x, y), [f64::from(u8::from(white)); 3], 3.0),
            "({x}, {y}): {:?}",
            shown.pixel(x, y)
        );
    }
}

#[test]
fn coordinates_are_perspective_correct_behind_the_camera() {
    let mut builder = create_builder();
    let image = builder.add_texture(64, 64, |x, y| [4 * x as u8, 4 * y as u8, 0, 255]);
    let half = 40.0_f32;
    let rest = vec![[-half, 0.0, half], [half, 0.0, half], [half, 0.0, -half], [-half, 0.0, -half]];
    let uvs = vec![[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]];
    let mesh = Mesh::from_indexed(rest, vec![[0.0, 1.0, 0.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]])
        .expect("expected a valid mesh");
    let eye = Vector3::new(3.0, 5.0, 4.0);
    let view = View::LookAt { eye: eye.into(), target: [3.0, 0.0, -6.0], up: [0.0, 1.0, 0.0] };
    let lens = Lens::Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 32.0 };
    let shown = render_square(
        &mut open_renderer(),
        &builder.add_domain(mesh, painted(Some(image))).build(),
        Camera { view, lens, ..front_camera(64) },
        64,
    );
    let forward = Vector3::new(0.0, -5.0, -10.0_f64).normalize();
    let (right, up) = (Vector3::x(), Vector3::x().cross(&forward));
    for (x, y) in [(10, 40), (32, 32), (55, 60), (20, 25), (40, 50)] {
        let aside = (f64::from(x) + 0.5 - 32.0) / 60.0;
        let above = (32.0 - f64::from(y) - 0.5) / 60.0;
        let ray = forward + aside * right + above * up;
        let point = eye - ray * (eye.y / ray.y);
        // Texel i is centered at (i + 1/2) / 64. Filtering mixes linear light, but on so gentle a ramp the result is
        // close to mixing bytes.
        let [u, v] = [point.x, point.z].map(|number| (number + 40.0) / 80.0 * 64.0 - 0.5);
        let want = [4.0 * u, 4.0 * v, 0.0];
        let seen = shown.pixel(x, y).map(f64::from);
        let off = seen.iter().zip(want).map(|(seen, want)| (seen - want).abs()).fold(0.0, f64::max);
        assert!(off < 3.0, "({x}, {y}): {seen:?}, expected {want:?}");
    }
}

/// The signs and cases of the corrected equations hold; those printed in the source do not.
#[test]
fn equations_3_12_and_3_14_hold_as_corrected() {
    // Equation 3.12: with the sun from the left and the eye at the center, the highlight is on the left.
    let sun = Vector3::new(-0.3, 0.0, 1.0).normalize();
    let mut shiny = SceneBuilder::new();
    shiny.parts.look.sun = sun.cast::<f32>().into();
    let material =
        Material { diffuse: [0.0; 3], ambient: [0.0; 3], specular: [1.0; 3], shininess: 60.0, ..painted(None) };
    let shown = render(&shiny.add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), material).build());
    let (mut differ, normal) = (0, Vector3::z());
    for x in [5, 15, 17, 20, 32, 48] {
        let point = Vector3::new((f64::from(x) + 0.5 - 32.0) / 10.0, -0.05, 0.0);
        let to_eye = (Vector3::new(0.0, 0.0, 10.0) - point).normalize();
        let mirrored = |toward: Vector3<f64>| 2.0 * toward.dot(&normal) * normal - toward;
        let light = |toward: Vector3<f64>| [0.5 * mirrored(toward).dot(&sun).max(0.0).powi(60); 3];
        assert!(is_close(shown.pixel(x, 32), light(to_eye), 1.0), "{x}: {:?}", shown.pixel(x, 32));
        // As printed, v_e points away from the camera.
        differ += usize::from(!is_close(shown.pixel(x, 32), light(-to_eye), 1.0));
    }
    assert!(differ > 2, "the printed sign of v_e is told from ours");

    // Equation 3.14: s_tex = 1 selects the color of the image; as printed, it would select the material's own color.
    let shown = |textured: bool| {
        let mut builder = create_builder();
        let image = builder.add_texture(1, 1, |_, _| [188, 10, 90, 255]);
        render(
            &builder
                .add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), painted(textured.then_some(image)))
                .build(),
        )
        .pixel(30, 30)
    };
    assert_eq!((shown(true), shown(false)), ([188, 10, 90], [255; 3]));
}

#[test]
fn every_pixel_sees_its_triangle_the_ground_or_nothing() {
    let mut builder = create_builder();
    builder.parts.look.ground = Some(Ground::default());
    // The first domain is a cut-out and the second is opaque. The renderer draws the opaque one first.
    let leaf = Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, ..painted(None) };
    let scene = builder
        .add_domain(facing_rectangle(-2.0, 0.0, -1.0, 1.0, 0.0), leaf)
        .add_domain(facing_rectangle(1.0, 0.0, 2.0, 1.0, 0.0), painted(None))
        .build();
    let mut renderer = open_renderer();
    renderer.read_visibility().expect_err("no frame yet");
    let view = View::LookAt { eye: [0.0, 0.5, 10.0], target: [0.0, 0.5, 0.0], up: [0.0, 1.0, 0.0] };
    let shown = render_square(&mut renderer, &scene, Camera { view, ..front_camera(64) }, 64);
    let seen = renderer.read_visibility().expect("reads");
    assert_eq!(seen.len(), 64 * 64);
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    let at = |x: usize, y: usize| match seen[64 * y + x] {
        VisibilityId::Triangle(place) => buffers.source_triangle(place),
        _ => None,
    };
    // The first triangle of each square is right of and below the diagonal.
    assert_eq!((at(19, 34), at(15, 29)), (Some((0, 0)), Some((0, 1))));
    assert_eq!((at(49, 34), at(45, 29)), (Some((1, 0)), Some((1, 1))));
    assert_eq!((seen[64 * 5 + 32], seen[64 * 60 + 32]), (VisibilityId::Background, VisibilityId::Ground));
    assert_eq!(buffers.source_triangle(4), None);
    assert!(shown.pixel(19, 34) != shown.pixel(32, 5));
}

#[test]
fn five_hundred_and_twelve_images_are_drawn_in_one_call() {
    let mut builder = create_builder();
    for index in 0..512_u32 {
        let image =
            builder.add_texture(4, 4, |_, _| [(index % 256) as u8, 255 - (index % 256) as u8, (index / 2) as u8, 255]);
        let (left, bottom) = (-3.2 + 0.2 * (index % 32) as f32, -3.2 + 0.4 * (index / 32) as f32);
        builder =
            builder.add_domain(facing_rectangle(left, bottom, left + 0.2, bottom + 0.4, 0.0), painted(Some(image)));
    }
    let shown = render(&builder.build());
    assert_eq!(shown.stats.draw_calls, 1);
    for index in [0, 1, 100, 255, 256, 300, 511_u32] {
        let seen = shown.pixel(2 * (index % 32), 64 - 2 - 4 * (index / 32));
        let want = [(index % 256) as u8, 255 - (index % 256) as u8, (index / 2) as u8];
        assert!(seen.iter().zip(want).all(|(a, b)| a.abs_diff(b) <= 1), "image {index}: {seen:?}, expected {want:?}");
    }
}

/// Renders one square with an image and a normal map, with these normals and tangents at its corners.
fn spoiled(scene: &Arc<Scene>, normals: [f32; 3], tangents: [f32; 4], flat: bool) -> Vec<u8> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let mut positions = scene.shapes[0].mesh.rest().as_flattened().to_vec();
    if flat {
        // Shrunk along x below the resolution of f32, so that the square has no area on the screen.
        positions.chunks_exact_mut(3).for_each(|vertex| vertex[0] *= 1e-30);
    }
    let surface = DeformedSurface {
        positions,
        normals: normals.repeat(4),
        tangents: tangents.repeat(4),
        ..DeformedSurface::default()
    };
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    let shot = FrameParams { camera: front_camera(64), width: 64, height: 64, bounds: scene.rest_bounds, light: None };
    renderer.draw(&buffers, &shot).expect("expected a frame").rgba
}

#[test]
fn degenerate_normals_and_triangles_leave_no_black_pixel() {
    let mut builder = create_builder();
    builder.parts.look.zenith = [0.3; 3];
    builder.parts.look.horizon = [0.3; 3];
    let image = builder.add_texture(4, 4, |_, _| [200, 200, 200, 255]);
    let bump = builder.add_texture(1, 1, |_, _| [150, 100, 220, 255]);
    let material = Material { normal_texture: Some(bump), specular: [1.0; 3], shininess: 1e6, ..painted(Some(image)) };
    let scene = builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), material).build();
    for normal in [[0.0; 3], [f32::NAN; 3], [f32::INFINITY; 3], [1e-30; 3], [f32::MAX; 3]] {
        for tangent in [[0.0; 4], [f32::NAN; 4], [0.0, 0.0, f32::MAX, 1.0]] {
            for flat in [false, true] {
                let rgba = spoiled(&scene, normal, tangent, flat);
                let black = rgba.chunks_exact(4).filter(|pixel| pixel[..3].iter().any(|byte| *byte < 100)).count();
                assert_eq!(black, 0, "{normal:?} {tangent:?} {flat}");
            }
        }
    }
    assert!(encode_srgb(0.3) > 100.0, "control: the sky is brighter than the judge's black");
}
