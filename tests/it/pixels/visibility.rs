//! The visibility buffer contains the triangle id of each sample. The tests check coverage, texture derivatives, ids,
//! and degenerate triangles.

use std::sync::Arc;

use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material, Mesh};
use modalcast_model::scene::{Camera, Ground, Lens, Scene, View};
use modalcast_render::{FrameParams, VisibilityId};
use nalgebra::Vector3;

use super::harness::{
    RenderedFrame, SceneBuilder, decode_srgb, encode_srgb, facing_rectangle, floor_mesh, front_camera, is_close,
    open_renderer, render, render_square,
};

/// A material lit by skylight alone. As the skylight of [`create_builder`] is 1, the material appears in its own color.
fn unlit_material(color_texture: Option<usize>) -> Material {
    Material { ambient: [1.0; 3], diffuse: [0.0; 3], color_texture, ..Material::default() }
}

fn create_builder() -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look.skylight = [1.0; 3];
    builder
}

#[test]
fn edge_covers_the_samples_on_its_side() {
    // The strip ends within pixel column 32, which is 0.1 units wide and begins at x = 0. `coverage` is the fraction of
    // the column that the strip covers. The four samples of a pixel lie at 1/8, 3/8, 5/8 and 7/8 of its width.
    for coverage in [0.25, 0.5, 0.75] {
        let render_with = |samples: u32| {
            let mut builder = create_builder();
            builder.parts.look.samples = samples;
            render(
                &builder
                    .add_domain(facing_rectangle(-1.0, -1.0, 0.1 * coverage as f32, 1.0, 0.0), unlit_material(None))
                    .build(),
            )
        };
        let multisampled = render_with(4);
        assert_eq!(multisampled.stats.samples, 4);
        assert!(
            is_close(multisampled.pixel(32, 30), [coverage; 3], 1.0),
            "{coverage}: {:?}",
            multisampled.pixel(32, 30)
        );
        let single_sample = render_with(1);
        assert_eq!(single_sample.stats.samples, 1);
        assert!(
            [[0; 3], [255; 3]].contains(&single_sample.pixel(32, 30)),
            "{coverage}: {:?}",
            single_sample.pixel(32, 30)
        );
    }
}

#[test]
fn cut_out_edge_is_resolved_per_sample() {
    // The square covers 40 x 40 pixels. Alpha rises by 1/40 per pixel from left to right, so that each row crosses the
    // cutoff once.
    let render_with = |cutoff: f32, samples: u32| {
        let mut builder = create_builder();
        builder.parts.look.samples = samples;
        let image = builder.add_texture(256, 1, |x, _| [255, 255, 255, x as u8]);
        let alpha_mode = AlphaMode::Mask { cutoff };
        let cut_out_material = Material { alpha_mode, ..unlit_material(Some(image)) };
        render(&builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), cut_out_material).build())
    };
    // Linear light of row 30, in white pixels.
    let total_light = |frame: &RenderedFrame| (14..50).map(|x| decode_srgb(frame.pixel(x, 30)[0])).sum::<f64>();
    for quarters in 0..4 {
        // Distance of the cut-out's edge from the left side of the square, in pixels.
        let edge_x = 20.0 + 0.25 * f64::from(quarters) + 0.01;
        // Alpha at the edge: texel i of 256 has alpha i / 255, and its center is at (i + 0.5) / 256 of the width.
        let cutoff = ((edge_x / 40.0 * 256.0 - 0.5) / 255.0) as f32;
        let (multisampled, single_sample) = (render_with(cutoff, 4), render_with(cutoff, 1));
        // `total_light` counts columns up to 49, and the square begins at column 12.
        let expected_pixels = 50.0 - 12.0 - edge_x;
        assert!(
            (total_light(&multisampled) - expected_pixels).abs() < 0.3,
            "{quarters} quarters: expected the light of {expected_pixels} pixels, got {}",
            total_light(&multisampled)
        );
        // At most two pixels of each of the 40 rows are partly covered.
        let count_gray = |frame: &RenderedFrame| frame.count_pixels(|[red, ..]| red > 4 && red < 251);
        assert!(
            count_gray(&single_sample) == 0 && count_gray(&multisampled) <= 2 * 40,
            "{quarters} quarters: {} gray pixels with one sample, {} with four",
            count_gray(&single_sample),
            count_gray(&multisampled)
        );
    }
    assert!(
        (total_light(&render_with(0.25, 4)) - total_light(&render_with(0.75, 4))).abs() > 15.0,
        "negative control: expected the cutoff to change the image"
    );
}

