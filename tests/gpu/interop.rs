//! CUDA writes vertices into buffers that it shares with OpenGL. Vertices and images equal those of a deformer with
//! buffers of its own, whose vertices are copied to OpenGL. An output is a set of device buffers for the vertices of
//! one step.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, CudaDeformerOptions, Device};
use modalcast_model::deform::{Deformer, VertexAttributes};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};
use modalcast_model::scene::{Camera, Scene};
use modalcast_render::{DevicePreference, FrameParams, MAX_FRAMES_IN_FLIGHT, Renderer};

use crate::accuracy::{assert_equals_reference, have_equal_bits};
use crate::scenes;

/// Opens a deformer that writes into `buffers`, or, with `None`, into memory of its own.
fn open_deformer(device: &Arc<Device>, scene: &Arc<Scene>, buffers: Option<GlVertexBuffers>) -> CudaDeformer {
    let options = CudaDeformerOptions::with_bounding_axes(scene.light_axes());
    CudaDeformer::new(device, scene, buffers, options).expect("expected a CUDA deformer")
}

/// Opens a renderer and a CUDA device, and creates a scene with normal maps.
fn open_renderer() -> (Renderer, Arc<Device>, Arc<Scene>) {
    let renderer = Renderer::open(DevicePreference::Cuda(0)).expect("expected an OpenGL context on the CUDA device");
    let scene = scenes::random_scene(
        &[(3000, 12), (50, 0), (7, 3)],
        scenes::RandomSceneOptions { instances: 5, normal_maps: true, rigid_transforms: false },
    );
    (renderer, Device::open(0).expect("expected a CUDA device"), scene)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shared_buffers_have_the_bits_of_copied_buffers() {
    let (mut renderer, device, scene) = open_renderer();
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    let mut sharing_deformer = open_deformer(&device, &scene, Some(buffers.vertex_buffers()));
    let mut copying_deformer = open_deformer(&device, &scene, None);
    assert!(sharing_deformer.shares_buffers(), "expected shared buffers");
    assert!(!copying_deformer.shares_buffers());
    for seed in 0..3 {
        let state = scenes::random_state(&scene, seed);
        let summary = assert_equals_reference("shared buffers", &scene, &state, &mut sharing_deformer);
        let bounds = copying_deformer.deform(&state).expect("expected the step to succeed").bounds;
        assert_eq!(summary.bounds, bounds);
        let shared_surface = sharing_deformer.surface().expect("expected a surface");
        let copied_surface = copying_deformer.surface().expect("expected a surface");
        assert!(have_equal_bits(&shared_surface.positions, &copied_surface.positions));
        assert!(have_equal_bits(&shared_surface.normals, &copied_surface.normals));
        assert!(have_equal_bits(&shared_surface.tangents, &copied_surface.tangents));
    }
    drop(sharing_deformer);
    renderer.unload(buffers);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shared_buffers_are_read_back_during_the_next_step() {
    let (mut renderer, device, scene) = open_renderer();
    let buffers = renderer.load(&scene).expect("expected the scene to load");
    let mut sharing_deformer = open_deformer(&device, &scene, Some(buffers.vertex_buffers()));
    let mut copying_deformer = open_deformer(&device, &scene, None);
    assert!(sharing_deformer.shares_buffers(), "expected shared buffers");
    let mut pending = None;
    for seed in 0..50 {
        let state = scenes::random_state(&scene, seed);
        sharing_deformer.deform(&state).expect("expected the step to succeed");
        copying_deformer.deform(&state).expect("expected the step to succeed");
        let want = copying_deformer.surface().expect("expected a surface").clone();
        // The readback of this step, and the surface that it must return.
        let readback_and_surface = (
            sharing_deformer.readback(VertexAttributes::POSITIONS_AND_NORMALS).expect("expected a readback to start"),
            want,
        );
        if let Some((readback, want)) = pending.replace(readback_and_surface) {
            let got = sharing_deformer.wait_readback(&readback).expect("expected the readback to complete");
            assert!(have_equal_bits(&got.positions, &want.positions), "the step before step {seed}");
            assert!(have_equal_bits(&got.normals, &want.normals), "the step before step {seed}");
            let current = &pending.as_ref().expect("expected a pending readback").1;
            assert!(
                !have_equal_bits(&got.positions, &current.positions),
                "step {seed}: expected other positions than those of the step before"
            );
        }
    }
    assert_eq!(sharing_deformer.outputs(), 1, "expected no second output, because OpenGL draws from the first");
    drop(sharing_deformer);
    renderer.unload(buffers);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_of_shared_and_uploaded_buffers_are_equal() {
    let (mut renderer, device, scene) = open_renderer();
    let (state, other_state) = (scenes::random_state(&scene, 1), scenes::random_state(&scene, 2));
    let (shared_scene, uploaded_scene) = (
        renderer.load(&scene).expect("expected the scene to load"),
        renderer.load(&scene).expect("expected the scene to load"),
    );
    let mut sharing_deformer = open_deformer(&device, &scene, Some(shared_scene.vertex_buffers()));
    let bounds = sharing_deformer.deform(&state).expect("expected the step to succeed").bounds;
    // A camera for a square image also shows the scene in other sizes.
    let params = FrameParams {
        camera: Camera::fit_to_scene(&scene, 64, 64),
        width: 320,
        height: 240,
        bounds,
        light_bounds: None,
    };
    let frame = renderer.draw(&shared_scene, &params).expect("expected a frame");
    renderer
        .upload(&uploaded_scene, sharing_deformer.surface().expect("expected a surface"))
        .expect("expected the upload to succeed");
    let uploaded_frame = renderer.draw(&uploaded_scene, &params).expect("expected a frame");
    assert_eq!(frame.rgba, uploaded_frame.rgba, "expected the same image of uploaded vertices");
    let repeated_frame = renderer.draw(&shared_scene, &params).expect("expected a frame");
    assert_eq!(frame.rgba, repeated_frame.rgba, "expected the same image after reading the surface");
    sharing_deformer.deform(&other_state).expect("expected the step to succeed");
    let moved_frame = renderer.draw(&shared_scene, &params).expect("expected a frame");
    assert_ne!(frame.rgba, moved_frame.rgba, "expected another image of another state");
    drop(sharing_deformer);
    renderer.unload(shared_scene);
    renderer.unload(uploaded_scene);
}

/// Later steps overwrite the shared buffers while the frames are in flight.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_in_flight_keep_the_vertices_of_their_step() {
    let (mut renderer, device, scene) = open_renderer();
    let (shared_scene, uploaded_scene) = (
        renderer.load(&scene).expect("expected the scene to load"),
        renderer.load(&scene).expect("expected the scene to load"),
    );
    let mut sharing_deformer = open_deformer(&device, &scene, Some(shared_scene.vertex_buffers()));
    let mut copying_deformer = open_deformer(&device, &scene, None);
    assert!(sharing_deformer.shares_buffers(), "expected shared buffers");
    // A large image, so that a frame takes longer than a step.
    let params = |bounds| FrameParams {
        camera: Camera::fit_to_scene(&scene, 64, 64),
        width: 1920,
        height: 1080,
        bounds,
        light_bounds: None,
    };
    let (mut frames, mut expected_images) = (std::collections::VecDeque::new(), Vec::new());
    let mut images = Vec::new();
    for seed in 0..30 {
        let state = scenes::random_state(&scene, seed);
        if frames.len() == MAX_FRAMES_IN_FLIGHT {
            images.extend(frames.pop_front().map(|frame| renderer.read_image(frame).expect("expected a frame").rgba));
        }
        let bounds = sharing_deformer.deform(&state).expect("expected the step to succeed").bounds;
        frames.push_back(renderer.submit(&shared_scene, &params(bounds)).expect("expected the frame to start"));
    }
    images.extend(frames.into_iter().map(|frame| renderer.read_image(frame).expect("expected a frame").rgba));
    for seed in 0..30 {
        let bounds =
            copying_deformer.deform(&scenes::random_state(&scene, seed)).expect("expected the step to succeed").bounds;
        renderer
            .upload(&uploaded_scene, copying_deformer.surface().expect("expected a surface"))
            .expect("expected the upload to succeed");
        expected_images.push(renderer.draw(&uploaded_scene, &params(bounds)).expect("expected a frame").rgba);
    }
    for (seed, (image, want)) in images.iter().zip(&expected_images).enumerate() {
        assert!(image == want, "step {seed}");
    }
    assert!(
        images.len() == 30 && expected_images.windows(2).all(|pair| pair[0] != pair[1]),
        "expected different images of successive states"
    );
    drop(sharing_deformer);
    renderer.unload(shared_scene);
    renderer.unload(uploaded_scene);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_unknown_or_small_buffers_fall_back_to_copies() {
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
    };
    let without_tangents = GlVertexBuffers { tangents: None, ..loaded_scene.vertex_buffers() };
    for buffers in [small_scene.vertex_buffers(), unknown_buffers, without_tangents] {
        let mut deformer = open_deformer(&device, &scene, Some(buffers.clone()));
        assert!(!deformer.shares_buffers(), "{buffers:?}");
        assert_equals_reference("copied buffers", &scene, &scenes::random_state(&scene, 3), &mut deformer);
    }
    let mut sharing_deformer = open_deformer(&device, &scene, Some(loaded_scene.vertex_buffers()));
    assert!(sharing_deformer.shares_buffers(), "expected shared buffers after rejected ones");
    assert_equals_reference("after rejected buffers", &scene, &scenes::random_state(&scene, 3), &mut sharing_deformer);
}
