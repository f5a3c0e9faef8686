//! Unused features have no allocations and no passes. Frames of extreme sizes, cameras and vertices are valid and
//! deterministic.

use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{DeformedSurface, Deformer as _};
use modalcast_model::domain::{AlphaMode, Material, Mesh, Transform};
use modalcast_model::scene::{BoundingBox, Camera, RenderSettings, SceneState, View};
use modalcast_render::{DevicePreference, FrameParams, Pass, Renderer, devices, plan};

use super::harness::{SceneBuilder, facing_rectangle, floor_mesh, front_camera, open_renderer, render, render_square};

fn default_look_builder() -> SceneBuilder {
    let mut builder = SceneBuilder::new();
    builder.parts.look = RenderSettings::default();
    builder
}

/// Allocated buffers and executed passes equal the plan of the scene.
#[test]
fn unused_features_allocate_and_run_nothing() {
    let plain_frame = render(&default_look_builder().add_domain(floor_mesh(1.0, -0.5), Material::default()).build());
    let allocation_names = |allocations: &[modalcast_render::Allocation]| {
        allocations.iter().map(|allocation| allocation.name.clone()).collect::<Vec<_>>()
    };
    for name in ["tangents", "uvs", "triangle materials"] {
        assert!(!allocation_names(&plain_frame.allocations).contains(&name.to_string()), "{name}");
    }
    assert_eq!(
        plain_frame.stats.passes,
        [Pass::Shadow, Pass::Blur, Pass::Visibility, Pass::Background, Pass::Shade, Pass::Encode]
    );

    let mut builder = default_look_builder();
    let image = builder.add_texture(1, 1, |_, _| [128, 128, 255, 255]);
    let normal_mapped = Material { normal_texture: Some(image), ..Material::default() };
    let glass = Material { alpha_mode: AlphaMode::Blend, alpha: 0.5, ..Material::default() };
    let mut builder = builder.add_domain(floor_mesh(1.0, -0.5), normal_mapped).add_domain(floor_mesh(1.0, -0.3), glass);
    // More opaque domains add no buffers and no passes.
    for index in 0..8 {
        builder = builder.add_domain(floor_mesh(0.1, -0.2 + 0.01 * index as f32), Material::default());
    }
    let scene = builder.build();
    let full_frame = render(&scene);
    for name in ["tangents", "uvs", "triangle materials"] {
        assert!(allocation_names(&full_frame.allocations).contains(&name.to_string()), "{name}");
    }
    assert_eq!(
        full_frame.stats.passes,
        [
            Pass::Shadow,
            Pass::Blur,
            Pass::Visibility,
            Pass::OitCount,
            Pass::OitAllocate,
            Pass::OitFill,
            Pass::OitResolve,
            Pass::Background,
            Pass::Shade,
            Pass::Encode
        ]
    );
    let mut planned_buffers = plan(&scene).buffers;
    planned_buffers.sort_by(|a, b| a.name.cmp(&b.name));
    assert_eq!(full_frame.allocations, planned_buffers, "expected the planned allocations");
    assert_eq!(full_frame.stats.passes, plan(&scene).passes, "expected the planned passes");
}

#[test]
fn draw_calls_do_not_grow_with_domains_and_materials() {
    let draw_calls = |domains: usize| {
        let mut builder = SceneBuilder::new();
        for index in 0..domains {
            let double_sided = index % 2 == 1;
            builder = builder.add_domain(
                facing_rectangle(-1.0, -1.0, 1.0, 1.0, index as f32 * -0.01),
                Material { double_sided, ..Material::default() },
            );
        }
        render(&builder.build()).stats.draw_calls
    };
    // One draw call for all single-sided domains, and one for all double-sided domains. A lone domain is single-sided.
    assert_eq!([1, 2, 9, 60].map(draw_calls), [1, 2, 2, 2]);
}

#[test]
fn empty_and_oversized_frames_are_rejected() {
    let scene =
        SceneBuilder::new().add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), Material::default()).build();
    let mut renderer = open_renderer();
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    let limit = renderer.info().max_side;
    for (width, height) in [(0, 0), (0, 5), (5, 0), (limit + 1, 1), (16384, 16384), (u32::MAX, u32::MAX)] {
        let params = FrameParams {
            camera: front_camera(64),
            width,
            height,
            bounds: scene.rest_bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        };
        let error = renderer.draw(&buffers, &params).expect_err("expected an invalid-size error").to_string();
        let expected = format!("frame.size: expected 1 to {limit} pixels a side, got {width} x {height}");
        assert_eq!(error, expected);
    }
    let params = FrameParams {
        camera: front_camera(64),
        width: 1,
        height: 1,
        bounds: scene.rest_bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    assert_eq!(renderer.draw(&buffers, &params).expect("expected a frame of one pixel").rgba.len(), 4);
}

