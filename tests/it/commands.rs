//! Commands of the program `modalcast`: what they print, and their exit codes.

use std::path::Path;
use std::process::{Command, Output};

const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

fn run(folder: &Path, arguments: &[&str]) -> Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalcast"));
    command.current_dir(folder).args(arguments).output().expect("expected the program to start")
}

#[test]
fn render_prints_the_remarks_that_inspect_prints() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a written file");
    write("a.obj", TRIANGLE);
    write("pressure.npy", "");
    let arguments = ["a.obj", "--out", "a.png", "--size", "32x16", "--backend", "cpu", "--renderer", "software"];
    let rendered = run(folder.path(), &[&["render"], &arguments[..]].concat());
    let inspected = run(folder.path(), &["inspect", "a.obj"]);
    let remarks = |output: &Output| {
        assert!(output.status.success(), "{output:?}");
        let text = String::from_utf8_lossy(&output.stdout).into_owned();
        text.lines().filter(|line| line.starts_with("remark: ")).map(str::to_owned).collect::<Vec<_>>()
    };
    assert_eq!(remarks(&rendered), remarks(&inspected));
    assert!(remarks(&rendered)[0].starts_with("remark: not used as modes: pressure.npy"), "{rendered:?}");
}

#[test]
fn view_rejects_what_it_cannot_open_before_it_prints_an_address() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("a written file");
    write("damaged.obj", "v 0 0\n");
    for (model, code) in [("damaged.obj", 3), ("absent.obj", 4)] {
        let output = run(folder.path(), &["view", model, "--no-open", "--backend", "cpu", "--renderer", "off"]);
        assert_eq!(output.status.code(), Some(code), "{model}: {output:?}");
        assert_eq!(String::from_utf8_lossy(&output.stdout), "", "{model}");
        assert!(String::from_utf8_lossy(&output.stderr).contains(model), "{output:?}");
    }
}
