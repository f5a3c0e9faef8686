//! Converts MTL statements to Phong materials. Default colors: white for Kd, the value of Kd for Ka, black for Ks.
//!
//! Programs without ambient light write a gray as Ka, such as black, white or 0.2 for any Kd, so a gray also means Kd,
//! except in a material of black Kd without Ks and Ns. A surface reflects no more of the skylight than of the sunlight, so
//! Ka is at most Kd, unless Kd is black. There is no highlight with `illum 0` and `illum 1`, or with an exponent Ns that is
//! missing or at most 1, with which the highlight would cover the whole lit side; files use 0 for "not specified".

use super::mtl::MtlMaterial;
use crate::domain::{AlphaMode, Material, Texture};
use crate::error::Result;
use crate::load::asset_dir::AssetDir;
use crate::load::texture_cache::TextureCache;

/// The largest exponent of a highlight.
const MAX_EXPONENT: f32 = 1e6;
/// The alpha-test cutoff of materials whose alpha comes from an image.
pub(in crate::load) const DEFAULT_ALPHA_CUTOFF: f32 = 0.5;

/// Creates the material of `statements`, with images read from `files`.
///
/// An image with alpha selects the alpha test; an opacity below 1 selects blending. Materials are double-sided, because
/// MTL cannot express this property and leaves are usually single sheets.
///
/// # Errors
/// `Invalid` with the material and the statement: an unreadable file. In strict mode, also a missing image, an image that is
/// no PNG, JPEG or WebP image, and the corrections of [`crate::load::values`], which are remarks otherwise.
pub(super) fn create_material(
    name: &str,
    statements: &MtlMaterial,
    files: &AssetDir,
    texture_cache: &mut TextureCache,
    remarks: &mut Vec<String>,
) -> Result<Material> {
    let field_of = |statement: &str| format!("material '{name}': {statement}");
    let mut corrections = statements.corrections.clone();
    let mut color = |statement: &str, color: Option<[f32; 3]>| {
        corrections.color(&field_of(statement), color?, "the default is used")
    };
    let diffuse = color("Kd", statements.diffuse).unwrap_or([1.0; 3]);
    let is_black = diffuse == [0.0; 3];
    let has_only_ambient = is_black && statements.specular.is_none() && statements.exponent.is_none();
    let is_default = |color: &[f32; 3]| !has_only_ambient && color[0] == color[1] && color[1] == color[2];
    let ambient = color("Ka", statements.ambient).filter(|color| !is_default(color)).unwrap_or(diffuse);
    let limit = |channel: usize| if is_black { 1.0 } else { diffuse[channel] };
    let ambient = [0, 1, 2].map(|channel| ambient[channel].min(limit(channel)));
    let specular = color("Ks", statements.specular).filter(|_| !statements.is_matte).unwrap_or([0.0; 3]);
    let mut number = |statement: &str, value: Option<f32>, range: [f32; 2]| {
        corrections.in_range(&field_of(statement), value?, range, "the default is used")
    };
    let alpha = number("d", statements.opacity, [0.0, 1.0]).unwrap_or(1.0);
    let exponent = number("Ns", statements.exponent, [0.0, MAX_EXPONENT]).filter(|exponent| *exponent > 1.0);
    remarks.extend(corrections.remarks(files.is_strict())?);
    if specular != [0.0; 3] && exponent.is_none() {
        remarks.push(field_of("no highlight (Ks) is drawn, because Ns is missing or at most 1"));
    }
    let statements = &with_paths_of_images(statements, files, &field_of, remarks)?;
    let color_texture = load_color_texture(statements, files, texture_cache)
        .map_err(|error| error.prefix_field(&field_of("map_Kd, map_d")))?;
    let normal_texture = match &statements.normal_map {
        Some(path) => load_normal_texture(path, files, texture_cache)
            .map_err(|error| error.prefix_field(&field_of("normal map")))?,
        None => None,
    };
    remarks.extend(statements.remarks.iter().cloned());
    if let (Some(path), None) = (&statements.normal_map, normal_texture) {
        remarks.push(field_of(&format!("'{path}' is a gray height map and is not used: expected a normal map")));
    }
    let has_alpha = color_texture.is_some_and(|index| texture_cache.textures()[index].has_alpha());
    let alpha_mode = if alpha < 1.0 {
        AlphaMode::Blend
    } else if has_alpha {
        AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF }
    } else {
        AlphaMode::Opaque
    };
    let material = Material {
        name: name.to_owned(),
        ambient,
        diffuse,
        specular: exponent.map_or([0.0; 3], |_| specular),
        shininess: exponent.unwrap_or(1.0),
        alpha,
        color_texture,
        normal_texture,
        alpha_mode,
        double_sided: true,
    };
    material.validated()
}

