//! Test scenes and a faulty deformer for the unit tests of the engine.

use std::sync::Arc;
use std::time::Duration;

use super::scene::delivery::Delivery;
use super::scene::lease::LeaseRequest;
use super::scene::step_queue::Overflow;
use super::source::{SceneSource, StoredUpload};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::backend_settings::BackendSettings;
use modalcast_model::deform::{Backend, DeformSummary, DeformedSurface, Deformer, VertexAttributes, VertexReadback};
use modalcast_model::domain::{Attachment, Domain, Material, Mesh, Modes, Shape, Transform};
use modalcast_model::error::{Error, Result};
use modalcast_model::load::OpenedScene;
use modalcast_model::memory::MemoryReservation;
use modalcast_model::scene::{DeformationSettings, Scene, SceneParts, SceneState};

/// Two domains, `left` and `right`. Each is a square of two triangles with two modes. `right` is attached to `left`.
pub(super) fn two_strips() -> Arc<Scene> {
    strips(DeformationSettings::default())
}

/// [`two_strips`] with displacements and boxes enabled.
pub(super) fn strips_with_attributes() -> Arc<Scene> {
    strips(DeformationSettings { displacements: true, boxes: true, ..DeformationSettings::default() })
}

fn strips(deformation: DeformationSettings) -> Arc<Scene> {
    let rest_positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
    let (normals, triangles) = (vec![[0.0, 0.0, 1.0]; 4], vec![[0, 1, 2], [0, 2, 3]]);
    let mesh = Mesh::from_indexed(rest_positions, normals, vec![], triangles).expect("expected a valid mesh");
    // U has 12 rows (4 vertices) and 2 columns. Every fifth entry is not zero, so that the columns differ.
    let entries = (0..24).map(|index| if index % 5 == 0 { 0.5 } else { 0.0 }).collect();
    let modes = Modes::from_columns(12, 2, entries).expect("expected valid modes");
    let shape = Shape::new(mesh, modes).expect("expected a valid shape");
    let domain = |name: &str, attachment| Domain { attachment, ..Domain::new(name, 0) };
    let joint = Attachment { parent: 0, frame: Transform::IDENTITY, vertices: vec![1, 2] };
    let domains = vec![domain("left", None), domain("right", Some(joint))];
    let (shapes, materials) = (vec![shape], vec![Material::default()]);
    Scene::new(SceneParts { shapes, materials, domains, deformation, ..SceneParts::named("strips") })
        .expect("expected a valid scene")
}

/// A fault of [`FaultyDeformer`]. A state whose first coordinate is [`Self::q`] triggers the fault.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum InjectedFault {
    PanicInDeform,
    PanicInReadback,
    PanicInWait,
    Fault,
    RendererLost,
    DeviceLost,
    Endless,
    Abort,
    StackOverflow,
    /// SIGKILL, as the kernel sends it when memory is exhausted.
    Kill,
    /// SIGABRT from another process, as a supervisor sends it.
    SentAbort,
    /// An abort because the operating system has no memory.
    FailedAllocation,
}

impl InjectedFault {
    const ALL: [Self; 12] = [
        Self::PanicInDeform,
        Self::PanicInReadback,
        Self::PanicInWait,
        Self::Fault,
        Self::RendererLost,
        Self::DeviceLost,
        Self::Endless,
        Self::Abort,
        Self::StackOverflow,
        Self::Kill,
        Self::SentAbort,
        Self::FailedAllocation,
    ];

    /// The first coordinate of a state that triggers the fault, far above that of any valid test state.
    pub(super) fn q(self) -> f32 {
        1000.0 + self as u8 as f32
    }
}

/// The reference deformer with faults that are triggered by the state. Its readbacks are in flight until they are
/// awaited.
pub(super) struct FaultyDeformer {
    inner: ReferenceDeformer,
    fault: Option<InjectedFault>,
    readbacks: Vec<Arc<DeformedSurface>>,
}

impl FaultyDeformer {
    pub(super) fn boxed(scene: &Arc<Scene>) -> Box<dyn Deformer + Send> {
        Box::new(Self { inner: ReferenceDeformer::new(scene), fault: None, readbacks: Vec::new() })
    }
}

impl Deformer for FaultyDeformer {
    fn backend(&self) -> Backend {
        Backend::Reference
    }

