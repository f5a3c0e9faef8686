//! Malformed models: each is rejected with the name of its field, and none causes a panic.

use serde_json::json;

use super::materials::{png, textured};
use super::{F32, Model, U16, morphed, push};
use crate::load::asset_dir::AssetDir;
use crate::load::gltf::buffers::{GltfBuffers, MEMORY_BUDGET};
use crate::load::gltf::warnings::ImportWarnings;
use crate::load::gltf::{assemble, container};
use crate::scene::Scene;

/// A textured, morphed, indexed model that covers every part of the reader.
fn full() -> Model {
    let mut model = textured(json!({
        "alphaMode": "MASK", "normalTexture": {"index": 1},
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 0}}
    }));
    let indices = model.accessor(bytemuck::cast_slice(&[0_u16, 1, 2]), U16, "SCALAR", 3);
    let target = model.floats("VEC3", 3, &[0.25; 9]);
    let places = model.view(&[0, 2]);
    let values = model.view(bytemuck::cast_slice(&[1.0_f32; 6]));
    let sparse = json!({
        "componentType": F32, "type": "VEC3", "count": 3,
        "sparse": {
            "count": 2,
            "indices": {"bufferView": places, "componentType": 5121},
            "values": {"bufferView": values}
        }
    });
    let sparse = push(&mut model.json["accessors"], sparse);
    model.primitive()["indices"] = indices.into();
    model.primitive()["targets"] = json!([{"POSITION": target}, {"POSITION": sparse}]);
    model.json["meshes"][0]["weights"] = json!([0.5, 0.25]);
    push(&mut model.json["nodes"], json!({"children": [0], "translation": [1, 2, 3]}));
    model.with("/scenes/0/nodes", json!([1]))
}

fn refused(model: &Model, field: &str) {
    let refusal = model.read().err().unwrap_or_else(|| panic!("{field}: not refused")).to_string();
    assert!(refusal.contains(field), "'{refusal}' does not name '{field}'");
    assert!(refusal.contains("expected") && refusal.contains(", got "), "{refusal}");
}

#[test]
fn the_full_model_itself_is_sound() {
    let parts = full().parts();
    assert_eq!((parts.domains.len(), parts.textures.len(), parts.shapes[0].modes.rank()), (1, 1, 2));
    assert_eq!(parts.shapes[0].modes.column(1), [1.0, 1.0, 1.0, 0.0, 0.0, 0.0, 1.0, 1.0, 1.0]);
    Scene::new(parts).expect("a scene");
}

#[test]
fn numbers_out_of_range_are_refused_by_their_field() {
    let two_to_62 = 1_u64 << 62;
    let two_to_63 = 1_u64 << 63;
    let most = u64::MAX;
    for (pointer, value, field) in [
        ("/accessors/0/count", json!(two_to_62), "attributes.POSITION: accessors[0]: count"),
        ("/accessors/0/count", json!(two_to_62 / 12), "accessors[0]: byteOffset + stride x (count - 1) + size"),
        ("/accessors/0/count", json!(4), "accessors[0]: byteOffset + stride x (count - 1) + size"),
        ("/accessors/0/count", json!(0), "accessors[0]: count"),
        ("/accessors/0/count", json!(-1), "accessors[0]"),
        ("/accessors/0/byteOffset", json!(two_to_63), "accessors[0]: byteOffset"),
        ("/accessors/0/byteOffset", json!(most), "accessors[0]: byteOffset"),
        ("/accessors/0/byteOffset", json!(4), "accessors[0]: byteOffset"),
        ("/accessors/0/bufferView", json!(99), "accessors[0]: bufferView"),
        ("/accessors/0/bufferView", json!(null), "accessors[0]: bufferView"),
        ("/accessors/0/componentType", json!(5122), "accessors[0]: componentType"),
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
        ("/accessors/5/sparse/values/byteOffset", json!(most), "sparse: values: byteOffset"),
        ("/bufferViews/0/byteLength", json!(1_u64 << 60), "bufferViews[0]: byteOffset + byteLength"),
        ("/bufferViews/0/byteOffset", json!(most), "bufferViews[0]: byteOffset + byteLength"),
        ("/bufferViews/0/byteLength", json!(35), "accessors[0]: byteOffset"),
        ("/bufferViews/0/buffer", json!(1), "bufferViews[0]: buffer"),
        ("/bufferViews/0/byteStride", json!(8), "accessors[0]: bufferView.byteStride"),
        ("/bufferViews/0/byteStride", json!(0), "accessors[0]: bufferView.byteStride"),
        ("/bufferViews/0/byteStride", json!(most), "accessors[0]: byteOffset"),
        ("/buffers/0/byteLength", json!(1_u64 << 40), "buffers[0]: byteLength"),
        ("/materials/0/pbrMetallicRoughness/baseColorFactor", json!([1, 1, 1, 7]), "baseColorFactor[3]"),
        ("/materials/0/pbrMetallicRoughness/roughnessFactor", json!(-0.5), "roughnessFactor"),
        ("/materials/0/alphaCutoff", json!(3), "cutoff"),
        ("/materials/0/alphaMode", json!("GHOST"), "materials[0]: alphaMode"),
        ("/meshes/0/weights", json!([1]), "nodes[0]: weights"),
        ("/nodes/0/rotation", json!([0, 0, 0, 0]), "nodes[0]: rotation"),
        ("/nodes/0/matrix", json!([1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]), "nodes[0]: matrix"),
        ("/nodes/0/translation", json!([1e39, 0, 0]), "nodes[0]: transform[3]"),
    ] {
        refused(&full().with(pointer, value), field);
    }
}

