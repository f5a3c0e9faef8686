//! Checkpoint store: persists the last step of every scene, one file per scene. A background thread writes in rounds,
//! at most twenty per second, and uses at most a tenth of a core: after a round it pauses for nine times the processor
//! time of the round. A round writes and syncs one file per changed scene. Files are replaced by an atomic rename,
//! so neither a killed server nor a power loss leaves a partial file. The steps since the beginning of the last round
//! can be lost: usually those of 0.05 s and of the duration of a round.
//!
//! A state that cannot be written, for example because the disk is full, is written again later. Until then the store is
//! degraded, and the durable step of the scene stands still.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use rustix::time::{ClockId, clock_gettime};
use sha2::{Digest as _, Sha256};
use tokio::sync::watch;

use super::file_system::{FileSystem, write_atomic};
use crate::engine::lock::lock;
use modalcast_model::domain::Transform;
use modalcast_model::error::{Result, fault, fault_in, invalid};
use modalcast_model::scene::{FloatingOrigins, Scene, SceneState};

/// Pause between two rounds of writes.
const WRITE_INTERVAL: Duration = Duration::from_millis(50);

/// Pause after a round, as a multiple of the processor time of the round.
const PAUSE_PER_CPU_TIME: u32 = 9;

/// Pause after a round in which a write failed.
const RETRY_INTERVAL: Duration = Duration::from_millis(250);

/// Magic number of a checkpoint file. The file continues with run and step number (u64), time (f64, seconds), the
/// counts of coordinates and of transforms (u64), q (f32), the transforms (12 f32 each), and the SHA-256 of all bytes
/// before the hash. Little-endian.
const MAGIC: &[u8; 8] = b"MCSTEP01";
/// Magic number of a checkpoint with floating origins, the points that transforms are relative to. Between the
/// transforms and the hash, the file contains the shared origin (3 f64) and one translation (3 f64) per transform.
const MAGIC_ORIGINS: &[u8; 8] = b"MCSTEP02";
/// Magic number of a checkpoint with pivots, the points that the transforms map to their translations. After the
/// translations, the file contains one pivot (3 f64) per transform.
const MAGIC_PIVOTS: &[u8; 8] = b"MCSTEP03";
/// The magic number and five numbers of 8 bytes.
const HEADER_BYTES: usize = 8 + 5 * 8;
const HASH_BYTES: usize = 32;
/// Size of a transform: 12 f32.
const TRANSFORM_BYTES: usize = 48;
/// Size of an origin or a translation: 3 f64.
const POINT_BYTES: usize = 24;

/// A step that survives a crash of the server and a power loss.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in crate::engine) struct DurableStep {
    pub(in crate::engine) run: u64,
    pub(in crate::engine) number: u64,
    /// Simulation time in seconds.
    pub(in crate::engine) time: f64,
}

impl DurableStep {
    const fn of(state: &SceneState) -> Self {
        Self { run: state.run, number: state.step, time: state.time }
    }
}

/// Writes checkpoints in the background.
#[derive(Debug)]
pub(in crate::engine) struct CheckpointStore {
    writer: Arc<CheckpointWriter>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

/// The part of the store that the background thread uses.
#[derive(Debug)]
struct CheckpointWriter {
    file_system: Arc<dyn FileSystem>,
    folder: PathBuf,
    pending: Mutex<PendingWrites>,
    /// Signaled when `pending` has changed.
    change_signal: Condvar,
    /// Held while files are read, written or removed. Lock order: `file_lock` before `pending` and `durable`.
    file_lock: Mutex<()>,
    /// The steps on disk, by scene name.
    durable: Mutex<BTreeMap<String, DurableStep>>,
    /// Whether the last round could not write a state.
    is_degraded: watch::Sender<bool>,
}

#[derive(Debug, Default)]
struct PendingWrites {
    /// The newest states that are not on disk yet, by scene name.
    dirty: BTreeMap<String, Arc<SceneState>>,
    is_stopping: bool,
}

impl CheckpointStore {
    /// Starts the thread that writes into the existing folder `folder`.
    ///
    /// # Errors
    /// `Fault` when the thread cannot be created.
    pub(in crate::engine) fn start(folder: PathBuf, file_system: &Arc<dyn FileSystem>) -> Result<Self> {
        let writer = Arc::new(CheckpointWriter::new(folder, file_system));
        let thread_writer = Arc::clone(&writer);
        let thread = std::thread::Builder::new()
            .name("checkpoints".into())
            .spawn(move || thread_writer.run())
            .map_err(fault_in("checkpoint thread"))?;
        Ok(Self { writer, thread: Mutex::new(Some(thread)) })
    }

