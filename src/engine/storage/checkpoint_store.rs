//! Checkpoint store: persists the last step of every scene, one file per scene. A background thread writes in rounds,
//! at most ten per second. A round writes and syncs one file per changed scene. Files are replaced by an atomic rename,
//! so a killed server never leaves a partial file. It loses the steps of the last 0.1 s plus the duration of one round.

use std::collections::BTreeMap;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

use sha2::{Digest as _, Sha256};

use super::atomic_file::write_atomic;
use crate::engine::lock::lock;
use modalcast_model::domain::Transform;
use modalcast_model::error::{Result, fault, fault_in, invalid};
use modalcast_model::scene::{FloatingOrigins, Scene, SceneState};

/// Pause between two rounds of writes.
const WRITE_INTERVAL: Duration = Duration::from_millis(100);

/// Magic number of a checkpoint file. The file continues with run and step number (u64), time (f64, seconds), the
/// counts of coordinates and of transforms (u64), q (f32), the transforms (12 f32 each), and the SHA-256 of all bytes
/// before the hash. Little-endian.
const MAGIC: &[u8; 8] = b"MCSTEP01";
/// Magic number of a checkpoint with floating origins, the points that transforms are relative to. Between the
/// transforms and the hash, the file contains the shared origin (3 f64) and one translation (3 f64) per transform.
const MAGIC_ORIGINS: &[u8; 8] = b"MCSTEP02";
/// The magic number and five numbers of 8 bytes.
const HEADER_BYTES: usize = 8 + 5 * 8;
const HASH_BYTES: usize = 32;
/// Size of a transform: 12 f32.
const TRANSFORM_BYTES: usize = 48;
/// Size of an origin or a translation: 3 f64.
const POINT_BYTES: usize = 24;

/// Writes checkpoints in the background.
#[derive(Debug)]
pub(in crate::engine) struct CheckpointStore {
    folder: PathBuf,
    shared: Arc<Shared>,
    thread: Mutex<Option<JoinHandle<()>>>,
}

#[derive(Debug, Default)]
struct Shared {
    pending: Mutex<PendingWrites>,
    /// Signaled when `pending` has changed.
    change_signal: Condvar,
    /// Held while files are read, written or removed. Lock order: `file_lock` before `pending`.
    file_lock: Mutex<()>,
}

#[derive(Debug, Default)]
struct PendingWrites {
    /// The newest states that are not on disk yet, by scene name.
    dirty: BTreeMap<String, Arc<SceneState>>,
    is_stopping: bool,
}

impl CheckpointStore {
    /// Starts the thread that writes into `folder`.
    ///
    /// # Errors
    /// `Fault` when the folder or the thread cannot be created.
    pub(in crate::engine) fn start(folder: PathBuf) -> Result<Self> {
        fs::create_dir_all(&folder).map_err(fault_in("state folder"))?;
        let shared = Arc::new(Shared::default());
        let (thread_shared, thread_folder) = (Arc::clone(&shared), folder.clone());
        let thread = std::thread::Builder::new()
            .name("checkpoints".into())
            .spawn(move || write_loop(&thread_shared, &thread_folder))
            .map_err(fault_in("checkpoint thread"))?;
        Ok(Self { folder, shared, thread: Mutex::new(Some(thread)) })
    }

    /// Records the newest state of a scene. Never waits for the disk.
    pub(in crate::engine) fn enqueue(&self, name: &str, state: &Arc<SceneState>) {
        lock(&self.shared.pending).dirty.insert(name.to_owned(), Arc::clone(state));
        self.shared.change_signal.notify_one();
    }

    /// Returns the newest recorded state of a scene, on disk or not. `None` if no state was recorded. Waits for the
    /// disk.
    ///
    /// # Errors
    /// `Invalid` when the file is damaged or its size does not match the scene; `Fault` of the disk.
    pub(in crate::engine) fn load(&self, name: &str, scene: &Scene) -> Result<Option<SceneState>> {
        let _files = lock(&self.shared.file_lock);
        // A scene that failed and is opened again may have a state that is not on disk yet.
        if let Some(state) = lock(&self.shared.pending).dirty.get(name) {
            // Decoding checks that the state matches the scene.
            return decode(&encode(state), scene).map(Some);
        }
        match fs::read(checkpoint_path(&self.folder, name)) {
            Ok(bytes) => decode(&bytes, scene).map(Some),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(fault("reading a checkpoint", error)),
        }
    }