/// Replaces the paths of images by those of their files, and removes the images that are not drawn, with a remark for each.
///
/// # Errors
/// As for [`AssetDir::find_image`], with the statement.
fn with_paths_of_images(
    statements: &MtlMaterial,
    files: &AssetDir,
    field_of: &impl Fn(&str) -> String,
    remarks: &mut Vec<String>,
) -> Result<MtlMaterial> {
    let mut statements = statements.clone();
    for (image, statement, stand_in) in [
        (&mut statements.color_map, "map_Kd", "the color Kd is drawn"),
        (&mut statements.alpha_map, "map_d", "the surface is opaque"),
        (&mut statements.normal_map, "normal map", "the normals of the mesh are used"),
    ] {
        let Some(reference) = image.take() else { continue };
        let subject = format!("{} '{reference}'", field_of(statement));
        *image = files
            .find_image(&reference, &subject, stand_in, remarks)
            .map_err(|error| error.prefix_field(&field_of(statement)))?;
    }
    Ok(statements)
}

/// Loads the image of `map_Kd` with the alpha of `map_d`. A missing `map_Kd` is white. Returns `None` if both
/// are missing.
fn load_color_texture(
    statements: &MtlMaterial,
    files: &AssetDir,
    texture_cache: &mut TextureCache,
) -> Result<Option<usize>> {
    match (&statements.color_map, &statements.alpha_map) {
        (Some(color_path), Some(alpha_path)) if color_path != alpha_path => {
            let texture_name = format!("{color_path} with the alpha of {alpha_path}");
            texture_cache
                .get_or_insert_with(files, &texture_name, || {
                    replace_alpha(&texture_name, Some(&decode(files, color_path)?), &decode(files, alpha_path)?)
                })
                .map(Some)
        }
        (None, Some(alpha_path)) => {
            let texture_name = format!("white with the alpha of {alpha_path}");
            texture_cache
                .get_or_insert_with(files, &texture_name, || {
                    replace_alpha(&texture_name, None, &decode(files, alpha_path)?)
                })
                .map(Some)
        }
        (Some(color_path), _) => texture_cache.load(files, color_path).map(Some),
        (None, None) => Ok(None),
    }
}

fn decode(files: &AssetDir, path: &str) -> Result<Texture> {
    crate::load::texture_cache::decode(files, path)
}

/// Replaces the alpha of `color` by the alpha channel of `alpha`, or by its red channel if `alpha` is opaque. Samples
/// the nearest texel of `alpha`. A missing `color` is white.
fn replace_alpha(name: &str, color: Option<&Texture>, alpha: &Texture) -> Result<Texture> {
    let (width, height) = color.map_or((alpha.width(), alpha.height()), |image| (image.width(), image.height()));
    let source_channel = if alpha.has_alpha() { 3 } else { 0 };
    let mut rgba = color.map_or_else(|| vec![255; alpha.rgba().len()], |image| image.rgba().to_vec());
    let mut texels = rgba.chunks_exact_mut(4);
    for row in 0..u64::from(height) {
        let source_row = row * u64::from(alpha.height()) / u64::from(height);
        for column in 0..u64::from(width) {
            let source_texel =
                source_row * u64::from(alpha.width()) + column * u64::from(alpha.width()) / u64::from(width);
            if let Some(texel) = texels.next() {
                texel[3] = alpha.rgba()[4 * source_texel as usize + source_channel];
            }
        }
    }
    Texture::new(name, width, height, rgba)
}

