//! Cost of reading every frame back: frames per second without readback, with a blocking readback after each frame, and
//! with readbacks through the ring while the next frames are drawn.
//!
//! All three methods keep at most as many frames in flight as the ring has slots, so that they differ only in the
//! readback. Rounds of the three methods alternate, and the medians over the rounds are compared. Two more methods,
//! without readback and through the ring, upload the vertices of another step before every frame, as a moving scene
//! does.
//!
//! Validation comes first: frames of two alternating cameras come back through the ring and must equal, in order, the
//! frames that were drawn one by one, with steps between them and without.

use std::collections::VecDeque;
use std::sync::mpsc::{self, SyncSender};
use std::time::Instant;

use serde::Serialize;

use super::RenderReportOptions;
use super::harness::{HarnessScene, RenderHarness, Size};
use super::measure::STILL;
use super::workloads::{AnimatedScene, RenderWorkload};
use crate::markdown_table::table;
use crate::timing::{MIN_REPETITIONS, quantile};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, fault_in};
use modalcast_model::scene::{Camera, View};
use modalcast_render::{FrameImage, FrameParams, MAX_FRAMES_IN_FLIGHT};

/// Rounds per method.
const ROUNDS: usize = 5;

/// Frames per second of one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ReadbackRates {
    pub load: String,
    pub size: Size,
    /// Frames per round.
    pub frames: usize,
    pub unread_fps: f64,
    pub at_once_fps: f64,
    pub ring_fps: f64,
    /// Percentage of frames per second that is lost to the readback.
    pub at_once_loss: f64,
    pub ring_loss: f64,
    /// The same with the vertices of another step uploaded before every frame.
    pub stepped_unread_fps: f64,
    pub stepped_ring_fps: f64,
    pub stepped_ring_loss: f64,
}

/// The frames to draw: even and odd frame numbers alternate between two shots.
struct FrameSource {
    shots: [FrameParams; 2],
    /// Vertices to upload before even and odd frames, if any.
    steps: Option<[DeformedSurface; 2]>,
}

/// Distance in steps between the two uploaded states.
const APART: usize = 7;

/// Readback method.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ReadbackMode {
    Unread,
    AtOnce,
    Ring,
}

/// Measures one load with its own look.
///
/// # Errors
/// Errors of drawing; `Fault` when a frame that was read through the ring differs from the frame drawn alone.
pub(super) fn measure(
    studio: &mut RenderHarness,
    request: &RenderReportOptions,
    kind: RenderWorkload,
) -> Result<ReadbackRates> {
    let stage = kind.stage()?;
    let camera = stage.camera(request.size);
    let mut set = studio.set(&stage.scene)?;
    let stepped = FrameSource::stepped(studio, &mut set, &stage, request.size)?;
    let still = FrameSource { shots: stepped.shots, steps: None };
    [&still, &stepped].into_iter().try_for_each(|feed| validate(studio, &set, feed))?;
    // One camera, so that all rounds draw the same.
    let [still, stepped] = [still, stepped].map(|feed| FrameSource { shots: [feed.shots[0]; 2], ..feed });
    studio.warm_up(&set, camera, request.size)?;
    // A software renderer takes as long for one frame as a GPU for a thousand.
    let frames = if studio.renderer.info().software { MIN_REPETITIONS } else { request.replays.max(MIN_REPETITIONS) };
    let ways = [ReadbackMode::Unread, ReadbackMode::AtOnce, ReadbackMode::Ring].map(|way| (way, &still));
    let ways = ways.into_iter().chain([ReadbackMode::Unread, ReadbackMode::Ring].map(|way| (way, &stepped)));
    let mut fps = [const { Vec::new() }; 5];
    for _ in 0..ROUNDS {
        for ((way, feed), list) in ways.clone().zip(&mut fps) {
            list.push(round(studio, &set, feed, (way, frames))?);
        }
    }
    studio.unload(set);
    let [unread, at_once, ring, stepped_unread, stepped_ring] = fps.map(median);
    Ok(ReadbackRates {
        load: stage.name,
        size: request.size,
        frames,
        unread_fps: unread,
        at_once_fps: at_once,
        ring_fps: ring,
        at_once_loss: loss(unread, at_once),
        ring_loss: loss(unread, ring),
        stepped_unread_fps: stepped_unread,
        stepped_ring_fps: stepped_ring,
        stepped_ring_loss: loss(stepped_unread, stepped_ring),
    })
}

impl FrameSource {
    /// Two cameras and the vertices of two steps; the shadow's bounds cover both.
    fn stepped(studio: &mut RenderHarness, set: &mut HarnessScene, stage: &AnimatedScene, size: Size) -> Result<Self> {
        let mut pose = |step: usize| -> Result<_> {
            studio.pose(set, &stage.state(step))?;
            Ok((set.surface()?.clone(), set.extents()))
        };
        let ((later, far), (first, near)) = (pose(STILL + APART)?, pose(STILL)?);
        let camera = stage.camera(size);
        let light = near.1.zip(far.1).map(|(near, far)| near.union(far));
        let shot = |camera: Camera| FrameParams { bounds: near.0.union(far.0), light, ..set.shot(camera, size) };
        Ok(Self { shots: [camera, farther(camera)].map(shot), steps: Some([first, later]) })
    }

