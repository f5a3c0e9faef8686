//! Exports of recordings: their numbers equal those of the server, and the loader of scenes reads the glTF file.

use std::io::Read as _;
use std::path::Path;

use modalcast_client::{ShapeArray, VertexRequest, VertexSelection};
use modalcast_recording::{Recording, export_gltf, export_html, export_npz};
use serde_json::Value;

use crate::harness::{Renderer, Server, new_file, record_steps, upload_pair};

const STEPS: u64 = 13;

/// A recording of the pair, and the positions of all vertices after each step, one list per domain.
struct Recorded {
    recording: Recording,
    /// Per step and domain: three numbers per vertex.
    positions: Vec<Vec<Vec<f32>>>,
    folder: tempfile::TempDir,
}

async fn record_pair() -> Recorded {
    let server = Server::start_with(Renderer::Off).await;
    upload_pair(&server.client, "pair", 1.0).await;
    let (folder, path) = new_file("pair.mcap");
    record_steps(&server.client, "pair", &path, STEPS, None).await;
    let recording = Recording::open(&path).expect("a recording");
    let scene = modalcast_recording::open_recorded_scene(&server.client, &recording, "").await.expect("the scene");
    // Replays step by step, so that the vertices of each step can be requested.
    let mut positions = Vec::new();
    for step in 0..STEPS {
        // A microsecond later, because the times in the file are rounded.
        let time = step * 1_000_000_000 / 24 + 1000;
        let range = modalcast_recording::TimeRange { from: time, to: time };
        let request = modalcast_recording::ReplayRequest { range, speed: None, ..Default::default() };
        let replay = modalcast_recording::replay(
            &server.client,
            &recording,
            &scene,
            &request,
            |_| Ok(()),
            std::future::pending(),
        );
        assert_eq!(replay.await.expect("a replay").steps, 1);
        let request = VertexRequest::new("pair", VertexSelection::default());
        let set = server.client.get_vertices(&request).await.expect("vertices");
        let of_domain = |ordinal: usize| set.positions[set.float_range(ordinal).expect("a domain")].to_vec();
        positions.push(vec![of_domain(0), of_domain(1)]);
    }
    Recorded { recording, positions, folder }
}

/// T (x0 + U q) for one vertex; `modes` has the three rows of the vertex.
fn deform(transform: &[f64], x0: &[f32], modes: &[f32], q: &[f32]) -> [f64; 3] {
    let local: Vec<f64> = (0..3)
        .map(|axis| {
            let row = &modes[axis * q.len()..][..q.len()];
            f64::from(x0[axis]) + row.iter().zip(q).map(|(mode, q)| f64::from(*mode) * f64::from(*q)).sum::<f64>()
        })
        .collect();
    std::array::from_fn(|row| {
        (0..3).map(|column| transform[4 * row + column] * local[column]).sum::<f64>() + transform[4 * row + 3]
    })
}

fn distance(a: [f64; 3], b: &[f32]) -> f64 {
    (0..3).map(|axis| (a[axis] - f64::from(b[axis])).powi(2)).sum::<f64>().sqrt()
}

/// An array of a `.npz` file: the type, the shape as text, and the bytes.
struct Array {
    header: String,
    bytes: Vec<u8>,
}

impl Array {
    fn read(path: &Path, name: &str) -> Self {
        let file = std::fs::File::open(path).expect("a file");
        let mut archive = zip::ZipArchive::new(file).expect("an archive");
        let mut entry = archive.by_name(&format!("{name}.npy")).unwrap_or_else(|error| panic!("{name}: {error}"));
        let mut bytes = Vec::new();
        entry.read_to_end(&mut bytes).expect("an entry");
        // The length of the header is at byte 8. The header ends at a multiple of 64 bytes.
        let length = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
        assert_eq!((10 + length) % 64, 0);
        let header = String::from_utf8(bytes[10..10 + length].to_vec()).expect("text");
        Self { header, bytes: bytes[10 + length..].to_vec() }
    }

