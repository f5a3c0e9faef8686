//! Forces from viewers: ownership, expiry, limits, and the stream that a physics process reads.

use std::time::{Duration, Instant};

use modalcast::config::{Config, RendererChoice};
use modalcast_client::{
    Camera, Client, Force, ForceKind, ForceRequest, ForceSet, ForceStream, Lens, PickRectangle, PickRequest, Picture,
    Reason, Rejection, Replies, SurfaceForce, View,
};
use modalcast_proto::v1;

use crate::service_harness::{SILENCE_LIMIT, Server, rigid_step, step, strips, with_timeout};

const FIRST_OWNER: [u8; 16] = [1; 16];
const SECOND_OWNER: [u8; 64] = [2; 64];

/// A lifetime that no test reaches, in milliseconds.
const LONG_LIFETIME: u32 = 10_000;

/// A rotation by 90 degrees about z.
const QUARTER_TURN: [f32; 4] = [0.0, 0.0, std::f32::consts::FRAC_1_SQRT_2, std::f32::consts::FRAC_1_SQRT_2];

async fn start_server() -> (Server, Client) {
    let server = Server::start_default().await;
    server.open("strips").await;
    let client = connect(&server).await;
    (server, client)
}

async fn connect(server: &Server) -> Client {
    Client::connect(&server.address).await.expect("expected a connection")
}

/// A force on the two modes of a domain.
fn modal_force(id: u64, domain: u32, f_q: [f32; 2]) -> Force {
    Force::on_modes(id, domain, &f_q)
}

/// A force on the first triangle of a domain.
fn surface_force(id: u64, domain: u32, vector: [f64; 3]) -> Force {
    let surface = SurfaceForce { triangle: 0, barycentric: [0.5, 0.25, 0.25], vector };
    Force { id, domain, kind: ForceKind::Surface(surface) }
}

fn request(owner: &[u8], forces: &[Force]) -> ForceRequest {
    let request = ForceRequest::new("strips", owner).lifetime_ms(LONG_LIFETIME);
    forces.iter().cloned().fold(request, ForceRequest::force)
}

/// Sets the forces of an owner; returns the number of the owner.
async fn apply(client: &Client, owner: &[u8], forces: &[Force]) -> u64 {
    let reply = with_timeout(client.apply_forces(&request(owner, forces))).await.expect("expected valid forces");
    assert_eq!(reply.lifetime_ms, LONG_LIFETIME);
    reply.owner
}

async fn apply_invalid(client: &Client, request: &ForceRequest) -> Rejection {
    let error = with_timeout(client.apply_forces(request)).await.expect_err("expected a rejection");
    error.rejection().expect("expected details").clone()
}

async fn subscribe(client: &Client) -> ForceStream {
    with_timeout(client.stream_forces("strips", 0.0)).await.expect("expected a subscription")
}

async fn next_set(stream: &mut ForceStream) -> ForceSet {
    with_timeout(stream.next()).await.expect("expected another set").expect("expected a valid set")
}

