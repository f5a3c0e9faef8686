//! Phong materials: equation 3.12 of B. Wang's thesis "CUDA Deformers for Model Reduction" with clamped dot products,
//! extended by alpha, textures and normal maps.

use crate::error::{Result, invalid};

/// How a material's alpha is used (as in glTF).
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum AlphaMode {
    /// Alpha is ignored.
    #[default]
    Opaque,
    /// Fragments with an alpha below the cutoff are discarded, also in the shadow pass.
    Mask { cutoff: f32 },
    /// Drawn after opaque triangles and blended by alpha.
    Blend,
}

/// A Phong material. Colors are linear, 0 to 1.
#[derive(Debug, Clone, PartialEq)]
pub struct Material {
    pub name: String,
    pub ambient: [f32; 3],
    pub diffuse: [f32; 3],
    pub specular: [f32; 3],
    /// Phong exponent, 0 to 1e6.
    pub shininess: f32,
    /// 0 (invisible) to 1 (opaque).
    pub alpha: f32,
    /// Index into the scene's textures. The texture multiplies diffuse, ambient and alpha; its colors are sRGB.
    pub color_texture: Option<usize>,
    /// Index into the scene's textures. A tangent-space normal map with +Y up (OpenGL's convention) and linear values.
    pub normal_texture: Option<usize>,
    pub alpha_mode: AlphaMode,
    /// Draws back faces too, with their normal flipped towards the viewer.
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
            color_texture: None,
            normal_texture: None,
            alpha_mode: AlphaMode::Opaque,
            double_sided: false,
        }
    }
}

impl Material {
    /// The color of surfaces whose source has none, linear: a steel blue of medium luminance, which differs clearly from
    /// the background and the shadows of a studio.
    pub const UNSPECIFIED_COLOR: [f32; 3] = [0.19, 0.31, 0.47];

    /// The material of surfaces whose source has none: [`Self::UNSPECIFIED_COLOR`] with a wide highlight, double-sided.
    /// An empty name becomes `default`.
    pub fn unspecified(name: &str) -> Self {
        Self {
            name: if name.is_empty() { "default" } else { name }.into(),
            ambient: Self::UNSPECIFIED_COLOR,
            diffuse: Self::UNSPECIFIED_COLOR,
            specular: [0.10; 3],
            shininess: 24.0,
            double_sided: true,
            ..Self::default()
        }
    }

    /// Multiplies the ambient and the diffuse color by a linear color.
    pub fn multiply_color(&mut self, color: [f32; 3]) {
        for factor in [&mut self.ambient, &mut self.diffuse] {
            factor.iter_mut().zip(color).for_each(|(factor, channel)| *factor *= channel);
        }
    }

    /// Validates all numbers.
    ///
    /// # Errors
    /// `Invalid` with the material and the field.
    pub fn validated(self) -> Result<Self> {
        let check_unit_interval = |field: &str, value: f32| match value {
            0.0..=1.0 => Ok(()),
            _ => Err(invalid(format!("material '{}': {field}", self.name), "0 to 1", value)),
        };
        for (field, color) in [("ambient", self.ambient), ("diffuse", self.diffuse), ("specular", self.specular)] {
            color.into_iter().try_for_each(|channel| check_unit_interval(field, channel))?;
        }
        check_unit_interval("alpha", self.alpha)?;
        if let AlphaMode::Mask { cutoff } = self.alpha_mode {
            check_unit_interval("cutoff", cutoff)?;
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
    fn out_of_range_alpha_is_rejected_with_its_field() {
        let error = Material { alpha: 7.0, ..Material::default() }.validated().expect_err("an alpha out of range");
        assert_eq!(error.to_string(), "material 'white': alpha: expected 0 to 1, got 7");
        let nan_material = Material { diffuse: [0.0, f32::NAN, 0.0], ..Material::default() };
        assert!(nan_material.validated().is_err());
        assert!(Material::default().validated().is_ok());
    }
}
