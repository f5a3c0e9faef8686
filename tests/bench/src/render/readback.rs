//! Measures the cost of reading every frame back: frames per second without readback, with a blocking readback after
//! each frame, and with asynchronous readbacks while the next frames are drawn. Asynchronous readbacks go through the
//! renderer's ring of [`MAX_FRAMES_IN_FLIGHT`] staging buffers.
//!
//! All three methods keep at most [`MAX_FRAMES_IN_FLIGHT`] frames in flight, so that they differ only in the readback.
//! Rounds of the three methods alternate, and the medians over the rounds are compared. The methods without readback
//! and through the ring are also measured with a moving scene: the vertices of another step are uploaded before every
//! frame.
//!
//! The readback is validated before it is timed. Frames of two alternating cameras are read through the ring and must
//! equal, in order, the frames of blocking readbacks. This is checked with and without uploads between the frames.

use std::collections::VecDeque;
use std::sync::mpsc::{self, SyncSender};
use std::time::Instant;

use serde::Serialize;

use super::RenderReportOptions;
use super::harness::{LoadedScene, RenderHarness, Size};
use super::measure::STILL_STEP;
use super::workloads::{AnimatedScene, RenderWorkload};
use crate::markdown_table::table;
use crate::timing::{MIN_REPETITIONS, quantile};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::scene::{Camera, View};
use modalcast_render::{FrameImage, FrameParams, MAX_FRAMES_IN_FLIGHT};

/// Rounds per method.
const ROUNDS: usize = 5;

/// Frames per second of one workload.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReadbackRates {
    pub load: String,
    pub size: Size,
    /// Frames per round.
    pub frames: usize,
    /// Rate without readback.
    pub unread_fps: f64,
    #[serde(rename = "at_once_fps")]
    pub blocking_fps: f64,
    pub ring_fps: f64,
    /// Loss of frames per second by the readback, percent.
    #[serde(rename = "at_once_loss")]
    pub blocking_loss: f64,
    pub ring_loss: f64,
    /// Rates and loss with a moving scene: the vertices of another step are uploaded before every frame.
    #[serde(rename = "stepped_unread_fps")]
    pub moving_unread_fps: f64,
    #[serde(rename = "stepped_ring_fps")]
    pub moving_ring_fps: f64,
    #[serde(rename = "stepped_ring_loss")]
    pub moving_ring_loss: f64,
}

impl ReadbackRates {
    /// The results as one line of text.
    pub fn line(&self) -> String {
        let Self { load, unread_fps, ring_fps, ring_loss, moving_ring_loss, .. } = self;
        format!(
            "{load:<18}readback: {ring_fps:.1} frames/s of {unread_fps:.1} without it, loss {ring_loss:.1} %, \
             {moving_ring_loss:.1} % with uploads"
        )
    }
}

/// Parameters and vertices of even and of odd frames.
struct FrameSource {
    frame_params: [FrameParams; 2],
    /// Vertices of two steps, which are uploaded before even and odd frames; `None` for a still scene.
    surfaces: Option<[DeformedSurface; 2]>,
}

/// Steps between the two uploaded states. Any distance at which the vertices differ would do.
const STEP_DISTANCE: usize = 7;

/// Readback method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ReadbackMode {
    /// Frames are not read back.
    Unread,
    /// A blocking readback follows each frame.
    Blocking,
    /// Asynchronous readbacks through the ring.
    Ring,
}

