//! CUDA writes into OpenGL buffers: vertices and pictures equal those with a copy.

use std::sync::Arc;

use modalcast_compute::gpu::{CudaDeformer, Device};
use modalcast_model::deform::{Deformer, VertexAttributes};
use modalcast_model::raster::{GlBuffer, GlVertexBuffers};
use modalcast_model::scene::{Camera, Scene};
use modalcast_render::{DevicePreference, FrameParams, MAX_FRAMES_IN_FLIGHT, Renderer, SceneBuffers};

use crate::accuracy::{check, same_bits};
use crate::scenes;

fn shared(buffers: &SceneBuffers) -> GlVertexBuffers {
    buffers.vertex_buffers().expect("buffers")
}

fn stage() -> (Renderer, Arc<Device>, Arc<Scene>) {
    let renderer = Renderer::open(DevicePreference::Cuda(0)).expect("OpenGL on the CUDA device");
    let scene = scenes::scene(&[(3000, 12), (50, 0), (7, 3)], 5, true, false);
    (renderer, Device::open(0).expect("a CUDA device"), scene)
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shared_buffers_have_the_bits_of_copied_ones() {
    let (mut renderer, device, scene) = stage();
    let buffers = renderer.load(&scene).expect("loads");
    let mut direct = CudaDeformer::new(&device, &scene, Some(shared(&buffers))).expect("a deformer");
    let mut copied = CudaDeformer::new(&device, &scene, None).expect("a deformer");
    assert!(direct.shares_buffers(), "interop was refused");
    assert!(!copied.shares_buffers());
    for seed in 0..3 {
        let state = scenes::state(&scene, seed);
        let shown = check("shared buffers", &scene, &state, &mut direct);
        let bounds = copied.deform(&state).expect("deforms").bounds;
        assert_eq!(shown.bounds, bounds);
        let (direct, copied) = (direct.surface().expect("copies"), copied.surface().expect("copies"));
        assert!(same_bits(&direct.positions, &copied.positions));
        assert!(same_bits(&direct.normals, &copied.normals));
        assert!(same_bits(&direct.tangents, &copied.tangents));
    }
    drop(direct);
    renderer.unload(buffers);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_shared_buffers_are_fetched_during_the_next_step() {
    let (mut renderer, device, scene) = stage();
    let buffers = renderer.load(&scene).expect("loads");
    let mut direct = CudaDeformer::new(&device, &scene, Some(shared(&buffers))).expect("a deformer");
    let mut plain = CudaDeformer::new(&device, &scene, None).expect("a deformer");
    assert!(direct.shares_buffers(), "interop was refused");
    let mut before = None;
    for seed in 0..50 {
        let state = scenes::state(&scene, seed);
        direct.deform(&state).expect("deforms");
        plain.deform(&state).expect("deforms");
        let want = plain.surface().expect("copies").clone();
        let next = (direct.readback(VertexAttributes::VERTICES).expect("begins"), want);
        if let Some((readback, want)) = before.replace(next) {
            let got = direct.wait_readback(&readback).expect("arrives");
            assert!(same_bits(&got.positions, &want.positions), "step {seed}");
            assert!(same_bits(&got.normals, &want.normals), "step {seed}");
            let now = &before.as_ref().expect("there").1;
            assert!(!same_bits(&got.positions, &now.positions), "the judge can fail");
        }
    }
    assert_eq!(direct.outputs(), 1, "OpenGL draws from the one there is");
    drop(direct);
    renderer.unload(buffers);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_of_shared_and_uploaded_buffers_are_equal() {
    let (mut renderer, device, scene) = stage();
    let (state, other) = (scenes::state(&scene, 1), scenes::state(&scene, 2));
    let (to_share, to_fill) = (renderer.load(&scene).expect("loads"), renderer.load(&scene).expect("loads"));
    let mut direct = CudaDeformer::new(&device, &scene, Some(shared(&to_share))).expect("a deformer");
    let bounds = direct.deform(&state).expect("deforms").bounds;
    let shot =
        FrameParams { camera: Camera::fit_to_scene(&scene, 64, 64), width: 320, height: 240, bounds, light: None };
    let shown = renderer.draw(&to_share, &shot).expect("draws");
    renderer.upload(&to_fill, direct.surface().expect("copies")).expect("uploads");
    let uploaded = renderer.draw(&to_fill, &shot).expect("draws");
    assert_eq!(shown.rgba, uploaded.rgba, "reading the surface leaves the picture");
    let again = renderer.draw(&to_share, &shot).expect("draws");
    assert_eq!(shown.rgba, again.rgba, "a copy of the surface does not disturb the shared buffers");
    direct.deform(&other).expect("deforms");
    let moved = renderer.draw(&to_share, &shot).expect("draws");
    assert_ne!(shown.rgba, moved.rgba, "the judge can fail");
    drop(direct);
    renderer.unload(to_share);
    renderer.unload(to_fill);
}

/// Later steps overwrite the shared buffers while the frames are in flight.
#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_frames_in_flight_keep_the_vertices_of_their_step() {
    let (mut renderer, device, scene) = stage();
    let (to_share, to_fill) = (renderer.load(&scene).expect("loads"), renderer.load(&scene).expect("loads"));
    let mut direct = CudaDeformer::new(&device, &scene, Some(shared(&to_share))).expect("a deformer");
    let mut copied = CudaDeformer::new(&device, &scene, None).expect("a deformer");
    assert!(direct.shares_buffers(), "interop was refused");
    // A large picture, so that a frame takes longer than a step.
    let shot = |bounds| FrameParams {
        camera: Camera::fit_to_scene(&scene, 64, 64),
        width: 1920,
        height: 1080,
        bounds,
        light: None,
    };
    let (mut frames, mut wanted) = (std::collections::VecDeque::new(), Vec::new());
    let mut images = Vec::new();
    for seed in 0..30 {
        let state = scenes::state(&scene, seed);
        if frames.len() == MAX_FRAMES_IN_FLIGHT {
            images.extend(frames.pop_front().map(|frame| renderer.read_image(frame).expect("draws").rgba));
        }
        let bounds = direct.deform(&state).expect("deforms").bounds;
        frames.push_back(renderer.submit(&to_share, &shot(bounds)).expect("submits"));
    }
    images.extend(frames.into_iter().map(|frame| renderer.read_image(frame).expect("draws").rgba));
    for seed in 0..30 {
        let bounds = copied.deform(&scenes::state(&scene, seed)).expect("deforms").bounds;
        renderer.upload(&to_fill, copied.surface().expect("copies")).expect("uploads");
        wanted.push(renderer.draw(&to_fill, &shot(bounds)).expect("draws").rgba);
    }
    for (seed, (image, want)) in images.iter().zip(&wanted).enumerate() {
        assert!(image == want, "step {seed}");
    }
    assert!(images.len() == 30 && wanted.windows(2).all(|pair| pair[0] != pair[1]), "the judge can fail");
    drop(direct);
    renderer.unload(to_share);
    renderer.unload(to_fill);
}

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_unknown_or_small_buffers_fall_back_to_copies() {
    let (mut renderer, device, scene) = stage();
    let small = renderer.load(&scenes::scene(&[(4, 0)], 1, true, false)).expect("loads");
    let good = renderer.load(&scene).expect("loads");
    let GlVertexBuffers { positions, normals, .. } = shared(&good);
    let unknown = GlVertexBuffers {
        positions: GlBuffer { name: 999_999, ..positions.clone() },
        normals: GlBuffer { name: 999_998, ..normals },
        tangents: Some(GlBuffer { name: 999_997, ..positions }),
    };
    let without_tangents = GlVertexBuffers { tangents: None, ..shared(&good) };
    for buffers in [shared(&small), unknown, without_tangents] {
        let mut deformer = CudaDeformer::new(&device, &scene, Some(buffers.clone())).expect("a deformer");
        assert!(!deformer.shares_buffers(), "{buffers:?}");
        check("fallen back", &scene, &scenes::state(&scene, 3), &mut deformer);
    }
    let mut direct = CudaDeformer::new(&device, &scene, Some(shared(&good))).expect("a deformer");
    assert!(direct.shares_buffers(), "refusals leave nothing behind");
    check("after refusals", &scene, &scenes::state(&scene, 3), &mut direct);
}
