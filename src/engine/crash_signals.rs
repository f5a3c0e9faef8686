//! Handlers of the signals that end a process with a fault. They append the scene that the thread worked for to the crash
//! log, and leave the signal to the handler before them. SIGKILL has no handler, so it is never recorded.
//!
//! SIGBUS has no handler here: its causes lie outside the process, such as a truncated file or missing memory.

use std::fs::File;
use std::io;
use std::mem::MaybeUninit;
use std::os::fd::{FromRawFd as _, IntoRawFd as _, OwnedFd};
use std::ptr;
use std::sync::OnceLock;
use std::sync::atomic::{AtomicI32, Ordering};

use libc::{c_int, c_void};

use super::running_scene::running_scene;
use super::storage::crash_log::CrashRecord;

const SIGNALS: [(c_int, &str); 4] =
    [(libc::SIGSEGV, "SIGSEGV"), (libc::SIGABRT, "SIGABRT"), (libc::SIGFPE, "SIGFPE"), (libc::SIGILL, "SIGILL")];

/// If less than this number of bytes is left to the process, the memory is exhausted, probably by other processes or other
/// scenes.
const SHORT_MEMORY: usize = 256 << 20;

/// Descriptor of the crash log, which the handlers own; -1 before the first call of [`install`].
static CRASH_FILE: AtomicI32 = AtomicI32::new(-1);

/// The actions before those of this module, in the order of [`SIGNALS`]. That of SIGSEGV reports a stack overflow.
static EARLIER_ACTIONS: OnceLock<[libc::sigaction; SIGNALS.len()]> = OnceLock::new();

/// Installs the handlers, once for each process. They append to a copy of `crash_file`, which must be opened to append; a
/// later call replaces the file.
///
/// # Errors
/// The descriptor cannot be copied, or the handlers cannot be installed.
pub(super) fn install(crash_file: &File) -> io::Result<()> {
    let descriptor = crash_file.try_clone()?.into_raw_fd();
    let earlier = CRASH_FILE.swap(descriptor, Ordering::AcqRel);
    if earlier >= 0 {
        // SAFETY: the descriptor comes from `into_raw_fd`, and the swap has removed the only copy of its number.
        drop(unsafe { OwnedFd::from_raw_fd(earlier) });
    }
    let mut is_first = false;
    EARLIER_ACTIONS.get_or_init(|| {
        is_first = true;
        SIGNALS.map(|(signal, _)| present_action(signal))
    });
    if is_first {
        SIGNALS.iter().try_for_each(|(signal, _)| set_handler(*signal))?;
    }
    Ok(())
}

fn present_action(signal: c_int) -> libc::sigaction {
    let mut action = MaybeUninit::<libc::sigaction>::zeroed();
    // SAFETY: `action` is valid for writes, and the null pointer leaves the action unchanged. The call fails only for an
    // invalid signal. An action of zeros is valid, too: the default action.
    unsafe {
        libc::sigaction(signal, ptr::null(), action.as_mut_ptr());
        action.assume_init()
    }
}

fn set_handler(signal: c_int) -> io::Result<()> {
    // SAFETY: an action of zeros is valid: no flags, an empty mask and the default action.
    let mut action: libc::sigaction = unsafe { MaybeUninit::zeroed().assume_init() };
    action.sa_sigaction = handle_signal as *const () as usize;
    // After a stack overflow, only the alternate stack of the thread has space.
    action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK;
    // SAFETY: `action` is valid, and its handler has the signature that `SA_SIGINFO` demands. The handler calls only
    // async-signal-safe functions.
    match unsafe { libc::sigaction(signal, &action, ptr::null_mut()) } {
        0 => Ok(()),
        _ => Err(io::Error::last_os_error()),
    }
}

/// Records the scene of this thread, restores the earlier action, and lets it handle the signal. Everything here is
/// async-signal-safe: it neither allocates, locks nor panics.
extern "C" fn handle_signal(signal: c_int, info: *mut libc::siginfo_t, _context: *mut c_void) {
    // SAFETY: the kernel passes a valid `info` to a handler with `SA_SIGINFO`.
    let info = unsafe { &*info };
    // A fault of an instruction, as opposed to a signal that was sent.
    let is_fault = info.si_code > 0;
    if (is_fault || is_from_this_process(info)) && !is_memory_short() {
        record(signal);
    }
    let index = SIGNALS.iter().position(|(number, _)| *number == signal);
    let earlier = index.and_then(|index| EARLIER_ACTIONS.get()?.get(index));
    // SAFETY: the action is that of `present_action`, or the null pointer, which changes nothing. `sigaction` and `raise`
    // are async-signal-safe.
    unsafe {
        libc::sigaction(signal, earlier.map_or(ptr::null(), ptr::from_ref), ptr::null_mut());
        // After the return, the faulty instruction is executed again and faults again. A sent signal must be sent again.
        if !is_fault {
            libc::raise(signal);
        }
    }
}

/// Whether the process sent the signal to itself, as `abort` does. Others may send it, too, for example `kill`.
fn is_from_this_process(info: &libc::siginfo_t) -> bool {
    // SAFETY: `si_pid` is present in signals that were sent. `getpid` has no preconditions and is async-signal-safe.
    unsafe { info.si_code == libc::SI_TKILL && info.si_pid() == libc::getpid() }
}

/// Whether the memory of the process is exhausted. A failed allocation aborts the process, whatever has taken the memory.
fn is_memory_short() -> bool {
    let (protection, flags) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_PRIVATE | libc::MAP_ANONYMOUS);
    // SAFETY: a new anonymous mapping at an address that the kernel chooses does not affect other memory, and nothing uses
    // it before it is removed. Both calls are system calls without locks in the process.
    unsafe {
        let memory = libc::mmap(ptr::null_mut(), SHORT_MEMORY, protection, flags, -1, 0);
        memory == libc::MAP_FAILED || libc::munmap(memory, SHORT_MEMORY) != 0
    }
}

/// Appends the scene that this thread works for, if there is one.
fn record(signal: c_int) {
    let cause = SIGNALS.iter().find(|(number, _)| *number == signal).map(|(_, name)| *name);
    if let (Some(cause), Some(scene)) = (cause, running_scene()) {
        let record = CrashRecord::new(cause, scene);
        let line = record.line();
        // SAFETY: the pointer and the length are those of a slice. `write` is async-signal-safe; with an invalid
        // descriptor it fails. There is no remedy for a failure.
        unsafe { libc::write(CRASH_FILE.load(Ordering::Acquire), line.as_ptr().cast(), line.len()) };
    }
}
