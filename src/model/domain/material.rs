//! Phong materials: equation 3.12 of the thesis with clamped dots, extended by alpha, textures and normal maps.

use crate::error::{Result, invalid};

/// What happens to the alpha of a material (glTF's words).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum AlphaMode {
    /// Alpha is ignored.
    #[default]
    Opaque,
    /// A fragment below the cutoff is left out, in the shadow pass too.
    Mask { cutoff: f32 },
    /// Drawn after all else and blended by alpha.
    Blend,
}

/// Colours are linear, 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    pub name: String,
    pub ambient: [f32; 3],
    pub diffuse: [f32; 3],
    pub specular: [f32; 3],
    /// Phong exponent, 0 to 1e6.
    pub shininess: f32,
    /// 0 (nothing to be seen) to 1.
    pub alpha: f32,
    /// Index into the scene's textures; multiplies diffuse, ambient and alpha. Stored sRGB.
    pub colour_texture: Option<usize>,
    /// Index into the scene's textures; tangent space, +Y up (OpenGL's convention). Stored linear.
    pub normal_texture: Option<usize>,
    pub alpha_mode: AlphaMode,
    /// Back faces are drawn too, with their normal turned to the viewer.
    pub double_sided: bool,
}

impl Default for Material {
    fn default() -> Self {
        Self {
            name: "white".into(),
            ambient: [1.0; 3],
            diffuse: [1.0; 3],
            specular: [0.0; 3],
            shininess: 1.0,
            alpha: 1.0,
            colour_texture: None,
            normal_texture: None,
            alpha_mode: AlphaMode::Opaque,
            double_sided: false,
        }
    }
}

impl Material {
    /// The material itself if all of its numbers are in range.
    ///
    /// # Errors
    /// `Invalid` naming the material and the field.
    pub fn checked(self) -> Result<Self> {
        let unit = |field: &str, value: f32| match value {
            0.0..=1.0 => Ok(()),
            _ => Err(invalid(format!("material '{}': {field}", self.name), "0 to 1", value)),
        };
        for (field, colour) in [("ambient", self.ambient), ("diffuse", self.diffuse), ("specular", self.specular)] {
            colour.into_iter().try_for_each(|channel| unit(field, channel))?;
        }
        unit("alpha", self.alpha)?;
        if let AlphaMode::Mask { cutoff } = self.alpha_mode {
            unit("cutoff", cutoff)?;
        }
        if !(0.0..=1e6).contains(&self.shininess) {
            return Err(invalid(format!("material '{}': shininess", self.name), "0 to 1e6", self.shininess));
        }
        Ok(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_alpha_of_seven_is_refused_with_field_expected_and_given() {
        let refusal = Material { alpha: 7.0, ..Material::default() }.checked().expect_err("7 is no alpha");
        assert_eq!(refusal.to_string(), "material 'white': alpha: expected 0 to 1, given 7");
        let nan = Material { diffuse: [0.0, f32::NAN, 0.0], ..Material::default() };
        assert!(nan.checked().is_err());
        assert!(Material::default().checked().is_ok());
    }
}
