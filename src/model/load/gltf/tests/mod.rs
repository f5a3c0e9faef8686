//! Tests of the glTF loader with small generated models.

mod malformed;
mod materials;
mod real;

use serde_json::{Value, json};

use crate::domain::CreaseAngle;
use crate::error::Result;
use crate::load::asset_dir::AssetDir;
use crate::scene::{NormalMethod, Scene, SceneParts};

// Component types of glTF.
const U8: u64 = 5121;
const U16: u64 = 5123;
const U32: u64 = 5125;
const F32: u64 = 5126;

/// A document and its binary chunk.
#[derive(Clone)]
struct Model {
    json: Value,
    bin: Vec<u8>,
}

impl Model {
    /// Accessor 0: the positions of a right triangle in the plane z = 0; one node, one mesh, one primitive.
    fn triangle() -> Self {
        let json = json!({
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"name": "one", "mesh": 0}],
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "buffers": [{"byteLength": 0}],
            "bufferViews": [],
            "accessors": []
        });
        let mut model = Self { json, bin: Vec::new() };
        model.add_floats("VEC3", 3, &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0]);
        model
    }

    /// Appends the bytes to the binary chunk. Returns the index of their buffer view.
    fn add_view(&mut self, bytes: &[u8]) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let view = json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len()});
        self.bin.extend_from_slice(bytes);
        self.json["buffers"][0]["byteLength"] = self.bin.len().into();
        push(&mut self.json["bufferViews"], view)
    }

    /// Returns the index of the accessor.
    fn add_accessor(&mut self, bytes: &[u8], component: u64, kind: &str, count: usize) -> usize {
        let view = self.add_view(bytes);
        let accessor = json!({"bufferView": view, "componentType": component, "type": kind, "count": count});
        push(&mut self.json["accessors"], accessor)
    }

    /// Returns the index of the accessor.
    fn add_floats(&mut self, kind: &str, count: usize, numbers: &[f32]) -> usize {
        self.add_accessor(bytemuck::cast_slice(numbers), F32, kind, count)
    }

    /// The first primitive of the first mesh.
    fn primitive(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]
    }

    /// The model with a value set at a JSON pointer.
    fn with(mut self, pointer: &str, value: Value) -> Self {
        let (parent, key) = pointer.rsplit_once('/').expect("a JSON pointer");
        let parent = self.json.pointer_mut(parent).expect("an existing parent");
        match parent.as_array_mut() {
            Some(list) => list[key.parse::<usize>().expect("an index")] = value,
            None => parent[key] = value,
        }
        self
    }

    fn to_glb(&self) -> Vec<u8> {
        let mut text = self.json.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut glb = b"glTF\x02\0\0\0\0\0\0\0".to_vec();
        for (kind, chunk) in [(b"JSON", &text), (b"BIN\0", &self.bin)] {
            glb.extend((chunk.len() as u32).to_le_bytes());
            glb.extend(kind);
            glb.extend(chunk);
        }
        let length = glb.len() as u32;
        glb[8..12].copy_from_slice(&length.to_le_bytes());
        glb
    }

    fn read(&self) -> Result<SceneParts> {
        super::parse(&AssetDir::unrestricted(&std::env::temp_dir()), "model", &self.to_glb(), CreaseAngle::default())
    }

    fn parts(&self) -> SceneParts {
        self.read().expect("a valid model")
    }
}

/// Appends a value to a JSON list. Returns its index.
fn push(list: &mut Value, value: Value) -> usize {
    let list = list.as_array_mut().expect("a list");
    list.push(value);
    list.len() - 1
}

/// A triangle with two targets. The second (accessor 2) is sparse without dense values and moves only vertex 2.
fn morphed_triangle() -> Model {
    let mut model = Model::triangle();
    let dense = model.add_floats("VEC3", 3, &[0.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 3.0]);
    let sparse_indices = model.add_view(&[2]);
    let sparse_values = model.add_view(bytemuck::cast_slice(&[0.5_f32, -0.5, 0.25]));
    let sparse = json!({
        "componentType": F32, "type": "VEC3", "count": 3,
        "sparse": {
            "count": 1,
            "indices": {"bufferView": sparse_indices, "componentType": U8},
            "values": {"bufferView": sparse_values}
        }
    });
    let sparse_accessor = push(&mut model.json["accessors"], sparse);
    model.primitive()["targets"] = json!([{"POSITION": dense, "NORMAL": dense}, {"POSITION": sparse_accessor}]);
    model
}

