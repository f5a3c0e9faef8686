//! Paths of images in model files: every format and every way to open a scene gives the same outcome.

use std::path::Path;
use std::sync::Arc;

use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use serde_json::json;
use sha2::{Digest as _, Sha256};

use super::{FileHashes, LoadOptions, OpenedScene, SceneRepository, open, open_with};
use crate::memory::MemoryReservation;

const INSIDE: [u8; 4] = [10, 20, 30, 255];
const OUTSIDE: [u8; 4] = [200, 0, 0, 255];

/// A folder with an image outside of the folder `scene`, and one in it.
fn create_folder() -> tempfile::TempDir {
    let outer = tempfile::tempdir().expect("a temporary folder");
    std::fs::create_dir_all(outer.path().join("scene/maps")).expect("a new folder");
    for (path, texel) in [("secret.png", OUTSIDE), ("scene/maps/Wood.png", INSIDE)] {
        let image = image::RgbaImage::from_pixel(1, 1, image::Rgba(texel));
        image.save(outer.path().join(path)).expect("a writable file");
    }
    outer
}

/// The files of a triangle with the image `reference` in each format. The first file is the model. The last text is the
/// subject of remarks.
fn models(reference: &str) -> Vec<(Vec<(&'static str, String)>, String)> {
    let obj = "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n";
    let ply = format!(
        "ply\nformat ascii 1.0\ncomment TextureFile {reference}\nelement vertex 3\nproperty float x\nproperty float y\n\
         property float z\nproperty float s\nproperty float t\nelement face 1\nproperty list uchar int vertex_indices\n\
         end_header\n0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n3 0 1 2\n"
    );
    let numbers: [f32; 15] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0];
    let data = STANDARD.encode(bytemuck::cast_slice::<f32, u8>(&numbers));
    let gltf = json!({
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"}
        ],
        "bufferViews": [
            {"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 24}
        ],
        "buffers": [{"byteLength": 60, "uri": format!("data:application/octet-stream;base64,{data}")}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}], "images": [{"uri": reference}]
    });
    vec![
        (
            vec![("a.obj", obj.to_owned()), ("a.mtl", format!("newmtl m\nmap_Kd {reference}\n"))],
            format!("material 'm': map_Kd '{reference}'"),
        ),
        (vec![("a.ply", ply)], format!("TextureFile '{reference}'")),
        (vec![("a.gltf", gltf.to_string())], format!("image '{reference}'")),
    ]
}

/// The first texel of the scene's only image, and the remarks.
fn outcome(opened: &OpenedScene) -> (Option<Vec<u8>>, Vec<String>) {
    assert!(opened.scene.textures.len() <= 1);
    (opened.scene.textures.first().map(|texture| texture.rgba().to_vec()), opened.scene.remarks.clone())
}

/// Opens the model `name` in `outer/scene` as an upload of this folder.
fn open_upload(outer: &Path, name: &str) -> OpenedScene {
    let folder = outer.join("scene");
    let files = ["a.obj", "a.mtl", "a.ply", "a.gltf", "maps/Wood.png"].into_iter();
    let hash = |path: &str| -> Option<(String, [u8; 32])> {
        let content = std::fs::read(folder.join(path)).ok()?;
        Some((path.to_owned(), Sha256::digest(content).into()))
    };
    let hashes = Arc::new(files.filter_map(hash).collect::<FileHashes>());
    let repository = SceneRepository::new(None).expect("a repository without a folder");
    repository.open_upload(&folder, name, &hashes, &MemoryReservation::unlimited()).expect(name)
}

#[test]
fn paths_of_images_have_one_outcome_everywhere() {
    let outer = create_folder();
    let secret = outer.path().join("secret.png").display().to_string();
    let is_read = Some("'maps/Wood.png' is read");
    for (reference, reason, treatment) in [
        ("maps/Wood.png", None, None),
        ("./maps/../maps/Wood.png", None, None),
        ("maps\\Wood.png", None, None),
        ("MAPS/wood.PNG", Some("does not exist"), is_read),
        ("absent.png", Some("does not exist"), None),
        ("C:\\work\\maps\\wood.png", Some("is outside of the folder of the scene"), is_read),
        ("file:///home/user/maps/Wood.png", Some("is outside of the folder of the scene"), is_read),
        ("C:\\work\\wood.png", Some("is outside of the folder of the scene"), None),
        ("https://host/secret.png", Some("is outside of the folder of the scene"), None),
        ("../secret.png", Some("is outside of the folder of the scene"), None),
        ("maps/../../secret.png", Some("is outside of the folder of the scene"), None),
        (secret.as_str(), Some("is outside of the folder of the scene"), None),
    ] {
        for (files, subject) in models(reference) {
            let scene = outer.path().join("scene");
            for (name, text) in &files {
                std::fs::write(scene.join(name), text).expect("a writable file");
            }
            let name = files[0].0;
            let path = scene.join(name).display().to_string();
            let found = outcome(&open(&path).expect(reference));
            let expected_texel = (reason.is_none() || treatment.is_some()).then(|| INSIDE.to_vec());
            assert_eq!(found.0, expected_texel, "{name} {reference}");
            assert_eq!(found.1.len(), usize::from(reason.is_some()), "{name} {reference}: {:?}", found.1);
            let start = format!("{subject} {}: {}", reason.unwrap_or_default(), treatment.unwrap_or_default());
            assert!(found.1.iter().all(|remark| remark.starts_with(&start)), "expected {start}, got {:?}", found.1);
            let repository = SceneRepository::new(Some(outer.path())).expect("an existing folder");
            let served = repository.open(&format!("scene/{name}"), &MemoryReservation::unlimited());
            assert_eq!(outcome(&served.expect(reference)), found, "served {name}: {reference}");
            assert_eq!(outcome(&open_upload(outer.path(), name)), found, "uploaded {name}: {reference}");
            let strict = open_with(&path, &LoadOptions { is_strict: true, ..LoadOptions::default() });
            match reason {
                None => drop(strict.expect(reference)),
                Some(_) => {
                    let message = strict.expect_err(reference).to_string();
                    assert!(message.ends_with("(strict mode)"), "{message}");
                }
            }
        }
    }
}

/// A model in a folder of a scene refers to the images of the scene, but does not when the model itself is opened.
#[test]
fn images_of_a_scene_can_be_beside_the_folder_of_a_model() {
    let outer = create_folder();
    let scene = outer.path().join("scene");
    std::fs::create_dir(scene.join("models")).expect("a new folder");
    let write = |path: &str, text: &str| std::fs::write(scene.join(path), text).expect("a writable file");
    write("scene.toml", "model = 'models/a.obj'\n");
    for (name, text) in &models("../maps/Wood.png")[0].0 {
        write(&format!("models/{name}"), text);
    }
    let texels_of = |path: &Path| outcome(&open(&path.display().to_string()).expect("a scene"));
    assert_eq!(texels_of(&scene), (Some(INSIDE.to_vec()), vec![]));
    let (texel, remarks) = texels_of(&scene.join("models/a.obj"));
    assert_eq!((texel, remarks.len()), (None, 1), "{remarks:?}");
    write("models/a.mtl", "newmtl m\nmap_Kd ../../secret.png\n");
    assert_eq!(texels_of(&scene).0, None, "expected no image outside of the scene");
}
