//! States over the wire: q and transforms of each step. A client deforms by itself, applies changes to its state, and
//! sends a recorded state as a step again.

use std::sync::Arc;

use modalcast_client::{
    Attribute, Client, Delivery, Error as ClientError, Reason, SceneDescription, SceneState, ShapeArray, StateLayout,
    StateRequest, StateStream, StateStreamRequest, VertexSelection, VertexStreamRequest,
};
use modalcast_proto::v1;
use prost::Message as _;
use v1::state_service_client::StateServiceClient;

use crate::service_harness::{MAX_MESSAGE_BYTES, Server, rigid_step, step, with_timeout};

/// Maximum distance of a vertex from the server's vertex per axis, in scene units. Coordinates are below 8, where
/// numbers in f32 are 5e-7 apart, and the transform of a follower is rounded three times.
const TOLERANCE: f64 = 4e-6;

/// A rotation by 90 degrees about z.
const QUARTER_TURN: [f32; 4] = [0.0, 0.0, std::f32::consts::FRAC_1_SQRT_2, std::f32::consts::FRAC_1_SQRT_2];

async fn connect(server: &Server) -> Client {
    Client::connect(&server.address).await.expect("expected a connection")
}

async fn subscribe(client: &Client, request: StateStreamRequest) -> StateStream {
    let description = client.describe(&request.scene, &[]).await.expect("expected a description");
    let layout = StateLayout::new(&description).expect("expected a valid description");
    with_timeout(client.stream_states(&request, &layout)).await.expect("expected a subscription")
}

async fn next_state(states: &mut StateStream) -> Arc<SceneState> {
    with_timeout(states.next()).await.expect("expected another state").expect("expected a valid state")
}

/// The data with which a client deforms a scene by itself: x0 and U of every domain.
struct Deformer {
    description: SceneDescription,
    /// U of each domain, row-major.
    modes: Vec<Vec<f32>>,
}

impl Deformer {
    async fn fetch(client: &Client, scene: &str) -> Self {
        let arrays = [ShapeArray::RestPositions];
        let description = client.describe(scene, &arrays).await.expect("expected a description");
        let mut modes = Vec::new();
        for domain in &description.domains {
            modes.push(client.read_modes(scene, domain.index, &[]).await.expect("expected U").rows);
        }
        Self { description, modes }
    }

    /// x = T (x0 + U q) of all vertices of a domain: three numbers each, in f64.
    fn positions(&self, state: &SceneState, domain: usize) -> Vec<f64> {
        let (q, matrix) = (state.q(domain).expect("expected q"), state.transform(domain).expect("expected T"));
        let rest_positions = &self.description.shape_of(&self.description.domains[domain]).rest_positions;
        let displacement = |row: usize| -> f64 {
            let entries = &self.modes[domain][row * q.len()..][..q.len()];
            entries.iter().zip(q).map(|(entry, q)| f64::from(*entry) * f64::from(*q)).sum()
        };
        let local: Vec<f64> =
            (0..rest_positions.len()).map(|row| f64::from(rest_positions[row]) + displacement(row)).collect();
        let transform = |point: &[f64]| -> [f64; 3] {
            std::array::from_fn(|axis| {
                let row = &matrix[4 * axis..][..4];
                (0..3).map(|column| f64::from(row[column]) * point[column]).sum::<f64>() + f64::from(row[3])
            })
        };
        local.chunks_exact(3).flat_map(transform).collect()
    }
}

fn max_distance(positions: &[f64], expected_positions: &[f32]) -> f64 {
    assert_eq!(positions.len(), expected_positions.len());
    positions.iter().zip(expected_positions).map(|(a, b)| (a - f64::from(*b)).abs()).fold(0.0, f64::max)
}