#[test]
fn position_targets_are_columns_of_u_and_normals_choose_exact_ones() {
    let parts = morphed_triangle().parts();
    let modes = &parts.shapes[0].modes;
    assert_eq!((modes.rank(), modes.vertices()), (2, 3));
    assert_eq!(modes.column(0), [0.0, 0.0, 1.0, 0.0, 0.0, 2.0, 0.0, 0.0, 3.0]);
    assert_eq!(modes.column(1), [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.5, -0.5, 0.25]);
    assert_eq!(parts.domains[0].rest_q, [] as [f32; 0]);
    assert!(parts.remarks[0].starts_with("normals of morph targets: exact normals"), "{:?}", parts.remarks);
    assert_eq!(parts.deformation.normals, NormalMethod::Exact);
    let without_normals = morphed_triangle().with("/meshes/0/primitives/0/targets/0/NORMAL", Value::Null);
    let mut without_normals = without_normals;
    without_normals.primitive()["targets"][0].as_object_mut().expect("a target").remove("NORMAL");
    let without_normals = without_normals.parts();
    assert_eq!((without_normals.deformation.normals, without_normals.remarks.len()), (NormalMethod::Rigid, 0));
    assert_eq!(Scene::new(parts).expect("a valid scene").rank_of(0), 2);
}

#[test]
fn sparse_values_replace_dense_values() {
    let mut model = morphed_triangle();
    // The sparse accessor gets the positions as dense values.
    model.json["accessors"][2]["bufferView"] = 0.into();
    let parts = model.parts();
    assert_eq!(parts.shapes[0].modes.column(1), [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.5, -0.5, 0.25]);
}

#[test]
fn targets_are_dropped_only_if_all_are_zero() {
    let mut model = Model::triangle();
    let zeros = model.add_floats("VEC3", 3, &[0.0; 9]);
    let empty = json!({"componentType": F32, "type": "VEC3", "count": 3});
    let empty = push(&mut model.json["accessors"], empty);
    model.primitive()["targets"] = json!([{"POSITION": zeros}, {"POSITION": empty}, {}]);
    model.json["nodes"][0]["weights"] = json!([1.0, 2.0, 3.0]);
    let parts = model.parts();
    assert_eq!(parts.shapes[0].modes.rank(), 0);
    assert!(parts.domains[0].rest_q.is_empty());
    // Accessor 0 contains the positions, which are not all zero.
    model.primitive()["targets"] = json!([{"POSITION": zeros}, {"POSITION": 0}, {}]);
    assert_eq!(model.parts().shapes[0].modes.rank(), 3);
}

#[test]
fn node_weights_override_mesh_weights_for_all_primitives() {
    let mut model = morphed_triangle();
    let morphed_primitive = model.primitive().clone();
    push(&mut model.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}}));
    push(&mut model.json["meshes"][0]["primitives"], morphed_primitive);
    push(&mut model.json["nodes"], json!({"mesh": 0, "weights": [3.0, 4.0]}));
    let model = model.with("/meshes/0/weights", json!([1.0, 2.0])).with("/scenes/0/nodes", json!([0, 1]));
    let parts = model.parts();
    let weights: Vec<&[f32]> = parts.domains.iter().map(|domain| domain.rest_q.as_slice()).collect();
    assert_eq!(weights, [&[1.0, 2.0][..], &[], &[1.0, 2.0], &[3.0, 4.0], &[], &[3.0, 4.0]]);
    let shares_q_with: Vec<_> = parts.domains.iter().map(|domain| domain.shares_q_with).collect();
    assert_eq!(shares_q_with, [None, None, Some(0), None, None, Some(3)]);
    let shapes: Vec<_> = parts.domains.iter().map(|domain| domain.shape).collect();
    assert_eq!((shapes, parts.shapes.len()), (vec![0, 1, 2, 0, 1, 2], 3));
    Scene::new(parts).expect("a valid scene");
}

