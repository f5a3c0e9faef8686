//! Scenes that load slowly do not delay built-in ones.

use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::sync::{Arc, Mutex};

use modalcast::engine::{SceneSource, StoredUpload};
use modalcast_model::error::Result;
use modalcast_model::load::OpenedScene;
use modalcast_model::memory::MemoryReservation;
use modalcast_proto::v1;

use crate::service_harness::{Server, config, strips, with_timeout};

/// A source whose scene `built-in` opens at once. Every other scene waits until the test sends a message.
struct BlockedSource {
    started: SyncSender<()>,
    released: Mutex<Receiver<()>>,
}

impl SceneSource for BlockedSource {
    fn open(&self, source: &str, _: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        if !self.is_built_in(source) {
            self.started.send(()).ok(); // The test waits for the first load only.
            self.released.lock().expect("expected no panic").recv().expect("expected a message of the test");
        }
        Ok(strips().into())
    }

    fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        self.open(&upload.entry, memory)
    }

    fn is_built_in(&self, source: &str) -> bool {
        source == "built-in"
    }

    fn list(&self) -> Vec<String> {
        Vec::new()
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn built_in_scene_does_not_wait_for_files() {
    const LOADS: usize = 8;
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let ((started, starts), (release, released)) = (sync_channel(LOADS), sync_channel(LOADS));
    let source = BlockedSource { started, released: Mutex::new(released) };
    let server = Server::start_from(config(folder.path()), Arc::new(source)).await;
    let scenes = server.scenes().await;
    let open = |source: String| {
        let mut scenes = scenes.clone();
        let request = v1::OpenSceneRequest { scene: source.clone(), source };
        tokio::spawn(async move { scenes.open_scene(request).await.map(drop) })
    };
    let mut loads = Vec::new();
    for number in 0..LOADS {
        loads.push(open(format!("file-{number}")));
    }
    tokio::task::spawn_blocking(move || starts.recv().expect("expected a load")).await.expect("expected no panic");
    let built_in = open("built-in".into());
    with_timeout(built_in).await.expect("expected no panic").expect("expected the built-in scene to open");
    assert!(loads.iter().all(|load| !load.is_finished()), "expected the files to wait");
    for _ in 0..LOADS {
        release.send(()).expect("expected a waiting load");
    }
    for load in loads {
        with_timeout(load).await.expect("expected no panic").expect("expected the scene to open");
    }
}
