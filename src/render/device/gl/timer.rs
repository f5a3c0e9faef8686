//! Measures the device time of passes, and waits for the device.

use std::cell::RefCell;
use std::rc::Rc;
use std::time::{Duration, Instant};

use glow::HasContext as _;

use super::Gl;
use modalcast_model::error::{Result, fault_in};

/// Measures the time of a sequence of commands. On hardware this is a timer query. Timer queries of software
/// rasterizers are meaningless, so there the wall clock measures the commands between two waits.
#[derive(Debug)]
pub(crate) enum PassTimer {
    /// Milliseconds by the wall clock.
    Wall(f64),
    Query(Rc<Gl>, glow::Query),
}

impl Gl {
    /// Waits until all commands are complete.
    ///
    /// # Errors
    /// `Fault` of `stage` when the device does not finish within `limit`.
    pub(crate) fn wait(self: &Rc<Self>, stage: &'static str, limit: Duration) -> Result<()> {
        self.fence(stage)?.wait(stage, limit)
    }

    /// Runs the commands of a pass and measures their device time. A software rasterizer waits for the commands, at
    /// most `limit`. Each timer has its own query until it is dropped, so that several frames can be in flight.
    ///
    /// # Errors
    /// Those of the commands; `Fault` of the pass when a software rasterizer exceeds `limit`.
    pub(crate) fn time_pass(
        self: &Rc<Self>,
        pass: &'static str,
        limit: Duration,
        commands: impl FnOnce() -> Result<()>,
    ) -> Result<PassTimer> {
        if self.limits.software {
            self.wait(pass, limit)?;
            let start = Instant::now();
            commands()?;
            self.wait(pass, limit)?;
            return Ok(PassTimer::Wall(start.elapsed().as_secs_f64() * 1e3));
        }
        let timer = PassTimer::Query(Rc::clone(self), self.acquire_query(&self.free_queries)?);
        let active_query = ActiveQuery::begin(&timer)?;
        commands()?;
        drop(active_query);
        Ok(timer)
    }

    /// Begins to measure when the device executes the following commands. `None` for a software rasterizer, which
    /// executes them without a queue.
    pub(crate) fn begin_span(self: &Rc<Self>) -> Result<Option<SpanTimer>> {
        if self.limits.software {
            return Ok(None);
        }
        // SAFETY: only reads the clock of the device.
        let now_ns = unsafe { self.functions()?.get_parameter_i64(glow::TIMESTAMP) };
        Ok(Some(SpanTimer { recording_ns: now_ns.max(0) as u64, begin: self.timestamp()?, end: None }))
    }

    /// The time at which the device has executed all commands so far.
    fn timestamp(self: &Rc<Self>) -> Result<Timestamp> {
        let query = self.acquire_query(&self.free_timestamps)?;
        // SAFETY: the query belongs to the timestamp alone, and is used for timestamps only.
        unsafe { self.functions()?.query_counter(query, glow::TIMESTAMP) }
        Ok(Timestamp { gl: Rc::clone(self), query })
    }

    /// Takes a query from a pool; creates one if the pool is empty.
    fn acquire_query(&self, pool: &RefCell<Vec<glow::Query>>) -> Result<glow::Query> {
        let free_query = pool.borrow_mut().pop();
        let gl = self.functions()?;
        // SAFETY: a new name, which stays in the pool until the context is destroyed.
        free_query.map_or_else(|| unsafe { gl.create_query() }.map_err(fault_in("timer")), Ok)
    }
}

/// Measures when the device executes a sequence of commands.
#[derive(Debug)]
pub(crate) struct SpanTimer {
    /// Time of the device's clock before the first command was recorded.
    recording_ns: u64,
    begin: Timestamp,
    /// `None` until [`SpanTimer::end`].
    end: Option<Timestamp>,
}

/// A timestamp query, which returns to its pool when this is dropped.
#[derive(Debug)]
struct Timestamp {
    gl: Rc<Gl>,
    query: glow::Query,
}

impl SpanTimer {
    /// Ends the sequence of commands.
    pub(crate) fn end(&mut self, gl: &Rc<Gl>) -> Result<()> {
        self.end = Some(gl.timestamp()?);
        Ok(())
    }

