//! Power loss: the operations on the state folder are recorded, and a server starts from every prefix of them. Data
//! that were not synced are lost or damaged.

use std::collections::BTreeMap;
use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use sha2::{Digest as _, Sha256};

use super::array_upload::{ArrayUpload, ArrayUploadHeader, UploadedDomain, UploadedShape};
use super::checkpoint_store::CheckpointStore;
use super::file_system::{DiskFileSystem, FileSystem, StateFile, paths_below};
use super::provenance::SceneProvenance;
use super::run_counter::RunCounter;
use super::scene_catalog::SceneCatalog;
use super::scene_record::{SceneAccess, SceneRecord};
use super::upload::{CompleteUpload, Upload, UploadHeader};
use crate::admission::{Account, Admission};
use crate::config::Config;
use crate::engine::lock::lock;
use crate::engine::testing;
use crate::engine::upload_permits::{UploadPermit, UploadPermits};
use crate::identity::Principal;
use modalcast_model::domain::Transform;
use modalcast_model::memory::MemoryReservation;
use modalcast_model::scene::{Scene, SceneState, UpAxis};

/// A change of the state folder. Paths are relative to it.
#[derive(Debug, Clone)]
enum Operation {
    CreateFolder(PathBuf),
    CreateFile(PathBuf),
    Write(PathBuf, Vec<u8>),
    SyncFile(PathBuf),
    SyncFolder(PathBuf),
    Rename(PathBuf, PathBuf),
    RemoveFile(PathBuf),
    RemoveFolder(PathBuf),
}

/// Changes a folder of the disk, and records the changes.
#[derive(Debug, Clone)]
struct RecordingFileSystem {
    root: PathBuf,
    operations: Arc<Mutex<Vec<Operation>>>,
    /// Number of calls that wait for the disk.
    syncs: Arc<AtomicUsize>,
}

impl RecordingFileSystem {
    fn record<T>(
        &self,
        path: &Path,
        result: io::Result<T>,
        operation: impl FnOnce(PathBuf) -> Operation,
    ) -> io::Result<T> {
        if let (Ok(_), Ok(relative)) = (&result, path.strip_prefix(&self.root)) {
            lock(&self.operations).push(operation(relative.to_owned()));
        }
        result
    }
}

impl FileSystem for RecordingFileSystem {
    fn create_folder(&self, path: &Path) -> io::Result<()> {
        self.record(path, DiskFileSystem.create_folder(path), Operation::CreateFolder)
    }

    fn create_file(&self, path: &Path, is_new: bool) -> io::Result<Box<dyn StateFile>> {
        let file = self.record(path, DiskFileSystem.create_file(path, is_new), Operation::CreateFile)?;
        Ok(Box::new(RecordingFile { file_system: self.clone(), path: path.to_owned(), file }))
    }

    fn sync_folder(&self, path: &Path) -> io::Result<()> {
        self.syncs.fetch_add(1, Ordering::Relaxed);
        self.record(path, DiskFileSystem.sync_folder(path), Operation::SyncFolder)
    }

    fn sync_tree(&self, path: &Path) -> io::Result<()> {
        self.syncs.fetch_add(1, Ordering::Relaxed);
        DiskFileSystem.sync_tree(path)?;
        for path in paths_below(path)? {
            let operation = if path.is_dir() { Operation::SyncFolder } else { Operation::SyncFile };
            self.record(&path, Ok(()), operation)?;
        }
        Ok(())
    }

    fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
        let relative_from = from.strip_prefix(&self.root).expect("expected a path in the folder").to_owned();
        self.record(to, DiskFileSystem.rename(from, to), |to| Operation::Rename(relative_from, to))
    }

    fn remove_file(&self, path: &Path) -> io::Result<()> {
        self.record(path, DiskFileSystem.remove_file(path), Operation::RemoveFile)
    }

    fn remove_folder(&self, path: &Path) -> io::Result<()> {
        self.record(path, DiskFileSystem.remove_folder(path), Operation::RemoveFolder)
    }
}

#[derive(Debug)]
struct RecordingFile {
    file_system: RecordingFileSystem,
    path: PathBuf,
    file: Box<dyn StateFile>,
}

impl Write for RecordingFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let result = self.file.write(bytes);
        let written = bytes[..result.as_ref().map_or(0, |length| *length)].to_vec();
        self.file_system.record(&self.path, result, |path| Operation::Write(path, written))
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

impl StateFile for RecordingFile {
    fn sync(&mut self) -> io::Result<()> {
        self.file_system.syncs.fetch_add(1, Ordering::Relaxed);
        self.file_system.record(&self.path, self.file.sync(), Operation::SyncFile)
    }
}