/// The positions that a client computes from states equal those of the server, also of domains that follow others.
/// The f64 translations of the scene `far` move the origins.
#[tokio::test(flavor = "multi_thread")]
async fn client_deforms_by_itself() {
    let server = Server::start_default().await;
    let translated = |number, translation| {
        rigid_step(number, v1::TransformFormat::QuaternionXyzwF64, &[(1, QUARTER_TURN, translation)])
    };
    let rotated = rigid_step(2, v1::TransformFormat::QuaternionXyzwF32, &[(1, QUARTER_TURN, [1.0, 0.25, -0.5])]);
    let first_step = step(1, &[0, 1], &[0.25, -0.5, 0.75, 0.125]);
    // In units of half a meter, the unit of `far`: first 4 units from the scene's origin, then 1e7 units (5,000 km)
    // farther away.
    let far_steps = vec![
        first_step.clone(),
        translated(2, [2e7 + 4.0, -2e7, 2e7]),
        translated(3, [3e7, -2e7 + 1.0, 2e7]),
        step(4, &[0], &[0.5, 0.5]),
    ];
    for (scene, steps) in [("twig", vec![first_step, rotated, step(3, &[3], &[0.5, -0.25])]), ("far", far_steps)] {
        server.open(scene).await;
        let client = connect(&server).await;
        let deformer = Deformer::fetch(&client, scene).await;
        let mut states = subscribe(&client, StateStreamRequest::new(scene, ())).await;
        assert_eq!(states.settings.delivery(), v1::Delivery::Lossless);
        let selection = VertexSelection::default().attribute(Attribute::Positions);
        let mut sets =
            client.stream_vertices(&VertexStreamRequest::new(scene, selection)).await.expect("expected a subscription");
        let mut writer = server.drive_lossless(scene).await;
        let mut last_state: Option<Arc<SceneState>> = None;
        for step in steps {
            writer.send_step_and_wait(step).await;
            let state = next_state(&mut states).await;
            let set = with_timeout(sets.next()).await.expect("expected another set").expect("expected a valid set");
            assert_eq!((&state.step, state.skipped), (&set.step, 0));
            let mut changed_domains = 0;
            for domain in 0..set.domains.len() {
                let expected_positions = &set.positions[set.float_range(domain).expect("expected a range")];
                let distance = max_distance(&deformer.positions(&state, domain), expected_positions);
                assert!(distance < TOLERANCE, "{scene} step {} domain {domain}: {distance}", state.step.number);
                assert_eq!(state.origin(domain), Some(set.domain_origin(domain)), "{scene} domain {domain}");
                changed_domains += last_state
                    .iter()
                    .filter(|last_state| {
                        max_distance(&deformer.positions(last_state, domain), expected_positions) > 1000.0 * TOLERANCE
                    })
                    .count();
            }
            assert!(last_state.is_none() || changed_domains > 0, "control: expected other vertices than before");
            last_state = Some(state);
        }
    }
}

/// A stream that skips steps ends in the same state as a stream of every step. The last step changes only domain 0, so
/// the last state must also contain the changes of skipped steps.
#[tokio::test(flavor = "multi_thread")]
async fn skipped_steps_are_part_of_the_next_state() {
    let server = Server::start_default().await;
    server.open("twig").await;
    let client = connect(&server).await;
    let mut lossless_states = subscribe(&client, StateStreamRequest::new("twig", ())).await;
    let latest_request = StateStreamRequest::new("twig", ()).delivery(Delivery::Latest).max_hz(2.0);
    let mut latest_states = subscribe(&client, latest_request).await;
    assert_eq!(latest_states.settings.max_hz, 2.0);
    let mut writer = server.drive_lossless("twig").await;
    writer.send_step_and_wait(step(1, &[0, 1, 2], &[0.5; 6])).await;
    let first_state = next_state(&mut latest_states).await;
    assert_eq!((first_state.step.number, first_state.skipped), (1, 0));
    let last_step = 30;
    for number in 2..=last_step {
        let domain = if number == last_step { 0 } else { number as u32 % 3 };
        let value = 0.01 * number as f32;
        writer.send_step_and_wait(step(number, &[domain], &[value, -value])).await;
    }
    let mut last_lossless_state = next_state(&mut lossless_states).await;
    while last_lossless_state.step.number < last_step {
        last_lossless_state = next_state(&mut lossless_states).await;
        assert_eq!(last_lossless_state.skipped, 0);
    }
    let (mut skipped, mut received, mut last_latest_state) = (0, 1, Arc::clone(&first_state));
    while last_latest_state.step.number < last_step {
        last_latest_state = next_state(&mut latest_states).await;
        received += 1;
        skipped += last_latest_state.skipped;
    }
    assert_eq!(received + skipped, last_step);
    assert!(skipped > 0, "expected skipped steps with a limit of 2 per second");
    for domain in 0..4 {
        assert_eq!(last_latest_state.q(domain), last_lossless_state.q(domain), "domain {domain}");
        assert_eq!(last_latest_state.transform(domain), last_lossless_state.transform(domain), "domain {domain}");
    }
    for domain in 0..3 {
        assert_ne!(last_latest_state.q(domain), first_state.q(domain), "control: expected domain {domain} to change");
    }
}

