//! A fake server for tests of the clients. It implements the wire contract in memory with x = T (x0 + U q) in f64.

mod serve;

use std::collections::HashMap;
use std::sync::Mutex;

use modalcast_proto::v1;
use tokio::sync::{Semaphore, broadcast};
use tonic::Status;
use tonic_types::{ErrorDetails, StatusExt as _};

pub(crate) use serve::serve;

/// One domain and its shape, which no other domain has: their descriptions, rest positions (3 per vertex) and U (3n x
/// r, row-major).
#[derive(Debug, Clone, Default)]
pub(crate) struct FakeDomain {
    pub(crate) wire: v1::DomainDescription,
    pub(crate) shape: v1::ShapeDescription,
    pub(crate) rest_positions: Vec<f32>,
    pub(crate) modes: Vec<f32>,
    pub(crate) indices: Vec<u32>,
}

/// Row-major 3x4 identity.
pub(crate) const IDENTITY: [f32; 12] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

impl FakeDomain {
    /// A domain at the origin. Each vertex has one corner, that is, one normal.
    pub(crate) fn new(index: u32, rest_positions: Vec<f32>, rank: u32, modes: Vec<f32>) -> Self {
        let vertices = (rest_positions.len() / 3) as u32;
        assert_eq!(modes.len(), rest_positions.len() * rank as usize, "expected 3n rows of U");
        // A triangle strip: triangle i has the corners i, i + 1 and i + 2.
        let indices: Vec<u32> =
            (0..vertices.saturating_sub(2)).flat_map(|first_vertex| first_vertex..first_vertex + 3).collect();
        let shape = v1::ShapeDescription {
            shape: index,
            vertices,
            rank,
            corners: vertices,
            triangles: (indices.len() / 3) as u32,
            ..Default::default()
        };
        let wire = v1::DomainDescription {
            domain: index,
            name: format!("domain {index}"),
            shape: index,
            placement: pack(&IDENTITY).into(),
            ..Default::default()
        };
        Self { wire, shape, rest_positions, modes, indices }
    }

    /// World positions T (x0 + U q); `transform` is T, row-major 3x4.
    fn positions(&self, q: &[f32], transform: &[f32]) -> Vec<f32> {
        let mut local_positions: Vec<f64> = self.rest_positions.iter().map(|number| f64::from(*number)).collect();
        for (row, entry) in local_positions.iter_mut().enumerate() {
            let modes = &self.modes[row * q.len()..][..q.len()];
            *entry += modes.iter().zip(q).map(|(mode, q)| f64::from(*mode) * f64::from(*q)).sum::<f64>();
        }
        let transform_entry = |row: usize, column: usize| f64::from(transform[4 * row + column]);
        let world_coordinate = |x: &[f64], row| {
            (0..3).map(|column| transform_entry(row, column) * x[column]).sum::<f64>() + transform_entry(row, 3)
        };
        local_positions.chunks(3).flat_map(|x| (0..3).map(move |row| world_coordinate(x, row) as f32)).collect()
    }
}

/// The state after a step, as sent to subscribers.
#[derive(Debug, Clone)]
pub(crate) struct StepOutput {
    pub(crate) step: v1::StepId,
    pub(crate) positions: Vec<f32>,
}

/// The only scene of the fake server, `toy`, and the requests that it received.
pub(crate) struct FakeServer {
    pub(crate) domains: Vec<FakeDomain>,
    /// Rest bounds: minimum x, y, z, then maximum x, y, z.
    pub(crate) bounds: [f64; 6],
    /// The version that the server reports.
    pub(crate) protocol_version: u32,
    /// The largest window of a step stream.
    pub(crate) window: u32,
    /// Number of acknowledgments that may still be sent; unlimited unless a test restricts it.
    pub(crate) ack_permits: Semaphore,
    /// The accepted steps.
    pub(crate) steps: Mutex<Vec<v1::Step>>,
    /// The forces on the scene, which a test sets.
    pub(crate) forces: Vec<v1::AppliedForce>,
    /// Paths and bytes of the files of the last upload. Reused files have no bytes.
    pub(crate) uploaded_files: Mutex<Vec<(String, Vec<u8>)>>,
    /// Hashes of the contents that the server claims to have. `None`: the server does not know the call
    /// `find_uploaded_files`.
    pub(crate) known_hashes: Option<Vec<Vec<u8>>>,
    /// Whether the server no longer has these contents when the upload arrives.
    pub(crate) loses_contents: bool,
    /// The state after each step, for the subscribers.
    pub(crate) outputs: broadcast::Sender<StepOutput>,
    state: Mutex<State>,
}

