//! What it costs to read every frame: frames drawn a second when none is read, when each is read before the next is begun,
//! and when each is read through the ring while the next ones are drawn.
//!
//! All three wait for a frame before as many others are under way as the ring has places, so that they differ in nothing but
//! the reading. Rounds of the three take turns; the medians of their rounds are compared.

use std::collections::VecDeque;
use std::sync::mpsc::{self, SyncSender};
use std::time::Instant;

use serde::Serialize;

use super::Request;
use super::loads::Kind;
use super::measure::STILL;
use super::studio::{Set, Size, Studio};
use crate::error::{Result, during};
use crate::render::{FRAMES_UNDER_WAY, Image, Shot};
use crate::report::peers::{line, rule};
use crate::report::timing::FEWEST;

/// Rounds of each way.
const ROUNDS: usize = 5;

/// Frames a second of one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Readback {
    pub load: String,
    pub size: Size,
    /// Frames of a round.
    pub frames: usize,
    pub unread_fps: f64,
    pub at_once_fps: f64,
    pub ring_fps: f64,
    /// Percent of the frames a second that are lost by reading them.
    pub at_once_loss: f64,
    pub ring_loss: f64,
}

/// Who reads the frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Way {
    Unread,
    AtOnce,
    Ring,
}

/// Measures one load under its own look.
///
/// # Errors
/// Those of drawing it; `Fault` when a frame that was read through the ring is not the one that was drawn alone.
pub(super) fn measure(studio: &mut Studio, request: &Request, kind: Kind) -> Result<Readback> {
    let stage = kind.stage()?;
    let camera = stage.camera(request.size);
    let mut set = studio.set(&stage.scene)?;
    studio.pose(&mut set, &stage.state(STILL))?;
    let shot = set.shot(camera, request.size);
    validate(studio, &set, &shot)?;
    studio.warm_up(&set, camera, request.size)?;
    // In software each takes as long as a thousand elsewhere.
    let frames = if studio.renderer.info().software { FEWEST } else { request.replays.max(FEWEST) };
    let mut fps = [const { Vec::new() }; 3];
    for _ in 0..ROUNDS {
        for (way, list) in [Way::Unread, Way::AtOnce, Way::Ring].into_iter().zip(&mut fps) {
            list.push(round(studio, &set, &shot, (way, frames))?);
        }
    }
    studio.strike(set);
    let [unread, at_once, ring] = fps.map(median);
    Ok(Readback {
        load: stage.name,
        size: request.size,
        frames,
        unread_fps: unread,
        at_once_fps: at_once,
        ring_fps: ring,
        at_once_loss: loss(unread, at_once),
        ring_loss: loss(unread, ring),
    })
}

/// Percent of `all` that `left` lacks.
fn loss(all: f64, left: f64) -> f64 {
    100.0 * (1.0 - left / all)
}

fn median(mut list: Vec<f64>) -> f64 {
    list.sort_by(f64::total_cmp);
    list[list.len() / 2]
}

/// Frames through the full ring are those that are drawn one by one.
fn validate(studio: &mut Studio, set: &Set, shot: &Shot) -> Result<()> {
    let alone = studio.renderer.draw(&set.buffers, shot)?;
    let frames = 2 * FRAMES_UNDER_WAY;
    let (images, taken) = mpsc::sync_channel(frames);
    under_way(studio, set, shot, (frames, Some(images)))?;
    let wrong = taken.iter().filter(|image| image.rgba != alone.rgba).count();
    match wrong {
        0 => Ok(()),
        _ => Err(during("readback")(format!("{wrong} frames through the ring differ from the one drawn alone"))),
    }
}

/// Frames a second of one round. Whoever takes the images drops them, on a thread of its own.
fn round(studio: &mut Studio, set: &Set, shot: &Shot, (way, frames): (Way, usize)) -> Result<f64> {
    // Room for all, so that nobody who copies pixels waits.
    let (images, taken) = mpsc::sync_channel::<Image>(frames);
    let begin = Instant::now();
    let taker = std::thread::spawn(move || taken.iter().filter(|image| !image.rgba.is_empty()).count());
    match way {
        Way::AtOnce => {
            for _ in 0..frames {
                images.send(studio.renderer.draw(&set.buffers, shot)?).map_err(during("readback"))?;
            }
            drop(images);
        }
        Way::Unread => under_way(studio, set, shot, (frames, None)).map(|()| drop(images))?,
        Way::Ring => under_way(studio, set, shot, (frames, Some(images)))?,
    }
    let taken = taker.join().map_err(|_| during("readback")("the taker of frames panicked"))?;
    let seconds = begin.elapsed().as_secs_f64();
    match taken == if way == Way::Unread { 0 } else { frames } {
        true => Ok(frames as f64 / seconds),
        false => Err(during("readback")(format!("{taken} of {frames} frames came back"))),
    }
}

