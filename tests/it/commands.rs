//! Commands of the program `modalcast`: what they print, and their exit codes.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::os::unix::fs::PermissionsExt as _;
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

/// A box of this size in an OBJ file with a material library that does not exist.
fn box_without_materials(size: f64) -> String {
    let mut text = String::from("mtllib absent.mtl\n");
    for corner in 0..8_u32 {
        let [x, y, z] = [0, 1, 2].map(|axis| size * f64::from(corner >> axis & 1));
        text.push_str(&format!("v {x} {y} {z}\n"));
    }
    text + "usemtl red\nf 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n"
}

const ON_CPU: [&str; 4] = ["--backend", "cpu", "--renderer", "off"];

#[test]
fn strict_mode_is_the_same_in_all_commands() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    std::fs::write(folder.path().join("a.obj"), box_without_materials(1.0)).expect("expected a written file");
    let view = [&["view", "--no-open"], &ON_CPU[..]].concat();
    let errors: Vec<String> = [&["inspect"][..], &["render", "--out", "a.png"], &view[..]]
        .into_iter()
        .map(|command| {
            let output = run(folder.path(), &[command, &["a.obj", "--strict"]].concat());
            assert_eq!(output.status.code(), Some(3), "{output:?}");
            String::from_utf8_lossy(&output.stderr).into_owned()
        })
        .collect();
    for error in &errors {
        assert!(error.contains("absent.mtl") && error.contains("(strict mode)"), "{error}");
    }
    assert!(run(folder.path(), &["inspect", "a.obj"]).status.success(), "control: a remark");
}

#[test]
fn unit_and_up_axis_of_the_command_line_are_those_of_the_scene() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    std::fs::write(folder.path().join("a.obj"), box_without_materials(200.0)).expect("expected a written file");
    let inspect = |options: &[&str]| {
        let output = run(folder.path(), &[&["inspect", "a.obj"], options].concat());
        assert!(output.status.success(), "{output:?}");
        String::from_utf8_lossy(&output.stdout).into_owned()
    };
    let size_remark = "remark: the scene is 200 x 200 x 200 m; if its file is in millimeters, pass --unit mm";
    let by_default = inspect(&[]);
    assert!(by_default.contains("up Y, unit 1 m") && by_default.contains(size_remark), "{by_default}");
    let in_millimeters = inspect(&["--unit", "mm", "--up", "x"]);
    assert!(in_millimeters.contains("up X, unit 0.001 m"), "{in_millimeters}");
    assert!(!in_millimeters.contains("the scene is"), "{in_millimeters}");
    for (command, message) in [
        (&["inspect", "a.obj", "--unit", "yard"][..], "expected m, mm, cm"),
        (&["render", "a.obj", "--out", "a.png", "--up", "0,1,0"][..], "expected x, y or z"),
        (&["render", "a.obj", "--out", "a.png", "--camera-up", "0,1,0"][..], "--eye"),
    ] {
        let output = run(folder.path(), command);
        assert_eq!(output.status.code(), Some(2), "{output:?}");
        assert!(String::from_utf8_lossy(&output.stderr).contains(message), "{output:?}");
    }
    let recording = folder.path().join("a.mcap");
    std::fs::write(recording, b"\x89MCAP0\r\n").expect("expected a written file");
    let output = run(folder.path(), &["view", "a.mcap", "--no-open", "--unit", "mm"]);
    assert!(String::from_utf8_lossy(&output.stderr).contains("expected a model, got a recording"), "{output:?}");
}

