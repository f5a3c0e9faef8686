//! Tests of frames in flight: readback, time limits, panics and lost contexts. In these tests, the renderer does not
//! wait between passes, even on a software device.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use super::{FramePixels, MappedPixels, Renderer};
use crate::device;
use crate::device::gl::UnsharedMemory;
use crate::device::readback_ring::{MAX_FRAMES_IN_FLIGHT, ReadbackRing};
use crate::hang_guard::HANG_GUARD;
use crate::pass::Pass;
use crate::scene_data::geometry::tests::squares;
use crate::{Aov, DevicePreference, FrameImage, FrameParams, PixelReadback, SceneBuffers};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::error::Error;
use modalcast_model::memory::{MemoryBudget, MemoryKind};
use modalcast_model::scene::{Camera, Scene, Transparency};
use modalcast_model::shared_memory::PictureMemory;

/// A renderer that behaves as on hardware. A software renderer waits after every pass to time it; this one times passes
/// with queries, so that submitted frames stay in flight.
fn open() -> Renderer {
    let (mut gl, cuda_device) = device::open(DevicePreference::Any).expect("EGL");
    Rc::get_mut(&mut gl).expect("the only reference").limits.software = false;
    Renderer::new(gl, cuda_device).expect("a renderer")
}

/// An opaque square, and a glass square in front of it.
fn scene() -> Arc<Scene> {
    let glass = Material { alpha: 0.5, alpha_mode: AlphaMode::Blend, double_sided: true, ..Material::default() };
    let red = Material { diffuse: [0.9, 0.2, 0.1], double_sided: true, ..Material::default() };
    let mut parts = squares(vec![red, glass]);
    parts.look.transparency = Transparency::OrderIndependent;
    Scene::new(parts).expect("a valid scene")
}

/// Positions and normals of both squares. The glass has the width 0.25 + `extra_width`.
fn surface(extra_width: f32) -> DeformedSurface {
    let square = |z: f32, width: f32| [[0.0, 0.0, z], [width, 0.0, z], [width, 1.0, z], [0.0, 1.0, z]];
    let positions = [square(0.0, 1.0), square(0.3, 0.25 + extra_width)].concat();
    let normals = [0.0, 0.0, 1.0].repeat(positions.len());
    DeformedSurface { positions: positions.as_flattened().to_vec(), normals, ..DeformedSurface::default() }
}

pub(super) fn params(scene: &Scene, side: u32) -> FrameParams {
    let camera = Camera::fit_to_scene(scene, side, side);
    FrameParams {
        camera,
        width: side,
        height: side,
        bounds: scene.rest_bounds,
        light_bounds: None,
        edges: None,
        samples: None,
    }
}

/// Pixels of a surface drawn by a new renderer, and its number of blended fragments.
fn draw_frame(extra_width: f32) -> (Vec<u8>, u64) {
    let (mut renderer, scene) = (open(), scene());
    let buffers = renderer.load(&scene).expect("loads");
    renderer.upload(&buffers, &surface(extra_width)).expect("uploads");
    let image = renderer.draw(&buffers, &params(&scene, 64)).expect("draws");
    (image.rgba, renderer.stats().oit.expect("list statistics").fragments)
}

/// A renderer with a loaded scene and its uploaded surface.
pub(super) fn load_renderer() -> (Renderer, Arc<Scene>, SceneBuffers) {
    let (mut renderer, scene) = (open(), scene());
    let buffers = renderer.load(&scene).expect("loads");
    renderer.upload(&buffers, &surface(0.0)).expect("uploads");
    (renderer, scene, buffers)
}

#[test]
fn frames_in_flight_keep_their_vertices_and_counts() {
    let (mut renderer, scene, buffers) = load_renderer();
    let widths = [0.0, 0.2, 0.6];
    let mut pending_frames = Vec::new();
    for extra_width in widths {
        renderer.upload(&buffers, &surface(extra_width)).expect("uploads");
        pending_frames.push(renderer.submit(&buffers, &params(&scene, 64)).expect("submits"));
    }
    // Last frame first: the host may wait in any order.
    let mut frames = Vec::new();
    for extra_width in widths.into_iter().rev() {
        let pending_frame = pending_frames.pop().expect("a pending frame");
        let image = renderer.read_image(pending_frame).expect("draws");
        let (rgba, fragments) = draw_frame(extra_width);
        assert!(image.rgba == rgba, "{extra_width}");
        assert_eq!(renderer.stats().oit.expect("list statistics").fragments, fragments);
        let names: Vec<&str> = image.times.iter().map(|(key, _)| key.name()).collect();
        // The context of these tests counts as hardware.
        assert_eq!(names[..4], ["switch", "shadow", "blur", "draw"]);
        assert!(image.times.iter().all(|(_, ms)| ms.is_finite() && ms >= 0.0), "{:?}", image.times);
        frames.push((rgba, fragments));
    }
    // `frames[0]` has the widest glass.
    assert!(frames[0] != frames[1] && frames[1] != frames[2] && frames[0].1 > frames[2].1, "expected different frames");
}

