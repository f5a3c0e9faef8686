//! Measures the device time of passes, and waits for the device.

use std::rc::Rc;
use std::time::{Duration, Instant};

use glow::HasContext as _;

use super::Gl;
use modalcast_model::error::{Result, fault_in};

/// Milliseconds of a sequence of commands. Hardware uses a timer query. Software uses the wall clock and waits before
/// and after, because its timer queries are meaningless.
#[derive(Debug)]
pub(crate) enum PassTimer {
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

    /// Runs the commands of a pass and measures their device time. In software this waits for them, at most `limit`.
    /// Each pass owns a query until its stopwatch is dropped, so that several frames can be in flight.
    ///
    /// # Errors
    /// Those of the commands; `Fault` of the pass when software does not finish in time.
    pub(crate) fn time_pass(
        self: &Rc<Self>,
        (pass, limit): (&'static str, Duration),
        commands: impl FnOnce() -> Result<()>,
    ) -> Result<PassTimer> {
        if self.limits.software {
            self.wait(pass, limit)?;
            let begin = Instant::now();
            commands()?;
            self.wait(pass, limit)?;
            return Ok(PassTimer::Wall(begin.elapsed().as_secs_f64() * 1e3));
        }
        let gl = self.current();
        let free = self.free_queries.borrow_mut().pop();
        // SAFETY: queries do not nest: this one is ended before the function returns, even if the commands fail. A
        // query from the pool has no other user.
        let query = unsafe {
            let query = free.map_or_else(|| gl.create_query(), Ok).map_err(fault_in("timer"))?;
            gl.begin_query(glow::TIME_ELAPSED, query);
            query
        };
        let timer = PassTimer::Query(Rc::clone(self), query);
        let done = commands();
        // SAFETY: ends the query that was begun above.
        unsafe { self.current().end_query(glow::TIME_ELAPSED) }
        done.map(|()| timer)
    }
}

impl PassTimer {
    /// Milliseconds. Waits for the result if the device has not finished.
    pub(crate) fn ms(&self) -> f64 {
        match self {
            Self::Wall(ms) => *ms,
            // SAFETY: the query was ended; reading its result waits until it is available.
            Self::Query(gl, query) => unsafe {
                gl.current().get_query_parameter_u64(*query, glow::QUERY_RESULT) as f64 * 1e-6
            },
        }
    }

    /// Whether the device has finished the commands; does not wait.
    pub(crate) fn is_done(&self) -> bool {
        match self {
            Self::Wall(_) => true,
            // SAFETY: the query was ended; this asks for availability only.
            Self::Query(gl, query) => unsafe {
                gl.current().get_query_parameter_u32(*query, glow::QUERY_RESULT_AVAILABLE) != 0
            },
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
    /// A stopwatch for commands that the device never reaches.
    pub(crate) fn unstarted_timer(self: &Rc<Self>) -> PassTimer {
        // SAFETY: a new name; reading a query that was never begun is an OpenGL error without a result.
        let query = unsafe { self.current().create_query() }.expect("a query");
        PassTimer::Query(Rc::clone(self), query)
    }
}
