//! Every invalid message is answered with a rejection that names the field, the expected and the received value. The
//! stream stays open, and other clients are not affected.

use modalcast_proto::v1;
use sha2::{Digest as _, Sha256};
use tonic::Code;
use v1::Delivery;
use v1::drive_scene_request::Kind as RequestKind;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::upload_scene_request::Part;

use crate::service_harness::{
    DEFAULT_WINDOW, Server, StepWriter, get_vertices, reference_vertices, rejection_details, rigid_step, step, strips,
    with_timeout,
};

/// The name of a case, an invalid step, the field of its rejection, and the prefixes of `expected` and `given`.
type InvalidStep = (&'static str, v1::Step, [&'static str; 3]);

/// The identity rotation as a quaternion x y z w.
const IDENTITY_QUATERNION: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

/// Invalid steps of the scene `strips`, whose two domains have two modes each. "T" in the names is a transform. The
/// last valid step has the number 10.
fn invalid_steps() -> Vec<InvalidStep> {
    let transforms = |domains: &[u32], numbers: &[f32]| v1::Step {
        transform_domains: domains.to_vec(),
        transforms: numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into(),
        ..step(11, &[], &[])
    };
    let mut infinite_transform = [1.0; 12];
    infinite_transform[7] = f32::INFINITY;
    let mut truncated_q = step(11, &[0], &[0.0, 0.0]);
    truncated_q.q = truncated_q.q.slice(..7);
    let nan_time = v1::Step { time: f64::NAN, ..step(11, &[0], &[0.0, 0.0]) };
    vec![
        ("q too short", step(11, &[1], &[0.5]), ["step.q", "8 bytes (2 coordinates of domain 'right')", "4 bytes"]),
        ("q too long", step(11, &[0], &[0.5; 3]), ["step.q", "8 bytes (2 coordinates of domain 'left')", "12 bytes"]),
        ("q of all domains is too short", step(11, &[], &[0.5; 3]), ["step.q", "16 bytes (4 coordinates)", "12 bytes"]),
        ("q cut within a number", truncated_q, ["step.q", "8 bytes", "7 bytes"]),
        (
            "NaN in q",
            step(11, &[0], &[0.0, f32::NAN]),
            ["step.q[1]", "a finite number", "NaN for mode 1 of domain 'left'"],
        ),
        (
            "infinity in q",
            step(11, &[1], &[f32::INFINITY, 0.0]),
            ["step.q[0]", "a finite", "inf for mode 0 of domain 'right'"],
        ),
        ("q moves a vertex beyond 1e18", step(11, &[1], &[f32::MAX, 0.0]), ["step.q", "q and transform", "vertex"]),
        ("unknown domain in q", step(11, &[0, 2], &[0.0; 4]), ["step.q_domains[1]", "an index below 2", "2"]),
        ("unknown domain in T", transforms(&[9], &[0.0; 12]), ["step.transform_domains[0]", "an index below 2", "9"]),
        (
            "repeated domain in q",
            step(11, &[1, 1], &[0.0; 4]),
            ["step.q_domains[1]", "an index that was not named", "1"],
        ),
        (
            "repeated domain in T",
            transforms(&[0, 0], &[0.0; 24]),
            ["step.transform_domains[1]", "an index that was not named", "0"],
        ),
        ("too many domains, q", step(11, &[0, 1, 0], &[0.0; 6]), ["step.q_domains", "at most 2 indices", "3"]),
        (
            "too many domains, T",
            transforms(&[0, 1, 0], &[0.0; 36]),
            ["step.transform_domains", "at most 2 indices", "3"],
        ),
        ("T too short", transforms(&[0], &[0.0; 11]), ["step.transforms", "48 bytes", "44 bytes"]),
        (
            "infinity in T",
            transforms(&[1], &infinite_transform),
            ["step.transforms[0].transform[7]", "a finite", "inf"],
        ),
        ("NaN time", nan_time, ["step.time", "a finite number", "NaN"]),
        ("decreasing step number", step(9, &[0], &[0.0; 2]), ["step.number", "a number above 10", "9"]),
        ("repeated step number", step(10, &[0], &[0.0; 2]), ["step.number", "a number above 10", "10"]),
    ]
}

