//! Frame streams whose cameras can be moved while the streams run: the ids of the streams and their present cameras.

use std::collections::HashMap;
use std::fmt;
use std::sync::{Arc, Mutex, Weak};

use tokio::sync::{Notify, watch};

use crate::engine::lock::lock;
use crate::engine::output::output_spec::PictureSpec;
use modalcast_model::error::{Error, Result, fault_in, invalid};
use modalcast_model::scene::{CameraSource, Scene};

/// Identifies a frame stream. Only the client that opened the stream and the server know it.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct StreamId([u8; Self::BYTES]);

impl StreamId {
    const BYTES: usize = 16;

    /// Reads an id from a request.
    ///
    /// # Errors
    /// `Invalid` unless there are 16 bytes.
    pub fn parse(field: &str, bytes: &[u8]) -> Result<Self> {
        let id = bytes
            .try_into()
            .map_err(|_| invalid(field, format!("{} bytes", Self::BYTES), format!("{} bytes", bytes.len())))?;
        Ok(Self(id))
    }

    fn random() -> Result<Self> {
        let mut bytes = [0; Self::BYTES];
        getrandom::fill(&mut bytes).map_err(fault_in("random stream id"))?;
        Ok(Self(bytes))
    }

    pub const fn as_bytes(&self) -> &[u8] {
        &self.0
    }
}

/// Without the bytes, because an id in a log would let others move the cameras.
impl fmt::Debug for StreamId {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        out.write_str("StreamId")
    }
}

/// The pictures of a frame stream with their present cameras.
#[derive(Debug, Clone)]
pub(in crate::engine) struct CameraState {
    pub pictures: Arc<[PictureSpec]>,
    /// Number of updates of the cameras so far.
    pub camera_version: u64,
}

/// Moves the cameras of one frame stream. Updates that the scene has not drawn yet are merged.
#[derive(Debug, Clone)]
pub struct CameraControl {
    state: watch::Sender<CameraState>,
    /// Wakes the scene after an update.
    scene_wake: Arc<Notify>,
}

impl CameraControl {
    pub(super) fn new(pictures: Arc<[PictureSpec]>, scene_wake: Arc<Notify>) -> Self {
        Self { state: watch::Sender::new(CameraState { pictures, camera_version: 0 }), scene_wake }
    }

    pub(super) fn receiver(&self) -> watch::Receiver<CameraState> {
        self.state.subscribe()
    }

    /// The pictures with their present cameras.
    pub fn pictures(&self) -> Arc<[PictureSpec]> {
        Arc::clone(&self.state.borrow().pictures)
    }

    /// Replaces the cameras of pictures, given by index. Returns the version of the first frame that shows them.
    pub fn move_cameras(&self, cameras: &[(usize, CameraSource)]) -> u64 {
        let mut camera_version = 0;
        self.state.send_modify(|state| {
            let mut pictures = state.pictures.to_vec();
            for (index, camera) in cameras {
                if let Some(picture) = pictures.get_mut(*index) {
                    picture.camera = *camera;
                }
            }
            state.pictures = pictures.into();
            state.camera_version += 1;
            camera_version = state.camera_version;
        });
        self.scene_wake.notify_one();
        camera_version
    }
}

/// A running frame stream that can be found by its id.
#[derive(Debug)]
pub struct FrameStreamEntry {
    pub scene: Arc<Scene>,
    pub cameras: CameraControl,
}

/// All running frame streams. The limit on the subscribers of a scene also limits their number.
#[derive(Debug, Default)]
pub(in crate::engine) struct FrameStreamRegistry(Mutex<HashMap<StreamId, Arc<FrameStreamEntry>>>);

impl FrameStreamRegistry {
    /// Registers a stream until the registration is dropped.
    ///
    /// # Errors
    /// `Fault` when the operating system returns no random bytes.
    pub(in crate::engine) fn register(self: &Arc<Self>, entry: FrameStreamEntry) -> Result<FrameStreamRegistration> {
        let id = StreamId::random()?;
        lock(&self.0).insert(id, Arc::new(entry));
        Ok(FrameStreamRegistration { id, registry: Arc::downgrade(self) })
    }

    /// The running stream with this id.
    ///
    /// # Errors
    /// `StreamNotFound` when no running stream has this id.
    pub(in crate::engine) fn find(&self, id: StreamId) -> Result<Arc<FrameStreamEntry>> {
        lock(&self.0).get(&id).cloned().ok_or(Error::StreamNotFound)
    }
}

/// Keeps a frame stream in the registry.
#[derive(Debug)]
pub struct FrameStreamRegistration {
    pub id: StreamId,
    registry: Weak<FrameStreamRegistry>,
}

impl Drop for FrameStreamRegistration {
    fn drop(&mut self) {
        if let Some(registry) = self.registry.upgrade() {
            lock(&registry.0).remove(&self.id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::output::output_spec::FrameOutput;
    use crate::engine::testing;
    use modalcast_model::scene::{Camera, FrameSize, FrameStyle};

    fn camera_control() -> CameraControl {
        let camera = CameraSource::framing(&testing::two_strips(), FrameSize::new(8, 8));
        let picture = PictureSpec {
            camera,
            size: FrameSize::new(8, 8),
            output: FrameOutput::Color,
            style: FrameStyle::default(),
        };
        CameraControl::new([picture; 2].into(), Arc::default())
    }

    #[test]
    fn stream_is_found_by_its_id_until_its_registration_is_dropped() {
        let registry = Arc::new(FrameStreamRegistry::default());
        let entry = || FrameStreamEntry { scene: testing::two_strips(), cameras: camera_control() };
        let registrations = [(); 2].map(|()| registry.register(entry()).expect("expected random bytes"));
        let [first, second] = registrations;
        let first_id = StreamId::parse("stream", first.id.as_bytes()).expect("expected a valid id");
        assert!(registry.find(first_id).is_ok() && first_id != second.id);
        drop(first);
        assert_eq!(registry.find(first_id).expect_err("expected an ended stream"), Error::StreamNotFound);
        assert!(registry.find(second.id).is_ok(), "control: expected the other stream");
        assert!(StreamId::parse("stream", &[7; 15]).is_err());
        assert_eq!(format!("{:?}", second.id), "StreamId");
    }

    #[test]
    fn update_moves_only_the_named_pictures_and_counts() {
        let cameras = camera_control();
        let receiver = cameras.receiver();
        let [still, moved] = [0, 1].map(|index: usize| cameras.pictures()[index].camera);
        let moved = CameraSource::Fixed(Camera { far: 7.0, near: 1.0, ..*moved.at_rest() });
        assert_eq!((cameras.move_cameras(&[(1, still)]), cameras.move_cameras(&[(1, moved)])), (1, 2));
        let state = receiver.borrow().clone();
        assert_eq!((state.pictures[0].camera, state.pictures[1].camera, state.camera_version), (still, moved, 2));
    }
}
