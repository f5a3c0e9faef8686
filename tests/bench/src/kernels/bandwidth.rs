//! Launches `kernels/bandwidth.cu`: kernels that copy, read and fill device memory, and kernels that help with timing.

use cudarc::driver::{CudaFunction, LaunchConfig, PushKernelArg as _};

use super::kernel_benchmark::BenchmarkSource;
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, fault_in};

/// Threads per block.
const BLOCK: u64 = 256;
/// Bytes of a `uint4`, the vector that `copy` and `read` access.
const VECTOR_BYTES: u64 = 16;

/// Macros of the variant of `read` that evicts the L2 cache. The lines that it reads must stay in the cache, so it does
/// not use streaming loads.
pub(super) const L2_FLUSH_DEFINES: &[&str] = &["LOADS=8"];
/// Loads per thread of the variant that evicts the L2 cache, as in [`L2_FLUSH_DEFINES`].
pub(super) const L2_FLUSH_LOADS: u64 = 8;

pub(super) const SOURCE: BenchmarkSource = BenchmarkSource {
    text: include_str!("../../kernels/bandwidth.cu"),
    functions: &["copy", "read", "fill", "delay", "empty_kernel"],
    define_sets: &[
        // For `fill`, `delay` and `empty_kernel`, which use no macros.
        &[],
        &["LOADS=1", "STREAMING"],
        &["LOADS=2", "STREAMING"],
        &["LOADS=4", "STREAMING"],
        &["LOADS=8", "STREAMING"],
        &["LOADS=16", "STREAMING"],
        &["LOADS=1"],
        &["LOADS=4"],
        &["LOADS=8"],
        &["LOADS=16"],
    ],
};

/// Bytes of a tile, the work of one block of `copy` or `read` with `loads` loads per thread.
pub(super) const fn tile_bytes(loads: u64) -> u64 {
    BLOCK * loads * VECTOR_BYTES
}

/// Launches `copy` or `read`. `buffers` are the device addresses of the source and the destination.
pub(super) fn launch(device: &Device, function: &CudaFunction, blocks: u32, buffers: [u64; 2]) -> Result<()> {
    let mut launch = device.stream().launch_builder(function);
    // SAFETY: the arguments of the kernels are two addresses. All callers pass buffers of at least `blocks` tiles.
    unsafe { launch.arg(&buffers[0]).arg(&buffers[1]).launch(config(blocks)) }.map_err(fault_in("bandwidth"))?;
    Ok(())
}

fn config(blocks: u32) -> LaunchConfig {
    LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (BLOCK as u32, 1, 1), shared_mem_bytes: 0 }
}

/// Loads per thread and macros of all compiled variants of `copy` and `read`.
pub(super) fn variants() -> impl Iterator<Item = (u64, &'static [&'static str])> {
    let loads_per_thread = |defines: &[&str]| defines.first()?.strip_prefix("LOADS=")?.parse().ok();
    SOURCE.define_sets.iter().filter_map(move |defines| Some((loads_per_thread(defines)?, *defines)))
}

/// A buffer of pseudo-random numbers, because memory that holds zeros may be faster than memory in use.
pub(super) fn random_buffer(device: &Device, bytes: u64) -> Result<DeviceBuffer> {
    let buffer = DeviceBuffer::zeroed(device, bytes)?;
    let function = device.function("fill", SOURCE.text, &[])?;
    let (dst, words) = (buffer.address(), bytes / 4);
    let mut launch = device.stream().launch_builder(&function);
    let config = config(words.div_ceil(BLOCK) as u32);
    // SAFETY: the kernel's arguments are the address of `buffer` and its number of words.
    unsafe { launch.arg(&dst).arg(&words).launch(config) }.map_err(fault_in("bandwidth"))?;
    Ok(buffer)
}

#[cfg(test)]
mod tests {
    use super::super::kernel_benchmark::tests::compile_all;
    use super::*;

    /// CPU twin (the same algorithm in Rust) of the addressing of `copy` and `read`: the indices of the vectors that
    /// they access.
    fn twin_of_copy(blocks: u64, loads: u64) -> Vec<u64> {
        let threads = (0..blocks).flat_map(|block| (0..BLOCK).map(move |thread| block * BLOCK * loads + thread));
        threads.flat_map(|first| (0..loads).map(move |index| first + index * BLOCK)).collect()
    }

    /// CPU twin of `fill`: the same algorithm in Rust, for one word.
    fn twin_of_fill(index: u32) -> u32 {
        let mut key = index ^ index >> 16;
        key = key.wrapping_mul(0x85eb_ca6b);
        key ^= key >> 13;
        key = key.wrapping_mul(0xc2b2_ae35);
        (key ^ key >> 16) & 0x7fff_ffff
    }

    #[test]
    fn copies_every_vector_once_for_any_loads_per_thread() {
        let loads: Vec<u64> = variants().map(|(loads, _)| loads).collect();
        assert_eq!(loads.len(), SOURCE.define_sets.len() - 1, "expected a variant for every set but the empty one");
        for loads in loads {
            // A whole number of tiles for every variant, because every number of loads divides 16.
            let bytes = 3 * tile_bytes(16);
            let mut vector_indices = twin_of_copy(bytes / tile_bytes(loads), loads);
            vector_indices.sort_unstable();
            assert!(vector_indices.iter().copied().eq(0..bytes / VECTOR_BYTES), "{loads} loads");
        }
    }

    #[test]
    fn filled_words_differ_and_are_never_all_ones() {
        let words: std::collections::BTreeSet<u32> = (0..4096).map(twin_of_fill).collect();
        // The finalizer of MurmurHash3 is a bijection, but `fill` clears the top bit, so a few words may coincide.
        assert!(words.len() > 4090);
        // `read` writes only if it reads a word of all ones.
        assert!(words.iter().all(|word| *word != u32::MAX));
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_bandwidth() {
        compile_all(&SOURCE);
    }
}
