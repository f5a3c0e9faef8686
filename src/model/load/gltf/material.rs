//! Converts glTF's metallic-roughness materials to Phong materials (equation 3.12 of the thesis).
//!
//! With base color factor c, metalness m and roughness p (each of m and p is its factor times the mean of its texture
//! channel, because Phong's parameters are constant over a surface), alpha = p^2 and the reflectance at normal
//! incidence f = 0.04 (1 - m) + c m:
//!
//! ```text
//! diffuse   = c (1 - m / 2)            a metal mirrors its surroundings, which are not rendered; half remains diffuse
//! ambient   = c
//! specular  = min(1, f / (4 alpha^2))  the peak of a GGX lobe relative to a white diffuse surface
//! shininess = (2 / alpha^2 - 2) / 4    exponent of a half-vector lobe; that of a reflected vector is a quarter of it
//! ```
//!
//! `shininess` is clamped to 1 to 10,000. The base color texture multiplies diffuse, ambient and alpha. Normal textures
//! have +Y up, as in [`Material`]. A mask material remains one even if its base color texture has no alpha, because a
//! scene file may replace the texture.

use std::collections::HashMap;

use super::document::{self, Document};
use super::get_element;
use super::texture::TextureLoader;
use super::warnings::{ImportWarnings, sanitize};
use crate::domain::{AlphaMode, Material};
use crate::error::{Result, invalid};

/// Converts materials when primitives first use them.
#[derive(Debug)]
pub(super) struct MaterialConverter<'a> {
    document: &'a Document,
    pub(super) texture_loader: TextureLoader<'a>,
    /// The converted materials.
    pub(super) materials: Vec<Material>,
    /// Indices in `materials`, by index in the document (`None` is the default material) and usability of textures.
    known: HashMap<(Option<usize>, bool), usize>,
}

impl<'a> MaterialConverter<'a> {
    pub(super) fn new(document: &'a Document, texture_loader: TextureLoader<'a>) -> Self {
        Self { document, texture_loader, materials: Vec::new(), known: HashMap::new() }
    }

    /// The set of texture coordinates of a material: that of the base color, else of the normal map, else 0.
    ///
    /// # Errors
    /// `Invalid` if the material does not exist.
    pub(super) fn uv_set(&self, material: Option<usize>) -> Result<u32> {
        let Some(index) = material else { return Ok(0) };
        let material = get_element(&self.document.materials, index, "material")?;
        let base = material.pbr_metallic_roughness.base_color_texture.as_ref();
        Ok(base.or(material.normal_texture.as_ref()).map_or(0, |wanted| wanted.tex_coord))
    }

    /// The index of a converted material. It has no textures if the primitive lacks the texture coordinates.
    ///
    /// # Errors
    /// `Invalid` with the material and the field.
    pub(super) fn material_index(
        &mut self,
        wanted: Option<usize>,
        has_uvs: bool,
        remarks: &mut ImportWarnings,
    ) -> Result<usize> {
        if let Some(known) = self.known.get(&(wanted, has_uvs)) {
            return Ok(*known);
        }
        let material = match wanted {
            None => Material::default(),
            Some(index) => {
                let source = get_element(&self.document.materials, index, "material")?;
                let made = self.phong(source, index, has_uvs, remarks);
                made.map_err(|error| error.prefix_field(&format!("materials[{index}]")))?
            }
        };
        self.materials.push(material);
        self.known.insert((wanted, has_uvs), self.materials.len() - 1);
        Ok(self.materials.len() - 1)
    }

    fn phong(
        &mut self,
        source: &document::Material,
        index: usize,
        has_uvs: bool,
        remarks: &mut ImportWarnings,
    ) -> Result<Material> {
        let name = source.name.as_deref().filter(|name| !name.is_empty());
        let name = name.map_or_else(|| format!("material {index}"), |name| sanitize(name, 120));
        let pbr = &source.pbr_metallic_roughness;
        check_factors(pbr)?;
        let color = self.base_color(pbr, &name, has_uvs, remarks)?;
        let normal = self.normal_map(source, &name, has_uvs, remarks)?;
        let (metal, roughness) = self.metal_and_roughness(pbr, &name, remarks)?;
        if source.occlusion_texture.is_some() {
            remarks.add(format!("material '{name}': the occlusion texture is ignored"));
        }
        if source.emissive_texture.is_some() || source.emissive_factor.is_some_and(|color| color != [0.0; 3]) {
            remarks.add(format!("material '{name}': emission is ignored"));
        }
        let [red, green, blue, alpha] = pbr.base_color_factor;
        let base = [red, green, blue];
        let square = roughness.powi(4).max(1e-8);
        Material {
            ambient: base,
            diffuse: base.map(|channel| channel * (1.0 - 0.5 * metal)),
            specular: base.map(|channel| ((0.04 * (1.0 - metal) + channel * metal) / (4.0 * square)).min(1.0)),
            shininess: ((2.0 / square - 2.0) / 4.0).clamp(1.0, 1e4),
            alpha,
            color_texture: color,
            normal_texture: normal,
            alpha_mode: alpha_mode(source)?,
            double_sided: source.double_sided,
            name,
        }
        .validated()
    }

