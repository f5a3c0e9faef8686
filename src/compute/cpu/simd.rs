//! Run-time dispatch: the same Rust, compiled once more for what most x86 machines have.

use pulp::NullaryFnOnce;

/// Runs work on 256-bit vectors with fused multiply-add where the machine has them. Results do not depend on that:
/// `mul_add` rounds once everywhere. What the work calls must be `#[inline(always)]`, or it stays compiled for any
/// machine.
#[inline(always)]
pub(super) fn vectorized<W: NullaryFnOnce>(work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(wide) = pulp::x86::V3::try_new() {
        return wide.vectorize(work);
    }
    work.call()
}