struct State {
    /// Number of writers so far.
    run: u64,
    has_writer: bool,
    /// Per domain: r coordinates.
    q: Vec<Vec<f32>>,
    /// Per domain: T, row-major 3x4.
    transforms: Vec<Vec<f32>>,
    last_step: Option<v1::StepId>,
}

impl FakeServer {
    pub(crate) fn new(domains: Vec<FakeDomain>) -> Self {
        let q = domains.iter().map(|domain| vec![0.0; domain.shape.rank as usize]).collect();
        let transforms = domains.iter().map(|domain| decode_f32(&domain.wire.placement)).collect();
        let positions: Vec<f32> = domains
            .iter()
            .flat_map(|domain| {
                domain.positions(&vec![0.0; domain.shape.rank as usize], &decode_f32(&domain.wire.placement))
            })
            .collect();
        let mut bounds = [f64::MAX, f64::MAX, f64::MAX, f64::MIN, f64::MIN, f64::MIN];
        for (index, number) in positions.iter().enumerate() {
            bounds[index % 3] = bounds[index % 3].min(f64::from(*number));
            bounds[index % 3 + 3] = bounds[index % 3 + 3].max(f64::from(*number));
        }
        Self {
            domains,
            bounds,
            protocol_version: v1::PROTOCOL_VERSION,
            window: 8,
            ack_permits: Semaphore::new(Semaphore::MAX_PERMITS),
            steps: Mutex::default(),
            forces: Vec::new(),
            uploaded_files: Mutex::default(),
            known_hashes: None,
            loses_contents: false,
            // More steps than any test sends, so that no subscriber misses one.
            outputs: broadcast::channel(1 << 14).0,
            state: Mutex::new(State { run: 0, has_writer: false, q, transforms, last_step: None }),
        }
    }

    pub(crate) fn info(&self) -> v1::SceneInfo {
        let sum =
            |count: fn(&FakeDomain) -> u32| self.domains.iter().map(|domain| u64::from(count(domain))).sum::<u64>();
        v1::SceneInfo {
            scene: "toy".into(),
            source: "toy".into(),
            domains: self.domains.len() as u32,
            vertices: sum(|domain| domain.shape.vertices),
            corners: sum(|domain| domain.shape.corners),
            triangles: sum(|domain| domain.shape.triangles),
            coordinates: sum(|domain| if domain.wire.shares_q_with.is_some() { 0 } else { domain.shape.rank }),
            up: "y".into(),
            unit: 1.0,
            origin: vec![0.0; 3],
            bounds: self.bounds.to_vec(),
            last_step: self.state.lock().unwrap().last_step,
            ..Default::default()
        }
    }

    /// Acquires the writer lease. Returns the number of this writer, counted from 1. Fails if another writer has the
    /// lease.
    fn acquire_writer_lease(&self) -> Result<u64, v1::Rejection> {
        let mut state = self.state.lock().unwrap();
        if std::mem::replace(&mut state.has_writer, true) {
            return Err(rejection(None, "scene", "a scene without a writer", "the writer of another run"));
        }
        state.run += 1;
        Ok(state.run)
    }

    fn release_writer_lease(&self) {
        self.state.lock().unwrap().has_writer = false;
    }