/// Renders white and black stripes, each two texels wide, on a square of 40 x 40 pixels that begins at pixel (12, 12).
/// The texture has `size` x `size` texels, and the texture coordinates run from 0 to `max_uv`.
fn render_stripes(size: u32, max_uv: f32) -> RenderedFrame {
    let mut builder = create_builder();
    let image = builder.add_texture(size, size, |x, _| if x % 4 < 2 { [255; 4] } else { [0, 0, 0, 255] });
    let positions = facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0).rest_positions().to_vec();
    let uvs = vec![[0.0, max_uv], [max_uv, max_uv], [max_uv, 0.0], [0.0, 0.0]];
    let mesh = Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 4], uvs, vec![[0, 1, 2], [0, 2, 3]])
        .expect("expected a valid mesh");
    render(&builder.add_domain(mesh, unlit_material(Some(image))).build())
}

/// Pixels of the square of [`render_stripes`] that one triangle fills. Pixels at the border of the square and on its
/// diagonal, x + y = 63, are excluded.
fn inner_pixels() -> impl Iterator<Item = (u32, u32)> {
    (13..51_u32).flat_map(|y| (13..51_u32).map(move |x| (x, y))).filter(|(x, y)| (x + y).abs_diff(63) > 1)
}

/// With one texel per pixel, mip level 0 is read. With four texels per pixel and axis, level 2 is read, the mean of 4 x
/// 4 texels.
#[test]
fn mip_level_follows_texels_per_pixel() {
    let level_0 = render_stripes(40, 1.0);
    for (x, y) in inner_pixels() {
        let is_white = (x - 12) % 4 < 2;
        assert!(
            is_close(level_0.pixel(x, y), [f64::from(u8::from(is_white)); 3], 3.0),
            "({x}, {y}): {:?}",
            level_0.pixel(x, y)
        );
    }
    let level_2 = render_stripes(160, 1.0);
    assert!(
        inner_pixels().all(|(x, y)| is_close(level_2.pixel(x, y), [0.5; 3], 3.0)),
        "expected uniform gray of level 2, got {:?}",
        level_2.pixel(20, 20)
    );
    assert!(!is_close(level_0.pixel(20, 20), [0.5; 3], 3.0), "negative control: expected stripes of level 0");
}

#[test]
fn repeated_texture_has_no_mip_seam() {
    // The texture of 20 texels is repeated twice. If the coordinates were wrapped before their derivatives are
    // computed, the derivatives would jump in the middle of the square and blur a line there.
    let frame = render_stripes(20, 2.0);
    for (x, y) in inner_pixels() {
        let is_white = (x - 12) % 4 < 2;
        assert!(
            is_close(frame.pixel(x, y), [f64::from(u8::from(is_white)); 3], 3.0),
            "({x}, {y}): {:?}",
            frame.pixel(x, y)
        );
    }
}

/// The two triangles of the floor extend behind the camera.
#[test]
fn texture_coordinates_are_perspective_correct() {
    let mut builder = create_builder();
    let image = builder.add_texture(64, 64, |x, y| [4 * x as u8, 4 * y as u8, 0, 255]);
    let eye = Vector3::new(3.0, 5.0, 4.0);
    let view = View::LookAt { eye: eye.into(), target: [3.0, 0.0, -6.0], up: [0.0, 1.0, 0.0] };
    let lens = Lens::Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 32.0 };
    let frame = render_square(
        &mut open_renderer(),
        &builder.add_domain(floor_mesh(40.0, 0.0), unlit_material(Some(image))).build(),
        Camera { view, lens, ..front_camera(64) },
        64,
    );
    let forward = Vector3::new(0.0, -5.0, -10.0_f64).normalize();
    let (right, up) = (Vector3::x(), Vector3::x().cross(&forward));
    for (x, y) in [(10, 40), (32, 32), (55, 60), (20, 25), (40, 50)] {
        let right_offset = (f64::from(x) + 0.5 - 32.0) / 60.0;
        let up_offset = (32.0 - f64::from(y) - 0.5) / 60.0;
        let ray = forward + right_offset * right + up_offset * up;
        // The intersection with the floor, y = 0.
        let point = eye - ray * (eye.y / ray.y);
        // Texel i has the bytes 4 i and its center at (i + 1/2) / 64. Filtering mixes linear light. Neighboring texels
        // differ so little that mixing bytes gives nearly the same result.
        let [u, v] = [point.x, point.z].map(|number| (number + 40.0) / 80.0 * 64.0 - 0.5);
        let expected = [4.0 * u, 4.0 * v, 0.0];
        let color = frame.pixel(x, y).map(f64::from);
        let error = color.iter().zip(expected).map(|(color, expected)| (color - expected).abs()).fold(0.0, f64::max);
        assert!(error < 3.0, "({x}, {y}): {color:?}, expected {expected:?}");
    }
}