#[test]
fn nodes_are_placed_and_attached_to_the_nearest_ancestor_mesh() {
    let sqrt_half = std::f64::consts::FRAC_1_SQRT_2;
    let nodes = json!([
        {"name": "leaf", "mesh": 0, "translation": [0, 0, 1]},
        {"name": "root", "mesh": 0, "children": [2], "translation": [10, 0, 0], "scale": [2, 2, 2]},
        {"name": "joint", "children": [0], "rotation": [0, 0, sqrt_half, sqrt_half]},
        {"name": "leaf", "mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 5, 0, 1]}
    ]);
    let model = Model::triangle().with("/nodes", nodes).with("/scenes/0/nodes", json!([1, 3]));
    let parts = model.parts();
    let names: Vec<&str> = parts.domains.iter().map(|domain| domain.name.as_str()).collect();
    assert_eq!(names, ["root.0", "leaf.0", "leaf #3.0"]);
    assert_eq!(parts.shapes.len(), 1);
    assert_close(&parts.domains[1].placement.0, &[0.0, -2.0, 0.0, 10.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2.0, 2.0]);
    assert_close(&parts.domains[2].placement.0, &[1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 5.0, 0.0, 0.0, 1.0, 0.0]);
    // The translation of "leaf" by 1 along z, then the rotation of "joint" by 90 degrees about z.
    let attachment = parts.domains[1].attachment.as_ref().expect("an attachment to the root");
    assert_eq!((attachment.parent, attachment.vertices.len()), (0, 0));
    assert_close(&attachment.frame.0, &[0.0, -1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0]);
    let world_from_leaf = parts.domains[0].placement.compose(attachment.frame);
    assert_close(&world_from_leaf.0, &parts.domains[1].placement.0);
    assert!(parts.domains[0].attachment.is_none() && parts.domains[2].attachment.is_none());
    Scene::new(parts).expect("a valid scene");
}

fn assert_close(actual: &[f32; 12], expected: &[f32; 12]) {
    let is_close = actual.iter().zip(expected).all(|(a, b)| (a - b).abs() <= 1e-6);
    assert!(is_close, "expected {expected:?}, got {actual:?}");
}

#[test]
fn chain_of_100000_nodes_is_read_without_recursion() {
    let node_count = 100_000;
    let mut nodes: Vec<Value> = (0..node_count).map(|node| json!({"children": [node + 1]})).collect();
    nodes.push(json!({"mesh": 0, "translation": [0, 2, 0]}));
    let parts = Model::triangle().with("/nodes", nodes.into()).parts();
    assert_eq!((parts.domains.len(), parts.domains[0].placement.0[7]), (1, 2.0));
}

#[test]
fn all_index_types_and_topologies_give_correct_triangles() {
    let mut model = Model::triangle();
    model.json["accessors"] = json!([]);
    model.add_floats("VEC3", 5, &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0]);
    let u32_indices = [0_u32, 1, 2, 3, 3, 4];
    let u8_indices = u32_indices.map(|index| index as u8);
    let u16_indices = u32_indices.map(|index| index as u16);
    let accessors = [
        model.add_accessor(&u8_indices, U8, "SCALAR", 6),
        model.add_accessor(bytemuck::cast_slice(&u16_indices), U16, "SCALAR", 6),
        model.add_accessor(bytemuck::cast_slice(&u32_indices), U32, "SCALAR", 6),
    ];
    let mut triangles = |mode: u64, accessor: usize| {
        *model.primitive() = json!({"attributes": {"POSITION": 0}, "indices": accessor, "mode": mode});
        let mesh = &model.parts().shapes[0].mesh;
        let vertices_of = |triangle: &[u32; 3]| triangle.map(|corner| mesh.corners().vertices[corner as usize]);
        mesh.triangles().iter().map(vertices_of).collect::<Vec<_>>()
    };
    // Triangles as vertices: the fan folds back, so that creases split its corners. Modes 4, 5 and 6: a list, a strip
    // (without its degenerate triangles) and a fan.
    for accessor in accessors {
        assert_eq!(triangles(4, accessor), [[0, 1, 2], [3, 3, 4]]);
        assert_eq!(triangles(5, accessor), [[0, 1, 2], [1, 3, 2]]);
        assert_eq!(triangles(6, accessor), [[1, 2, 0], [2, 3, 0], [3, 3, 0], [3, 4, 0]]);
    }
}

