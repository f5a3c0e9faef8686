//! Tests of frames in flight, with a renderer that does not wait between passes, like one on hardware.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::Arc;
use std::thread;
use std::time::Duration;

use super::{MappedPixels, Renderer};
use crate::device;
use crate::device::readback_ring::MAX_FRAMES_IN_FLIGHT;
use crate::pass::Pass;
use crate::scene_data::geometry::tests::squares;
use crate::{DevicePreference, FrameImage, FrameParams, SceneBuffers};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::domain::{AlphaMode, Material};
use modalcast_model::error::{Error, Result};
use modalcast_model::raster::{DrawTarget, Rasterizer};
use modalcast_model::scene::{Camera, Scene, Transparency};

/// A renderer that times its passes with queries on any device, so that its frames are in flight after they were
/// submitted.
fn open() -> Renderer {
    let (mut gl, cuda_device) = device::open(DevicePreference::Any).expect("EGL");
    Rc::get_mut(&mut gl).expect("not shared yet").limits.software = false;
    Renderer::new(gl, cuda_device).expect("images")
}

/// An opaque square, and a glass square in front of it.
fn scene() -> Arc<Scene> {
    let glass = Material { alpha: 0.5, alpha_mode: AlphaMode::Blend, double_sided: true, ..Material::default() };
    let red = Material { diffuse: [0.9, 0.2, 0.1], double_sided: true, ..Material::default() };
    let mut parts = squares(vec![red, glass]);
    parts.look.transparency = Transparency::OrderIndependent;
    Scene::new(parts).expect("good")
}

/// Both squares; the glass is wider by `by`.
fn surface(by: f32) -> DeformedSurface {
    let square = |z: f32, wide: f32| [[0.0, 0.0, z], [wide, 0.0, z], [wide, 1.0, z], [0.0, 1.0, z]];
    let positions = [square(0.0, 1.0), square(0.3, 0.25 + by)].concat();
    let normals = [0.0, 0.0, 1.0].repeat(positions.len());
    DeformedSurface { positions: positions.as_flattened().to_vec(), normals, ..DeformedSurface::default() }
}

fn shot(scene: &Scene, side: u32) -> FrameParams {
    let camera = Camera::fit_to_scene(scene, side, side);
    FrameParams { camera, width: side, height: side, bounds: scene.rest_bounds, light: None }
}

/// The picture of one surface drawn alone, and its number of blended fragments.
fn alone(by: f32) -> (Vec<u8>, u64) {
    let (mut renderer, scene) = (open(), scene());
    let buffers = renderer.load(&scene).expect("loads");
    renderer.upload(&buffers, &surface(by)).expect("uploads");
    let image = renderer.draw(&buffers, &shot(&scene, 64)).expect("draws");
    (image.rgba, renderer.stats().oit.expect("exact").fragments)
}

fn loaded() -> (Renderer, Arc<Scene>, SceneBuffers) {
    let (mut renderer, scene) = (open(), scene());
    let buffers = renderer.load(&scene).expect("loads");
    renderer.upload(&buffers, &surface(0.0)).expect("uploads");
    (renderer, scene, buffers)
}

#[test]
fn each_frame_under_way_keeps_its_vertices_camera_and_counts_whatever_comes_after_it() {
    let (mut renderer, scene, buffers) = loaded();
    let moved = [0.0, 0.2, 0.6];
    let mut tickets = Vec::new();
    for by in moved {
        renderer.upload(&buffers, &surface(by)).expect("uploads");
        tickets.push(renderer.submit(&buffers, &shot(&scene, 64)).expect("submits"));
    }
    // Last frame first: the host chooses the order of waiting.
    let mut seen = Vec::new();
    for by in moved.into_iter().rev() {
        let ticket = tickets.pop().expect("as many");
        let image = renderer.read_image(ticket).expect("draws");
        let (rgba, fragments) = alone(by);
        assert!(image.rgba == rgba, "{by}");
        assert_eq!(renderer.stats().oit.expect("exact").fragments, fragments);
        let names: Vec<&str> = image.times.iter().map(|(key, _)| key.name()).collect();
        assert_eq!(names[..3], ["shadow", "blur", "draw"]);
        assert!(image.times.iter().all(|(_, ms)| ms.is_finite() && ms >= 0.0), "{:?}", image.times);
        seen.push((rgba, fragments));
    }
    assert!(seen[0] != seen[1] && seen[1] != seen[2] && seen[0].1 > seen[2].1, "control: the frames differ");
}