/// Shading follows equations 3.12 and 3.14 of the thesis with corrections.
#[test]
fn equations_3_12_and_3_14_hold_with_corrections() {
    // Equation 3.12 reflects v_e, the direction between the eye and the shaded point, at the normal. As printed, v_e
    // points away from the eye. The corrected v_e points to the eye. With the sun from the left and the eye in the
    // middle, the highlight is on the left.
    let sun = Vector3::new(-0.3, 0.0, 1.0).normalize();
    let mut builder = SceneBuilder::new();
    builder.parts.look.sun = sun.cast::<f32>().into();
    let material =
        Material { diffuse: [0.0; 3], ambient: [0.0; 3], specular: [1.0; 3], shininess: 60.0, ..unlit_material(None) };
    let frame = render(&builder.add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 0.0), material).build());
    let (mut differing_pixels, normal) = (0, Vector3::z());
    for x in [5, 15, 17, 20, 32, 48] {
        let point = Vector3::new((f64::from(x) + 0.5 - 32.0) / 10.0, -0.05, 0.0);
        let to_eye = (Vector3::new(0.0, 0.0, 10.0) - point).normalize();
        let reflect = |direction: Vector3<f64>| 2.0 * direction.dot(&normal) * normal - direction;
        let highlight = |direction: Vector3<f64>| [0.5 * reflect(direction).dot(&sun).max(0.0).powi(60); 3];
        assert!(is_close(frame.pixel(x, 32), highlight(to_eye), 1.0), "{x}: {:?}", frame.pixel(x, 32));
        differing_pixels += usize::from(!is_close(frame.pixel(x, 32), highlight(-to_eye), 1.0));
    }
    assert!(differing_pixels > 2, "negative control: expected the printed sign of v_e to give other colors");

    // Equation 3.14: s_tex, 1 for a textured material, selects the color of the texture. As printed, it would select
    // the color of the material.
    let render_with = |has_texture: bool| {
        let mut builder = create_builder();
        let image = builder.add_texture(1, 1, |_, _| [188, 10, 90, 255]);
        render(
            &builder
                .add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), unlit_material(has_texture.then_some(image)))
                .build(),
        )
        .pixel(30, 30)
    };
    assert_eq!((render_with(true), render_with(false)), ([188, 10, 90], [255; 3]));
}

#[test]
fn visibility_ids_are_triangles_the_ground_or_background() {
    let mut builder = create_builder();
    builder.parts.look.ground = Some(Ground::default());
    // Domain 0 is a cut-out and domain 1 is opaque. The renderer draws domain 1 first.
    let leaf = Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, ..unlit_material(None) };
    let scene = builder
        .add_domain(facing_rectangle(-2.0, 0.0, -1.0, 1.0, 0.0), leaf)
        .add_domain(facing_rectangle(1.0, 0.0, 2.0, 1.0, 0.0), unlit_material(None))
        .build();
    let mut renderer = open_renderer();
    renderer.read_visibility().expect_err("expected an error before the first frame");
    let view = View::LookAt { eye: [0.0, 0.5, 10.0], target: [0.0, 0.5, 0.0], up: [0.0, 1.0, 0.0] };
    let frame = render_square(&mut renderer, &scene, Camera { view, ..front_camera(64) }, 64);
    let ids = renderer.read_visibility().expect("expected visibility ids");
    assert_eq!(ids.len(), 64 * 64);
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    // Domain of the triangle at a pixel, and index of the triangle in the mesh of the domain.
    let source_at = |x: usize, y: usize| match ids[64 * y + x] {
        VisibilityId::Triangle(index) => buffers.source_triangle(index),
        _ => None,
    };
    // The first triangle of each square is below the diagonal.
    assert_eq!((source_at(19, 34), source_at(15, 29)), (Some((0, 0)), Some((0, 1))));
    assert_eq!((source_at(49, 34), source_at(45, 29)), (Some((1, 0)), Some((1, 1))));
    assert_eq!((ids[64 * 5 + 32], ids[64 * 60 + 32]), (VisibilityId::Background, VisibilityId::Ground));
    assert_eq!(buffers.source_triangle(4), None, "expected no triangle after the four of the scene");
    assert!(frame.pixel(19, 34) != frame.pixel(32, 5));
}