/// Cut-outs are drawn correctly in such a frame.
#[test]
fn frame_too_large_for_msaa_is_drawn_with_one_sample() {
    let mut builder = SceneBuilder::new();
    let image = builder.add_texture(2, 1, |x, _| [255, 255, 255, 255 * x as u8]);
    let alpha_mode = AlphaMode::Mask { cutoff: 0.5 };
    let leaf = Material { color_texture: Some(image), alpha_mode, ..Material::default() };
    let scene = builder.add_domain(facing_rectangle(-1.0, -1.0, 1.0, 1.0, 0.0), leaf).build();
    let mut renderer = open_renderer();
    // 3400 x 3400 pixels exceed the limit of multisampling, 11 x 2^20 pixels. The square is seen under 11.4 degrees, so
    // the field of view of 12 degrees shows all of it. The left half of the square is cut out.
    let side = 3400;
    let mut camera = front_camera(side);
    camera.lens = modalcast_model::scene::Lens::FieldOfView(12.0);
    let frame = render_square(&mut renderer, &scene, camera, side);
    assert_eq!(frame.stats.samples, 1);
    let (left, right) = (frame.pixel(side / 2 - 700, side / 2), frame.pixel(side / 2 + 700, side / 2));
    assert!(left == [0; 3] && right != [0; 3], "expected black only on the left, got {left:?} and {right:?}");
}

#[test]
fn frames_are_deterministic() {
    let scene = default_look_builder()
        .add_domain(floor_mesh(1.0, 0.5), Material::default())
        .add_domain(floor_mesh(0.5, 1.0), Material::default())
        .build();
    let mut renderer = open_renderer();
    let first_frame = render_square(&mut renderer, &scene, Camera::fit_to_scene(&scene, 64, 64), 96);
    assert!(
        first_frame.image.rgba
            == render_square(&mut renderer, &scene, Camera::fit_to_scene(&scene, 64, 64), 96).image.rgba,
        "expected the same image in the same context"
    );
    assert!(
        first_frame.image.rgba
            == render_square(&mut open_renderer(), &scene, Camera::fit_to_scene(&scene, 64, 64), 96).image.rgba,
        "expected the same image in another context"
    );
    let mut other_camera = Camera::fit_to_scene(&scene, 64, 64);
    other_camera.lens = modalcast_model::scene::Lens::FieldOfView(33.0);
    assert!(
        first_frame.image.rgba != render_square(&mut renderer, &scene, other_camera, 96).image.rgba,
        "negative control: expected another image of another camera"
    );
}

/// Triangles without area, a sun straight above, and a camera inside the bounds of the scene.
#[test]
fn degenerate_scenes_suns_and_cameras_are_drawn() {
    let positions = vec![[0.0, 0.0, 0.0], [1.0, 1.0, 0.0], [2.0, 2.0, 0.0], [0.0, 0.0, 0.0]];
    let triangles = vec![[0, 1, 2], [0, 0, 0], [0, 3, 1]];
    let degenerate_mesh =
        Mesh::from_indexed(positions, vec![[0.0, 0.0, 1.0]; 4], vec![], triangles).expect("expected a valid mesh");
    let mut builder = default_look_builder();
    builder.parts.look.sun = [0.0, 1.0, 0.0];
    let scene = builder
        .add_domain(degenerate_mesh, Material::default())
        .add_domain(floor_mesh(2.0, 0.5), Material::default())
        .build();
    let frame = render(&scene);
    let sky = frame.pixel(0, 0);
    assert!(frame.count_pixels(|pixel| pixel != sky) > 100);
    let view = View::LookAt { eye: [0.1, 0.3, 0.1], target: [1.0, 0.5, 0.0], up: [0.0, 1.0, 0.0] };
    let frame_from_inside =
        render_square(&mut open_renderer(), &scene, Camera { view, ..Camera::fit_to_scene(&scene, 64, 64) }, 64);
    assert_eq!(frame_from_inside.image.rgba.len(), 4 * 64 * 64);
}

