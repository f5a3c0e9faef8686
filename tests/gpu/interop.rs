//! CUDA copies vertices into OpenGL's buffers on the device. Images equal those of vertices that pass through the host.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, Device};
use modalcast_model::deform::{Deformer, VertexAttributes};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};
use modalcast_model::scene::{Camera, Scene};
use modalcast_render::{FrameParams, MAX_FRAMES_IN_FLIGHT, Renderer};

use crate::accuracy::{assert_equals_reference, have_equal_bits};
use crate::gl::Exclusive;
use crate::scenes;

/// Opens a deformer that can fill `buffers`. With `None` its vertices must be uploaded.
fn open_deformer(device: &Arc<Device>, scene: &Arc<Scene>, buffers: Option<GlVertexBuffers>) -> CudaDeformer {
    let options = CudaDeformerOptions::with_bounding_axes(scene.light_axes());
    CudaDeformer::new(device, scene, buffers, options).expect("expected a CUDA deformer")
}

/// Opens a renderer and a CUDA device, and creates a scene with normal maps.
fn open_renderer() -> (Exclusive<Renderer>, Arc<Device>, Arc<Scene>) {
    let renderer = Exclusive::renderer();
    let scene = scenes::random_scene(
        &[(3000, 12), (50, 0), (7, 3)],
        scenes::RandomSceneOptions { instances: 5, normal_maps: true, rigid_transforms: false },
    );
    (renderer, Device::open(0).expect("expected a CUDA device"), scene)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_vertices_are_read_back_while_buffers_are_filled() {
    let (mut renderer, device, scene) = open_renderer();
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    let mut filling_deformer = open_deformer(&device, &scene, Some(buffers.vertex_buffers()));
    let mut uploading_deformer = open_deformer(&device, &scene, None);
    assert!(filling_deformer.fills_gl_buffers() && !uploading_deformer.fills_gl_buffers());
    assert!(uploading_deformer.fill_gl_buffers().is_err(), "expected no buffers to fill");
    let mut pending = None;
    for seed in 0..50 {
        let state = scenes::random_state(&scene, seed);
        filling_deformer.deform(&state).expect("expected the step to succeed");
        filling_deformer.fill_gl_buffers().expect("expected filled buffers");
        uploading_deformer.deform(&state).expect("expected the step to succeed");
        let want = uploading_deformer.surface().expect("expected a surface").clone();
        // The readback of this step, and the surface that it must return.
        let readback_and_surface = (
            filling_deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS).expect("expected a readback to start"),
            want,
        );
        if let Some((readback, want)) = pending.replace(readback_and_surface) {
            let got = filling_deformer.wait_readback(&readback).expect("expected the readback to complete");
            assert!(have_equal_bits(&got.positions, &want.positions), "the step before step {seed}");
            assert!(have_equal_bits(&got.normals, &want.normals), "the step before step {seed}");
            let current = &pending.as_ref().expect("expected a pending readback").1;
            assert!(
                !have_equal_bits(&got.positions, &current.positions),
                "step {seed}: expected other positions than those of the step before"
            );
        }
    }
    assert_eq!(filling_deformer.outputs(), 2, "expected a second output for steps during a readback");
    drop(filling_deformer);
    renderer.unload(buffers);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_of_filled_and_uploaded_buffers_are_equal() {
    let (mut renderer, device, scene) = open_renderer();
    let (state, other_state) = (scenes::random_state(&scene, 1), scenes::random_state(&scene, 2));
    let (filled_scene, uploaded_scene) = (
        renderer.load(&scene).expect("expected the scene to load"),
        renderer.load(&scene).expect("expected the scene to load"),
    );
    let mut filling_deformer = open_deformer(&device, &scene, Some(filled_scene.vertex_buffers()));
    let bounds = filling_deformer.deform(&state).expect("expected the step to succeed").bounds;
    filling_deformer.fill_gl_buffers().expect("expected filled buffers");
    // A camera for a square image also shows the scene in other sizes.
    let params = FrameParams {
        camera: Camera::fit_to_scene(&scene, 64, 64),
        width: 320,
        height: 240,
        bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    let frame = renderer.draw(&filled_scene, &params).expect("expected a frame");
    renderer
        .upload(&uploaded_scene, filling_deformer.surface().expect("expected a surface"))
        .expect("expected the upload to succeed");
    let uploaded_frame = renderer.draw(&uploaded_scene, &params).expect("expected a frame");
    assert_eq!(frame.rgba, uploaded_frame.rgba, "expected the same image of uploaded vertices");
    let repeated_frame = renderer.draw(&filled_scene, &params).expect("expected a frame");
    assert_eq!(frame.rgba, repeated_frame.rgba, "expected the same image after reading the surface");
    filling_deformer.deform(&other_state).expect("expected the step to succeed");
    filling_deformer.fill_gl_buffers().expect("expected filled buffers");
    let moved_frame = renderer.draw(&filled_scene, &params).expect("expected a frame");
    assert_ne!(frame.rgba, moved_frame.rgba, "expected another image of another state");
    drop(filling_deformer);
    renderer.unload(filled_scene);
    renderer.unload(uploaded_scene);
}

/// Later steps fill the buffers while the frames are in flight.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_in_flight_keep_the_vertices_of_their_step() {
    let (mut renderer, device, scene) = open_renderer();
    let (filled_scene, uploaded_scene) = (
        renderer.load(&scene).expect("expected the scene to load"),
        renderer.load(&scene).expect("expected the scene to load"),
    );
    let mut filling_deformer = open_deformer(&device, &scene, Some(filled_scene.vertex_buffers()));
    let mut uploading_deformer = open_deformer(&device, &scene, None);
    assert!(filling_deformer.fills_gl_buffers());
    // A large image, so that a frame takes longer than a step.
    let params = |bounds| FrameParams {
        camera: Camera::fit_to_scene(&scene, 64, 64),
        width: 1920,
        height: 1080,
        bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    };
    let (mut frames, mut expected_images) = (std::collections::VecDeque::new(), Vec::new());
    let mut images = Vec::new();
    for seed in 0..30 {
        let state = scenes::random_state(&scene, seed);
        if frames.len() == MAX_FRAMES_IN_FLIGHT {
            images.extend(frames.pop_front().map(|frame| renderer.read_image(frame).expect("expected a frame").rgba));
        }
        let bounds = filling_deformer.deform(&state).expect("expected the step to succeed").bounds;
        filling_deformer.fill_gl_buffers().expect("expected filled buffers");
        frames.push_back(renderer.submit(&filled_scene, &params(bounds)).expect("expected the frame to start"));
    }
    images.extend(frames.into_iter().map(|frame| renderer.read_image(frame).expect("expected a frame").rgba));
    for seed in 0..30 {
        let bounds = uploading_deformer
            .deform(&scenes::random_state(&scene, seed))
            .expect("expected the step to succeed")
            .bounds;
        renderer
            .upload(&uploaded_scene, uploading_deformer.surface().expect("expected a surface"))
            .expect("expected the upload to succeed");
        expected_images.push(renderer.draw(&uploaded_scene, &params(bounds)).expect("expected a frame").rgba);
    }
    for (seed, (image, want)) in images.iter().zip(&expected_images).enumerate() {
        let different = image.iter().zip(want).filter(|(a, b)| a != b).count();
        let largest = image.iter().zip(want).map(|(a, b)| a.abs_diff(*b)).max();
        let equal_steps: Vec<usize> =
            (0..expected_images.len()).filter(|other| *image == expected_images[*other]).collect();
        assert!(
            image == want,
            "step {seed}: {different} numbers differ, by at most {largest:?}; the image is that of the steps {equal_steps:?}"
        );
    }
    assert!(
        images.len() == 30 && expected_images.windows(2).all(|pair| pair[0] != pair[1]),
        "expected different images of successive states"
    );
    drop(filling_deformer);
    renderer.unload(filled_scene);
    renderer.unload(uploaded_scene);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_unknown_or_small_buffers_are_not_filled() {
    let (mut renderer, device, scene) = open_renderer();
    let small_scene = renderer
        .load(&scenes::random_scene(
            &[(4, 0)],
            scenes::RandomSceneOptions { instances: 1, normal_maps: true, rigid_transforms: false },
        ))
        .expect("expected the scene to load");
    let loaded_scene = renderer.load(&scene).expect("expected the scene to load");
    let GlVertexBuffers { positions, normals, .. } = loaded_scene.vertex_buffers();
    let unknown_buffers = GlVertexBuffers {
        positions: GlBuffer { name: 999_999, ..positions.clone() },
        normals: GlBuffer { name: 999_998, ..normals },
        tangents: Some(GlBuffer { name: 999_997, ..positions }),
        importer: None,
    };
    let without_tangents = GlVertexBuffers { tangents: None, ..loaded_scene.vertex_buffers() };
    for buffers in [small_scene.vertex_buffers(), unknown_buffers, without_tangents] {
        let mut deformer = open_deformer(&device, &scene, Some(buffers.clone()));
        assert!(!deformer.fills_gl_buffers(), "{buffers:?}");
        assert_equals_reference("rejected buffers", &scene, &scenes::random_state(&scene, 3), &mut deformer);
    }
    let mut filling_deformer = open_deformer(&device, &scene, Some(loaded_scene.vertex_buffers()));
    assert!(filling_deformer.fills_gl_buffers(), "expected accepted buffers after rejected ones");
    assert_equals_reference("after rejected buffers", &scene, &scenes::random_state(&scene, 3), &mut filling_deformer);
}