/// Invalid steps in the rigid transform formats, and steps whose bytes do not match their format.
fn invalid_transform_steps() -> Vec<InvalidStep> {
    let step_with_format = |format: i32| v1::Step {
        transform_domains: vec![0],
        // The size of an affine transform: 12 numbers in f32.
        transforms: vec![0; 48].into(),
        transform_format: format,
        ..step(11, &[], &[])
    };
    let step_with_known_format = |format: v1::TransformFormat| step_with_format(format.into());
    let overflowing_step = rigid_step(
        11,
        v1::TransformFormat::QuaternionXyzwF64,
        &[(0, IDENTITY_QUATERNION, [1e7; 3]), (1, IDENTITY_QUATERNION, [1e7; 3])],
    );
    let overflowing_step = v1::Step { q_domains: vec![1], q: step(11, &[1], &[f32::MAX, 0.0]).q, ..overflowing_step };
    vec![
        ("unknown format", step_with_format(9), ["step.transform_format", "a format of this version", "9"]),
        (
            "affine bytes in format QuaternionXyzwF32",
            step_with_known_format(v1::TransformFormat::QuaternionXyzwF32),
            ["step.transforms", "28 bytes (1 tr", "48 bytes"],
        ),
        (
            "affine bytes in format QuaternionXyzwF64",
            step_with_known_format(v1::TransformFormat::QuaternionXyzwF64),
            ["step.transforms", "40 bytes (1 tr", "48 bytes"],
        ),
        (
            "zero quaternion",
            rigid_step(11, v1::TransformFormat::QuaternionXyzwF32, &[(1, [0.0; 4], [0.0; 3])]),
            ["step.transforms[0].rotation", "a quaternion x y z w of norm 1", "norm 0"],
        ),
        (
            "quaternion of norm 2",
            rigid_step(11, v1::TransformFormat::QuaternionXyzwF64, &[(0, [0.0, 2.0, 0.0, 0.0], [0.0; 3])]),
            ["step.transforms[0].rotation", "a quaternion x y z w of norm 1", "norm 2"],
        ),
        (
            "NaN in a quaternion",
            rigid_step(11, v1::TransformFormat::QuaternionXyzwF64, &[(1, [0.0, f32::NAN, 0.0, 1.0], [0.0; 3])]),
            ["step.transforms[0].rotation[1]", "a finite", "NaN"],
        ),
        (
            "infinity in an f32 translation",
            rigid_step(11, v1::TransformFormat::QuaternionXyzwF32, &[(0, IDENTITY_QUATERNION, [0.0, 1e300, 0.0])]),
            ["step.transforms[0].translation[1]", "a finite", "inf"],
        ),
        (
            "infinity in an f64 translation",
            rigid_step(
                11,
                v1::TransformFormat::QuaternionXyzwF64,
                &[(0, IDENTITY_QUATERNION, [0.0, 0.0, f64::NEG_INFINITY])],
            ),
            ["step.transforms[0].translation[2]", "a finite", "-inf"],
        ),
        (
            "f64 translation above the limit",
            rigid_step(11, v1::TransformFormat::QuaternionXyzwF64, &[(1, IDENTITY_QUATERNION, [-1e300, 0.0, 0.0])]),
            ["step.transforms[0].translation[0]", "at most 1.09", "-1000000000"],
        ),
        ("q moves a vertex of a far scene beyond 1e18", overflowing_step, ["step.q", "q and transform", "vertex"]),
    ]
}

fn matches_texts(rejection: &v1::Rejection, [field, expected, given]: [&str; 3]) -> bool {
    rejection.field == field && rejection.expected.starts_with(expected) && rejection.given.starts_with(given)
}