    /// Applies a step atomically, or returns the rejection.
    fn apply(&self, step: &v1::Step) -> Result<(), v1::Rejection> {
        let reject = |field, expected: String, given: String| Err(rejection(Some(step.number), field, expected, given));
        let q_bytes = 4 * step.q_domains.iter().map(|index| self.rank(*index)).sum::<usize>();
        if step.q.len() != q_bytes {
            return reject("step.q", format!("{q_bytes} bytes"), format!("{} bytes", step.q.len()));
        }
        // 12 f32 per transform. The fake server supports no other format.
        let transform_bytes = 48 * step.transform_domains.len();
        if step.transforms.len() != transform_bytes {
            return reject(
                "step.transforms",
                format!("{transform_bytes} bytes"),
                format!("{} bytes", step.transforms.len()),
            );
        }
        let is_follower = |index: &&u32| self.domains[**index as usize].wire.follows.is_some();
        if let Some(follower) = step.transform_domains.iter().find(is_follower) {
            return reject("step.transform_domains", "domains that follow no other".into(), follower.to_string());
        }
        let (q, transforms) = (decode_f32(&step.q), decode_f32(&step.transforms));
        if !q.iter().chain(&transforms).all(|number| number.is_finite()) {
            return reject("step", "finite numbers".into(), "NaN or infinity".into());
        }
        let mut state = self.state.lock().unwrap();
        let mut start = 0;
        for index in &step.q_domains {
            let rank = self.rank(*index);
            state.q[*index as usize] = q[start..][..rank].to_vec();
            start += rank;
        }
        for (index, transform) in step.transform_domains.iter().zip(transforms.chunks(12)) {
            state.transforms[*index as usize] = transform.to_vec();
        }
        let id = v1::StepId { run: state.run, number: step.number, time: step.time };
        state.last_step = Some(id);
        drop(state);
        self.steps.lock().unwrap().push(step.clone());
        self.outputs.send(self.output()).ok();
        Ok(())
    }

    /// Returns to the rest state, unless a writer has the lease.
    fn reset(&self) -> Result<v1::StepId, v1::Rejection> {
        self.acquire_writer_lease()?;
        let mut state = self.state.lock().unwrap();
        state.q.iter_mut().for_each(|q| q.fill(0.0));
        state.transforms = self.domains.iter().map(|domain| decode_f32(&domain.wire.placement)).collect();
        let id = v1::StepId { run: state.run, number: 0, time: 0.0 };
        state.last_step = Some(id);
        drop(state);
        self.release_writer_lease();
        Ok(id)
    }

    fn rank(&self, domain: u32) -> usize {
        self.domains[domain as usize].shape.rank as usize
    }

    /// The state after the last step.
    pub(crate) fn output(&self) -> StepOutput {
        let state = self.state.lock().unwrap();
        let q = |index: usize| {
            let owner = self.domains[index].wire.shares_q_with.map_or(index, |owner| owner as usize);
            &state.q[owner]
        };
        let mut transforms = state.transforms.clone();
        for (index, domain) in self.domains.iter().enumerate() {
            if let Some(leader) = domain.wire.follows {
                transforms[index] = compose(&transforms[leader as usize], &decode_f32(&domain.wire.follow_frame));
            }
        }
        let domains = self.domains.iter().enumerate();
        let positions = domains.flat_map(|(index, domain)| domain.positions(q(index), &transforms[index]));
        StepOutput { step: state.last_step.unwrap_or_default(), positions: positions.collect() }
    }
}

pub(crate) fn rejection(
    step: Option<u64>,
    field: &str,
    expected: impl ToString,
    given: impl ToString,
) -> v1::Rejection {
    let reason = v1::Reason::InvalidField.into();
    v1::Rejection { step, reason, field: field.into(), expected: expected.to_string(), given: given.to_string() }
}

/// A gRPC status with a rejection in its details.
fn rejection_status(code: tonic::Code, rejection: &v1::Rejection) -> Status {
    let texts = [("expected", &rejection.expected), ("given", &rejection.given)];
    let metadata: HashMap<String, String> = texts.map(|(key, text)| (key.to_owned(), text.clone())).into();
    let mut details = ErrorDetails::with_error_info(rejection.reason().as_str_name(), "modalcast", metadata);
    details.add_bad_request_violation(rejection.field.clone(), "invalid");
    Status::with_error_details(code, format!("{}: {}", rejection.field, rejection.given), details)
}

/// The product of two affine transforms, row-major 3x4.
pub(crate) fn compose(a: &[f32], b: &[f32]) -> Vec<f32> {
    let entry = |index: usize| {
        let (row, column) = (index / 4, index % 4);
        let sum: f32 = (0..3).map(|k| a[4 * row + k] * b[4 * k + column]).sum();
        sum + if column == 3 { a[4 * row + 3] } else { 0.0 }
    };
    (0..12).map(entry).collect()
}

/// Decodes little-endian f32 at any alignment.
pub(crate) fn decode_f32(bytes: &[u8]) -> Vec<f32> {
    bytemuck::pod_collect_to_vec(bytes)
}

/// The bytes of little-endian numbers.
pub(crate) fn pack<T: bytemuck::NoUninit>(numbers: &[T]) -> Vec<u8> {
    bytemuck::cast_slice(numbers).to_vec()
}
