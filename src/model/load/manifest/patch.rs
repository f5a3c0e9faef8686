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
    /// Returns the index of the texture in the file `path`. The first call for a file reads it.
    fn load_texture(&mut self, path: &str) -> Result<usize>;
    fn texture(&self, index: usize) -> Option<&Texture>;
}

impl MaterialPatch {
    /// Applies the overrides to `material`.
    ///
    /// Without an `alpha_mode`, an opaque material becomes blended if its new alpha is below 1, or masked if its new
    /// color texture has alpha.
    ///
    /// # Errors
    /// `Invalid` with the material and the key, for a texture that cannot be read or a cutoff without alpha mode mask.
    pub(super) fn apply(&self, material: &mut Material, lookup: &mut impl TextureLookup) -> Result<()> {
        let field_of = |key: &str| format!("material '{}': {key}", material.name);
        let mut load_texture = |path: &str, key: &str| match path {
            "" => Ok(None),
            path => lookup.load_texture(path).map(Some).map_err(|error| error.prefix_field(&field_of(key))),
        };
        let color_texture =
            self.color_texture.as_deref().map(|path| load_texture(path, "color_texture")).transpose()?;
        let normal_texture =
            self.normal_texture.as_deref().map(|path| load_texture(path, "normal_texture")).transpose()?;
        let new_texture_has_alpha =
            color_texture.flatten().and_then(|index| lookup.texture(index)).is_some_and(Texture::has_alpha);
        let alpha_mode = match (self.alpha_mode, material.alpha_mode) {
            (Some(AlphaModeKey::Opaque), _) => AlphaMode::Opaque,
            (Some(AlphaModeKey::Blend), _) => AlphaMode::Blend,
            (Some(AlphaModeKey::Mask), AlphaMode::Mask { cutoff }) => AlphaMode::Mask { cutoff },
            (Some(AlphaModeKey::Mask), _) => AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF },
            (None, AlphaMode::Opaque) if self.alpha.is_some_and(|alpha| alpha < 1.0) => AlphaMode::Blend,
            (None, AlphaMode::Opaque) if new_texture_has_alpha => AlphaMode::Mask { cutoff: DEFAULT_ALPHA_CUTOFF },
            (None, alpha_mode) => alpha_mode,
        };
        let alpha_mode = match (alpha_mode, self.cutoff) {
            (alpha_mode, None) => alpha_mode,
            (AlphaMode::Mask { .. }, Some(cutoff)) => AlphaMode::Mask { cutoff },
            (_, Some(cutoff)) => return Err(invalid(field_of("cutoff"), "alpha_mode mask or no cutoff", cutoff)),
        };
        // An override of the diffuse color also overrides the ambient color, unless that has an override.
        material.ambient = self.ambient.or(self.diffuse).unwrap_or(material.ambient);
        material.diffuse = self.diffuse.unwrap_or(material.diffuse);
        material.specular = self.specular.unwrap_or(material.specular);
        material.shininess = self.shininess.unwrap_or(material.shininess);
        material.alpha = self.alpha.unwrap_or(material.alpha);
        material.color_texture = color_texture.unwrap_or(material.color_texture);
        material.normal_texture = normal_texture.unwrap_or(material.normal_texture);
        material.double_sided = self.double_sided.unwrap_or(material.double_sided);
        material.alpha_mode = alpha_mode;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    struct LoadedTextures(Vec<Texture>);

    impl TextureLookup for LoadedTextures {
        fn load_texture(&mut self, path: &str) -> Result<usize> {
            let index = self.0.iter().position(|texture| texture.name == path);
            index.ok_or_else(|| invalid(format!("file '{path}'"), "an existing file", "none"))
        }

        fn texture(&self, index: usize) -> Option<&Texture> {
            self.0.get(index)
        }
    }

    /// Applies the overrides in `text` to `material`. The scene has the textures "solid" (index 0, opaque) and "leaf"
    /// (index 1, with alpha 0).
    fn patch_material(text: &str, mut material: Material) -> Result<Material> {
        let texture = |name: &str, alpha: u8| Texture::new(name, 1, 1, vec![1, 2, 3, alpha]).expect("a valid texture");
        let patch: MaterialPatch = toml::from_str(text).map_err(|error| invalid("toml", "a patch", error.message()))?;
        patch.apply(&mut material, &mut LoadedTextures(vec![texture("solid", 255), texture("leaf", 0)]))?;
        Ok(material)
    }

    #[test]
    fn patch_changes_only_the_given_keys() {
        let base = || Material { color_texture: Some(9), specular: [0.5; 3], ..Material::default() };
        assert_eq!(patch_material("", base()).expect("a valid patch"), base());
        // The empty name removes the color texture. The alpha below 1 selects blending.
        let text = "alpha = 0.5\ncolor_texture = ''\ndiffuse = [1, 0, 0]\nnormal_texture = 'solid'";
        let patched = patch_material(text, base()).expect("a valid patch");
        assert_eq!((patched.color_texture, patched.normal_texture), (None, Some(0)));
        assert_eq!((patched.diffuse, patched.specular), ([1.0, 0.0, 0.0], [0.5; 3]));
        assert_eq!(patched.alpha_mode, AlphaMode::Blend);
    }

    #[test]
    fn texture_alpha_selects_mask_unless_a_mode_is_given() {
        let mask = |cutoff| AlphaMode::Mask { cutoff };
        let masked = || Material { alpha_mode: mask(0.3), ..Material::default() };
        for (text, base, alpha_mode) in [
            ("color_texture = 'leaf'", Material::default(), mask(0.5)),
            ("color_texture = 'solid'", Material::default(), AlphaMode::Opaque),
            ("color_texture = 'leaf'", masked(), mask(0.3)),
            ("alpha_mode = 'mask'", masked(), mask(0.3)),
            ("cutoff = 0.7", masked(), mask(0.7)),
            ("color_texture = 'leaf'\nalpha_mode = 'blend'", masked(), AlphaMode::Blend),
            ("alpha_mode = 'opaque'", masked(), AlphaMode::Opaque),
        ] {
            assert_eq!(patch_material(text, base).expect(text).alpha_mode, alpha_mode, "{text}");
        }
    }

    #[test]
    fn invalid_overrides_are_rejected_with_their_key() {
        for (text, start) in [
            ("color_texture = 'no'", "material 'white': color_texture: file 'no': expected an existing file"),
            ("cutoff = 0.5", "material 'white': cutoff: expected alpha_mode mask or no cutoff"),
            ("colour_texture = 'leaf'", "toml: expected a patch, got unknown field `colour_texture`"),
            ("alpha_mode = 'cut'", "toml: expected a patch, got unknown variant `cut`"),
        ] {
            let message = patch_material(text, Material::default()).expect_err(text).to_string();
            assert!(message.starts_with(start), "{message}");
        }
    }
}
