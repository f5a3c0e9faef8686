//! Modes that `modalcast view` computes from a surface or a volume mesh: runs the program `modalcast-modes`, and keeps its files in the
//! user's cache folder.

use std::fs::{self, File};
use std::io::{Read as _, Write as _};
use std::os::unix::process::ExitStatusExt as _;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, SystemTime};

use rustix::process::{Pid, Signal, kill_process};
use sha2::{Digest, Sha256};
use tokio::io::AsyncReadExt as _;
use tokio::process::Command;

use super::loading_options::LoadingOptions;
use super::modeling_options::ModelingOptions;
use super::serve::TerminationSignals;
use super::{Completion, print_line, sibling};
use modalcast_model::error::{Error, Result, fault, fault_in};
use modalcast_model::load;

/// Limit on the size of all entries of the cache in bytes.
const MAX_CACHE_BYTES: u64 = 2 << 30;

/// A folder of a computation that has not ended after this time was left by a process that was killed.
const ABANDONED_AFTER: Duration = Duration::from_secs(24 * 3600);

/// Prefix of the folders of computations that have not ended.
const TEMPORARY_PREFIX: &str = ".new-";

/// The file with the summary that the program printed.
const SUMMARY_FILE: &str = "summary.txt";

/// Time between SIGTERM and SIGKILL.
const EXIT_TIME: Duration = Duration::from_secs(10);

/// The exit code of a command that Ctrl-C ended: 128 and the number of the signal.
const INTERRUPTED: u8 = 130;

/// Largest length of the name of the surface in the name of an entry. A file name has at most 255 bytes.
const MAX_STEM_CHARS: usize = 40;

/// Most files of a folder that are hashed.
const MAX_HASHED_FILES: usize = 10_000;

/// The outcome of a computation.
#[derive(Debug, PartialEq)]
pub(super) enum Computed {
    /// The file with the surface and its modes.
    File(PathBuf),
    /// There is no file, and the reason is already printed.
    Ended(Completion),
}

/// The file with the modes of the surface at the path `source`, from the cache or newly computed. Prints the summary of
/// the program, whose progress and errors go to standard error.
///
/// # Errors
/// `Unavailable` if the program is missing, was built from other sources, or the cache folder cannot be written.
pub(super) async fn compute(source: &str, loading: &LoadingOptions, options: &ModelingOptions) -> Result<Computed> {
    let program = sibling::MODES.checked_path()?;
    let cache = Cache::new(cache_folder(|name| std::env::var_os(name))?);
    let mut signals = TerminationSignals::install()?;
    let result_arguments = [loading.arguments(), options.result_arguments()].concat();
    let key = entry_key(source, &result_arguments, &program);
    let name = format!("{}-{key}", short_stem(source));
    let file_name = format!("{}.npz", stem_of(source));
    if let Some(file) = cache.find(&name, &file_name) {
        let summary = fs::read_to_string(file.with_file_name(SUMMARY_FILE)).unwrap_or_default();
        print_summary(&summary, &file);
        return Ok(Computed::File(file));
    }
    let folder = cache.create()?;
    let flags = [vec!["--progress=auto".to_owned()], loading.arguments(), options.arguments()].concat();
    let output = folder.path().join(&file_name);
    let is_about_output = |line: &&str| line.contains(&*output.to_string_lossy());
    let mut command = Command::new(&program);
    command.args(flags).arg("--out").arg(&output).arg("--").arg(source);
    match run_program(command, &mut signals).await? {
        ProgramEnd::Done(summary) => {
            // Without the lines that name the file, which is moved.
            let lines: Vec<&str> = summary.lines().filter(|line| !is_about_output(line)).collect();
            let summary = lines.join("\n");
            write_summary(folder.path(), &summary).map_err(|error| cache.unavailable(&error))?;
            let file = cache.insert(folder, &name, &file_name)?;
            print_summary(&summary, &file);
            Ok(Computed::File(file))
        }
        ProgramEnd::Failed(code) => Ok(Computed::Ended(Completion::ProgramFailed(code))),
    }
}

/// How the program ended.
enum ProgramEnd {
    /// Successfully. Contains its standard output.
    Done(String),
    /// With this exit code, and a message on standard error.
    Failed(u8),
}