#[test]
fn frames_in_flight_are_limited_per_target() {
    let (mut renderer, scene, buffers) = load_renderer();
    let params = params(&scene, 64);
    let staging_count = |renderer: &Renderer| renderer.targets.last().expect("drawn").readback_ring.count();
    for _ in 0..5 {
        renderer.draw(&buffers, &params).expect("draws");
    }
    assert_eq!(staging_count(&renderer), 1, "expected one staging buffer for frames that are read one by one");
    let unread_frames: Vec<_> =
        (0..5).map(|_| renderer.submit_without_readback(&buffers, &params).expect("submits")).collect();
    for pending_frame in unread_frames {
        assert!(renderer.read_image(pending_frame).expect("draws").rgba.is_empty());
    }
    assert_eq!(staging_count(&renderer), 1, "a frame without readback needs no staging buffer");
    let mut pending_frames: Vec<_> = (0..3).map(|_| renderer.submit(&buffers, &params).expect("submits")).collect();
    assert_eq!((staging_count(&renderer), MAX_FRAMES_IN_FLIGHT), (3, 3));
    let error = renderer.submit(&buffers, &params).expect_err("a full ring");
    assert_eq!(error, Error::Busy { queue: "frames in flight", limit: 3 });
    let smaller_params = FrameParams { width: 32, height: 32, ..params };
    renderer.draw(&buffers, &smaller_params).expect("a staging buffer of the smaller target");
    let first_image = renderer.read_image(pending_frames.remove(0)).expect("draws");
    pending_frames.push(renderer.submit(&buffers, &params).expect("a free slot"));
    drop(pending_frames.remove(0));
    pending_frames.push(renderer.submit(&buffers, &params).expect("the slot of the dropped frame"));
    for pending_frame in pending_frames {
        assert!(renderer.read_image(pending_frame).expect("draws").rgba == first_image.rgba);
    }
    // A readback of ids does not use the ring of the frames.
    assert!(!renderer.read_visibility().expect("ids of the last frame").is_empty());
}

/// Draws a frame, so that the renderer has its target, and lets later frames of this target use emulated shared
/// pictures.
fn use_emulated_pictures(renderer: &mut Renderer, buffers: &SceneBuffers, params: &FrameParams) {
    renderer.draw(buffers, params).expect("draws");
    let target = renderer.targets.last_mut().expect("drawn");
    let [_, cull_range] = target.desc.readback_ranges();
    target.readback_ring = ReadbackRing::of_emulated_pictures(&renderer.gl, cull_range.end);
}

#[test]
fn frames_in_shared_pictures_have_the_same_pixels_and_counts() {
    let (mut renderer, scene, buffers) = load_renderer();
    let params = params(&scene, 64);
    for band_samples in [u64::MAX, 64 * 16 * 4] {
        renderer.set_max_band_samples(band_samples);
        use_emulated_pictures(&mut renderer, &buffers, &params);
        let mut pending_frames = Vec::new();
        for extra_width in [0.0, 0.2, 0.6] {
            renderer.upload(&buffers, &surface(extra_width)).expect("uploads");
            pending_frames.push(renderer.submit(&buffers, &params).expect("submits"));
        }
        let error = renderer.submit(&buffers, &params).expect_err("three frames in flight");
        assert_eq!(error, Error::Busy { queue: "frames in flight", limit: 3 });
        for (pending_frame, extra_width) in pending_frames.into_iter().zip([0.0, 0.2, 0.6]) {
            while !pending_frame.is_ready() {
                thread::yield_now();
            }
            let image = renderer.read_image(pending_frame).expect("draws");
            let (rgba, fragments) = draw_frame(extra_width);
            assert!(image.rgba == rgba, "{extra_width}");
            assert_eq!(renderer.stats().oit.expect("list statistics").fragments, fragments);
        }
    }
}

