//! Checkpoint store: persists the last step of every scene, one file per scene. A background thread writes at most ten
//! times per second and replaces files by an atomic rename. A killed server therefore loses the last 0.1 s plus the
//! time of one round, which syncs a file and its folder per changed scene; it never leaves a partial file.

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
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::scene::{FloatingOrigins, Scene, SceneState};

/// Pause between two rounds of writes.
const WRITE_INTERVAL: Duration = Duration::from_millis(100);

/// Magic number of a checkpoint file. The file continues with run and step number (u64), time (f64, seconds), the
/// counts of coordinates and of transforms (u64), q (f32), the transforms (12 f32 each), and the SHA-256 of all bytes
/// before the hash. Little-endian.
const MAGIC: &[u8; 8] = b"MCSTEP01";
/// Magic number of a checkpoint with floating origins: as above, plus the shared origin (3 f64) and one translation (3 f64) per
/// transform after the transforms.
const MAGIC_ORIGINS: &[u8; 8] = b"MCSTEP02";
const HEADER_BYTES: usize = 8 + 5 * 8;
const HASH_BYTES: usize = 32;

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
    changed: Condvar,
    /// Held while files are written or removed. Lock order: `files` before `pending`.
    files: Mutex<()>,
}

#[derive(Debug, Default)]
struct PendingWrites {
    /// Dirty states: the newest state of each scene that is not on disk yet, at most one per scene.
    dirty: BTreeMap<String, Arc<SceneState>>,
    stopping: bool,
}

impl CheckpointStore {
    /// Starts the thread that writes into `folder`.
    ///
    /// # Errors
    /// `Fault` when the folder or the thread cannot be created.
    pub(in crate::engine) fn start(folder: PathBuf) -> Result<Self> {
        fs::create_dir_all(&folder).map_err(fault_in("state folder"))?;
        let shared = Arc::new(Shared::default());
        let (theirs, place) = (Arc::clone(&shared), folder.clone());
        let thread = std::thread::Builder::new()
            .name("checkpoints".into())
            .spawn(move || write_loop(&theirs, &place))
            .map_err(fault_in("checkpoint thread"))?;
        Ok(Self { folder, shared, thread: Mutex::new(Some(thread)) })
    }

    /// Records the newest state of a scene. Never waits for the disk.
    pub(in crate::engine) fn enqueue(&self, name: &str, state: &Arc<SceneState>) {
        lock(&self.shared.pending).dirty.insert(name.to_owned(), Arc::clone(state));
        self.shared.changed.notify_one();
    }

    /// The checkpoint of a scene, if there is one: the newest recorded state, on disk or not. Waits for the disk.
    ///
    /// # Errors
    /// `Invalid` when the file is damaged or its size does not match the scene; `Fault` of the disk.
    pub(in crate::engine) fn load(&self, name: &str, scene: &Scene) -> Result<Option<SceneState>> {
        let _files = lock(&self.shared.files);
        // A scene that failed and is opened again may have a state that is not on disk yet.
        if let Some(state) = lock(&self.shared.pending).dirty.get(name) {
            return decode(&encode(state), scene).map(Some);
        }
        match fs::read(path_of(&self.folder, name)) {
            Ok(bytes) => decode(&bytes, scene).map(Some),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(fault_in("reading the kept step")(error)),
        }
    }

    /// Removes a scene's file. Waits for the disk.
    pub(in crate::engine) fn remove(&self, name: &str) {
        let _files = lock(&self.shared.files);
        lock(&self.shared.pending).dirty.remove(name);
        // Usually the scene had no step, so there is no file.
        fs::remove_file(path_of(&self.folder, name)).ok();
    }