    /// Uploads the vertices of the frame with this number, if the feed has steps.
    fn step(&self, studio: &mut RenderHarness, set: &HarnessScene, frame: usize) -> Result<()> {
        self.steps.as_ref().map_or(Ok(()), |steps| studio.renderer.upload(&set.buffers, &steps[frame % 2]))
    }
}

/// The same view from a 25 % larger distance.
fn farther(camera: Camera) -> Camera {
    let View::LookAt { eye, target, up } = camera.view else { return camera };
    let eye = std::array::from_fn(|axis| target[axis] + 1.25 * (eye[axis] - target[axis]));
    Camera { view: View::LookAt { eye, target, up }, ..camera }
}

/// Percentage of `all` that is missing in `left`.
fn loss(all: f64, left: f64) -> f64 {
    100.0 * (1.0 - left / all)
}

fn median(mut list: Vec<f64>) -> f64 {
    quantile(&mut list, 0.5).unwrap_or(f64::NAN)
}

/// Checks that frames through the full ring equal those that are drawn one by one, in order.
fn validate(studio: &mut RenderHarness, set: &HarnessScene, feed: &FrameSource) -> Result<()> {
    let mut alone = |frame: usize| {
        feed.step(studio, set, frame)?;
        studio.renderer.draw(&set.buffers, &feed.shots[frame])
    };
    let alone = [alone(0)?, alone(1)?];
    let frames = 2 * MAX_FRAMES_IN_FLIGHT + 1;
    let (texture_panels, taken) = mpsc::sync_channel(frames);
    under_way(studio, set, feed, (frames, Some(texture_panels)))?;
    check(&alone, &taken.iter().collect::<Vec<_>>(), frames)
}

/// Checks that all frames came back, with even frames equal to the first one drawn alone and odd frames equal to the
/// second.
fn check(alone: &[FrameImage; 2], taken: &[(usize, FrameImage)], frames: usize) -> Result<()> {
    if alone[0].rgba == alone[1].rgba {
        return Err(fault_in("readback")("two cameras show the same: frames that are mixed up would not be noticed"));
    }
    let numbers: std::collections::BTreeSet<usize> = taken.iter().map(|(frame, _)| *frame).collect();
    let wrong = taken.iter().filter(|(frame, image)| image.rgba != alone[frame % 2].rgba).count();
    match (numbers.len() == frames && taken.len() == frames, wrong) {
        (true, 0) => Ok(()),
        (false, _) => Err(fault_in("readback")(format!("{} of {frames} frames came back", numbers.len()))),
        _ => Err(fault_in("readback")(format!("{wrong} frames through the ring differ from those drawn alone"))),
    }
}

/// Frames per second of one round. The images are dropped on a separate thread.
fn round(
    studio: &mut RenderHarness,
    set: &HarnessScene,
    feed: &FrameSource,
    (way, frames): (ReadbackMode, usize),
) -> Result<f64> {
    // Capacity for all frames, so that the copying threads do not wait.
    let (texture_panels, taken) = mpsc::sync_channel::<(usize, FrameImage)>(frames);
    let begin = Instant::now();
    let taker = std::thread::spawn(move || taken.iter().filter(|(_, image)| !image.rgba.is_empty()).count());
    match way {
        ReadbackMode::AtOnce => {
            for frame in 0..frames {
                feed.step(studio, set, frame)?;
                let image = studio.renderer.draw(&set.buffers, &feed.shots[frame % 2])?;
                texture_panels.send((frame, image)).map_err(fault_in("readback"))?;
            }
            drop(texture_panels);
        }
        ReadbackMode::Unread => under_way(studio, set, feed, (frames, None)).map(|()| drop(texture_panels))?,
        ReadbackMode::Ring => under_way(studio, set, feed, (frames, Some(texture_panels)))?,
    }
    let taken = taker.join().map_err(|_| fault_in("readback")("the taker of frames panicked"))?;
    let seconds = begin.elapsed().as_secs_f64();
    match taken == if way == ReadbackMode::Unread { 0 } else { frames } {
        true => Ok(frames as f64 / seconds),
        false => Err(fault_in("readback")(format!("{taken} of {frames} frames came back"))),
    }
}

