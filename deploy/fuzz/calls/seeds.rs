//! Seeds of the targets of calls: valid messages, from which the fuzzer starts.

use bytes::Bytes;
use modalcast_proto::v1;
use prost::Message;
use sha2::{Digest as _, Sha256};
use v1::drive_scene_request::Kind as DriveKind;
use v1::upload_arrays_request::Part as ArraysPart;
use v1::upload_scene_request::Part as FilesPart;

use super::target::STORED_SCENE;
use super::target::input::{CHUNK, MESSAGE, SEPARATOR};

const TRIANGLE: &[u8] = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n";

/// Modes in SOFA's text format: 9 rows, one column.
const MODES: &[u8] = b"9 1\n0\n0\n1\n0\n0\n1\n0\n0\n1\n";

const MANIFEST: &[u8] = b"unit = 0.5\n[[domain]]\nname = \"a\"\nmodel = \"m.obj\"\nmodes = \"u/modes.txt\"\n";

/// A file of every upload of arrays.
const STORED_FILE: &[u8] = b"newmtl surface\nKd 1 1 1\n";

const IDENTITY: [f32; 12] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

pub(crate) fn seeds(target: &str) -> Vec<Vec<u8>> {
    match target {
        "drive_scene" => vec![steps()],
        "upload_arrays" => vec![two_domains("arrays"), triangle_without_modes()],
        "upload_scene" => vec![one_file(), folder(), declared_file(), reused_file()],
        _ => Vec::new(),
    }
}

fn message(message: &impl Message) -> Vec<u8> {
    [&[MESSAGE][..], &message.encode_to_vec()].concat()
}

fn chunk(content: &[u8]) -> Vec<u8> {
    [&[CHUNK][..], content].concat()
}

fn floats(numbers: &[f32]) -> Vec<u8> {
    numbers.iter().flat_map(|number| number.to_le_bytes()).collect()
}

/// A run of a writer in the stored scene: a step of one message, a step of two messages, one with quaternions, and one
/// of the whole scene.
fn steps() -> Vec<u8> {
    let delivery = v1::Delivery::Lossless.into();
    let open = v1::OpenDrive { scene: STORED_SCENE.into(), delivery, take_over: true, ..Default::default() };
    let step = |number: u64, has_more: bool| v1::Step {
        number,
        time: number as f64,
        q_domains: vec![0],
        q: floats(&[0.5]).into(),
        transform_domains: vec![1],
        transforms: floats(&IDENTITY).into(),
        has_more,
        ..Default::default()
    };
    let last_part = v1::Step { q_domains: vec![1], transform_domains: vec![0], ..step(2, false) };
    let rotation = v1::Step {
        transform_format: v1::TransformFormat::QuaternionXyzwF32.into(),
        transforms: floats(&[0.0, 0.0, 0.0, 1.0, 1.0, 2.0, 3.0]).into(),
        ..step(3, false)
    };
    let whole = v1::Step {
        q_domains: vec![],
        q: floats(&[0.5, 0.25]).into(),
        transform_domains: vec![],
        transforms: floats(&IDENTITY.repeat(2)).into(),
        ..step(4, false)
    };
    let steps = [step(1, false), step(2, true), last_part, rotation, whole].map(DriveKind::Step);
    let kinds = [DriveKind::Open(open)].into_iter().chain(steps);
    let messages = kinds.map(|kind| message(&v1::DriveSceneRequest { kind: Some(kind) }));
    messages.collect::<Vec<_>>().join(SEPARATOR)
}

fn arrays_part(part: ArraysPart) -> Vec<u8> {
    message(&v1::UploadArraysRequest { part: Some(part) })
}

