//! Picks, and frames of outputs other than color: depth, domain indices, normals and color maps of values. A pick
//! answers a rectangle of pixels with one hit (a point of a surface) per pixel that shows a surface. These tests need
//! an EGL driver that can render.

use modalcast::config::{Config, RendererChoice};
use modalcast_client::{
    Camera, Client, Code, FrameFormat, FrameRequest, Hit, Lens, Output, PickRectangle, PickRequest, Picture, View,
};
use modalcast_compute::reference;
use modalcast_model::scene::Scene;
use modalcast_proto::v1;
use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use crate::service_harness::{Server, far_strips, rigid_step, sheet, state_after_steps, step, strips};

/// Maximum distance of a picked position from the reference, in scene units. Coordinates are a few units large, where
/// numbers in f32 are 5e-7 apart.
const TOLERANCE: f64 = 2e-6;

/// The identity rotation as a quaternion x y z w.
const IDENTITY_QUATERNION: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

async fn start_server(source: &str) -> (Server, Client) {
    let server = Server::start_with(|config| Config { renderer: RendererChoice::Auto, ..config }).await;
    server.open(source).await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    (server, client)
}

/// A picture of the strips by a camera 4 units in front of them. The focal length of 160 pixels gives 160 / 4 = 40
/// pixels per unit at z = 0.
fn picture() -> Picture {
    let view = View::LookAt { eye: [0.5, 0.5, 4.0], target: [0.5, 0.5, 0.0], up: Some([0.0, 1.0, 0.0]) };
    let lens = Lens::Intrinsics { fx: 160.0, fy: 160.0, cx: 48.0, cy: 40.0 };
    let camera = Some(Camera { view, lens, clip: None });
    Picture { width: 96, height: 80, camera, ..Picture::default() }
}

/// Whether the position of a hit lies on the ray of its pixel, up to [`TOLERANCE`]. The numbers are those of
/// [`picture`].
fn is_on_ray(hit: &Hit) -> bool {
    let [x, y] = hit.pixel.map(f64::from);
    let ray = Vector3::new((x + 0.5 - 48.0) / 160.0, (40.0 - y - 0.5) / 160.0, -1.0);
    let point = Vector3::from(hit.position) - Vector3::new(0.5, 0.5, 4.0);
    (point - ray * (ray.dot(&point) / ray.norm_squared())).norm() < TOLERANCE
}

/// The complete U of a domain, with 3 rows per vertex and one column per mode.
fn mode_matrix(scene: &Scene, domain: u32) -> DMatrix<f64> {
    let shape = &scene.shapes[scene.domains[domain as usize].shape];
    let (rows, rank) = (3 * shape.mesh.rest_positions().len(), shape.modes.rank());
    DMatrix::from_iterator(rows, rank, shape.modes.columns().iter().map(|entry| f64::from(*entry)))
}

/// Reduced force U^T A^T f of a force f at a hit, with the complete U and the linear part A of the transform. f is
/// distributed to the vertices of the triangle by the barycentric coordinates.
fn project_force(scene: &Scene, hit: &Hit, linear: Matrix3<f64>, force: Vector3<f64>) -> DVector<f64> {
    let mode_matrix = mode_matrix(scene, hit.domain);
    let mut vertex_forces = DVector::zeros(mode_matrix.nrows());
    for (vertex, weight) in hit.vertices.iter().zip(hit.barycentric) {
        let vertex_force = weight * linear.transpose() * force;
        (0..3).for_each(|axis| vertex_forces[3 * *vertex as usize + axis] += vertex_force[axis]);
    }
    mode_matrix.transpose() * vertex_forces
}

/// Position of a hit on the f64 reference surface after some steps, from the hit's triangle and barycentric
/// coordinates.
fn reference_position(scene: &Scene, steps: &[v1::Step], hit: &Hit) -> Vector3<f64> {
    let positions = reference::deform(scene, &state_after_steps(scene, steps));
    let first_vertex = scene.layout.domains[hit.domain as usize].first_vertex;
    let corners = hit.vertices.iter().map(|vertex| Vector3::from(positions[first_vertex + *vertex as usize]));
    corners.zip(hit.barycentric).map(|(corner, weight)| corner * weight).sum()
}