/// 70,000 domains: the first state has all of them, a later one only those that have changed.
#[tokio::test(flavor = "multi_thread")]
async fn later_states_contain_only_changed_domains() {
    let server = Server::start_default().await;
    server.open("crowd").await;
    let client = connect(&server).await;
    let mut states = subscribe(&client, StateStreamRequest::new("crowd", ()).max_steps(4)).await;
    let mut writer = server.drive_lossless("crowd").await;
    let mut matrix = modalcast_model::domain::Transform::IDENTITY.0;
    matrix[7] = 2.5;
    let transforms = matrix.iter().flat_map(|entry| entry.to_le_bytes()).collect::<Vec<u8>>().into();
    for step in [
        step(1, &[7], &[0.5, 0.25]),
        step(2, &[69_999, 7], &[-1.0, 3.0, 0.5, 0.25]),
        v1::Step { transform_domains: vec![3], transforms, ..step(3, &[], &[]) },
        step(4, &[7], &[0.5, 0.25]),
    ] {
        writer.send_step_and_wait(step).await;
    }
    // Per domain two coordinates and a matrix; then the origin.
    let mut state = next_state(&mut states).await;
    assert_eq!(state.encoded_bytes, 70_000 * (8 + 48) + 24);
    // Step 2 sets domain 7 to the values that it has. Step 4 changes nothing.
    for (number, encoded_bytes) in [(2, 4 + 8), (3, 4 + 48), (4, 0)] {
        state = next_state(&mut states).await;
        assert_eq!((state.step.number, state.encoded_bytes), (number, encoded_bytes));
    }
    assert_eq!(
        [7, 8, 69_999].map(|domain| state.q(domain)),
        [[0.5, 0.25], [0.0, 0.0], [-1.0, 3.0]].each_ref().map(|q| Some(&q[..]))
    );
    assert_eq!(state.transform(3), Some(matrix));
    assert!(with_timeout(states.next()).await.is_none(), "expected the end after four states");
}

/// The complete state of a scene: its head and its bytes.
async fn get_state(server: &Server, scene: &str) -> (v1::StateHead, Vec<u8>) {
    let request = v1::GetStateRequest { scene: scene.into(), ..v1::GetStateRequest::default() };
    let mut client = StateServiceClient::new(server.channel().await);
    let mut replies = with_timeout(client.get_state(request)).await.expect("expected a reply").into_inner();
    let (mut received_head, mut bytes) = (None, Vec::new());
    while let Some(reply) = with_timeout(replies.message()).await.expect("expected another message") {
        assert!(reply.encoded_len() <= MAX_MESSAGE_BYTES, "{} bytes", reply.encoded_len());
        let chunk = reply.chunk.expect("expected a chunk");
        assert_eq!((chunk.offset, chunk.head.is_some()), (bytes.len() as u64, bytes.is_empty()));
        received_head = received_head.or(chunk.head);
        bytes.extend_from_slice(&chunk.data);
    }
    let head = received_head.expect("expected a head");
    assert_eq!((head.total, head.complete), (bytes.len() as u64, true));
    (head, bytes)
}