    /// Writes the dirty states and ends the thread. Waits for the disk.
    pub(in crate::engine) fn finish(&self) {
        lock(&self.shared.pending).stopping = true;
        self.shared.changed.notify_one();
        if let Some(thread) = lock(&self.thread).take() {
            thread.join().ok(); // The panic hook has already printed a panic of the thread.
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

fn write_loop(shared: &Shared, folder: &Path) {
    loop {
        let waits = |pending: &mut PendingWrites| pending.dirty.is_empty() && !pending.stopping;
        drop(shared.changed.wait_while(lock(&shared.pending), waits).unwrap_or_else(PoisonError::into_inner));
        {
            let _files = lock(&shared.files);
            let dirty = std::mem::take(&mut lock(&shared.pending).dirty);
            for (name, state) in dirty {
                if let Err(error) = write_atomic(&path_of(folder, &name), &encode(&state)) {
                    tracing::warn!(scene = name, %error, "the last step could not be kept");
                }
            }
        }
        let pending = lock(&shared.pending);
        if pending.stopping && pending.dirty.is_empty() {
            return;
        }
        let runs = |pending: &mut PendingWrites| !pending.stopping;
        drop(shared.changed.wait_timeout_while(pending, WRITE_INTERVAL, runs).unwrap_or_else(PoisonError::into_inner));
    }
}

fn path_of(folder: &Path, name: &str) -> PathBuf {
    folder.join(format!("{name}.step"))
}

fn encode(state: &SceneState) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(HEADER_BYTES + 4 * state.q.len() + 48 * state.transforms.len() + HASH_BYTES);
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
    let rest = SceneState::rest(scene);
    let has_cells = bytes.starts_with(MAGIC_ORIGINS);
    let extra = if has_cells { 24 * (1 + rest.transforms.len()) } else { 0 };
    let size = HEADER_BYTES + 4 * rest.q.len() + 48 * rest.transforms.len() + extra + HASH_BYTES;
    if bytes.len() != size {
        return Err(invalid("kept step", format!("{size} bytes for this scene"), format!("{} bytes", bytes.len())));
    }
    let (body, hash) = bytes.split_at(size - HASH_BYTES);
    if Sha256::digest(body).as_slice() != hash || !(has_cells || body.starts_with(MAGIC)) {
        return Err(invalid("kept step", "bytes that match their SHA-256", "a damaged file"));
    }
    let word = |at: usize| {
        let mut word = [0; 8];
        word.copy_from_slice(&body[8 * at..8 * at + 8]);
        word
    };
    let counts = [u64::from_le_bytes(word(4)), u64::from_le_bytes(word(5))];
    if counts != [rest.q.len() as u64, rest.transforms.len() as u64] {
        let expected = format!("{} coordinates and {} transforms", rest.q.len(), rest.transforms.len());
        return Err(invalid("kept step", expected, format!("{counts:?}")));
    }
    let (q, places) = body[HEADER_BYTES..].split_at(4 * rest.q.len());
    let (transforms, origins) = places.split_at(48 * rest.transforms.len());
    let number = |word: &[u8]| f32::from_le_bytes([word[0], word[1], word[2], word[3]]);
    let transform = |bytes: &[u8]| Transform(std::array::from_fn(|entry| number(&bytes[4 * entry..])));
    Ok(SceneState {
        run: u64::from_le_bytes(word(1)),
        step: u64::from_le_bytes(word(2)),
        time: f64::from_le_bytes(word(3)),
        q: q.chunks_exact(4).map(number).collect(),
        transforms: transforms.chunks_exact(48).map(transform).collect(),
        origins: if has_cells { Some(Arc::new(decode_origins(origins)?)) } else { None },
        ..rest
    })
}

/// Decodes the shared origin (24 bytes), then the translations (24 bytes each).
fn decode_origins(bytes: &[u8]) -> Result<FloatingOrigins> {
    let point = |bytes: &[u8]| {
        std::array::from_fn(|axis| {
            let mut word = [0; 8];
            word.copy_from_slice(&bytes[8 * axis..8 * axis + 8]);
            f64::from_le_bytes(word)
        })
    };
    let (shared, translations) = bytes.split_at(24);
    FloatingOrigins::restore(point(shared), translations.chunks_exact(24).map(point).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

    fn moved(scene: &Scene) -> SceneState {
        let mut state = SceneState { run: 3, step: 41, time: 0.25, ..SceneState::rest(scene) };
        state.q[1] = -0.5;
        state.transforms[1].0[3] = 7.0;
        state
    }

    #[test]
    fn a_kept_step_comes_back_bit_for_bit_and_a_damaged_one_is_refused() {
        let scene = testing::two_strips();
        let state = moved(&scene);
        let bytes = encode(&state);
        assert_eq!(decode(&bytes, &scene).expect("whole"), state);
        for at in [0, 9, HEADER_BYTES + 2, bytes.len() - 1] {
            let mut damaged = bytes.clone();
            damaged[at] ^= 1;
            assert!(decode(&damaged, &scene).is_err(), "byte {at}");
        }
        assert!(decode(&bytes[..bytes.len() - 1], &scene).is_err());
        assert!(decode(&[], &scene).is_err());
    }

    #[test]
    fn a_step_with_cells_comes_back_with_them_and_one_cut_short_is_refused() {
        use modalcast_model::scene::{RawStepUpdate, StepUpdate, TransformFormat};
        let scene = testing::two_strips();
        let rotation = [0.0, 0.0, 0.0, 1.0_f32].into_iter().flat_map(f32::to_le_bytes);
        let translation = [1e7 + 0.125, -3.5, 0.0_f64].into_iter().flat_map(f64::to_le_bytes);
        let raw = RawStepUpdate {
            transform_domains: vec![1],
            transforms: rotation.chain(translation).collect(),
            transform_format: TransformFormat::RigidF64,
            ..RawStepUpdate::default()
        };
        let mut state = moved(&scene);
        state.apply(&scene, &StepUpdate::parse(&scene, &raw).expect("a good step"));
        let bytes = encode(&state);
        let kept = decode(&bytes, &scene).expect("whole");
        assert_eq!((&kept, kept.origin_of(1)), (&state, [9766.0 * 1024.0, 0.0, 0.0]));
        assert_ne!(SceneState { origins: None, ..kept }, state, "expected a comparison of floating origins");
        assert!(decode(&bytes[..bytes.len() - 24], &scene).is_err());
    }

    #[test]
    fn a_finished_keeper_has_written_the_newest_note_and_forgets_on_demand() {
        let folder = tempfile::tempdir().expect("a folder");
        let scene = testing::two_strips();
        let checkpoints = CheckpointStore::start(folder.path().to_owned()).expect("starts");
        for step in 0..50 {
            checkpoints.enqueue("strips", &Arc::new(SceneState { step, ..moved(&scene) }));
        }
        checkpoints.finish();
        let kept = checkpoints.load("strips", &scene).expect("fits").expect("is there");
        assert_eq!(kept, SceneState { step: 49, ..moved(&scene) });
        checkpoints.remove("strips");
        assert_eq!(checkpoints.load("strips", &scene), Ok(None));
    }
}