#[test]
fn a_fourth_frame_of_a_form_is_refused_and_a_scene_that_is_read_at_once_has_one_buffer() {
    let (mut renderer, scene, buffers) = loaded();
    let shot = shot(&scene, 64);
    let made = |renderer: &Renderer| renderer.targets.last().expect("drawn").readback_ring.count();
    for _ in 0..5 {
        renderer.draw(&buffers, &shot).expect("draws");
    }
    assert_eq!(made(&renderer), 1);
    let unread: Vec<_> =
        (0..5).map(|_| renderer.submit_without_readback(&buffers, &shot).expect("as many as one likes")).collect();
    for ticket in unread {
        assert!(renderer.read_image(ticket).expect("draws").rgba.is_empty());
    }
    assert_eq!(made(&renderer), 1, "what nobody reads takes none");
    let mut tickets: Vec<_> = (0..3).map(|_| renderer.submit(&buffers, &shot).expect("has room")).collect();
    assert_eq!((made(&renderer), MAX_FRAMES_IN_FLIGHT), (3, 3));
    let refusal = renderer.submit(&buffers, &shot).expect_err("full");
    assert_eq!(refusal, Error::Busy { queue: "frames in flight", limit: 3 });
    let smaller = FrameParams { width: 32, height: 32, ..shot };
    renderer.draw(&buffers, &smaller).expect("another form has its own");
    let first = renderer.read_image(tickets.remove(0)).expect("draws");
    tickets.push(renderer.submit(&buffers, &shot).expect("there is room again"));
    drop(tickets.remove(0));
    tickets.push(renderer.submit(&buffers, &shot).expect("one that was given up makes room"));
    for ticket in tickets {
        assert!(renderer.read_image(ticket).expect("draws").rgba == first.rgba);
    }
    assert!(!renderer.read_visibility().expect("beside the ring").is_empty());
}

#[test]
fn a_frame_that_does_not_end_is_an_error_with_the_name_of_the_pass_and_the_next_is_drawn() {
    let (mut renderer, scene, buffers) = loaded();
    let shot = shot(&scene, 64);
    let passes =
        [Pass::Shadow, Pass::Blur, Pass::Visibility, Pass::Blended, Pass::Shade, Pass::Bloom, Pass::Encode, Pass::Read];
    for stuck in 0..passes.len() {
        let mut ticket = renderer.submit(&buffers, &shot).expect("submits");
        renderer.gl.wait("test", Duration::from_secs(60)).expect("all of it");
        let timed: Vec<Pass> = ticket.passes.iter().map(|(pass, _)| *pass).collect();
        assert_eq!(timed, passes);
        ticket.fence = renderer.gl.broken_fence();
        for (_, timer) in &mut ticket.passes[stuck..] {
            *timer = renderer.gl.unstarted_timer();
        }
        assert!(ticket.is_ready(), "to be given up");
        let Err(Error::Fault { stage, reason }) = renderer.read_image(ticket) else { panic!("no fault") };
        assert_eq!(stage, passes[stuck].name());
        let last = if stuck == 0 { "none".to_owned() } else { format!("'{}'", passes[stuck - 1]) };
        assert!(reason.ends_with(&format!("the last pass that it finished: {last}")), "{reason}");
        // Discards the errors of querying objects that do not exist.
        renderer.gl.check("test").ok();
        renderer.draw(&buffers, &shot).expect("the next one is drawn");
    }
}

#[test]
fn a_frame_that_fails_halfway_leaves_no_images_of_which_nobody_knows_what_they_hold() {
    let (mut renderer, scene, mut buffers) = loaded();
    let shot = shot(&scene, 64);
    let want = renderer.draw(&buffers, &shot).expect("draws").rgba;
    let blur = std::mem::take(&mut buffers.programs.blur);
    let Err(Error::Fault { stage, .. }) = renderer.draw(&buffers, &shot) else { panic!("no fault") };
    assert_eq!((stage, renderer.targets.len()), ("blur", 0));
    buffers.programs.blur = blur;
    assert!(renderer.draw(&buffers, &shot).expect("draws again").rgba == want);
}

#[test]
fn a_frame_that_is_late_by_more_than_the_limit_is_ready_to_be_given_up() {
    let (mut renderer, scene, buffers) = loaded();
    renderer.frame_timeout = Duration::from_millis(5);
    let ticket = renderer.submit_without_readback(&buffers, &shot(&scene, 64)).expect("submits");
    ticket.is_ready();
    thread::sleep(Duration::from_millis(6));
    assert!(ticket.time_left().is_zero() && ticket.is_ready_within(Duration::from_secs(60)));
}

#[test]
fn a_frame_comes_back_when_the_images_of_its_form_were_freed_meanwhile() {
    let (mut renderer, scene, buffers) = loaded();
    let early = renderer.submit(&buffers, &shot(&scene, 64)).expect("submits");
    for side in 32..40 {
        renderer.draw(&buffers, &shot(&scene, side)).expect("draws");
    }
    assert!(renderer.targets.iter().all(|target| target.desc.width != 64));
    let pixels = renderer.map_pixels(early).expect("draws");
    renderer.draw(&buffers, &shot(&scene, 41)).expect("draws while somebody reads what was freed");
    assert_eq!(renderer.gl.retired_buffer_count(), 1);
    assert!(pixels.into_image().rgba == alone(0.0).0);
    renderer.draw(&buffers, &shot(&scene, 42)).expect("draws");
    assert_eq!(renderer.gl.retired_buffer_count(), 0);
}