#[tokio::test(flavor = "multi_thread")]
async fn reduced_force_of_a_hit_matches_the_complete_modes() {
    let (server, client) = start_server("strips").await;
    let scene = strips();
    let mut writer = server.drive_lossless("strips").await;
    // Rotation by 90 degrees about z.
    let rotation = [0.0, 0.0, std::f32::consts::FRAC_1_SQRT_2, std::f32::consts::FRAC_1_SQRT_2];
    let steps = [
        step(1, &[0, 1], &[0.2, -0.1, 0.15, 0.3]),
        rigid_step(2, v1::TransformFormat::QuaternionXyzwF32, &[(1, rotation, [1.0, 0.25, -0.5])]),
    ];
    // Pixel (44, 37) shows the strips before and after the steps.
    let rest_picks = client
        .pick(&PickRequest::new("strips", PickRectangle::pixel(picture(), 44, 37)))
        .await
        .expect("expected a pick");
    assert_eq!((rest_picks.step.run, rest_picks.hits.len()), (0, 1));
    for step in steps.clone() {
        writer.send_step_and_wait(step).await;
    }
    let request = PickRequest::new("strips", PickRectangle::pixel(picture(), 0, 0).size(64, 64)).exact_step(2);
    let picks = client.pick(&request).await.expect("expected a pick");
    assert_eq!(picks.step.number, 2);
    let state = state_after_steps(&scene, &steps);
    let force = Vector3::new(0.3, -2.0, 1.1);
    let mut hits_of_domains = [0; 2];
    for hit in &picks.hits {
        hits_of_domains[hit.domain as usize] += 1;
        let linear = state.transforms[hit.domain as usize].linear();
        let expected_force = project_force(&scene, hit, linear, force);
        let reduced_force = DVector::from_vec(hit.reduced_force(force.into()));
        assert!(
            (&reduced_force - &expected_force).norm() < 1e-6 * force.norm(),
            "expected {expected_force}, got {reduced_force}"
        );
        assert!(
            (Vector3::from(hit.position) - reference_position(&scene, &steps, hit)).norm() < TOLERANCE
                && is_on_ray(hit),
            "{hit:?}"
        );
    }
    // Each square covers about 40 x 40 = 1600 pixels; both may be partly hidden or outside of the rectangle.
    assert!(hits_of_domains.iter().all(|hits| *hits > 200), "expected hits of both domains, got {hits_of_domains:?}");
    let rotated_hit = picks.hits.iter().find(|hit| hit.domain == 1).expect("expected a hit of domain 1");
    let unrotated_force = project_force(&scene, rotated_hit, Matrix3::identity(), force);
    let reduced_force = DVector::from_vec(rotated_hit.reduced_force(force.into()));
    assert!((reduced_force - unrotated_force).norm() > 0.1, "negative control: expected another without rotation");
    let current_picks = client
        .pick(&PickRequest::new("strips", PickRectangle::pixel(picture(), 44, 37)))
        .await
        .expect("expected a pick");
    assert!(
        (Vector3::from(current_picks.hits[0].position) - Vector3::from(rest_picks.hits[0].position)).norm() > 0.01,
        "expected the picked point to move"
    );
}