/// The unit of a file without computed modes is that of the scene. With them, it is that of the surface, and the result
/// is in meters.
#[test]
fn view_with_a_unit_computes_no_modes_unless_they_are_requested() {
    let folder = folder_with_stand_in();
    let folder = folder.path();
    std::fs::write(folder.join("part.obj"), box_without_materials(200.0)).expect("expected a written file");
    let mut command = Command::new(folder.join("modalcast"));
    command.current_dir(folder).args(["view", "part.obj", "--unit", "mm", "--up", "x", "--no-open", "--no-sim"]);
    let mut view = command.args(ON_CPU).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().expect("a process");
    let lines = BufReader::new(view.stdout.take().expect("expected an output")).lines();
    assert!(lines.map_while(Result::ok).any(|line| line.starts_with("open http://")), "expected an open scene");
    kill_process(Pid::from_child(&view), Signal::TERM).expect("expected a running server");
    let mut log = String::new();
    view.stderr.take().expect("expected a log").read_to_string(&mut log).expect("expected text");
    assert!(view.wait().expect("expected the end of the server").success());
    assert!(!folder.join("runs").exists(), "no modes");
    assert!(log.contains("absent.mtl") && !log.contains("the scene is 200"), "{log}");

    let mut command = view_command(folder, "steel");
    let output =
        command.args(["--unit", "mm", "--up", "x", "--strict"]).output().expect("expected the program to start");
    let log = String::from_utf8_lossy(&output.stderr);
    assert!(log.starts_with("modes of --progress=auto --unit=mm --up=x --strict --material=steel"), "{log}");
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

/// A folder with the program `modalcast` and a stand-in for `modalcast-modes`, which counts its runs in the file `runs`.
fn folder_with_stand_in() -> tempfile::TempDir {
    let program = Path::new(env!("CARGO_BIN_EXE_modalcast"));
    // In the folder of the program, because a hard link cannot cross file systems.
    let folder = tempfile::tempdir_in(program.parent().expect("expected a folder")).expect("expected a folder");
    std::fs::hard_link(program, folder.path().join("modalcast")).expect("expected a link");
    let script = format!(
        "#!/bin/sh\n[ \"$1\" = --build ] && {{ echo {}; exit; }}\necho >>runs\necho \"modes of $*\" >&2\n\
         case \"$*\" in *=slow*) exec sleep 600;; *=bad*) echo 'error: no material' >&2; exit 2;; esac\n\
         while [ \"$1\" != --out ]; do shift; done\necho model >\"$2\"\necho mass 1 kg\necho \"written $2\"\n",
        modalcast::BUILD
    );
    let path = folder.path().join("modalcast-modes");
    std::fs::write(&path, script).expect("expected a written file");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).expect("expected changed permissions");
    std::fs::write(folder.path().join("part.obj"), TRIANGLE).expect("expected a written file");
    folder
}

/// `modalcast view part.obj` with a material, and with its cache in the folder.
fn view_command(folder: &Path, material: &str) -> Command {
    let mut command = Command::new(folder.join("modalcast"));
    command.current_dir(folder).env("XDG_CACHE_HOME", folder.join("cache")).args(["view", "part.obj", "--material"]);
    command.args([material, "--no-open", "--backend", "cpu", "--renderer", "off"]);
    command
}

/// Names of the entries in the cache of [`view_command`].
fn cached_names(folder: &Path) -> Vec<String> {
    let entries = std::fs::read_dir(folder.join("cache/modalcast/models")).into_iter().flatten().flatten();
    entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect()
}

#[test]
fn view_computes_modes_once_for_a_surface_and_its_options() {
    let folder = folder_with_stand_in();
    let folder = folder.path();
    for (runs, material) in [(1, "steel"), (1, "steel"), (2, "brass"), (2, "steel")] {
        let output = view_command(folder, material).output().expect("expected the program to start");
        let text = String::from_utf8_lossy(&output.stdout);
        assert!(text.starts_with("mass 1 kg\ncached    /"), "{output:?}");
        assert!(text.trim_end().ends_with("/part.npz"), "the scene has the name of the part: {text}");
        // The stand-in writes no archive, which ends the server.
        assert!(String::from_utf8_lossy(&output.stderr).contains("part.npz': archive: expected"), "{output:?}");
        assert_eq!(std::fs::read_to_string(folder.join("runs")).expect("expected runs").len(), runs);
        assert_eq!(cached_names(folder).len(), runs, "{:?}", cached_names(folder));
    }
    std::fs::write(folder.join("part.obj"), TRIANGLE.replace('1', "2")).expect("expected a written file");
    view_command(folder, "steel").output().expect("expected the program to start");
    assert_eq!(cached_names(folder).len(), 3, "another surface");
}

