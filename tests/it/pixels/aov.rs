//! Readbacks of AOVs (arbitrary output variables: depth, domain indices, normals and vertex values) equal the values
//! that the tests compute.

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Camera, Ground, Lens, View};
use modalcast_render::{Aov, AovImage, FrameParams};
use nalgebra::Vector3;

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, front_camera, open_renderer};

/// Reads an AOV of a scene at rest in a square image with side `size`. For [`Aov::Values`], the value of each vertex is
/// its x coordinate, and the function also asserts that missing values and too few values are errors.
fn read_aov(builder: SceneBuilder, camera: Camera, size: u32, aov: Aov) -> AovImage {
    let scene = builder.build();
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    let mut surface = modalcast_model::deform::DeformedSurface::default();
    for (domain, layout) in scene.domains.iter().zip(&scene.layout.domains) {
        let mesh = &scene.shapes[domain.shape].mesh;
        assert_eq!(layout.first_vertex, surface.positions.len() / 3);
        surface.positions.extend(mesh.rest_positions().as_flattened());
        // The meshes of these tests have one corner per vertex.
        surface.normals.extend(mesh.corners().normals.as_flattened());
    }
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    let params = FrameParams {
        camera,
        width: size,
        height: size,
        bounds: scene.rest_bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    if let Aov::Values { .. } = aov {
        renderer.render_aov(&buffers, &params, aov).expect_err("expected an error without vertex values");
        let values: Vec<f32> = surface.positions.chunks_exact(3).map(|point| point[0]).collect();
        renderer.upload_vertex_values(&mut buffers, &values[1..]).expect_err("expected an error for too few values");
        renderer.upload_vertex_values(&mut buffers, &values).expect("expected the upload to succeed");
    }
    renderer.render_aov(&buffers, &params, aov).expect("expected AOVs")
}

fn decode_f32(image: &AovImage) -> Vec<f32> {
    bytemuck::pod_collect_to_vec(&image.bytes)
}

/// A camera for 64 x 64 pixels that looks down at the plane y = 0 from height 5. Its focal length is 60 pixels. Its
/// clip planes of 0 are fitted to the bounds.
fn oblique_camera() -> Camera {
    let view = View::LookAt { eye: [3.0, 5.0, 4.0], target: [0.0, 0.0, -6.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 32.0 }, near: 0.0, far: 0.0 }
}

/// Depth along the view axis where the ray of a pixel of [`oblique_camera`] intersects the plane y = 0; `None` for rays
/// that do not go down.
fn depth_of_floor(x: u32, y: u32) -> Option<f64> {
    // The vector from the eye to the target of the camera.
    let forward = Vector3::new(-3.0, -5.0, -10.0_f64).normalize();
    let right = forward.cross(&Vector3::y()).normalize();
    let up = right.cross(&forward);
    // The component of the ray along `forward` is 1. So the depth is the factor by which the ray reaches the plane.
    let ray = forward + (f64::from(x) + 0.5 - 32.0) / 60.0 * right + (32.0 - f64::from(y) - 0.5) / 60.0 * up;
    (ray.y < 0.0).then(|| -5.0 / ray.y)
}

/// Depth is infinite in pixels without a surface.
#[test]
fn depth_is_in_meters_along_the_view_axis() {
    // `unit` is in meters per scene unit.
    for (has_ground, unit) in [(false, 1.0), (true, 0.5)] {
        let mut builder = SceneBuilder::new();
        builder.parts.unit = Some(unit);
        builder.parts.look.ground = has_ground.then(Ground::default);
        // With a ground, the square is small, so that most pixels show the ground.
        let half_side = if has_ground { 1.0 } else { 40.0 };
        let image = read_aov(
            builder.add_domain(floor_mesh(half_side, 0.0), Material::default()),
            oblique_camera(),
            64,
            if has_ground { Aov::DepthWithGround } else { Aov::Depth },
        );
        assert_eq!((image.width, image.height, image.samples), (64, 64, 1));
        let (mut covered_pixels, mut max_relative_error) = (0, 0.0_f64);
        for (pixel, depth) in decode_f32(&image).into_iter().enumerate() {
            let expected = depth_of_floor(pixel as u32 % 64, pixel as u32 / 64).map(|scene_units| scene_units * unit);
            if depth.is_finite() {
                covered_pixels += 1;
                let expected = expected.expect("expected depth below the horizon only");
                max_relative_error = max_relative_error.max((f64::from(depth) / expected - 1.0).abs());
            }
        }
        // More than 2000 of the 4096 pixels are below the horizon.
        assert!(covered_pixels > 2000, "{covered_pixels} pixels");
        assert!(max_relative_error < 1e-4, "expected only rounding errors of f32, got {max_relative_error:e}");
        assert_eq!(decode_f32(&image)[0], f32::INFINITY, "expected infinite depth in the sky at the top left");
    }
}

/// Opaque domain 2 is drawn before cut-out domain 1. Blended domain 0 is ignored.
#[test]
fn domain_indices_do_not_depend_on_the_drawing_order() {
    let cut_out_material = Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, ..Material::default() };
    let glass_material = Material { alpha_mode: AlphaMode::Blend, alpha: 0.5, ..Material::default() };
    let builder = SceneBuilder::new()
        .add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 2.0), glass_material)
        .add_domain(facing_rectangle(-2.0, 0.0, -1.0, 1.0, 0.0), cut_out_material)
        .add_domain(facing_rectangle(1.0, 0.0, 2.0, 1.0, 0.0), Material::default());
    let ids: Vec<u32> = bytemuck::pod_collect_to_vec(&read_aov(builder, front_camera(64), 64, Aov::Domains).bytes);
    let id_at = |x: usize, y: usize| ids[64 * y + x];
    // Pixels at the center of domain 1, at the center of domain 2, and between both domains.
    let [cut_out_id, opaque_id, background_id] = [id_at(17, 26), id_at(47, 26), id_at(32, 26)];
    assert_eq!([cut_out_id, opaque_id, background_id], [1, 2, u32::MAX]);
    assert_eq!(ids.iter().filter(|id| **id == 1).count(), 100, "expected 10 x 10 pixels of domain 1");
}