/// Draws with as many frames in flight as the ring has slots. `to` receives each frame's number and pixels, which are
/// copied on other threads.
fn under_way(
    studio: &mut RenderHarness,
    set: &HarnessScene,
    feed: &FrameSource,
    (frames, to): (usize, Option<SyncSender<(usize, FrameImage)>>),
) -> Result<()> {
    let mut tickets = VecDeque::new();
    for frame in 0..frames + MAX_FRAMES_IN_FLIGHT {
        if let Some(ticket) = if frame < MAX_FRAMES_IN_FLIGHT { None } else { tickets.pop_front() } {
            let pixels = studio.renderer.map_pixels(ticket)?;
            if let Some(to) = to.clone() {
                rayon::spawn(move || {
                    // The receiver counts the images, so a failed send is noticed there.
                    to.send((frame - MAX_FRAMES_IN_FLIGHT, pixels.into_image())).ok();
                });
            }
        }
        if frame < frames {
            feed.step(studio, set, frame)?;
            let shot = &feed.shots[frame % 2];
            tickets.push_back(match &to {
                Some(_) => studio.renderer.submit(&set.buffers, shot)?,
                None => studio.renderer.submit_without_readback(&set.buffers, shot)?,
            });
        }
    }
    Ok(())
}

/// The Markdown section of the report.
pub(super) fn section(list: &[ReadbackRates]) -> String {
    let head = ["load", "frames/s, none read", "each read at once", "loss", "each read through the ring", "loss"];
    let head = [&head[..], &["a step before each, none read", "a step before each, through the ring", "loss"]].concat();
    let mut text = String::from(
        "\n## Reading every frame back\n\nThe same vertices again and again; and with those of another step uploaded from host \
         memory before every frame.\n\n",
    );
    let cells = |row: &ReadbackRates| {
        let percent = |loss: f64| format!("{loss:.1} %");
        [
            row.load.clone(),
            format!("{:.1}", row.unread_fps),
            format!("{:.1}", row.at_once_fps),
            percent(row.at_once_loss),
            format!("{:.1}", row.ring_fps),
            percent(row.ring_loss),
            format!("{:.1}", row.stepped_unread_fps),
            format!("{:.1}", row.stepped_ring_fps),
            percent(row.stepped_ring_loss),
        ]
    };
    text.push_str(&table(&head, list.iter().map(cells)));
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn measures_all_readback_methods_and_fills_the_table() {
        let request = RenderReportOptions {
            loads: vec![],
            plants: vec![],
            variants: vec![],
            size: Size { width: 64, height: 36 },
            quick: true,
            replays: 20,
        };
        let mut studio = RenderHarness::open().expect("EGL");
        let row = measure(&mut studio, &request, RenderWorkload::Square).expect("measured");
        assert!(row.unread_fps > 0.0 && row.at_once_fps > 0.0 && row.ring_fps > 0.0, "{row:?}");
        assert!(row.stepped_unread_fps > 0.0 && row.stepped_ring_fps > 0.0 && row.stepped_ring_loss < 100.0);
        assert!(row.ring_loss < 100.0 && row.at_once_loss < 100.0 && row.frames >= 20);
        let markdown = section(std::slice::from_ref(&row));
        assert!(markdown.lines().any(|line| line.contains("square") && line.contains('%')), "{markdown}");
        assert_eq!((loss(200.0, 190.0), median(vec![3.0, 1.0, 2.0])), (5.000000000000004, 2.0));
    }

    #[test]
    fn detects_wrong_swapped_and_missing_frames() {
        let stage = RenderWorkload::Square.stage().expect("a load");
        let size = Size { width: 64, height: 36 };
        let mut studio = RenderHarness::open().expect("EGL");
        let mut set = studio.set(&stage.scene).expect("loads");
        let mut feed = FrameSource::stepped(&mut studio, &mut set, &stage, size).expect("poses");
        validate(&mut studio, &set, &feed).expect("control: with steps");
        let alone = [0, 1].map(|frame| {
            feed.step(&mut studio, &set, frame).expect("uploads");
            studio.renderer.draw(&set.buffers, &feed.shots[frame]).expect("draws")
        });
        let (texture_panels, taken) = mpsc::sync_channel(6);
        under_way(&mut studio, &set, &feed, (6, Some(texture_panels))).expect("draws");
        // Several threads copy, so the frames arrive in any order; the swap below needs two that differ.
        let mut frames: Vec<(usize, FrameImage)> = taken.iter().collect();
        frames.sort_by_key(|(number, _)| *number);
        check(&alone, &frames, 6).expect("control: all are right");
        let why = |frames: &[(usize, FrameImage)]| check(&alone, frames, 6).expect_err("noticed").to_string();
        assert!(why(&frames[1..]).contains("5 of 6"));
        (frames[2].0, frames[3].0) = (frames[3].0, frames[2].0);
        assert!(why(&frames).contains("2 frames"), "two that are swapped");
        (frames[2].0, frames[3].0) = (frames[3].0, frames[2].0);
        frames[4].1.rgba[100] ^= 1;
        assert!(why(&frames).contains("1 frames"), "one byte is wrong");
        feed.shots[1] = feed.shots[0];
        feed.steps = None;
        let same = validate(&mut studio, &set, &feed).expect_err("nothing could be told apart");
        assert!(same.to_string().contains("two cameras show the same"), "{same}");
    }
}
