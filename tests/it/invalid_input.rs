//! Invalid input: each case is refused with field, expected and given. The stream stays open, and other clients are not
//! affected.

use modalcast_proto::v1;
use prost::Message as _;
use sha2::{Digest as _, Sha256};
use tonic::Code;
use v1::Policy;
use v1::drive_scene_request::Kind as RequestKind;
use v1::drive_scene_response::Kind as ResponseKind;
use v1::upload_scene_request::Part;

use crate::service_harness::{
    Driver, Server, get_vertices, reference_vertices, rejection_details, rigid_step, step, strips, with_timeout,
};

/// An invalid step: the name of the case, the step, and the prefixes of field, expected and given.
type BadStep = (&'static str, v1::Step, [&'static str; 3]);

/// The identity rotation as a quaternion x y z w.
const UPRIGHT: [f32; 4] = [0.0, 0.0, 0.0, 1.0];

fn bad_steps() -> Vec<BadStep> {
    let transforms = |domains: &[u32], numbers: &[f32]| v1::Step {
        transform_domains: domains.to_vec(),
        transforms: numbers.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into(),
        ..step(11, &[], &[])
    };
    let mut infinite = [1.0; 12];
    infinite[7] = f32::INFINITY;
    let mut odd = step(11, &[0], &[0.0, 0.0]);
    odd.q = odd.q.slice(..7);
    let timeless = v1::Step { time: f64::NAN, ..step(11, &[0], &[0.0, 0.0]) };
    vec![
        ("q too short", step(11, &[1], &[0.5]), ["step.q of domain 'right'", "8 bytes (2 coordinates)", "4 bytes"]),
        ("q too long", step(11, &[0], &[0.5; 3]), ["step.q of domain 'left'", "8 bytes (2 coordinates)", "12 bytes"]),
        ("q of all, too short", step(11, &[], &[0.5; 3]), ["step.q", "16 bytes (4 coordinates)", "12 bytes"]),
        ("q cut within a number", odd, ["step.q of domain 'left'", "8 bytes", "7 bytes"]),
        ("NaN in q", step(11, &[0], &[0.0, f32::NAN]), ["step.q of domain 'left', mode 1", "a finite number", "NaN"]),
        (
            "infinity in q",
            step(11, &[1], &[f32::INFINITY, 0.0]),
            ["step.q of domain 'right', mode 0", "a finite", "inf"],
        ),
        (
            "q that overflows",
            step(11, &[1], &[f32::MAX, 0.0]),
            ["step.q of domain 'right'", "q and transform", "vertex"],
        ),
        ("no such domain, q", step(11, &[0, 2], &[0.0; 4]), ["step.q_domains[1]", "an index below 2", "2"]),
        ("no such domain, T", transforms(&[9], &[0.0; 12]), ["step.transform_domains[0]", "an index below 2", "9"]),
        ("a domain twice, q", step(11, &[1, 1], &[0.0; 4]), ["step.q_domains[1]", "an index that was not named", "1"]),
        (
            "a domain twice, T",
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
            transforms(&[1], &infinite),
            ["step.transforms of domain 'right': transform[7]", "a finite", "inf"],
        ),
        ("NaN time", timeless, ["step.time", "a finite number", "NaN"]),
        ("a number that goes back", step(9, &[0], &[0.0; 2]), ["step.number", "a number above 10", "9"]),
        ("a number that comes again", step(10, &[0], &[0.0; 2]), ["step.number", "a number above 10", "10"]),
    ]
}

