//! How long stretches of commands take, and waiting for all of them.

use std::rc::Rc;
use std::time::{Duration, Instant};

use glow::HasContext as _;

use super::Gl;
use modalcast_model::error::{Result, during};

/// Milliseconds of a stretch of commands: a timer query on hardware, the wall clock around waiting in software, where timer
/// queries mean nothing.
#[derive(Debug)]
pub(crate) enum Stopwatch {
    Wall(f64),
    Query(Rc<Gl>, glow::Query),
}

impl Gl {
    /// Waits until all commands are done.
    ///
    /// # Errors
    /// `Fault` of `stage` when the device did not finish within `limit`.
    pub(crate) fn wait(self: &Rc<Self>, stage: &'static str, limit: Duration) -> Result<()> {
        self.fence(stage)?.wait(stage, limit)
    }

    /// Runs the commands of a pass and tells how long they take; in software this waits for them, at most `limit`. Each
    /// stretch has a query of its own until its stopwatch is dropped, so that several frames may be under way.
    ///
    /// # Errors
    /// Those of the commands; `Fault` of the pass when software did not finish.
    pub(crate) fn timed(
        self: &Rc<Self>,
        (pass, limit): (&'static str, Duration),
        commands: impl FnOnce() -> Result<()>,
    ) -> Result<Stopwatch> {
        if self.limits.software {
            self.wait(pass, limit)?;
            let begin = Instant::now();
            commands()?;
            self.wait(pass, limit)?;
            return Ok(Stopwatch::Wall(begin.elapsed().as_secs_f64() * 1e3));
        }
        let gl = self.on();
        let free = self.timers.borrow_mut().pop();
        // SAFETY: one query at a time: it is ended before this returns, whatever the commands did. One that was used before is
        // waited for by nobody.
        let query = unsafe {
            let query = free.map_or_else(|| gl.create_query(), Ok).map_err(during("timer"))?;
            gl.begin_query(glow::TIME_ELAPSED, query);
            query
        };
        let stopwatch = Stopwatch::Query(Rc::clone(self), query);
        let done = commands();
        // SAFETY: ends the query that was begun above.
        unsafe { self.on().end_query(glow::TIME_ELAPSED) }
        done.map(|()| stopwatch)
    }
}

impl Stopwatch {
    /// Milliseconds; for a stretch that was ended and waited for.
    pub(crate) fn ms(&self) -> f64 {
        match self {
            Self::Wall(ms) => *ms,
            // SAFETY: the query was ended; its result is there or waited for.
            Self::Query(gl, query) => unsafe {
                gl.on().get_query_parameter_u64(*query, glow::QUERY_RESULT) as f64 * 1e-6
            },
        }
    }

    /// Whether the device has done the stretch; nothing is waited for.
    pub(crate) fn is_over(&self) -> bool {
        match self {
            Self::Wall(_) => true,
            // SAFETY: the query was ended; this only asks.
            Self::Query(gl, query) => unsafe {
                gl.on().get_query_parameter_u32(*query, glow::QUERY_RESULT_AVAILABLE) != 0
            },
        }
    }
}

impl Drop for Stopwatch {
    fn drop(&mut self) {
        if let Self::Query(gl, query) = self {
            // There are as many as were ever under way at once.
            gl.timers.borrow_mut().push(*query);
        }
    }
}

#[cfg(test)]
impl Gl {
    /// A stopwatch of a stretch that the device never comes to.
    pub(crate) fn stopped_watch(self: &Rc<Self>) -> Stopwatch {
        // SAFETY: a fresh name; asking for a query that was never begun is an error without a result.
        let query = unsafe { self.on().create_query() }.expect("a query");
        Stopwatch::Query(Rc::clone(self), query)
    }
}