/// Draws with as many frames under way as the ring has places. `to`: who gets their pixels, copied on other threads.
fn under_way(
    studio: &mut Studio,
    set: &Set,
    shot: &Shot,
    (frames, to): (usize, Option<SyncSender<Image>>),
) -> Result<()> {
    let renderer = &mut studio.renderer;
    let mut tickets = VecDeque::new();
    for frame in 0..frames + FRAMES_UNDER_WAY {
        if let Some(ticket) = if frame < FRAMES_UNDER_WAY { None } else { tickets.pop_front() } {
            let pixels = renderer.retrieve(ticket)?;
            if let Some(to) = to.clone() {
                rayon::spawn(move || {
                    to.send(pixels.into_image()).ok(); // Whoever takes them counts them.
                });
            }
        }
        if frame < frames {
            tickets.push_back(match &to {
                Some(_) => renderer.submit(&set.buffers, shot)?,
                None => renderer.submit_unread(&set.buffers, shot)?,
            });
        }
    }
    Ok(())
}

/// The table of a page.
pub(super) fn section(list: &[Readback]) -> String {
    let head = ["load", "frames/s, none read", "each read at once", "loss", "each read through the ring", "loss"];
    let mut text = String::from("\n## Reading every frame back\n\n");
    text.push_str(&line(head.map(String::from)));
    text.push_str(&rule(head.len()));
    for row in list {
        let percent = |loss: f64| format!("{loss:.1} %");
        text.push_str(&line([
            row.load.clone(),
            format!("{:.1}", row.unread_fps),
            format!("{:.1}", row.at_once_fps),
            percent(row.at_once_loss),
            format!("{:.1}", row.ring_fps),
            percent(row.ring_loss),
        ]));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_load_is_drawn_in_three_ways_and_its_table_has_a_row() {
        let request = Request {
            loads: vec![],
            plants: vec![],
            variants: vec![],
            size: Size { width: 64, height: 36 },
            quick: true,
            replays: 20,
        };
        let mut studio = Studio::open().expect("EGL");
        let row = measure(&mut studio, &request, Kind::Square).expect("measured");
        assert!(row.unread_fps > 0.0 && row.at_once_fps > 0.0 && row.ring_fps > 0.0, "{row:?}");
        assert!(row.ring_loss < 100.0 && row.at_once_loss < 100.0 && row.frames >= 20);
        let page = section(std::slice::from_ref(&row));
        assert!(page.lines().any(|line| line.contains("square") && line.contains('%')), "{page}");
        assert_eq!((loss(200.0, 190.0), median(vec![3.0, 1.0, 2.0])), (5.000000000000004, 2.0));
    }

    #[test]
    fn a_frame_that_came_back_wrong_is_noticed() {
        let stage = Kind::Square.stage().expect("a load");
        let size = Size { width: 64, height: 36 };
        let mut studio = Studio::open().expect("EGL");
        let mut set = studio.set(&stage.scene).expect("loads");
        studio.pose(&mut set, &stage.state(STILL)).expect("poses");
        let shot = set.shot(stage.camera(size), size);
        validate(&mut studio, &set, &shot).expect("control: the same");
        let (images, taken) = mpsc::sync_channel(5);
        under_way(&mut studio, &set, &shot, (5, Some(images))).expect("draws");
        let frames: Vec<Image> = taken.iter().collect();
        studio.pose(&mut set, &stage.state(STILL + 7)).expect("poses");
        let other = studio.renderer.draw(&set.buffers, &set.shot(stage.camera(size), size)).expect("draws");
        assert!(frames.len() == 5 && frames.iter().all(|frame| frame.rgba != other.rgba));
    }
}