/// 4096 hits with their modes reach a client with default message limits. Picks far from the world origin are exact to
/// 1e-3 scene units.
#[tokio::test(flavor = "multi_thread")]
async fn many_hits_are_chunked_and_far_picks_keep_precision() {
    let (_server, client) = start_server("sheet").await;
    let view = View::LookAt { eye: [150.0, 150.0, 40.0], target: [150.0, 150.0, 0.0], up: Some([0.0, 1.0, 0.0]) };
    let camera = Some(Camera { view, lens: Lens::FieldOfView(20.0), clip: None });
    let picture = Picture { width: 640, height: 480, camera, ..Picture::default() };
    let picks = client
        .pick(&PickRequest::new("sheet", PickRectangle::pixel(picture, 100, 100).size(64, 64)))
        .await
        .expect("expected a pick");
    assert_eq!(picks.hits.len(), 64 * 64, "expected the sheet to fill the view");
    let scene = sheet();
    // Every 97th hit, to save time.
    for hit in picks.hits.iter().step_by(97) {
        let expected_force = project_force(&scene, hit, Matrix3::identity(), Vector3::new(1.0, 2.0, -3.0));
        let reduced_force = DVector::from_vec(hit.reduced_force([1.0, 2.0, -3.0]));
        assert!((reduced_force - expected_force).norm() < 1e-5);
    }
    let picks_without_modes = client
        .pick(&PickRequest::new(
            "sheet",
            PickRectangle { omit_modes: true, ..PickRectangle::pixel(picture, 0, 0).size(2, 1) },
        ))
        .await
        .expect("expected a pick");
    assert!(picks_without_modes.hits.iter().all(|hit| hit.modes.is_empty() && hit.rank == 4));

    let (server, client) = start_server("far").await;
    let scene = far_strips();
    // Poses are in half meters, the unit of the scene, from the world origin.
    let domain_translation = [3e7, -2e7 + 0.125, 2e7];
    let poses = [0, 1].map(|domain| (domain, IDENTITY_QUATERNION, domain_translation));
    let far_step = rigid_step(1, v1::TransformFormat::QuaternionXyzwF64, &poses);
    server.drive_lossless("far").await.send_step_and_wait(far_step.clone()).await;
    // Cameras and picked positions are in scene units from the scene origin.
    let translation: [f64; 3] = std::array::from_fn(|axis| domain_translation[axis] - scene.origin[axis] / scene.unit);
    let offset_point = |x: f64, y: f64, z: f64| [translation[0] + x, translation[1] + y, translation[2] + z];
    let view = View::LookAt {
        eye: offset_point(0.4, 0.45, 3.0),
        target: offset_point(0.4, 0.45, 0.0),
        up: Some([0.0, 1.0, 0.0]),
    };
    let camera = Some(Camera { view, lens: Lens::FieldOfView(40.0), clip: None });
    let picture = Picture { width: 65, height: 65, camera, ..Picture::default() };
    let hit = client
        .pick(&PickRequest::new("far", PickRectangle::pixel(picture, 32, 32)))
        .await
        .expect("expected a pick")
        .hits
        .remove(0);
    // Both domains of the scene have their square at z = 0, so the camera sees its target.
    let distance = (Vector3::from(hit.position) - Vector3::from(offset_point(0.4, 0.45, 0.0))).norm();
    assert!(distance < 1e-3, "expected the target of the camera, got a distance of {distance} units");
    // The camera is 3 units of half a meter from its target.
    assert!((hit.depth - 1.5).abs() < 1e-3, "expected a depth of 1.5 m, got {}", hit.depth);
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_rectangles_outputs_and_steps_are_rejected() {
    let (server, client) = start_server("strips").await;
    // A rectangle has at most 64 x 64 pixels and lies within the picture of 96 x 80 pixels.
    for (corner, size, field) in
        [([0, 0], [65, 1], "width"), ([0, 0], [0, 3], "width"), ([95, 79], [2, 1], "x"), ([96, 0], [1, 1], "x")]
    {
        let request =
            PickRequest::new("strips", PickRectangle::pixel(picture(), corner[0], corner[1]).size(size[0], size[1]));
        let error = client.pick(&request).await.expect_err(field);
        assert_eq!(error.rejection().map(|rejection| rejection.field.as_str()), Some(field), "{error}");
    }
    let corner_picks = client
        .pick(&PickRequest::new("strips", PickRectangle::pixel(picture(), 95, 79)))
        .await
        .expect("expected a pick");
    assert!(corner_picks.hits.is_empty(), "expected no hit at the corner pixel of the picture");
    // This request waits for a step that is never sent.
    let unanswered_request =
        PickRequest::new("strips", PickRectangle::pixel(picture(), 0, 0)).minimum_step(1).deadline_ms(60);
    let error = client.pick(&unanswered_request).await.expect_err("expected a timeout");
    assert!(matches!(error, modalcast_client::Error::Status { code: Code::DeadlineExceeded, .. }), "{error}");

    let wire_picture = |output: v1::Output, format: v1::Format| v1::Picture {
        width: 32,
        height: 32,
        output: output.into(),
        format: format.into(),
        ..v1::Picture::default()
    };
    let depth_as_png = wire_picture(v1::Output::Depth, v1::Format::Png);
    let color_as_floats = wire_picture(v1::Output::Color, v1::Format::F32);
    let missing_mode = v1::Picture { mode: 2, ..wire_picture(v1::Output::ModeShape, v1::Format::Png) };
    let scaled_depth = v1::Picture { largest: 1.0, ..wire_picture(v1::Output::Depth, v1::Format::F32) };
    let nan_scale = v1::Picture { largest: f64::NAN, ..wire_picture(v1::Output::Displacement, v1::Format::Png) };
    let unknown_output = v1::Picture { output: 99, ..v1::Picture::default() };
    for (picture, field) in [
        (depth_as_png, "pictures[0].format"),
        (color_as_floats, "pictures[0].format"),
        (missing_mode, "pictures[0].mode"),
        (scaled_depth, "pictures[0].largest"),
        (nan_scale, "pictures[0].largest"),
        (unknown_output, "pictures[0].output"),
    ] {
        let request = v1::RenderFrameRequest { scene: "strips".into(), pictures: vec![picture], ..Default::default() };
        let status = server.frames().await.render_frame(request).await.expect_err(field);
        assert_eq!(crate::service_harness::rejection_details(&status).field, field);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn outputs_have_their_format_and_agree_with_picks() {
    let (server, client) = start_server("strips").await;
    let mut writer = server.drive_lossless("strips").await;
    writer.send_step_and_wait(step(1, &[0, 1], &[0.2, -0.1, 0.15, 0.3])).await;
    let render = async |output| {
        let request = FrameRequest::new("strips", Picture { output, ..picture() });
        client.render_frame(&request.minimum_step(1)).await.expect("expected a frame")
    };
    let (depth, domains, normals) =
        (render(Output::Depth).await, render(Output::Domains).await, render(Output::Normals).await);
    assert_eq!(
        [depth.format, domains.format, normals.format],
        [FrameFormat::F32, FrameFormat::U32, FrameFormat::F32x3]
    );
    let picks = client
        .pick(&PickRequest::new("strips", PickRectangle::pixel(picture(), 20, 10).size(64, 64)))
        .await
        .expect("expected a pick");
    // The word of 4 bytes at an index.
    let read_word =
        |bytes: &[u8], index: usize| <[u8; 4]>::try_from(&bytes[4 * index..][..4]).expect("expected four bytes");
    let mut different_pixels = 0;
    for hit in &picks.hits {
        // The picture is 96 pixels wide.
        let index = (hit.pixel[1] * 96 + hit.pixel[0]) as usize;
        let is_same_domain = u32::from_le_bytes(read_word(&domains.bytes, index)) == hit.domain;
        let depth_error = (f64::from(f32::from_le_bytes(read_word(&depth.bytes, index))) / hit.depth - 1.0).abs();
        let normal = (0..3).map(|axis| f64::from(f32::from_le_bytes(read_word(&normals.bytes, 3 * index + axis))));
        let normal_error =
            normal.zip(hit.normal).map(|(actual, expected)| (actual - expected).abs()).fold(0.0, f64::max);
        different_pixels += usize::from(!(is_same_domain && depth_error < 1e-5 && normal_error < 1e-5));
    }
    // At an edge, the pass for picks and the pass for frames may draw different triangles.
    assert!(
        picks.hits.len() > 1000 && different_pixels <= 3,
        "{different_pixels} of {} pixels differ",
        picks.hits.len()
    );
    let color = render(Output::Color).await.bytes;
    // `scale_max` is the value at the bright end of the color map; 0 means the maximum of the frame.
    let maps = [
        render(Output::Displacement { scale_max: 0.0 }).await,
        render(Output::Displacement { scale_max: 9.0 }).await,
        render(Output::ModeShape { mode: 0, scale_max: 0.0 }).await,
        render(Output::ModeShape { mode: 1, scale_max: 0.0 }).await,
    ];
    for (index, map) in maps.iter().enumerate() {
        assert_eq!(
            (map.format, image::load_from_memory(&map.bytes).expect("expected a PNG file").width()),
            (FrameFormat::Png, 96)
        );
        assert!(map.bytes != color && maps[..index].iter().all(|other| other.bytes != map.bytes), "map {index}");
    }
}

/// The domains are 10,000 km apart along x and along z. A camera 3 m from a domain picks positions that are exact to 1
/// mm.
#[tokio::test(flavor = "multi_thread")]
async fn distant_domains_are_picked_by_nearby_cameras() {
    let (server, client) = start_server("strips").await;
    let translation = [1e7 + 1.25, 0.0, -1e7];
    let far_step = rigid_step(1, v1::TransformFormat::QuaternionXyzwF64, &[(1, IDENTITY_QUATERNION, translation)]);
    server.drive_lossless("strips").await.send_step_and_wait(far_step).await;
    // The third pick repeats the first one after a pick by a distant camera.
    for (domain, center) in [(1, translation), (0, [0.0; 3]), (1, translation)] {
        let offset_point = |x: f64, y: f64, z: f64| [center[0] + x, center[1] + y, center[2] + z];
        let view = View::LookAt {
            eye: offset_point(0.4, 0.45, 3.0),
            target: offset_point(0.4, 0.45, 0.0),
            up: Some([0.0, 1.0, 0.0]),
        };
        let camera = Some(Camera { view, lens: Lens::FieldOfView(40.0), clip: None });
        let picture = Picture { width: 65, height: 65, camera, ..Picture::default() };
        let hits = client
            .pick(&PickRequest::new("strips", PickRectangle::pixel(picture, 32, 32)))
            .await
            .expect("expected a pick")
            .hits;
        let distance = (Vector3::from(hits[0].position) - Vector3::from(offset_point(0.4, 0.45, 0.0))).norm();
        assert!(
            hits[0].domain == domain && distance < 1e-3,
            "expected domain {domain} at the target, got a distance of {distance} units and {hits:?}"
        );
    }
}