/// What a power loss leaves of operations that were not synced.
#[derive(Debug, Clone, Copy)]
enum Crash {
    /// Names and content are as at the last sync.
    LosesNames,
    /// Names are as after the last operation, content as at the last sync.
    LosesContent,
    /// Names are as after the last operation, and half of the content since the last sync is written.
    TearsContent,
}

/// A file or folder of a disk that can lose its power.
#[derive(Debug)]
enum Node {
    File { bytes: Vec<u8>, synced: Vec<u8> },
    Folder { names: BTreeMap<PathBuf, usize>, synced: BTreeMap<PathBuf, usize> },
}

/// A disk that distinguishes synced data from other data. Node 0 is the root.
#[derive(Debug)]
struct CrashDisk {
    nodes: Vec<Node>,
}

impl CrashDisk {
    fn new() -> Self {
        Self { nodes: vec![Node::Folder { names: BTreeMap::new(), synced: BTreeMap::new() }] }
    }

    fn names(&mut self, folder: usize) -> &mut BTreeMap<PathBuf, usize> {
        match &mut self.nodes[folder] {
            Node::Folder { names, .. } => names,
            Node::File { .. } => panic!("expected a folder"),
        }
    }

    fn find(&mut self, path: &Path) -> usize {
        path.iter().fold(0, |folder, name| self.names(folder)[Path::new(name)])
    }

    /// The names in the folder of a path, and the name in it.
    fn entry(&mut self, path: &Path) -> (&mut BTreeMap<PathBuf, usize>, PathBuf) {
        let folder = self.find(path.parent().expect("expected a path with a folder"));
        (self.names(folder), path.file_name().expect("expected a name").into())
    }

    fn add(&mut self, path: &Path, node: Node) {
        let number = self.nodes.len();
        self.nodes.push(node);
        let (names, name) = self.entry(path);
        names.insert(name, number);
    }

    fn exists(&mut self, path: &Path) -> bool {
        let (names, name) = self.entry(path);
        names.contains_key(&name)
    }

    fn apply(&mut self, operation: &Operation) {
        match operation {
            Operation::CreateFolder(path) => {
                let mut parents: Vec<&Path> = path.ancestors().filter(|path| path.parent().is_some()).collect();
                parents.reverse();
                for folder in parents {
                    if !self.exists(folder) {
                        self.add(folder, Node::Folder { names: BTreeMap::new(), synced: BTreeMap::new() });
                    }
                }
            }
            Operation::CreateFile(path) if !self.exists(path) => {
                self.add(path, Node::File { bytes: Vec::new(), synced: Vec::new() });
            }
            Operation::CreateFile(path) | Operation::Write(path, _) | Operation::SyncFile(path) => {
                let number = self.find(path);
                let Node::File { bytes, synced } = &mut self.nodes[number] else { panic!("expected a file") };
                match operation {
                    Operation::Write(_, written) => bytes.extend_from_slice(written),
                    Operation::SyncFile(_) => synced.clone_from(bytes),
                    _ => bytes.clear(),
                }
            }
            Operation::SyncFolder(path) => {
                let number = self.find(path);
                let Node::Folder { names, synced } = &mut self.nodes[number] else { panic!("expected a folder") };
                synced.clone_from(names);
            }
            Operation::Rename(from, to) => {
                let (names, name) = self.entry(from);
                let number = names.remove(&name).expect("expected a name");
                let (names, name) = self.entry(to);
                names.insert(name, number);
            }
            Operation::RemoveFile(path) | Operation::RemoveFolder(path) => {
                let (names, name) = self.entry(path);
                names.remove(&name).expect("expected a name");
            }
        }
    }

    /// Writes the files and folders that remain after a crash to a folder.
    fn write_to(&self, folder: &Path, crash: Crash, node: usize) {
        match &self.nodes[node] {
            Node::Folder { names, synced } => {
                fs::create_dir_all(folder).expect("expected a new folder");
                let names = if matches!(crash, Crash::LosesNames) { synced } else { names };
                for (name, number) in names {
                    self.write_to(&folder.join(name), crash, *number);
                }
            }
            Node::File { bytes, synced } => {
                let is_appended = bytes.starts_with(synced);
                let left = match crash {
                    Crash::TearsContent if is_appended => &bytes[..synced.len() + (bytes.len() - synced.len()) / 2],
                    Crash::TearsContent => &bytes[..bytes.len() / 2],
                    Crash::LosesNames | Crash::LosesContent => synced,
                };
                fs::write(folder, left).expect("expected a written file");
            }
        }
    }
}

