//! Tests with real models. They are ignored by default, because the datasets are not part of the repository. Expected
//! names, sizes and translations are properties of the datasets.

use std::path::PathBuf;

use crate::domain::{AlphaMode, CreaseAngle, Texture};
use crate::load::asset_dir::AssetDir;
use crate::scene::{Scene, SceneParts};

fn read_dataset(path: &str) -> SceneParts {
    let default_folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let folder = std::env::var_os("MODALCAST_DATA").map_or(default_folder, PathBuf::from);
    super::super::read(&AssetDir::unrestricted(&folder), path, CreaseAngle::default()).expect("a valid model")
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_morph_stress_test_has_a_rigid_and_a_modal_domain() {
    let parts = read_dataset("gltf/MorphStressTest/MorphStressTest.gltf");
    assert_eq!(parts.name, "MorphStressTest");
    let names: Vec<&str> = parts.domains.iter().map(|domain| domain.name.as_str()).collect();
    assert_eq!(names, ["Main.0", "Main.1"]);
    let sizes: Vec<_> =
        parts.shapes.iter().map(|shape| (shape.mesh.rest_positions().len(), shape.modes.rank())).collect();
    assert_eq!(sizes, [(24, 0), (1504, 8)]);
    assert_eq!(parts.shapes[1].mesh.triangles().len(), 2400);
    assert_eq!(parts.domains[1].rest_q, [0.0; 8]);
    assert!(parts.domains.iter().all(|domain| domain.shares_q_with.is_none()));
    // The accessors declare these extrema of the eight targets.
    for mode in 0..8 {
        let column = parts.shapes[1].modes.column(mode);
        let max_entry = |axis: usize| {
            column.iter().skip(axis).step_by(3).fold(0.0_f32, |max_entry, entry| max_entry.max(entry.abs()))
        };
        assert!((max_entry(0) - 0.05).abs() <= 1e-6 && max_entry(1) == 1.0 && max_entry(2) == 0.0, "mode {mode}");
    }
    let textures: Vec<&str> = parts.textures.iter().map(|texture| texture.name.as_str()).collect();
    assert_eq!(textures, ["TinyGrid", "ColorSwatches"]);
    for text in ["animations (3)", "normals of morph targets", "'Base': the occlusion texture"] {
        assert!(parts.remarks.iter().any(|remark| remark.contains(text)), "expected '{text}', got {:?}", parts.remarks);
    }
    let scene = Scene::new(parts).expect("a valid scene");
    assert!(scene.rest_bounds.max[1] > 0.49, "expected y up, got {:?}", scene.rest_bounds);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../../../shared/data (from this crate)"]
fn real_ferns_are_four_masked_plants_with_a_normal_map() {
    let parts = read_dataset("gltf/fern/fern_02.glb");
    let sizes: Vec<_> = parts
        .domains
        .iter()
        .map(|domain| &parts.shapes[domain.shape].mesh)
        .map(|mesh| (mesh.rest_positions().len(), mesh.triangles().len()))
        .collect();
    assert_eq!(sizes, [(1660, 2384), (1568, 2248), (544, 784), (565, 816)]);
    let names: Vec<&str> = parts.domains.iter().map(|domain| domain.name.as_str()).collect();
    assert_eq!(names, ["fern_02_b.0", "fern_02_c.0", "fern_02_a.0", "fern_02_d.0"]);
    assert_eq!(parts.domains[1].placement.translation().x as f32, 1.000_001);
    let [material] = parts.materials.as_slice() else { panic!("{:?}", parts.materials) };
    assert_eq!(material.alpha_mode, AlphaMode::Mask { cutoff: 0.5 });
    assert!(material.double_sided);
    let texture_width = |texture: Option<usize>| texture.map(|index| &parts.textures[index]).map(Texture::width);
    assert_eq!(
        (texture_width(material.color_texture), texture_width(material.normal_texture)),
        (Some(2048), Some(2048))
    );
    assert_eq!(parts.textures[0].name, "fern_02_diff-fern_02_alpha");
    assert_eq!(parts.textures.len(), 2);
    let scene = Scene::new(parts).expect("a valid scene");
    assert!(scene.features.mask && scene.features.normal_maps);
}