/// Invalid steps in the rigid transform formats, and steps with a format that does not match their bytes.
fn bad_formats() -> Vec<BadStep> {
    let bytes = |format: i32| v1::Step {
        transform_domains: vec![0],
        transforms: vec![0; 48].into(),
        transform_format: format,
        ..step(11, &[], &[])
    };
    let misnamed = |format: v1::TransformFormat| bytes(format.into());
    let overflow = rigid_step(11, v1::TransformFormat::RigidF64, &[(0, UPRIGHT, [1e7; 3]), (1, UPRIGHT, [1e7; 3])]);
    let overflow = v1::Step { q_domains: vec![1], q: step(11, &[1], &[f32::MAX, 0.0]).q, ..overflow };
    vec![
        ("a format of no version", bytes(9), ["step.transform_format", "a format of this version", "9"]),
        ("48 bytes as 28", misnamed(v1::TransformFormat::RigidF32), ["step.transforms", "28 bytes (1 tr", "48 bytes"]),
        ("48 bytes as 40", misnamed(v1::TransformFormat::RigidF64), ["step.transforms", "40 bytes (1 tr", "48 bytes"]),
        (
            "no rotation",
            rigid_step(11, v1::TransformFormat::RigidF32, &[(1, [0.0; 4], [0.0; 3])]),
            ["step.transforms of domain 'right': rotation", "a quaternion x y z w of norm 1", "norm 0"],
        ),
        (
            "twice a rotation",
            rigid_step(11, v1::TransformFormat::RigidF64, &[(0, [0.0, 2.0, 0.0, 0.0], [0.0; 3])]),
            ["step.transforms of domain 'left': rotation", "a quaternion x y z w of norm 1", "norm 2"],
        ),
        (
            "NaN in a quaternion",
            rigid_step(11, v1::TransformFormat::RigidF64, &[(1, [0.0, f32::NAN, 0.0, 1.0], [0.0; 3])]),
            ["step.transforms of domain 'right': rotation[1]", "a finite", "NaN"],
        ),
        (
            "infinity in an f32 translation",
            rigid_step(11, v1::TransformFormat::RigidF32, &[(0, UPRIGHT, [0.0, 1e300, 0.0])]),
            ["step.transforms of domain 'left': translation[1]", "a finite", "inf"],
        ),
        (
            "infinity in an f64 translation",
            rigid_step(11, v1::TransformFormat::RigidF64, &[(0, UPRIGHT, [0.0, 0.0, f64::NEG_INFINITY])]),
            ["step.transforms of domain 'left': translation[2]", "a finite", "-inf"],
        ),
        (
            "an f64 translation beyond all worlds",
            rigid_step(11, v1::TransformFormat::RigidF64, &[(1, UPRIGHT, [-1e300, 0.0, 0.0])]),
            ["step.transforms of domain 'right': translation[0]", "at most 1.09", "-1000000000"],
        ),
        ("q that overflows far away", overflow, ["step.q of domain 'right'", "q and transform", "vertex"]),
    ]
}

fn begins(rejection: &v1::Rejection, [field, expected, given]: [&str; 3]) -> bool {
    rejection.field.starts_with(field) && rejection.expected.starts_with(expected) && rejection.given.starts_with(given)
}