#[test]
fn overflowed_vertices_leave_no_black_pixels() {
    let mut builder = default_look_builder();
    builder.parts.look.horizon = [0.5; 3];
    let scene = builder.add_domain(facing_rectangle(-2.0, -2.0, 2.0, 2.0, 0.0), Material::default()).build();
    let mut renderer = open_renderer();
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    for value in [f32::NAN, f32::INFINITY, f32::MAX, -f32::MAX] {
        let mut positions: Vec<f32> = scene.shapes[0].mesh.rest_positions().as_flattened().to_vec();
        positions[6..9].fill(value); // the third vertex
        let surface = DeformedSurface { positions, normals: [0.0, 0.0, 1.0].repeat(4), ..DeformedSurface::default() };
        renderer.upload(&buffers, &surface).expect("expected the upload to succeed");
        let bounds = BoundingBox { min: [f64::NAN; 3], max: [f64::NAN; 3] };
        let params = FrameParams {
            camera: front_camera(64),
            width: 64,
            height: 64,
            bounds,
            light_bounds: None,
            edges: None,
            samples: None,
        };
        let image = renderer.draw(&buffers, &params).expect("expected a frame");
        assert!(image.rgba.chunks_exact(4).all(|pixel| pixel[..3] != [0; 3] && pixel[3] == 255), "{value}");
    }
    let short_surface = DeformedSurface { positions: vec![0.0; 3], ..DeformedSurface::default() };
    let error =
        renderer.upload(&buffers, &short_surface).expect_err("expected an error for 3 of 12 numbers").to_string();
    assert!(error.contains("expected 12 numbers of positions, got 3"), "{error}");
}

#[test]
fn scene_far_from_the_origin_is_rendered() {
    let mut parts = default_look_builder()
        .add_domain(floor_mesh(1.0, 1.0), Material::default())
        .add_domain(floor_mesh(0.5, 0.0), Material::default())
        .parts;
    for domain in &mut parts.domains {
        let mut placement = Transform::IDENTITY;
        // The translation is the last column of the row-major 3 x 4 matrix.
        (placement.0[3], placement.0[7], placement.0[11]) = (1e7, 1e7, -1e7);
        domain.placement = placement;
    }
    let scene = SceneBuilder { parts }.build();
    let frame = render_square(&mut open_renderer(), &scene, Camera::fit_to_scene(&scene, 64, 64), 64);
    assert_eq!(frame.image.rgba.len(), 4 * 64 * 64);
}

#[test]
fn renderers_work_on_separate_and_on_shared_threads() {
    let draw_frame = || {
        let scene = default_look_builder().add_domain(floor_mesh(1.0, 0.5), Material::default()).build();
        render_square(&mut open_renderer(), &scene, Camera::fit_to_scene(&scene, 64, 64), 32).image.rgba
    };
    let expected_rgba = draw_frame();
    let threads: Vec<_> = (0..4).map(|_| std::thread::spawn(move || [draw_frame(), draw_frame()])).collect();
    for thread in threads {
        assert!(thread.join().expect("expected the thread not to panic").iter().all(|bytes| *bytes == expected_rgba));
    }
    let (mut first_renderer, mut second_renderer) = (open_renderer(), open_renderer());
    let scene = default_look_builder().add_domain(floor_mesh(1.0, 0.5), Material::default()).build();
    let buffers = first_renderer.load(&scene).expect("expected the scene to load");
    assert!(
        render_square(&mut second_renderer, &scene, Camera::fit_to_scene(&scene, 64, 64), 32).image.rgba
            == expected_rgba
    );
    drop(second_renderer);
    let mut deformer = ReferenceDeformer::new(&scene);
    let bounds = deformer.deform(&SceneState::rest(&scene)).expect("expected the step to succeed").bounds;
    first_renderer
        .upload(&buffers, deformer.surface().expect("expected a surface"))
        .expect("expected the upload to succeed");
    let params = FrameParams {
        camera: Camera::fit_to_scene(&scene, 64, 64),
        width: 32,
        height: 32,
        bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    assert!(
        first_renderer.draw(&buffers, &params).expect("expected a frame").rgba == expected_rgba,
        "expected independent contexts on one thread"
    );
}

#[test]
fn devices_are_listed_and_unknown_ones_rejected() {
    let device_list = devices().expect("expected libEGL");
    assert!(device_list.iter().any(|device| device.renderer.is_some()), "{device_list:?}");
    for device in &device_list {
        assert_eq!(device.renderer.is_none(), device.problem.is_some(), "{device:?}");
    }
    // No machine has a CUDA device 4711. The error names the vendor file of NVIDIA's EGL driver, which may be missing.
    let error = Renderer::open(DevicePreference::Cuda(4711)).expect_err("expected an unknown-device error").to_string();
    assert!(error.contains("CUDA device 4711") && error.contains("10_nvidia.json"), "{error}");
    if device_list.iter().any(|device| device.software && device.renderer.is_some()) {
        assert!(Renderer::open(DevicePreference::Software).expect("expected a software renderer").info().software);
    }
}