/// Runs the program until it ends, or until a signal ends both.
async fn run_program(mut command: Command, signals: &mut TerminationSignals) -> Result<ProgramEnd> {
    command.stdin(Stdio::null()).stdout(Stdio::piped()).kill_on_drop(true);
    let mut child = command.spawn().map_err(fault_in("modes"))?;
    let mut pipe = child.stdout.take().ok_or_else(|| fault("modes", "expected a pipe for standard output"))?;
    let mut summary = Vec::new();
    let finished = async {
        pipe.read_to_end(&mut summary).await?;
        child.wait().await
    };
    let status = tokio::select! {
        status = finished => status.map_err(fault_in("modes"))?,
        () = signals.received() => {
            // Ctrl-C in a terminal has also reached the program.
            let pid = child.id().and_then(|id| i32::try_from(id).ok()).and_then(Pid::from_raw);
            if let Some(pid) = pid {
                kill_process(pid, Signal::TERM).ok(); // Fails only if the program has already ended.
            }
            if tokio::time::timeout(EXIT_TIME, child.wait()).await.is_err() {
                child.kill().await.ok();
            }
            return Ok(ProgramEnd::Failed(INTERRUPTED));
        }
    };
    match (status.code(), status.signal().and_then(Signal::from_named_raw)) {
        (Some(0), _) => Ok(ProgramEnd::Done(String::from_utf8_lossy(&summary).into_owned())),
        (Some(code), _) => Ok(ProgramEnd::Failed(u8::try_from(code).unwrap_or(1))),
        // The signal of Ctrl-C can end the program before this one receives it.
        (None, Some(Signal::INT | Signal::TERM)) => Ok(ProgramEnd::Failed(INTERRUPTED)),
        (None, _) => Err(fault("modes", format!("{} ended with {status}", sibling::MODES.program()))),
    }
}

fn print_summary(summary: &str, file: &Path) {
    summary.lines().for_each(print_line);
    print_line(format!("cached    {}", file.display()));
}

fn write_summary(folder: &Path, summary: &str) -> std::io::Result<()> {
    File::create(folder.join(SUMMARY_FILE))?.write_all(summary.as_bytes())
}

/// The name of the surface without folders and extension.
fn stem_of(source: &str) -> String {
    // The path `.` has a name only when it is resolved.
    let path = Path::new(source).canonicalize().unwrap_or_else(|_| source.into());
    path.file_stem().map_or_else(|| "part".to_owned(), |stem| stem.to_string_lossy().into_owned())
}

fn short_stem(source: &str) -> String {
    stem_of(source).chars().filter(|character| character.is_ascii()).take(MAX_STEM_CHARS).collect()
}

/// The folder of the cache: in `XDG_CACHE_HOME`, or else in `~/.cache`.
fn cache_folder(variable: impl Fn(&str) -> Option<std::ffi::OsString>) -> Result<PathBuf> {
    // The XDG Base Directory Specification ignores relative paths.
    let absolute = |name: &str| variable(name).map(PathBuf::from).filter(|path| path.is_absolute());
    let base = absolute("XDG_CACHE_HOME").or_else(|| absolute("HOME").map(|home| home.join(".cache")));
    base.map(|base| base.join("modalcast/models")).ok_or_else(|| Error::Unavailable {
        what: "cache folder",
        reason: "neither XDG_CACHE_HOME nor HOME is an absolute path".into(),
        remedy: "Set one of them".into(),
    })
}

/// A hash of everything that determines the result: the content of the surface, the arguments and the program.
fn entry_key(source: &str, arguments: &[String], program: &Path) -> String {
    let mut hash = Sha256::new();
    // Length prefixes keep two parts from reading like two others.
    let mut add = |part: &[u8]| {
        hash.update((part.len() as u64).to_le_bytes());
        hash.update(part);
    };
    add(crate::BUILD.as_bytes());
    // The hash of the build is not that of the program's own sources.
    add(&file_version(program));
    add(&(arguments.len() as u64).to_le_bytes());
    arguments.iter().for_each(|argument| add(argument.as_bytes()));
    add(source.rsplit('/').next().unwrap_or_default().as_bytes());
    let path = Path::new(source);
    let files = if path.is_dir() { files_of(path) } else { [vec![path.to_owned()], referenced_files(path)].concat() };
    for file in files {
        add(file.file_name().unwrap_or_default().as_encoded_bytes());
        add(&hash_file(&file).unwrap_or_default());
    }
    hash.finalize().iter().take(16).map(|byte| format!("{byte:02x}")).collect()
}