/// Owner, id and f_q of each force.
fn summarize(set: &ForceSet) -> Vec<(u64, u64, Vec<f32>)> {
    set.forces.iter().map(|force| (force.owner, force.id, force.f_q.clone())).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_reports_new_changed_and_cleared_forces() {
    let (server, client) = start_server().await;
    let mut stream = subscribe(&client).await;
    assert_eq!(next_set(&mut stream).await, ForceSet::default());
    assert_eq!(apply(&client, &FIRST_OWNER, &[modal_force(7, 0, [1.0, 2.0])]).await, 1);
    assert_eq!(summarize(&next_set(&mut stream).await), [(1, 7, vec![1.0, 2.0])]);
    // Another owner uses the same id and does not change the forces of the first one.
    let second_viewer = connect(&server).await;
    assert_eq!(apply(&second_viewer, &SECOND_OWNER, &[modal_force(7, 1, [3.0, 4.0])]).await, 2);
    assert_eq!(summarize(&next_set(&mut stream).await), [(1, 7, vec![1.0, 2.0]), (2, 7, vec![3.0, 4.0])]);
    assert_eq!(apply(&second_viewer, &SECOND_OWNER, &[]).await, 0);
    assert_eq!(summarize(&next_set(&mut stream).await), [(1, 7, vec![1.0, 2.0])]);
    // The second call is a renewal, which is not reported.
    for f_q in [[1.0, 2.0], [1.0, 2.0], [5.0, 6.0]] {
        assert_eq!(apply(&second_viewer, &FIRST_OWNER, &[modal_force(7, 0, f_q)]).await, 1, "expected the same owner");
    }
    assert_eq!(summarize(&next_set(&mut stream).await), [(1, 7, vec![5.0, 6.0])]);
    let mut late_stream = subscribe(&client).await;
    assert_eq!(summarize(&next_set(&mut late_stream).await), [(1, 7, vec![5.0, 6.0])]);
    apply(&client, &FIRST_OWNER, &[]).await;
    assert_eq!(next_set(&mut stream).await, ForceSet::default());
}

/// The next reason why nothing receives the forces.
async fn next_receiver_error(reader: &mut Replies<v1::StreamForcesResponse>) -> String {
    with_timeout(reader.next()).await.expect("expected a valid report").expect("expected a report").receiver_error
}

/// Readers learn the reason, also those that come later, until another receiver subscribes.
#[tokio::test(flavor = "multi_thread")]
async fn readers_learn_why_nothing_receives_forces() {
    let (server, client) = start_server().await;
    let request = || v1::StreamForcesRequest { scene: "strips".into(), max_hz: 0.0, passive: true };
    let mut reader = with_timeout(client.force_messages(request())).await.expect("expected a subscription");
    assert_eq!(next_receiver_error(&mut reader).await, "");
    let scene_handle = server.engine.find("strips").expect("expected the scene");
    scene_handle.set_receiver_error("diverged");
    assert_eq!(next_receiver_error(&mut reader).await, "diverged");
    let mut late_reader = with_timeout(client.force_messages(request())).await.expect("expected a subscription");
    assert_eq!(next_receiver_error(&mut late_reader).await, "diverged");
    subscribe(&client).await;
    assert_eq!(next_receiver_error(&mut reader).await, "");
}

/// The forces of a viewer whose connection is lost expire; those of another viewer that renews them remain.
#[tokio::test(flavor = "multi_thread")]
async fn forces_of_a_lost_viewer_expire() {
    // The reader must receive the forces before they expire.
    const LIFETIME: Duration = SILENCE_LIMIT;
    let (server, client) = start_server().await;
    let mut stream = subscribe(&client).await;
    next_set(&mut stream).await;
    apply(&client, &FIRST_OWNER, &[modal_force(1, 0, [1.0, 0.0])]).await;
    next_set(&mut stream).await;
    let lost_viewer = connect(&server).await;
    let lost_force = request(&SECOND_OWNER, &[modal_force(2, 1, [0.0, 1.0])]).lifetime_ms(LIFETIME.as_millis() as u32);
    let applied_at = Instant::now();
    with_timeout(lost_viewer.apply_forces(&lost_force)).await.expect("expected valid forces");
    drop(lost_viewer);
    assert_eq!(next_set(&mut stream).await.forces.len(), 2);
    let remaining_forces = next_set(&mut stream).await;
    assert!(applied_at.elapsed() >= LIFETIME, "expected the forces to last for their lifetime");
    assert_eq!(summarize(&remaining_forces), [(1, 1, vec![1.0, 0.0])]);
}

/// A picture of the strips from the front.
fn picture() -> Picture {
    let view = View::LookAt { eye: [0.5, 0.5, 4.0], target: [0.5, 0.5, 0.0], up: Some([0.0, 1.0, 0.0]) };
    let lens = Lens::Intrinsics { fx: 160.0, fy: 160.0, cx: 48.0, cy: 40.0 };
    Picture { width: 96, height: 80, camera: Some(Camera { view, lens, clip: None }), ..Picture::default() }
}

/// f_q of a force at a picked point equals U^T A^T f with U and A of the pick. Needs an EGL driver that can render.
#[tokio::test(flavor = "multi_thread")]
async fn reduced_force_equals_that_of_a_pick() {
    let server = Server::start_with(|config| Config { renderer: RendererChoice::Auto, ..config }).await;
    server.open("strips").await;
    let client = connect(&server).await;
    let mut writer = server.drive_lossless("strips").await;
    writer.send_step_and_wait(step(1, &[0, 1], &[0.2, -0.1, 0.15, 0.3])).await;
    let poses: Vec<_> = (0..2).map(|domain| (domain, QUARTER_TURN, [1.0, 0.0, 0.0])).collect();
    writer.send_step_and_wait(rigid_step(2, v1::TransformFormat::QuaternionXyzwF32, &poses)).await;
    let picks = client.pick(&PickRequest::new("strips", PickRectangle::pixel(picture(), 0, 0).size(64, 64))).await;
    let hits = picks.expect("expected a pick").hits;
    let hit = hits.get(hits.len() / 2).expect("expected a hit");
    let vector = [0.3, -2.0, 1.1];
    apply(&client, &FIRST_OWNER, &[Force::at_hit(1, hit, vector)]).await;
    let set = next_set(&mut subscribe(&client).await).await;
    assert_eq!(set.step.map(|step| step.number), Some(2));
    let [force] = set.forces.as_slice() else { panic!("expected one force, got {:?}", set.forces) };
    let expected_f_q: Vec<f32> = hit.reduced_force(vector).into_iter().map(|component| component as f32).collect();
    assert_eq!((force.domain, &force.f_q), (hit.domain, &expected_f_q));
    let surface = SurfaceForce { triangle: hit.triangle, barycentric: hit.barycentric, vector };
    assert_eq!(force.surface, Some(surface));
    let without_rotation =
        modalcast_client::Hit { linear: [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0], ..hit.clone() };
    let unrotated_f_q = without_rotation.reduced_force(vector);
    let difference = unrotated_f_q.iter().zip(&force.f_q).map(|(a, b)| (a - f64::from(*b)).abs()).fold(0.0, f64::max);
    assert!(difference > 0.01, "control: expected the rotation to change f_q");
}

/// f_q of a force at the point of [`surface_force`]. `local_force` is the force in the frame of the domain.
fn expected_f_q(local_force: [f64; 3]) -> Vec<f32> {
    let scene = strips();
    let shape = scene.shape_of(0);
    let corners = shape.mesh.triangles()[0];
    let component = |mode: usize| {
        let weighted_entry = |(corner, weight): (&u32, f64), axis: usize| {
            let vertex = shape.mesh.corners().vertices[*corner as usize];
            weight * f64::from(shape.modes.entry(vertex as usize, axis, mode))
        };
        let entry =
            |axis| corners.iter().zip([0.5, 0.25, 0.25]).map(|corner| weighted_entry(corner, axis)).sum::<f64>();
        (0..3).map(|axis| entry(axis) * local_force[axis]).sum::<f64>() as f32
    };
    (0..2).map(component).collect()
}

/// A step that rotates the domain changes f_q and is reported; a step that only deforms it is not.
#[tokio::test(flavor = "multi_thread")]
async fn rotation_of_the_domain_changes_f_q() {
    let (server, client) = start_server().await;
    let mut writer = server.drive_lossless("strips").await;
    apply(&client, &FIRST_OWNER, &[surface_force(1, 1, [2.0, 0.0, 0.0])]).await;
    let mut stream = subscribe(&client).await;
    let rest_set = next_set(&mut stream).await;
    assert_eq!(
        (rest_set.step.map(|step| step.run), &rest_set.forces[0].f_q),
        (Some(0), &expected_f_q([2.0, 0.0, 0.0]))
    );
    let scene = strips();
    let mesh = &scene.shape_of(1).mesh;
    let corners =
        mesh.triangles()[0].map(|corner| mesh.rest_positions()[mesh.corners().vertices[corner as usize] as usize]);
    let component = |axis: usize| {
        let [a, b, c] = corners.map(|position| f64::from(position[axis]));
        0.5 * a + 0.25 * b + 0.25 * c
    };
    let expected_point = std::array::from_fn(component);
    assert_eq!(rest_set.forces[0].rest_point, Some(expected_point));
    writer.send_step_and_wait(step(1, &[1], &[0.5, 0.5])).await;
    let pose = [(1, QUARTER_TURN, [0.0, 0.0, 0.0])];
    writer.send_step_and_wait(rigid_step(2, v1::TransformFormat::QuaternionXyzwF32, &pose)).await;
    let rotated_set = next_set(&mut stream).await;
    assert_eq!(rotated_set.step.map(|step| step.number), Some(2));
    // The domain's y axis points along -x of the world, so that the force is -y in the frame of the domain.
    let (f_q, expected) = (&rotated_set.forces[0].f_q, expected_f_q([0.0, -2.0, 0.0]));
    assert!(f_q.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-6), "expected {expected:?}, got {f_q:?}");
    assert_ne!(f_q, &rest_set.forces[0].f_q, "control: expected the rotation to change f_q");
}

