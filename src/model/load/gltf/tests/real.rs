//! Tests with the real models among the inputs.

use std::path::PathBuf;

use crate::domain::{AlphaMode, Texture};
use crate::load::asset_dir::AssetDir;
use crate::scene::{Scene, SceneParts};

fn read(path: &str) -> SceneParts {
    let here = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../../shared/data");
    let data = std::env::var_os("MODALCAST_DATA").map_or(here, PathBuf::from);
    super::super::read(&AssetDir::unrestricted(&data), path).expect("the real input")
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_morph_stress_test_has_a_rigid_plate_and_a_block_of_eight_modes() {
    let parts = read("gltf/MorphStressTest/MorphStressTest.gltf");
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
        let most = |axis: usize| column.iter().skip(axis).step_by(3).fold(0.0_f32, |most, entry| most.max(entry.abs()));
        assert!((most(0) - 0.05).abs() <= 1e-6 && most(1) == 1.0 && most(2) == 0.0, "mode {mode}");
    }
    let textures: Vec<&str> = parts.textures.iter().map(|texture| texture.name.as_str()).collect();
    assert_eq!(textures, ["TinyGrid", "ColorSwatches"]);
    for said in ["animations (3)", "NORMAL targets", "'Base': the occlusion texture"] {
        assert!(parts.remarks.iter().any(|remark| remark.contains(said)), "{said} in {:?}", parts.remarks);
    }
    let scene = Scene::new(parts).expect("a scene");
    assert!(scene.rest_bounds.max[1] > 0.49, "upright: {:?}", scene.rest_bounds);
}

#[test]
#[ignore = "needs the real inputs: MODALCAST_DATA or ../shared/data"]
fn real_ferns_are_four_masked_plants_with_a_normal_map() {
    let parts = read("gltf/fern/fern_02.glb");
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
    let side = |texture: Option<usize>| texture.map(|index| &parts.textures[index]).map(Texture::width);
    assert_eq!((side(material.color_texture), side(material.normal_texture)), (Some(2048), Some(2048)));
    assert_eq!(parts.textures[0].name, "fern_02_diff-fern_02_alpha");
    assert_eq!(parts.textures.len(), 2);
    let scene = Scene::new(parts).expect("a scene");
    assert!(scene.features.mask && scene.features.normal_maps);
}