/// What must survive a crash.
#[derive(Debug, Clone, Default)]
struct Acknowledged {
    /// The scenes, and the files of those that were uploaded.
    scenes: BTreeMap<String, BTreeMap<String, Vec<u8>>>,
    /// The durable steps.
    steps: BTreeMap<String, u64>,
    run: u64,
}

/// Changes a state folder as a server does.
struct Recorder {
    root: PathBuf,
    file_system: Arc<dyn FileSystem>,
    operations: Arc<Mutex<Vec<Operation>>>,
    syncs: Arc<AtomicUsize>,
    catalog: SceneCatalog,
    checkpoints: CheckpointStore,
    run_counter: RunCounter,
    scene: Arc<Scene>,
    acknowledged: Acknowledged,
    /// The acknowledged state by the number of operations after which it was acknowledged.
    history: Vec<(usize, Acknowledged)>,
}

impl Recorder {
    fn new(root: &Path) -> Self {
        let (operations, syncs) = (Arc::default(), Arc::default());
        let recording = RecordingFileSystem {
            root: root.to_owned(),
            operations: Arc::clone(&operations),
            syncs: Arc::clone(&syncs),
        };
        let file_system: Arc<dyn FileSystem> = Arc::new(recording);
        let catalog = SceneCatalog::open(root, &file_system).expect("expected a new state folder");
        Self {
            root: root.to_owned(),
            checkpoints: CheckpointStore::without_thread(catalog.checkpoint_folder(), &file_system),
            run_counter: RunCounter::open(root, &file_system).expect("expected a new counter"),
            catalog,
            file_system,
            operations,
            syncs,
            scene: testing::two_strips(),
            acknowledged: Acknowledged::default(),
            history: vec![(0, Acknowledged::default())],
        }
    }

    fn acknowledge(&mut self) {
        let count = lock(&self.operations).len();
        self.history.push((count, self.acknowledged.clone()));
    }

    fn begin_run(&mut self) {
        self.acknowledged.run = self.run_counter.next().expect("expected a run");
        self.acknowledge();
    }

    fn open_repository_scene(&mut self, name: &str) {
        let provenance = SceneProvenance::Repository { source: "strips".into() };
        self.catalog.add(name, &Self::own_record(provenance)).expect("expected a written catalog");
        self.acknowledged.scenes.insert(name.into(), BTreeMap::new());
        self.acknowledge();
    }

    fn own_record(provenance: SceneProvenance) -> SceneRecord {
        SceneRecord { provenance, access: SceneAccess::new(&Principal::owner()) }
    }

    fn permit() -> UploadPermit {
        let permits = UploadPermits::new(&Config::default(), &Admission::default());
        permits.admit(Account::server(), 1).expect("expected a free place")
    }

    fn upload(&mut self, name: &str, files: &[(&str, &str)]) {
        let total_bytes = files.iter().map(|(_, text)| text.len() as u64).sum();
        let header =
            UploadHeader { scene: name.into(), entry: files[0].0.into(), files: files.len() as u32, total_bytes };
        let uploads = self.catalog.uploads();
        let mut upload = Upload::begin(&uploads, &self.file_system, header, Self::permit(), vec![])
            .expect("expected a temporary folder");
        for (path, text) in files {
            let sha256 = Sha256::digest(text.as_bytes());
            upload.begin_file(path, text.len() as u64, &sha256).expect("expected a new file");
            // The two halves are separate writes.
            let (first, second) = text.as_bytes().split_at(text.len() / 2);
            upload.write_chunk(first).expect("expected an accepted chunk");
            upload.write_chunk(second).expect("expected an accepted chunk");
        }
        self.commit(name, upload.finish().expect("expected a complete upload"));
    }

