//! Run-time dispatch: compiles the same Rust code a second time for AVX2 with FMA, which most x86 machines have.

use pulp::NullaryFnOnce;

/// Runs work on 256-bit vectors with fused multiply-add if the machine supports them. The results are the same without
/// them, because `mul_add` rounds once on every machine. Functions that the work calls must be `#[inline(always)]`, or
/// they are compiled for the baseline target.
#[inline(always)]
pub(super) fn run_vectorized<W: NullaryFnOnce>(work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return simd.vectorize(work);
    }
    work.call()
}