#[test]
fn points_and_lines_are_ignored_with_a_remark() {
    let mut model = Model::triangle();
    for mode in 0..4 {
        push(&mut model.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}, "mode": mode}));
    }
    let parts = model.parts();
    assert_eq!(parts.domains.len(), 1);
    assert_eq!(parts.remarks, ["primitives of points or lines are ignored"]);
}

#[test]
fn interleaved_and_normalized_attributes_are_decoded() {
    let mut model = Model::triangle();
    assert_eq!(model.parts().shapes[0].mesh.corners().normals, [[0.0, 0.0, 1.0]; 3], "expected smooth normals");
    // A vertex has twelve bytes of position and four bytes of texture coordinates. 13107 is 0.2 x 65535.
    let mut bytes = Vec::new();
    for (x, u) in [(0.0_f32, 0_u16), (4.0, 65535), (8.0, 13107)] {
        bytes.extend(bytemuck::cast_slice::<f32, u8>(&[x, x * x, 0.0]));
        bytes.extend(bytemuck::cast_slice::<u16, u8>(&[u, 65535 - u]));
    }
    let view = model.add_view(&bytes);
    model.json["bufferViews"][view]["byteStride"] = 16.into();
    model.json["accessors"] = json!([
        {"bufferView": view, "componentType": F32, "type": "VEC3", "count": 3},
        {"bufferView": view, "byteOffset": 12, "componentType": U16, "normalized": true, "type": "VEC2", "count": 3}
    ]);
    model.primitive()["attributes"] = json!({"POSITION": 0, "TEXCOORD_0": 1});
    let parts = model.parts();
    assert_eq!(parts.shapes[0].mesh.rest_positions(), [[0.0, 0.0, 0.0], [4.0, 16.0, 0.0], [8.0, 64.0, 0.0]]);
    assert_eq!(parts.shapes[0].mesh.corners().uvs, [[0.0, 1.0], [1.0, 0.0], [0.2, 0.8]]);
}

#[test]
fn buffers_are_read_from_data_uris_and_the_model_folder_only() {
    use base64::Engine;
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut model = Model::triangle();
    std::fs::create_dir(folder.path().join("sub")).expect("a new folder");
    std::fs::write(folder.path().join("sub/my buffer.bin"), &model.bin).expect("a writable file");
    std::fs::write(folder.path().join("secret.bin"), &model.bin).expect("a writable file");
    let files = AssetDir::unrestricted(folder.path());
    let mut read_buffer_uri = |uri: String| {
        model.json["buffers"][0]["uri"] = uri.into();
        std::fs::write(folder.path().join("sub/model.gltf"), model.json.to_string()).expect("a writable file");
        super::read(&files, "sub/model.gltf", CreaseAngle::default())
    };
    let data = base64::engine::general_purpose::STANDARD.encode(&Model::triangle().bin);
    let from_data_uri = read_buffer_uri(format!("data:application/octet-stream;base64,{data}")).expect("a valid model");
    let from_file = read_buffer_uri("my%20buffer.bin".into()).expect("a valid model");
    assert_eq!(from_data_uri.shapes[0].mesh, from_file.shapes[0].mesh);
    assert_eq!((from_file.name.as_str(), from_file.domains[0].name.as_str()), ("model", "one.0"));
    let secret = folder.path().join("secret.bin");
    for uri in
        ["../secret.bin", "%2e%2e/secret.bin", "file:///x", "https://host/x", secret.to_str().expect("a UTF-8 path")]
    {
        let message = read_buffer_uri(uri.into()).expect_err(uri).to_string();
        let expected =
            "file 'sub/model.gltf': buffers[0]: uri: expected a data URI or a path in or below the model's folder";
        assert!(message.starts_with(expected), "{message}");
    }
    let message = read_buffer_uri("absent.bin".into()).expect_err("a missing file").to_string();
    assert!(message.contains("buffers[0]: file 'absent.bin'"), "{message}");
}

