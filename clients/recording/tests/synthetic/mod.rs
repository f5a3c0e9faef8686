//! A synthetic scene, its states, and recordings of them.

use std::path::Path;

use bytes::Bytes;
use modalcast_client::v1;
use modalcast_recording::{MetadataEntry, RecordingWriter};
use sha2::{Digest as _, Sha256};
use v1::describe_scene_response::Part;

/// Row-major 3x4 identity.
pub(crate) const IDENTITY: [f32; 12] = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// Steps per second of the states.
pub(crate) const RATE: u64 = 60;

/// Bytes that are identified by their hash.
pub(crate) struct Content {
    pub(crate) bytes: Vec<u8>,
}

impl Content {
    fn hash(&self) -> [u8; 32] {
        Sha256::digest(&self.bytes).into()
    }
}

fn bytes_of<T: bytemuck::NoUninit>(numbers: &[T]) -> Bytes {
    Bytes::copy_from_slice(bytemuck::cast_slice(numbers))
}

/// The messages that describe the scene, and its contents. The scene is a triangle with two modes, and a second domain
/// of the same shape.
pub(crate) fn scene() -> (Vec<v1::DescribeSceneResponse>, Vec<Content>) {
    let positions = Content { bytes: bytes_of(&[0.0_f32, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]).to_vec() };
    let modes: Vec<f32> = (0..18).map(|number| number as f32 / 16.0).collect();
    let modes = Content { bytes: bytes_of(&modes).to_vec() };
    let array = |array: v1::Array, content: &Content| v1::ArrayDescription {
        array: array.into(),
        bytes: content.bytes.len() as u64,
        sha256: Bytes::copy_from_slice(&content.hash()),
    };
    let arrays = vec![array(v1::Array::RestPositions, &positions), array(v1::Array::Modes, &modes)];
    let shape = v1::ShapeDescription { vertices: 3, rank: 2, corners: 3, triangles: 1, arrays, ..Default::default() };
    let domain = |domain: u32| v1::DomainDescription {
        domain,
        name: format!("domain {domain}"),
        placement: bytes_of(&IDENTITY),
        ..Default::default()
    };
    let info =
        v1::SceneInfo { scene: "pair".into(), source: "pair".into(), domains: 2, unit: 1.0, ..Default::default() };
    let material = v1::MaterialDescription {
        ambient: vec![0.5; 3],
        diffuse: vec![0.5; 3],
        specular: vec![0.0; 3],
        ..Default::default()
    };
    let parts = [
        Part::Scene(info),
        Part::Shapes(v1::ShapeDescriptions { shapes: vec![shape] }),
        Part::Materials(v1::MaterialDescriptions { materials: vec![material] }),
        Part::Domains(v1::DomainDescriptions { domains: vec![domain(0), domain(1)] }),
    ];
    let messages = parts.into_iter().map(|part| v1::DescribeSceneResponse { part: Some(part) }).collect();
    (messages, vec![positions, modes])
}

/// q of domain 0 at a step; the second coordinate changes at every tenth step only.
pub(crate) fn q_at(step: u64) -> [f32; 2] {
    [step as f32 * 0.25, (step / 10) as f32]
}

/// The state of a step, as a server sends it: the first one is complete. Domain 1 never changes.
pub(crate) fn state(step: u64, run: u64) -> v1::StateChunk {
    let is_complete = step == 0;
    let q = q_at(step);
    let mut sections: Vec<(v1::StateContent, Bytes)> = match is_complete {
        true => vec![
            (v1::StateContent::QDomains, bytes_of(&[0_u32, 1])),
            (v1::StateContent::Q, bytes_of(&[q[0], q[1], 0.5, -0.5])),
            (v1::StateContent::TransformDomains, bytes_of(&[0_u32, 1])),
            (v1::StateContent::Transforms, bytes_of(&[IDENTITY, IDENTITY].concat())),
            (v1::StateContent::Origins, bytes_of(&[0.0_f64; 3])),
        ],
        false => {
            vec![(v1::StateContent::QDomains, bytes_of(&[0_u32])), (v1::StateContent::Q, bytes_of(&q))]
        }
    };
    if step % 7 == 3 {
        let mut transform = IDENTITY;
        transform[3] = step as f32;
        sections.push((v1::StateContent::TransformDomains, bytes_of(&[0_u32])));
        sections.push((v1::StateContent::Transforms, bytes_of(&transform)));
    }
    let (mut wire_sections, mut data) = (Vec::new(), Vec::new());
    for (content, bytes) in sections {
        let offset = data.len() as u64;
        wire_sections.push(v1::StateSection { content: content.into(), offset, bytes: bytes.len() as u64 });
        data.extend(bytes);
    }
    let head = v1::StateHead {
        step: Some(v1::StepId { run, number: step, time: step as f64 / RATE as f64 }),
        complete: is_complete,
        sections: wire_sections,
        total: data.len() as u64,
        stages: vec![v1::StageTime { stage: "deform".into(), milliseconds: step as f32 }],
        ..Default::default()
    };
    v1::StateChunk { head: Some(head), offset: 0, data: data.into() }
}

/// The metadata of a recording of these contents.
pub(crate) fn metadata(contents: &[Content], embedded: bool) -> Vec<MetadataEntry> {
    let entry = |name, values: &[(&str, String)]| MetadataEntry {
        name,
        values: values.iter().map(|(key, value)| ((*key).to_owned(), value.clone())).collect(),
    };
    let hex = |content: &Content| content.hash().iter().map(|byte| format!("{byte:02x}")).collect::<String>();
    let hashes: Vec<String> = contents.iter().map(hex).collect();
    let sizes: Vec<String> = contents.iter().map(|content| content.bytes.len().to_string()).collect();
    let kind = if embedded { "embedded" } else { "by-hash" };
    let recording = [("version", "1"), ("scene", "pair"), ("source", "pair"), ("contents", kind)];
    vec![
        entry("recording", &recording.map(|(key, value)| (key, value.to_owned()))),
        entry("content", &[("sha256", hashes.join(" ")), ("bytes", sizes.join(" "))]),
    ]
}

/// Begins a recording of the scene, with its contents if `embedded`, else only with their hashes.
pub(crate) fn begin<W: std::io::Write>(writer: W, embedded: bool) -> RecordingWriter<W> {
    let (messages, contents) = scene();
    let mut recording = RecordingWriter::new(writer, &metadata(&contents, embedded)).expect("a written header");
    messages.into_iter().for_each(|message| recording.scene_message(message).expect("a written message"));
    for (item, content) in contents.iter().enumerate().filter(|_| embedded) {
        let (item, total) = (item as u32, content.bytes.len() as u64);
        let message = v1::ReadContentResponse { item, offset: 0, total, data: content.bytes.clone().into() };
        recording.content_message(&message).expect("a written message");
    }
    recording
}

/// A whole recording of `steps` states, with a chunk of its own for every `per_chunk` states.
pub(crate) fn recording(steps: u64, per_chunk: u64) -> Vec<u8> {
    let mut writer = begin(Vec::new(), true);
    for step in 0..steps {
        writer.state_chunk(state(step, 1)).expect("a written state");
        if step % per_chunk == per_chunk - 1 {
            writer.flush().expect("a written chunk");
        }
    }
    writer.finish().expect("a written file")
}

/// Writes a file into a folder and returns its path.
pub(crate) fn write(folder: &Path, name: &str, bytes: &[u8]) -> std::path::PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, bytes).expect("a written file");
    path
}