/// Length and time of the last change of a file, as bytes.
fn file_version(path: &Path) -> Vec<u8> {
    let Ok(metadata) = path.metadata() else { return Vec::new() };
    let time = metadata.modified().ok().and_then(|time| time.duration_since(SystemTime::UNIX_EPOCH).ok());
    [metadata.len().to_le_bytes().as_slice(), &time.unwrap_or_default().as_nanos().to_le_bytes()].concat()
}

/// The hash of a file's content. Empty if it cannot be read; the program reports why.
fn hash_file(path: &Path) -> std::io::Result<Vec<u8>> {
    // A pipe or a device may block.
    if !path.metadata()?.is_file() {
        return Ok(Vec::new());
    }
    let (mut file, mut hash, mut buffer) = (File::open(path)?, Sha256::new(), vec![0; 1 << 16]);
    loop {
        match file.read(&mut buffer)? {
            0 => return Ok(hash.finalize().to_vec()),
            count => hash.update(&buffer[..count]),
        }
    }
}

/// The files of a folder, in the order of their names.
fn files_of(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().take(MAX_HASHED_FILES).flatten();
    let mut files: Vec<PathBuf> = entries.map(|entry| entry.path()).filter(|path| path.is_file()).collect();
    files.sort();
    files
}

/// The files that an OBJ file (material libraries), a glTF file (buffers) or a Vega mesh (included files, and fixed vertices
/// beside it) refers to and that contain more than images.
fn referenced_files(path: &Path) -> Vec<PathBuf> {
    let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let names: Vec<String> = match (extension.to_str(), path.is_file()) {
        (Some("obj"), true) => {
            let text = fs::read(path).unwrap_or_default();
            let lines = text.split(|byte| *byte == b'\n').filter_map(|line| line.trim_ascii().strip_prefix(b"mtllib"));
            let names = lines.map(|names| String::from_utf8_lossy(names.trim_ascii()).into_owned());
            // A line has several names, or one with spaces.
            names.flat_map(|names| std::iter::once(names.clone()).chain(words_of(&names)).collect::<Vec<_>>()).collect()
        }
        (Some("gltf"), true) => {
            let json: serde_json::Value =
                fs::read(path).ok().and_then(|bytes| serde_json::from_slice(&bytes).ok()).unwrap_or_default();
            let buffers = json["buffers"].as_array().into_iter().flatten();
            buffers.filter_map(|buffer| buffer["uri"].as_str().map(str::to_owned)).collect()
        }
        (Some("veg"), true) => {
            let text = fs::read(path).unwrap_or_default();
            let lines =
                text.split(|byte| *byte == b'\n').filter_map(|line| line.trim_ascii().strip_prefix(b"*INCLUDE"));
            let included = lines.map(|name| String::from_utf8_lossy(name.trim_ascii()).into_owned());
            let is_list = |file: &PathBuf| file.extension().is_some_and(|extension| extension == "bou");
            let lists = files_of(folder).into_iter().filter(is_list);
            included.chain(lists.filter_map(|file| Some(file.file_name()?.to_str()?.to_owned()))).collect()
        }
        _ => Vec::new(),
    };
    names.iter().take(MAX_HASHED_FILES).filter_map(|name| load::find_referenced_file(folder, name)).collect()
}

fn words_of(text: &str) -> Vec<String> {
    text.split_whitespace().map(str::to_owned).collect()
}

/// A folder with one folder per entry, which contains the file with the modes and the summary.
struct Cache {
    folder: PathBuf,
}

impl Cache {
    fn new(folder: PathBuf) -> Self {
        Self { folder }
    }

    fn unavailable(&self, error: &std::io::Error) -> Error {
        Error::Unavailable {
            what: "cache folder",
            reason: format!("{}: {error}", self.folder.display()),
            remedy: "Set XDG_CACHE_HOME to a folder that can be written".into(),
        }
    }

