//! Tests with malformed models. Each model is rejected with the name of its field, and none causes a panic.

use serde_json::json;

use super::materials::{encode_png, textured_triangle};
use super::{F32, Model, U8, U16, morphed_triangle, push};
use crate::domain::CreaseAngle;
use crate::load::asset_dir::AssetDir;
use crate::load::gltf::buffers::{GltfBuffers, MEMORY_BUDGET};
use crate::load::gltf::remarks::ImportRemarks;
use crate::load::gltf::{assemble, container};
use crate::scene::Scene;

/// A textured, morphed, indexed model that covers every part of the loader. Accessors: 0 positions, 1 and 2 texture
/// coordinates, 3 indices, 4 and 5 morph targets, of which 5 is sparse. Node 1 is the parent of node 0.
fn complete_model() -> Model {
    let mut model = textured_triangle(json!({
        "alphaMode": "MASK", "normalTexture": {"index": 1},
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 0}}
    }));
    let indices = model.add_accessor(bytemuck::cast_slice(&[0_u16, 1, 2]), U16, "SCALAR", 3);
    let target = model.add_floats("VEC3", 3, &[0.25; 9]);
    let sparse_indices = model.add_view(&[0, 2]);
    let sparse_values = model.add_view(bytemuck::cast_slice(&[1.0_f32; 6]));
    let sparse = json!({
        "componentType": F32, "type": "VEC3", "count": 3,
        "sparse": {
            "count": 2,
            "indices": {"bufferView": sparse_indices, "componentType": U8},
            "values": {"bufferView": sparse_values}
        }
    });
    let sparse_accessor = push(&mut model.json["accessors"], sparse);
    model.primitive()["indices"] = indices.into();
    model.primitive()["targets"] = json!([{"POSITION": target}, {"POSITION": sparse_accessor}]);
    model.json["meshes"][0]["weights"] = json!([0.5, 0.25]);
    push(&mut model.json["nodes"], json!({"children": [0], "translation": [1, 2, 3]}));
    model.with("/scenes/0/nodes", json!([1]))
}

/// Asserts that the model is rejected with an error that contains `field`.
fn assert_rejected(model: &Model, field: &str) {
    let message = model.read().err().unwrap_or_else(|| panic!("{field}: expected an error")).to_string();
    assert!(message.contains(field), "expected an error about '{field}', got '{message}'");
    assert!(message.contains("expected") && message.contains(", got "), "{message}");
}