/// The sections of a recorded state are the fields of a step.
#[tokio::test(flavor = "multi_thread")]
async fn recorded_state_can_be_sent_as_a_step() {
    let server = Server::start_default().await;
    server.open("twig").await;
    let request = v1::OpenSceneRequest { source: "twig".into(), scene: "replay".into() };
    server.scenes().await.open_scene(request).await.expect("expected the scene to open");
    let mut writer = server.drive_lossless("twig").await;
    writer.send_step_and_wait(step(1, &[0, 1, 2, 3], &[0.5, -0.25, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0])).await;
    let format = v1::TransformFormat::QuaternionXyzwF32;
    writer.send_step_and_wait(rigid_step(2, format, &[(1, QUARTER_TURN, [1.0, 2.0, 3.0])])).await;
    let (head, bytes) = get_state(&server, "twig").await;
    // Lists that are left out mean all domains, in a state as in a step.
    let section = |content: v1::StateContent| {
        let section = head.sections.iter().find(|section| section.content() == content);
        section.map(|section| bytes[section.offset as usize..][..section.bytes as usize].to_vec()).unwrap_or_default()
    };
    let (rest_head, rest_bytes) = get_state(&server, "replay").await;
    assert_eq!((rest_head.step.map(|step| step.run), rest_head.sections), (Some(0), head.sections.clone()));
    assert_ne!(rest_bytes, bytes, "control: expected another state before the step");
    let recorded_step = v1::Step {
        number: 5,
        q_domains: bytemuck::pod_collect_to_vec(&section(v1::StateContent::QDomains)),
        q: section(v1::StateContent::Q).into(),
        transform_domains: bytemuck::pod_collect_to_vec(&section(v1::StateContent::TransformDomains)),
        transforms: section(v1::StateContent::Transforms).into(),
        ..v1::Step::default()
    };
    server.drive_lossless("replay").await.send_step_and_wait(recorded_step).await;
    let (replayed_head, replayed_bytes) = get_state(&server, "replay").await;
    assert_eq!((replayed_head.step.map(|step| step.number), replayed_bytes), (Some(5), bytes));
}

#[tokio::test(flavor = "multi_thread")]
async fn single_state_is_that_of_the_selected_step() {
    let server = Server::start_default().await;
    server.open("crowd").await;
    let client = connect(&server).await;
    let description = client.describe("crowd", &[]).await.expect("expected a description");
    let layout = StateLayout::new(&description).expect("expected a valid description");
    // 70,000 domains take several chunks.
    let (head, _) = get_state(&server, "crowd").await;
    assert!(head.total > 3 << 20);
    let request = StateRequest::new("crowd", ()).minimum_step(1);
    let (state, ()) = tokio::join!(with_timeout(client.get_state(&request, &layout)), async {
        server.drive_lossless("crowd").await.send_step_and_wait(step(1, &[69_999], &[0.5, 0.25])).await;
    });
    let state = state.expect("expected a state");
    assert_eq!((state.step.number, state.q(69_999), state.q(0)), (1, Some(&[0.5, 0.25][..]), Some(&[0.0, 0.0][..])));
    let error = client.get_state(&StateRequest::new("crowd", ()).exact_step(0), &layout).await;
    let error = error.expect_err("expected a passed step");
    assert_eq!(error.rejection().map(|rejection| rejection.reason), Some(Reason::StepPassed));
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_rates_are_rejected() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let client = connect(&server).await;
    let description = client.describe("strips", &[]).await.expect("expected a description");
    let layout = StateLayout::new(&description).expect("expected a valid description");
    for (delivery, max_hz, is_valid) in [
        (Delivery::Latest, 1000.0, true),
        (Delivery::Latest, 0.001, true),
        (Delivery::Lossless, 0.0, true),
        (Delivery::Lossless, 30.0, false),
        (Delivery::Latest, -1.0, false),
        (Delivery::Latest, f64::INFINITY, false),
        (Delivery::Latest, f64::NAN, false),
    ] {
        let request = StateStreamRequest::new("strips", ()).delivery(delivery).max_hz(max_hz);
        match with_timeout(client.stream_states(&request, &layout)).await {
            Ok(_) => assert!(is_valid, "{delivery:?} {max_hz}"),
            Err(ClientError::Status { rejection: Some(rejection), .. }) => {
                assert!(!is_valid, "{delivery:?} {max_hz}");
                assert_eq!((rejection.reason, rejection.field.as_str()), (Reason::InvalidField, "max_hz"));
            }
            Err(error) => panic!("expected details, got {error}"),
        }
    }
}
