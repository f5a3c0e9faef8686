//! Upload of meshes and modes as arrays: the same vertices as from files, persistence, and rejection of invalid arrays.

use std::path::Path;
use std::sync::Arc;

use modalcast::identity::Principal;
use modalcast_client::{ArrayUpload, Client, Reason, UploadDomain, UploadShape};
use modalcast_model::load::SceneRepository;
use modalcast_proto::v1;
use tonic::Code;
use v1::upload_arrays_request::Part;

use crate::service_harness::{Server, config, get_vertices, rejection_details, step};

/// A transform with entries that have no short decimal representation.
fn placement() -> [f32; 12] {
    let (sine, cosine) = 0.7_f32.sin_cos();
    [cosine, -sine, 0.0, 1.0 / 3.0, sine, cosine, 0.0, 1e-7, 0.0, 0.0, 1.0, -12_345.678]
}

/// A beam of nine square sections along y with two modes. The numbers have no short decimal representation.
struct Beam {
    positions: Vec<[f32; 3]>,
    triangles: Vec<[u32; 3]>,
    modes: Vec<f32>,
}

impl Beam {
    fn new() -> Self {
        let (mut positions, mut modes, mut triangles) = (vec![], vec![], vec![]);
        for section in 0..9_u32 {
            let y = section as f32 / 7.0;
            for corner in 0..4_u32 {
                let (x, z) = [(0.1, 0.1), (-0.1, 0.1), (-0.1, -0.1), (0.1, -0.1)][corner as usize];
                positions.push([x / 3.0, y, z / 7.0]);
                modes.extend([y * y / 3.0, 0.0, -y * x / 11.0, 1e-12 * y, 0.0, y.sin()]);
                if section > 0 {
                    let (lower, upper) = (4 * (section - 1), 4 * section);
                    let next = (corner + 1) % 4;
                    triangles.push([lower + corner, lower + next, upper + corner]);
                    triangles.push([lower + next, upper + next, upper + corner]);
                }
            }
        }
        Self { positions, triangles, modes }
    }

    fn shape(self) -> UploadShape {
        UploadShape::Arrays { positions: self.positions, triangles: self.triangles, rank: 2, modes: self.modes }
    }

    /// The beam as files, with the placements of [`two_beams`].
    fn write_files(&self, folder: &Path) {
        let vertices = self.positions.iter().map(|[x, y, z]| format!("v {x} {y} {z}\n"));
        let faces = self.triangles.iter().map(|face| face.map(|vertex| (vertex + 1).to_string()).join(" "));
        let obj: String = vertices.chain(faces.map(|face| format!("f {face}\n"))).collect();
        // SOFA's text format: numbers of rows and columns, then the rows.
        let rows = self.modes.chunks(2).map(|row| format!("{} {}\n", row[0], row[1]));
        let modes: String = [format!("{} 2\n", 3 * self.positions.len())].into_iter().chain(rows).collect();
        let matrix = placement().map(|entry| format!("{:?}", f64::from(entry))).join(", ");
        let manifest = format!(
            "[[domain]]\nname = 'first'\nmodel = 'beam.obj'\nmodes = 'modes.txt'\nplacement.matrix = [{matrix}]\n\
             [[domain]]\nname = 'second'\nmodel = 'beam.obj'\nmodes = 'modes.txt'\n"
        );
        std::fs::create_dir_all(folder).expect("expected a new folder");
        for (name, text) in [("beam.obj", obj), ("modes.txt", modes), ("scene.toml", manifest)] {
            std::fs::write(folder.join(name), text).expect("expected a written file");
        }
    }
}

/// Two beams of one shape; the first one has a placement, a color and eigenvalues.
fn two_beams() -> ArrayUpload {
    let first = UploadDomain::new("first \"\\ beam", Beam::new().shape());
    let first = first.placement(placement()).color([0.25, 0.5, 1.0 / 3.0]).eigenvalues(&[0.1, 1.0 / 3.0]);
    let second = UploadDomain::new("second", UploadShape::OfDomain(0));
    ArrayUpload::new("arrays").unit(0.01).up("z").domain(first).domain(second)
}

async fn start_server(state_folder: &Path, repository_folder: &Path) -> (Server, Client) {
    let repository = SceneRepository::new(Some(repository_folder)).expect("expected a repository");
    let server = Server::start_from(config(state_folder), Arc::new(repository)).await;
    let client = Client::connect(&server.address).await.expect("expected a connection");
    (server, client)
}