#[test]
fn scene_with_512_textures_is_drawn_in_one_call() {
    let mut builder = create_builder();
    // 32 columns and 16 rows of rectangles of 2 x 4 pixels, from the bottom left.
    for index in 0..512_u32 {
        let image =
            builder.add_texture(4, 4, |_, _| [(index % 256) as u8, 255 - (index % 256) as u8, (index / 2) as u8, 255]);
        let (left, bottom) = (-3.2 + 0.2 * (index % 32) as f32, -3.2 + 0.4 * (index / 32) as f32);
        builder = builder
            .add_domain(facing_rectangle(left, bottom, left + 0.2, bottom + 0.4, 0.0), unlit_material(Some(image)));
    }
    let frame = render(&builder.build());
    assert_eq!(frame.stats.draw_calls, 1);
    for index in [0, 1, 100, 255, 256, 300, 511_u32] {
        let pixel = frame.pixel(2 * (index % 32), 64 - 2 - 4 * (index / 32));
        let expected = [(index % 256) as u8, 255 - (index % 256) as u8, (index / 2) as u8];
        assert!(
            pixel.iter().zip(expected).all(|(a, b)| a.abs_diff(b) <= 1),
            "texture {index}: {pixel:?}, expected {expected:?}"
        );
    }
}

/// Renders the square of a scene with `normal` and `tangent` at all corners. With `is_flattened`, the square has no
/// area on the screen.
fn render_with_normals(scene: &Arc<Scene>, normal: [f32; 3], tangent: [f32; 4], is_flattened: bool) -> Vec<u8> {
    let mut renderer = open_renderer();
    let buffers = renderer.load(scene).expect("expected the scene to load");
    let mut positions = scene.shapes[0].mesh.rest_positions().as_flattened().to_vec();
    if is_flattened {
        // Shrinks the square along x below the resolution of clip coordinates in f32.
        positions.chunks_exact_mut(3).for_each(|vertex| vertex[0] *= 1e-30);
    }
    let surface = DeformedSurface {
        positions,
        normals: normal.repeat(4),
        tangents: tangent.repeat(4),
        ..DeformedSurface::default()
    };
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    let params = FrameParams {
        camera: front_camera(64),
        width: 64,
        height: 64,
        bounds: scene.rest_bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    renderer.draw(&buffers, &params).expect("expected a frame").rgba
}

#[test]
fn degenerate_normals_and_triangles_leave_no_black_pixel() {
    let mut builder = create_builder();
    builder.parts.look.zenith = [0.3; 3];
    builder.parts.look.horizon = [0.3; 3];
    let image = builder.add_texture(4, 4, |_, _| [200, 200, 200, 255]);
    let normal_map = builder.add_texture(1, 1, |_, _| [150, 100, 220, 255]);
    let material = Material {
        normal_texture: Some(normal_map),
        specular: [1.0; 3],
        shininess: 1e6,
        ..unlit_material(Some(image))
    };
    let scene = builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), material).build();
    for normal in [[0.0; 3], [f32::NAN; 3], [f32::INFINITY; 3], [1e-30; 3], [f32::MAX; 3]] {
        for tangent in [[0.0; 4], [f32::NAN; 4], [0.0, 0.0, f32::MAX, 1.0]] {
            for is_flattened in [false, true] {
                let rgba = render_with_normals(&scene, normal, tangent, is_flattened);
                let dark_pixels =
                    rgba.chunks_exact(4).filter(|pixel| pixel[..3].iter().any(|byte| *byte < 100)).count();
                assert_eq!(dark_pixels, 0, "normal {normal:?}, tangent {tangent:?}, flattened {is_flattened}");
            }
        }
    }
    assert!(encode_srgb(0.3) > 100.0, "expected a sky brighter than the threshold of dark pixels");
}
