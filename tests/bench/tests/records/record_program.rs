//! Runs `tests/bench/record` in a small repository.

use std::path::Path;
use std::process::Command;

/// Runs a program and returns its standard output.
fn run(program: &str, arguments: &[&str], folder: &Path) -> String {
    let mut command = Command::new(program);
    // Variables of an enclosing git command, such as a hook, would name another repository.
    ["GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE"].iter().for_each(|name| {
        command.env_remove(name);
    });
    let output =
        command.args(arguments).current_dir(folder).output().unwrap_or_else(|error| panic!("{program}: {error}"));
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).expect("UTF-8");
    assert!(output.status.success(), "{program} {arguments:?}: {}", text(output.stderr));
    text(output.stdout)
}

/// Commits all files of a folder.
fn commit(folder: &Path) {
    run("git", &["add", "--all"], folder);
    let identity = ["-c", "user.name=test", "-c", "user.email=test@example.com", "-c", "commit.gpgsign=false"];
    run("git", &[&identity[..], &["commit", "--quiet", "--message", "change"]].concat(), folder);
}

/// Runs `tests/bench/record` for the repository in a folder.
fn record(folder: &Path, arguments: &[&str]) -> String {
    let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("record");
    let program = [program.to_str().expect("UTF-8"), "--root", folder.to_str().expect("UTF-8")];
    run("python3", &[&program[..], arguments].concat(), folder)
}

#[test]
fn warns_of_a_record_whose_sources_have_changed() {
    let folder = tempfile::tempdir().expect("expected a folder");
    let folder = folder.path();
    let write = |path: &str, text: &str| {
        let path = folder.join(path);
        std::fs::create_dir_all(path.parent().expect("a folder")).expect("created");
        std::fs::write(path, text).expect("written");
    };
    run("git", &["init", "--quiet"], folder);
    let entry = |name: &str, source: &str| {
        format!(
            "[[record]]\nfile = \"{name}\"\ncommand = \"measure {name}\"\nsources = [\"{source}\"]\nhash = \"\"\n\n"
        )
    };
    write("tests/bench/records/records.toml", &(entry("a.json", "src") + &entry("b.json", "kernels")));
    write("src/lib.rs", "one");
    write("kernels/deform.cu", "one");
    write("report.json", r#"{"rows": [{"us": 1.23456789, "traffic": [1], "none": null}], "count": 12}"#);
    commit(folder);

    let unstamped = record(folder, &["check"]);
    assert!(unstamped.contains("a.json") && unstamped.contains("    measure b.json"), "{unstamped}");
    record(folder, &["add", "report.json", "a.json", "--commit", "HEAD"]);
    record(folder, &["stamp", "b.json"]);
    assert_eq!(record(folder, &["check"]), "");
    let added = std::fs::read_to_string(folder.join("tests/bench/records/a.json")).expect("expected a record");
    let added: serde_json::Value = serde_json::from_str(&added).expect("JSON");
    assert_eq!(added, serde_json::json!({"rows": [{"us": 1.23457}], "count": 12}));

    // Documents and unit tests are no sources. The record itself is not one either.
    write("src/README.md", "text");
    write("src/scene/tests.rs", "test");
    write("src/scene/tests/control.rs", "test");
    commit(folder);
    assert_eq!(record(folder, &["check"]), "");
    write("src/lib.rs", "two");
    commit(folder);
    let changed = record(folder, &["check"]);
    assert!(changed.contains("a.json") && changed.contains("    measure a.json"), "{changed}");
    assert!(!changed.contains("b.json"), "{changed}");
}
