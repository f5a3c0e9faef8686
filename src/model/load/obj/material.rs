//! Converts MTL statements to Phong materials. Default colors: white for Kd, the value of Kd for Ka, black for Ks.

use super::mtl::MtlMaterial;
use crate::domain::{AlphaMode, Material, Texture};
use crate::error::Result;
use crate::load::asset_dir::AssetDir;
use crate::load::texture_cache::TextureCache;

/// The alpha-test cutoff of materials whose alpha comes from an image.
pub(in crate::load) const DEFAULT_ALPHA_CUTOFF: f32 = 0.5;

/// The material of `statements`, with images read from `files`.
///
/// Alpha in an image selects the alpha test; an opacity below 1 selects blending. Materials are double-sided, because
/// OBJ cannot express this property and leaves are usually single sheets.
///
/// # Errors
/// `Invalid` with the material and the statement: a missing or unreadable image, or a number out of range.
pub(super) fn material(
    name: &str,
    statements: &MtlMaterial,
    files: &AssetDir,
    texture_cache: &mut TextureCache,
    remarks: &mut Vec<String>,
) -> Result<Material> {
    let place = |statement: &str| format!("material '{name}': {statement}");
    let diffuse = statements.diffuse.unwrap_or([1.0; 3]);
    let color_texture =
        color_texture(statements, files, texture_cache).map_err(|error| error.prefix_field(&place("map_Kd, map_d")))?;
    let normal_texture = match &statements.normal_map {
        Some(path) => {
            normal_texture(path, files, texture_cache).map_err(|error| error.prefix_field(&place("normal map")))?
        }
        None => None,
    };
    remarks.extend(statements.remarks.iter().cloned());
    if let (Some(path), None) = (&statements.normal_map, normal_texture) {
        remarks.push(place(&format!("'{path}' is a grey height map, not a normal map, and is not used")));
    }
    let alpha = statements.opacity.unwrap_or(1.0);
    let cut_out = color_texture.is_some_and(|index| texture_cache.list()[index].has_alpha());
    let alpha_mode = match () {
        () if alpha < 1.0 => AlphaMode::Blend,
        () if cut_out => AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF },
        () => AlphaMode::Opaque,
    };
    let material = Material {
        name: name.to_owned(),
        ambient: statements.ambient.unwrap_or(diffuse),
        diffuse,
        specular: statements.specular.unwrap_or([0.0; 3]),
        // Below 1, the highlight would extend past the light's horizon; files use 0 for "not specified".
        shininess: statements.exponent.unwrap_or(1.0).clamp(1.0, 1e6),
        alpha,
        color_texture,
        normal_texture,
        alpha_mode,
        double_sided: true,
    };
    material.validated()
}

/// The color image with the alpha of `map_d`, as far as they are given.
fn color_texture(
    statements: &MtlMaterial,
    files: &AssetDir,
    texture_cache: &mut TextureCache,
) -> Result<Option<usize>> {
    match (&statements.color_map, &statements.alpha_map) {
        (Some(color), Some(alpha)) if color != alpha => {
            let key = format!("{color} with the alpha of {alpha}");
            texture_cache
                .get_or_insert_with(&key, || with_alpha(&key, Some(&decode(files, color)?), &decode(files, alpha)?))
                .map(Some)
        }
        (None, Some(alpha)) => {
            let key = format!("white with the alpha of {alpha}");
            texture_cache.get_or_insert_with(&key, || with_alpha(&key, None, &decode(files, alpha)?)).map(Some)
        }
        (Some(color), _) => texture_cache.load(files, color).map(Some),
        (None, None) => Ok(None),
    }
}

fn decode(files: &AssetDir, path: &str) -> Result<Texture> {
    crate::load::texture_cache::decode(files, path)
}

/// Copies the alpha channel of `alpha`, or its red channel if it is opaque, to the texels of `color` (nearest
/// neighbor).
fn with_alpha(name: &str, color: Option<&Texture>, alpha: &Texture) -> Result<Texture> {
    let (width, height) = color.map_or((alpha.width(), alpha.height()), |image| (image.width(), image.height()));
    let channel = if alpha.has_alpha() { 3 } else { 0 };
    let mut rgba = color.map_or_else(|| vec![255; alpha.rgba().len()], |image| image.rgba().to_vec());
    let mut texels = rgba.chunks_exact_mut(4);
    for row in 0..u64::from(height) {
        let from_row = row * u64::from(alpha.height()) / u64::from(height);
        for column in 0..u64::from(width) {
            let from = from_row * u64::from(alpha.width()) + column * u64::from(alpha.width()) / u64::from(width);
            if let Some(texel) = texels.next() {
                texel[3] = alpha.rgba()[4 * from as usize + channel];
            }
        }
    }
    Texture::new(name, width, height, rgba)
}