    /// Milliseconds from the begin of the recording of the commands, or from `previous_end_ns` if that is later, until
    /// the device began them. Replaces `previous_end_ns` by the end of these commands if that is later. Waits for the
    /// device.
    pub(crate) fn delay_ms(&self, previous_end_ns: &mut u64) -> f64 {
        let (begin_ns, end_ns) = (self.begin.ns(), self.end.as_ref().map_or(0, Timestamp::ns));
        let delay_ns = delay_ns(self.recording_ns, *previous_end_ns, begin_ns);
        *previous_end_ns = end_ns.max(*previous_end_ns);
        delay_ns as f64 * 1e-6
    }
}

/// Nanoseconds from the later one of two times until the begin.
const fn delay_ns(recording_ns: u64, previous_end_ns: u64, begin_ns: u64) -> u64 {
    let ready_ns = if recording_ns > previous_end_ns { recording_ns } else { previous_end_ns };
    begin_ns.saturating_sub(ready_ns)
}

impl Timestamp {
    /// The time of the device's clock. Waits for the device. 0 if the context cannot be made current.
    fn ns(&self) -> u64 {
        let Some(gl) = self.gl.functions_or_skip() else { return 0 };
        // SAFETY: the query was issued; reading its result waits until it is available.
        unsafe { gl.get_query_parameter_u64(self.query, glow::QUERY_RESULT) }
    }
}

impl Drop for Timestamp {
    fn drop(&mut self) {
        self.gl.free_timestamps.borrow_mut().push(self.query);
    }
}

/// A timer query that has begun. Dropping this value ends the query, also if the commands fail or panic, so that the
/// next query can begin.
struct ActiveQuery<'a> {
    gl: &'a Gl,
}

impl<'a> ActiveQuery<'a> {
    /// Begins the query of a timer. No other query may be active.
    fn begin(timer: &'a PassTimer) -> Result<Option<Self>> {
        let PassTimer::Query(gl, query) = timer else { return Ok(None) };
        // SAFETY: the query belongs to the timer alone. OpenGL reports an error if another one is active.
        unsafe { gl.functions()?.begin_query(glow::TIME_ELAPSED, *query) }
        Ok(Some(Self { gl }))
    }
}

impl Drop for ActiveQuery<'_> {
    fn drop(&mut self) {
        let Some(gl) = self.gl.functions_or_skip() else { return };
        // SAFETY: ends the query that `begin` has begun.
        unsafe { gl.end_query(glow::TIME_ELAPSED) }
    }
}

impl PassTimer {
    /// The time in milliseconds. Waits for the result if the device has not finished. 0 if the context cannot be made
    /// current.
    pub(crate) fn ms(&self) -> f64 {
        match self {
            Self::Wall(ms) => *ms,
            Self::Query(gl, query) => {
                let Some(gl) = gl.functions_or_skip() else { return 0.0 };
                // SAFETY: the query was ended; reading its result waits until it is available.
                unsafe { gl.get_query_parameter_u64(*query, glow::QUERY_RESULT) as f64 * 1e-6 }
            }
        }
    }

    /// Whether the device has finished the commands; does not wait.
    pub(crate) fn is_done(&self) -> bool {
        match self {
            Self::Wall(_) => true,
            Self::Query(gl, query) => {
                let Some(gl) = gl.functions_or_skip() else { return false };
                // SAFETY: the query was ended; this asks for availability only.
                unsafe { gl.get_query_parameter_u32(*query, glow::QUERY_RESULT_AVAILABLE) != 0 }
            }
        }
    }
}

impl Drop for PassTimer {
    fn drop(&mut self) {
        if let Self::Query(gl, query) = self {
            // The pool grows to the largest number of queries that were in flight at once.
            gl.free_queries.borrow_mut().push(*query);
        }
    }
}

#[cfg(test)]
impl Gl {
    /// A timer that is never done.
    pub(crate) fn unstarted_timer(self: &Rc<Self>) -> PassTimer {
        // SAFETY: a new name; reading a query that was never begun is an OpenGL error without a result.
        let query = unsafe { self.functions().expect("a current context").create_query() }.expect("a query");
        PassTimer::Query(Rc::clone(self), query)
    }
}

#[cfg(test)]
mod tests {
    use super::delay_ns;

    #[test]
    fn delay_begins_at_the_recording_or_the_end_of_the_previous_commands() {
        assert_eq!(delay_ns(100, 40, 130), 30);
        assert_eq!(delay_ns(100, 120, 130), 10);
        assert_eq!(delay_ns(100, 140, 130), 0);
    }
}
