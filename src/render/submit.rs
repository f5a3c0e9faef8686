//! Asynchronous frames: [`Renderer::submit`] records the commands of a frame, [`Renderer::collect`] takes its pixels
//! when they are ready. In between, the host can do other work or submit more frames.
//!
//! The uniforms of a frame (`frame`, `splits`, the initial values of the counters) are written with stream-ordered
//! OpenGL commands. Frames in flight therefore keep their own values; the same holds for uploaded vertices.

use std::cell::Cell;
use std::ops::Range;
use std::time::{Duration, Instant};

use rayon::prelude::*;

use super::gl::{Fence, Lent, Stopwatch};
use super::lists;
use super::programs::Sampled;
use super::region::Region;
use super::ring::Slot;
use super::scene_buffers::SceneBuffers;
use super::splits::Splits;
use super::target::{Form, Target};
use super::{Image, Path, Paths, Ran, Renderer, Shot, cull, frame, passes};
use modalcast_model::error::{Error, Result, during, invalid};

/// Bytes that one thread copies at a time: large enough that the cost of starting a task is small in comparison.
const STRETCH: usize = 1 << 20;

/// A frame in flight. Dropping the ticket abandons the frame.
#[derive(Debug)]
pub struct Ticket {
    form: Form,
    /// None for a frame whose pixels are not read back.
    slot: Option<Slot>,
    fence: Fence,
    /// Passes in execution order, each with its timer.
    passes: Vec<(&'static str, Stopwatch)>,
    ran: Ran,
    limit: Duration,
    /// When the host first polled or waited for the frame.
    waited: Cell<Option<Instant>>,
}

/// Pixels of a finished frame, still in the staging buffer that the device wrote. Any thread may copy them. The ring
/// cannot reuse the staging buffer until then, so copy them soon.
#[derive(Debug)]
pub struct Pixels {
    width: u32,
    height: u32,
    lent: Option<Lent>,
    passes: Vec<(&'static str, f64)>,
    paths: Paths,
}

impl Renderer {
    /// Draws one frame of the current buffers and waits for its pixels.
    ///
    /// # Errors
    /// Those of [`Self::submit`] and [`Self::retrieve`].
    pub fn draw(&mut self, buffers: &SceneBuffers, shot: &Shot) -> Result<Image> {
        let ticket = self.submit(buffers, shot)?;
        self.collect(ticket)
    }

    /// Submits one frame of the current buffers; later changes of the buffers do not affect it. At most
    /// [`super::FRAMES_UNDER_WAY`] frames of one form may be in flight. A further one is refused until the oldest is
    /// collected.
    ///
    /// # Errors
    /// `Busy` when too many frames are in flight, `Invalid` for a size above the limit or a camera whose matrices
    /// overflow, `Fault` naming the pass when OpenGL reports an error.
    pub fn submit(&mut self, buffers: &SceneBuffers, shot: &Shot) -> Result<Ticket> {
        self.start(buffers, shot, true)
    }

    /// Submits a frame whose pixels stay on the device, like a frame that is shown on a screen: its image is empty.
    /// Such frames use no staging buffer, so their number in flight is not limited.
    ///
    /// # Errors
    /// Those of [`Self::submit`] except `Busy`.
    pub fn submit_unread(&mut self, buffers: &SceneBuffers, shot: &Shot) -> Result<Ticket> {
        self.start(buffers, shot, false)
    }

    /// Waits for a frame and copies its pixels.
    ///
    /// # Errors
    /// Those of [`Self::retrieve`].
    pub fn collect(&mut self, ticket: Ticket) -> Result<Image> {
        self.retrieve(ticket).map(Pixels::into_image)
    }

