//! Fences: markers in the command stream that the host can poll or wait for.

use std::rc::Rc;
use std::time::{Duration, Instant};

use glow::HasContext as _;

use super::Gl;
use modalcast_model::error::{Result, fault, fault_in};

/// A fence: signaled once all commands before it are complete.
#[derive(Debug)]
pub(crate) struct Fence {
    gl: Rc<Gl>,
    name: glow::Fence,
    /// Whether each wait fails.
    #[cfg(test)]
    is_broken: bool,
}

impl Gl {
    /// Inserts a fence after all commands so far and flushes them to the device.
    pub(crate) fn fence(self: &Rc<Self>, stage: &'static str) -> Result<Fence> {
        let gl = self.functions()?;
        // SAFETY: a new fence, owned by the returned value.
        let name = unsafe { gl.fence_sync(glow::SYNC_GPU_COMMANDS_COMPLETE, 0) }.map_err(fault_in(stage))?;
        let fence = Fence {
            gl: Rc::clone(self),
            name,
            #[cfg(test)]
            is_broken: false,
        };
        // SAFETY: only submits commands.
        unsafe { gl.flush() }
        Ok(fence)
    }
}

impl Fence {
    /// Whether waiting is over: the commands are complete, or the wait fails and [`Self::wait`] returns the reason.
    pub(crate) fn is_done(&self) -> bool {
        self.is_done_within(Duration::ZERO)
    }

    /// Like [`Self::is_done`], after waiting at most `limit` or one second, whichever is shorter.
    pub(crate) fn is_done_within(&self, limit: Duration) -> bool {
        self.poll("fence", limit).unwrap_or(true)
    }

    /// Waits until the commands are complete.
    ///
    /// # Errors
    /// `Fault` of `stage` when the device does not finish within `limit` or when the wait fails; `DeviceLost` when the
    /// context is lost.
    pub(crate) fn wait(&self, stage: &'static str, limit: Duration) -> Result<()> {
        let start = Instant::now();
        while !self.poll(stage, limit.saturating_sub(start.elapsed()))? {
            if start.elapsed() >= limit {
                return Err(fault(stage, format!("the device did not finish within {limit:?}")));
            }
        }
        Ok(())
    }

    /// Whether the commands are complete, after waiting at most `limit` or one second, whichever is shorter.
    fn poll(&self, stage: &'static str, limit: Duration) -> Result<bool> {
        // glow has 32 bits for the nanoseconds, so one call waits at most one second.
        let timeout_ns = limit.min(Duration::from_secs(1)).as_nanos() as i32;
        let gl = self.gl.functions().map_err(fault_in(stage))?;
        // SAFETY: the fence lives as long as this value.
        let status = unsafe { gl.client_wait_sync(self.name, glow::SYNC_FLUSH_COMMANDS_BIT, timeout_ns) };
        #[cfg(test)]
        let status = if self.is_broken { glow::WAIT_FAILED } else { status };
        match status {
            glow::ALREADY_SIGNALED | glow::CONDITION_SATISFIED => Ok(true),
            glow::TIMEOUT_EXPIRED => Ok(false),
            _ => Err(self
                .gl
                .renderer_lost_error(stage)
                .unwrap_or_else(|| fault(stage, "the wait for the device failed"))),
        }
    }
}

impl Drop for Fence {
    fn drop(&mut self) {
        // SAFETY: this value owns the name, which is not used afterwards.
        self.gl.delete(|gl| unsafe { gl.delete_sync(self.name) });
    }
}

#[cfg(test)]
impl Gl {
    /// A fence for which no wait succeeds.
    pub(crate) fn broken_fence(self: &Rc<Self>) -> Fence {
        let mut fence = self.fence("test").expect("a fence");
        fence.is_broken = true;
        fence
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::device::gl::TextureDesc;
    use crate::hang_guard::HANG_GUARD;
    use crate::{DevicePreference, device};

    /// Draws an image that takes longer than a millisecond: `iterations` sines per pixel. A software driver draws it on
    /// its own threads.
    fn draw_for_long(gl: &Rc<Gl>, iterations: u32) {
        let (target, format) = (glow::TEXTURE_2D, glow::RGBA8);
        let desc = TextureDesc { target, format, width: 2048, height: 2048, depth: 1, levels: 1 };
        let color = gl.texture(desc).expect("a texture");
        let framebuffer = gl.color_framebuffer(&color).expect("complete");
        let vertex_source = "#version 430 core\nvoid main() { gl_Position = vec4(4 * (gl_VertexID & 1) - 1, 2 * (gl_VertexID & 2) - 1, \
                      0, 1); }";
        let fragment_source = format!(
            "#version 430 core\nout vec4 color;\nvoid main() {{ float x = gl_FragCoord.x; for (int i = 0; i < {iterations}; ++i) \
             x = sin(x); color = vec4(x); }}"
        );
        let stages = [(glow::VERTEX_SHADER, vertex_source), (glow::FRAGMENT_SHADER, &fragment_source)];
        let program = gl.program("long", &stages).expect("compiles");
        let empty_vertex_array = gl.vertex_array(None, &[]).expect("an array");
        gl.set_pipeline_state(super::super::PipelineState::default());
        program.bind(None);
        gl.draw_fullscreen_triangle(&framebuffer, 2048, &empty_vertex_array);
    }

    /// The draws become longer until one is unfinished at the wait, because a busy machine may delay this thread.
    #[test]
    fn wait_returns_an_error_with_its_stage_after_the_limit() {
        let (gl, _) = device::open(DevicePreference::Any).expect("EGL");
        let shortest = if gl.limits.software { 200 } else { 20_000 };
        let mut draws = (0..10).map(|doublings| {
            draw_for_long(&gl, shortest << doublings);
            let fence = gl.fence("long").expect("a fence");
            let was_done = fence.is_done();
            let error = fence.wait("long", Duration::from_millis(1)).err();
            (fence, was_done, error)
        });
        let (fence, timeout) = draws
            .find_map(|(fence, was_done, error)| error.filter(|_| !was_done).map(|error| (fence, error.to_string())))
            .expect("an unfinished draw");
        assert!(timeout.contains("long") && timeout.contains("the device did not finish within 1ms"), "{timeout}");
        fence.wait("long", HANG_GUARD).expect("a finished draw");
        assert!(fence.is_done() && fence.is_done_within(HANG_GUARD));
        fence.wait("long", Duration::ZERO).expect("no timeout of a signaled fence");
        let failure = gl.broken_fence().wait("gone", HANG_GUARD).expect_err("a failed wait").to_string();
        assert!(failure.contains("gone") && failure.contains("the wait for the device failed"), "{failure}");
    }
}
