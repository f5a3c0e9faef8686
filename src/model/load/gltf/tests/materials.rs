//! Tests of materials and textures with small models.

use std::io::Cursor;

use serde_json::{Value, json};

use super::{Model, push};
use crate::domain::{AlphaMode, CreaseAngle, Material};
use crate::scene::Scene;

/// A 2 x 2 PNG of one color.
pub(super) fn encode_png(pixel: [u8; 4]) -> Vec<u8> {
    let image = image::RgbaImage::from_pixel(2, 2, image::Rgba(pixel));
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, image::ImageFormat::Png).expect("an encoded PNG");
    bytes.into_inner()
}

/// A triangle with two sets of texture coordinates, one image as textures 0 and 1, and one material. Texture 1 has an
/// unsupported sampler, which clamps to the edge (OpenGL's `GL_CLAMP_TO_EDGE` is 33071; `GL_LINEAR` is 9729).
pub(super) fn textured_triangle(material: Value) -> Model {
    let mut model = Model::triangle();
    let first_uvs = model.add_floats("VEC2", 3, &[0.0, 0.0, 1.0, 0.0, 0.0, 1.0]);
    let second_uvs = model.add_floats("VEC2", 3, &[5.0, 5.0, 6.0, 5.0, 5.0, 6.0]);
    let image = model.add_view(&encode_png([0, 128, 255, 255]));
    model.primitive()["attributes"] = json!({"POSITION": 0, "TEXCOORD_0": first_uvs, "TEXCOORD_1": second_uvs});
    model.primitive()["material"] = 0.into();
    model.json["images"] = json!([{"name": "swatch", "bufferView": image, "mimeType": "image/png"}]);
    model.json["samplers"] = json!([{"wrapS": 33071, "magFilter": 9729}]);
    model.json["textures"] = json!([{"source": 0}, {"source": 0, "sampler": 0}]);
    model.json["materials"] = json!([material]);
    model
}

fn read_material(source: Value) -> Material {
    textured_triangle(source).parts().materials.remove(0)
}

#[test]
fn missing_images_are_remarks_but_errors_in_strict_mode() {
    let texture = json!({"index": 0});
    let pbr = json!({
        "baseColorFactor": [0.5, 0.25, 0.125, 1.0], "baseColorTexture": texture, "metallicRoughnessTexture": texture,
        "metallicFactor": 0.0
    });
    let mut model = textured_triangle(json!({"pbrMetallicRoughness": pbr, "normalTexture": texture}));
    model.json["images"] = json!([{"uri": "absent.png"}]);
    let parts = model.parts();
    let material = &parts.materials[0];
    assert_eq!((material.diffuse, material.color_texture, material.normal_texture), ([0.5, 0.25, 0.125], None, None));
    for stand_in in ["the color factor is drawn", "the normals of the mesh are used", "factors are used"] {
        let is_remark =
            |remark: &String| remark.starts_with("image 'absent.png' does not exist: ") && remark.ends_with(stand_in);
        assert!(parts.remarks.iter().any(is_remark), "expected {stand_in} in {:?}", parts.remarks);
    }
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = crate::load::asset_dir::AssetDir::unrestricted(folder.path()).strict();
    let message = crate::load::gltf::parse(&files, "model", &model.to_glb(), CreaseAngle::default())
        .map(drop)
        .expect_err("strict mode")
        .to_string();
    assert!(message.ends_with("file 'absent.png': expected an existing file, got none (strict mode)"), "{message}");
}