    fn base_color(
        &mut self,
        pbr: &document::PbrMetallicRoughness,
        name: &str,
        has_uvs: bool,
        remarks: &mut ImportWarnings,
    ) -> Result<Option<usize>> {
        let Some(wanted) = &pbr.base_color_texture else { return Ok(None) };
        if !has_uvs {
            let set = wanted.tex_coord;
            remarks.add(format!("material '{name}': a primitive lacks TEXCOORD_{set}, its colour texture is left out"));
            return Ok(None);
        }
        self.texture_loader
            .texture_index(wanted, remarks)
            .map(Some)
            .map_err(within("pbrMetallicRoughness.baseColorTexture"))
    }

    fn normal_map(
        &mut self,
        source: &document::Material,
        name: &str,
        has_uvs: bool,
        remarks: &mut ImportWarnings,
    ) -> Result<Option<usize>> {
        let Some(wanted) = &source.normal_texture else { return Ok(None) };
        let base = source.pbr_metallic_roughness.base_color_texture.as_ref();
        let other_set = base.is_some_and(|base| base.tex_coord != wanted.tex_coord);
        if other_set || !has_uvs {
            let reason = if other_set { "it wants another set than the colour texture:" } else { "a primitive lacks" };
            let set = wanted.tex_coord;
            remarks.add(format!("material '{name}': the normal map is left out, {reason} TEXCOORD_{set}"));
            return Ok(None);
        }
        if let Some(scale) = wanted.scale.filter(|scale| *scale != 1.0) {
            remarks.add(format!("material '{name}': the normal map's scale of {scale} is ignored"));
        }
        self.texture_loader.texture_index(wanted, remarks).map(Some).map_err(within("normalTexture"))
    }

    /// Metalness and roughness, 0 to 1. Their texture stores them in blue and green.
    fn metal_and_roughness(
        &mut self,
        pbr: &document::PbrMetallicRoughness,
        name: &str,
        remarks: &mut ImportWarnings,
    ) -> Result<(f32, f32)> {
        let factors = (pbr.metallic_factor, pbr.roughness_factor);
        let Some(wanted) = &pbr.metallic_roughness_texture else { return Ok(factors) };
        let channel_means = self
            .texture_loader
            .channel_means(wanted, remarks)
            .map_err(within("pbrMetallicRoughness.metallicRoughnessTexture"))?;
        remarks.add(format!("material '{name}': of the metallic-roughness texture only the mean is used"));
        Ok((factors.0 * channel_means[2], factors.1 * channel_means[1]))
    }
}

fn within(place: &str) -> impl Fn(crate::error::Error) -> crate::error::Error {
    move |error| error.prefix_field(place)
}

fn check_factors(pbr: &document::PbrMetallicRoughness) -> Result<()> {
    let [red, green, blue, alpha] = pbr.base_color_factor;
    let factors = [
        ("baseColorFactor[0]", red),
        ("baseColorFactor[1]", green),
        ("baseColorFactor[2]", blue),
        ("baseColorFactor[3]", alpha),
        ("metallicFactor", pbr.metallic_factor),
        ("roughnessFactor", pbr.roughness_factor),
    ];
    match factors.into_iter().find(|(_, factor)| !(0.0..=1.0).contains(factor)) {
        None => Ok(()),
        Some((field, factor)) => Err(invalid(format!("pbrMetallicRoughness.{field}"), "0 to 1", factor)),
    }
}

fn alpha_mode(source: &document::Material) -> Result<AlphaMode> {
    match source.alpha_mode.as_deref() {
        None | Some("OPAQUE") => Ok(AlphaMode::Opaque),
        Some("BLEND") => Ok(AlphaMode::Blend),
        Some("MASK") => Ok(AlphaMode::Mask { cutoff: source.alpha_cutoff.unwrap_or(0.5) }),
        Some(other) => Err(invalid("alphaMode", "OPAQUE, MASK or BLEND", sanitize(other, 40))),
    }
}
