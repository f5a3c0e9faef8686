//! Run-time dispatch: the same Rust, compiled once more for what most x86 machines have.

use pulp::NullaryFnOnce;

#[cfg(target_arch = "x86_64")]
pulp::simd_type!({
    /// 256-bit vectors, fused multiply-add and conversion of halves.
    struct Wide {
        avx: f!("avx"),
        avx2: f!("avx2"),
        fma: f!("fma"),
        f16c: f!("f16c"),
    }
});

/// Runs work on the widest vectors there are. Results do not depend on them: `mul_add` rounds once everywhere. What
/// the work calls must be `#[inline(always)]`, or it stays compiled for any machine.
#[inline(always)]
pub(super) fn vectorized<W: NullaryFnOnce>(work: W) -> W::Output {
    #[cfg(target_arch = "x86_64")]
    if let Some(wide) = Wide::try_new() {
        return wide.vectorize(work);
    }
    work.call()
}
