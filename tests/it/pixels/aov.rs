//! AOV readbacks (depth, domains, normals, values) compared with arithmetic.

use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::scene::{Camera, Ground, Lens, View};
use modalcast_render::{Aov, AovImage, FrameParams};
use nalgebra::Vector3;

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, front_camera, open_renderer};

/// Reads an AOV of a scene at rest in a square picture.
fn survey(builder: SceneBuilder, camera: Camera, size: u32, field: Aov) -> AovImage {
    let scene = builder.build();
    let mut renderer = open_renderer();
    let mut buffers = renderer.load(&scene).expect("expected the scene to load");
    let mut surface = modalcast_model::deform::DeformedSurface::default();
    for (domain, slot) in scene.domains.iter().zip(&scene.layout.slots) {
        let mesh = &scene.shapes[domain.shape].mesh;
        assert_eq!(slot.first_vertex, surface.positions.len() / 3);
        surface.positions.extend(mesh.rest().as_flattened());
        surface.normals.extend(mesh.corners().normals.as_flattened());
    }
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    let shot = FrameParams { camera, width: size, height: size, bounds: scene.rest_bounds, light: None };
    if let Aov::Values { .. } = field {
        renderer.render_aov(&buffers, &shot, field).expect_err("no values yet");
        let values: Vec<f32> = surface.positions.chunks_exact(3).map(|point| point[0]).collect();
        renderer.upload_vertex_values(&mut buffers, &values[1..]).expect_err("too few");
        renderer.upload_vertex_values(&mut buffers, &values).expect("expected the upload to succeed");
    }
    renderer.render_aov(&buffers, &shot, field).expect("expected AOVs")
}

fn floats(survey: &AovImage) -> Vec<f32> {
    bytemuck::pod_collect_to_vec(&survey.bytes)
}

fn oblique() -> Camera {
    let view = View::LookAt { eye: [3.0, 5.0, 4.0], target: [0.0, 0.0, -6.0], up: [0.0, 1.0, 0.0] };
    Camera { view, lens: Lens::Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 32.0 }, near: 0.0, far: 0.0 }
}

/// Depth along the view axis where the ray of a pixel meets the plane y = 0; `None` for rays that do not go down.
fn depth_of_floor(x: u32, y: u32) -> Option<f64> {
    let forward = Vector3::new(-3.0, -5.0, -10.0_f64).normalize();
    let right = forward.cross(&Vector3::y()).normalize();
    let up = right.cross(&forward);
    let ray = forward + (f64::from(x) + 0.5 - 32.0) / 60.0 * right + (32.0 - f64::from(y) - 0.5) / 60.0 * up;
    (ray.y < 0.0).then(|| -5.0 / ray.y)
}

/// Depth is infinite in pixels without a surface.
#[test]
fn depth_is_in_meters_along_the_view_axis() {
    for (ground, unit) in [(false, 1.0), (true, 0.5)] {
        let mut builder = SceneBuilder::new();
        builder.parts.unit = unit;
        builder.parts.look.ground = ground.then(Ground::default);
        // With a ground the square is small, so that most pixels show the ground.
        let half = if ground { 1.0 } else { 40.0 };
        let depth = survey(builder.add_domain(floor_mesh(half, 0.0), Material::default()), oblique(), 64, Aov::Depth);
        assert_eq!((depth.width, depth.height, depth.samples), (64, 64, 1));
        let (mut met, mut most) = (0, 0.0_f64);
        for (at, got) in floats(&depth).into_iter().enumerate() {
            let want = depth_of_floor(at as u32 % 64, at as u32 / 64).map(|depth| depth * unit);
            if got.is_finite() {
                met += 1;
                let want = want.expect("only what lies below the horizon is met");
                most = most.max((f64::from(got) / want - 1.0).abs());
            }
        }
        assert!(met > 2000 && most < 1e-4, "{met} pixels, off by {most:e} of their depth");
        assert!(floats(&depth)[0] == f32::INFINITY || ground, "the sky");
    }
}