#[test]
fn unsupported_features_are_reported_or_rejected() {
    let model = Model::triangle()
        .with("/animations", json!([{"channels": [{"x": 1}]}, {}]))
        .with("/cameras", json!([{}]))
        .with("/extensionsUsed", json!(["KHR_materials_unlit", "KHR_texture_transform", "KHR_texture_basisu"]))
        .with("/extensionsRequired", json!(["KHR_texture_transform", "KHR_texture_basisu"]));
    let remarks = model.parts().remarks;
    for feature in ["KHR_materials_unlit", "KHR_texture_basisu", "animations (2)", "cameras (1)"] {
        assert_eq!(
            remarks.iter().filter(|remark| remark.contains(feature)).count(),
            1,
            "expected one remark on {feature}, got {remarks:?}"
        );
    }
    let convert = "(convert it in its folder with `gltf-transform copy model.glb model.uncompressed.glb`";
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = AssetDir::unrestricted(folder.path());
    let read = |name: &str, files: &AssetDir| {
        let content = Model::triangle().with("/extensionsRequired", json!([name])).to_glb();
        super::parse(files, "model", &content, CreaseAngle::default()).map(drop)
    };
    for (name, expected) in [
        ("KHR_draco_mesh_compression", convert),
        ("EXT_meshopt_compression", convert),
        ("EXT_mesh_gpu_instancing", "no extension that changes geometry, got EXT_mesh_gpu_instancing"),
        ("VENDOR_unknown", "a known extension, because others can change geometry, got VENDOR_unknown"),
    ] {
        let message = read(name, &files).expect_err(name).to_string();
        assert!(message.starts_with("extensionsRequired[0]") && message.contains(expected), "{message}");
    }
    let text = Model::triangle().with("/extensionsRequired", json!(["KHR_draco_mesh_compression"])).json.to_string();
    let message = super::parse(&files, "model", text.as_bytes(), CreaseAngle::default()).map(drop).expect_err("a text");
    assert!(message.to_string().contains("copy model.gltf model.uncompressed.glb"), "{message}");
    for name in ["KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp"] {
        read(name, &files.strict()).expect("a supported extension");
    }
    for name in ["KHR_materials_unlit", "KHR_techniques_webgl", "KHR_texture_basisu"] {
        read(name, &files).expect("an extension that can be ignored");
        let message = read(name, &files.strict()).expect_err("strict mode").to_string();
        assert!(message.contains("expected an extension that is supported"), "{message}");
    }
}

/// Lists are objects with names in glTF 1.0, whose version was optional.
#[test]
fn older_versions_are_named() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = AssetDir::unrestricted(folder.path());
    let message_of = |content: &[u8]| {
        super::parse(&files, "model", content, CreaseAngle::default()).map(drop).expect_err("an old file").to_string()
    };
    let lists = json!({"scenes": {"main": {"nodes": ["root"]}}, "meshes": {}, "accessors": {}});
    for (asset, version) in [
        (json!({"version": "1.0", "profile": {"api": "WebGL"}}), "1.0"),
        (json!({"version": 1.1}), "1.1"),
        (json!(null), "1.0"),
    ] {
        let mut document = lists.clone();
        document["asset"] = asset;
        let expected = format!("asset.version: expected 2.0, got {version}: convert the file to glTF 2.0");
        assert_eq!(message_of(document.to_string().as_bytes()), expected);
    }
    let mut glb = Model::triangle().to_glb();
    glb[4] = 1;
    assert_eq!(message_of(&glb), "glb.version: expected 2, got 1: convert the file to glTF 2.0");
    let mut document = lists;
    document["asset"] = json!({"version": "2.0"});
    assert!(!message_of(document.to_string().as_bytes()).contains("asset.version"), "control: the version is right");
}