/// Every invalid step is rejected with its field and leaves the state unchanged. The same stream and the stream of
/// another client continue.
#[tokio::test(flavor = "multi_thread")]
async fn stream_stays_open_after_invalid_steps() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let request = v1::OpenSceneRequest { source: "strips".into(), scene: "other".into() };
    server.scenes().await.open_scene(request).await.expect("expected the scene to open");
    let mut other_writer = server.drive_lossless("other").await;
    let mut writer = server.drive_lossless("strips").await;
    let valid_step = step(10, &[], &[0.1, 0.2, 0.3, 0.4]);
    writer.send_step_and_wait(valid_step.clone()).await;
    let expected_vertices = reference_vertices(&strips(), &[valid_step]);
    let request = v1::GetVerticesRequest { scene: "strips".into(), ..v1::GetVerticesRequest::default() };
    // A step that moves a vertex beyond 1e18 is rejected, but its number counts as used. So the numbers increase from
    // case to case.
    for (index, (name, mut invalid_step, prefixes)) in
        invalid_steps().into_iter().chain(invalid_transform_steps()).enumerate()
    {
        // The two cases that test a number that is too low keep their number. The limit in their rejection depends on
        // the earlier cases.
        let is_decreasing = invalid_step.number < 11;
        invalid_step.number += if is_decreasing { 0 } else { index as u64 };
        let number = invalid_step.number;
        writer.send_step(invalid_step).await;
        let rejection = writer.receive_rejection().await;
        let prefixes = if is_decreasing { [prefixes[0], "a number above", prefixes[2]] } else { prefixes };
        assert!(matches_texts(&rejection, prefixes), "{name}: {rejection:?}");
        assert_eq!(rejection.step, Some(number), "{name}");
        let reply = get_vertices(&server, request.clone()).await.expect("expected vertices");
        assert_eq!(
            (reply.step().number, &reply.positions, &reply.normals),
            (10, &expected_vertices.positions, &expected_vertices.normals),
            "{name}"
        );
        assert_eq!(reply.origins, [0.0; 3], "{name}: expected the origin of a scene that has not moved");
        other_writer.send_step_and_wait(step(index as u64, &[0], &[0.5, 0.5])).await;
    }
    // 1000 is above the numbers of all invalid steps.
    writer.send_step_and_wait(step(1000, &[0], &[0.0, 0.0])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_opens_after_rejected_openings() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut writer = StepWriter::connect(server.channel().await).await;
    writer.send_step(step(1, &[], &[])).await;
    assert!(matches_texts(&writer.receive_rejection().await, ["", "open before the first step", "a step"]));
    let ResponseKind::Rejection(unknown_scene) = writer.open("nowhere", Delivery::Lossless, DEFAULT_WINDOW).await
    else {
        panic!("expected a rejection of an unknown scene")
    };
    assert!(matches_texts(&unknown_scene, ["", "an existing scene", "'nowhere'"]), "{unknown_scene:?}");
    let open = v1::OpenDrive { scene: "strips".into(), delivery: 77, ..v1::OpenDrive::default() };
    writer.send(RequestKind::Open(open)).await;
    assert!(matches_texts(&writer.receive_rejection().await, ["open.delivery", "a delivery of this version", "77"]));
    assert!(matches!(writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)));
    let ResponseKind::Rejection(second_open) = writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await else {
        panic!("expected a rejection of a second open message")
    };
    assert!(matches_texts(&second_open, ["", "one open per stream", "a second open"]), "{second_open:?}");
    writer.send_step_and_wait(step(0, &[0], &[0.0, 0.0])).await;
}