/// The bits of positions and normals.
async fn vertex_bits(server: &Server, scene: &str) -> [Vec<u32>; 2] {
    let request = v1::GetVerticesRequest { scene: scene.into(), ..Default::default() };
    let reply = get_vertices(server, request).await.expect("expected vertices");
    [reply.positions, reply.normals].map(|numbers| numbers.into_iter().map(f32::to_bits).collect())
}

#[tokio::test(flavor = "multi_thread")]
async fn beam_from_arrays_has_the_vertices_of_the_beam_from_files() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (state_folder, repository_folder) = (folder.path().join("state"), folder.path().join("scenes"));
    Beam::new().write_files(&repository_folder.join("files"));
    let (server, client) = start_server(&state_folder, &repository_folder).await;
    let info = client.upload_arrays(two_beams()).await.expect("expected the upload to succeed");
    assert_eq!((info.domains, info.vertices, info.coordinates, info.unit), (2, 72, 4, 0.01));
    assert_eq!((info.up.as_str(), info.remarks.as_slice()), ("z", [].as_slice()));
    let description = client.describe("arrays", &[]).await.expect("expected a description");
    assert_eq!(description.shapes.len(), 1, "expected one shape for both domains");
    let first = &description.domains[0];
    assert_eq!((first.name.as_str(), first.eigenvalues.as_slice()), ("first \"\\ beam", [0.1, 1.0 / 3.0].as_slice()));
    assert_eq!(description.materials[first.material].diffuse, [0.25, 0.5, 1.0 / 3.0]);
    server.open("files").await;
    let rest_bits = vertex_bits(&server, "files").await;
    assert_eq!(vertex_bits(&server, "arrays").await, rest_bits);
    for scene in ["files", "arrays"] {
        let mut writer = server.drive_lossless(scene).await;
        writer.send_step_and_wait(step(1, &[0, 1], &[0.3, -1.1, 0.7, 0.01])).await;
    }
    let driven_bits = vertex_bits(&server, "files").await;
    assert_ne!(driven_bits, rest_bits, "control: expected the step to move the beam");
    assert_eq!(vertex_bits(&server, "arrays").await, driven_bits);
    server.stop().await.expect("expected the server to stop");
    let (server, _) = start_server(&state_folder, &repository_folder).await;
    assert_eq!(vertex_bits(&server, "arrays").await, driven_bits, "expected the scene after a restart");
}

/// A disk that changes a digit of a coordinate must not change the simulation silently.
#[tokio::test(flavor = "multi_thread")]
async fn changed_digit_in_a_stored_file_is_an_error_with_its_name() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let state_folder = folder.path().join("state");
    let (server, client) = start_server(&state_folder, folder.path()).await;
    client.upload_arrays(two_beams()).await.expect("expected the upload to succeed");
    server.stop().await.expect("expected the server to stop");
    let path = state_folder.join("uploads/arrays/0.obj");
    let text = std::fs::read_to_string(&path).expect("expected a stored mesh");
    let changed = text.replacen("v 0.0", "v 0.1", 1);
    assert_ne!(changed, text, "control");
    std::fs::write(&path, &changed).expect("expected a written file");
    let (server, client) = start_server(&state_folder, folder.path()).await;
    client.describe("arrays", &[]).await.expect_err("expected no scene");
    let list = server.scenes().await.list_scenes(v1::ListScenesRequest {}).await.expect("expected a list").into_inner();
    let error = list.failed[0].error.clone().expect("expected an error");
    assert_eq!(error.reason(), Reason::InvalidFile);
    assert_eq!(error.field, "file 'scene.toml': domain 0 ('0.obj'): file '0.obj'");
    assert!(error.expected.starts_with("the uploaded content, SHA-256 "), "{error:?}");
    server.stop().await.expect("expected the server to stop");
    std::fs::write(&path, &text).expect("expected a written file");
    let (_server, client) = start_server(&state_folder, folder.path()).await;
    client.describe("arrays", &[]).await.expect("expected the scene with the uploaded file");
}