/// Positions and indices that are zero except for sparse values.
#[test]
fn sparse_accessors_without_dense_values_are_read() {
    let mut model = Model::triangle();
    let add_sparse = |model: &mut Model, component: u64, kind: &str, elements: [u8; 2], values: &[u8]| {
        let (indices, values) = (model.add_view(&elements), model.add_view(values));
        let sparse = json!({
            "count": 2, "indices": {"bufferView": indices, "componentType": U8}, "values": {"bufferView": values}
        });
        let accessor = json!({"componentType": component, "type": kind, "count": 3, "sparse": sparse});
        push(&mut model.json["accessors"], accessor)
    };
    let moved = [2.0_f32, 0.0, 0.0, 0.0, 3.0, 0.0];
    let positions = add_sparse(&mut model, F32, "VEC3", [1, 2], bytemuck::cast_slice(&moved));
    let indices = add_sparse(&mut model, U16, "SCALAR", [0, 1], bytemuck::cast_slice(&[2_u16, 1]));
    model.primitive()["attributes"]["POSITION"] = positions.into();
    model.primitive()["indices"] = indices.into();
    let parts = model.parts();
    let mesh = &parts.shapes[0].mesh;
    assert_eq!(mesh.rest_positions(), [[0.0; 3], [2.0, 0.0, 0.0], [0.0, 3.0, 0.0]]);
    assert_eq!(mesh.triangles()[0].map(|corner| mesh.corners().vertices[corner as usize]), [2, 1, 0]);
    let large = model.with(&format!("/accessors/{positions}/count"), json!(1_u64 << 30));
    let message = large.read().map(drop).expect_err("too many zeros").to_string();
    assert!(message.contains("count: expected at most 4194304 without a bufferView, got 1073741824"), "{message}");
}

/// Positions as signed shorts in the scale of the node, and normals and texture coordinates as normalized bytes.
#[test]
fn quantized_attributes_are_decoded() {
    let mut model = Model::triangle();
    let positions = [0_i16, 0, 0, 0, 100, 0, 0, 0, 0, -100, 0, 0];
    let positions = model.add_accessor(bytemuck::cast_slice(&positions), 5122, "VEC3", 3);
    let normals =
        model.add_accessor(bytemuck::cast_slice(&[0_i8, 0, -128, 0, 0, 0, 127, 0, 127, 0, 0, 0]), 5120, "VEC3", 3);
    let uvs = model.add_accessor(&[0, 255, 0, 0, 51, 0, 0, 0, 255, 255, 0, 0], U8, "VEC2", 3);
    for (accessor, stride) in [(positions, 8), (normals, 4), (uvs, 4)] {
        let view = model.json["accessors"][accessor]["bufferView"].as_u64().expect("a view") as usize;
        model.json["bufferViews"][view]["byteStride"] = stride.into();
    }
    for accessor in [normals, uvs] {
        model.json["accessors"][accessor]["normalized"] = true.into();
    }
    model.primitive()["attributes"] = json!({"POSITION": positions, "NORMAL": normals, "TEXCOORD_0": uvs});
    let parts = model.parts();
    let mesh = &parts.shapes[0].mesh;
    assert_eq!(mesh.rest_positions(), [[0.0; 3], [100.0, 0.0, 0.0], [0.0, -100.0, 0.0]]);
    assert_eq!(mesh.corners().normals, [[0.0, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]);
    assert_eq!(mesh.corners().uvs, [[0.0, 1.0], [0.2, 0.0], [1.0, 1.0]]);
}

/// A normal that is not a number is computed, and a position that is not a number is an error only if a triangle uses it.
#[test]
fn numbers_that_do_not_matter_are_remarks() {
    let mut model = Model::triangle();
    let normals = model.add_floats("VEC3", 3, &[0.0, 0.0, 1.0, f32::NAN, 0.0, 0.0, 0.0, 0.0, 1.0]);
    model.primitive()["attributes"]["NORMAL"] = normals.into();
    let parts = model.parts();
    assert_eq!(parts.shapes[0].mesh.corners().normals, [[0.0, 0.0, 1.0]; 3]);
    assert!(parts.remarks[0].starts_with("attributes.NORMAL: expected finite numbers"), "{:?}", parts.remarks);
    let mut model = Model::triangle();
    let four = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, f32::NAN, 0.0, 0.0];
    let positions = model.add_floats("VEC3", 4, &four);
    let indices = |last: u16| bytemuck::cast_slice::<u16, u8>(&[0, 1, last]).to_vec();
    let used = model.add_accessor(&indices(3), U16, "SCALAR", 3);
    let unused = model.add_accessor(&indices(2), U16, "SCALAR", 3);
    model.primitive()["attributes"]["POSITION"] = positions.into();
    model.primitive()["indices"] = unused.into();
    let parts = model.parts();
    assert!(parts.remarks[0].contains("no triangle uses the vertex"), "{:?}", parts.remarks);
    model.primitive()["indices"] = used.into();
    let message = model.read().expect_err("a used position").to_string();
    assert!(message.contains("attributes.POSITION: element 3: expected finite numbers, got [NaN"), "{message}");
}