/// Every invalid step is refused by field and leaves the state unchanged. The same stream and the stream of another
/// client continue.
#[tokio::test(flavor = "multi_thread")]
async fn bad_steps_are_refused_and_the_stream_stays_open() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let request = v1::OpenSceneRequest { source: "strips".into(), scene: "other".into() };
    server.scenes().await.open_scene(request).await.expect("opens");
    let mut other = server.drive("other", Policy::Lossless, 0).await;
    let mut driver = server.drive("strips", Policy::Lossless, 0).await;
    let good = step(10, &[], &[0.1, 0.2, 0.3, 0.4]);
    driver.step_acknowledged(good.clone()).await;
    let want = reference_vertices(&strips(), &[good]);
    let ask = v1::GetVerticesRequest { scene: "strips".into(), ..v1::GetVerticesRequest::default() };
    // The server keeps the number of a step that it refused for overflow, so the numbers of the following steps
    // increase.
    for (index, (name, mut bad, refusal)) in bad_steps().into_iter().chain(bad_formats()).enumerate() {
        let goes_back = bad.number < 11;
        bad.number += if goes_back { 0 } else { index as u64 };
        let number = bad.number;
        driver.step(bad).await;
        let rejection = driver.rejection().await;
        let refusal = if goes_back { [refusal[0], "a number above", refusal[2]] } else { refusal };
        assert!(begins(&rejection, refusal), "{name}: {rejection:?}");
        assert_eq!(rejection.step, Some(number), "{name}");
        let got = get_vertices(&server, ask.clone()).await.expect("vertices");
        assert_eq!((got.step().number, &got.positions, &got.normals), (10, &want.0, &want.1), "{name}");
        assert_eq!((got.head.origin.as_slice(), got.origins.len()), ([0.0; 3].as_slice(), 0), "{name}");
        other.step_acknowledged(step(index as u64, &[0], &[0.5, 0.5])).await;
    }
    driver.step_acknowledged(step(1000, &[0], &[0.0, 0.0])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn stream_opens_after_refused_openings() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut driver = Driver::connect(server.channel().await).await;
    driver.step(step(1, &[], &[])).await;
    assert!(begins(&driver.rejection().await, ["kind", "open, before any step", "a step"]));
    let ResponseKind::Rejection(unknown) = driver.open("nowhere", Policy::Lossless, 0).await else { panic!("opened") };
    assert!(begins(&unknown, ["scene", "a scene that is there", "'nowhere'"]), "{unknown:?}");
    let open = v1::OpenDrive { scene: "strips".into(), policy: 77, window: 0 };
    driver.send(RequestKind::Open(open)).await;
    assert!(begins(&driver.rejection().await, ["open.policy", "a policy of this version", "77"]));
    assert!(matches!(driver.open("strips", Policy::Lossless, 0).await, ResponseKind::Opened(_)));
    let ResponseKind::Rejection(again) = driver.open("strips", Policy::Lossless, 0).await else {
        panic!("opened twice")
    };
    assert!(begins(&again, ["open", "one open per stream", "a second"]), "{again:?}");
    driver.step_acknowledged(step(0, &[0], &[0.0, 0.0])).await;
}