    /// A store whose test calls [`Self::write_round`].
    #[cfg(test)]
    pub(in crate::engine) fn without_thread(folder: PathBuf, file_system: &Arc<dyn FileSystem>) -> Self {
        Self { writer: Arc::new(CheckpointWriter::new(folder, file_system)), thread: Mutex::new(None) }
    }

    #[cfg(test)]
    pub(super) fn write_round(&self) {
        self.writer.write_round();
    }

    /// Whether the newest states cannot be written, for example because the disk is full.
    pub(in crate::engine) fn watch_degraded(&self) -> watch::Receiver<bool> {
        self.writer.is_degraded.subscribe()
    }

    /// The newest step of a scene that survives a crash of the server and a power loss.
    pub(in crate::engine) fn durable_step(&self, name: &str) -> Option<DurableStep> {
        lock(&self.writer.durable).get(name).copied()
    }

    /// Records the newest state of a scene. Never waits for the disk.
    pub(in crate::engine) fn enqueue(&self, name: &str, state: &Arc<SceneState>) {
        lock(&self.writer.pending).dirty.insert(name.to_owned(), Arc::clone(state));
        self.writer.change_signal.notify_one();
    }

    /// Returns the newest recorded state of a scene, on disk or not. `None` if no state was recorded. Waits for the
    /// disk.
    ///
    /// # Errors
    /// `Invalid` when the file is damaged or its size does not match the scene; `Fault` of the disk.
    pub(in crate::engine) fn load(&self, name: &str, scene: &Scene) -> Result<Option<SceneState>> {
        let _files = lock(&self.writer.file_lock);
        // A scene that failed and is opened again may have a state that is not on disk yet.
        if let Some(state) = lock(&self.writer.pending).dirty.get(name) {
            // Decoding checks that the state matches the scene.
            return decode(&encode(state), scene).map(Some);
        }
        match fs::read(checkpoint_path(&self.writer.folder, name)) {
            Ok(bytes) => {
                let state = decode(&bytes, scene)?;
                lock(&self.writer.durable).insert(name.to_owned(), DurableStep::of(&state));
                Ok(Some(state))
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(fault("reading a checkpoint", error)),
        }
    }

    /// Removes the checkpoint of a scene. Waits for the disk.
    pub(in crate::engine) fn remove(&self, name: &str) {
        let CheckpointWriter { file_system, folder, pending, durable, file_lock, .. } = &*self.writer;
        let _files = lock(file_lock);
        lock(pending).dirty.remove(name);
        lock(durable).remove(name);
        // A scene without steps has no file.
        if file_system.remove_file(&checkpoint_path(folder, name)).is_ok() {
            // Without this sync, a power loss could bring the step back for a later scene with this name.
            file_system.sync_folder(folder).ok();
        }
    }

    /// Writes the states that are not written yet, and ends the thread. Waits for the disk.
    pub(in crate::engine) fn finish(&self) {
        lock(&self.writer.pending).is_stopping = true;
        self.writer.change_signal.notify_one();
        if let Some(thread) = lock(&self.thread).take() {
            thread.join().ok(); // If the thread has panicked, the panic hook has printed the panic.
        }
    }
}

/// The checkpoints of one scene.
#[derive(Debug, Clone)]
pub(in crate::engine) struct SceneCheckpoints {
    store: Arc<CheckpointStore>,
    name: String,
}

impl SceneCheckpoints {
    pub(in crate::engine) const fn new(store: Arc<CheckpointStore>, name: String) -> Self {
        Self { store, name }
    }

