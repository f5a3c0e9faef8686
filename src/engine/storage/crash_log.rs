//! The file `crashes` of the state folder: the scenes whose work ended the process in the last starts. A scene that did so
//! twice in the last three starts is set aside: it is not opened again at a start, until a client opens it by name.
//!
//! The file is text. Each start of a server rewrites it; later records are appended, some of them by signal handlers:
//!
//! ```text
//! modalcast crashes 1
//! aside CAUSE SCENE    the scene is set aside
//! start                the following lines belong to a further start of the server
//! crash CAUSE SCENE    work of the scene ended the process
//! clear SCENE          earlier lines of the scene do not apply any longer
//! ```

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::io::{self, Read as _, Write as _};
use std::path::Path;
use std::sync::{Arc, Mutex};

use super::file_system::{FileSystem, write_atomic};
use super::provenance::validate_scene_name;
use crate::engine::lock::lock;
use crate::engine::running_scene::SceneName;
use modalcast_model::error::Error;

const FILE_NAME: &str = "crashes";
const HEADER: &str = "modalcast crashes 1";
/// Number of starts that are examined.
const EXAMINED_STARTS: usize = 3;
/// Number of examined starts that a scene must have ended in order to be set aside.
const MAX_CRASHES: usize = 2;
/// Limit on the size of the file in bytes, above the size with as many scenes as a server can have.
const MAX_FILE_BYTES: u64 = 1 << 20;

/// A line of the crash log. It owns no memory, so that a signal handler can write it.
#[derive(Debug)]
pub(in crate::engine) struct CrashRecord {
    bytes: [u8; Self::MAX_BYTES],
    length: usize,
}

impl CrashRecord {
    const MAX_BYTES: usize = 96;

    /// `cause` is one word of at most 16 letters. Async-signal-safe.
    pub(in crate::engine) fn new(cause: &str, scene: SceneName) -> Self {
        let text = "crash ".bytes().chain(cause.bytes()).chain(" ".bytes()).chain(scene.bytes()).chain("\n".bytes());
        let mut record = Self { bytes: [0; Self::MAX_BYTES], length: 0 };
        for (to, from) in record.bytes.iter_mut().zip(text) {
            *to = from;
            record.length += 1;
        }
        record
    }

    pub(in crate::engine) fn line(&self) -> &[u8] {
        self.bytes.get(..self.length).unwrap_or_default()
    }
}

/// The causes of the last starts' ends, by scene.
type Causes = BTreeMap<String, String>;

/// The content of the file.
#[derive(Debug, Default)]
struct CrashHistory {
    /// Oldest first.
    starts: Vec<Causes>,
    set_aside: Causes,
}

impl CrashHistory {
    /// `None` if the text is damaged.
    fn parse(text: &str) -> Option<Self> {
        let mut lines = text.lines();
        let mut history = Self::default();
        if lines.next()? != HEADER {
            return None;
        }
        for line in lines {
            let words: Vec<&str> = line.split(' ').collect();
            match words[..] {
                ["start"] => history.starts.push(Causes::new()),
                ["crash", cause, scene] => drop(history.starts.last_mut()?.insert(scene_name(scene)?, cause.into())),
                ["aside", cause, scene] => drop(history.set_aside.insert(scene_name(scene)?, cause.into())),
                ["clear", scene] => drop(history.clear(scene)),
                _ => return None,
            }
        }
        Some(history)
    }