/// Loads a normal map. `bump` may also name a gray height map, which is not supported and yields `None`.
fn normal_texture(path: &str, files: &AssetDir, texture_cache: &mut TextureCache) -> Result<Option<usize>> {
    let index = texture_cache.load(files, path)?;
    let gray =
        texture_cache.list()[index].rgba().chunks_exact(4).all(|texel| texel[0] == texel[1] && texel[1] == texel[2]);
    Ok((!gray).then_some(index))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn png(folder: &std::path::Path, name: &str, side: u32, texel: [u8; 4]) {
        let image = image::RgbaImage::from_pixel(side, side, image::Rgba(texel));
        image.save(folder.join(name)).expect("written");
    }

    fn read(text: &str, folder: &std::path::Path) -> Result<(Material, TextureCache, Vec<String>)> {
        let all = super::super::mtl::parse(text.as_bytes())?;
        let (mut texture_cache, mut remarks) = (TextureCache::default(), Vec::new());
        let material = material("m", &all["m"], &AssetDir::unrestricted(folder), &mut texture_cache, &mut remarks)?;
        Ok((material, texture_cache, remarks))
    }

    #[test]
    fn missing_colours_have_stated_values_and_black_stays_black() {
        let folder = tempfile::tempdir().expect("a folder");
        let (plain, ..) = read("newmtl m\nNs 0\n", folder.path()).expect("good");
        assert_eq!((plain.diffuse, plain.ambient, plain.specular), ([1.0; 3], [1.0; 3], [0.0; 3]));
        assert_eq!((plain.shininess, plain.alpha_mode), (1.0, AlphaMode::Opaque));
        let (black, ..) = read("newmtl m\nKd 0 0 0\n", folder.path()).expect("good");
        assert_eq!((black.diffuse, black.ambient), ([0.0; 3], [0.0; 3]));
    }

    #[test]
    fn alpha_of_an_image_masks_and_opacity_blends() {
        let folder = tempfile::tempdir().expect("a folder");
        png(folder.path(), "leaf.png", 2, [9, 8, 7, 0]);
        png(folder.path(), "solid.png", 2, [9, 8, 7, 255]);
        png(folder.path(), "grey.png", 3, [100, 100, 100, 255]);
        let mask = AlphaMode::Mask { cutoff: 0.5 };
        for (text, mode, alpha) in [
            ("map_Kd leaf.png\nmap_d leaf.png", mask, Some(0)),
            ("map_Kd leaf.png", mask, Some(0)),
            ("map_Kd solid.png", AlphaMode::Opaque, Some(255)),
            ("map_Kd solid.png\nmap_d grey.png", mask, Some(100)),
            ("map_d grey.png", mask, Some(100)),
            ("d 0.5", AlphaMode::Blend, None),
            ("map_Kd leaf.png\nTr 0.5", AlphaMode::Blend, Some(0)),
        ] {
            let (material, texture_cache, _) = read(&format!("newmtl m\n{text}\n"), folder.path()).expect(text);
            assert_eq!(material.alpha_mode, mode, "{text}");
            let texel = material.color_texture.map(|index| texture_cache.list()[index].rgba()[7]);
            assert_eq!(texel, alpha, "{text}");
        }
    }

    #[test]
    fn normal_maps_are_taken_and_grey_height_maps_are_remarked() {
        let folder = tempfile::tempdir().expect("a folder");
        png(folder.path(), "n.png", 1, [128, 128, 255, 255]);
        png(folder.path(), "h.png", 1, [128, 128, 128, 255]);
        assert_eq!(read("newmtl m\nnorm n.png\n", folder.path()).expect("good").0.normal_texture, Some(0));
        let (material, _, remarks) = read("newmtl m\nbump h.png\n", folder.path()).expect("good");
        assert_eq!(material.normal_texture, None);
        assert!(remarks[0].contains("'h.png' is a grey height map"), "{remarks:?}");
    }

    #[test]
    fn a_missing_or_broken_image_and_an_alpha_of_seven_are_refused_by_material() {
        let folder = tempfile::tempdir().expect("a folder");
        std::fs::write(folder.path().join("broken.png"), b"\x89PNG\r\n").expect("written");
        for (statement, start) in [
            ("map_Kd no.png", "material 'm': map_Kd, map_d: file 'no.png': expected a file that is there"),
            ("map_Kd broken.png", "material 'm': map_Kd, map_d: texture 'broken.png': expected a PNG or JPEG image"),
            ("norm no.png", "material 'm': normal map: file 'no.png': expected a file that is there"),
            ("d 7", "material 'm': alpha: expected 0 to 1, got 7"),
            ("Ka 0 0 0\nKd 1 1 2", "material 'm': diffuse: expected 0 to 1, got 2"),
        ] {
            let refusal = read(&format!("newmtl m\n{statement}\n"), folder.path()).expect_err(statement).to_string();
            assert!(refusal.starts_with(start), "{refusal}");
        }
    }
}
