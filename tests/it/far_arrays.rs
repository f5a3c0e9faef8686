//! Uploaded arrays at coordinates of a map: an origin, f64 positions or an f64 placement keep their precision, in
//! vertices, descriptions and states, and after a restart.

use std::path::Path;
use std::sync::Arc;

use modalcast_client::{ArrayUpload, Client, StateLayout, StateRequest, UploadDomain, UploadShape};
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use nalgebra::{Point3, UnitQuaternion, Vector3};
use v1::upload_arrays_request::Part;

use crate::service_harness::{Server, config, get_vertices, rigid_step};

/// Easting, northing and height in scene units. f32 rounds the northing by up to 0.25.
const CENTER: [f64; 3] = [500_000.3, 4_649_776.2, 12.1];
/// The promise is 1e-5 of the diagonal, which is 0.7.
const MAX_ERROR: f64 = 1e-6;

const OFFSETS: [[f32; 3]; 4] = [[0.0, 0.0, 0.0], [0.41, 0.03, 0.0], [0.07, 0.37, 0.011], [0.1, 0.13, 0.43]];
const TRIANGLES: [[u32; 3]; 4] = [[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]];

fn x0(center: [f64; 3]) -> Vec<Point3<f64>> {
    OFFSETS.iter().map(|offset| Point3::from(Vector3::from(*offset).cast::<f64>() + Vector3::from(center))).collect()
}

fn shape() -> UploadShape {
    UploadShape::Arrays { positions: OFFSETS.to_vec(), triangles: TRIANGLES.to_vec(), rank: 0, modes: vec![] }
}

async fn start_server(folder: &Path) -> (Server, Client) {
    let repository = SceneRepository::new(Some(folder)).expect("expected a repository");
    let server = Server::start_from(config(&folder.join("state")), Arc::new(repository)).await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    (server, client)
}

/// World positions of the only domain.
async fn positions_of(server: &Server, scene: &str) -> Vec<Point3<f64>> {
    let request = v1::GetVerticesRequest { scene: scene.into(), ..Default::default() };
    let reply = get_vertices(server, request).await.expect("expected vertices");
    let origin = Vector3::from_column_slice(&reply.origins);
    let position = |numbers: &[f32]| Point3::from(origin + Vector3::from_column_slice(numbers).cast::<f64>());
    reply.positions.chunks_exact(3).map(position).collect()
}

fn max_distance(positions: &[Point3<f64>], expected: &[Point3<f64>]) -> f64 {
    assert_eq!(positions.len(), expected.len());
    positions.iter().zip(expected).map(|(a, b)| (a - b).norm()).fold(0.0, f64::max)
}

/// Sends f64 positions as the wire has them.
async fn upload_f64(server: &Server, scene: &str) {
    let header = v1::UploadArraysHeader { scene: scene.into(), domains: 1, total_bytes: 96 + 48, ..Default::default() };
    let domain =
        v1::UploadedDomain { name: "a".into(), vertices: 4, triangles: 4, f64_positions: true, ..Default::default() };
    let positions =
        x0(CENTER).into_iter().flat_map(|point| point.coords.as_slice().to_vec()).flat_map(f64::to_le_bytes);
    let chunk: Vec<u8> = positions.chain(TRIANGLES.into_iter().flatten().flat_map(u32::to_le_bytes)).collect();
    let parts = [Part::Header(header), Part::Domain(domain), Part::Chunk(chunk.into())];
    let requests = parts.map(|part| v1::UploadArraysRequest { part: Some(part) });
    server.scenes().await.upload_arrays(tokio_stream::iter(requests)).await.expect("expected an upload");
}