    /// Waits for a frame and returns its pixels uncopied, so that another thread can copy them.
    ///
    /// # Errors
    /// `Fault` naming the pass that did not finish within the time limit, or the OpenGL error.
    pub fn retrieve(&mut self, ticket: Ticket) -> Result<Pixels> {
        ticket.wait()?;
        let Ticket { form, slot, passes, mut ran, .. } = ticket;
        let staging = slot.as_ref().and_then(Slot::staging);
        if let Some(staging) = staging {
            let [listed, culled] = form.told().map(|part| part.start as usize..part.end as usize);
            let told = |part: Range<usize>| if part.is_empty() { Ok(None) } else { staging.read(part).map(Some) };
            (ran.lists, ran.culled) =
                (told(listed)?.map(|head| lists::told(&head)), told(culled)?.map(|counts| cull::told(&counts)));
        }
        // When the compute rasterizer drew the visibility there are no camera counts; the sun's are dropped with them.
        ran.culled = ran.culled.filter(|_| ran.paths.visibility != Some(Path::Cuda));
        let lent = staging.map(|staging| staging.lend(form.bytes() as usize)).transpose()?;
        self.gl.check("read")?;
        warn_of_lists(&self.ran, &ran);
        if let Some(culled) = &ran.culled {
            tracing::trace!(?culled, "triangles before they were drawn");
        }
        let paths = ran.paths;
        self.ran = ran;
        Ok(Pixels { width: form.width, height: form.height, lent, passes: times(&passes), paths })
    }

    fn start(&mut self, buffers: &SceneBuffers, shot: &Shot, is_read: bool) -> Result<Ticket> {
        self.check_size(shot)?;
        let numbers = frame::Frame::new(&buffers.scene, shot, buffers.origin)?;
        let look = &buffers.scene.look;
        let size = [shot.width, shot.height];
        let form = Form::new(&self.gl, size, look, lists::wanted(&self.gl, &buffers.scene, size)?);
        let form = Form { culling: cull::of(buffers.plan()), ..form };
        self.make_room(form)?;
        let sampled = buffers.sampled(form.samples, &mut |source| self.program(source))?;
        let Some(target) = self.targets.last() else { return Err(during("draw")("no target")) };
        let slot = if is_read { Some(target.ring.take(self.watchdog)?) } else { None };
        let ground = draws_ground(buffers, shot);
        target.reach.set(reach(buffers, shot, ground));
        buffers.buffer("frame")?.write(bytemuck::bytes_of(&numbers));
        passes::bind(buffers)?;
        cull::begin(buffers);
        if let Some(splits) = buffers.buffers.get("splits") {
            let fit = frame::sun_fit(&buffers.scene, shot, buffers.origin);
            splits.write(bytemuck::bytes_of(&Splits::new(&buffers.scene, shot, &fit, buffers.origin)));
        }
        let mut ran = Ran { samples: form.samples, ..Ran::default() };
        let passes = self.run(buffers, shot, (target, &sampled, ground), &mut ran).and_then(|mut passes| {
            passes.extend(self.bring(buffers, target, slot.as_ref())?);
            Ok(passes)
        });
        if passes.is_err() {
            // A failed pass leaves the images of the target undefined.
            self.targets.pop();
        }
        let passes = passes?;
        self.last = Some(numbers);
        Ok(Ticket {
            form,
            slot,
            fence: self.gl.fence("read")?,
            passes,
            ran,
            limit: self.watchdog,
            waited: Cell::new(None),
        })
    }

    pub(super) fn check_size(&self, shot: &Shot) -> Result<()> {
        let limit = self.info.max_side;
        if [shot.width, shot.height].iter().all(|side| (1..=limit).contains(side)) {
            return Ok(());
        }
        let given = format!("{} x {}", shot.width, shot.height);
        Err(invalid("frame.size", format!("1 to {limit} pixels a side"), given))
    }

