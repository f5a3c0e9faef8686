//! The three wire formats of transforms (affine f32, rigid f32 and rigid f64) give the same vertices. Vertices 10,000
//! km from the origin have errors of at most 1 mm.

use modalcast::config::{BackendChoice, Config};
use modalcast_model::scene::Scene;
use modalcast_proto::v1;
use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use v1::TransformFormat::{AffineF32, QuaternionXyzwF32, QuaternionXyzwF64, Unspecified};

use crate::service_harness::{
    ReceivedVertices, Server, config, far_strips, get_vertices, reference_vertices, rigid_step, select,
    state_after_steps, step, strips,
};

/// Pose of a domain in scene units.
#[derive(Clone, Copy)]
struct Pose {
    /// Quaternion x y z w.
    rotation: [f32; 4],
    translation: [f64; 3],
}

fn vertex_request(scene: &str, domains: &[u32]) -> v1::GetVerticesRequest {
    let selection = select(domains, &[]);
    v1::GetVerticesRequest { scene: scene.into(), selection, ..v1::GetVerticesRequest::default() }
}

fn quaternion(roll: f64, pitch: f64, yaw: f64) -> [f32; 4] {
    let rotation = UnitQuaternion::from_euler_angles(roll, pitch, yaw);
    [rotation.i, rotation.j, rotation.k, rotation.w].map(|number| number as f32)
}

/// World positions of a domain in meters, computed in f64 as unit * (R (x0 + U q) + t). `unit` is the length of a scene
/// unit in meters.
fn expected_positions(scene: &Scene, domain: usize, q: &[f32], pose: Pose) -> Vec<Vector3<f64>> {
    let [x, y, z, w] = pose.rotation.map(f64::from);
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
    let shape = scene.shape_of(domain);
    let world_position = |(vertex, rest_position): (usize, &[f32; 3])| {
        let deformed_position = Vector3::from_fn(|axis, _| {
            let products =
                q.iter().enumerate().map(|(mode, q)| f64::from(shape.modes.entry(vertex, axis, mode)) * f64::from(*q));
            f64::from(rest_position[axis]) + products.sum::<f64>()
        });
        scene.unit * (rotation * deformed_position + Vector3::from(pose.translation))
    };
    shape.mesh.rest_positions().iter().enumerate().map(world_position).collect()
}

/// World positions in meters, decoded from the reply.
fn decode_positions(scene: &Scene, reply: &ReceivedVertices) -> Vec<Vector3<f64>> {
    let mut positions = reply.positions.chunks_exact(3);
    let mut world_positions = Vec::new();
    for (index, vertices) in reply.layout.vertices.iter().enumerate() {
        // Origins are in meters: one per domain, or one for all domains.
        let origin = if reply.origins.len() == 3 { &reply.origins[..] } else { &reply.origins[3 * index..][..3] };
        let origin = Vector3::from_column_slice(origin);
        for position in positions.by_ref().take(*vertices as usize) {
            world_positions.push(origin + scene.unit * Vector3::from_column_slice(position).cast::<f64>());
        }
    }
    world_positions
}

fn max_distance(positions: &[Vector3<f64>], expected_positions: &[Vector3<f64>]) -> f64 {
    assert_eq!(positions.len(), expected_positions.len());
    positions.iter().zip(expected_positions).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
}

async fn start_cpu_server() -> Server {
    Server::start_with(|config| Config { backend: BackendChoice::Cpu, ..config }).await
}

#[tokio::test(flavor = "multi_thread")]
async fn transform_formats_give_equal_vertices() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    let pose = Pose { rotation: quaternion(0.3, -0.8, 2.0), translation: [1.5, -2.25, 3.0] };
    // The pose as an affine 3 x 4 matrix.
    let matrix =
        state_after_steps(&strips(), &[rigid_step(0, QuaternionXyzwF32, &[(1, pose.rotation, pose.translation)])])
            .transforms[1];
    let affine_step = |format: v1::TransformFormat| v1::Step {
        transform_domains: vec![1],
        transforms: bytemuck::cast_slice::<f32, u8>(&matrix.0).to_vec().into(),
        transform_format: format.into(),
        ..step(0, &[], &[])
    };
    let steps = [
        affine_step(Unspecified),
        affine_step(AffineF32),
        rigid_step(0, QuaternionXyzwF32, &[(1, pose.rotation, pose.translation)]),
        rigid_step(0, QuaternionXyzwF64, &[(1, pose.rotation, pose.translation)]),
    ];
    let expected_vertices = reference_vertices(&strips(), &steps[..1]);
    for (number, mut step) in steps.into_iter().enumerate() {
        step.number = number as u64;
        // Every other step has further fields before the transforms, so that their alignment in the message differs.
        // The coordinates are zero, as at rest.
        if number % 2 == 1 {
            step.q_domains = vec![0];
            step.q = vec![0; 8].into();
        }
        writer.send_step_and_wait(step).await;
        let reply = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
        assert_eq!(
            (&reply.positions, &reply.normals),
            (&expected_vertices.positions, &expected_vertices.normals),
            "step {number}"
        );
        assert_eq!(reply.origins, [0.0; 3]);
    }
    // Negative control: another rotation gives other vertices.
    let other_step = rigid_step(9, QuaternionXyzwF32, &[(1, quaternion(0.3, -0.8, 2.1), pose.translation)]);
    assert_ne!(reference_vertices(&strips(), &[other_step]).positions, expected_vertices.positions);
}