#[tokio::test(flavor = "multi_thread")]
async fn limits_and_invalid_forces_are_rejected() {
    let (_server, client) = start_server().await;
    let forces: Vec<Force> = (0..17).map(|id| modal_force(id, 0, [1.0, 0.0])).collect();
    let rejection = apply_invalid(&client, &request(&FIRST_OWNER, &forces)).await;
    assert_eq!(
        (rejection.reason, rejection.expected.as_str()),
        (Reason::LimitReached, "at most 16 forces of one owner")
    );
    assert_eq!(apply(&client, &FIRST_OWNER, &forces[..16]).await, 1);
    for owner in 1..32 {
        apply(&client, &[100 + owner; 16], &forces[..1]).await;
    }
    let rejection = apply_invalid(&client, &request(&SECOND_OWNER, &forces[..1])).await;
    let expected = "at most 32 owners of forces of one scene";
    assert_eq!((rejection.reason, rejection.expected.as_str()), (Reason::LimitReached, expected));
    assert_eq!(apply(&client, &FIRST_OWNER, &[]).await, 0);
    assert_eq!(apply(&client, &SECOND_OWNER, &forces[..1]).await, 33);

    let valid_force = surface_force(1, 0, [1.0; 3]);
    let surface = |triangle: u32, barycentric: [f64; 3], vector: [f64; 3]| Force {
        kind: ForceKind::Surface(SurfaceForce { triangle, barycentric, vector }),
        ..valid_force.clone()
    };
    let center = [0.25, 0.25, 0.5];
    for (force, field) in [
        (surface_force(2, 2, [1.0; 3]), "forces[1].domain"),
        (surface(2, center, [1.0; 3]), "forces[1].surface.triangle"),
        (surface(0, [0.25, 0.25, 0.25], [1.0; 3]), "forces[1].surface.barycentric"),
        (surface(0, center, [1.0, f64::NAN, 0.0]), "forces[1].surface.vector"),
        (Force::on_modes(2, 0, &[1.0]), "forces[1].modal.f_q"),
        (valid_force.clone(), "forces[1].id"),
    ] {
        let rejection = apply_invalid(&client, &request(&SECOND_OWNER, &[valid_force.clone(), force])).await;
        assert_eq!((rejection.reason, rejection.field.as_str()), (Reason::InvalidField, field));
    }
    for (request, field) in [
        (request(&[1; 15], &[]), "owner"),
        (request(&[1; 65], &[]), "owner"),
        (request(&FIRST_OWNER, &[]).lifetime_ms(10_001), "lifetime_ms"),
    ] {
        assert_eq!(apply_invalid(&client, &request).await.field, field);
    }
    // The invalid requests have changed nothing.
    let mut stream = subscribe(&client).await;
    let set = next_set(&mut stream).await;
    assert_eq!(set.forces.last().map(|force| (force.owner, force.id)), Some((33, 0)));
    let defaults = ForceRequest::new("strips", &SECOND_OWNER).force(valid_force);
    let reply = with_timeout(client.apply_forces(&defaults)).await.expect("expected valid forces");
    assert_eq!((reply.lifetime_ms, reply.receivers), (500, 1));
}

