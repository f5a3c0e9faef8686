//! Tests of materials and textures with small models.

use std::io::Cursor;

use serde_json::{Value, json};

use super::{Model, push};
use crate::domain::{AlphaMode, Material};
use crate::scene::Scene;

/// A 2 x 2 PNG of one color.
pub(super) fn png(pixel: [u8; 4]) -> Vec<u8> {
    let image = image::RgbaImage::from_pixel(2, 2, image::Rgba(pixel));
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Png).expect("encoded");
    bytes.into_inner()
}

/// A triangle with two sets of texture coordinates, one image as textures 0 and 1, and one material.
pub(super) fn textured(material: Value) -> Model {
    let mut model = Model::triangle();
    let near = model.floats("VEC2", 3, &[0.0, 0.0, 1.0, 0.0, 0.0, 1.0]);
    let far = model.floats("VEC2", 3, &[5.0, 5.0, 6.0, 5.0, 5.0, 6.0]);
    let image = model.view(&png([0, 128, 255, 255]));
    model.primitive()["attributes"] = json!({"POSITION": 0, "TEXCOORD_0": near, "TEXCOORD_1": far});
    model.primitive()["material"] = 0.into();
    model.json["images"] = json!([{"name": "swatch", "bufferView": image, "mimeType": "image/png"}]);
    model.json["samplers"] = json!([{"wrapS": 33071, "magFilter": 9729}]);
    model.json["textures"] = json!([{"source": 0}, {"source": 0, "sampler": 0}]);
    model.json["materials"] = json!([material]);
    model
}

fn material(source: Value) -> Material {
    textured(source).parts().materials.remove(0)
}

#[test]
fn metalness_tints_the_specular_colour_and_roughness_sets_the_exponent() {
    let factors = |metal: f32, rough: f32| {
        let pbr = json!({
            "baseColorFactor": [0.8, 0.4, 0.2, 0.5], "metallicFactor": metal, "roughnessFactor": rough
        });
        material(json!({"pbrMetallicRoughness": pbr}))
    };
    let plastic = factors(0.0, 0.5);
    assert_eq!((plastic.diffuse, plastic.ambient, plastic.alpha), ([0.8, 0.4, 0.2], [0.8, 0.4, 0.2], 0.5));
    // alpha^2 = 0.5^4 = 1/16: a peak of 0.04 x 16 / 4 and an exponent of (32 - 2) / 4.
    for channel in plastic.specular {
        assert!((channel - 0.16).abs() <= 1e-6, "{channel}");
    }
    assert!((plastic.shininess - 7.5).abs() <= 1e-5, "{}", plastic.shininess);
    let metal = factors(1.0, 1.0);
    assert_eq!(metal.diffuse, [0.4, 0.2, 0.1]);
    assert_eq!(metal.specular, [0.2, 0.1, 0.05]);
    assert_eq!(metal.shininess, 1.0);
    let mirror = factors(1.0, 0.0);
    assert_eq!((mirror.specular, mirror.shininess), ([1.0; 3], 1e4));
}

#[test]
fn the_metallic_roughness_texture_counts_by_its_mean_and_is_not_kept() {
    let pbr = json!({"roughnessFactor": 0.5, "metallicRoughnessTexture": {"index": 0}});
    let parts = textured(json!({"name": "m", "pbrMetallicRoughness": pbr})).parts();
    assert!(parts.textures.is_empty());
    // Blue is 255: metal; green is 128 of 255: a quarter rough.
    let square = (0.5 * 128.0 / 255.0_f32).powi(4);
    assert_eq!(parts.materials[0].diffuse, [0.5; 3]);
    assert!((parts.materials[0].shininess / ((2.0 / square - 2.0) / 4.0) - 1.0).abs() <= 1e-5);
    assert!(parts.remarks[0].contains("only the mean is used"), "{:?}", parts.remarks);
}

#[test]
fn alpha_modes_cutoffs_and_double_sides_are_kept_even_when_no_image_has_alpha() {
    let mask = material(json!({
        "name": "leaf", "alphaMode": "MASK", "alphaCutoff": 0.25, "doubleSided": true,
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}
    }));
    assert_eq!((mask.name.as_str(), mask.alpha_mode), ("leaf", AlphaMode::Mask { cutoff: 0.25 }));
    assert!(mask.double_sided && mask.color_texture == Some(0));
    assert_eq!(material(json!({"alphaMode": "MASK"})).alpha_mode, AlphaMode::Mask { cutoff: 0.5 });
    assert_eq!(material(json!({"alphaMode": "BLEND"})).alpha_mode, AlphaMode::Blend);
    assert_eq!(material(json!({})).alpha_mode, AlphaMode::Opaque);
    assert!(!material(json!({})).double_sided);
}

#[test]
fn an_image_is_decoded_once_for_both_of_its_roles() {
    let source = json!({
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "normalTexture": {"index": 1, "scale": 0.5}
    });
    let parts = textured(source).parts();
    assert_eq!((parts.textures.len(), parts.textures[0].name.as_str()), (1, "swatch"));
    assert_eq!(parts.textures[0].rgba()[..4], [0, 128, 255, 255]);
    assert_eq!((parts.materials[0].color_texture, parts.materials[0].normal_texture), (Some(0), Some(0)));
    for said in ["scale of 0.5", "samplers that clamp"] {
        assert!(parts.remarks.iter().any(|remark| remark.contains(said)), "{said} in {:?}", parts.remarks);
    }
    let scene = Scene::new(parts).expect("a scene");
    assert_eq!(scene.shapes[0].tangents().len(), 3);
}

#[test]
fn the_colour_texture_chooses_the_set_and_a_normal_map_of_another_set_is_left_out() {
    let source = json!({
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}},
        "normalTexture": {"index": 0}
    });
    let parts = textured(source).parts();
    assert_eq!(parts.shapes[0].mesh.corners().uvs[0], [5.0, 5.0]);
    assert_eq!((parts.materials[0].color_texture, parts.materials[0].normal_texture), (Some(0), None));
    assert!(parts.remarks[0].contains("it wants another set"), "{:?}", parts.remarks);
    let normal_only = textured(json!({"normalTexture": {"index": 0, "texCoord": 1}})).parts();
    assert_eq!(normal_only.shapes[0].mesh.corners().uvs[0], [5.0, 5.0]);
    assert_eq!(normal_only.materials[0].normal_texture, Some(0));
}

#[test]
fn a_primitive_without_coordinates_gets_its_material_without_textures() {
    let mut model = textured(json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}));
    push(&mut model.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}, "material": 0}));
    push(&mut model.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}}));
    let parts = model.parts();
    let colors: Vec<_> = parts.domains.iter().map(|domain| parts.materials[domain.material].color_texture).collect();
    assert_eq!(colors, [Some(0), None, None]);
    assert_eq!(parts.materials[parts.domains[2].material], Material::default());
    assert!(parts.remarks[0].contains("lacks TEXCOORD_0"), "{:?}", parts.remarks);
}

#[test]
fn occlusion_emission_and_texture_transforms_are_reported() {
    let transform = json!({"index": 0, "extensions": {"KHR_texture_transform": {"scale": [2, 2]}}});
    let source = json!({
        "name": "all", "occlusionTexture": {"index": 0}, "emissiveFactor": [0, 1, 0],
        "pbrMetallicRoughness": {"baseColorTexture": transform}
    });
    let remarks = textured(source).parts().remarks;
    for said in ["KHR_texture_transform", "'all': the occlusion texture", "'all': emission"] {
        assert!(remarks.iter().any(|remark| remark.contains(said)), "{said} in {remarks:?}");
    }
}