/// An oversized message does not affect the last valid step of its scene, or another stream on the same connection.
#[tokio::test(flavor = "multi_thread")]
async fn oversized_message_ends_only_its_own_stream() {
    let server = Server::start_with(|config| modalcast::config::Config { message_bytes: 65536, ..config }).await;
    server.open("strips").await;
    let channel = server.channel().await;
    let request = v1::OpenSceneRequest { source: "strips".into(), scene: "other".into() };
    server.scenes().await.open_scene(request).await.expect("expected the scene to open");
    let mut other_writer = StepWriter::connect(channel.clone()).await;
    assert!(matches!(other_writer.open("other", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)));
    let mut writer = StepWriter::connect(channel).await;
    assert!(matches!(writer.open("strips", Delivery::Lossless, DEFAULT_WINDOW).await, ResponseKind::Opened(_)));
    let valid_step = step(1, &[0], &[0.5, 0.25]);
    writer.send_step_and_wait(valid_step.clone()).await;
    // 80,000 bytes of coordinates.
    writer.send_step(step(2, &[0], &vec![0.0; 20_000])).await;
    let status = with_timeout(writer.replies.message()).await.expect_err("expected the stream to end with an error");
    assert_eq!(status.code(), Code::ResourceExhausted);
    assert_eq!(rejection_details(&status).expected, "at most 65536 bytes");
    let request = v1::GetVerticesRequest { scene: "strips".into(), ..v1::GetVerticesRequest::default() };
    let reply = get_vertices(&server, request).await.expect("expected vertices");
    assert_eq!((reply.step().number, reply.positions), (1, reference_vertices(&strips(), &[valid_step]).positions));
    other_writer.send_step_and_wait(step(1, &[0], &[0.5, 0.5])).await;
    let mut second_writer = server.drive_lossless("strips").await;
    second_writer.send_step_and_wait(step(0, &[0], &[0.0, 0.0])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_requests_return_code_and_details() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut scenes = server.scenes().await;
    // Status, expected code, and prefixes of the fields `field`, `expected` and `given` of the rejection.
    let mut rejected_calls = Vec::new();
    let selection = Some(v1::VertexSelection { domains: vec![0, 5], ..Default::default() });
    let request = v1::GetVerticesRequest { scene: "strips".into(), selection, ..v1::GetVerticesRequest::default() };
    let status = get_vertices(&server, request).await.expect_err("expected an unknown-domain error");
    rejected_calls.push((status, Code::InvalidArgument, ["selection.domains[1]", "an index below 2", "5"]));
    let request = v1::GetVerticesRequest { scene: "nowhere".into(), ..v1::GetVerticesRequest::default() };
    let status = get_vertices(&server, request).await.expect_err("expected an unknown-scene error");
    rejected_calls.push((status, Code::NotFound, ["", "an existing scene", "'nowhere'"]));
    let request = v1::ReadModesRequest { scene: "strips".into(), domain: 2, vertices: vec![] };
    let status = scenes.read_modes(request).await.expect_err("expected an unknown-domain error");
    rejected_calls.push((status, Code::InvalidArgument, ["domain", "an index below 2", "2"]));
    let request = v1::ReadModesRequest { scene: "strips".into(), domain: 0, vertices: vec![0, 4] };
    let status = scenes.read_modes(request).await.expect_err("expected an unknown-vertex error");
    rejected_calls.push((status, Code::InvalidArgument, ["vertices[1]", "an index below 4", "4"]));
    let request = v1::DescribeSceneRequest { scene: "strips".into(), domains: vec![7], ..Default::default() };
    let status = scenes.describe_scene(request).await.expect_err("expected an unknown-domain error");
    rejected_calls.push((status, Code::InvalidArgument, ["domains[0]", "an index below 2", "7"]));
    let request = v1::DescribeSceneRequest { scene: "strips".into(), arrays: vec![99], ..Default::default() };
    let status = scenes.describe_scene(request).await.expect_err("expected an unknown-array error");
    rejected_calls.push((status, Code::InvalidArgument, ["arrays[0]", "an array of this version", "99"]));
    let request = v1::OpenSceneRequest { source: "nothing".into(), scene: String::new() };
    let status = scenes.open_scene(request).await.expect_err("expected an unknown-source error");
    rejected_calls.push((status, Code::NotFound, ["", "an existing scene", "nothing"]));
    let request = v1::OpenSceneRequest { source: "strips".into(), scene: "../x".into() };
    let status = scenes.open_scene(request).await.expect_err("expected an invalid-name error");
    rejected_calls.push((status, Code::InvalidArgument, ["scene", "1 to 64 of", "\"../x\""]));
    let request = v1::OpenSceneRequest { source: "sheet".into(), scene: "strips".into() };
    let status = scenes.open_scene(request).await.expect_err("expected a name conflict");
    rejected_calls.push((
        status,
        Code::AlreadyExists,
        ["", "a free scene name", "'strips', which belongs to 'strips'"],
    ));
    let request = v1::DeleteSceneRequest { scene: "nowhere".into() };
    let status = scenes.delete_scene(request).await.expect_err("expected an unknown-scene error");
    rejected_calls.push((status, Code::NotFound, ["", "an existing scene", "'nowhere'"]));
    for (status, code, prefixes) in rejected_calls {
        assert_eq!(status.code(), code, "{status:?}");
        assert!(
            matches_texts(&rejection_details(&status), prefixes),
            "expected {prefixes:?}, got {:?}",
            rejection_details(&status)
        );
    }
    // A panic in the loader fails only its own call.
    let request = v1::OpenSceneRequest { source: "panic".into(), scene: String::new() };
    let status = scenes.open_scene(request).await.expect_err("expected an internal error");
    assert_eq!(status.code(), Code::Internal);
    server.open("strips").await;
}

/// The messages of a valid upload of one file, `scene.txt`. Its contents name the source to open.
fn upload_parts(contents: &[u8]) -> Vec<Part> {
    let header =
        v1::UploadHeader { scene: "up".into(), entry: String::new(), files: 1, total_bytes: contents.len() as u64 };
    let sha256 = Sha256::digest(contents).to_vec().into();
    let file = v1::UploadFile { path: "scene.txt".into(), bytes: contents.len() as u64, sha256, reuse: false };
    vec![Part::Header(header), Part::File(file), Part::Chunk(contents.to_vec().into())]
}

async fn upload(server: &Server, parts: Vec<Part>) -> Result<v1::UploadSceneResponse, tonic::Status> {
    let requests = parts.into_iter().map(|part| v1::UploadSceneRequest { part: Some(part) }).collect::<Vec<_>>();
    let response = server.scenes().await.upload_scene(tokio_stream::iter(requests)).await;
    response.map(tonic::Response::into_inner)
}

/// An upload of `scene.txt` with the contents "strips", after a change of the header or of the file message.
fn modified_upload(modify: impl FnOnce(&mut v1::UploadHeader, &mut v1::UploadFile)) -> Vec<Part> {
    let mut parts = upload_parts(b"strips");
    if let [Part::Header(header), Part::File(file), _] = parts.as_mut_slice() {
        modify(header, file);
    }
    parts
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_uploads_are_rejected_and_leave_no_files() {
    let server = Server::start_with(|config| modalcast::config::Config { upload_bytes: 1000, ..config }).await;
    let uploads = server.engine.config().state.join("uploads");
    let upload_to = |path: &'static str| modified_upload(move |_, file| file.path = path.into());
    // Name of the case, messages, and prefixes of the fields `field`, `expected` and `given` of the rejection.
    let cases: Vec<(&str, Vec<Part>, [&str; 3])> = vec![
        ("empty stream", vec![], ["", "a header as the first part", "the end of the stream"]),
        ("no header", upload_parts(b"strips").split_off(1), ["", "a header as the first part", "another part"]),
        ("wrong hash", modified_upload(|_, file| file.sha256 = vec![7; 32].into()), ["file.sha256", "0707", ""]),
        (
            "hash of 3 bytes",
            modified_upload(|_, file| file.sha256 = vec![7; 3].into()),
            ["file.sha256", "32 bytes", "3 bytes"],
        ),
        ("path outside of the folder", upload_to("../scene.txt"), ["file.path", "a relative path", "\"../scene.txt\""]),
        ("absolute path", upload_to("/etc/scene.txt"), ["file.path", "a relative path", "\"/etc/scene.txt\""]),
        ("backslash in the path", upload_to("..\\scene.txt"), ["file.path", "a relative path", ""]),
        ("no contents", upload_parts(b"strips")[..2].to_vec(), ["file.bytes", "6 bytes", "0 bytes for 'scene.txt'"]),
        (
            "too few bytes announced",
            modified_upload(|header, _| header.total_bytes = 5),
            ["header.total_bytes", "5", "6"],
        ),
        (
            "more bytes than the limit",
            modified_upload(|header, _| header.total_bytes = 1001),
            ["header.total_bytes", "at most 1000", "1001"],
        ),
        ("fewer files than announced", modified_upload(|header, _| header.files = 2), ["header.files", "2", "1"]),
        ("invalid name", modified_upload(|header, _| header.scene = "a/b".into()), ["scene", "1 to 64", "\"a/b\""]),
        (
            "invalid entry",
            modified_upload(|header, _| header.entry = "../x".into()),
            ["header.entry", "a relative path", "\"../x\""],
        ),
        ("missing entry", modified_upload(|header, _| header.entry = "x".into()), ["", "a file", ""]),
        ("file names an unknown source", upload_parts(b"nothing"), ["", "an existing scene", "nothing"]),
    ];
    for (name, parts, prefixes) in cases {
        let status = upload(&server, parts).await.expect_err(name);
        assert!(matches_texts(&rejection_details(&status), prefixes), "{name}: {:?}", rejection_details(&status));
        assert_eq!(
            std::fs::read_dir(&uploads).expect("expected an uploads folder").count(),
            0,
            "{name}: expected no files"
        );
    }
    upload(&server, upload_parts(b"strips")).await.expect("expected the upload to succeed after rejected ones");
    let status = upload(&server, upload_parts(b"strips")).await.expect_err("expected a name conflict");
    assert_eq!(status.code(), Code::AlreadyExists);
    assert!(uploads.join("up/scene.txt").exists());
    let delete = v1::DeleteSceneRequest { scene: "up".into() };
    server.scenes().await.delete_scene(delete).await.expect("expected the deletion to succeed");
    assert_eq!(std::fs::read_dir(&uploads).expect("expected an uploads folder").count(), 0);
}

/// Status details are sent in an HTTP/2 header, whose size is limited. A rejection that repeats a very long input is
/// truncated.
#[tokio::test(flavor = "multi_thread")]
async fn rejection_details_fit_into_a_header() {
    let server = Server::start_default().await;
    let request = v1::OpenSceneRequest { source: "x".repeat(500_000), scene: "name".into() };
    let status = server.scenes().await.open_scene(request).await.expect_err("expected an unknown-source error");
    assert_eq!(status.code(), Code::NotFound);
    assert!(rejection_details(&status).given.ends_with("..."));
    assert!(status.details().len() + status.message().len() < 4096);
}
