//! Commands of the program `modalcast`: what they print, and their exit codes.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::{Command, Output, Stdio};

use rustix::process::{Pid, Signal, kill_process};

const TRIANGLE: &str = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

fn command(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalcast"));
    command.current_dir(folder).args(arguments);
    command
}

fn run(folder: &Path, arguments: &[&str]) -> Output {
    command(folder, arguments).output().expect("expected the program to start")
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
    write("text.mcap", "text");
    for (model, code) in [("damaged.obj", 3), ("absent.obj", 4), ("text.mcap", 3), ("absent.mcap", 4)] {
        let output = run(folder.path(), &["view", model, "--no-open", "--backend", "cpu", "--renderer", "off"]);
        assert_eq!(output.status.code(), Some(code), "{model}: {output:?}");
        assert_eq!(String::from_utf8_lossy(&output.stdout), "", "{model}");
        assert!(String::from_utf8_lossy(&output.stderr).contains(model), "{output:?}");
    }
}

#[test]
fn view_serves_a_page_that_contains_the_recording() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    std::fs::write(folder.path().join("a.mcap"), b"\x89MCAP0\r\n").expect("expected a written file");
    let mut server =
        command(folder.path(), &["view", "a.mcap", "--no-open"]).stdout(Stdio::piped()).spawn().expect("a process");
    let lines = BufReader::new(server.stdout.take().expect("expected an output")).lines();
    let url = lines.map_while(Result::ok).find_map(|line| line.strip_prefix("open http://").map(str::to_owned));
    let url = url.expect("expected the URL of the page");
    let (host, path) = url.split_once('/').expect("expected a path");
    let mut socket = TcpStream::connect(host).expect("expected a connection");
    write!(socket, "GET /{path} HTTP/1.1\r\nHost: {host}\r\n\r\n").expect("expected a sent request");
    let mut answer = String::new();
    socket.read_to_string(&mut answer).expect("expected a page that is not compressed");
    assert!(answer.starts_with("HTTP/1.1 200"), "{answer}");
    // echo -ne '\x89MCAP0\r\n' | base64
    assert!(answer.contains("<script id=\"recording\" type=\"application/octet-stream\">iU1DQVAwDQo=</script>"));
    let pid = i32::try_from(server.id()).ok().and_then(Pid::from_raw).expect("expected a process");
    kill_process(pid, Signal::TERM).expect("expected a running server");
    assert!(server.wait().expect("expected the end of the server").success());
}