#[test]
fn held_pictures_are_bounded_and_keep_their_pixels() {
    let (mut renderer, scene, buffers) = load_renderer();
    let params = params(&scene, 64);
    use_emulated_pictures(&mut renderer, &buffers, &params);
    let draw = |renderer: &mut Renderer, extra_width: f32| {
        renderer.upload(&buffers, &surface(extra_width)).expect("uploads");
        let pending_frame = renderer.submit(&buffers, &params).expect("submits");
        renderer.map_pixels(pending_frame).expect("draws").into_shared_image().rgba
    };
    let is_held = |pixels: &FramePixels| matches!(pixels, FramePixels::Held(_));
    let widths: Vec<f32> = (0..8).map(|index| 0.1 * index as f32).collect();
    let mut images: Vec<FramePixels> = widths.iter().map(|width| draw(&mut renderer, *width)).collect();
    // Of eight pictures, three remain for frames in flight.
    assert_eq!(images.iter().map(is_held).collect::<Vec<_>>(), [[true; 5].as_slice(), &[false; 3]].concat());
    for (image, width) in images.iter().zip(&widths) {
        assert!(image.as_ref() == draw_frame(*width).0, "{width}");
    }
    images.remove(0);
    assert!(is_held(&draw(&mut renderer, 0.3)), "expected a picture that a reader has returned");
}

#[test]
fn abandoned_frames_return_their_pictures() {
    let (mut renderer, scene, buffers) = load_renderer();
    let params = params(&scene, 64);
    use_emulated_pictures(&mut renderer, &buffers, &params);
    for round in 0..20 {
        let pending_frame = renderer.submit(&buffers, &params).expect("submits");
        if round % 2 == 0 {
            // Starts the copy.
            pending_frame.is_ready_within(HANG_GUARD);
        }
    }
    assert!(renderer.draw(&buffers, &params).expect("draws").rgba == draw_frame(0.0).0);
}

#[test]
fn software_renderer_refuses_shared_pictures() {
    let (mut renderer, scene, buffers) = load_renderer();
    if renderer.info().cuda_device.is_some() {
        return;
    }
    let memory = Rc::new(UnsharedMemory::default());
    renderer.share_pictures(Rc::clone(&memory) as Rc<dyn PictureMemory>).expect("no lost device");
    let PixelReadback::PixelBuffer(reason) = &renderer.info().pixel_readback else { panic!("expected a refusal") };
    assert!(reason.contains("is not a CUDA device"), "{reason}");
    assert_eq!(memory.picture_count.get(), 0);
    assert!(renderer.draw(&buffers, &params(&scene, 64)).expect("draws").rgba == draw_frame(0.0).0);
}

#[test]
fn timeout_names_the_pass_and_the_next_frame_is_drawn() {
    let (mut renderer, scene, buffers) = load_renderer();
    let params = params(&scene, 64);
    let passes = [
        Pass::Shadow,
        Pass::Blur,
        Pass::Visibility,
        Pass::AmbientOcclusion,
        Pass::Blended,
        Pass::Shade,
        Pass::Bloom,
        Pass::Encode,
        Pass::Read,
    ];
    for failing_index in 0..passes.len() {
        let mut pending_frame = renderer.submit(&buffers, &params).expect("submits");
        renderer.gl.wait("test", HANG_GUARD).expect("a finished frame");
        let timed: Vec<Pass> = pending_frame.passes.iter().map(|(pass, _)| *pass).collect();
        assert_eq!(timed, passes);
        // As if the device had stopped in the pass `failing_index`.
        pending_frame.fence = renderer.gl.broken_fence();
        for (_, timer) in &mut pending_frame.passes[failing_index..] {
            *timer = renderer.gl.unstarted_timer();
        }
        assert!(pending_frame.is_ready(), "reading a frame that timed out must not wait");
        let Err(Error::Fault { stage, reason }) = renderer.read_image(pending_frame) else {
            panic!("expected a fault")
        };
        assert_eq!(stage, passes[failing_index].name());
        let last = if failing_index == 0 { "none".to_owned() } else { format!("'{}'", passes[failing_index - 1]) };
        assert!(reason.ends_with(&format!("; last finished pass: {last}")), "{reason}");
        // Discards the errors of reading timers that were never started.
        renderer.gl.check("test").ok();
        renderer.draw(&buffers, &params).expect("draws");
    }
}