/// The scene keeps its last good step, and the other stream on the same connection continues.
#[tokio::test(flavor = "multi_thread")]
async fn oversized_message_ends_only_its_own_stream() {
    let server = Server::start_with(|config| modalcast::config::Config { message_bytes: 64 << 10, ..config }).await;
    server.open("strips").await;
    // Both streams share one connection.
    let channel = server.channel().await;
    let request = v1::OpenSceneRequest { source: "strips".into(), scene: "other".into() };
    server.scenes().await.open_scene(request).await.expect("opens");
    let mut other = Driver::connect(channel.clone()).await;
    assert!(matches!(other.open("other", Policy::Lossless, 0).await, ResponseKind::Opened(_)));
    let mut driver = Driver::connect(channel).await;
    assert!(matches!(driver.open("strips", Policy::Lossless, 0).await, ResponseKind::Opened(_)));
    let good = step(1, &[0], &[0.5, 0.25]);
    driver.step_acknowledged(good.clone()).await;
    driver.step(step(2, &[0], &vec![0.0; 20_000])).await;
    let end = with_timeout(driver.replies.message()).await.expect_err("a fault of transport");
    assert_eq!(end.code(), Code::ResourceExhausted);
    assert_eq!(rejection_details(&end).expected, "at most 65536 bytes");
    let ask = v1::GetVerticesRequest { scene: "strips".into(), ..v1::GetVerticesRequest::default() };
    let got = get_vertices(&server, ask).await.expect("vertices");
    assert_eq!((got.step().number, got.positions), (1, reference_vertices(&strips(), &[good]).0));
    other.step_acknowledged(step(1, &[0], &[0.5, 0.5])).await;
    let mut next = server.drive("strips", Policy::Lossless, 0).await;
    next.step_acknowledged(step(0, &[0], &[0.0, 0.0])).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn bad_requests_are_refused_with_code_and_details() {
    let server = Server::start_default().await;
    server.open("strips").await;
    let mut scenes = server.scenes().await;
    let mut refuse = Vec::new();
    let selection = Some(v1::VertexSelection { domains: vec![0, 5], ..Default::default() });
    let ask = v1::GetVerticesRequest { scene: "strips".into(), selection, ..v1::GetVerticesRequest::default() };
    let status = get_vertices(&server, ask).await.expect_err("expected an unknown-domain error");
    refuse.push((status, Code::InvalidArgument, ["selection.domains[1]", "an index below 2", "5"]));
    let ask = v1::GetVerticesRequest { scene: "nowhere".into(), ..v1::GetVerticesRequest::default() };
    let status = get_vertices(&server, ask).await.expect_err("expected an unknown-scene error");
    refuse.push((status, Code::NotFound, ["scene", "a scene", "'nowhere'"]));
    let request = v1::ReadModesRequest { scene: "strips".into(), domain: 2, vertices: vec![] };
    let status = scenes.read_modes(request).await.expect_err("expected an unknown-domain error");
    refuse.push((status, Code::InvalidArgument, ["domain", "an index below 2", "2"]));
    let request = v1::ReadModesRequest { scene: "strips".into(), domain: 0, vertices: vec![0, 4] };
    let status = scenes.read_modes(request).await.expect_err("no such vertex");
    refuse.push((status, Code::InvalidArgument, ["vertices[1]", "an index below 4", "4"]));
    let request = v1::DescribeSceneRequest { scene: "strips".into(), domains: vec![7], arrays: vec![] };
    let status = scenes.describe_scene(request).await.expect_err("expected an unknown-domain error");
    refuse.push((status, Code::InvalidArgument, ["domains[0]", "an index below 2", "7"]));
    let request = v1::DescribeSceneRequest { scene: "strips".into(), domains: vec![], arrays: vec![99] };
    let status = scenes.describe_scene(request).await.expect_err("no such array");
    refuse.push((status, Code::InvalidArgument, ["arrays", "arrays of this version", "99"]));
    let request = v1::OpenSceneRequest { source: "nothing".into(), scene: String::new() };
    let status = scenes.open_scene(request).await.expect_err("expected an unknown-source error");
    refuse.push((status, Code::NotFound, ["scene", "a scene", "nothing"]));
    let request = v1::OpenSceneRequest { source: "strips".into(), scene: "../x".into() };
    let status = scenes.open_scene(request).await.expect_err("no such name");
    refuse.push((status, Code::InvalidArgument, ["scene", "1 to 64 of", "\"../x\""]));
    let request = v1::OpenSceneRequest { source: "sheet".into(), scene: "strips".into() };
    let status = scenes.open_scene(request).await.expect_err("another source");
    refuse.push((status, Code::AlreadyExists, ["the name of the scene", "nobody", "'strips' is strips"]));
    let request = v1::DeleteSceneRequest { scene: "nowhere".into() };
    let status = scenes.delete_scene(request).await.expect_err("expected an unknown-scene error");
    refuse.push((status, Code::NotFound, ["scene", "a scene", "'nowhere'"]));
    for (status, code, refusal) in refuse {
        assert_eq!(status.code(), code, "{status:?}");
        assert!(begins(&rejection_details(&status), refusal), "{:?} is not {refusal:?}", rejection_details(&status));
    }
    let request = v1::OpenSceneRequest { source: "panic".into(), scene: String::new() };
    let status = scenes.open_scene(request).await.expect_err("a loader that panics");
    assert_eq!(status.code(), Code::Internal);
    server.open("strips").await;
}

/// An upload of one file, `scene.txt`. Tests modify it to make it invalid.
fn upload(contents: &[u8]) -> Vec<Part> {
    let header =
        v1::UploadHeader { scene: "up".into(), entry: String::new(), files: 1, total_bytes: contents.len() as u64 };
    let sha256 = Sha256::digest(contents).to_vec().into();
    let file = v1::UploadFile { path: "scene.txt".into(), bytes: contents.len() as u64, sha256 };
    vec![Part::Header(header), Part::File(file), Part::Chunk(contents.to_vec().into())]
}

async fn send(server: &Server, parts: Vec<Part>) -> Result<v1::UploadSceneResponse, tonic::Status> {
    let requests = parts.into_iter().map(|part| v1::UploadSceneRequest { part: Some(part) }).collect::<Vec<_>>();
    let sent = server.scenes().await.upload_scene(tokio_stream::iter(requests)).await;
    sent.map(tonic::Response::into_inner)
}

fn spoilt(change: impl FnOnce(&mut v1::UploadHeader, &mut v1::UploadFile)) -> Vec<Part> {
    let mut parts = upload(b"strips");
    if let [Part::Header(header), Part::File(file), _] = parts.as_mut_slice() {
        change(header, file);
    }
    parts
}

#[tokio::test(flavor = "multi_thread")]
async fn bad_uploads_are_refused_and_leave_no_files() {
    let server = Server::start_with(|config| modalcast::config::Config { upload_bytes: 1000, ..config }).await;
    let uploads = server.engine.config().state.join("uploads");
    let path = |path: &'static str| spoilt(move |_, file| file.path = path.into());
    let table: Vec<(&str, Vec<Part>, [&str; 3])> = vec![
        ("nothing at all", vec![], ["part", "a header first", "nothing"]),
        ("no header", upload(b"strips").split_off(1), ["part", "a header first", "a file or chunk"]),
        (
            "a hash that differs",
            spoilt(|_, file| file.sha256 = vec![7; 32].into()),
            ["file.sha256 of 'scene.txt'", "0707", ""],
        ),
        ("no hash", spoilt(|_, file| file.sha256 = vec![7; 3].into()), ["file.sha256", "32 bytes", "3 bytes"]),
        ("out of the folder", path("../scene.txt"), ["file.path", "a relative path", "\"../scene.txt\""]),
        ("absolute", path("/etc/scene.txt"), ["file.path", "a relative path", "\"/etc/scene.txt\""]),
        ("backslashes", path("..\\scene.txt"), ["file.path", "a relative path", ""]),
        ("truncated", upload(b"strips")[..2].to_vec(), ["file.bytes of 'scene.txt'", "6 bytes", "0 bytes"]),
        ("too few bytes announced", spoilt(|header, _| header.total_bytes = 5), ["header.total_bytes", "5", "6"]),
        (
            "more than the limit",
            spoilt(|header, _| header.total_bytes = 1001),
            ["header.total_bytes", "at most 1000", "1001"],
        ),
        ("a file too few", spoilt(|header, _| header.files = 2), ["header.files", "2", "1"]),
        ("a bad name", spoilt(|header, _| header.scene = "a/b".into()), ["scene", "1 to 64", "\"a/b\""]),
        (
            "a bad entry",
            spoilt(|header, _| header.entry = "../x".into()),
            ["header.entry", "a relative path", "\"../x\""],
        ),
        ("an entry that is not there", spoilt(|header, _| header.entry = "x".into()), ["entry", "a file", ""]),
        ("no scene in it", upload(b"lunch"), ["scene", "a scene", "lunch"]),
    ];
    for (name, parts, refusal) in table {
        let status = send(&server, parts).await.expect_err(name);
        assert!(begins(&rejection_details(&status), refusal), "{name}: {:?}", rejection_details(&status));
        assert_eq!(
            std::fs::read_dir(&uploads).expect("expected a temporary folder").count(),
            0,
            "{name} left something"
        );
    }
    send(&server, upload(b"strips")).await.expect("a good one under the same name");
    let status = send(&server, upload(b"strips")).await.expect_err("the name is taken");
    assert_eq!(status.code(), Code::AlreadyExists);
    assert!(uploads.join("up/scene.txt").exists());
    let delete = v1::DeleteSceneRequest { scene: "up".into() };
    server.scenes().await.delete_scene(delete).await.expect("expected the deletion to succeed");
    assert_eq!(std::fs::read_dir(&uploads).expect("expected a temporary folder").count(), 0);
}

/// Status details travel in an HTTP/2 header, so a refusal of a very long input is truncated.
#[tokio::test(flavor = "multi_thread")]
async fn refusal_details_fit_into_a_header() {
    let server = Server::start_default().await;
    let request = v1::OpenSceneRequest { source: "x".repeat(500_000), scene: "name".into() };
    let status = server.scenes().await.open_scene(request).await.expect_err("expected an unknown-source error");
    assert_eq!(status.code(), Code::NotFound);
    assert!(rejection_details(&status).encoded_len() < 4096);
}