/// Every vertex of the beam is on an edge of 90 degrees. The second domain has the shape of the first one. The angle is
/// stored also if it is the default, so that a later default does not change the scene after a restart.
#[tokio::test(flavor = "multi_thread")]
async fn crease_angle_of_arrays_splits_corners_but_no_vertices() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (_server, client) = start_server(&folder.path().join("state"), folder.path()).await;
    for (name, crease_angle, corners) in [("hard", None, 144), ("smooth", Some(180.0), 72), ("flat", Some(89.0), 144)] {
        let first = UploadDomain::new("first", Beam::new().shape());
        let first = crease_angle.map_or(first.clone(), |degrees| first.crease_angle(degrees));
        let second = UploadDomain::new("second", UploadShape::OfDomain(0));
        let upload = ArrayUpload::new(name).domain(first).domain(second);
        let info = client.upload_arrays(upload).await.expect("expected the upload to succeed");
        assert_eq!((info.vertices, info.corners), (72, corners), "{name}");
        let description = client.describe(name, &[]).await.expect("expected a description");
        assert_eq!(description.shapes.len(), 1, "{name}: expected one shape for both domains");
    }
    let uploads = std::fs::read_dir(folder.path().join("state/uploads")).expect("expected uploads");
    let manifests = uploads.map(|entry| entry.expect("expected a folder").path().join("scene.toml"));
    let angles_of = |path: std::path::PathBuf| -> Vec<String> {
        let text = std::fs::read_to_string(path).expect("expected a manifest");
        text.lines().filter_map(|line| line.strip_prefix("crease_angle = ").map(str::to_owned)).collect()
    };
    let mut angles: Vec<Vec<String>> = manifests.map(angles_of).collect();
    angles.sort_unstable();
    assert_eq!(angles, [["180.0"; 2], ["40.0"; 2], ["89.0"; 2]]);
}

/// Sends parts and returns the rejection.
async fn rejected_upload(server: &Server, parts: Vec<Part>) -> (Code, v1::Rejection) {
    let requests: Vec<_> = parts.into_iter().map(|part| v1::UploadArraysRequest { part: Some(part) }).collect();
    let status = server.scenes().await.upload_arrays(tokio_stream::iter(requests)).await;
    let status = status.expect_err("expected a rejection");
    (status.code(), rejection_details(&status))
}

/// A triangle with one mode: 36 bytes of positions, 12 bytes of indices and 36 bytes of U.
fn triangle() -> v1::UploadedDomain {
    v1::UploadedDomain { name: "a".into(), vertices: 3, triangles: 1, rank: 1, ..Default::default() }
}

fn header(domains: u32, total_bytes: u64) -> Part {
    Part::Header(v1::UploadArraysHeader { scene: "sent".into(), domains, total_bytes, ..Default::default() })
}

/// Arrays of [`triangle`] with the given first coordinate, last index and first entry of U.
fn arrays(x: f32, last_index: u32, entry: f32) -> Part {
    let positions = [x, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];
    let modes = [entry, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0];
    let indices = [0, 1, last_index];
    let parts: [&[u8]; 3] = [bytemuck::bytes_of(&positions), bytemuck::bytes_of(&indices), bytemuck::bytes_of(&modes)];
    Part::Chunk(parts.concat().into())
}