/// Measures one workload with the render settings of its scene.
///
/// # Errors
/// Errors of drawing; `Fault` when a frame that was read through the ring differs from its blocking readback.
pub(super) fn measure(
    harness: &mut RenderHarness,
    options: &RenderReportOptions,
    workload: RenderWorkload,
) -> Result<ReadbackRates> {
    let animation = workload.build()?;
    let camera = animation.camera(options.size);
    let mut loaded_scene = harness.load(&animation.scene)?;
    let moving_source = FrameSource::with_two_steps(harness, &mut loaded_scene, &animation, options.size)?;
    let still_source = FrameSource { frame_params: moving_source.frame_params, surfaces: None };
    [&still_source, &moving_source].into_iter().try_for_each(|source| validate(harness, &loaded_scene, source))?;
    // Both cameras were needed for validation only. With one camera, all frames have the same view.
    let [still_source, moving_source] =
        [still_source, moving_source].map(|source| FrameSource { frame_params: [source.frame_params[0]; 2], ..source });
    harness.warm_up(&loaded_scene, camera, options.size)?;
    // A software renderer is about a thousand times slower than a GPU, so it draws the minimum number of frames.
    let frames = if harness.renderer.info().software { MIN_REPETITIONS } else { options.replays.max(MIN_REPETITIONS) };
    let modes = [ReadbackMode::Unread, ReadbackMode::Blocking, ReadbackMode::Ring].map(|mode| (mode, &still_source));
    let modes = modes.into_iter().chain([ReadbackMode::Unread, ReadbackMode::Ring].map(|mode| (mode, &moving_source)));
    // The rates of each of the five pairs of mode and source.
    let mut fps = [const { Vec::new() }; 5];
    for _ in 0..ROUNDS {
        for ((mode, source), rates) in modes.clone().zip(&mut fps) {
            rates.push(measure_round(harness, &loaded_scene, source, (mode, frames))?);
        }
    }
    harness.unload(loaded_scene);
    let [unread, blocking, ring, moving_unread, moving_ring] = fps.map(median);
    Ok(ReadbackRates {
        load: animation.name,
        size: options.size,
        frames,
        unread_fps: unread,
        blocking_fps: blocking,
        ring_fps: ring,
        blocking_loss: loss(unread, blocking),
        ring_loss: loss(unread, ring),
        moving_unread_fps: moving_unread,
        moving_ring_fps: moving_ring,
        moving_ring_loss: loss(moving_unread, moving_ring),
    })
}

impl FrameSource {
    /// Two cameras and the vertices of two steps; the bounds of the shadow map cover both steps.
    fn with_two_steps(
        harness: &mut RenderHarness,
        loaded_scene: &mut LoadedScene,
        animation: &AnimatedScene,
        size: Size,
    ) -> Result<Self> {
        let mut deform = |step: usize| -> Result<_> {
            harness.deform(loaded_scene, &animation.state(step))?;
            Ok((loaded_scene.surface()?.clone(), loaded_scene.deformed_bounds()))
        };
        let (second_surface, (second_bounds, second_light_box)) = deform(STILL_STEP + STEP_DISTANCE)?;
        let (first_surface, (first_bounds, first_light_box)) = deform(STILL_STEP)?;
        let camera = animation.camera(size);
        let light_bounds = first_light_box.zip(second_light_box).map(|(first, second)| first.union(second));
        let frame_params = |camera: Camera| FrameParams {
            bounds: first_bounds.union(second_bounds),
            light_bounds,
            edges: None,
            samples: None,
            ..loaded_scene.frame_params(camera, size)
        };
        Ok(Self {
            frame_params: [camera, move_camera_back(camera)].map(frame_params),
            surfaces: Some([first_surface, second_surface]),
        })
    }

    /// Uploads the vertices of a frame, unless the scene is still.
    fn upload_step(&self, harness: &mut RenderHarness, loaded_scene: &LoadedScene, frame: usize) -> Result<()> {
        self.surfaces
            .as_ref()
            .map_or(Ok(()), |surfaces| harness.renderer.upload(&loaded_scene.buffers, &surfaces[frame % 2]))
    }
}

/// The same view from a 25 % larger distance.
fn move_camera_back(camera: Camera) -> Camera {
    let View::LookAt { eye, target, up } = camera.view else { return camera };
    let eye = std::array::from_fn(|axis| target[axis] + 1.25 * (eye[axis] - target[axis]));
    Camera { view: View::LookAt { eye, target, up }, ..camera }
}

/// Loss of the rate `fps` compared with `baseline_fps`, percent.
fn loss(baseline_fps: f64, fps: f64) -> f64 {
    100.0 * (1.0 - fps / baseline_fps)
}

fn median(mut rates: Vec<f64>) -> f64 {
    quantile(&mut rates, 0.5).unwrap_or(f64::NAN)
}

/// Checks that frames that are read through the ring equal the frames of blocking readbacks, in order.
fn validate(harness: &mut RenderHarness, loaded_scene: &LoadedScene, source: &FrameSource) -> Result<()> {
    let mut draw_blocking = |frame: usize| {
        source.upload_step(harness, loaded_scene, frame)?;
        harness.renderer.draw(&loaded_scene.buffers, &source.frame_params[frame])
    };
    let expected = [draw_blocking(0)?, draw_blocking(1)?];
    let frames = 2 * MAX_FRAMES_IN_FLIGHT + 1;
    let (frame_sender, receiver) = mpsc::sync_channel(frames);
    draw_pipelined(harness, loaded_scene, source, (frames, Some(frame_sender)))?;
    check_frames(&expected, &receiver.iter().collect::<Vec<_>>(), frames)
}