    fn numbers<T: bytemuck::Pod>(&self) -> Vec<T> {
        bytemuck::pod_collect_to_vec(&self.bytes)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn arrays_of_npz_give_the_vertices_of_the_server() {
    let Recorded { recording, positions, folder } = record_pair().await;
    let out = folder.path().join("pair.npz");
    export_npz(&recording, &out).expect("an exported file");
    let times: Vec<f64> = Array::read(&out, "time").numbers();
    assert!((times[12] - 0.5).abs() < 1e-9 && times.len() == 13, "{times:?}");
    assert_eq!(Array::read(&out, "step").numbers::<u64>(), (0..STEPS).collect::<Vec<_>>());
    assert!(Array::read(&out, "names").header.contains("'<U6'"));
    assert_eq!(Array::read(&out, "shapes").numbers::<u32>(), [0, 1]);
    // The first shape is a grid of 4 x 4 vertices, which has 18 triangles.
    let faces = Array::read(&out, "shape_0/faces");
    assert!(faces.header.contains("(18, 3, )") && faces.numbers::<u32>()[..3] == [0, 1, 4], "{}", faces.header);
    for (domain, (name, rank)) in [("first", 2), ("second", 3)].into_iter().enumerate() {
        let q = Array::read(&out, &format!("{name}/q"));
        assert!(q.header.contains(&format!("(13, {rank}, )")), "{}", q.header);
        let (q, transforms): (Vec<f32>, Vec<f64>) = (q.numbers(), Array::read(&out, &format!("{name}/T")).numbers());
        let x0: Vec<f32> = Array::read(&out, &format!("shape_{domain}/x0")).numbers();
        let modes: Vec<f32> = Array::read(&out, &format!("shape_{domain}/U")).numbers();
        for (step, expected) in positions.iter().enumerate() {
            for (vertex, expected) in expected[domain].chunks(3).enumerate() {
                let x = deform(
                    &transforms[12 * step..][..12],
                    &x0[3 * vertex..][..3],
                    &modes[3 * vertex * rank..][..3 * rank],
                    &q[rank * step..][..rank],
                );
                assert!(distance(x, expected) < 1e-5, "{name}, step {step}, vertex {vertex}: {x:?} {expected:?}");
            }
        }
    }
    assert_ne!(positions[3][0], positions[4][0], "control: expected steps to differ");
}

/// The JSON and the binary data of a `.glb` file.
struct Glb {
    document: Value,
    data: Vec<u8>,
}

impl Glb {
    fn read(path: &Path) -> Self {
        let bytes = std::fs::read(path).expect("a file");
        // A file header of 12 bytes, and the chunks of JSON and binary data, each with a header of 8 bytes.
        let length = u32::from_le_bytes(bytes[12..16].try_into().expect("four bytes")) as usize;
        let document = serde_json::from_slice(&bytes[20..20 + length]).expect("JSON");
        Self { document, data: bytes[28 + length..].to_vec() }
    }

    fn floats(&self, accessor: &Value) -> Vec<f32> {
        let accessor = &self.document["accessors"][accessor.as_u64().expect("an index") as usize];
        let view = &self.document["bufferViews"][accessor["bufferView"].as_u64().expect("a view") as usize];
        let number = |key: &str| view[key].as_u64().expect("a number") as usize;
        bytemuck::pod_collect_to_vec(&self.data[number("byteOffset")..][..number("byteLength")])
    }

    /// The times of the keys of all channels.
    fn times(&self) -> Vec<f32> {
        self.floats(&self.document["animations"][0]["samplers"][0]["input"])
    }

    /// The values of a channel of a node at a key, or those of the node itself if it has no channel.
    fn value(&self, node: usize, path: &str, key: usize) -> Vec<f32> {
        let animation = &self.document["animations"][0];
        let channels = animation["channels"].as_array().expect("channels");
        let own = &self.document["nodes"][node][path];
        let count = own.as_array().expect("a value").len();
        match channels.iter().find(|channel| channel["target"]["node"] == node && channel["target"]["path"] == path) {
            Some(channel) => {
                let sampler = &animation["samplers"][channel["sampler"].as_u64().expect("an index") as usize];
                self.floats(&sampler["output"])[count * key..][..count].to_vec()
            }
            None => own
                .as_array()
                .expect("a value")
                .iter()
                .map(|number| number.as_f64().expect("a number") as f32)
                .collect(),
        }
    }
}

/// Row-major 3x4 of a node's translation, rotation and scale, with the scale of the scene.
fn matrix(translation: &[f32], rotation: &[f32], scale: &[f32], unit: f64) -> Vec<f64> {
    let rotation = glam::Quat::from_slice(rotation).as_dquat();
    let columns: Vec<glam::DVec3> =
        (0..3).map(|axis| rotation * (glam::DVec3::AXES[axis] * f64::from(scale[axis]))).collect();
    let entry = |row: usize, column: usize| match column {
        3 => unit * f64::from(translation[row]),
        _ => unit * columns[column][row],
    };
    (0..12).map(|index| entry(index / 4, index % 4)).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn animation_of_gltf_gives_the_vertices_of_the_server() {
    let Recorded { recording, positions, folder } = record_pair().await;
    let out = folder.path().join("pair.glb");
    export_gltf(&recording, 1.0, &out).expect("an exported file");
    let glb = Glb::read(&out);
    let unit = recording.description().info.unit;
    // The server loads the file as a scene.
    let server = Server::start_in(Renderer::Off, folder.path()).await;
    server.client.open_scene("pair.glb", "glb").await.expect("a scene");
    let arrays = [ShapeArray::RestPositions, ShapeArray::Modes];
    let loaded = server.client.describe("glb", &arrays).await.expect("a description");
    assert_eq!(loaded.domains.len(), 2);
    let recorded = recording.read_description(&arrays, false).expect("contents");
    let mut largest = 0.0_f64;
    for (node, domain) in loaded.domains.iter().enumerate() {
        let shape = loaded.shape_of(domain);
        let rank = domain.rank;
        assert_eq!(rank, recorded.domains[node].rank);
        // The loader may merge and reorder the vertices of glTF, so match them by rest position.
        let rest = &recorded.shapes[node].rest_positions;
        for (step, expected) in positions.iter().enumerate() {
            let (translation, rotation) = (glb.value(node, "translation", step), glb.value(node, "rotation", step));
            let transform = matrix(&translation, &rotation, &glb.value(node, "scale", step), unit);
            let q = glb.value(node, "weights", step);
            for (vertex, x0) in shape.rest_positions.chunks(3).enumerate() {
                let original = rest.chunks(3).position(|original| original == x0).expect("a vertex at rest");
                let x = deform(&transform, x0, &shape.modes[3 * vertex * rank..][..3 * rank], &q);
                let expected: Vec<f32> =
                    expected[node][3 * original..][..3].iter().map(|number| number * unit as f32).collect();
                largest = largest.max(distance(x, &expected));
            }
        }
        let placement = matrix(
            &glb.value(node, "translation", 0),
            &glb.value(node, "rotation", 0),
            &glb.value(node, "scale", 0),
            unit,
        );
        let difference = domain.placement.iter().zip(&placement).map(|(a, b)| (f64::from(*a) - b).abs());
        assert!(difference.fold(0.0, f64::max) < 1e-6, "{:?} {placement:?}", domain.placement);
    }
    assert!(largest < 1e-5, "{largest}");
    // In slow motion, the same keys have later times.
    export_gltf(&recording, 100.0, &out).expect("an exported file");
    let slow = Glb::read(&out);
    for (step, (time, slow_time)) in glb.times().into_iter().zip(slow.times()).enumerate() {
        let expected = step as f32 / 24.0;
        assert!((time - expected).abs() < 1e-6 && (slow_time - 100.0 * expected).abs() < 1e-4, "{time} {slow_time}");
        assert_eq!(glb.value(1, "rotation", step), slow.value(1, "rotation", step));
    }
    assert_eq!((glb.times().len(), slow.times().len()), (positions.len(), positions.len()));
    assert_eq!(export_gltf(&recording, 0.0, &out).expect_err("a factor of 0").exit_code(), 3);
    assert_ne!(glb.value(0, "weights", 3), glb.value(0, "weights", 4), "control: expected animated weights");
    assert_ne!(glb.value(1, "translation", 3), glb.value(1, "translation", 4), "control: expected motion");
    assert_ne!(glb.value(1, "rotation", 3), glb.value(1, "rotation", 4), "control: expected motion");
}

#[tokio::test(flavor = "multi_thread")]
async fn page_contains_the_recording() {
    use base64::Engine as _;
    let Recorded { recording, folder, .. } = record_pair().await;
    let out = folder.path().join("pair.html");
    let page = "<!doctype html><html><head><title>t</title></head><body><script>main()</script></body></html>";
    export_html(&recording, page, 100.0, &out).expect("a page");
    let text = std::fs::read_to_string(&out).expect("a page");
    let tag = "<script id=\"recording\" type=\"application/octet-stream\" data-slow=\"100\">";
    let (before, rest) = text.split_once(tag).expect("the recording");
    let (encoded, after) = rest.split_once("</script>").expect("the end of the recording");
    assert_eq!(format!("{before}{}", after.trim_start()), page);
    let bytes = base64::engine::general_purpose::STANDARD.decode(encoded).expect("base64");
    assert_eq!(bytes, std::fs::read(recording.path()).expect("the recording"));
    assert_eq!(export_html(&recording, "no page", 1.0, &out).expect_err("another page").exit_code(), 3);
}