#[test]
fn normals_face_the_camera_and_are_zero_elsewhere() {
    let double_sided = Material { double_sided: true, ..Material::default() };
    let builder = SceneBuilder::new().add_domain(facing_rectangle(-2.0, -2.0, 0.0, 2.0, 0.0), double_sided);
    let view_from_behind = View::LookAt { eye: [0.0, 0.0, -10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
    let normals =
        decode_f32(&read_aov(builder, Camera { view: view_from_behind, ..front_camera(64) }, 64, Aov::Normals));
    let normal_at = |x: usize, y: usize| &normals[3 * (64 * y + x)..][..3];
    // Seen from behind, the rectangle covers columns 32 to 51.
    let (rectangle_normal, sky_normal) = (normal_at(40, 30), normal_at(20, 30));
    assert_eq!((rectangle_normal, sky_normal), (&[0.0, 0.0, -1.0][..], &[0.0; 3][..]));
    let mut builder = SceneBuilder::new();
    builder.parts.look.ground = Some(Ground::default());
    let normals = decode_f32(&read_aov(
        builder.add_domain(floor_mesh(1.0, 0.0), Material::default()),
        oblique_camera(),
        64,
        Aov::Normals,
    ));
    let bottom_center = &normals[3 * (64 * 63 + 32)..][..3];
    assert_eq!(bottom_center, [0.0; 3], "expected zeros on the ground");
}

/// A sample stores the value of a vertex divided by `scale_max`, clamped to 0 to 1, as a 16-bit number. The value of
/// each vertex is its x coordinate.
#[test]
fn values_are_interpolated_linearly_and_clamped() {
    for (samples, scale_max) in [(1, 2.0), (4, 1.0)] {
        let mut builder = SceneBuilder::new();
        builder.parts.look.samples = samples;
        let frame = read_aov(
            builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), Material::default()),
            front_camera(64),
            64,
            Aov::Values { scale_max },
        );
        assert_eq!(frame.samples, samples);
        let image_samples: Vec<u32> = bytemuck::pod_collect_to_vec(&frame.bytes);
        // The square covers columns 12 to 51; its border is excluded.
        for x in 13..51_usize {
            let pixel_samples = &image_samples[samples as usize * (64 * 30 + x)..][..samples as usize];
            // The lower 16 bits of a sample are its value.
            let mean = pixel_samples.iter().map(|sample| f64::from(sample & 0xFFFF) / 65535.0).sum::<f64>()
                / f64::from(samples);
            let expected = ((x as f64 + 0.5 - 32.0) / 10.0 / f64::from(scale_max)).clamp(0.0, 1.0);
            // Values have steps of 1 / 65535, about 1.5e-5. Near 0 and 1, only some samples of a pixel are clamped,
            // which changes their mean.
            let tolerance = if (0.05..0.95).contains(&expected) { 1e-4 } else { 0.1 };
            assert!((mean - expected).abs() < tolerance, "{x}: expected {expected}, got {mean}");
            // The upper 16 bits are the cosine between the normal and the direction to the eye, at least 0.98 here.
            assert!(pixel_samples.iter().all(|sample| sample >> 16 > 60000), "expected a cosine above 60000 / 65535");
        }
        let top_rows = &image_samples[..samples as usize * 64 * 5];
        assert!(top_rows.iter().all(|sample| *sample == 0), "expected zeros above the square");
    }
}

#[test]
fn aovs_allocate_on_demand_and_do_not_change_frames() {
    let scene =
        SceneBuilder::new().add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), Material::default()).build();
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    let mesh = &scene.shapes[0].mesh;
    let surface = modalcast_model::deform::DeformedSurface {
        positions: mesh.rest_positions().as_flattened().to_vec(),
        normals: mesh.corners().normals.as_flattened().to_vec(),
        tangents: vec![],
        ..Default::default()
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
    let expected_rgba = renderer.draw(&buffers, &params).expect("expected a frame").rgba;
    let (expected_stats, initial_allocations) = (renderer.stats().clone(), buffers.allocations());
    renderer.upload_vertex_values(&mut buffers, &[0.0, 1.0, 2.0, 3.0]).expect("expected the upload to succeed");
    assert_eq!(
        buffers.allocations().len(),
        initial_allocations.len() + 1,
        "expected one new allocation for the values"
    );
    for aov in [Aov::Depth, Aov::DepthWithGround, Aov::Domains, Aov::Normals, Aov::Values { scale_max: 3.0 }] {
        renderer.render_aov(&buffers, &params, aov).expect("expected AOVs");
        assert_eq!(renderer.draw(&buffers, &params).expect("expected a frame").rgba, expected_rgba);
        assert_eq!(renderer.stats(), &expected_stats);
    }
    for [width, height] in [[0, 64], [64, u32::MAX]] {
        renderer
            .render_aov(&buffers, &FrameParams { width, height, ..params }, Aov::Depth)
            .expect_err("expected an invalid-size error");
    }
}