    /// The file of an entry, which is now the most recently used one.
    fn find(&self, name: &str, file_name: &str) -> Option<PathBuf> {
        let path = self.folder.join(name).join(file_name);
        let file = File::open(&path).ok()?;
        file.set_modified(SystemTime::now()).ok(); // A cache that cannot be written is still read.
        Some(path)
    }

    /// A folder for a new entry. It is removed when it is dropped.
    fn create(&self) -> Result<tempfile::TempDir> {
        let create = || {
            fs::create_dir_all(&self.folder)?;
            tempfile::Builder::new().prefix(TEMPORARY_PREFIX).tempdir_in(&self.folder)
        };
        create().map_err(|error| self.unavailable(&error))
    }

    /// Makes a folder of [`Self::create`] an entry, and removes the least recently used ones if the cache is too large.
    fn insert(&self, folder: tempfile::TempDir, name: &str, file_name: &str) -> Result<PathBuf> {
        let entry = self.folder.join(name);
        match fs::rename(folder.path(), &entry) {
            Ok(()) => drop(folder.keep()),
            // Another process has computed the same.
            Err(_) if entry.join(file_name).is_file() => {}
            // An entry without its file: its removal ended halfway.
            Err(_) if entry.is_dir() => {
                fs::remove_dir_all(&entry).map_err(|error| self.unavailable(&error))?;
                fs::rename(folder.path(), &entry).map_err(|error| self.unavailable(&error))?;
                drop(folder.keep());
            }
            Err(error) => return Err(self.unavailable(&error)),
        }
        self.remove_oldest(MAX_CACHE_BYTES, name);
        Ok(entry.join(file_name))
    }