#[test]
fn failed_frame_drops_its_render_target() {
    let (mut renderer, scene, mut buffers) = load_renderer();
    let params = params(&scene, 64);
    let expected_rgba = renderer.draw(&buffers, &params).expect("draws").rgba;
    // Without its programs, the blur fails.
    let blur_programs = std::mem::take(&mut buffers.programs.blur);
    let Err(Error::Fault { stage, .. }) = renderer.draw(&buffers, &params) else { panic!("expected a fault") };
    assert_eq!((stage, renderer.targets.len()), ("blur", 0));
    buffers.programs.blur = blur_programs;
    assert!(renderer.draw(&buffers, &params).expect("draws again").rgba == expected_rgba);
}

#[test]
fn reading_a_frame_beyond_its_time_limit_does_not_wait() {
    let (mut renderer, scene, buffers) = load_renderer();
    renderer.frame_timeout = Duration::from_millis(5);
    let pending_frame = renderer.submit_without_readback(&buffers, &params(&scene, 64)).expect("submits");
    // The clock starts at the first poll.
    pending_frame.is_ready();
    thread::sleep(Duration::from_millis(6));
    assert!(pending_frame.time_left().is_zero() && pending_frame.is_ready_within(HANG_GUARD));
}

#[test]
fn frame_is_readable_after_its_target_was_freed() {
    let (mut renderer, scene, buffers) = load_renderer();
    let pending_frame = renderer.submit(&buffers, &params(&scene, 64)).expect("submits");
    // Eight targets, more than the cache holds.
    for side in 32..40 {
        renderer.draw(&buffers, &params(&scene, side)).expect("draws");
    }
    assert!(renderer.targets.iter().all(|target| target.desc.width != 64));
    let pixels = renderer.map_pixels(pending_frame).expect("draws");
    renderer.draw(&buffers, &params(&scene, 41)).expect("draws while the pixels are mapped");
    // The staging buffer of the freed target lives until its pixels are copied.
    assert_eq!(renderer.gl.retired_buffer_count(), 1);
    assert!(pixels.into_image().rgba == draw_frame(0.0).0);
    renderer.draw(&buffers, &params(&scene, 42)).expect("draws");
    assert_eq!(renderer.gl.retired_buffer_count(), 0);
}

#[test]
fn mapped_pixels_outlive_the_renderer() {
    let (mut renderer, scene, buffers) = load_renderer();
    let pending_frame = renderer.submit(&buffers, &params(&scene, 64)).expect("submits");
    let pixels = renderer.map_pixels(pending_frame).expect("draws");
    drop(renderer);
    drop(buffers);
    assert!(pixels.into_image().rgba == draw_frame(0.0).0);
}

#[test]
fn threads_copy_pixels_while_the_renderer_is_dropped() {
    let (expected_rgba, _) = draw_frame(0.0);
    let (mut renderer, scene, buffers) = load_renderer();
    let params = params(&scene, 64);
    let spawn_reader = |renderer: &mut Renderer, buffers: &SceneBuffers| {
        let pending_frame = renderer.submit(buffers, &params).expect("submits");
        let pixels = renderer.map_pixels(pending_frame).expect("draws");
        thread::spawn(move || {
            thread::sleep(Duration::from_millis(50));
            pixels.into_image()
        })
    };
    // A ring has three staging buffers, so the fourth frame waits until a thread has copied the first.
    let readers: Vec<_> = (0..4).map(|_| spawn_reader(&mut renderer, &buffers)).collect();
    renderer.unload(buffers);
    drop(renderer);
    for reader in readers {
        let FrameImage { rgba, .. } = reader.join().expect("no panic");
        assert!(rgba == expected_rgba);
    }
}

#[test]
fn submit_times_out_while_all_staging_buffers_are_mapped() {
    let (mut renderer, scene, buffers) = load_renderer();
    renderer.frame_timeout = HANG_GUARD;
    let params = params(&scene, 64);
    let mut mapped_frames = Vec::new();
    for _ in 0..3 {
        let pending_frame = renderer.submit(&buffers, &params).expect("submits");
        mapped_frames.push(renderer.map_pixels(pending_frame).expect("draws"));
    }
    renderer.frame_timeout = Duration::from_millis(20);
    assert!(matches!(renderer.submit(&buffers, &params), Err(Error::Busy { .. })));
    renderer.frame_timeout = HANG_GUARD;
    let images: Vec<FrameImage> = mapped_frames.into_iter().map(MappedPixels::into_image).collect();
    let last_image = renderer.draw(&buffers, &params).expect("draws");
    assert!(images.iter().all(|image| image.rgba == last_image.rgba));
}