/// Covers images of other formats than PNG, JPEG and WebP: embedded, as a data URI, and defined by an extension only.
#[test]
fn other_image_formats_are_remarks_but_errors_in_strict_mode() {
    let pbr = json!({
        "baseColorFactor": [0.5, 0.25, 0.125, 1.0], "baseColorTexture": {"index": 0}, "metallicFactor": 0.0
    });
    let model = || textured_triangle(json!({"pbrMetallicRoughness": pbr}));
    let mut embedded = model();
    let view = embedded.add_view(b"\xabKTX 20\xbb\r\n\x1a\n\0\0\0\0");
    embedded.json["images"] = json!([{"name": "swatch", "bufferView": view, "mimeType": "image/ktx2"}]);
    let mut data_uri = model();
    data_uri.json["images"] = json!([{"name": "swatch", "uri": "data:image/bmp;base64,Qk02AAAAAAAAADYAAAAoAAAA"}]);
    let mut extension = model();
    extension.json["textures"] = json!([{"extensions": {"KHR_texture_basisu": {"source": 0}}}]);
    let folder = tempfile::tempdir().expect("a temporary folder");
    let files = crate::load::asset_dir::AssetDir::unrestricted(folder.path()).strict();
    for (model, remark, error) in [
        (
            embedded,
            "image 'swatch' is no PNG, JPEG or WebP image: the color factor is drawn",
            "a PNG, JPEG or WebP image",
        ),
        (
            data_uri,
            "image 'swatch' is no PNG, JPEG or WebP image: the color factor is drawn",
            "a PNG, JPEG or WebP image",
        ),
        (extension, "texture 0 has no PNG, JPEG or WebP image: the color factor is drawn", "textures[0].source"),
    ] {
        let parts = model.parts();
        assert_eq!((parts.materials[0].diffuse, parts.materials[0].color_texture), ([0.5, 0.25, 0.125], None));
        assert!(parts.remarks.iter().any(|given| given == remark), "expected {remark} in {:?}", parts.remarks);
        let strict = crate::load::gltf::parse(&files, "model", &model.to_glb(), CreaseAngle::default());
        let message = strict.map(drop).expect_err("strict mode").to_string();
        assert!(message.contains(error), "{message}");
    }
}

/// The texel at the corner `corner` of the first triangle of the first domain.
fn texel_at_corner(parts: &crate::scene::SceneParts, corner: usize) -> [u8; 4] {
    let material = &parts.materials[parts.domains[0].material];
    let texture = &parts.textures[material.color_texture.expect("an image of the colors")];
    let mesh = &parts.shapes[parts.domains[0].shape].mesh;
    let [u, v] = mesh.corners().uvs[mesh.triangles()[0][corner] as usize];
    let (x, y) = ((u * texture.width() as f32) as usize, (v * texture.height() as f32) as usize);
    texture.rgba().as_chunks::<4>().0[y * texture.width() as usize + x]
}

#[test]
fn vertex_colors_of_all_formats_are_drawn() {
    let floats: Vec<u8> = bytemuck::cast_slice(&[1.0_f32, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 7.0]).to_vec();
    let bytes = [255_u8, 0, 0, 255, 0, 255, 0, 255, 0, 0, 255, 128];
    let shorts = bytes.map(|byte| u16::from(byte) * 257);
    for (data, component, kind) in [
        (&floats[..], super::F32, "VEC3"),
        (&bytes, super::U8, "VEC4"),
        (bytemuck::cast_slice(&shorts), super::U16, "VEC4"),
    ] {
        for (alpha_mode, alpha) in [("OPAQUE", 255), ("BLEND", if kind == "VEC4" { 128 } else { 255 })] {
            let mut model = Model::triangle();
            let colors = model.add_accessor(data, component, kind, 3);
            model.json["accessors"][colors]["normalized"] = (component != super::F32).into();
            model.primitive()["attributes"]["COLOR_0"] = colors.into();
            model.primitive()["material"] = 0.into();
            let pbr = json!({"baseColorFactor": [0.5, 0.5, 0.5, 1.0]});
            model.json["materials"] = json!([{"pbrMetallicRoughness": pbr, "alphaMode": alpha_mode}]);
            let parts = model.parts();
            let texels = [0, 1, 2].map(|corner| texel_at_corner(&parts, corner));
            let expected = [[255, 0, 0, 255], [0, 255, 0, 255], [0, 0, 255, alpha]];
            assert_eq!(texels, expected, "{kind} of {component}, {alpha_mode}");
            let ambient = parts.materials[parts.domains[0].material].ambient;
            assert_eq!(ambient, [0.5; 3], "expected the colors to multiply the color of the material");
            let is_clamped = parts.remarks.iter().any(|remark| remark.contains("the channels are clamped"));
            assert_eq!(is_clamped, component == super::F32, "{:?}", parts.remarks);
            Scene::new(parts).expect("a valid scene");
        }
    }
}