#[test]
fn complete_model_is_valid() {
    let parts = complete_model().parts();
    assert_eq!((parts.domains.len(), parts.textures.len(), parts.shapes[0].modes.rank()), (1, 1, 2));
    assert_eq!(parts.shapes[0].modes.column(1), [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
    Scene::new(parts).expect("a valid scene");
}

#[test]
fn out_of_range_numbers_are_rejected_by_field() {
    // The size in bytes of 2^62 positions (12 bytes each) or 2^63 indices (2 bytes each) overflows 64 bits. The size of
    // 2^62 / 12 positions or 2^62 indices does not overflow, but exceeds the buffer view.
    let two_to_62 = 1_u64 << 62;
    let two_to_63 = 1_u64 << 63;
    let u64_max = u64::MAX;
    for (pointer, value, field) in [
        ("/accessors/0/count", json!(two_to_62), "attributes.POSITION: accessors[0]: count"),
        ("/accessors/0/count", json!(two_to_62 / 12), "accessors[0]: byteOffset + stride x (count - 1) + size"),
        ("/accessors/0/count", json!(4), "accessors[0]: byteOffset + stride x (count - 1) + size"),
        ("/accessors/0/count", json!(0), "accessors[0]: count"),
        ("/accessors/0/count", json!(-1), "accessors[0]"),
        ("/accessors/0/byteOffset", json!(two_to_63), "accessors[0]: byteOffset"),
        ("/accessors/0/byteOffset", json!(u64_max), "accessors[0]: byteOffset"),
        ("/accessors/0/byteOffset", json!(4), "accessors[0]: byteOffset"),
        ("/accessors/0/bufferView", json!(99), "accessors[0]: bufferView"),
        ("/accessors/0/bufferView", json!(null), "accessors[0]: bufferView"),
        ("/accessors/0/componentType", json!(5125), "accessors[0]: componentType"),
        ("/accessors/0/type", json!("VEC4"), "accessors[0]: type"),
        ("/accessors/3/count", json!(two_to_62), "indices: accessors[3]: byteOffset"),
        ("/accessors/3/count", json!(two_to_63), "indices: accessors[3]: count"),
        ("/accessors/3/type", json!("VEC3"), "indices: accessors[3]: type"),
        ("/accessors/3/componentType", json!(F32), "indices: accessors[3]: componentType"),
        ("/accessors/3/count", json!(2), "meshes[0].primitives[0]: indices"),
        ("/accessors/4/count", json!(2), "targets[0].POSITION: accessors[4]: count"),
        ("/accessors/5/count", json!(two_to_62), "targets[1].POSITION: accessors[5]: count"),
        ("/accessors/5/sparse/count", json!(0), "accessors[5]: sparse: count"),
        ("/accessors/5/sparse/count", json!(4), "accessors[5]: sparse: count"),
        ("/accessors/5/sparse/count", json!(3), "accessors[5]: sparse: indices: byteOffset"),
        ("/accessors/5/sparse/indices/componentType", json!(F32), "sparse: indices: componentType"),
        ("/accessors/5/sparse/values/bufferView", json!(77), "sparse: values: bufferView"),
        ("/accessors/5/sparse/values/byteOffset", json!(u64_max), "sparse: values: byteOffset"),
        ("/bufferViews/0/byteLength", json!(1_u64 << 60), "bufferViews[0]: byteOffset + byteLength"),
        ("/bufferViews/0/byteOffset", json!(u64_max), "bufferViews[0]: byteOffset + byteLength"),
        ("/bufferViews/0/byteLength", json!(35), "accessors[0]: byteOffset"),
        ("/bufferViews/0/buffer", json!(1), "bufferViews[0]: buffer"),
        ("/bufferViews/0/byteStride", json!(8), "accessors[0]: bufferView.byteStride"),
        ("/bufferViews/0/byteStride", json!(0), "accessors[0]: bufferView.byteStride"),
        ("/bufferViews/0/byteStride", json!(u64_max), "accessors[0]: byteOffset"),
        ("/buffers/0/byteLength", json!(1_u64 << 40), "buffers[0]: byteLength"),
        ("/meshes/0/weights", json!([1]), "nodes[0]: weights"),
        ("/nodes/0/rotation", json!([0, 0, 0, 0]), "nodes[0]: rotation"),
        ("/nodes/0/matrix", json!([1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "nodes[0]: matrix"),
        ("/nodes/0/translation", json!([1e39, 0, 0]), "nodes[0]: transform[3]"),
    ] {
        assert_rejected(&complete_model().with(pointer, value), field);
    }
}

#[test]
fn invalid_references_and_types_are_rejected_by_field() {
    for (pointer, value, field) in [
        ("/meshes/0/primitives/0/attributes/POSITION", json!(99), "attributes.POSITION: accessor"),
        ("/meshes/0/primitives/0/attributes", json!({"NORMAL": 0}), "primitives[0]: attributes.POSITION"),
        ("/meshes/0/primitives/0/indices", json!(99), "indices: accessor"),
        ("/meshes/0/primitives/0/material", json!(9), "primitives[0]: material"),
        ("/meshes/0/primitives/0/mode", json!(7), "primitives[0]: mode"),
        ("/meshes/0/primitives", json!([]), "scenes"),
        ("/nodes/0/mesh", json!(5), "nodes[0]: mesh"),
        ("/nodes/1/children", json!([0, 7]), "nodes[1].children[1]"),
        ("/nodes/1/children", json!([0, 0]), "nodes[1].children[1]"),
        ("/nodes/1/children", json!([1]), "nodes[1].children"),
        ("/nodes/0/children", json!([1]), "nodes[0].children"),
        ("/scene", json!(4), "scene"),
        ("/scenes/0/nodes", json!([8]), "scenes[0]: nodes[0]"),
        ("/scenes/0/nodes", json!([0]), "scenes[0]: nodes[0]"),
        ("/scenes/0/nodes", json!([1, 1]), "scenes[0]: nodes[1]"),
        ("/textures/0/source", json!(6), "textures[0].source"),
        ("/textures/1/sampler", json!(6), "textures[1].sampler"),
        ("/images/0/bufferView", json!(null), "images[0]: uri"),
        ("/images/0/uri", json!("data:text/plain,abc"), "images[0]: uri"),
        ("/buffers/0/uri", json!("../secret.bin"), "buffers[0]: uri"),
        ("/buffers/0/uri", json!("/etc/hostname"), "buffers[0]: uri"),
        ("/buffers/0/uri", json!("data:text/plain,abc"), "buffers[0]: uri"),
        ("/buffers/0/uri", json!("data:;base64,%%%"), "buffers[0]: uri"),
        ("/buffers/0/uri", json!("data:;base64,AAAA"), "buffers[0]: byteLength"),
        ("/buffers", json!([]), "bufferViews"),
        ("/asset/version", json!("1.0"), "asset.version"),
        ("/asset/minVersion", json!("2.1"), "asset.version"),
        ("/accessors/0/type", json!(3), "accessors[0]"),
        ("/meshes/0/primitives/0/attributes/POSITION", json!("0"), "meshes[0]"),
        ("/materials/0/doubleSided", json!("yes"), "materials[0]"),
    ] {
        assert_rejected(&complete_model().with(pointer, value), field);
    }
}

#[test]
fn invalid_indices_and_non_finite_numbers_are_rejected() {
    let mut model = Model::triangle();
    let indices = model.add_accessor(bytemuck::cast_slice(&[0_u16, 1, 3]), U16, "SCALAR", 3);
    model.primitive()["indices"] = indices.into();
    assert_rejected(&model, "indices: accessors[1]: element 2: expected an index below 3, got 3");
    // In `morphed_triangle`, the positions are bytes 0 to 35, and the first column of U begins at byte 36.
    for invalid_number in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut model = morphed_triangle();
        model.bin[16..20].copy_from_slice(&invalid_number.to_le_bytes());
        assert_rejected(&model, "attributes.POSITION: element 1");
        let mut model = morphed_triangle();
        model.bin[36..40].copy_from_slice(&invalid_number.to_le_bytes());
        assert_rejected(&model, "targets[0].POSITION: element 0");
    }
    let mut model = complete_model();
    let view = model.add_view(&[2, 0]);
    assert_rejected(&model.with("/accessors/5/sparse/indices/bufferView", json!(view)), "sparse: indices");
    let mut model = complete_model();
    let view = model.add_view(&[1, 3]);
    assert_rejected(&model.with("/accessors/5/sparse/indices/bufferView", json!(view)), "sparse: indices");
}

#[test]
fn mode_and_memory_limits_are_checked_before_allocation() {
    let targets: Vec<_> = (0..513).map(|_| json!({"POSITION": 0})).collect();
    assert_rejected(&Model::triangle().with("/meshes/0/primitives/0/targets", targets.into()), "targets");
    // Use all but `remaining_budget` bytes of the budget before the model is assembled.
    let model = complete_model();
    let document = container::parse_document(model.json.to_string().as_bytes()).expect("a valid document");
    let folder = AssetDir::unrestricted(&std::env::temp_dir());
    for (remaining_budget, is_enough) in [(100, false), (10_000, true)] {
        let buffers = GltfBuffers::load(&document, &folder, Some(&model.bin)).expect("valid buffers");
        buffers.charge_budget(MEMORY_BUDGET - remaining_budget).expect("within the budget");
        let result = assemble::assemble("model", &document, &buffers, CreaseAngle::default(), ImportRemarks::default());
        assert_eq!(result.is_ok(), is_enough);
        assert!(is_enough || result.is_err_and(|error| error.to_string().contains("decoded size: expected at most")));
    }
}

#[test]
fn truncated_and_patched_glb_headers_are_rejected() {
    let folder = AssetDir::unrestricted(&std::env::temp_dir());
    let glb = complete_model().to_glb();
    let parse = |bytes: &[u8]| super::super::parse(&folder, "cut", bytes, CreaseAngle::default());
    for length in 0..glb.len() {
        let message = parse(&glb[..length]).expect_err("a truncated file").to_string();
        assert!(message.contains("expected"), "{message}");
        // With a corrected header length, the chunks are too long.
        if length >= 12 {
            let mut truncated = glb[..length].to_vec();
            truncated[8..12].copy_from_slice(&(length as u32).to_le_bytes());
            assert!(parse(&truncated).is_err(), "{length} of {} bytes: expected an error", glb.len());
        }
    }
    let parse_patched = |offset: usize, word: u32| {
        let mut patched = glb.clone();
        patched[offset..offset + 4].copy_from_slice(&word.to_le_bytes());
        parse(&patched).expect_err("a patched header").to_string()
    };
    for (offset, word, field) in [
        (4, 1, "glb.version"),
        (8, u32::MAX, "glb.length"),
        (12, u32::MAX, "glb.chunk.length"),
        (16, 0, "glb.chunk[0].type"),
    ] {
        let message = parse_patched(offset, word);
        assert!(message.starts_with(field), "{message}");
    }
    assert!(
        parse(&[glb.as_slice(), &[0]].concat()).expect_err("a trailing byte").to_string().starts_with("glb.length")
    );
}

#[test]
fn deeply_nested_or_huge_json_is_rejected() {
    let folder = AssetDir::unrestricted(&std::env::temp_dir());
    let nested_lists = format!("{{\"nodes\": {}", "[".repeat(100_000));
    let objects = format!("{{\"nodes\": [{}{{}}]}}", "{},".repeat((1 << 21) + 1));
    let commas = format!("{{\"scenes\": [{{\"nodes\": [{}0]}}]}}", "0,".repeat((1 << 24) + 1));
    for text in [nested_lists, objects, commas, String::new(), "[]".into(), "null".into()] {
        let message = super::super::parse(&folder, "json", text.as_bytes(), CreaseAngle::default())
            .expect_err("an invalid document")
            .to_string();
        assert!(message.starts_with("json: expected") || message.starts_with("asset.version"), "{message}");
    }
}

/// A xorshift generator with a fixed seed, so that each failure is reproducible.
struct XorShift(u64);

impl XorShift {
    /// A number below `limit`.
    fn next_below(&mut self, limit: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % limit as u64) as usize
    }
}

#[test]
fn mutated_glb_never_causes_a_panic() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = AssetDir::unrestricted(folder.path());
    let glb = complete_model().to_glb();
    let digit_offsets: Vec<usize> = (20..glb.len()).filter(|offset| glb[*offset].is_ascii_digit()).collect();
    let mut random = XorShift(0x9E37_79B9_7F4A_7C15);
    let (mut accepted_count, mut rejected_count) = (0, 0);
    for round in 0..6000 {
        let mut bytes = glb.clone();
        for _ in 0..=random.next_below(3) {
            // Half of the rounds change only digits. The JSON remains valid, so these rounds test the later stages.
            match round % 2 {
                0 => bytes[random.next_below(glb.len())] ^= 1 << random.next_below(8),
                _ => bytes[digit_offsets[random.next_below(digit_offsets.len())]] = b'0' + random.next_below(10) as u8,
            }
        }
        match super::super::parse(&files, "mutant", &bytes, CreaseAngle::default()) {
            Ok(parts) => {
                accepted_count += 1;
                // Validation must not panic either; its result does not matter.
                let _ = Scene::new(parts);
            }
            Err(_) => rejected_count += 1,
        }
    }
    assert!(
        accepted_count > 300 && rejected_count > 300,
        "control: expected over 300 each, got {accepted_count} and {rejected_count}"
    );
}

#[test]
fn image_beyond_the_size_limit_is_rejected() {
    let mut large_png = encode_png([1, 2, 3, 4]);
    // Patch the width in the PNG header. The decoder may reject the wrong checksum of the header first.
    large_png[16..20].copy_from_slice(&100_000_u32.to_be_bytes());
    let mut model = complete_model();
    let view = model.add_view(&large_png);
    assert_rejected(&model.with("/images/0/bufferView", json!(view)), "images[0]: texture 'swatch'");
}

/// Values of materials that do not prevent a picture.
#[test]
fn values_out_of_range_are_remarks_but_errors_in_strict_mode() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = crate::load::asset_dir::AssetDir::unrestricted(folder.path()).strict();
    for (pointer, value, remark) in [
        (
            "/materials/0/pbrMetallicRoughness/baseColorFactor",
            json!([1, 1, 1, 7]),
            Some("baseColorFactor: expected 0 to 1, got 7"),
        ),
        ("/materials/0/pbrMetallicRoughness/baseColorFactor", json!([1.000_000_2, 1, 1, 1]), None),
        (
            "/materials/0/pbrMetallicRoughness/roughnessFactor",
            json!(-0.5),
            Some("roughnessFactor: expected 0 to 1, got -0.5"),
        ),
        ("/materials/0/alphaCutoff", json!(3), Some("alphaCutoff: expected 0 to 1, got 3")),
        ("/materials/0/alphaMode", json!("GHOST"), Some("alphaMode: expected OPAQUE, MASK or BLEND, got GHOST")),
    ] {
        let model = complete_model().with(pointer, value);
        let remarks = model.parts().remarks;
        let found = remark.is_some_and(|remark| remarks.iter().any(|given| given.contains(remark)));
        assert_eq!(found, remark.is_some(), "expected {remark:?}, got {remarks:?}");
        let strict = super::super::parse(&files, "model", &model.to_glb(), CreaseAngle::default()).map(drop);
        match remark {
            Some(remark) => assert!(strict.expect_err(pointer).to_string().contains(remark)),
            None => strict.expect("a valid model"),
        }
    }
}