    /// Removes the least recently used entries until all have at most `limit` bytes. The entry `kept` remains.
    fn remove_oldest(&self, limit: u64, kept: &str) {
        let mut entries = Vec::new();
        for entry in fs::read_dir(&self.folder).into_iter().flatten().flatten() {
            let files = files_of(&entry.path());
            let metadata = || files.iter().filter_map(|file| file.metadata().ok());
            let bytes: u64 = metadata().map(|metadata| metadata.len()).sum();
            let is_temporary = entry.file_name().to_string_lossy().starts_with(TEMPORARY_PREFIX);
            // The folder of a computation may still be empty.
            let folder_time = entry.metadata().and_then(|metadata| metadata.modified()).ok();
            let time = metadata().filter_map(|metadata| metadata.modified().ok()).max().or(folder_time);
            let age = time.and_then(|time| time.elapsed().ok()).unwrap_or_default();
            if is_temporary && age > ABANDONED_AFTER {
                fs::remove_dir_all(entry.path()).ok();
            }
            if !is_temporary {
                entries.push((age, bytes, entry));
            }
        }
        let mut total: u64 = entries.iter().map(|(_, bytes, _)| bytes).sum();
        entries.sort_by_key(|(age, ..)| std::cmp::Reverse(*age));
        for (_, bytes, entry) in entries.iter().filter(|(.., entry)| entry.file_name() != kept) {
            if total <= limit {
                break;
            }
            if fs::remove_dir_all(entry.path()).is_ok() {
                total -= bytes;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(clamp: &str) -> ModelingOptions {
        ModelingOptions { clamp: vec![clamp.to_owned()], ..ModelingOptions::default() }
    }

    fn folder() -> tempfile::TempDir {
        tempfile::tempdir().expect("expected a temporary folder")
    }

    fn write(path: PathBuf, content: &[u8]) {
        std::fs::write(path, content).expect("expected a written file");
    }

    #[test]
    fn key_changes_with_content_options_program_and_referenced_files() {
        let folder = folder();
        let path = |name: &str| folder.path().join(name);
        let key = |name: &str, options: &ModelingOptions| {
            entry_key(&path(name).to_string_lossy(), &options.result_arguments(), &path("program"))
        };
        write(path("program"), b"1");
        write(path("a.obj"), b"mtllib a b.mtl\nmtllib b.mtl c.mtl\nv 0 0 0\n");
        write(path("a b.mtl"), b"1");
        write(path("c.mtl"), b"1");
        let mut keys = vec![key("a.obj", &options("x<0"))];
        let one_thread = ModelingOptions { threads: Some(1), ..options("x<0") };
        assert_eq!(key("a.obj", &one_thread), keys[0], "expected a result that does not depend on the threads");
        keys.push(key("a.obj", &options("x<1")));
        for name in ["a.obj", "a b.mtl", "c.mtl", "program"] {
            write(path(name), b"mtllib a b.mtl\nmtllib b.mtl c.mtl\nv 0 0 1\n");
            keys.push(key("a.obj", &options("x<0")));
        }
        write(path("a.gltf"), br#"{"buffers": [{"uri": "a.bin"}]}"#);
        for content in [b"1", b"2"] {
            write(path("a.bin"), content);
            keys.push(key("a.gltf", &options("x<0")));
            keys.push(key("", &options("x<0")));
        }
        // The loader reads a file in the folder for a path on another machine.
        write(path("d.obj"), b"mtllib C:\\work\\D.MTL\n");
        for content in [b"1", b"2"] {
            write(path("d.mtl"), content);
            keys.push(key("d.obj", &options("x<0")));
        }
        write(path("e.veg"), b"*SET a\n*INCLUDE e.txt\n");
        for name in ["e.txt", "e.bou"] {
            for content in [b"1", b"2"] {
                write(path(name), content);
                keys.push(key("e.veg", &options("x<0")));
            }
        }
        let different: std::collections::BTreeSet<&String> = keys.iter().collect();
        assert_eq!(different.len(), keys.len(), "{keys:?}");
        assert_eq!(key("a.obj", &options("x<0")), keys[5], "control: nothing has changed");
    }

    #[test]
    fn cache_folder_follows_the_xdg_specification() {
        let folder = |cache: Option<&str>, home: Option<&str>| {
            cache_folder(|name| if name == "HOME" { home } else { cache }.map(Into::into))
        };
        assert_eq!(folder(Some("/c"), Some("/h")), Ok("/c/modalcast/models".into()));
        assert_eq!(folder(Some("c"), Some("/h")), Ok("/h/.cache/modalcast/models".into()));
        assert!(folder(None, None).is_err());
    }

    #[test]
    fn least_recently_used_entries_are_removed() {
        let folder = folder();
        let cache = Cache::new(folder.path().join("models"));
        let second = Duration::from_secs(1);
        let add = |name: &str, age: u32| {
            let entry = cache.create().expect("expected a new folder");
            write(entry.path().join("a.npz"), &[0; 1000]);
            let path = cache.insert(entry, name, "a.npz").expect("expected a new entry");
            let file = File::open(path).expect("expected a readable file");
            file.set_modified(SystemTime::now() - age * second).expect("expected another time");
        };
        let names = || {
            let entries = std::fs::read_dir(&cache.folder).expect("expected a folder").flatten();
            let mut names: Vec<String> =
                entries.map(|entry| entry.file_name().to_string_lossy().into_owned()).collect();
            names.sort();
            names
        };
        for (name, age) in [("a", 40), ("b", 30), ("c", 20), ("d", 50)] {
            add(name, age);
        }
        let running = cache.create().expect("expected a new folder");
        let abandoned = cache.folder.join(".new-abandoned");
        std::fs::create_dir(&abandoned).expect("expected a new folder");
        let day = File::open(&abandoned).expect("expected a folder");
        day.set_modified(SystemTime::now() - ABANDONED_AFTER - second).expect("expected another time");
        cache.remove_oldest(4000, "d");
        assert_eq!(names().len(), 5, "control: four entries are small enough");
        assert!(cache.find("a", "a.npz").is_some() && cache.find("a", "b.npz").is_none());
        cache.remove_oldest(2000, "d");
        let running_name = running.path().file_name().expect("expected a name").to_string_lossy().into_owned();
        assert_eq!(names(), [running_name, "a".into(), "d".into()], "`a` was used last, and `d` is kept");
        // A second process has computed the same entry.
        add("a", 0);
        assert_eq!(names().len(), 3);
        drop(running);
        assert_eq!(names(), ["a", "d"]);
        // The removal of an entry ended halfway.
        std::fs::remove_file(cache.folder.join("a").join("a.npz")).expect("expected a removed file");
        add("a", 0);
        assert!(cache.find("a", "a.npz").is_some());
    }

    #[test]
    fn names_are_those_of_the_surface() {
        assert_eq!((stem_of("/x/part.stl"), short_stem("a/größe.stl")), ("part".into(), "gre".into()));
        assert_eq!(stem_of("/"), "part");
    }
}
