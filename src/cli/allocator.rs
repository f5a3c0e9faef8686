//! The allocator of the C library.

/// Limits the arenas to one per core, unless the environment limits them. By default, glibc has up to eight per core.
/// Each arena keeps the most memory that its threads have had in use at once, so with 98 arenas on 16 cores, resident
/// memory grew by 14 MB in 15 minutes of clients that come and go, and with 16 arenas by 6 MB. `deploy/README.md` has
/// the measurements, also of the frames per second that fewer arenas cost.
///
/// Must be called before the first thread is started: arenas that exist remain.
pub(super) fn limit_arenas() {
    #[cfg(target_env = "gnu")]
    if std::env::var_os("MALLOC_ARENA_MAX").is_none() {
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let arenas = libc::c_int::try_from(cores).unwrap_or(libc::c_int::MAX);
        // SAFETY: `mallopt` takes two integers and may be called at any time. It returns 0 for an unknown parameter,
        // and then the limit of the C library remains.
        unsafe { libc::mallopt(libc::M_ARENA_MAX, arenas) };
    }
}