    /// Selects the fault that the state triggers. Faults of `readback` and `wait_readback` occur when these are called.
    fn deform(&mut self, state: &SceneState) -> Result<DeformSummary> {
        self.fault = InjectedFault::ALL.into_iter().find(|fault| state.q[0] == fault.q());
        match self.fault {
            Some(InjectedFault::PanicInDeform) => panic!("injected into deform"),
            Some(InjectedFault::Fault) => Err(fault_error()),
            Some(InjectedFault::RendererLost) => Err(renderer_lost_error()),
            Some(InjectedFault::DeviceLost) => Err(device_lost_error()),
            Some(InjectedFault::Endless) => loop {
                std::thread::park();
            },
            Some(InjectedFault::Abort) => std::process::abort(),
            Some(InjectedFault::StackOverflow) => panic!("{}", overflow_stack(0)),
            Some(InjectedFault::Kill) => send_signal("KILL"),
            Some(InjectedFault::SentAbort) => send_signal("ABRT"),
            Some(InjectedFault::FailedAllocation) => exhaust_memory(),
            _ => self.inner.deform(state),
        }
    }

    fn surface(&mut self) -> Result<&DeformedSurface> {
        self.inner.surface()
    }

    fn readback(&mut self, _attributes: VertexAttributes) -> Result<VertexReadback> {
        assert_ne!(self.fault, Some(InjectedFault::PanicInReadback), "injected into readback");
        let surface = Arc::new(self.inner.surface()?.clone());
        self.readbacks.push(Arc::clone(&surface));
        Ok(VertexReadback::pending(surface))
    }

    fn wait_readback(&mut self, readback: &VertexReadback) -> Result<Arc<DeformedSurface>> {
        assert_ne!(self.fault, Some(InjectedFault::PanicInWait), "injected into wait");
        let index = self
            .readbacks
            .iter()
            .position(|surface| readback.writes_to(surface))
            .expect("expected a readback of this deformer");
        Ok(self.readbacks.swap_remove(index))
    }
}

/// Recurses until the stack ends.
#[expect(unconditional_recursion, reason = "the stack must overflow")]
fn overflow_stack(depth: u64) -> u64 {
    let frame = std::hint::black_box([depth; 64]);
    overflow_stack(frame[0] + 1) + frame[1]
}

/// Another process sends a signal to this one.
fn send_signal(signal: &str) -> ! {
    let process = std::process::id().to_string();
    std::process::Command::new("kill").args(["-s", signal, &process]).status().expect("expected the program `kill`");
    loop {
        std::thread::park();
    }
}

/// Allocates until the operating system refuses, which aborts the process.
fn exhaust_memory() -> ! {
    let no_memory = rustix::process::Rlimit { current: Some(1), maximum: Some(1) };
    rustix::process::setrlimit(rustix::process::Resource::As, no_memory).expect("expected a lower limit");
    let mut blocks = Vec::new();
    loop {
        blocks.push(vec![1_u8; 1 << 20]);
    }
}

/// The error of an injected fault, after which the device works.
pub(super) fn fault_error() -> Error {
    Error::Fault { stage: "deform", reason: "injected".into() }
}

/// The error of an injected loss of the renderer.
pub(super) fn renderer_lost_error() -> Error {
    Error::RendererLost { stage: "deform", reason: "injected".into() }
}

/// The error of an injected device loss.
pub(super) fn device_lost_error() -> Error {
    Error::DeviceLost { stage: "deform", reason: "injected".into() }
}

/// A source with the single scene "strips".
pub(super) struct StripsSource;

impl SceneSource for StripsSource {
    fn open(&self, _source: &str, _: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        Ok(OpenedScene { scene: two_strips(), backends: BackendSettings::default() })
    }

    fn open_upload(&self, upload: &StoredUpload, memory: &Arc<MemoryReservation>) -> Result<OpenedScene> {
        self.open(&upload.entry, memory)
    }

    fn list(&self) -> Vec<String> {
        vec!["strips".into()]
    }
}

/// A request for the lease of a lossless writer.
pub(crate) fn lossless_lease(window: u32) -> LeaseRequest {
    LeaseRequest {
        account: crate::admission::Account::server(),
        delivery: Delivery::Lossless,
        overflow: Overflow::Block,
        window,
        stall_budget: Duration::from_secs(3600),
        token: None,
        takes_over: false,
        initial_state: None,
    }
}