    /// Uploads domains with a triangle each.
    fn upload_triangles(&mut self, name: &str, domains: u32) {
        let total_bytes = 48 * u64::from(domains);
        let header = ArrayUploadHeader { scene: name.into(), domains, total_bytes, unit: 1.0, up: UpAxis::Y };
        let memory = MemoryReservation::unlimited();
        let mut upload = ArrayUpload::begin(&self.catalog.uploads(), &self.file_system, header, Self::permit(), memory)
            .expect("expected a temporary folder");
        let positions = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0_f32].into_iter().flat_map(f32::to_le_bytes);
        let arrays: Vec<u8> = positions.chain([0, 1, 2_u32].into_iter().flat_map(u32::to_le_bytes)).collect();
        for index in 0..domains {
            let domain = UploadedDomain {
                name: format!("triangle {index}"),
                shape: UploadedShape::Arrays {
                    vertices: 3,
                    triangles: 1,
                    rank: 0,
                    f64_positions: false,
                    origin: [0.0; 3],
                },
                placement: Transform::IDENTITY.0.map(f64::from),
                color: [1.0; 3],
                eigenvalues: Vec::new(),
                crease_angle: None,
            };
            upload.begin_domain(&domain).expect("expected a new domain");
            upload.write_chunk(&arrays).expect("expected accepted arrays");
        }
        self.commit(name, upload.finish().expect("expected a complete upload"));
    }

    fn commit(&mut self, name: &str, upload: CompleteUpload) {
        let entry = upload.entry.clone();
        let folder = self.catalog.upload_folder(name);
        upload.commit(&folder).expect("expected a moved folder");
        self.catalog
            .add(name, &Self::own_record(SceneProvenance::Upload { entry }))
            .expect("expected a written catalog");
        self.acknowledged.scenes.insert(name.into(), read_files(&folder));
        self.acknowledge();
    }

    fn save_step(&mut self, name: &str, step: u64) {
        let state = SceneState { run: 1, step, ..SceneState::rest(&self.scene) };
        self.checkpoints.enqueue(name, &Arc::new(state));
        self.checkpoints.write_round();
        assert_eq!(self.checkpoints.durable_step(name).map(|durable| durable.number), Some(step));
        self.acknowledged.steps.insert(name.into(), step);
        self.acknowledge();
    }

    fn delete(&mut self, name: &str) {
        self.checkpoints.remove(name);
        assert_eq!(self.catalog.remove(name), Ok(true));
        self.acknowledged.scenes.remove(name);
        self.acknowledged.steps.remove(name);
        self.acknowledge();
    }

    /// All changes that a server makes.
    fn record(root: &Path) -> Self {
        let mut recorder = Self::new(root);
        recorder.begin_run();
        recorder.open_repository_scene("strips");
        recorder.save_step("strips", 1);
        recorder.upload("model", &[("deep/model.obj", "v 0 0 0"), ("model.mtl", "newmtl a")]);
        recorder.save_step("model", 2);
        recorder.save_step("strips", 3);
        recorder.upload_triangles("triangle", 1);
        recorder.delete("strips");
        recorder.begin_run();
        recorder.delete("model");
        recorder.upload("model", &[("model.obj", "v 1 1 1")]);
        recorder.save_step("model", 4);
        recorder
    }
}

/// The content of all files below a folder, by their paths.
fn read_files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut files = BTreeMap::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(current) = folders.pop() {
        for entry in fs::read_dir(current).into_iter().flatten().flatten() {
            let path = entry.path();
            if path.is_dir() {
                folders.push(path);
            } else {
                let name = path.strip_prefix(folder).expect("expected a path in the folder").display().to_string();
                files.insert(name, fs::read(&path).expect("expected a readable file"));
            }
        }
    }
    files
}

/// Starts from a folder. `before` is the last acknowledged state, `after` the next one.
fn assert_restarts(root: &Path, before: &Acknowledged, after: &Acknowledged, scene: &Scene, crash: &str) {
    let disk: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
    let catalog = SceneCatalog::open(root, &disk).unwrap_or_else(|error| panic!("{crash}: {error}"));
    let run_counter = RunCounter::open(root, &disk).unwrap_or_else(|error| panic!("{crash}: {error}"));
    let checkpoints = CheckpointStore::without_thread(catalog.checkpoint_folder(), &disk);
    let entries = catalog.entries();
    for (name, files) in &before.scenes {
        match (entries.contains_key(name), after.scenes.contains_key(name)) {
            (true, _) => {
                let found = read_files(&catalog.upload_folder(name));
                assert!(found == *files || after.scenes.get(name) == Some(&found), "{crash}: files of '{name}'");
            }
            (false, is_kept) => assert!(!is_kept, "{crash}: '{name}' is lost"),
        }
    }
    for name in entries.keys() {
        let is_known = before.scenes.contains_key(name) || after.scenes.contains_key(name);
        assert!(is_known, "{crash}: '{name}' was deleted");
    }
    for (name, step) in before.steps.iter().filter(|(name, _)| after.steps.contains_key(*name)) {
        let state = checkpoints.load(name, scene).unwrap_or_else(|error| panic!("{crash}: step of '{name}': {error}"));
        assert!(state.is_some_and(|state| state.step >= *step), "{crash}: step {step} of '{name}' is lost");
    }
    assert!(run_counter.next().expect("expected a run") > before.run, "{crash}: the run is used twice");
}

