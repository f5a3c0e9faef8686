//! The three wire formats of transforms, and domains ten thousand kilometers from the origin: vertices are exact to the
//! millimeter.

use modalcast::config::{BackendChoice, Config};
use modalcast_model::scene::Scene;
use modalcast_proto::v1;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use v1::TransformFormat::{AffineF32, RigidF32, RigidF64, Unspecified};

use crate::service_harness::{
    ReceivedVertices, Server, config, far_strips, get_vertices, reference_vertices, rigid_step, state_after_steps,
    step, strips,
};

/// Pose of a domain: quaternion x y z w and translation.
type Pose = ([f32; 4], [f64; 3]);

fn vertex_request(scene: &str, domains: &[u32]) -> v1::GetVerticesRequest {
    let selection = Some(v1::VertexSelection { domains: domains.to_vec(), ..Default::default() });
    v1::GetVerticesRequest { scene: scene.into(), selection, ..v1::GetVerticesRequest::default() }
}

fn quaternion(roll: f64, pitch: f64, yaw: f64) -> [f32; 4] {
    let rotation = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
    [rotation.i, rotation.j, rotation.k, rotation.w].map(|number| number as f32)
}

/// World positions in meters, computed in f64: unit (R (x0 + U q) + t) with t as sent.
fn expected_positions(scene: &Scene, domain: usize, q: &[f32], (rotation, translation): Pose) -> Vec<Vector3<f64>> {
    let [x, y, z, w] = rotation.map(f64::from);
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let shape = scene.shape_of(domain);
    let world_position = |(vertex, rest): (usize, &[f32; 3])| {
        let deformed = Vector3::from_fn(|axis, _| {
            let modes = q.iter().enumerate();
            let displacement: f64 =
                modes.map(|(mode, q)| f64::from(shape.modes.entry(vertex, axis, mode)) * f64::from(*q)).sum();
            f64::from(rest[axis]) + displacement
        });
        scene.unit * (rotation * deformed + Vector3::from(translation))
    };
    shape.mesh.rest_positions().iter().enumerate().map(world_position).collect()
}

/// World positions in meters, decoded from the reply.
fn decode_positions(scene: &Scene, got: &ReceivedVertices) -> Vec<Vector3<f64>> {
    let mut points = got.positions.chunks_exact(3);
    let mut world = Vec::new();
    for (index, vertices) in got.head.vertices.iter().enumerate() {
        let origin = if got.origins.is_empty() { &got.head.origin } else { &got.origins[3 * index..][..3] };
        let origin = Vector3::from_column_slice(origin);
        for point in points.by_ref().take(*vertices as usize) {
            world.push(origin + scene.unit * Vector3::from_column_slice(point).cast::<f64>());
        }
    }
    world
}

fn max_distance(got: &[Vector3<f64>], want: &[Vector3<f64>]) -> f64 {
    assert_eq!(got.len(), want.len());
    got.iter().zip(want).map(|(got, want)| (got - want).norm()).fold(0.0, f64::max)
}

async fn start_cpu_server() -> Server {
    Server::start_with(|config| Config { backend: BackendChoice::Cpu, ..config }).await
}

#[tokio::test(flavor = "multi_thread")]
async fn transform_formats_agree_at_any_byte_alignment() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut driver = server.drive("strips", v1::Policy::Lossless, 0).await;
    let pose = (quaternion(0.3, -0.8, 2.0), [1.5, -2.25, 1e3]);
    let matrix = state_after_steps(&strips(), &[rigid_step(0, RigidF32, &[(1, pose.0, pose.1)])]).transforms[1];
    let affine = |format: v1::TransformFormat| v1::Step {
        transform_domains: vec![1],
        transforms: bytemuck::cast_slice::<f32, u8>(&matrix.0).to_vec().into(),
        transform_format: format.into(),
        ..step(0, &[], &[])
    };
    let steps = [
        affine(Unspecified),
        affine(AffineF32),
        rigid_step(0, RigidF32, &[(1, pose.0, pose.1)]),
        rigid_step(0, RigidF64, &[(1, pose.0, pose.1)]),
    ];
    let want = reference_vertices(&strips(), &steps[..1]);
    for (number, mut step) in steps.into_iter().enumerate() {
        step.number = number as u64;
        // An odd number of bytes before the transforms changes their alignment within the message.
        step.q_domains = vec![0; usize::from(number % 2 == 1)];
        step.q = vec![0; 8 * step.q_domains.len()].into();
        driver.step_acknowledged(step).await;
        let got = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
        assert_eq!((&got.positions, &got.normals), (&want.0, &want.1), "step {number}");
        assert_eq!((got.head.origin.as_slice(), got.origins.len()), ([0.0; 3].as_slice(), 0));
    }
    // Negative control: another rotation gives other vertices.
    let other = rigid_step(9, RigidF32, &[(1, quaternion(0.3, -0.8, 2.1), pose.1)]);
    assert_ne!(reference_vertices(&strips(), &[other]).0, want.0);
}