    /// Records the passes that make the picture.
    fn run(
        &self,
        buffers: &SceneBuffers,
        shot: &Shot,
        (target, sampled, ground): (&Target, &Sampled, bool),
        ran: &mut Ran,
    ) -> Result<Vec<(&'static str, Stopwatch)>> {
        let gl = &self.gl;
        let timed = |pass, commands: &mut dyn FnMut() -> Result<()>| {
            gl.timed((pass, self.watchdog), commands).map(|stopwatch| (pass, stopwatch))
        };
        let mut times = Vec::new();
        let content = buffers.shadow_of(shot);
        let by_others = buffers.drawn_beside().map(|(beside, draws)| {
            let wanted = [draws[0] && buffers.shared_shadow.is_wanted(content), draws[1]];
            (beside, wanted)
        });
        if let Some((beside, wanted)) = by_others.filter(|(_, wanted)| wanted.contains(&true)) {
            let name = if wanted[0] { "raster" } else { "ids" };
            match timed(name, &mut || beside.draw(gl, (buffers, shot), wanted, ran)) {
                Ok(time) => times.push(time),
                Err(error) => beside.give_up(&error),
            }
        }
        buffers.shared_shadow.draw_unless_there(content, || {
            times.push(timed("shadow", &mut || passes::shadow(gl, buffers, ran))?);
            times.push(timed("blur", &mut || passes::blur(gl, buffers, ran))?);
            Ok(())
        })?;
        let beside = buffers.drawn_beside().filter(|(_, draws)| draws[1]).map(|(beside, _)| beside);
        if buffers.culler.is_some() && beside.is_none() {
            times.push(timed("cull", &mut || cull::camera(gl, buffers, target, sampled, ran))?);
        }
        times.extend([
            timed("visibility", &mut || match beside {
                Some(beside) => beside.unpack(gl, target, ran),
                None => {
                    passes::visibility(gl, buffers, target, sampled, ran)?;
                    if ground { passes::ground(gl, buffers, shot, ran) } else { Ok(()) }
                }
            })?,
            timed("blended", &mut || passes::blended(gl, buffers, target, sampled, ran))?,
            timed("shade", &mut || passes::shade(gl, buffers, target, sampled, ran))?,
            timed("bloom", &mut || buffers.post.bloom(gl, target, ran))?,
            timed("encode", &mut || buffers.post.encode(gl, target, ran))?,
        ]);
        Ok(times)
    }

    /// Copies the pixels, then the list and culling statistics, to the staging buffer.
    fn bring(
        &self,
        buffers: &SceneBuffers,
        target: &Target,
        slot: Option<&Slot>,
    ) -> Result<Option<(&'static str, Stopwatch)>> {
        let Some(staging) = slot.and_then(Slot::staging) else { return Ok(None) };
        let bytes = target.form.bytes();
        let copy = || {
            self.gl.copy(&target.packed, &staging.buffer, bytes);
            let ledger = target.lists.as_ref().map(|lists| &lists.ledger);
            for (from, to) in [ledger, buffers.buffers.get(cull::COUNTED)].into_iter().zip(target.form.told()) {
                if let Some(from) = from.filter(|_| !to.is_empty()) {
                    self.gl.copy_to(from, (&staging.buffer, to.start), to.end - to.start);
                }
            }
            self.gl.check("read")
        };
        self.gl.timed(("read", self.watchdog), copy).map(|stopwatch| Some(("read", stopwatch)))
    }
}

/// Whether the ground must be rasterized.
fn draws_ground(buffers: &SceneBuffers, shot: &Shot) -> bool {
    let scene = &buffers.scene;
    // The bounds of a rebased scene leave out what is far away.
    let is_last = buffers.apart.is_none() && frame::ground_is_last(scene, shot, buffers.origin);
    scene.look.ground.is_some() && frame::above_ground(scene, shot) && !is_last
}

/// Region of the frame that may show triangles or rasterized ground.
fn reach(buffers: &SceneBuffers, shot: &Shot, ground: bool) -> Region {
    let size = [shot.width, shot.height];
    if buffers.apart.is_some() || ground {
        return Region::whole(size);
    }
    Region::of(&frame::camera_clip(&buffers.scene, shot, buffers.origin), &shot.bounds, size)
}

impl Ticket {
    /// Whether [`Renderer::retrieve`] would return without waiting.
    pub fn is_ready(&self) -> bool {
        self.is_ready_within(Duration::ZERO)
    }