/// A mesh is drawn where its joints are. Its own node does not move it.
#[test]
fn skinned_meshes_have_the_pose_of_their_joints() {
    let mut model = Model::triangle();
    let joints = model.add_accessor(&[0, 1, 0, 0, 0, 1, 0, 0, 1, 0, 0, 0], U8, "VEC4", 3);
    let weights = [1.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0];
    let weights = model.add_floats("VEC4", 3, &weights);
    let mut bind = [0.0_f32; 32];
    for diagonal in [0, 5, 10, 15, 16, 21, 26, 31] {
        bind[diagonal] = 1.0;
    }
    // The inverse bind matrix of the second joint moves by -5 along x.
    bind[28] = -5.0;
    let bind = model.add_floats("MAT4", 2, &bind);
    let target = model.add_floats("VEC3", 3, &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
    model.primitive()["attributes"]["JOINTS_0"] = joints.into();
    model.primitive()["attributes"]["WEIGHTS_0"] = weights.into();
    model.primitive()["targets"] = json!([{"POSITION": target}]);
    model.json["skins"] = json!([{"joints": [1, 2], "inverseBindMatrices": bind}]);
    // The first joint turns by 90 degrees about z and moves by 1 along y. The second moves by 5 along x and 2 along z.
    let half = std::f64::consts::FRAC_1_SQRT_2;
    model.json["nodes"] = json!([
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0], "scale": [100, 100, 100]},
        {"translation": [0, 1, 0], "rotation": [0, 0, half, half]},
        {"translation": [5, 0, 2]}
    ]);
    model.json["scenes"] = json!([{"nodes": [0, 1, 2]}]);
    let parts = model.parts();
    assert_eq!(parts.domains[0].placement, crate::domain::Transform::IDENTITY);
    let is_near = |given: [f32; 3], expected: [f32; 3]| (0..3).all(|axis| (given[axis] - expected[axis]).abs() < 1e-6);
    let positions = parts.shapes[0].mesh.rest_positions();
    for (given, expected) in positions.iter().zip([[0.0, 1.0, 0.0], [0.5, 1.0, 1.0], [0.0, 1.0, 2.0]]) {
        assert!(is_near(*given, expected), "expected {expected:?}, got {positions:?}");
    }
    let column = parts.shapes[0].modes.column(0);
    assert!(
        is_near([column[0], column[1], column[2]], [0.0, 1.0, 0.0]),
        "expected a turned displacement, got {column:?}"
    );
    assert!(is_near([column[6], column[7], column[8]], [1.0, 0.0, 0.0]), "{column:?}");
    let rest = model.with("/nodes/0", json!({"mesh": 0})).parts();
    assert_eq!(rest.shapes[0].mesh.rest_positions()[1], [1.0, 0.0, 0.0], "control: without a skin");
    let missing = Model::triangle().with("/skins", json!([{"joints": [9]}])).with("/nodes/0/skin", json!(0));
    let message = missing.read().expect_err("a missing joint").to_string();
    assert!(message.contains("skins[0]: joints[0]: expected a node of the scene, got 9"), "{message}");
}

#[test]
fn only_the_default_scene_is_loaded() {
    let model = Model::triangle()
        .with("/nodes", json!([{"name": "a", "mesh": 0}, {"name": "b", "mesh": 0}]))
        .with("/scenes", json!([{"nodes": [0]}, {"nodes": [1]}]))
        .with("/scene", json!(1));
    let parts = model.parts();
    assert_eq!((parts.domains.len(), parts.domains[0].name.as_str()), (1, "b.0"));
    assert_eq!(parts.remarks, ["only scene 1 of 2 scenes is loaded"]);
    let parts_without_scenes = model.with("/scenes", json!([])).with("/scene", Value::Null).parts();
    assert_eq!(parts_without_scenes.domains.len(), 2);
}
