//! The allocator of the C library.

/// The largest number of arenas. By default, glibc has up to eight per core. Each arena keeps the most memory that its
/// threads have had in use at once, so with 98 arenas on 16 cores, resident memory grew for as long as clients came and
/// went. A server with few arenas takes as many steps per second (`tests/bench/records/h200-soak.json`).
#[cfg(target_env = "gnu")]
const MAX_ARENAS: libc::c_int = 4;

/// Limits the arenas, unless the environment does. Must be called before the first thread is started: arenas that exist
/// remain.
pub(super) fn limit_arenas() {
    #[cfg(target_env = "gnu")]
    if std::env::var_os("MALLOC_ARENA_MAX").is_none() {
        // SAFETY: `mallopt` takes two integers and may be called at any time. It returns 0 for an unknown parameter, and
        // then the limit of the C library remains.
        unsafe { libc::mallopt(libc::M_ARENA_MAX, MAX_ARENAS) };
    }
}