/// Loads a normal map. Returns `None` for a gray image, because `bump` may also name a height map, which is not
/// supported.
fn load_normal_texture(path: &str, files: &AssetDir, texture_cache: &mut TextureCache) -> Result<Option<usize>> {
    let index = texture_cache.load(files, path)?;
    let is_gray = texture_cache.textures()[index]
        .rgba()
        .chunks_exact(4)
        .all(|texel| texel[0] == texel[1] && texel[1] == texel[2]);
    Ok((!is_gray).then_some(index))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write_png(folder: &std::path::Path, name: &str, side: u32, texel: [u8; 4]) {
        let image = image::RgbaImage::from_pixel(side, side, image::Rgba(texel));
        image.save(folder.join(name)).expect("a writable file");
    }

    fn read(text: &str, folder: &std::path::Path) -> Result<(Material, TextureCache, Vec<String>)> {
        let statements = super::super::mtl::parse(text.as_bytes())?;
        let (mut texture_cache, mut remarks) = (TextureCache::default(), Vec::new());
        let files = AssetDir::unrestricted(folder).strict();
        let material = create_material("m", &statements["m"], &files, &mut texture_cache, &mut remarks)?;
        Ok((material, texture_cache, remarks))
    }

    #[test]
    fn missing_colors_have_defaults_and_black_remains_black() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let (default, ..) = read("newmtl m\nNs 0\n", folder.path()).expect("a valid material");
        assert_eq!((default.diffuse, default.ambient, default.specular), ([1.0; 3], [1.0; 3], [0.0; 3]));
        assert_eq!((default.shininess, default.alpha_mode), (1.0, AlphaMode::Opaque));
        for (statement, ambient) in [
            ("", [0.0; 3]),
            ("Ka 1 1 1\n", [1.0; 3]),
            ("Ka 1 1 1\nNs 20\n", [0.0; 3]),
            ("Ka 1 1 1\nKs 0 0 0\n", [0.0; 3]),
            ("Ka 0.5 0 0\n", [0.5, 0.0, 0.0]),
        ] {
            let (black, ..) = read(&format!("newmtl m\nKd 0 0 0\n{statement}"), folder.path()).expect("a material");
            assert_eq!((black.diffuse, black.ambient), ([0.0; 3], ambient), "{statement}");
        }
    }

    /// A gray is what programs without ambient light write as Ka.
    #[test]
    fn ambient_color_is_at_most_the_diffuse_color() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        for (statement, ambient) in [
            ("Ka 1 1 1", [0.5, 0.0, 0.25]),
            ("Ka 0 0 0", [0.5, 0.0, 0.25]),
            ("Ka 0.2 0.2 0.2", [0.5, 0.0, 0.25]),
            ("Ka 0.1 0 0.2", [0.1, 0.0, 0.2]),
            ("Ka 0.75 0.75 0.2", [0.5, 0.0, 0.2]),
        ] {
            let text = format!("newmtl m\n{statement}\nKd 0.5 0 0.25\n");
            let (material, _, remarks) = read(&text, folder.path()).expect(statement);
            assert_eq!((material.ambient, remarks.len()), (ambient, 0), "{statement}");
        }
    }

    #[test]
    fn highlights_need_an_illumination_model_and_an_exponent() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let remark = "material 'm': no highlight (Ks) is drawn, because Ns is missing or at most 1";
        for (statements, specular, remarks) in [
            ("Ns 20", 0.5, vec![]),
            ("Ns 1.5\nillum 2", 0.5, vec![]),
            ("Ns 1", 0.0, vec![remark]),
            ("Ns 20\nillum 1", 0.0, vec![]),
            ("Ns 20\nillum 0", 0.0, vec![]),
            ("Ns 0\nillum 1", 0.0, vec![]),
            ("Ns 0", 0.0, vec![remark]),
            ("Ns 0.4", 0.0, vec![remark]),
            ("illum 2", 0.0, vec![remark]),
        ] {
            let text = format!("newmtl m\nKs 0.5 0.5 0.5\n{statements}\n");
            let (material, _, given) = read(&text, folder.path()).expect(statements);
            assert_eq!((material.specular, given), ([specular; 3], remarks.into_iter().map(str::to_owned).collect()));
        }
    }

    #[test]
    fn image_alpha_selects_mask_and_opacity_selects_blend() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        write_png(folder.path(), "leaf.png", 2, [9, 8, 7, 0]);
        write_png(folder.path(), "solid.png", 2, [9, 8, 7, 255]);
        write_png(folder.path(), "grey.png", 3, [100, 100, 100, 255]);
        let mask = AlphaMode::Mask { cutoff: 0.5 };
        for (text, alpha_mode, second_texel_alpha) in [
            ("map_Kd leaf.png\nmap_d leaf.png", mask, Some(0)),
            ("map_Kd leaf.png", mask, Some(0)),
            ("map_Kd solid.png", AlphaMode::Opaque, Some(255)),
            ("map_Kd solid.png\nmap_d grey.png", mask, Some(100)),
            ("map_d grey.png", mask, Some(100)),
            ("d 0.5", AlphaMode::Blend, None),
            ("map_Kd leaf.png\nTr 0.5", AlphaMode::Blend, Some(0)),
        ] {
            let (material, texture_cache, _) = read(&format!("newmtl m\n{text}\n"), folder.path()).expect(text);
            assert_eq!(material.alpha_mode, alpha_mode, "{text}");
            let actual_alpha = material.color_texture.map(|index| texture_cache.textures()[index].rgba()[7]);
            assert_eq!(actual_alpha, second_texel_alpha, "{text}");
        }
    }

    #[test]
    fn normal_maps_are_loaded_and_height_maps_are_skipped() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        write_png(folder.path(), "n.png", 1, [128, 128, 255, 255]);
        write_png(folder.path(), "h.png", 1, [128, 128, 128, 255]);
        assert_eq!(read("newmtl m\nnorm n.png\n", folder.path()).expect("a valid material").0.normal_texture, Some(0));
        let (material, _, remarks) = read("newmtl m\nbump h.png\n", folder.path()).expect("a valid material");
        assert_eq!(material.normal_texture, None);
        assert!(remarks[0].contains("'h.png' is a gray height map"), "{remarks:?}");
    }

    /// Light intensities, roundings, and values that are not numbers.
    #[test]
    fn numbers_out_of_range_are_remarks_with_the_used_value() {
        let text = "newmtl m\nKd 1.5 -0.0001 0.0\nKs 2 1.0000001 nan\nTr -0.00001\nNs 1e9\nKa 1 1 1 1\n";
        let statements = super::super::mtl::parse(text.as_bytes()).expect("an MTL library");
        let (mut texture_cache, mut remarks) = (TextureCache::default(), Vec::new());
        let files = AssetDir::unrestricted(&std::env::temp_dir());
        let material = create_material("m", &statements["m"], &files, &mut texture_cache, &mut remarks);
        let material = material.expect("a material");
        assert_eq!((material.diffuse, material.specular), ([1.0, 0.0, 0.0], [0.0; 3]));
        assert_eq!((material.alpha, material.alpha_mode, material.shininess), (1.0, AlphaMode::Opaque, 1e6));
        let expected = [
            "Ka: expected one or three numbers, got 1 1 1 1: three are used",
            "Kd: expected 0 to 1, got 1.5: 1 is used",
            "Kd: expected 0 to 1, got -0.0001: 0 is used",
            "Ks: expected 0 to 1, got 2: 1 is used",
            "Ks: expected 0 to 1, got NaN: the default is used",
            "d: expected 0 to 1, got 1.00001: 1 is used",
            "Ns: expected 0 to 1000000, got 1000000000: 1000000 is used",
        ];
        assert_eq!(remarks, expected.map(|remark| format!("material 'm': {remark}")));
    }

    #[test]
    fn other_image_formats_are_remarks_but_errors_in_strict_mode() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(folder.path().join("a.tga"), [0, 0, 2, 0, 0, 0]).expect("a writable file");
        for (statement, field, stand_in) in [
            ("map_Kd", "map_Kd", "the color Kd is drawn"),
            ("map_d", "map_d", "the surface is opaque"),
            ("norm", "normal map", "the normals of the mesh are used"),
        ] {
            let text = format!("newmtl m\n{statement} a.tga\n");
            let statements = super::super::mtl::parse(text.as_bytes()).expect("an MTL library");
            let (mut texture_cache, mut remarks) = (TextureCache::default(), Vec::new());
            let files = AssetDir::unrestricted(folder.path());
            let material = create_material("m", &statements["m"], &files, &mut texture_cache, &mut remarks);
            let material = material.expect("a material without the image");
            assert_eq!((material.color_texture, material.normal_texture), (None, None));
            let expected = format!("material 'm': {field} 'a.tga' is no PNG, JPEG or WebP image: {stand_in}");
            assert_eq!(remarks, [expected]);
            let message = read(&text, folder.path()).expect_err(statement).to_string();
            assert!(
                message.ends_with("expected a PNG, JPEG or WebP image, got another format (strict mode)"),
                "{message}"
            );
        }
    }

    #[test]
    fn invalid_images_and_numbers_are_rejected_with_material() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        std::fs::write(folder.path().join("broken.png"), b"\x89PNG\r\n\x1a\n").expect("a writable file");
        for (statement, start) in [
            ("map_Kd no.png", "material 'm': map_Kd: file 'no.png': expected an existing file, got none (strict mode)"),
            (
                "map_Kd broken.png",
                "material 'm': map_Kd, map_d: texture 'broken.png': expected a PNG, JPEG or WebP image",
            ),
            ("norm no.png", "material 'm': normal map: file 'no.png': expected an existing file"),
            ("d 7", "material 'm': d: expected 0 to 1, got 7 (strict mode)"),
            ("Ns nan", "material 'm': Ns: expected 0 to 1000000, got NaN (strict mode)"),
            ("Ka 0 0 0\nKd 1 1 2", "material 'm': Kd: expected 0 to 1, got 2 (strict mode)"),
        ] {
            let message = read(&format!("newmtl m\n{statement}\n"), folder.path()).expect_err(statement).to_string();
            assert!(message.starts_with(start), "{message}");
        }
    }
}