#[test]
fn domain_indices_do_not_depend_on_the_drawing_order() {
    let leaf = Material { alpha_mode: AlphaMode::Mask { cutoff: 0.5 }, ..Material::default() };
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.5, ..Material::default() };
    let builder = SceneBuilder::new()
        .add_domain(facing_rectangle(-3.0, -3.0, 3.0, 3.0, 2.0), glass)
        .add_domain(facing_rectangle(-2.0, 0.0, -1.0, 1.0, 0.0), leaf)
        .add_domain(facing_rectangle(1.0, 0.0, 2.0, 1.0, 0.0), Material::default());
    let ids: Vec<u32> = bytemuck::pod_collect_to_vec(&survey(builder, front_camera(64), 64, Aov::Domains).bytes);
    assert_eq!([ids[64 * 26 + 17], ids[64 * 26 + 47], ids[64 * 26 + 32]], [1, 2, u32::MAX]);
    assert_eq!(ids.iter().filter(|id| **id == 1).count(), 100, "ten by ten pixels");
}

#[test]
fn normals_face_the_viewer_and_are_zero_elsewhere() {
    let double_sided = Material { double_sided: true, ..Material::default() };
    let builder = SceneBuilder::new().add_domain(facing_rectangle(-2.0, -2.0, 0.0, 2.0, 0.0), double_sided);
    let behind = View::LookAt { eye: [0.0, 0.0, -10.0], target: [0.0; 3], up: [0.0, 1.0, 0.0] };
    let normals = floats(&survey(builder, Camera { view: behind, ..front_camera(64) }, 64, Aov::Normals));
    let at = |x: usize, y: usize| &normals[3 * (64 * y + x)..][..3];
    assert_eq!((at(40, 30), at(20, 30)), (&[0.0, 0.0, -1.0][..], &[0.0; 3][..]));
    let mut builder = SceneBuilder::new();
    builder.parts.look.ground = Some(Ground::default());
    let normals =
        floats(&survey(builder.add_domain(floor_mesh(1.0, 0.0), Material::default()), oblique(), 64, Aov::Normals));
    assert_eq!(&normals[3 * (64 * 63 + 32)..][..3], [0.0; 3], "the ground");
}

#[test]
fn values_are_interpolated_linearly_and_clamped() {
    // The value of each vertex is its x.
    for (samples, largest) in [(1, 2.0), (4, 1.0)] {
        let mut builder = SceneBuilder::new();
        builder.parts.look.samples = samples;
        let shown = survey(
            builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), Material::default()),
            front_camera(64),
            64,
            Aov::Values { largest },
        );
        assert_eq!(shown.samples, samples);
        let words: Vec<u32> = bytemuck::pod_collect_to_vec(&shown.bytes);
        for x in 13..51_usize {
            let of_pixel = &words[samples as usize * (64 * 30 + x)..][..samples as usize];
            let mean = of_pixel.iter().map(|word| f64::from(word & 0xFFFF) / 65535.0).sum::<f64>() / f64::from(samples);
            let want = ((x as f64 + 0.5 - 32.0) / 10.0 / f64::from(largest)).clamp(0.0, 1.0);
            // Near the clamped ends, the samples of one pixel may mix clamped and linear values.
            let slack = if (0.05..0.95).contains(&want) { 1e-4 } else { 0.1 };
            assert!((mean - want).abs() < slack, "{x}: {mean} is not {want}");
            assert!(of_pixel.iter().all(|word| word >> 16 > 60000), "seen from before");
        }
        assert!(words[..samples as usize * 64 * 5].iter().all(|word| *word == 0));
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
        positions: mesh.rest().as_flattened().to_vec(),
        normals: mesh.corners().normals.as_flattened().to_vec(),
        tangents: vec![],
        ..Default::default()
    };
    renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
    let shot = FrameParams { camera: front_camera(64), width: 64, height: 64, bounds: scene.rest_bounds, light: None };
    let before = renderer.draw(&buffers, &shot).expect("expected a frame").rgba;
    let (stats, planned) = (renderer.stats().clone(), buffers.allocations());
    renderer.upload_vertex_values(&mut buffers, &[0.0, 1.0, 2.0, 3.0]).expect("expected the upload to succeed");
    assert_eq!(buffers.allocations().len(), planned.len() + 1, "the values, now that they were asked for");
    for field in [Aov::Depth, Aov::Domains, Aov::Normals, Aov::Values { largest: 3.0 }] {
        renderer.render_aov(&buffers, &shot, field).expect("expected AOVs");
        assert_eq!(renderer.draw(&buffers, &shot).expect("expected a frame").rgba, before);
        assert_eq!(renderer.stats(), &stats);
    }
    for [width, height] in [[0, 64], [64, u32::MAX]] {
        renderer.render_aov(&buffers, &FrameParams { width, height, ..shot }, Aov::Depth).expect_err("no such size");
    }
}