/// Checks that all frames were received. Even frames must equal the first expected image and odd frames the second.
fn check_frames(expected: &[FrameImage; 2], received: &[(usize, FrameImage)], frames: usize) -> Result<()> {
    if expected[0].rgba == expected[1].rgba {
        return Err(fault(
            "readback",
            "expected two cameras with different images, got equal ones: swapped frames would not be detected",
        ));
    }
    let received_numbers: std::collections::BTreeSet<usize> = received.iter().map(|(frame, _)| *frame).collect();
    let differing = received.iter().filter(|(frame, image)| image.rgba != expected[frame % 2].rgba).count();
    match (received_numbers.len() == frames && received.len() == frames, differing) {
        (true, 0) => Ok(()),
        (false, _) => Err(fault("readback", format!("expected {frames} frames, got {}", received_numbers.len()))),
        _ => Err(fault("readback", format!("expected frames equal to blocking readbacks, {differing} differ"))),
    }
}

/// Frames per second of one round. The images are dropped on a separate thread.
fn measure_round(
    harness: &mut RenderHarness,
    loaded_scene: &LoadedScene,
    source: &FrameSource,
    (mode, frames): (ReadbackMode, usize),
) -> Result<f64> {
    // The channel has capacity for all frames, so that the copying threads do not wait.
    let (frame_sender, receiver) = mpsc::sync_channel::<(usize, FrameImage)>(frames);
    let begin = Instant::now();
    let receiver_thread =
        std::thread::spawn(move || receiver.iter().filter(|(_, image)| !image.rgba.is_empty()).count());
    match mode {
        ReadbackMode::Blocking => {
            for frame in 0..frames {
                source.upload_step(harness, loaded_scene, frame)?;
                let image = harness.renderer.draw(&loaded_scene.buffers, &source.frame_params[frame % 2])?;
                frame_sender.send((frame, image)).map_err(fault_in("readback"))?;
            }
            drop(frame_sender);
        }
        ReadbackMode::Unread => {
            draw_pipelined(harness, loaded_scene, source, (frames, None)).map(|()| drop(frame_sender))?
        }
        ReadbackMode::Ring => draw_pipelined(harness, loaded_scene, source, (frames, Some(frame_sender)))?,
    }
    let received = receiver_thread.join().map_err(|_| fault("readback", "the receiving thread panicked"))?;
    let seconds = begin.elapsed().as_secs_f64();
    let expected = if mode == ReadbackMode::Unread { 0 } else { frames };
    match received == expected {
        true => Ok(frames as f64 / seconds),
        false => Err(fault("readback", format!("expected {expected} frames, got {received}"))),
    }
}

/// Draws with [`MAX_FRAMES_IN_FLIGHT`] frames in flight. `sender` receives each frame's number and pixels, which
/// are copied on other threads.
fn draw_pipelined(
    harness: &mut RenderHarness,
    loaded_scene: &LoadedScene,
    source: &FrameSource,
    (frames, sender): (usize, Option<SyncSender<(usize, FrameImage)>>),
) -> Result<()> {
    // Tickets of the frames in flight, oldest first. The last iterations submit nothing and read the remaining frames.
    let mut tickets = VecDeque::new();
    for frame in 0..frames + MAX_FRAMES_IN_FLIGHT {
        let finished_ticket = if frame < MAX_FRAMES_IN_FLIGHT { None } else { tickets.pop_front() };
        if let Some(ticket) = finished_ticket {
            let pixels = harness.renderer.map_pixels(ticket)?;
            if let Some(sender) = sender.clone() {
                rayon::spawn(move || {
                    // The receiver counts the images, so a failed send is noticed there.
                    sender.send((frame - MAX_FRAMES_IN_FLIGHT, pixels.into_image())).ok();
                });
            }
        }
        if frame < frames {
            source.upload_step(harness, loaded_scene, frame)?;
            let frame_params = &source.frame_params[frame % 2];
            tickets.push_back(match &sender {
                Some(_) => harness.renderer.submit(&loaded_scene.buffers, frame_params)?,
                None => harness.renderer.submit_without_readback(&loaded_scene.buffers, frame_params)?,
            });
        }
    }
    Ok(())
}