#[tokio::test(flavor = "multi_thread")]
async fn far_arrays_are_exact_at_rest_after_steps_and_after_a_restart() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (server, client) = start_server(folder.path()).await;
    let with_origin = UploadDomain::new("a", shape()).origin(CENTER);
    client.upload_arrays(ArrayUpload::new("origin").domain(with_origin)).await.expect("expected an upload");
    let mut matrix = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    (0..3).for_each(|axis| matrix[4 * axis + 3] = CENTER[axis]);
    let placed = UploadDomain::new("a", shape()).exact_placement(matrix);
    client.upload_arrays(ArrayUpload::new("placed").domain(placed)).await.expect("expected an upload");
    upload_f64(&server, "double").await;
    for scene in ["origin", "placed", "double"] {
        let error = max_distance(&positions_of(&server, scene).await, &x0(CENTER));
        assert!(error <= MAX_ERROR, "{scene}: {error:e}");
    }
    let rounded: Vec<Point3<f64>> = x0(CENTER).iter().map(|point| point.cast::<f32>().cast()).collect();
    assert!(max_distance(&rounded, &x0(CENTER)) > 0.1, "control: expected an error of f32");

    // T acts on the uncentered x0.
    let rotation = UnitQuaternion::from_euler_angles(0.4, -0.3, 1.0);
    let quaternion = [rotation.i, rotation.j, rotation.k, rotation.w].map(|number| number as f32);
    let [i, j, k, w] = quaternion.map(f64::from);
    let rotation = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(w, i, j, k));
    let translation = Vector3::new(-3000.4, 25.6, 1e6);
    let moved: Vec<Point3<f64>> = x0(CENTER).iter().map(|point| rotation * point + translation).collect();
    for scene in ["origin", "double"] {
        let mut writer = server.drive_lossless(scene).await;
        let format = v1::TransformFormat::QuaternionXyzwF64;
        writer.send_step_and_wait(rigid_step(1, format, &[(0, quaternion, translation.into())])).await;
        writer.finish().await;
        let error = max_distance(&positions_of(&server, scene).await, &moved);
        assert!(error <= MAX_ERROR, "{scene}: {error:e}");
    }
    server.stop().await.expect("expected the server to stop");
    let (server, client) = start_server(folder.path()).await;
    for (scene, expected) in [("origin", &moved), ("double", &moved), ("placed", &x0(CENTER))] {
        let error = max_distance(&positions_of(&server, scene).await, expected);
        assert!(error <= MAX_ERROR, "{scene} after a restart: {error:e}");
    }

    // States and descriptions: x = T x0 in f64, with T and x0 as a client receives them.
    let arrays = [v1::Array::RestPositions, v1::Array::CenteredPositions];
    for scene in ["origin", "double"] {
        let description = client.describe(scene, &arrays).await.expect("expected a description");
        let shape = &description.shapes[0];
        assert!(shape.has_origin() && description.info.remarks.iter().any(|remark| remark.contains("f32 transforms")));
        let layout = StateLayout::new(&description).expect("expected a layout");
        let state = client.get_state(&StateRequest::new(scene, ()), &layout).await.expect("expected a state");
        let origin = Vector3::from(state.origin(0).expect("an origin"));
        let t = nalgebra::Matrix3x4::from_row_slice(&state.transform(0).expect("a transform").map(f64::from));
        let positions_with = |numbers: &[f32], offset: [f64; 3]| -> Vec<Point3<f64>> {
            let position = |numbers: &[f32]| {
                let point = Vector3::from_column_slice(numbers).cast::<f64>() + Vector3::from(offset);
                Point3::from(origin + t * point.push(1.0))
            };
            numbers.chunks_exact(3).map(position).collect()
        };
        let error = max_distance(&positions_with(&shape.centered_positions, shape.origin), &moved);
        assert!(error <= MAX_ERROR, "{scene}: {error:e}");
        // A client that does not ask has the error of f32 positions, and no other.
        let error = max_distance(&positions_with(&shape.rest_positions, [0.0; 3]), &moved);
        assert!((1e-3..1.0).contains(&error), "{scene}: {error:e}");
    }
    let placed = client.describe("placed", &arrays).await.expect("expected a description");
    assert_eq!(placed.domains[0].exact_placement, matrix);
    assert!(!placed.shapes[0].has_origin() && placed.shapes[0].centered_positions.is_empty());
}