#[test]
fn view_ends_as_the_computation_and_keeps_nothing() {
    let folder = folder_with_stand_in();
    let folder = folder.path();
    let output = view_command(folder, "bad").output().expect("expected the program to start");
    assert_eq!((output.status.code(), cached_names(folder).len()), (Some(2), 0));
    assert_eq!(String::from_utf8_lossy(&output.stdout), "");
    assert!(String::from_utf8_lossy(&output.stderr).ends_with("part.obj\nerror: no material\n"), "{output:?}");
    for signal in [Signal::INT, Signal::TERM] {
        let mut view = view_command(folder, "slow").stderr(Stdio::piped()).spawn().expect("expected a process");
        let mut messages = BufReader::new(view.stderr.take().expect("expected messages"));
        messages.read_line(&mut String::new()).expect("expected the start of the computation");
        assert_eq!(cached_names(folder).len(), 1, "control: the folder of the computation");
        let pid = i32::try_from(view.id()).ok().and_then(Pid::from_raw).expect("expected a process");
        kill_process(pid, signal).expect("expected a running process");
        assert_eq!(view.wait().expect("expected the end of the program").code(), Some(130));
        // The pipe ends with the last process that writes to it.
        messages.read_to_string(&mut String::new()).expect("expected the end of the stand-in");
        assert_eq!(cached_names(folder), [""; 0]);
    }
}

#[test]
fn view_serves_a_recording_to_the_session_of_its_link() {
    const RECORDING: &str = "\u{89}MCAP0\r\n";
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    std::fs::write(folder.path().join("a.mcap"), b"\x89MCAP0\r\n").expect("expected a written file");
    let mut server =
        command(folder.path(), &["view", "a.mcap", "--no-open"]).stdout(Stdio::piped()).spawn().expect("a process");
    let lines = BufReader::new(server.stdout.take().expect("expected an output")).lines();
    let link = lines.map_while(Result::ok).find_map(|line| line.strip_prefix("open http://").map(str::to_owned));
    let link = link.expect("expected a link");
    let (host, code) = link.split_once("/#code=").expect("expected a code");
    let exchange = |request: &str| {
        let mut socket = TcpStream::connect(host).expect("expected a connection");
        write!(socket, "{request}").expect("expected a sent request");
        let mut answer = Vec::new();
        socket.read_to_end(&mut answer).expect("expected an answer");
        let answer: String = answer.into_iter().map(char::from).collect();
        let (head, body) = answer.split_once("\r\n\r\n").expect("expected a head");
        assert!(head.starts_with("HTTP/1.1 200"), "{head}");
        body.to_owned()
    };
    let page = exchange(&format!("GET / HTTP/1.1\r\nHost: {host}\r\n\r\n"));
    assert!(page.contains("data-path=\"recording\" data-slow=\"1\""));
    let length = code.len();
    let session =
        exchange(&format!("POST /session HTTP/1.1\r\nHost: {host}\r\nContent-Length: {length}\r\n\r\n{code}"));
    let authorization = format!("Authorization: Bearer {session}");
    let recording = exchange(&format!("GET /recording HTTP/1.1\r\nHost: {host}\r\n{authorization}\r\n\r\n"));
    assert_eq!(recording, RECORDING);
    let pid = i32::try_from(server.id()).ok().and_then(Pid::from_raw).expect("expected a process");
    kill_process(pid, Signal::TERM).expect("expected a running server");
    assert!(server.wait().expect("expected the end of the server").success());
}