#[test]
fn pixels_outlive_a_renderer_whose_thread_holds_them() {
    let (mut renderer, scene, buffers) = loaded();
    let ticket = renderer.submit(&buffers, &shot(&scene, 64)).expect("submits");
    let pixels = renderer.map_pixels(ticket).expect("draws");
    drop(renderer);
    drop(buffers);
    assert!(pixels.into_image().rgba == alone(0.0).0);
}

#[test]
fn pixels_are_copied_by_another_thread_and_their_memory_waits_for_it_whatever_goes_meanwhile() {
    let (want, _) = alone(0.0);
    let (mut renderer, scene, buffers) = loaded();
    let shot = shot(&scene, 64);
    let slow = |renderer: &mut Renderer, buffers: &SceneBuffers| {
        let ticket = renderer.submit(buffers, &shot).expect("has room");
        let pixels = renderer.map_pixels(ticket).expect("draws");
        thread::spawn(move || {
            thread::sleep(Duration::from_millis(50));
            pixels.into_image()
        })
    };
    // The fourth frame waits until the first was copied.
    let readers: Vec<_> = (0..4).map(|_| slow(&mut renderer, &buffers)).collect();
    renderer.unload(buffers);
    drop(renderer);
    for reader in readers {
        let FrameImage { rgba, .. } = reader.join().expect("lives");
        assert!(rgba == want);
    }
}

#[test]
fn pixels_that_are_held_for_too_long_refuse_frames_and_block_none_for_ever() {
    let (mut renderer, scene, buffers) = loaded();
    renderer.frame_timeout = Duration::from_secs(20);
    let shot = shot(&scene, 64);
    let mut held = Vec::new();
    for _ in 0..3 {
        let ticket = renderer.submit(&buffers, &shot).expect("has room");
        held.push(renderer.map_pixels(ticket).expect("draws"));
    }
    renderer.frame_timeout = Duration::from_millis(20);
    assert!(matches!(renderer.submit(&buffers, &shot), Err(Error::Busy { .. })));
    renderer.frame_timeout = Duration::from_secs(20);
    let images: Vec<FrameImage> = held.into_iter().map(MappedPixels::into_image).collect();
    let after = renderer.draw(&buffers, &shot).expect("there is room again");
    assert!(images.iter().all(|image| image.rgba == after.rgba));
}

/// Panics instead of drawing.
#[derive(Debug)]
struct PanickingRasterizer;

impl Rasterizer for PanickingRasterizer {
    fn draw(&mut self, _: Option<DrawTarget<'_>>, _: Option<DrawTarget<'_>>) -> Result<()> {
        panic!("injected")
    }

    fn precompile(&mut self, _: bool, _: bool) -> Result<()> {
        Ok(())
    }
}

/// The panic happens while the context is current, a timer query is active and a target is in use.
#[test]
fn other_scenes_are_drawn_after_a_panic_within_a_frame() {
    let (mut renderer, scene, buffers) = loaded();
    let want = renderer.draw(&buffers, &shot(&scene, 64)).expect("draws").rgba;
    let mut parts = squares(vec![Material { double_sided: true, ..Material::default() }]);
    parts.look.samples = 1;
    let other = Scene::new(parts).expect("good");
    let mut panicking = renderer.load(&other).expect("loads");
    let make = |_| Ok(Box::new(PanickingRasterizer) as Box<dyn Rasterizer>);
    renderer.attach_rasterizer(&mut panicking, make).expect("attached");
    // A second renderer, whose context is current before and after.
    let (mut bystander, _, bystander_buffers) = loaded();
    for _ in 0..MAX_FRAMES_IN_FLIGHT + 2 {
        let drawn = catch_unwind(AssertUnwindSafe(|| renderer.draw(&panicking, &shot(&other, 64))));
        assert!(drawn.is_err(), "the rasterizer is asked");
        renderer.gl.check("test").expect("no error remains");
        assert!(renderer.draw(&buffers, &shot(&scene, 64)).expect("draws").rgba == want);
        assert!(bystander.draw(&bystander_buffers, &shot(&scene, 64)).expect("draws").rgba == want);
    }
}

#[test]
fn frames_without_their_context_are_errors_and_later_ones_are_drawn() {
    let (mut renderer, scene, buffers) = loaded();
    let want = renderer.draw(&buffers, &shot(&scene, 64)).expect("draws").rgba;
    let (mut bystander, _, bystander_buffers) = loaded();
    let in_flight = renderer.submit(&buffers, &shot(&scene, 64)).expect("submits");
    let occupied = renderer.gl.occupy();
    let refused = [
        renderer.draw(&buffers, &shot(&scene, 64)).err(),
        renderer.upload(&buffers, &surface(0.5)).err(),
        renderer.load(&scene).err(),
        renderer.read_image(in_flight).err(),
    ];
    for error in refused {
        let error = error.expect("no context").to_string();
        assert!(error.contains("eglMakeCurrent"), "{error}");
    }
    assert!(bystander.draw(&bystander_buffers, &shot(&scene, 64)).expect("draws").rgba == want);
    drop(occupied);
    assert!(renderer.draw(&buffers, &shot(&scene, 64)).expect("draws").rgba == want, "the upload was not issued");
}