#[test]
fn every_prefix_of_the_writes_starts_with_all_acknowledged_state() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let recorder = Recorder::record(&folder.path().join("state"));
    let operations = lock(&recorder.operations).clone();
    assert!(operations.len() > 100, "expected many operations, got {}", operations.len());
    let mut disk = CrashDisk::new();
    for count in 0..=operations.len() {
        if count > 0 {
            disk.apply(&operations[count - 1]);
        }
        let index = recorder.history.partition_point(|(acknowledged_at, _)| *acknowledged_at <= count) - 1;
        let before = &recorder.history[index].1;
        let after = recorder.history.get(index + 1).map_or(before, |(_, acknowledged)| acknowledged);
        for crash in [Crash::LosesNames, Crash::LosesContent, Crash::TearsContent] {
            let restarted = tempfile::tempdir().expect("expected a temporary folder");
            disk.write_to(restarted.path(), crash, 0);
            let label = format!("{crash:?} after {count} operations, the last {:?}", operations.get(count.max(1) - 1));
            assert_restarts(restarted.path(), before, after, &recorder.scene, &label);
        }
    }
}

/// Each sync waits for the disk, so their number must not grow with the number of files.
#[test]
fn upload_of_many_files_has_as_many_syncs_as_one_of_few() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let mut recorder = Recorder::new(folder.path());
    let syncs_of = |recorder: &mut Recorder, upload: &dyn Fn(&mut Recorder)| {
        let before = recorder.syncs.load(Ordering::Relaxed);
        upload(recorder);
        recorder.syncs.load(Ordering::Relaxed) - before
    };
    let syncs_of_few = syncs_of(&mut recorder, &|recorder| recorder.upload("few", &[("a/a.obj", "v 0 0 0")]));
    let names: Vec<String> = (0..100).map(|index| format!("{index}/{index}.obj")).collect();
    let files: Vec<(&str, &str)> = names.iter().map(|name| (name.as_str(), "v 0 0 0")).collect();
    assert_eq!(syncs_of(&mut recorder, &|recorder| recorder.upload("files", &files)), syncs_of_few);
    assert_eq!(syncs_of(&mut recorder, &|recorder| recorder.upload_triangles("arrays", 100)), syncs_of_few);
}

/// Control: without syncs, an acknowledged scene is lost.
#[test]
fn writes_without_syncs_lose_acknowledged_state() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let recorder = Recorder::record(&folder.path().join("state"));
    let is_sync = |operation: &&Operation| matches!(operation, Operation::SyncFile(_) | Operation::SyncFolder(_));
    let mut disk = CrashDisk::new();
    lock(&recorder.operations)
        .iter()
        .filter(|operation| !is_sync(operation))
        .for_each(|operation| disk.apply(operation));
    for crash in [Crash::LosesNames, Crash::LosesContent, Crash::TearsContent] {
        let restarted = tempfile::tempdir().expect("expected a temporary folder");
        disk.write_to(restarted.path(), crash, 0);
        let file_system: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
        let catalog = SceneCatalog::open(restarted.path(), &file_system).expect("expected a start");
        assert_ne!(catalog.entries().len(), recorder.acknowledged.scenes.len(), "{crash:?}");
    }
}

#[test]
fn damaged_catalog_is_rebuilt_from_the_files_of_the_scenes() {
    for damage in [None, Some(""), Some("{\"model\":"), Some("[]")] {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let mut recorder = Recorder::record(folder.path());
        recorder.open_repository_scene("second-strips");
        let Recorder { root, catalog, acknowledged, .. } = recorder;
        let expected = catalog.entries();
        assert_eq!(expected.len(), 3);
        drop(catalog);
        let path = root.join("scenes.json");
        match damage {
            Some(text) => fs::write(path, text).expect("expected a written file"),
            None => fs::remove_file(path).expect("expected a removed file"),
        }
        let file_system: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
        let catalog = SceneCatalog::open(&root, &file_system).expect("expected a start");
        assert_eq!(catalog.entries(), expected, "{damage:?}");
        assert_eq!(read_files(&catalog.upload_folder("model")), acknowledged.scenes["model"], "{damage:?}");
        drop(catalog);
        let catalog = SceneCatalog::open(&root, &file_system).expect("expected a second start");
        assert_eq!(catalog.entries(), expected, "expected the rebuilt catalog to be written");
    }
}