#[test]
fn references_to_nothing_are_refused_by_their_field() {
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
        ("/textures/0/source", json!(null), "textures[0].source"),
        ("/textures/1/sampler", json!(6), "textures[1].sampler"),
        ("/images/0/bufferView", json!(0), "images[0]: texture 'swatch'"),
        ("/images/0/bufferView", json!(null), "images[0]: uri"),
        ("/images/0/uri", json!("../secret.png"), "images[0]: uri"),
        ("/images/0/uri", json!("file:///x"), "images[0]: uri"),
        ("/images/0/uri", json!("absent-from-this-folder.png"), "images[0]: file 'absent-from-this-folder.png'"),
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
        refused(&full().with(pointer, value), field);
    }
}

#[test]
fn an_index_beyond_the_vertices_numbers_that_are_not_finite_and_unsorted_sparse_places_are_refused() {
    let mut model = Model::triangle();
    let indices = model.accessor(bytemuck::cast_slice(&[0_u16, 1, 3]), U16, "SCALAR", 3);
    model.primitive()["indices"] = indices.into();
    refused(&model, "indices: accessors[1]: element 2: expected an index below 3, got 3");
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        let mut model = morphed();
        model.bin[16..20].copy_from_slice(&bad.to_le_bytes());
        refused(&model, "mesh.positions[1]");
        let mut model = morphed();
        model.bin[36..40].copy_from_slice(&bad.to_le_bytes());
        refused(&model, "modes[0, 0]");
    }
    let mut model = full();
    let view = model.view(&[2, 0]);
    refused(&model.with("/accessors/5/sparse/indices/bufferView", json!(view)), "sparse: indices");
    let mut model = full();
    let view = model.view(&[1, 3]);
    refused(&model.with("/accessors/5/sparse/indices/bufferView", json!(view)), "sparse: indices");
}

#[test]
fn more_modes_or_memory_than_the_limits_are_refused_before_they_are_allocated() {
    let targets: Vec<_> = (0..513).map(|_| json!({"POSITION": 0})).collect();
    refused(&Model::triangle().with("/meshes/0/primitives/0/targets", targets.into()), "targets");
    // A small model that follows so much other data that little of the budget is left.
    let model = full();
    let document = container::parse(model.json.to_string().as_bytes()).expect("parses");
    let folder = AssetDir::unrestricted(&std::env::temp_dir());
    for (left, fits) in [(100, false), (10_000, true)] {
        let bytes = GltfBuffers::load(&document, &folder, Some(&model.bin)).expect("there");
        bytes.charge_budget(MEMORY_BUDGET - left).expect("within the budget");
        let parts = assemble::assemble("model", &document, &bytes, ImportWarnings::default());
        assert_eq!(parts.is_ok(), fits);
        assert!(fits || parts.is_err_and(|error| error.to_string().contains("decoded size: expected at most")));
    }
}