/// Asserts that an upload is rejected with this field, expected value and given value.
async fn assert_rejected(server: &Server, parts: Vec<Part>, [field, expected, given]: [&str; 3]) {
    let (code, rejection) = rejected_upload(server, parts).await;
    assert_eq!((code, rejection.reason()), (Code::InvalidArgument, Reason::InvalidField), "{rejection:?}");
    assert_eq!([&rejection.field[..], &rejection.expected[..], &rejection.given[..]], [field, expected, given]);
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_domains_are_rejected_with_their_path() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (server, _) = start_server(&folder.path().join("state"), folder.path()).await;
    type Change = fn(&mut v1::UploadedDomain);
    let cases: [(Change, [&str; 3]); 8] = [
        (|it| it.rank = 513, ["rank", "0 to 512", "513"]),
        (|it| it.vertices = 0, ["vertices", "at least one vertex and one triangle", "0 vertices, 1 triangles"]),
        (|it| it.placement = vec![0; 47].into(), ["placement", "0, 48 or 96 bytes", "47 bytes"]),
        (|it| it.color = vec![0.0, 2.0, 0.0], ["color", "numbers from 0 to 1", "[0.0, 2.0, 0.0]"]),
        (|it| it.eigenvalues = vec![1.0; 2], ["eigenvalues", "none or 1 finite numbers", "2 numbers"]),
        (|it| it.crease_angle = Some(181.0), ["crease_angle", "0 to 180 degrees", "181"]),
        (|it| it.name = "a\nb".into(), ["name", "1 to 256 bytes without control characters", "\"a\\nb\""]),
        (
            |it| it.shares_shape_with = Some(0),
            ["shares_shape_with", "no arrays of its own", "3 vertices, 1 triangles, rank 1"],
        ),
    ];
    for (change, [field, expected, given]) in cases {
        let mut domain = triangle();
        change(&mut domain);
        let path = format!("domains[0].{field}");
        assert_rejected(&server, vec![header(1, 84), Part::Domain(domain)], [&path, expected, given]).await;
    }
    let arrays_of_first = || vec![header(2, 84), Part::Domain(triangle()), arrays(0.0, 2, 0.5)];
    let later = v1::UploadedDomain { name: "b".into(), shares_shape_with: Some(1), ..Default::default() };
    let path = "domains[1].shares_shape_with";
    let parts = [arrays_of_first(), vec![Part::Domain(later)]].concat();
    assert_rejected(&server, parts, [path, "an index below 1", "1"]).await;
    let creased = v1::UploadedDomain {
        name: "b".into(),
        shares_shape_with: Some(0),
        crease_angle: Some(30.0),
        ..Default::default()
    };
    let parts = [arrays_of_first(), vec![Part::Domain(creased)]].concat();
    assert_rejected(&server, parts, ["domains[1].crease_angle", "none with shares_shape_with", "30"]).await;
    let parts = [arrays_of_first(), vec![Part::Domain(triangle())]].concat();
    assert_rejected(&server, parts, ["domains[1].name", "a name that no earlier domain has", "a"]).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_arrays_are_rejected_and_leave_no_files() {
    let folder = tempfile::tempdir().expect("expected a temporary folder");
    let (server, client) = start_server(&folder.path().join("state"), folder.path()).await;
    let valid = || Part::Domain(triangle());
    let chunk = |length: usize| Part::Chunk(vec![0; length].into());
    let full = || arrays(0.0, 2, 0.5);
    // Parts, and the field, the expected and the given value of the rejection.
    let cases = [
        (vec![header(0, 84)], ["header.domains", "1 to 4096 domains", "0"]),
        (vec![header(1, u64::MAX)], ["header.total_bytes", "at most 4294967296 bytes", "18446744073709551615"]),
        (vec![header(1, 83), valid()], ["header.total_bytes", "83", "84"]),
        (vec![header(1, 85), valid(), full()], ["header.total_bytes", "85", "84"]),
        (vec![header(1, 84), valid(), chunk(85)], ["chunk", "at most 84 bytes (the rest of the arrays)", "85 bytes"]),
        (vec![header(1, 84), valid(), chunk(80)], ["domains[0]", "84 bytes", "80 bytes"]),
        (vec![header(2, 84), valid(), full()], ["header.domains", "2", "1"]),
        (vec![header(1, 84), valid(), full(), valid()], ["header.domains", "1", "2"]),
        (
            vec![header(1, 84), valid(), arrays(f32::NAN, 2, 0.5)],
            ["domains[0].mesh.positions[0]", "finite numbers", "[NaN, 0.0, 0.0]"],
        ),
        (vec![header(1, 84), valid(), arrays(0.0, 3, 0.5)], ["domains[0].mesh.indices[2]", "an index below 3", "3"]),
        (
            vec![header(1, 84), valid(), arrays(0.0, 2, f32::INFINITY)],
            ["domains[0].modes[0, 0]", "a finite number", "inf"],
        ),
    ];
    for (parts, texts) in cases {
        assert_rejected(&server, parts, texts).await;
    }
    for parts in [vec![valid()], vec![header(1, 84), header(1, 84)], vec![]] {
        let (code, rejection) = rejected_upload(&server, parts).await;
        assert_eq!((code, rejection.reason()), (Code::InvalidArgument, Reason::UnexpectedMessage), "{rejection:?}");
    }
    // The client sends fewer entries of U than the rank requires.
    let (positions, triangles) = (vec![[0.0; 3]; 3], vec![[0, 1, 2]]);
    let shape = UploadShape::Arrays { positions, triangles, rank: 2, modes: vec![0.0; 9] };
    let upload = ArrayUpload::new("sent").domain(UploadDomain::new("a", shape));
    let error = client.upload_arrays(upload).await.expect_err("expected too few entries");
    let rejection = error.rejection().expect("expected details");
    assert_eq!(rejection.to_string(), "domains[0]: expected 120 bytes, got 84 bytes");
    let left = std::fs::read_dir(folder.path().join("state/uploads")).expect("expected an uploads folder").count();
    assert_eq!((left, server.engine.list(&Principal::owner()).open.len()), (0, 0));
}