    /// Records the newest state of the scene. Never waits for the disk.
    pub(in crate::engine) fn save(&self, state: &Arc<SceneState>) {
        self.store.enqueue(&self.name, state);
    }

    /// The newest step of the scene that survives a crash of the server and a power loss.
    pub(in crate::engine) fn durable_step(&self) -> Option<DurableStep> {
        self.store.durable_step(&self.name)
    }
}

impl Drop for CheckpointStore {
    fn drop(&mut self) {
        self.finish();
    }
}

/// Processor time of this thread.
fn thread_cpu_time() -> Duration {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    Duration::try_from(time).unwrap_or_default()
}

impl CheckpointWriter {
    fn new(folder: PathBuf, file_system: &Arc<dyn FileSystem>) -> Self {
        Self {
            file_system: Arc::clone(file_system),
            folder,
            pending: Mutex::default(),
            change_signal: Condvar::new(),
            file_lock: Mutex::default(),
            durable: Mutex::default(),
            is_degraded: watch::Sender::new(false),
        }
    }

    /// Writes dirty states until the store is finished and no state is dirty, or cannot be written.
    fn run(&self) {
        loop {
            let has_no_work = |pending: &mut PendingWrites| pending.dirty.is_empty() && !pending.is_stopping;
            // Wait for work. Drop the lock before `file_lock` is acquired, because of the lock order.
            drop(
                self.change_signal.wait_while(lock(&self.pending), has_no_work).unwrap_or_else(PoisonError::into_inner),
            );
            let begin = thread_cpu_time();
            let is_written = self.write_round();
            let cpu_time = thread_cpu_time().saturating_sub(begin);
            let pending = lock(&self.pending);
            if pending.is_stopping && (pending.dirty.is_empty() || !is_written) {
                return;
            }
            let is_running = |pending: &mut PendingWrites| !pending.is_stopping;
            let pause = if is_written { WRITE_INTERVAL } else { RETRY_INTERVAL }.max(PAUSE_PER_CPU_TIME * cpu_time);
            drop(
                self.change_signal
                    .wait_timeout_while(pending, pause, is_running)
                    .unwrap_or_else(PoisonError::into_inner),
            );
        }
    }