/// Covers one color for all vertices, and vertex colors in a primitive whose material has an image or a normal map.
#[test]
fn vertex_colors_multiply_factors_and_images() {
    let with_colors = |mut model: Model, colors: &[f32]| {
        let accessor = model.add_floats("VEC3", 3, colors);
        model.primitive()["attributes"]["COLOR_0"] = accessor.into();
        model
    };
    let pbr = json!({"baseColorFactor": [0.5, 0.5, 1.0, 1.0], "baseColorTexture": {"index": 0}, "metallicFactor": 0});
    let mut uniform = Model::triangle();
    uniform.primitive()["material"] = 0.into();
    uniform.json["materials"] =
        json!([{"pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 1.0, 1.0], "metallicFactor": 0}}]);
    let parts = with_colors(uniform, &[0.5, 1.0, 0.25].repeat(3)).parts();
    let material = &parts.materials[parts.domains[0].material];
    assert_eq!((material.diffuse, material.color_texture), ([0.25, 0.5, 0.25], None));
    let textured = || textured_triangle(json!({"pbrMetallicRoughness": pbr}));
    // The image has the color (0, 128, 255).
    let parts = with_colors(textured(), &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]).parts();
    let texels = [0, 1, 2].map(|corner| texel_at_corner(&parts, corner));
    assert_eq!(texels, [[0, 0, 0, 255], [0, 128, 0, 255], [0, 0, 255, 255]]);
    let parts = with_colors(textured(), &[0.5, 1.0, 0.25].repeat(3)).parts();
    let material = &parts.materials[parts.domains[0].material];
    assert_eq!((material.diffuse, parts.textures.len()), ([0.25, 0.5, 0.25], 1), "expected the image and a factor");
    let normal_map = textured_triangle(json!({"pbrMetallicRoughness": pbr, "normalTexture": {"index": 0}}));
    let parts = with_colors(normal_map, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]).parts();
    assert_eq!(texel_at_corner(&parts, 0), [0, 128, 255, 255]);
    assert!(parts.remarks.iter().any(|remark| remark.starts_with("vertex colors are not used")), "{:?}", parts.remarks);
}

/// The primitives of one material have colors of their own, and the material itself is not changed.
#[test]
fn vertex_colors_belong_to_their_primitive() {
    let mut model = Model::triangle();
    let colors = model.add_floats("VEC3", 3, &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    model.primitive()["material"] = 0.into();
    model.primitive()["attributes"]["COLOR_0"] = colors.into();
    model.json["materials"] = json!([{"name": "shared"}]);
    push(&mut model.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}, "material": 0}));
    let parts = model.parts();
    let textures = parts.domains.iter().map(|domain| parts.materials[domain.material].color_texture);
    assert_eq!(textures.collect::<Vec<_>>(), [Some(0), None]);
    assert!(parts.domains.iter().all(|domain| parts.materials[domain.material].name == "shared"));
}

#[test]
fn metalness_and_roughness_become_phong_parameters() {
    let material_with_factors = |metalness: f32, roughness: f32| {
        let pbr = json!({
            "baseColorFactor": [0.8, 0.4, 0.2, 0.5], "metallicFactor": metalness, "roughnessFactor": roughness
        });
        read_material(json!({"pbrMetallicRoughness": pbr}))
    };
    let plastic = material_with_factors(0.0, 0.5);
    assert_eq!((plastic.diffuse, plastic.ambient, plastic.alpha), ([0.8, 0.4, 0.2], [0.8, 0.4, 0.2], 0.5));
    // The GGX parameter a = roughness^2 is 1/4, so 1 / a^2 is 16. The peak is 0.04 / (4 a^2) = 0.16, and the exponent
    // is (2 / a^2 - 2) / 4 = 7.5.
    for channel in plastic.specular {
        assert!((channel - 0.16).abs() <= 1e-6, "{channel}");
    }
    assert!((plastic.shininess - 7.5).abs() <= 1e-5, "{}", plastic.shininess);
    // With a = 1, the peak is a quarter of the base color, and the exponent is 0, which is clamped to 1.
    let metal = material_with_factors(1.0, 1.0);
    assert_eq!(metal.diffuse, [0.4, 0.2, 0.1]);
    assert_eq!(metal.specular, [0.2, 0.1, 0.05]);
    assert_eq!(metal.shininess, 1.0);
    let mirror = material_with_factors(1.0, 0.0);
    assert_eq!((mirror.specular, mirror.shininess), ([1.0; 3], 1e4));
}