#[tokio::test(flavor = "multi_thread")]
async fn far_scene_and_far_domain_keep_millimeter_precision() {
    let server = start_cpu_server().await;
    let scene = far_strips();
    server.open("far").await;
    let mut writer = server.drive_lossless("far").await;
    let q = [0.25, -0.5, 0.125, 0.75_f32];
    writer.send_step_and_wait(step(0, &[], &q)).await;
    // Translations are relative to the world origin, in scene units of half a meter. Domain 0 is near the scene origin.
    // Domain 1 is 2e7 units (10,000 km) from the scene origin along x.
    let origin = scene.origin.map(|meters| meters / scene.unit);
    let near_pose = Pose {
        rotation: quaternion(0.1, 0.2, 0.3),
        translation: [origin[0] + 3.001, origin[1] - 2.003, origin[2] + 0.007],
    };
    let far_pose = Pose {
        rotation: quaternion(-1.0, 0.5, 0.9),
        translation: [origin[0] + 2e7 + 1.234, origin[1] + 0.001, origin[2] - 700.021],
    };
    writer
        .send_step_and_wait(rigid_step(
            1,
            QuaternionXyzwF64,
            &[(0, near_pose.rotation, near_pose.translation), (1, far_pose.rotation, far_pose.translation)],
        ))
        .await;
    let reply = get_vertices(&server, vertex_request("far", &[])).await.expect("expected vertices");
    assert_eq!((reply.origins.len(), &reply.origins[..3]), (6, scene.origin.as_slice()));
    let expected =
        [expected_positions(&scene, 0, &q[..2], near_pose), expected_positions(&scene, 1, &q[2..], far_pose)].concat();
    let error = max_distance(&decode_positions(&scene, &reply), &expected);
    assert!(error <= 1e-3, "expected at most 1 mm, got {error} m");
    // Negative control: f32 cannot hold the translation of domain 1 from the scene origin with an error below 1 cm.
    let far_x = far_pose.translation[0] - origin[0];
    let f32_error = far_x - f64::from(far_x as f32);
    assert!(
        scene.unit * f32_error.abs() > 1e-2,
        "expected an f32 rounding error of more than 1 cm, got {f32_error} units"
    );
    // A selection of the domains in reverse order without normals, and a selection of one domain, have the same
    // precision.
    let selection = select(&[1, 0], &[v1::Attribute::Positions]);
    let swapped_reply = get_vertices(&server, v1::GetVerticesRequest { selection, ..vertex_request("far", &[]) })
        .await
        .expect("expected vertices");
    let expected =
        [expected_positions(&scene, 1, &q[2..], far_pose), expected_positions(&scene, 0, &q[..2], near_pose)].concat();
    assert!(
        swapped_reply.normals.is_empty() && max_distance(&decode_positions(&scene, &swapped_reply), &expected) <= 1e-3
    );
    let near_reply = get_vertices(&server, vertex_request("far", &[0])).await.expect("expected vertices");
    assert_eq!(near_reply.origins.len(), 3, "expected one origin");
    assert!(
        max_distance(&decode_positions(&scene, &near_reply), &expected_positions(&scene, 0, &q[..2], near_pose))
            <= 1e-3
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
    let mut writer = server.drive_lossless("strips").await;
    let poses = [
        Pose { rotation: quaternion(0.0, 0.4, 0.0), translation: [1e7 + 0.004, 5.006, -1e7 - 0.002] },
        Pose { rotation: quaternion(1.0, 0.0, 0.0), translation: [1e7 + 9.5, 0.0, -1e7] },
    ];
    let pose_step = |number| {
        rigid_step(
            number,
            QuaternionXyzwF64,
            &[0, 1].map(|index| (index as u32, poses[index].rotation, poses[index].translation)),
        )
    };
    writer.send_step_and_wait(pose_step(4)).await;
    let reply = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
    assert_eq!(reply.origins.len(), 3, "expected one origin for both domains");
    let distance = (Vector3::from_column_slice(&reply.origins) - Vector3::from(poses[0].translation)).amax();
    assert!(distance < 64.0, "expected an origin near the domains, got {:?}", reply.origins);
    let expected =
        [expected_positions(&scene, 0, &[], poses[0]), expected_positions(&scene, 1, &[], poses[1])].concat();
    let error = max_distance(&decode_positions(&scene, &reply), &expected);
    assert!(error <= 1e-3, "expected at most 1 mm, got {error} m");
    writer.finish().await;
    server.stop().await.expect("expected the server to stop without an error");
    let server = Server::start(settings()).await;
    let restored_reply = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
    assert_eq!(
        (restored_reply.step().number, &restored_reply.positions, &restored_reply.origins),
        (4, &reply.positions, &reply.origins)
    );
    // The next step changes only domain 1. Domain 0 keeps the pose that the restart restored.
    let mut writer = server.drive_from_current_state("strips").await;
    let new_pose = Pose { rotation: poses[1].rotation, translation: [1e7 + 11.5, 0.001, -1e7] };
    writer.send_step_and_wait(rigid_step(0, QuaternionXyzwF64, &[(1, new_pose.rotation, new_pose.translation)])).await;
    let reply = get_vertices(&server, vertex_request("strips", &[])).await.expect("expected vertices");
    let expected =
        [expected_positions(&scene, 0, &[], poses[0]), expected_positions(&scene, 1, &[], new_pose)].concat();
    assert!(reply.origins.len() == 3 && max_distance(&decode_positions(&scene, &reply), &expected) <= 1e-3);
}