/// A stream with a limited rate skips sets and ends with the newest one.
#[tokio::test(flavor = "multi_thread")]
async fn limited_rate_skips_to_the_newest_forces() {
    const CHANGES: u64 = 20;
    let (_server, client) = start_server().await;
    // At most one set every two seconds.
    let max_hz = 0.5;
    let mut stream = with_timeout(client.stream_forces("strips", max_hz)).await.expect("expected a subscription");
    next_set(&mut stream).await;
    for id in 1..=CHANGES {
        apply(&client, &FIRST_OWNER, &[modal_force(id, 0, [1.0, 0.0])]).await;
    }
    let mut reports = 0;
    loop {
        let set = next_set(&mut stream).await;
        reports += 1;
        if set.forces[0].id == CHANGES {
            break;
        }
    }
    assert!(reports < CHANGES, "expected skipped sets, got {reports} reports");
    assert!(with_timeout(client.stream_forces("strips", -1.0)).await.is_err());
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_ends_with_its_scene() {
    let (server, client) = start_server().await;
    let mut stream = subscribe(&client).await;
    next_set(&mut stream).await;
    client.delete_scene("strips").await.expect("expected the scene to close");
    let error = with_timeout(stream.next()).await.expect("expected an error").expect_err("expected an error");
    assert_eq!(error.rejection().map(|rejection| rejection.reason), Some(Reason::SceneNotFound));
    server.open("strips").await;
    let mut stream = subscribe(&client).await;
    assert_eq!(next_set(&mut stream).await, ForceSet::default(), "expected a new scene without forces");
    server.stop().await.expect("expected a clean stop");
    let error = with_timeout(stream.next()).await.expect("expected an error").expect_err("expected an error");
    assert_eq!(error.rejection().map(|rejection| rejection.reason), Some(Reason::ShuttingDown));
}