    /// Removes the checkpoint of a scene. Waits for the disk.
    pub(in crate::engine) fn remove(&self, name: &str) {
        let _files = lock(&self.shared.file_lock);
        lock(&self.shared.pending).dirty.remove(name);
        // A scene without steps has no file.
        fs::remove_file(checkpoint_path(&self.folder, name)).ok();
    }

    /// Writes the states that are not written yet, and ends the thread. Waits for the disk.
    pub(in crate::engine) fn finish(&self) {
        lock(&self.shared.pending).is_stopping = true;
        self.shared.change_signal.notify_one();
        if let Some(thread) = lock(&self.thread).take() {
            thread.join().ok(); // If the thread has panicked, the panic hook has printed the panic.
        }
    }
}

/// The checkpoints of one scene.
#[derive(Debug)]
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
}

impl Drop for CheckpointStore {
    fn drop(&mut self) {
        self.finish();
    }
}

/// Writes dirty states until the store is finished and no state is dirty.
fn write_loop(shared: &Shared, folder: &Path) {
    loop {
        let has_no_work = |pending: &mut PendingWrites| pending.dirty.is_empty() && !pending.is_stopping;
        // Wait for work. Drop the lock before `file_lock` is acquired, because of the lock order.
        drop(
            shared.change_signal.wait_while(lock(&shared.pending), has_no_work).unwrap_or_else(PoisonError::into_inner),
        );
        {
            let _files = lock(&shared.file_lock);
            let dirty = std::mem::take(&mut lock(&shared.pending).dirty);
            for (name, state) in dirty {
                if let Err(error) = write_atomic(&checkpoint_path(folder, &name), &encode(&state)) {
                    tracing::warn!(scene = name, %error, "the checkpoint could not be written");
                }
            }
        }
        let pending = lock(&shared.pending);
        if pending.is_stopping && pending.dirty.is_empty() {
            return;
        }
        let is_running = |pending: &mut PendingWrites| !pending.is_stopping;
        drop(
            shared
                .change_signal
                .wait_timeout_while(pending, WRITE_INTERVAL, is_running)
                .unwrap_or_else(PoisonError::into_inner),
        );
    }
}

fn checkpoint_path(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{name}.step"))
}

fn encode(state: &SceneState) -> Vec<u8> {
    let size = HEADER_BYTES + 4 * state.q.len() + TRANSFORM_BYTES * state.transforms.len() + HASH_BYTES;
    let mut bytes = Vec::with_capacity(size);
    bytes.extend_from_slice(if state.origins.is_some() { MAGIC_ORIGINS } else { MAGIC });
    bytes.extend_from_slice(&state.run.to_le_bytes());
    bytes.extend_from_slice(&state.step.to_le_bytes());
    bytes.extend_from_slice(&state.time.to_le_bytes());
    bytes.extend_from_slice(&(state.q.len() as u64).to_le_bytes());
    bytes.extend_from_slice(&(state.transforms.len() as u64).to_le_bytes());
    let transforms = state.transforms.iter().flat_map(|transform| transform.0);
    bytes.extend(state.q.iter().copied().chain(transforms).flat_map(f32::to_le_bytes));
    if let Some(origins) = &state.origins {
        let shared = origins.shared_origin();
        let translations = origins.translations().as_flattened();
        bytes.extend(shared.iter().chain(translations).flat_map(|number| number.to_le_bytes()));
    }
    let hash = Sha256::digest(&bytes);
    bytes.extend_from_slice(&hash);
    bytes
}

fn decode(bytes: &[u8], scene: &Scene) -> Result<SceneState> {
    let rest_state = SceneState::rest(scene);
    let has_origins = bytes.starts_with(MAGIC_ORIGINS);
    let origin_bytes = if has_origins { POINT_BYTES * (1 + rest_state.transforms.len()) } else { 0 };
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
    let origins = if has_origins { Some(decode_origins(origins, scene)?) } else { None };
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

/// Decodes the shared origin, then the translations.
fn decode_origins(bytes: &[u8], scene: &Scene) -> Result<FloatingOrigins> {
    let point_from_bytes = |bytes: &[u8]| {
        std::array::from_fn(|axis| {
            let mut word = [0; 8];
            word.copy_from_slice(&bytes[8 * axis..8 * axis + 8]);
            f64::from_le_bytes(word)
        })
    };
    let (shared, translations) = bytes.split_at(POINT_BYTES);
    let translations = translations.chunks_exact(POINT_BYTES).map(point_from_bytes).collect();
    FloatingOrigins::restore(scene, point_from_bytes(shared), translations)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

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
        let checkpoints = CheckpointStore::start(folder.path().to_owned()).expect("expected a checkpoint thread");
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