#[test]
fn metallic_roughness_texture_is_replaced_by_its_mean() {
    let pbr = json!({"roughnessFactor": 0.5, "metallicRoughnessTexture": {"index": 0}});
    let parts = textured_triangle(json!({"name": "m", "pbrMetallicRoughness": pbr})).parts();
    assert!(parts.textures.is_empty());
    // Blue is 255, so the metalness is 1. Green is 128, so the roughness is 0.5 x 128 / 255.
    let alpha2 = (0.5 * 128.0 / 255.0_f32).powi(4);
    assert_eq!(parts.materials[0].diffuse, [0.5; 3]);
    assert!((parts.materials[0].shininess / ((2.0 / alpha2 - 2.0) / 4.0) - 1.0).abs() <= 1e-5);
    assert!(parts.remarks[0].contains("only the mean of the metallic-roughness texture"), "{:?}", parts.remarks);
}

#[test]
fn alpha_mode_and_double_sided_do_not_depend_on_images() {
    let mask = read_material(json!({
        "name": "leaf", "alphaMode": "MASK", "alphaCutoff": 0.25, "doubleSided": true,
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}
    }));
    assert_eq!((mask.name.as_str(), mask.alpha_mode), ("leaf", AlphaMode::Mask { cutoff: 0.25 }));
    assert!(mask.double_sided && mask.color_texture == Some(0));
    assert_eq!(read_material(json!({"alphaMode": "MASK"})).alpha_mode, AlphaMode::Mask { cutoff: 0.5 });
    assert_eq!(read_material(json!({"alphaMode": "BLEND"})).alpha_mode, AlphaMode::Blend);
    assert_eq!(read_material(json!({})).alpha_mode, AlphaMode::Opaque);
    assert!(!read_material(json!({})).double_sided);
}

#[test]
fn image_of_two_textures_is_decoded_once() {
    let source = json!({
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
        "normalTexture": {"index": 1, "scale": 0.5}
    });
    let parts = textured_triangle(source).parts();
    assert_eq!((parts.textures.len(), parts.textures[0].name.as_str()), (1, "swatch"));
    assert_eq!(parts.textures[0].rgba()[..4], [0, 128, 255, 255]);
    assert_eq!((parts.materials[0].color_texture, parts.materials[0].normal_texture), (Some(0), Some(0)));
    assert!(parts.remarks.iter().any(|remark| remark.contains("scale of 0.5")), "{:?}", parts.remarks);
    let scene = Scene::new(parts).expect("a valid scene");
    assert_eq!(scene.shapes[0].tangents().len(), 3);
}

/// A sampler that clamps matters only outside of the image.
#[test]
fn unsupported_samplers_are_remarks_where_they_matter() {
    let remarks_of = |sampler: Value, uv_set: u32| {
        let pbr = json!({"baseColorTexture": {"index": 1, "texCoord": uv_set}});
        textured_triangle(json!({"pbrMetallicRoughness": pbr})).with("/samplers", json!([sampler])).parts().remarks
    };
    let clamp = "samplers that clamp or mirror are ignored: textures repeat";
    let nearest = "samplers with the filter NEAREST are ignored: textures are interpolated";
    for (sampler, uv_set, remark) in [
        (json!({"wrapS": 33071}), 0, None),
        (json!({"wrapS": 33071}), 1, Some(clamp)),
        (json!({"wrapT": 33648}), 1, Some(clamp)),
        (json!({}), 1, None),
        (json!({"magFilter": 9728}), 0, Some(nearest)),
        (json!({"magFilter": 9729, "minFilter": 9728}), 0, None),
    ] {
        assert_eq!(remarks_of(sampler, uv_set), remark.into_iter().collect::<Vec<_>>());
    }
}