    /// Writes the states that are dirty now. Returns whether all of them are on disk.
    fn write_round(&self) -> bool {
        let _files = lock(&self.file_lock);
        let dirty = std::mem::take(&mut lock(&self.pending).dirty);
        let mut is_written = true;
        for (name, state) in dirty {
            match write_atomic(&*self.file_system, &checkpoint_path(&self.folder, &name), &encode(&state)) {
                Ok(()) => drop(lock(&self.durable).insert(name, DurableStep::of(&state))),
                Err(error) => {
                    is_written = false;
                    // The log limits such records to one per second.
                    tracing::warn!(scene = name, %error, "the last step could not be written; it is tried again");
                    // Unless there is a newer state.
                    lock(&self.pending).dirty.entry(name).or_insert(state);
                }
            }
        }
        self.is_degraded.send_if_modified(|is_degraded| std::mem::replace(is_degraded, !is_written) == is_written);
        is_written
    }
}

fn checkpoint_path(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{name}.step"))
}

fn encode(state: &SceneState) -> Vec<u8> {
    let size = HEADER_BYTES + 4 * state.q.len() + TRANSFORM_BYTES * state.transforms.len() + HASH_BYTES;
    let mut bytes = Vec::with_capacity(size);
    bytes.extend_from_slice(match &state.origins {
        None => MAGIC,
        Some(origins) if origins.pivots().is_empty() => MAGIC_ORIGINS,
        Some(_) => MAGIC_PIVOTS,
    });
    bytes.extend_from_slice(&state.run.to_le_bytes());
    bytes.extend_from_slice(&state.step.to_le_bytes());
    bytes.extend_from_slice(&state.time.to_le_bytes());
    bytes.extend_from_slice(&(state.q.len() as u64).to_le_bytes());
    bytes.extend_from_slice(&(state.transforms.len() as u64).to_le_bytes());
    let transforms = state.transforms.iter().flat_map(|transform| transform.0);
    bytes.extend(state.q.iter().copied().chain(transforms).flat_map(f32::to_le_bytes));
    if let Some(origins) = &state.origins {
        let shared = origins.shared_origin();
        let (translations, pivots) = (origins.translations().as_flattened(), origins.pivots().as_flattened());
        bytes.extend(shared.iter().chain(translations).chain(pivots).flat_map(|number| number.to_le_bytes()));
    }
    let hash = Sha256::digest(&bytes);
    bytes.extend_from_slice(&hash);
    bytes
}

fn decode(bytes: &[u8], scene: &Scene) -> Result<SceneState> {
    let rest_state = SceneState::rest(scene);
    let has_pivots = bytes.starts_with(MAGIC_PIVOTS);
    let has_origins = bytes.starts_with(MAGIC_ORIGINS) || has_pivots;
    let points_per_root = usize::from(has_origins) + usize::from(has_pivots);
    let origin_bytes = POINT_BYTES * (usize::from(has_origins) + points_per_root * rest_state.transforms.len());
    let q_bytes = 4 * rest_state.q.len();
    let transform_bytes = TRANSFORM_BYTES * rest_state.transforms.len();
    let file_size = HEADER_BYTES + q_bytes + transform_bytes + origin_bytes + HASH_BYTES;
    if bytes.len() != file_size {
        return Err(invalid(
            "checkpoint",
            format!("{file_size} bytes (the size for this scene)"),
            format!("{} bytes", bytes.len()),
        ));
    }
    let (body, hash) = bytes.split_at(file_size - HASH_BYTES);
    if Sha256::digest(body).as_slice() != hash || !(has_origins || body.starts_with(MAGIC)) {
        return Err(invalid("checkpoint", "bytes that match their SHA-256", "a damaged file"));
    }
    // The words of 8 bytes in the header: magic number, run, step, time, and the two counts.
    let word = |index: usize| {
        let mut word = [0; 8];
        word.copy_from_slice(&body[8 * index..8 * index + 8]);
        word
    };
    let counts = [u64::from_le_bytes(word(4)), u64::from_le_bytes(word(5))];
    if counts != [rest_state.q.len() as u64, rest_state.transforms.len() as u64] {
        let expected = format!("{} coordinates and {} transforms", rest_state.q.len(), rest_state.transforms.len());
        return Err(invalid("checkpoint", expected, format!("{counts:?}")));
    }
    let (q, transforms_and_origins) = body[HEADER_BYTES..].split_at(q_bytes);
    let (transforms, origins) = transforms_and_origins.split_at(transform_bytes);
    let f32_from_bytes = |word: &[u8]| f32::from_le_bytes([word[0], word[1], word[2], word[3]]);
    let transform = |bytes: &[u8]| Transform(std::array::from_fn(|entry| f32_from_bytes(&bytes[4 * entry..])));
    let mut transforms: Vec<Transform> = transforms.chunks_exact(TRANSFORM_BYTES).map(transform).collect();
    let origins = match has_origins || scene.is_far {
        true => Some(decode_origins(origins, scene, &transforms)?),
        false => None,
    };
    if let Some(origins) = &origins {
        // The file may come from a version with other floating origins.
        let rebased = transforms.iter().enumerate().map(|(root, transform)| origins.rebase_transform(root, *transform));
        transforms = rebased.collect();
    }
    Ok(SceneState {
        run: u64::from_le_bytes(word(1)),
        step: u64::from_le_bytes(word(2)),
        time: f64::from_le_bytes(word(3)),
        q: q.chunks_exact(4).map(f32_from_bytes).collect(),
        transforms,
        origins: origins.map(Arc::new),
        ..rest_state
    })
}

/// Decodes the shared origin, the translations and the pivots. A file from a version without pivots has none, and a
/// file without origins has transforms relative to the scene's origin.
fn decode_origins(bytes: &[u8], scene: &Scene, transforms: &[Transform]) -> Result<FloatingOrigins> {
    let point_from_bytes = |bytes: &[u8]| {
        std::array::from_fn(|axis| {
            let mut word = [0; 8];
            word.copy_from_slice(&bytes[8 * axis..8 * axis + 8]);
            f64::from_le_bytes(word)
        })
    };
    let mut points = bytes.chunks_exact(POINT_BYTES).map(point_from_bytes);
    let shared_origin = points.next().unwrap_or_default();
    let mut translations: Vec<[f64; 3]> = match bytes {
        [] => transforms.iter().map(|transform| transform.translation().into()).collect(),
        _ => points.by_ref().take(transforms.len()).collect(),
    };
    FloatingOrigins::change_pivots(scene, transforms, &points.collect::<Vec<_>>(), &mut translations);
    FloatingOrigins::restore(scene, shared_origin, translations)
}

#[cfg(test)]
mod tests {
    use std::io::Write;
    use std::sync::atomic::{AtomicBool, Ordering};
    use std::time::Instant;