#[test]
fn a_glb_cut_short_or_with_false_lengths_is_refused_at_every_length() {
    let folder = AssetDir::unrestricted(&std::env::temp_dir());
    let glb = full().glb();
    let parse = |bytes: &[u8]| super::super::parse(&folder, "cut", bytes);
    for length in 0..glb.len() {
        let refusal = parse(&glb[..length]).expect_err("cut short").to_string();
        assert!(refusal.contains("expected"), "{refusal}");
        // With a corrected header length, the chunks are too long.
        if length >= 12 {
            let mut mended = glb[..length].to_vec();
            mended[8..12].copy_from_slice(&(length as u32).to_le_bytes());
            assert!(parse(&mended).is_err(), "{length} of {}", glb.len());
        }
    }
    let patched = |place: usize, word: u32| {
        let mut patched = glb.clone();
        patched[place..place + 4].copy_from_slice(&word.to_le_bytes());
        parse(&patched).expect_err("patched").to_string()
    };
    for (place, word, field) in [
        (4, 1, "glb.version"),
        (8, u32::MAX, "glb.length"),
        (12, u32::MAX, "glb.chunk.length"),
        (16, 0, "glb.chunk[0].type"),
    ] {
        let refusal = patched(place, word);
        assert!(refusal.starts_with(field), "{refusal}");
    }
    assert!(parse(&[glb.as_slice(), &[0]].concat()).expect_err("too long").to_string().starts_with("glb.length"));
}

#[test]
fn deep_or_huge_json_is_refused() {
    let folder = AssetDir::unrestricted(&std::env::temp_dir());
    let deep = format!("{{\"nodes\": {}", "[".repeat(100_000));
    let objects = format!("{{\"nodes\": [{}{{}}]}}", "{},".repeat((1 << 21) + 1));
    let commas = format!("{{\"scenes\": [{{\"nodes\": [{}0]}}]}}", "0,".repeat((1 << 24) + 1));
    for text in [deep, objects, commas, String::new(), "[]".into(), "null".into()] {
        let refusal = super::super::parse(&folder, "json", text.as_bytes()).expect_err("no document").to_string();
        assert!(refusal.starts_with("json: expected") || refusal.starts_with("asset.version"), "{refusal}");
    }
}

/// A small generator of uniformly distributed words (xorshift), so that each failure is reproducible.
struct XorShift(u64);

impl XorShift {
    fn throw(&mut self, sides: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % sides as u64) as usize
    }
}

#[test]
fn no_mutation_of_a_sound_glb_makes_the_reader_panic() {
    let folder = tempfile::tempdir().expect("a folder");
    let files = AssetDir::unrestricted(folder.path());
    let sound = full().glb();
    let digits: Vec<usize> = (20..sound.len()).filter(|at| sound[*at].is_ascii_digit()).collect();
    let mut dice = XorShift(0x9E37_79B9_7F4A_7C15);
    let (mut accepted, mut refused) = (0, 0);
    for round in 0..6000 {
        let mut bytes = sound.clone();
        for _ in 0..=dice.throw(3) {
            // Half of the rounds change numbers of the JSON, which then still parses and gets deeper into the reader.
            match round % 2 {
                0 => bytes[dice.throw(sound.len())] ^= 1 << dice.throw(8),
                _ => bytes[digits[dice.throw(digits.len())]] = b'0' + dice.throw(10) as u8,
            }
        }
        match super::super::parse(&files, "mutant", &bytes) {
            Ok(parts) => {
                accepted += 1;
                // Whether or not a scene results: code after the reader must not panic either.
                let _ = Scene::new(parts);
            }
            Err(_) => refused += 1,
        }
    }
    assert!(accepted > 300 && refused > 300, "{accepted} accepted, {refused} refused: the mutations are too weak");
}

#[test]
fn an_image_over_the_limits_is_refused() {
    let mut wide = png([1, 2, 3, 4]);
    // The width in the header of a PNG. Its checksum no longer matches, which the decoder may detect first.
    wide[16..20].copy_from_slice(&100_000_u32.to_be_bytes());
    let mut model = full();
    let view = model.view(&wide);
    refused(&model.with("/images/0/bufferView", json!(view)), "images[0]: texture 'swatch'");
}
