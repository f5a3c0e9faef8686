//! A server, driven scenes, and their recordings.

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};

use modalcast_client::{
    ArrayUpload, Client, Delivery, DomainTransform, DriveRequest, Frame, FrameStream, FrameStreamRequest, Picture,
    SceneInfo, Step, UploadDomain, UploadShape,
};
use modalcast_recording::{RecordRequest, Recorded, record};
use tokio::sync::oneshot;

/// How a server draws.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Renderer {
    Software,
    Off,
}

/// A server process with the built-in scenes. Dropping it kills the process and deletes its files.
pub(crate) struct Server {
    pub(crate) url: String,
    pub(crate) client: Client,
    process: Child,
    _folder: tempfile::TempDir,
}

/// The server's program: that of `MODALCAST_PROGRAM`, or the one of the same build, which `cargo test --workspace` or
/// `cargo build -p modalcast` has built.
fn server_program() -> PathBuf {
    let own_build = || {
        let test_program = std::env::current_exe().expect("the path of this program");
        let build_folder = test_program.ancestors().nth(2).expect("a folder of a build");
        build_folder.join("modalcast")
    };
    let program = std::env::var_os("MODALCAST_PROGRAM").map_or_else(own_build, PathBuf::from);
    assert!(program.exists(), "{} does not exist; build it with: cargo build -p modalcast", program.display());
    program
}

impl Server {
    /// A server that deforms and draws on the CPU.
    pub(crate) async fn start() -> Self {
        Self::start_with(Renderer::Software).await
    }

    pub(crate) async fn start_with(renderer: Renderer) -> Self {
        let scenes = tempfile::tempdir().expect("a folder");
        Self::start_in(renderer, scenes.path()).await
    }

    /// A server that can open the scenes of a folder.
    pub(crate) async fn start_in(renderer: Renderer, scenes: &Path) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let renderer = match renderer {
            Renderer::Software => "software",
            Renderer::Off => "off",
        };
        let mut process = Command::new(server_program())
            .args(["serve", "--listen", "127.0.0.1:0", "--backend", "cpu", "--renderer", renderer, "--state"])
            .arg(folder.path())
            .arg("--scenes")
            .arg(scenes)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("a process");
        let mut lines = BufReader::new(process.stdout.take().expect("a pipe")).lines();
        let line = lines.next().expect("the address").expect("text");
        let url = line.strip_prefix("listening on ").expect("the address").to_owned();
        let client = Client::connect(&url).await.expect("a connection");
        Self { url, client, process, _folder: folder }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        // Both calls fail if the process has already ended.
        self.process.kill().ok();
        self.process.wait().ok();
    }
}

/// Row-major 3x4: a rotation about y by an angle in radians, then a translation.
pub(crate) fn turned(angle: f32, translation: [f32; 3]) -> [f32; 12] {
    let (sine, cosine) = angle.sin_cos();
    let [x, y, z] = translation;
    [cosine, 0.0, sine, x, 0.0, 1.0, 0.0, y, -sine, 0.0, cosine, z]
}

/// A step of the test scenes at 24 Hz: changes q of domain 0 in every step, and the transform of domain 1 in every
/// third one.
pub(crate) fn step(number: u64, rank: usize) -> Step {
    let mut q = vec![0.0; rank];
    q[0] = (number as f32 * 0.7).sin() * 2.0;
    q[rank - 1] = number as f32 * 0.125;
    let mut step = Step::new(number, number as f64 / 24.0).q(0, &q);
    if number % 3 == 1 {
        step.set_transform(1, &turned(number as f32 * 0.1, [0.5, number as f32 * 0.25, -1.0]));
    }
    step
}

/// Uploads two domains of different shapes. The first one has two modes, and the second one has three.
pub(crate) async fn upload_pair(client: &Client, name: &str, mode_scale: f32) -> SceneInfo {
    let grid = |size: u32, rank: u32| {
        let positions: Vec<[f32; 3]> = (0..size * size)
            .map(|index| [(index % size) as f32, (index / size) as f32, (index % 3) as f32 * 0.25])
            .collect();
        let cells = (0..size - 1).flat_map(|row| (0..size - 1).map(move |column| row * size + column));
        let triangles = cells.flat_map(|corner| {
            let (right, above) = (corner + 1, corner + size);
            [[corner, right, above], [right, above + 1, above]]
        });
        let modes = (0..3 * size * size * rank).map(|index| mode_scale * (index % 11) as f32 / 32.0).collect();
        UploadShape::Arrays { positions, triangles: triangles.collect(), rank, modes }
    };
    let first = UploadDomain::new("first", grid(4, 2)).color([0.8, 0.2, 0.1]);
    let second = UploadDomain::new("second", grid(3, 3)).placement(turned(0.5, [4.0, 0.0, 0.0]));
    let upload = ArrayUpload::new(name).unit(0.5).domain(first).domain(second);
    client.upload_arrays(upload).await.expect("an uploaded scene")
}

/// Records `count` steps of [`step`] of a scene. Returns the frames of all steps too, if there is a picture.
pub(crate) async fn record_steps(
    client: &Client,
    scene: &str,
    path: &Path,
    count: u64,
    picture: Option<Picture>,
) -> (Recorded, Vec<Frame>) {
    let request = RecordRequest { max_states: count, ..RecordRequest::new(scene) };
    let (ready, is_ready) = oneshot::channel();
    let on_ready = move || ready.send(()).expect("a waiting test");
    let recorder = record(client, &request, path, on_ready, std::future::pending());
    let drive = async {
        is_ready.await.expect("a subscription");
        let frames = match picture {
            Some(picture) => {
                let request = FrameStreamRequest::new(scene, picture).max_steps(count);
                Some(client.stream_frames(&request).await.expect("a subscription"))
            }
            None => None,
        };
        let description = client.describe(scene, &[]).await.expect("a description");
        let rank = description.domains[0].rank;
        let send = async {
            let request = DriveRequest::new(scene, Delivery::Lossless);
            let mut stream = client.drive(&request).await.expect("a step stream");
            for number in 0..count {
                stream.step(&step(number, rank)).await.expect("an accepted step");
            }
            stream.finish().await.expect("acknowledged steps");
        };
        tokio::join!(collect(frames), send).0
    };
    let (recorded, frames) = tokio::join!(recorder, drive);
    (recorded.expect("a recording"), frames)
}

async fn collect(frames: Option<FrameStream>) -> Vec<Frame> {
    let mut list = Vec::new();
    if let Some(mut frames) = frames {
        while let Some(frame) = frames.next().await {
            list.push(frame.expect("a frame"));
        }
    }
    list
}

/// A transform far from the scene's origin.
pub(crate) fn far_transform(number: u64) -> DomainTransform {
    let half_angle = number as f32 * 0.05;
    DomainTransform::QuaternionXyzwF64 {
        rotation: [0.0, half_angle.sin(), 0.0, half_angle.cos()],
        translation: [2e7 + number as f64 * 0.1, -1e7, 0.25],
    }
}

/// A file in a new folder.
pub(crate) fn new_file(name: &str) -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().expect("a folder");
    let path = folder.path().join(name);
    (folder, path)
}
