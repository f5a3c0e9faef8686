//! Planned faults of CUDA (feature `fault-injection`): a failed launch costs one step, and the scene has its last state
//! again; a lost device and a launch that does not return end the device. Each fault needs a process of its own, because
//! the plan is read once.

use std::process::Command;
use std::sync::Arc;
use std::time::Duration;

use modalcast::admission::Account;
use modalcast::config::{BackendChoice, Config};
use modalcast::engine::{
    Delivery, Engine, FrameOutput, LeaseRequest, OutputBody, OutputSpec, Overflow, PictureSpec, Pixels, SceneHandle,
    StepReport, StepSelector, WriterSession,
};
use modalcast::identity::Principal;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::Error;
use modalcast_model::load::SceneRepository;
use modalcast_model::scene::{CameraSource, FrameSize, FrameStyle, RawStepUpdate};

/// Set in the process that has the fault. The value is what the process expects.
const EXPECTATION: &str = "MODALCAST_TEST_EXPECTATION";

/// Number of the launch that has the fault. Loading the scene launches fewer kernels and graphs.
const LAUNCH: u64 = 2000;

/// The limit on the time of a launch.
const WORK_LIMIT: Duration = Duration::from_secs(5);

#[test]
#[ignore = "needs an NVIDIA GPU"]
fn gpu_planned_faults_of_cuda_fail_a_step_or_end_the_device() {
    if let Ok(expectation) = std::env::var(EXPECTATION) {
        return tokio::runtime::Runtime::new().expect("expected a runtime").block_on(check(&expectation));
    }
    for (fault, expectation) in
        [("error", "recovery"), ("out-of-memory", "recovery"), ("lost", "loss"), ("endless", "loss"), ("", "nothing")]
    {
        let plan = if fault.is_empty() { String::new() } else { format!("launch:{fault}:{LAUNCH}") };
        assert!(has_passed(&plan, expectation), "{plan}");
    }
    // Negative controls: without a fault nothing is recovered from, and an error is no loss.
    assert!(!has_passed("", "recovery"));
    assert!(!has_passed(&format!("launch:error:{LAUNCH}"), "loss"));
}

/// Runs this test in another process.
fn has_passed(plan: &str, expectation: &str) -> bool {
    let name = "faults::gpu_planned_faults_of_cuda_fail_a_step_or_end_the_device";
    let output = Command::new(std::env::current_exe().expect("expected the path of the test"))
        .args(["--exact", name, "--include-ignored", "--nocapture"])
        .env(EXPECTATION, expectation)
        .env("MODALCAST_INJECT", plan)
        .output()
        .expect("expected a process");
    eprintln!(
        "{plan}: {}: {}{}",
        output.status,
        String::from_utf8_lossy(&output.stdout),
        String::from_utf8_lossy(&output.stderr)
    );
    // Not the exit code: a process with a thread that never returns can crash in the exit handlers of the driver.
    String::from_utf8_lossy(&output.stdout).contains("test result: ok. 1 passed")
}

/// Sends steps until one fails, and checks what follows.
async fn check(expectation: &str) {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let config = Config {
        state: folder.path().to_owned(),
        backend: BackendChoice::Cuda,
        device_work_limit: WORK_LIMIT,
        ..Config::default()
    };
    let source = Arc::new(SceneRepository::new(None).expect("expected the built-in scenes"));
    let engine = Engine::start(config.validated().expect("expected valid settings"), source).await;
    let engine = engine.expect("expected a CUDA device");
    let scene = engine.open("tree", "tree", &Principal::owner(), None).await.expect("expected the tree");
    let mut writer = acquire_writer(&scene).await;
    let rest = output(&scene).await;
    assert_eq!(send(&mut writer, &scene, 1, 0.5).await, None);
    let expected = output(&scene).await;
    assert!(expected != rest, "expected a step that moves the tree");
    let mut observer = engine.observe_device();
    let mut number = 1;
    let error = loop {
        number += 1;
        match send(&mut writer, &scene, number, 0.5).await {
            None if number < 2 * LAUNCH => {}
            error => break error,
        }
    };
    match (expectation, error) {
        ("nothing", None) => {}
        ("recovery", Some(Error::Fault { .. })) => {
            // Not serving, then serving again. The second change may have replaced the first one.
            observer.changed().await;
            assert!(output(&scene).await == expected, "expected the state before the fault");
            assert!(observer.is_working(), "expected a recovered device");
            assert_eq!(send(&mut writer, &scene, number + 1, 0.0).await, None);
            assert!(output(&scene).await == rest, "expected further steps");
        }
        ("loss", Some(Error::DeviceLost { .. })) => {
            let error = engine.device_lost().await;
            assert!(matches!(error, Error::DeviceLost { .. }), "{error}");
        }
        (expectation, error) => panic!("expected {expectation}, got {error:?} after {number} steps"),
    }
    engine.shutdown().await;
}

async fn acquire_writer(scene: &SceneHandle) -> WriterSession {
    let request = LeaseRequest {
        account: Account::server(),
        delivery: Delivery::Lossless,
        overflow: Overflow::Block,
        window: 1,
        stall_budget: Config::default().stall_budget,
        token: None,
        takes_over: false,
        initial_state: None,
    };
    scene.drive("test", request).await.expect("expected the lease")
}

/// Sends a step in which the first coordinate of the first deformable domain has this value. Returns the error of a
/// rejection.
async fn send(writer: &mut WriterSession, scene: &SceneHandle, number: u64, value: f32) -> Option<Error> {
    let domain =
        (0..scene.scene.domains.len()).find(|domain| scene.scene.rank_of(*domain) > 0).expect("expected modes");
    let mut q = vec![0.0_f32; scene.scene.rank_of(domain)];
    q[0] = value;
    let q = bytes::Bytes::copy_from_slice(bytemuck::cast_slice(&q));
    let q_domains = vec![u32::try_from(domain).expect("expected a small index")];
    let step = RawStepUpdate { number, time: number as f64, q_domains, q, ..RawStepUpdate::default() };
    writer.push_step(step).await.expect("expected capacity");
    match writer.next_report().await {
        Ok(StepReport::Done { .. }) => None,
        Ok(StepReport::Rejected { error, .. }) | Err(error) => Some(error),
    }
}

/// The positions of all vertices, and the pixels of a frame.
async fn output(scene: &SceneHandle) -> (Vec<f32>, Vec<u8>) {
    let spec = OutputSpec::Vertices(VertexAttributes::POSITIONS_AND_NORMALS);
    let vertices = scene.request_output(StepSelector::Current, spec).await.expect("expected vertices");
    let OutputBody::Vertices(vertices) = vertices.body else { panic!("expected vertices") };
    let vertices = vertices.wait().await.expect("expected vertices");
    let size = FrameSize::new(320, 240);
    let camera = CameraSource::framing(&scene.scene, size);
    let picture = PictureSpec { camera, size, output: FrameOutput::Color, style: FrameStyle::default() };
    let frames = scene.request_output(StepSelector::Current, OutputSpec::Frames(Arc::new([picture]))).await;
    let OutputBody::Frames(frames) = frames.expect("expected a frame").body else { panic!("expected frames") };
    let picture = frames.pictures[0].wait().await.expect("expected a picture");
    let Pixels::Color(pixels) = &picture.pixels else { panic!("expected pixels") };
    (vertices.surface.positions.clone(), pixels.to_vec())
}
