//! Run-time dispatch: compiles the inner loops a second time for x86-64-v3 (AVX2, BMI2), which most x86 machines have.

use pulp::NullaryFnOnce;

/// Runs work with the instructions of x86-64-v3 if the machine has them. Functions that the work calls must be
/// `#[inline(always)]`, or they are compiled for the baseline target.
#[inline(always)]
pub(super) fn run_vectorized<W: NullaryFnOnce>(work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(simd) = pulp::x86::V3::try_new() {
        return simd.vectorize(work);
    }
    work.call()
}
