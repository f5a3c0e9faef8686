use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::Duration;

use super::*;
use crate::device;
use crate::types::DevicePreference;

fn open() -> Rc<Gl> {
    device::open(DevicePreference::Any).expect("EGL").0
}

fn exists(gl: &Rc<Gl>, name: glow::Buffer) -> bool {
    // SAFETY: a query without side effects.
    unsafe { gl.functions().expect("current").is_buffer(name) }
}

#[test]
fn guards_restore_the_previous_context_also_by_a_panic() {
    let (first, second) = (open(), open());
    assert!(second.context.is_current(), "the last one that was opened stays current");
    let guard = first.make_current().expect("current");
    assert!(first.context.is_current());
    {
        let _nested = second.make_current().expect("current");
        assert!(second.context.is_current());
    }
    assert!(first.context.is_current());
    drop(guard);
    assert!(second.context.is_current());
    first.check("test").expect("no error");
    assert!(second.context.is_current(), "a command restores it too");
    let panicked = catch_unwind(AssertUnwindSafe(|| {
        let _guard = first.make_current().expect("current");
        assert!(first.context.is_current());
        panic!("injected");
    }));
    assert!(panicked.is_err() && second.context.is_current());
    drop(second);
    first.check("test").expect("the context that was current is gone");
}

#[test]
fn commands_without_their_context_are_errors_and_not_issued() {
    let (gl, other) = (open(), open());
    let buffer = gl.buffer(4, STATIC_DRAW, Some(&[1, 2, 3, 4])).expect("a buffer");
    let (leaked, kept) = (gl.buffer(4, STATIC_DRAW, None).expect("a buffer"), other.buffer(4, STATIC_DRAW, None));
    let kept = kept.expect("a buffer");
    let occupied = gl.occupy();
    for error in [
        gl.make_current().err(),
        gl.check("test").err(),
        gl.buffer(4, STATIC_DRAW, None).err(),
        gl.fence("test").err(),
        buffer.read(4).err(),
    ] {
        let error = error.expect("no context").to_string();
        assert!(error.contains("eglMakeCurrent"), "{error}");
    }
    buffer.write(&[9; 4]);
    // Both contexts use the same small names: a deletion on the wrong context would reach `kept`.
    let name = leaked.name();
    drop(leaked);
    assert!(exists(&other, kept.name()));
    other.check("test").expect("the other context is not affected");
    drop(occupied);
    let error = gl.check("late").expect_err("the write was skipped").to_string();
    assert!(error.contains("late") && error.contains("eglMakeCurrent"), "{error}");
    gl.check("test").expect("reported once");
    assert_eq!(buffer.read(4).expect("reads"), [1, 2, 3, 4]);
    assert!(exists(&gl, name), "not deleted");
}

#[test]
fn ranges_beyond_a_buffer_are_errors_before_the_call() {
    let gl = open();
    gl.buffer(8, STATIC_DRAW, Some(&[0; 4])).expect_err("too little data");
    gl.buffer(8, STATIC_DRAW, Some(&[0; 12])).expect_err("too much data");
    let small = gl.buffer(3, STATIC_DRAW, Some(&[1, 2, 3])).expect("fewer bytes than OpenGL's smallest buffer");
    assert_eq!(small.read(3).expect("reads"), [1, 2, 3]);
    let (from, to) = (gl.buffer(8, STATIC_DRAW, Some(&[7; 8])), gl.buffer(8, STATIC_DRAW, Some(&[0; 8])));
    let (from, to) = (from.expect("a buffer"), to.expect("a buffer"));
    to.read(9).expect_err("over the end");
    let reports = |what: &str| {
        let error = gl.check("test").expect_err("refused").to_string();
        assert!(error.contains(what), "{error}");
        gl.check("test").expect("OpenGL was not called");
    };
    to.write(&[9; 9]);
    reports("a write of 9 bytes");
    to.bind_uniform(0, 9);
    reports("9 bytes of uniforms");
    let whole = BufferCopy::first(8, &from, &to);
    for copy in [
        BufferCopy { from_offset: 1, ..whole },
        BufferCopy { to_offset: 1, ..whole },
        BufferCopy { bytes: 9, ..whole },
        BufferCopy { to_offset: u64::MAX, ..whole },
    ] {
        gl.copy(copy);
        reports("a copy beyond the end");
    }
    assert_eq!(to.read(8).expect("reads"), [0; 8]);
    gl.copy(whole);
    gl.check("test").expect("inside");
    assert_eq!(to.read(8).expect("reads"), [7; 8]);
}

#[test]
fn buffers_live_as_long_as_what_refers_to_them() {
    let gl = open();
    let buffer = gl.buffer(64, STATIC_DRAW, None).expect("a buffer");
    let (name, handle) = (buffer.name(), buffer.shared());
    let texture = gl.buffer_texture(&buffer, R32F).expect("a texture");
    let attribute = VertexAttribute { location: 0, buffer: &buffer, components: 1, integer: false };
    let array = gl.vertex_array(None, &[attribute]).expect("an array");
    drop(buffer);
    for one in [Box::new(handle) as Box<dyn std::any::Any>, Box::new(texture), Box::new(array)] {
        assert!(exists(&gl, name));
        drop(one);
    }
    assert!(!exists(&gl, name));
}

#[test]
fn timer_queries_end_when_their_commands_fail_or_panic() {
    let mut gl = open();
    Rc::get_mut(&mut gl).expect("not shared").limits.software = false;
    let time = |commands: &dyn Fn() -> Result<()>| gl.time_pass(("test", Duration::from_secs(60)), commands);
    time(&|| Err(fault_in("test")("injected"))).expect_err("failed");
    assert!(catch_unwind(AssertUnwindSafe(|| time(&|| panic!("injected")))).is_err());
    let timer = time(&|| Ok(())).expect("measures");
    gl.wait("test", Duration::from_secs(60)).expect("done");
    assert!(timer.is_done());
    gl.check("test").expect("only one query was active at a time");
    drop(timer);
    assert_eq!(gl.free_queries.borrow().len(), 1, "all used the same query");
}

#[test]
fn panics_discard_the_errors_of_interrupted_commands() {
    let gl = open();
    let buffer = gl.buffer(4, STATIC_DRAW, None).expect("a buffer");
    let interrupted = |has_guard: bool| {
        catch_unwind(AssertUnwindSafe(|| {
            let _guard = has_guard.then(|| gl.make_current().expect("current"));
            buffer.write(&[0; 5]);
            // SAFETY: the flag does not exist, and OpenGL rejects it.
            unsafe { gl.functions().expect("current").enable(0xFFFF) }
            panic!("injected");
        }))
        .expect_err("panicked");
    };
    interrupted(true);
    gl.check("test").expect("discarded");
    interrupted(false);
    gl.check("test").expect_err("control: without a guard, the error remains");
}