#[test]
fn color_texture_selects_uv_set_and_excludes_other_normal_maps() {
    let source = json!({
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0, "texCoord": 1}},
        "normalTexture": {"index": 0}
    });
    let parts = textured_triangle(source).parts();
    assert_eq!(parts.shapes[0].mesh.corners().uvs[0], [5.0, 5.0]);
    assert_eq!((parts.materials[0].color_texture, parts.materials[0].normal_texture), (Some(0), None));
    assert!(parts.remarks[0].contains("the color texture does not use TEXCOORD_0"), "{:?}", parts.remarks);
    let normal_only = textured_triangle(json!({"normalTexture": {"index": 0, "texCoord": 1}})).parts();
    assert_eq!(normal_only.shapes[0].mesh.corners().uvs[0], [5.0, 5.0]);
    assert_eq!(normal_only.materials[0].normal_texture, Some(0));
}

#[test]
fn primitive_without_uvs_has_a_material_without_textures() {
    let mut model = textured_triangle(json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}));
    push(&mut model.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}, "material": 0}));
    push(&mut model.json["meshes"][0]["primitives"], json!({"attributes": {"POSITION": 0}}));
    let parts = model.parts();
    let color_textures: Vec<_> =
        parts.domains.iter().map(|domain| parts.materials[domain.material].color_texture).collect();
    assert_eq!(color_textures, [Some(0), None, None]);
    assert_eq!(parts.materials[parts.domains[2].material], Material::default());
    assert!(parts.remarks[0].contains("lacks TEXCOORD_0"), "{:?}", parts.remarks);
}

#[test]
fn occlusion_and_emission_are_reported_and_texture_transforms_applied() {
    let transform = json!({"offset": [0, 1], "rotation": std::f64::consts::FRAC_PI_2, "scale": [0.5, 0.5]});
    let transformed_texture = json!({"index": 0, "extensions": {"KHR_texture_transform": transform}});
    let source = json!({
        "name": "all", "occlusionTexture": {"index": 0}, "emissiveFactor": [0, 1, 0],
        "pbrMetallicRoughness": {"baseColorTexture": transformed_texture}
    });
    let parts = textured_triangle(source).parts();
    // The example of the specification: the quarter at the lower left, turned by 90 degrees.
    let uvs = &parts.shapes[0].mesh.corners().uvs;
    for (uv, expected) in uvs.iter().zip([[0.0, 1.0], [0.0, 0.5], [0.5, 1.0]]) {
        assert!((0..2).all(|axis| (uv[axis] - expected[axis]).abs() < 1e-6), "expected {expected:?}, got {uv:?}");
    }
    let remarks = parts.remarks;
    for text in ["'all': the occlusion texture", "'all': emission"] {
        assert!(remarks.iter().any(|remark| remark.contains(text)), "expected '{text}', got {remarks:?}");
    }
}

/// An image of the extension EXT_texture_webp, lossless and with alpha, with and without an image for other programs.
#[test]
fn webp_images_are_decoded() {
    let mut bytes = Cursor::new(Vec::new());
    let image = image::RgbaImage::from_pixel(3, 2, image::Rgba([10, 200, 30, 128]));
    image.write_to(&mut bytes, image::ImageFormat::WebP).expect("an encoded image");
    for fallback in [json!(0), Value::Null] {
        let pbr = json!({"baseColorTexture": {"index": 0}});
        let mut model = textured_triangle(json!({"pbrMetallicRoughness": pbr, "alphaMode": "BLEND"}));
        let view = model.add_view(bytes.get_ref());
        push(&mut model.json["images"], json!({"bufferView": view, "mimeType": "image/webp"}));
        model.json["textures"] = json!([{"source": fallback, "extensions": {"EXT_texture_webp": {"source": 1}}}]);
        model.json["extensionsRequired"] = json!(["EXT_texture_webp"]);
        let parts = model.parts();
        let texture = &parts.textures[parts.materials[0].color_texture.expect("an image")];
        assert_eq!((texture.width(), &texture.rgba()[..4]), (3, &[10, 200, 30, 128][..]));
        assert!(parts.remarks.is_empty(), "{:?}", parts.remarks);
    }
}