#[tokio::test(flavor = "multi_thread")]
async fn far_scene_and_far_domain_keep_millimeter_precision() {
    let server = start_cpu_server().await;
    let scene = far_strips();
    server.open("far").await;
    let mut driver = server.drive("far", v1::Policy::Lossless, 0).await;
    let q = [0.25, -0.5, 0.125, 0.75_f32];
    driver.step_acknowledged(step(0, &[], &q)).await;
    // In half meters from the world origin. The first domain is near the scene origin, the second is 10,000 km east of
    // it.
    let origin = scene.origin.map(|meters| meters / scene.unit);
    let near_pose = (quaternion(0.1, 0.2, 0.3), [origin[0] + 3.001, origin[1] - 2.003, origin[2] + 0.007]);
    let far_pose = (quaternion(-1.0, 0.5, 0.9), [origin[0] + 2e7 + 1.234, origin[1] + 0.001, origin[2] - 700.021]);
    driver
        .step_acknowledged(rigid_step(1, RigidF64, &[(0, near_pose.0, near_pose.1), (1, far_pose.0, far_pose.1)]))
        .await;
    let got = get_vertices(&server, vertex_request("far", &[])).await.expect("expected vertices");
    assert_eq!((got.head.origin.as_slice(), got.head.origin_bytes), (scene.origin.as_slice(), 48));
    assert_eq!(got.origins[..3], scene.origin);
    let want =
        [expected_positions(&scene, 0, &q[..2], near_pose), expected_positions(&scene, 1, &q[2..], far_pose)].concat();
    let error = max_distance(&decode_positions(&scene, &got), &want);
    assert!(error <= 1e-3, "expected at most 1 mm, got {error} m");
    // Negative control: a far translation rounded to f32 relative to the scene origin has an error of more than 1 cm.
    let f32_error = far_pose.1[0] - origin[0] - f64::from((far_pose.1[0] - origin[0]) as f32);
    assert!(scene.unit * f32_error.abs() > 1e-2, "{f32_error}");
    // A selection of domains in another order and without normals, then one domain only.
    let selection = Some(v1::VertexSelection { domains: vec![1, 0], positions_only: true, ..Default::default() });
    let swapped = get_vertices(&server, v1::GetVerticesRequest { selection, ..vertex_request("far", &[]) })
        .await
        .expect("expected vertices");
    let want =
        [expected_positions(&scene, 1, &q[2..], far_pose), expected_positions(&scene, 0, &q[..2], near_pose)].concat();
    assert!(swapped.normals.is_empty() && max_distance(&decode_positions(&scene, &swapped), &want) <= 1e-3);
    let near_only = get_vertices(&server, vertex_request("far", &[0])).await.expect("expected vertices");
    assert_eq!(near_only.head.origin_bytes, 0);
    assert!(
        max_distance(&decode_positions(&scene, &near_only), &expected_positions(&scene, 0, &q[..2], near_pose)) <= 1e-3
    );
}

/// When all domains move far away, the origin of the scene moves with them. A restart restores that origin and the
/// vertices.
#[tokio::test(flavor = "multi_thread")]
async fn origin_follows_a_moved_scene_and_survives_a_restart() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let settings = || Config { backend: BackendChoice::Cpu, ..config(folder.path()) };
    let server = Server::start(settings()).await;
    let scene = strips();
    server.open("strips").await;
    let mut driver = server.drive("strips", v1::Policy::Lossless, 0).await;
    let poses = [
        (quaternion(0.0, 0.4, 0.0), [1e7 + 0.004, 5.006, -1e7 - 0.002]),
        (quaternion(1.0, 0.0, 0.0), [1e7 + 9.5, 0.0, -1e7]),
    ];
    let both_domains =
        |number| rigid_step(number, RigidF64, &[0, 1].map(|index| (index as u32, poses[index].0, poses[index].1)));
    driver.step_acknowledged(both_domains(4)).await;
    let got = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
    assert_eq!(
        (got.head.origin.as_slice(), got.head.origin_bytes),
        ([9766.0 * 1024.0, 0.0, -9766.0 * 1024.0].as_slice(), 0)
    );
    let want = [expected_positions(&scene, 0, &[], poses[0]), expected_positions(&scene, 1, &[], poses[1])].concat();
    let error = max_distance(&decode_positions(&scene, &got), &want);
    assert!(error <= 1e-3, "expected at most 1 mm, got {error} m");
    driver.finish().await;
    server.stop().await.expect("expected the server to stop without an error");
    let server = Server::start(settings()).await;
    let restored = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
    assert_eq!(
        (restored.step().number, &restored.positions, &restored.head.origin),
        (4, &got.positions, &got.head.origin)
    );
    // The next f64 transform applies to the state restored from the checkpoint.
    let mut driver = server.drive("strips", v1::Policy::Lossless, 0).await;
    let new_pose = (poses[1].0, [1e7 + 11.5, 0.001, -1e7]);
    driver.step_acknowledged(rigid_step(0, RigidF64, &[(1, new_pose.0, new_pose.1)])).await;
    let got = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
    let want = [expected_positions(&scene, 0, &[], poses[0]), expected_positions(&scene, 1, &[], new_pose)].concat();
    assert!(got.origins.is_empty() && max_distance(&decode_positions(&scene, &got), &want) <= 1e-3);
}