    fn to_text(&self) -> String {
        let lines = |kind: &'static str, causes: &Causes| {
            causes.iter().map(|(scene, cause)| format!("{kind} {cause} {scene}\n")).collect::<String>()
        };
        let starts = self.starts.iter().map(|causes| format!("start\n{}", lines("crash", causes)));
        format!("{HEADER}\n{}{}", lines("aside", &self.set_aside), starts.collect::<String>())
    }

    /// Sets scenes aside, removes the oldest starts and begins a new one. Scenes that do not exist are removed.
    fn begin_start(&mut self, exists: impl Fn(&str) -> bool) {
        for causes in self.starts.iter_mut().chain([&mut self.set_aside]) {
            causes.retain(|scene, _| exists(scene));
        }
        self.keep_starts(EXAMINED_STARTS);
        let scenes: Vec<String> = self.starts.iter().flat_map(|causes| causes.keys().cloned()).collect();
        for scene in scenes {
            let causes: Vec<&String> = self.starts.iter().filter_map(|causes| causes.get(&scene)).collect();
            if let Some(last) = causes.last().filter(|_| causes.len() >= MAX_CRASHES) {
                let last = (*last).clone();
                self.clear(&scene);
                self.set_aside.insert(scene, last);
            }
        }
        self.keep_starts(EXAMINED_STARTS - 1);
        self.starts.push(Causes::new());
    }

    fn keep_starts(&mut self, count: usize) {
        self.starts.drain(..self.starts.len().saturating_sub(count));
    }

    /// Removes a scene. Returns whether it was present.
    fn clear(&mut self, scene: &str) -> bool {
        let causes = self.starts.iter_mut().chain([&mut self.set_aside]);
        causes.filter_map(|causes| causes.remove(scene)).count() > 0
    }
}

fn scene_name(text: &str) -> Option<String> {
    validate_scene_name(text).ok().map(str::to_owned)
}

/// The crash log of a running server. If its file cannot be written, the server runs without it.
#[derive(Debug)]
pub(in crate::engine) struct CrashLog {
    /// Opened to append.
    file: Option<File>,
    history: Mutex<CrashHistory>,
}

impl CrashLog {
    /// Begins a new start in the log of a state folder. `exists` tells which scenes are to be opened again. A damaged file
    /// is logged and replaced.
    pub(in crate::engine) fn open(
        folder: &Path,
        file_system: &Arc<dyn FileSystem>,
        exists: impl Fn(&str) -> bool,
    ) -> Self {
        let path = folder.join(FILE_NAME);
        let mut history = read_history(&path).unwrap_or_else(|error| {
            tracing::warn!(%error, "{} is ignored", path.display());
            CrashHistory::default()
        });
        history.begin_start(exists);
        let write = || {
            write_atomic(&**file_system, &path, history.to_text().as_bytes())?;
            File::options().append(true).open(&path)
        };
        let file = write().inspect_err(|error| tracing::warn!(%error, "crashes are not recorded")).ok();
        Self { file, history: Mutex::new(history) }
    }

    /// The file, to which signal handlers append records.
    pub(in crate::engine) const fn file(&self) -> Option<&File> {
        self.file.as_ref()
    }

    /// Appends a record. It is durable if the machine continues to run, which is enough: a power loss is no fault of a scene.
    pub(in crate::engine) fn record(&self, cause: &str, scene: SceneName) {
        self.append(CrashRecord::new(cause, scene).line());
    }

    /// The reason why a scene is set aside. `None` if it is not.
    pub(in crate::engine) fn reason(&self, scene: &str) -> Option<Error> {
        let history = lock(&self.history);
        let cause = history.set_aside.get(scene)?;
        Some(Error::Unavailable {
            what: "scene",
            reason: format!(
                "its work ended the server {MAX_CRASHES} times in {EXAMINED_STARTS} starts, the last time by {cause}"
            ),
            remedy: "Open it by its name to try again".into(),
        })
    }

    /// Forgets the crashes of a scene if it is set aside: a client opens it.
    pub(in crate::engine) fn readmit(&self, scene: &str) {
        if self.reason(scene).is_some() {
            self.forget(scene);
        }
    }

    /// Forgets the crashes of a scene: it is deleted or replaced.
    pub(in crate::engine) fn forget(&self, scene: &str) {
        if lock(&self.history).clear(scene) {
            self.append(format!("clear {scene}\n").as_bytes());
        }
    }

    fn append(&self, line: &[u8]) {
        if let Some(mut file) = self.file.as_ref()
            && let Err(error) = file.write_all(line)
        {
            tracing::warn!(%error, "the crash log could not be written");
        }
    }
}

/// Reads the file; an empty history if there is none.
fn read_history(path: &Path) -> io::Result<CrashHistory> {
    let file = match fs::File::open(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(CrashHistory::default()),
        result => result?,
    };
    let mut text = String::new();
    file.take(MAX_FILE_BYTES).read_to_string(&mut text)?;
    let damaged = || io::Error::new(io::ErrorKind::InvalidData, "expected a list of crashes");
    CrashHistory::parse(&text).ok_or_else(damaged)
}
