//! Tests of the OpenGL layer: current contexts, ranges of buffers, ownership of names, timer queries and errors.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Instant;

use super::*;
use crate::device;
use crate::hang_guard::HANG_GUARD;
use crate::types::DevicePreference;

fn open() -> Rc<Gl> {
    device::open(DevicePreference::Any).expect("EGL").0
}

fn is_buffer_alive(gl: &Rc<Gl>, name: glow::Buffer) -> bool {
    // SAFETY: a query without side effects.
    unsafe { gl.functions().expect("a current context").is_buffer(name) }
}

#[test]
fn guards_restore_the_previous_context_also_after_a_panic() {
    let (first, second) = (open(), open());
    assert!(second.context.is_current(), "expected the last opened context to stay current");
    let guard = first.make_current().expect("a current context");
    assert!(first.context.is_current());
    {
        let _nested = second.make_current().expect("a current context");
        assert!(second.context.is_current());
    }
    assert!(first.context.is_current());
    drop(guard);
    assert!(second.context.is_current());
    first.check("test").expect("no error");
    assert!(second.context.is_current(), "expected a command to restore the context");
    let panicked = catch_unwind(AssertUnwindSafe(|| {
        let _guard = first.make_current().expect("a current context");
        assert!(first.context.is_current());
        panic!("injected");
    }));
    assert!(panicked.is_err() && second.context.is_current());
    drop(second);
    first.check("test").expect("no error after the previous context is destroyed");
}

#[test]
fn commands_are_not_issued_while_the_context_is_occupied() {
    let (gl, other) = (open(), open());
    let buffer = gl.buffer(4, STATIC_DRAW, Some(&[1, 2, 3, 4])).expect("a buffer");
    let leaked = gl.buffer(4, STATIC_DRAW, None).expect("a buffer");
    let other_buffer = other.buffer(4, STATIC_DRAW, None).expect("a buffer");
    let occupied_context = gl.occupy();
    for error in [
        gl.make_current().err(),
        gl.check("test").err(),
        gl.buffer(4, STATIC_DRAW, None).err(),
        gl.fence("test").err(),
        buffer.read(4).err(),
    ] {
        let error = error.expect("an error without a context").to_string();
        assert!(error.contains("eglMakeCurrent"), "{error}");
    }
    buffer.write(&[9; 4]);
    // Both contexts number their buffers alike: a deletion on the wrong context would delete `other_buffer`.
    let name = leaked.name();
    // The buffer cannot be deleted now, so it leaks.
    drop(leaked);
    assert!(is_buffer_alive(&other, other_buffer.name()));
    other.check("test").expect("no error of the other context");
    drop(occupied_context);
    let error = gl.check("late").expect_err("an error of the skipped write").to_string();
    assert!(error.contains("late") && error.contains("eglMakeCurrent"), "{error}");
    gl.check("test").expect("an error that is reported once");
    assert_eq!(buffer.read(4).expect("readable bytes"), [1, 2, 3, 4]);
    assert!(is_buffer_alive(&gl, name), "expected a leaked buffer");
}

#[test]
fn ranges_beyond_a_buffer_are_errors_without_an_opengl_call() {
    let gl = open();
    gl.buffer(8, STATIC_DRAW, Some(&[0; 4])).expect_err("too little data");
    gl.buffer(8, STATIC_DRAW, Some(&[0; 12])).expect_err("too much data");
    let small = gl.buffer(3, STATIC_DRAW, Some(&[1, 2, 3])).expect("a buffer of less than 4 bytes");
    assert_eq!(small.read(3).expect("readable bytes"), [1, 2, 3]);
    let (source, target) = (gl.buffer(8, STATIC_DRAW, Some(&[7; 8])), gl.buffer(8, STATIC_DRAW, Some(&[0; 8])));
    let (source, target) = (source.expect("a buffer"), target.expect("a buffer"));
    target.read(9).expect_err("a range beyond the end");
    let assert_rejected = |text: &str| {
        let error = gl.check("test").expect_err("a rejected command").to_string();
        assert!(error.contains(text), "{error}");
        gl.check("test").expect("no error of OpenGL");
    };
    target.write(&[9; 9]);
    assert_rejected("expected a write within 8 bytes, got 9 at byte 0");
    target.write_at(6, &[9; 3]);
    assert_rejected("expected a write within 8 bytes, got 3 at byte 6");
    target.bind_uniform(0, 9);
    assert_rejected("expected at most 8 bytes of uniforms, got 9");
    let full_copy = BufferCopy::first(8, &source, &target);
    for copy in [
        BufferCopy { source_offset: 1, ..full_copy },
        BufferCopy { target_offset: 1, ..full_copy },
        BufferCopy { bytes: 9, ..full_copy },
        BufferCopy { target_offset: u64::MAX, ..full_copy },
    ] {
        gl.copy(copy);
        assert_rejected("expected a copy inside of both buffers");
    }
    assert_eq!(target.read(8).expect("readable bytes"), [0; 8]);
    gl.copy(full_copy);
    gl.check("test").expect("a copy inside of both buffers");
    assert_eq!(target.read(8).expect("readable bytes"), [7; 8]);
}

