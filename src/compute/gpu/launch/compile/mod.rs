//! Machine code of kernels: compiled by NVRTC, or taken from the disk cache.

#[cfg(any(test, feature = "testing"))]
mod assembled;
mod cache;
mod nvrtc;

use std::path::PathBuf;

#[cfg(any(test, feature = "testing"))]
pub use self::assembled::{CAPABILITIES, CompiledVariant, assert_compiles};
use self::cache::{CubinCache, cache_key};
pub(crate) use self::nvrtc::{CompileJob, nvrtc};
use modalcast_model::error::Result;

/// Returns the machine code (a cubin) of a source with macros, for compute capability `major.minor`.
///
/// # Errors
/// `Unavailable` when NVRTC is missing or does not know the architecture; `Fault` with the compiler's log.
pub(crate) fn cubin(name: &str, source: &str, defines: &[&str], capability: (i32, i32)) -> Result<Vec<u8>> {
    let nvrtc = nvrtc()?;
    let job = CompileJob::new(name, source, defines, capability);
    let version = format!("{}.{}", nvrtc.version.0, nvrtc.version.1);
    let mut cache_key_parts = job.cache_key_parts();
    cache_key_parts.push(&version);
    let (cache, key) = (CubinCache::from_env(), cache_key(&cache_key_parts));
    if let Some(cubin) = cache.get(&key) {
        return Ok(cubin);
    }
    let cubin = nvrtc.compile(&job)?;
    cache.put(&key, &cubin);
    Ok(cubin)
}

/// The folder of the kernel cache, if there is one.
pub(crate) fn cache_folder() -> Option<PathBuf> {
    CubinCache::from_env().folder().map(PathBuf::from)
}
