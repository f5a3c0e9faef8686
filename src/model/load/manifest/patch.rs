//! Material overrides of `scene.toml`.

use crate::domain::{AlphaMode, Material, Texture};
use crate::error::{Result, invalid};
use crate::load::obj::DEFAULT_ALPHA_CUTOFF;

/// Overrides of a material. Missing keys keep the model's values; an empty texture name removes the texture.
#[derive(Debug, Clone, Default, serde::Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct MaterialPatch {
    ambient: Option<[f32; 3]>,
    diffuse: Option<[f32; 3]>,
    specular: Option<[f32; 3]>,
    shininess: Option<f32>,
    alpha: Option<f32>,
    #[serde(rename = "colour_texture")]
    color_texture: Option<String>,
    normal_texture: Option<String>,
    alpha_mode: Option<AlphaModeKey>,
    cutoff: Option<f32>,
    double_sided: Option<bool>,
}

#[derive(Debug, Clone, Copy, PartialEq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
enum AlphaModeKey {
    Opaque,
    Mask,
    Blend,
}

/// The textures of the scene whose materials are overridden.
pub(super) trait TextureLookup {
    /// The index of the texture in a file, which is read on the first call.
    fn index(&mut self, path: &str) -> Result<usize>;
    /// The texture at an index.
    fn at(&self, index: usize) -> Option<&Texture>;
}

impl MaterialPatch {
    /// Applies the overrides to `material`.
    ///
    /// Without an `alpha_mode`, an opaque material becomes blended if its new alpha is below 1, or masked if its new
    /// color texture has alpha.
    ///
    /// # Errors
    /// `Invalid` with the material and the key, for a texture that cannot be read or a cutoff without alpha mode mask.
    pub(super) fn apply(&self, material: &mut Material, gallery: &mut impl TextureLookup) -> Result<()> {
        let place = |key: &str| format!("material '{}': {key}", material.name);
        let mut texture = |path: &str, key: &str| match path {
            "" => Ok(None),
            path => gallery.index(path).map(Some).map_err(|error| error.prefix_field(&place(key))),
        };
        let color = self.color_texture.as_deref().map(|path| texture(path, "colour_texture")).transpose()?;
        let normal = self.normal_texture.as_deref().map(|path| texture(path, "normal_texture")).transpose()?;
        let cut_out = color.flatten().and_then(|index| gallery.at(index)).is_some_and(Texture::has_alpha);
        let mode = match (self.alpha_mode, material.alpha_mode) {
            (Some(AlphaModeKey::Opaque), _) => AlphaMode::Opaque,
            (Some(AlphaModeKey::Blend), _) => AlphaMode::Blend,
            (Some(AlphaModeKey::Mask), AlphaMode::Mask { cutoff }) => AlphaMode::Mask { cutoff },
            (Some(AlphaModeKey::Mask), _) => AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF },
            (None, AlphaMode::Opaque) if self.alpha.is_some_and(|alpha| alpha < 1.0) => AlphaMode::Blend,
            (None, AlphaMode::Opaque) if cut_out => AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF },
            (None, kept) => kept,
        };
        let mode = match (mode, self.cutoff) {
            (mode, None) => mode,
            (AlphaMode::Mask { .. }, Some(cutoff)) => AlphaMode::Mask { cutoff },
            (_, Some(cutoff)) => return Err(invalid(place("cutoff"), "the alpha_mode mask with it", cutoff)),
        };
        // An override of the diffuse color also applies in the shade.
        material.ambient = self.ambient.or(self.diffuse).unwrap_or(material.ambient);
        material.diffuse = self.diffuse.unwrap_or(material.diffuse);
        material.specular = self.specular.unwrap_or(material.specular);
        material.shininess = self.shininess.unwrap_or(material.shininess);
        material.alpha = self.alpha.unwrap_or(material.alpha);
        material.color_texture = color.unwrap_or(material.color_texture);
        material.normal_texture = normal.unwrap_or(material.normal_texture);
        material.double_sided = self.double_sided.unwrap_or(material.double_sided);
        material.alpha_mode = mode;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct Two(Vec<Texture>);

    impl TextureLookup for Two {
        fn index(&mut self, path: &str) -> Result<usize> {
            let found = self.0.iter().position(|texture| texture.name == path);
            found.ok_or_else(|| invalid(format!("file '{path}'"), "a file that is there", "none"))
        }
        fn at(&self, index: usize) -> Option<&Texture> {
            self.0.get(index)
        }
    }

    fn patched(text: &str, before: Material) -> Result<Material> {
        let texture = |name: &str, alpha: u8| Texture::new(name, 1, 1, vec![1, 2, 3, alpha]).expect("a texel");
        let mut material = before;
        let patch: MaterialPatch = toml::from_str(text).map_err(|error| invalid("toml", "a patch", error.message()))?;
        patch.apply(&mut material, &mut Two(vec![texture("solid", 255), texture("leaf", 0)]))?;
        Ok(material)
    }

    #[test]
    fn what_is_said_changes_and_what_is_not_stays() {
        let before = || Material { color_texture: Some(9), specular: [0.5; 3], ..Material::default() };
        assert_eq!(patched("", before()).expect("nothing"), before());
        let after =
            patched("alpha = 0.5\ncolour_texture = ''\ndiffuse = [1, 0, 0]\nnormal_texture = 'solid'", before());
        let after = after.expect("good");
        assert_eq!((after.color_texture, after.normal_texture, after.alpha_mode), (None, Some(0), AlphaMode::Blend));
        assert_eq!((after.diffuse, after.specular), ([1.0, 0.0, 0.0], [0.5; 3]));
    }

    #[test]
    fn alpha_modes_follow_the_texture_unless_they_are_stated() {
        let mask = |cutoff| AlphaMode::Mask { cutoff };
        let masked = || Material { alpha_mode: mask(0.3), ..Material::default() };
        for (text, before, after) in [
            ("colour_texture = 'leaf'", Material::default(), mask(0.5)),
            ("colour_texture = 'solid'", Material::default(), AlphaMode::Opaque),
            ("colour_texture = 'leaf'", masked(), mask(0.3)),
            ("alpha_mode = 'mask'", masked(), mask(0.3)),
            ("cutoff = 0.7", masked(), mask(0.7)),
            ("colour_texture = 'leaf'\nalpha_mode = 'blend'", masked(), AlphaMode::Blend),
            ("alpha_mode = 'opaque'", masked(), AlphaMode::Opaque),
        ] {
            assert_eq!(patched(text, before).expect(text).alpha_mode, after, "{text}");
        }
    }

    #[test]
    fn missing_textures_unknown_keys_and_stray_cutoffs_are_refused() {
        for (text, start) in [
            ("colour_texture = 'no'", "material 'white': colour_texture: file 'no': expected a file that is there"),
            ("cutoff = 0.5", "material 'white': cutoff: expected the alpha_mode mask with it"),
            ("color_texture = 'leaf'", "toml: expected a patch, got unknown field `color_texture`"),
            ("alpha_mode = 'cut'", "toml: expected a patch, got unknown variant `cut`"),
        ] {
            let refusal = patched(text, Material::default()).expect_err(text).to_string();
            assert!(refusal.starts_with(start), "{refusal}");
        }
    }
}