    /// Waits at most `limit` for the frame and returns whether it is ready. A frame that exceeds the watchdog's limit
    /// counts as ready: retrieving it reports the timeout.
    pub fn is_ready_within(&self, limit: Duration) -> bool {
        self.left().is_zero() || self.fence.is_over_within(limit)
    }

    /// Remaining watchdog time. The clock starts at the first poll or wait.
    fn left(&self) -> Duration {
        let begin = self.waited.get().unwrap_or_else(Instant::now);
        self.waited.set(Some(begin));
        self.limit.saturating_sub(begin.elapsed())
    }

    fn wait(&self) -> Result<()> {
        self.fence.wait("read", self.left()).map_err(|error| self.blame(error))
    }

    /// Names the pass at which the device stopped: the one after the last pass that is known to be finished.
    fn blame(&self, error: Error) -> Error {
        let Error::Fault { stage, reason } = error else { return error };
        let over = self.passes.iter().take_while(|(_, stopwatch)| stopwatch.is_over()).count();
        let stage = self.passes.get(over).map_or(stage, |(pass, _)| *pass);
        let last = over.checked_sub(1).map_or("none".into(), |last| format!("'{}'", self.passes[last].0));
        Error::Fault { stage, reason: format!("{reason} ({:?}); the last pass that it finished: {last}", self.limit) }
    }
}

impl Pixels {
    /// Adds the milliseconds of a stage that ran before the others.
    #[must_use]
    pub fn after(mut self, stage: &'static str, ms: f64) -> Self {
        self.passes.insert(0, (stage, ms));
        self
    }

    /// Copies the pixels; several threads share the work when there are many.
    pub fn into_image(self) -> Image {
        let begin = Instant::now();
        let Self { width, height, lent, mut passes, paths } = self;
        let bytes = lent.as_ref().map_or(&[][..], Lent::bytes);
        let mut rgba = vec![0; bytes.len()];
        let stretches = rgba.par_chunks_mut(STRETCH).zip(bytes.par_chunks(STRETCH));
        stretches.for_each(|(to, from)| to.copy_from_slice(from));
        drop(lent);
        if let Some((_, ms)) = passes.iter_mut().find(|(name, _)| *name == "read") {
            *ms += begin.elapsed().as_secs_f64() * 1e3;
        }
        Image { width, height, rgba, passes, paths }
    }
}

/// Milliseconds of the stages and of their passes.
fn times(passes: &[(&'static str, Stopwatch)]) -> Vec<(&'static str, f64)> {
    let all: Vec<(&'static str, f64)> = passes.iter().map(|(name, stopwatch)| (*name, stopwatch.ms())).collect();
    let of_shadow = |name: &str| ["raster", "shadow", "blur"].contains(&name);
    let sum =
        |wanted: &dyn Fn(&str) -> bool| all.iter().filter(|(name, _)| wanted(name)).fold(0.0, |sum, (_, ms)| sum + ms);
    let mut times = vec![("shadow", sum(&of_shadow))];
    times.extend(all.iter().filter(|(name, _)| of_shadow(name) && *name != "shadow"));
    times.push(("draw", sum(&|name| !of_shadow(name) && name != "read")));
    times.extend(all.iter().filter(|(name, _)| !of_shadow(name)));
    times
}

/// Warns when a frame drops blended fragments and the previous one did not.
fn warn_of_lists(last: &Ran, ran: &Ran) {
    let lacks = |ran: &Ran| ran.lists.filter(|lists| lists.dropped() > 0);
    if let (Some(lists), None) = (lacks(ran), lacks(last)) {
        let (dropped, kept) = (lists.dropped(), lists.kept);
        tracing::warn!(
            dropped,
            kept,
            "blended fragments are over the budget (look.fragments): the farthest are not drawn"
        );
    }
}

#[cfg(test)]
mod tests;