    use super::super::file_system::{DiskFileSystem, StateFile};
    use super::*;
    use crate::engine::testing;

    /// A disk that is full while `is_full` is set: files can be created but not written.
    #[derive(Debug, Default)]
    struct FullDisk {
        is_full: Arc<AtomicBool>,
    }

    #[derive(Debug)]
    struct FullDiskFile {
        is_full: Arc<AtomicBool>,
        file: Box<dyn StateFile>,
    }

    impl FileSystem for FullDisk {
        fn create_folder(&self, path: &Path) -> io::Result<()> {
            DiskFileSystem.create_folder(path)
        }

        fn create_file(&self, path: &Path, is_new: bool) -> io::Result<Box<dyn StateFile>> {
            let (is_full, file) = (Arc::clone(&self.is_full), DiskFileSystem.create_file(path, is_new)?);
            Ok(Box::new(FullDiskFile { is_full, file }))
        }

        fn sync_folder(&self, path: &Path) -> io::Result<()> {
            DiskFileSystem.sync_folder(path)
        }

        fn sync_tree(&self, path: &Path) -> io::Result<()> {
            DiskFileSystem.sync_tree(path)
        }

        fn rename(&self, from: &Path, to: &Path) -> io::Result<()> {
            DiskFileSystem.rename(from, to)
        }

        fn remove_file(&self, path: &Path) -> io::Result<()> {
            DiskFileSystem.remove_file(path)
        }

        fn remove_folder(&self, path: &Path) -> io::Result<()> {
            DiskFileSystem.remove_folder(path)
        }
    }

    impl Write for FullDiskFile {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            if self.is_full.load(Ordering::Relaxed) {
                return Err(io::ErrorKind::StorageFull.into());
            }
            self.file.write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            self.file.flush()
        }
    }

    impl StateFile for FullDiskFile {
        fn sync(&mut self) -> io::Result<()> {
            self.file.sync()
        }
    }