/// The panic happens while the context is current, a timer query is active and a target is in use.
#[test]
fn other_scenes_are_drawn_after_a_panic_within_a_frame() {
    let (mut renderer, scene, buffers) = load_renderer();
    let expected_rgba = renderer.draw(&buffers, &params(&scene, 64)).expect("draws").rgba;
    let mut parts = squares(vec![Material { double_sided: true, ..Material::default() }]);
    parts.look.samples = 1;
    let panicking_scene = Scene::new(parts).expect("a valid scene");
    let panicking_buffers = renderer.load(&panicking_scene).expect("loads");
    // A second renderer, whose context is current before and after each frame of the first.
    let (mut other_renderer, _, other_buffers) = load_renderer();
    // More panics than frames fit into the ring, so that leaked slots would be noticed.
    for _ in 0..MAX_FRAMES_IN_FLIGHT + 2 {
        renderer.injected_panic = Some(Pass::Shade);
        let result =
            catch_unwind(AssertUnwindSafe(|| renderer.draw(&panicking_buffers, &params(&panicking_scene, 64))));
        assert!(result.is_err(), "expected the injected panic");
        renderer.injected_panic = None;
        renderer.gl.check("test").expect("no OpenGL error");
        assert!(renderer.draw(&buffers, &params(&scene, 64)).expect("draws").rgba == expected_rgba);
        assert!(other_renderer.draw(&other_buffers, &params(&scene, 64)).expect("draws").rgba == expected_rgba);
    }
}

/// An occupied context is current on another thread.
#[test]
fn calls_fail_while_the_context_is_occupied_and_work_afterwards() {
    let (mut renderer, scene, buffers) = load_renderer();
    let expected_rgba = renderer.draw(&buffers, &params(&scene, 64)).expect("draws").rgba;
    let (mut other_renderer, _, other_buffers) = load_renderer();
    let in_flight = renderer.submit(&buffers, &params(&scene, 64)).expect("submits");
    let occupied_context = renderer.gl.occupy();
    let errors = [
        renderer.draw(&buffers, &params(&scene, 64)).err(),
        renderer.upload(&buffers, &surface(0.5)).err(),
        renderer.load(&scene).err(),
        renderer.read_image(in_flight).err(),
    ];
    for error in errors {
        let error = error.expect("an error without a context").to_string();
        assert!(error.contains("eglMakeCurrent"), "{error}");
    }
    assert!(other_renderer.draw(&other_buffers, &params(&scene, 64)).expect("draws").rgba == expected_rgba);
    drop(occupied_context);
    assert!(
        renderer.draw(&buffers, &params(&scene, 64)).expect("draws").rgba == expected_rgba,
        "expected no effect of the failed upload"
    );
}

#[test]
fn render_targets_stay_within_their_budget() {
    let (mut renderer, scene, buffers) = load_renderer();
    renderer.draw(&buffers, &params(&scene, 64)).expect("draws");
    let bytes = renderer.targets[0].desc.bytes();
    renderer.targets.clear();
    let budget = MemoryBudget::new(MemoryKind::RenderTargets, bytes, bytes);
    renderer.set_target_budget(Arc::clone(&budget));
    // Each target replaces the one before.
    for side in [64, 63, 64] {
        renderer.draw(&buffers, &params(&scene, side)).expect("draws");
        assert_eq!(renderer.targets.len(), 1);
    }
    assert_eq!(budget.reserved(), bytes);
    let result = renderer.draw(&buffers, &params(&scene, 512)).map(drop);
    assert!(matches!(result, Err(Error::OutOfMemory { asked, total, .. }) if asked > total), "{result:?}");
    renderer.render_aov(&buffers, &params(&scene, 64), Aov::Depth).expect("replaces the target of the frame");
    assert!(renderer.targets.is_empty() && renderer.has_targets() && budget.reserved() < bytes);
    renderer.draw(&buffers, &params(&scene, 64)).expect("replaces the target of the AOV");
    assert_eq!(budget.reserved(), bytes);
    renderer.free_unused_targets(Duration::ZERO).expect("frees");
    assert_eq!((renderer.has_targets(), budget.reserved()), (false, 0));
}