/// Positions, face and, for each mode, entries of U.
fn triangle_arrays(rank: usize) -> Vec<u8> {
    let positions = floats(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
    let face: Vec<u8> = [0_u32, 1, 2].iter().flat_map(|vertex| vertex.to_le_bytes()).collect();
    [positions, face, floats(&[0.25; 9]).repeat(rank)].concat()
}

/// Two domains with one shape of one mode.
pub(crate) fn two_domains(scene: &str) -> Vec<u8> {
    let header = v1::UploadArraysHeader {
        scene: scene.into(),
        domains: 2,
        total_bytes: 3 * 12 + 12 + 3 * 12,
        unit: 1.0,
        up: "y".into(),
    };
    let first = v1::UploadedDomain {
        name: "a".into(),
        vertices: 3,
        triangles: 1,
        rank: 1,
        color: vec![1.0, 0.0, 0.5],
        eigenvalues: vec![2.0],
        crease_angle: Some(30.0),
        ..Default::default()
    };
    let second = v1::UploadedDomain {
        name: "b".into(),
        shares_shape_with: Some(0),
        placement: floats(&IDENTITY).into(),
        ..Default::default()
    };
    [
        arrays_part(ArraysPart::Header(header)),
        arrays_part(ArraysPart::Domain(first)),
        chunk(&triangle_arrays(1)),
        arrays_part(ArraysPart::Domain(second)),
    ]
    .join(SEPARATOR)
}

/// A domain whose arrays are sent in two chunks. The header has no sums.
fn triangle_without_modes() -> Vec<u8> {
    let header = v1::UploadArraysHeader { scene: "a".into(), up: "z".into(), ..Default::default() };
    let domain = v1::UploadedDomain { name: "a".into(), vertices: 3, triangles: 1, ..Default::default() };
    let arrays = triangle_arrays(0);
    let (first, second) = arrays.split_at(7);
    let (header, domain) = (ArraysPart::Header(header), ArraysPart::Domain(domain));
    [arrays_part(header), arrays_part(domain), chunk(first), chunk(second)].join(SEPARATOR)
}

/// A header without sums.
fn files_header(entry: &str) -> Vec<u8> {
    let header = v1::UploadHeader { scene: "files".into(), entry: entry.into(), ..Default::default() };
    files_part(FilesPart::Header(header))
}

fn files_part(part: FilesPart) -> Vec<u8> {
    message(&v1::UploadSceneRequest { part: Some(part) })
}

/// A file without size and hash.
fn file(path: &str) -> Vec<u8> {
    files_part(FilesPart::File(v1::UploadFile { path: path.into(), ..Default::default() }))
}

fn sha256(content: &[u8]) -> Bytes {
    Sha256::digest(content).to_vec().into()
}

fn one_file() -> Vec<u8> {
    [files_header("m.obj"), file("m.obj"), chunk(TRIANGLE)].join(SEPARATOR)
}

fn folder() -> Vec<u8> {
    [
        files_header(""),
        file("scene.toml"),
        chunk(MANIFEST),
        file("m.obj"),
        chunk(TRIANGLE),
        file("u/modes.txt"),
        chunk(MODES),
    ]
    .join(SEPARATOR)
}

/// A file with its declarations in two chunks, and an empty file.
fn declared_file() -> Vec<u8> {
    let bytes = TRIANGLE.len() as u64;
    let header = v1::UploadHeader { scene: "b".into(), entry: "m.obj".into(), files: 2, total_bytes: bytes };
    let model = v1::UploadFile { path: "m.obj".into(), bytes, sha256: sha256(TRIANGLE), reuse: false };
    let empty = v1::UploadFile { path: "m.mtl".into(), bytes: 0, sha256: sha256(b""), reuse: false };
    let (first, second) = TRIANGLE.split_at(11);
    let parts = [FilesPart::Header(header), FilesPart::File(model)].map(files_part);
    let [header, model] = parts;
    [header, model, chunk(first), chunk(second), files_part(FilesPart::File(empty))].join(SEPARATOR)
}

/// A file of the stored scene, and a sent file.
fn reused_file() -> Vec<u8> {
    let (path, bytes) = ("m.mtl".into(), STORED_FILE.len() as u64);
    let library = v1::UploadFile { path, bytes, sha256: sha256(STORED_FILE), reuse: true };
    let model = [&b"mtllib m.mtl\nusemtl surface\n"[..], TRIANGLE].concat();
    [files_header("m.obj"), files_part(FilesPart::File(library)), file("m.obj"), chunk(&model)].join(SEPARATOR)
}