    fn wait_until(what: &str, mut condition: impl FnMut() -> bool) {
        let start = Instant::now();
        while !condition() {
            assert!(start.elapsed() < Duration::from_secs(60), "expected within 60 s: {what}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    #[test]
    fn full_disk_stops_the_durable_step_until_it_has_room() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let disk = FullDisk::default();
        let is_full = Arc::clone(&disk.is_full);
        let file_system: Arc<dyn FileSystem> = Arc::new(disk);
        let checkpoints =
            CheckpointStore::start(folder.path().to_owned(), &file_system).expect("expected a checkpoint thread");
        let is_degraded = checkpoints.watch_degraded();
        let scene = testing::two_strips();
        let save = |step| checkpoints.enqueue("strips", &Arc::new(SceneState { step, ..deformed_state(&scene) }));
        let durable_number = || checkpoints.durable_step("strips").map(|durable| durable.number);
        save(1);
        wait_until("step 1 on disk", || durable_number() == Some(1));
        is_full.store(true, Ordering::Relaxed);
        save(2);
        wait_until("a degraded store", || *is_degraded.borrow());
        save(3);
        assert_eq!(durable_number(), Some(1));
        is_full.store(false, Ordering::Relaxed);
        wait_until("step 3 on disk", || durable_number() == Some(3) && !*is_degraded.borrow());
        is_full.store(true, Ordering::Relaxed);
        save(4);
        // Ends although the step cannot be written.
        checkpoints.finish();
        let state = CheckpointStore::without_thread(folder.path().to_owned(), &file_system).load("strips", &scene);
        assert_eq!(state.expect("expected a valid checkpoint").map(|state| state.step), Some(3));
    }

    fn deformed_state(scene: &Scene) -> SceneState {
        let mut state = SceneState { run: 3, step: 41, time: 0.25, ..SceneState::rest(scene) };
        state.q[1] = -0.5;
        state.transforms[1].0[3] = 7.0;
        state
    }

    #[test]
    fn checkpoint_is_restored_exactly_and_a_damaged_one_is_rejected() {
        let scene = testing::two_strips();
        let state = deformed_state(&scene);
        let bytes = encode(&state);
        assert_eq!(decode(&bytes, &scene).expect("expected a valid checkpoint"), state);
        // One byte each of the magic number, the run, q and the hash.
        for index in [0, 9, HEADER_BYTES + 2, bytes.len() - 1] {
            let mut damaged_bytes = bytes.clone();
            damaged_bytes[index] ^= 1;
            assert!(decode(&damaged_bytes, &scene).is_err(), "expected an error for a changed byte {index}");
        }
        assert!(decode(&bytes[..bytes.len() - 1], &scene).is_err());
        assert!(decode(&[], &scene).is_err());
    }

    #[test]
    fn checkpoint_with_origins_is_restored_exactly() {
        use modalcast_model::scene::{RawStepUpdate, StepUpdate, TransformFormat};
        let scene = testing::two_strips();
        let rotation = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        let translation = [1e7 + 0.125, -3.5, 0.0_f64].into_iter().flat_map(f64::to_le_bytes);
        let raw = RawStepUpdate {
            transform_domains: vec![1],
            transforms: rotation.chain(translation).collect(),
            transform_format: TransformFormat::QuaternionXyzwF64,
            ..RawStepUpdate::default()
        };
        let mut state = deformed_state(&scene);
        state.apply(&scene, &StepUpdate::parse(&scene, &raw).expect("expected a valid step"));
        let bytes = encode(&state);
        let restored_state = decode(&bytes, &scene).expect("expected a valid checkpoint");
        assert_eq!((&restored_state, restored_state.origin_of(1)), (&state, state.origin_of(1)));
        assert!(
            (state.origin_of(1)[0] - 1e7).abs() < 1.0,
            "expected an origin near the domain: {:?}",
            state.origin_of(1)
        );
        assert_ne!(
            SceneState { origins: None, ..restored_state },
            state,
            "control: expected states with different origins to differ"
        );
        assert!(decode(&bytes[..bytes.len() - POINT_BYTES], &scene).is_err());
    }

    #[test]
    fn finish_writes_the_newest_state_and_remove_deletes_it() {
        let folder = tempfile::tempdir().expect("expected a temporary folder");
        let scene = testing::two_strips();
        let checkpoints = {
            let file_system: Arc<dyn FileSystem> = Arc::new(DiskFileSystem);
            CheckpointStore::start(folder.path().to_owned(), &file_system).expect("expected a checkpoint thread")
        };
        for step in 0..50 {
            checkpoints.enqueue("strips", &Arc::new(SceneState { step, ..deformed_state(&scene) }));
        }
        checkpoints.finish();
        let restored_state =
            checkpoints.load("strips", &scene).expect("expected a valid checkpoint").expect("expected a checkpoint");
        assert_eq!(restored_state, SceneState { step: 49, ..deformed_state(&scene) });
        checkpoints.remove("strips");
        assert_eq!(checkpoints.load("strips", &scene), Ok(None));
    }
}