/// The Markdown section of the report.
pub(super) fn readback_section(rows: &[ReadbackRates]) -> String {
    let header = ["load", "frames/s, no readback", "blocking readback", "loss", "readback through the ring", "loss"];
    let header = [&header[..], &["with uploads, no readback", "with uploads, through the ring", "loss"]].concat();
    let mut text = String::from(
        "\n## Reading every frame back\n\nWithout uploads, and with the vertices of another step uploaded from host \
         memory before every frame.\n\n",
    );
    let cells = |row: &ReadbackRates| {
        let format_percent = |loss: f64| format!("{loss:.1} %");
        [
            row.load.clone(),
            format!("{:.1}", row.unread_fps),
            format!("{:.1}", row.blocking_fps),
            format_percent(row.blocking_loss),
            format!("{:.1}", row.ring_fps),
            format_percent(row.ring_loss),
            format!("{:.1}", row.moving_unread_fps),
            format!("{:.1}", row.moving_ring_fps),
            format_percent(row.moving_ring_loss),
        ]
    };
    text.push_str(&table(&header, rows.iter().map(cells)));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measures_all_readback_methods_and_fills_the_table() {
        let options = RenderReportOptions {
            loads: vec![],
            plants: vec![],
            variants: vec![],
            size: Size { width: 64, height: 36 },
            quick: true,
            replays: 20,
        };
        let mut harness = RenderHarness::open().expect("a renderer");
        let rates = measure(&mut harness, &options, RenderWorkload::Square).expect("rates");
        assert!(rates.unread_fps > 0.0 && rates.blocking_fps > 0.0 && rates.ring_fps > 0.0, "{rates:?}");
        assert!(rates.moving_unread_fps > 0.0 && rates.moving_ring_fps > 0.0 && rates.moving_ring_loss < 100.0);
        assert!(rates.ring_loss < 100.0 && rates.blocking_loss < 100.0 && rates.frames == MIN_REPETITIONS);
        let markdown = readback_section(std::slice::from_ref(&rates));
        assert!(markdown.lines().any(|line| line.contains("square") && line.contains('%')), "{markdown}");
        // The loss is 100 (1 - 0.95) with the rounding of f64.
        assert_eq!((loss(200.0, 190.0), median(vec![3.0, 1.0, 2.0])), (5.000000000000004, 2.0));
    }

    #[test]
    fn detects_wrong_swapped_and_missing_frames() {
        let animation = RenderWorkload::Square.build().expect("a workload");
        let size = Size { width: 64, height: 36 };
        let mut harness = RenderHarness::open().expect("a renderer");
        let mut loaded_scene = harness.load(&animation.scene).expect("a loaded scene");
        let mut source =
            FrameSource::with_two_steps(&mut harness, &mut loaded_scene, &animation, size).expect("two steps");
        validate(&mut harness, &loaded_scene, &source).expect("equal frames with uploads between them");
        let expected = [0, 1].map(|frame| {
            source.upload_step(&mut harness, &loaded_scene, frame).expect("uploaded vertices");
            harness.renderer.draw(&loaded_scene.buffers, &source.frame_params[frame]).expect("a frame")
        });
        let (frame_sender, receiver) = mpsc::sync_channel(6);
        draw_pipelined(&mut harness, &loaded_scene, &source, (6, Some(frame_sender))).expect("six frames");
        // Several threads copy, so frames are received in any order. The swap below needs an even and an odd frame.
        let mut frames: Vec<(usize, FrameImage)> = receiver.iter().collect();
        frames.sort_by_key(|(number, _)| *number);
        check_frames(&expected, &frames, 6).expect("control: equal frames");
        let describe_rejection =
            |frames: &[(usize, FrameImage)]| check_frames(&expected, frames, 6).expect_err("a rejection").to_string();
        assert!(describe_rejection(&frames[1..]).contains("expected 6 frames, got 5"));
        (frames[2].0, frames[3].0) = (frames[3].0, frames[2].0);
        assert!(describe_rejection(&frames).contains("2 differ"), "two swapped frames");
        (frames[2].0, frames[3].0) = (frames[3].0, frames[2].0);
        frames[4].1.rgba[100] ^= 1;
        assert!(describe_rejection(&frames).contains("1 differ"), "one wrong byte");
        source.frame_params[1] = source.frame_params[0];
        source.surfaces = None;
        let error = validate(&mut harness, &loaded_scene, &source).expect_err("a rejection of equal images");
        assert!(error.to_string().contains("two cameras with different images"), "{error}");
    }
}