#[test]
fn buffers_live_until_the_last_reference_is_dropped() {
    let gl = open();
    let buffer = gl.buffer(64, STATIC_DRAW, None).expect("a buffer");
    let (name, handle) = (buffer.name(), buffer.shared());
    let texture = gl.buffer_texture(&buffer, R32F).expect("a texture");
    let attribute = VertexAttribute { location: 0, buffer: &buffer, components: 1, integer: false };
    let array = gl.vertex_array(None, &[attribute]).expect("an array");
    drop(buffer);
    for referrer in [Box::new(handle) as Box<dyn std::any::Any>, Box::new(texture), Box::new(array)] {
        assert!(is_buffer_alive(&gl, name));
        drop(referrer);
    }
    assert!(!is_buffer_alive(&gl, name));
}

#[test]
fn timer_queries_end_when_their_commands_fail_or_panic() {
    let mut gl = open();
    // On hardware, passes are timed with queries.
    Rc::get_mut(&mut gl).expect("not shared").limits.software = false;
    let time_commands = |commands: &dyn Fn() -> Result<()>| gl.time_pass("test", HANG_GUARD, commands);
    time_commands(&|| Err(fault("test", "injected"))).expect_err("the error of the commands");
    assert!(catch_unwind(AssertUnwindSafe(|| time_commands(&|| panic!("injected")))).is_err());
    let timer = time_commands(&|| Ok(())).expect("a timer");
    gl.wait("test", HANG_GUARD).expect("completed commands");
    assert!(timer.is_done());
    gl.check("test").expect("at most one active query at a time");
    drop(timer);
    assert_eq!(gl.free_queries.borrow().len(), 1, "expected one query for all timers");
}

#[test]
fn span_begins_after_its_submission_and_after_the_previous_one() {
    let mut gl = open();
    assert!(gl.begin_span().expect("no error").is_none(), "expected no spans of a software rasterizer");
    Rc::get_mut(&mut gl).expect("not shared").limits.software = false;
    let buffer = gl.buffer(4, STATIC_DRAW, None).expect("a buffer");
    let mut previous_end_ns = 0;
    let measure = |previous_end_ns: &mut u64| {
        let mut span = gl.begin_span().expect("no error").expect("a span");
        buffer.write(&[0; 4]);
        span.end(&gl).expect("no error");
        gl.wait("test", HANG_GUARD).expect("completed commands");
        span.delay_ms(previous_end_ns)
    };
    let begin = Instant::now();
    let delay_ms = measure(&mut previous_end_ns);
    assert!(previous_end_ns > 0 && (0.0..=begin.elapsed().as_secs_f64() * 1e3).contains(&delay_ms), "{delay_ms}");
    let mut far_end_ns = u64::MAX;
    assert_eq!((measure(&mut far_end_ns), far_end_ns), (0.0, u64::MAX), "expected no delay before the previous end");
    assert_eq!(gl.free_timestamps.borrow().len(), 2, "expected two queries for all spans");
}

#[test]
fn panics_discard_the_errors_of_interrupted_commands() {
    let gl = open();
    let buffer = gl.buffer(4, STATIC_DRAW, None).expect("a buffer");
    let interrupt_commands = |has_guard: bool| {
        catch_unwind(AssertUnwindSafe(|| {
            let _guard = has_guard.then(|| gl.make_current().expect("a current context"));
            buffer.write(&[0; 5]);
            // SAFETY: the flag does not exist, and OpenGL rejects it.
            unsafe { gl.functions().expect("a current context").enable(0xFFFF) }
            panic!("injected");
        }))
        .expect_err("a panic");
    };
    interrupt_commands(true);
    gl.check("test").expect("discarded errors");
    interrupt_commands(false);
    gl.check("test").expect_err("control: without a guard, the error remains");
}
