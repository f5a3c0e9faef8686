//! Injected faults of devices, with which tests show how the server recovers. Only programs that are built with the
//! feature `fault-injection` have them; in all others, a check is an empty function.
//!
//! The environment variable `MODALCAST_INJECT` lists faults as `POINT:FAULT:CALL`, separated by commas: the CALL-th call
//! at a point, counted from 1, has the fault. For example, `frame:lost:3` loses the renderer at the third frame.

#[cfg(not(feature = "fault-injection"))]
use crate::error::Result;

/// Where a fault can be injected.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InjectionPoint {
    /// The submission of a frame to OpenGL.
    Frame,
    /// The access to the pixels of a frame.
    Pixels,
    /// The allocation of a render target.
    Target,
    /// The computation of a step.
    Deform,
    /// The launch of a CUDA kernel or graph.
    Launch,
    /// The access of CUDA to buffers of OpenGL.
    Interop,
}

/// Fails, or does not return, if a fault is planned for this call.
///
/// # Errors
/// The planned fault: `Fault`, or `RendererLost` or `DeviceLost`.
#[cfg(not(feature = "fault-injection"))]
#[inline]
pub const fn check(_: InjectionPoint) -> Result<()> {
    Ok(())
}

/// Ends an injected loss of the renderer: the renderer was opened again.
#[cfg(not(feature = "fault-injection"))]
#[inline]
pub const fn reopen_renderer() {}

#[cfg(feature = "fault-injection")]
pub use planned::{check, reopen_renderer};

#[cfg(feature = "fault-injection")]
mod planned {
    use std::sync::LazyLock;
    use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
    use std::time::Duration;

    use super::InjectionPoint;
    use crate::error::{Error, Result, fault};

    const POINTS: [(&str, InjectionPoint); 6] = [
        ("frame", InjectionPoint::Frame),
        ("pixels", InjectionPoint::Pixels),
        ("target", InjectionPoint::Target),
        ("deform", InjectionPoint::Deform),
        ("launch", InjectionPoint::Launch),
        ("interop", InjectionPoint::Interop),
    ];

    /// What happens instead of a call.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    enum PlannedFault {
        /// The call fails. The device still works.
        Error,
        OutOfMemory,
        /// The context of the renderer, or that of CUDA, is lost.
        Lost,
        /// The call does not return.
        Endless,
    }

    #[derive(Debug)]
    struct Plan {
        point: InjectionPoint,
        fault: PlannedFault,
        /// Number of the call that has the fault.
        call: u64,
        calls: AtomicU64,
    }

    static PLANS: LazyLock<Vec<Plan>> = LazyLock::new(|| {
        let text = std::env::var("MODALCAST_INJECT").unwrap_or_default();
        let plans = text.split(',').filter(|word| !word.is_empty()).filter_map(|word| {
            let plan = parse(word);
            match &plan {
                Some(plan) => tracing::warn!(?plan, "a fault is planned"),
                None => tracing::error!("MODALCAST_INJECT: expected POINT:FAULT:CALL, got '{word}'"),
            }
            plan
        });
        plans.collect()
    });

    /// Whether an injected loss of the renderer lasts.
    static IS_RENDERER_LOST: AtomicBool = AtomicBool::new(false);

    fn parse(word: &str) -> Option<Plan> {
        let mut fields = word.split(':');
        let (point, fault, call) = (fields.next()?, fields.next()?, fields.next()?);
        let (_, point) = POINTS.into_iter().find(|(name, _)| *name == point)?;
        let fault = match fault {
            "error" => PlannedFault::Error,
            "out-of-memory" => PlannedFault::OutOfMemory,
            "lost" => PlannedFault::Lost,
            "endless" => PlannedFault::Endless,
            _ => return None,
        };
        Some(Plan { point, fault, call: call.parse().ok()?, calls: AtomicU64::new(0) })
    }

    const fn is_of_renderer(point: InjectionPoint) -> bool {
        matches!(point, InjectionPoint::Frame | InjectionPoint::Pixels | InjectionPoint::Target)
    }

    fn renderer_lost() -> Error {
        Error::RendererLost { stage: "draw", reason: "injected".into() }
    }

    /// See the function without the feature.
    pub fn check(point: InjectionPoint) -> Result<()> {
        if is_of_renderer(point) && IS_RENDERER_LOST.load(Ordering::Relaxed) {
            return Err(renderer_lost());
        }
        for plan in PLANS.iter().filter(|plan| plan.point == point) {
            if plan.calls.fetch_add(1, Ordering::Relaxed) + 1 != plan.call {
                continue;
            }
            tracing::warn!(?plan, "a fault is injected");
            match plan.fault {
                PlannedFault::Error => return Err(fault("device", "an injected error")),
                PlannedFault::OutOfMemory => return Err(fault("device", "an injected error: out of memory")),
                PlannedFault::Lost if is_of_renderer(point) => {
                    IS_RENDERER_LOST.store(true, Ordering::Relaxed);
                    return Err(renderer_lost());
                }
                PlannedFault::Lost => {
                    return Err(Error::DeviceLost { stage: "deform", reason: "injected".into() });
                }
                PlannedFault::Endless => loop {
                    std::thread::sleep(Duration::from_secs(1));
                },
            }
        }
        Ok(())
    }

    /// See the function without the feature.
    pub fn reopen_renderer() {
        IS_RENDERER_LOST.store(false, Ordering::Relaxed);
    }
}
