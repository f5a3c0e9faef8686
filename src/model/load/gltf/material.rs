//! Converts glTF's metallic-roughness materials to Phong materials ([`Material`]).
//!
//! The inputs are the base color factor c, the metalness m and the roughness p. Each of m and p is the product of a
//! factor and the mean of a texture channel, because Phong's parameters are constant over a surface. With the GGX
//! parameter alpha = p^2 and the reflectance at normal incidence f = 0.04 (1 - m) + c m:
//!
//! ```text
//! diffuse   = c (1 - m / 2)            half remains for metals, because reflections of surroundings are not rendered
//! ambient   = c
//! specular  = min(1, f / (4 alpha^2))  the peak of a GGX lobe relative to a white diffuse surface
//! shininess = (2 / alpha^2 - 2) / 4    2 / alpha^2 - 2 is the exponent of a half-vector lobe; Phong has a quarter of it
//! ```
//!
//! `shininess` is clamped to 1 to 10,000. The base color texture multiplies diffuse, ambient and opacity. Normal
//! textures have +Y up, as in [`Material`]. A material with alpha mode "mask" keeps this mode even if its base color
//! texture has no alpha, because a scene file may replace the texture.

use std::collections::HashMap;

use super::document::{self, Document, REPEAT, TextureInfo, TextureTransform};
use super::get_element;
use super::remarks::{ImportRemarks, sanitize};
use super::texture::TextureLoader;
use crate::domain::{AlphaMode, Material, Mesh};
use crate::error::Result;
use crate::load::obj::DEFAULT_ALPHA_CUTOFF;
use crate::load::polygons::{VertexColors, paint, paint_over, patch_side};
use crate::load::values::CorrectedValue;

/// Converts materials when primitives first use them.
#[derive(Debug)]
pub(super) struct MaterialConverter<'a> {
    document: &'a Document,
    pub(super) texture_loader: TextureLoader<'a>,
    /// The converted materials.
    pub(super) materials: Vec<Material>,
    /// Indices in `materials` by key. A key is the index in the document (`None` for the default material) and whether
    /// the primitive has texture coordinates.
    material_indices: HashMap<(Option<usize>, bool), usize>,
}

impl<'a> MaterialConverter<'a> {
    pub(super) fn new(document: &'a Document, texture_loader: TextureLoader<'a>) -> Self {
        Self { document, texture_loader, materials: Vec::new(), material_indices: HashMap::new() }
    }

    /// The set of texture coordinates of a material: the set that its base color texture uses or, without this texture,
    /// the set of its normal map, or else 0.
    ///
    /// # Errors
    /// `Invalid` if the material does not exist.
    pub(super) fn uv_set(&self, material: Option<usize>) -> Result<u32> {
        let Some(index) = material else { return Ok(0) };
        let material = get_element(&self.document.materials, index, "material")?;
        let base_color_texture = material.pbr_metallic_roughness.base_color_texture.as_ref();
        Ok(base_color_texture.or(material.normal_texture.as_ref()).map_or(0, TextureInfo::uv_set))
    }

    /// The transform of the texture coordinates of a material: that of its base color texture or, without this texture, that
    /// of its normal map.
    ///
    /// # Errors
    /// `Invalid` if the material does not exist.
    pub(super) fn uv_transform(&self, material: Option<usize>) -> Result<TextureTransform> {
        let Some(index) = material else { return Ok(TextureTransform::default()) };
        let material = get_element(&self.document.materials, index, "material")?;
        let base_color_texture = material.pbr_metallic_roughness.base_color_texture.as_ref();
        Ok(base_color_texture.or(material.normal_texture.as_ref()).map(TextureInfo::transform).unwrap_or_default())
    }

    /// Whether the image of a material repeats along u and along v outside of the range 0 to 1.
    ///
    /// # Errors
    /// `Invalid` if the material does not exist.
    pub(super) fn repeats(&self, material: Option<usize>) -> Result<[bool; 2]> {
        let Some(index) = material else { return Ok([true; 2]) };
        let material = get_element(&self.document.materials, index, "material")?;
        let textures = [material.pbr_metallic_roughness.base_color_texture.as_ref(), material.normal_texture.as_ref()];
        let sampler = |texture: &TextureInfo| {
            let texture = self.document.textures.get(texture.index)?;
            self.document.samplers.get(texture.sampler?)
        };
        let samplers = || textures.into_iter().flatten().filter_map(sampler);
        Ok([samplers().all(|sampler| sampler.wrap_s == REPEAT), samplers().all(|sampler| sampler.wrap_t == REPEAT)])
    }

    /// Applies the colors of a primitive's vertices: adds a copy of the material that has them, and returns the mesh and the
    /// index of this copy. The colors multiply those of the material and its image. An opaque material ignores their alpha.
    ///
    /// # Errors
    /// As for [`paint`], and `Invalid` or `OutOfMemory` if the image of the colors exceeds the memory.
    pub(super) fn with_vertex_colors(
        &mut self,
        index: usize,
        mesh: Mesh,
        mut colors: Vec<[f32; 4]>,
        remarks: &mut ImportRemarks,
    ) -> Result<(Mesh, usize)> {
        let mut material = self.materials[index].clone();
        if material.alpha_mode == AlphaMode::Opaque {
            colors.iter_mut().for_each(|color| color[3] = 1.0);
        }
        let [first, others @ ..] = &colors[..] else { return Ok((mesh, index)) };
        let is_uniform = others.iter().all(|color| color == first);
        let mesh = match material.color_texture {
            _ if is_uniform => {
                let [red, green, blue, alpha] = *first;
                material.multiply_color([red, green, blue]);
                material.alpha *= alpha;
                mesh
            }
            // The image of the colors has texture coordinates of its own.
            _ if material.normal_texture.is_some() => {
                remarks.add("vertex colors are not used where the material has a normal map".into());
                return Ok((mesh, index));
            }
            Some(image) => {
                let side = patch_side(&mesh, &self.texture_loader.textures[image])?;
                self.texture_loader.charge_patches(side, mesh.triangles().len())?;
                let (mesh, texture) = paint_over(&mesh, &colors, &self.texture_loader.textures[image], side)?;
                material.color_texture = Some(self.texture_loader.add(texture));
                mesh
            }
            None => {
                self.texture_loader.charge_patches(2, mesh.triangles().len())?;
                let VertexColors::Image(painted) = paint(&mesh, &colors)? else { return Ok((mesh, index)) };
                let (mesh, texture) = *painted;
                material.color_texture = Some(self.texture_loader.add(texture));
                mesh
            }
        };
        self.materials.push(material);
        Ok((mesh, self.materials.len() - 1))
    }

    /// Returns the index of a converted material. The first call for a material converts it. `material` is its index in
    /// the document; `None` is the default material. Without texture coordinates, the converted material has no
    /// textures.
    ///
    /// # Errors
    /// `Invalid` with the material and the field.
    pub(super) fn material_index(
        &mut self,
        material: Option<usize>,
        has_uvs: bool,
        remarks: &mut ImportRemarks,
    ) -> Result<usize> {
        if let Some(index) = self.material_indices.get(&(material, has_uvs)) {
            return Ok(*index);
        }
        let phong_material = match material {
            None => Material::default(),
            Some(index) => {
                let source = get_element(&self.document.materials, index, "material")?;
                let converted_material = self.convert_to_phong(source, index, has_uvs, remarks);
                converted_material.map_err(|error| error.prefix_field(&format!("materials[{index}]")))?
            }
        };
        self.materials.push(phong_material);
        self.material_indices.insert((material, has_uvs), self.materials.len() - 1);
        Ok(self.materials.len() - 1)
    }

    /// Whether a primitive has had a material of the document, not the default one.
    pub(super) fn has_materials(&self) -> bool {
        self.material_indices.keys().any(|(material, _)| material.is_some())
    }

    fn convert_to_phong(
        &mut self,
        source: &document::Material,
        index: usize,
        has_uvs: bool,
        remarks: &mut ImportRemarks,
    ) -> Result<Material> {
        let name = source.name.as_deref().filter(|name| !name.is_empty());
        let name = name.map_or_else(|| format!("material {index}"), |name| sanitize(name, 120));
        let pbr = &source.pbr_metallic_roughness;
        let mut factor = |field: &str, value: f32| {
            let subject = format!("material '{name}': {field}");
            remarks.corrections.in_range(&subject, value, [0.0, 1.0], "1 is used").unwrap_or(1.0)
        };
        let [red, green, blue, alpha] = pbr.base_color_factor.map(|value| factor("baseColorFactor", value));
        let (metalness, roughness) =
            (factor("metallicFactor", pbr.metallic_factor), factor("roughnessFactor", pbr.roughness_factor));
        let cutoff = source.alpha_cutoff.map_or(DEFAULT_ALPHA_CUTOFF, |cutoff| factor("alphaCutoff", cutoff));
        let color_texture = self.load_base_color(pbr, &name, has_uvs, remarks)?;
        let normal_texture = self.load_normal_map(source, &name, has_uvs, remarks)?;
        let [metalness_mean, roughness_mean] = self.mean_metalness_and_roughness(pbr, &name, remarks)?;
        let (metalness, roughness) = (metalness * metalness_mean, roughness * roughness_mean);
        if source.occlusion_texture.is_some() {
            remarks.add(format!("material '{name}': the occlusion texture is ignored"));
        }
        if source.emissive_texture.is_some() || source.emissive_factor.is_some_and(|color| color != [0.0; 3]) {
            remarks.add(format!("material '{name}': emission is ignored"));
        }
        let base_color = [red, green, blue];
        // alpha^2 of the GGX distribution; the minimum prevents a division by 0.
        let alpha2 = roughness.powi(4).max(1e-8);
        Material {
            ambient: base_color,
            diffuse: base_color.map(|channel| channel * (1.0 - 0.5 * metalness)),
            specular: base_color
                .map(|channel| ((0.04 * (1.0 - metalness) + channel * metalness) / (4.0 * alpha2)).min(1.0)),
            shininess: ((2.0 / alpha2 - 2.0) / 4.0).clamp(1.0, 1e4),
            alpha,
            color_texture,
            normal_texture,
            alpha_mode: convert_alpha_mode(source, cutoff, &name, remarks),
            double_sided: source.double_sided,
            name,
        }
        .validated()
    }

    fn load_base_color(
        &mut self,
        pbr: &document::PbrMetallicRoughness,
        name: &str,
        has_uvs: bool,
        remarks: &mut ImportRemarks,
    ) -> Result<Option<usize>> {
        let Some(texture) = &pbr.base_color_texture else { return Ok(None) };
        if !has_uvs {
            let uv_set = texture.uv_set();
            remarks
                .add(format!("material '{name}': the color texture is ignored: a primitive lacks TEXCOORD_{uv_set}"));
            return Ok(None);
        }
        let with_field = prefix_with("pbrMetallicRoughness.baseColorTexture");
        let stand_in = "the color factor is drawn";
        if self.texture_loader.is_unusable(texture, stand_in, remarks).map_err(&with_field)? {
            return Ok(None);
        }
        self.texture_loader.texture_index(texture, remarks).map(Some).map_err(with_field)
    }

    fn load_normal_map(
        &mut self,
        source: &document::Material,
        name: &str,
        has_uvs: bool,
        remarks: &mut ImportRemarks,
    ) -> Result<Option<usize>> {
        let Some(texture) = &source.normal_texture else { return Ok(None) };
        let base_color_texture = source.pbr_metallic_roughness.base_color_texture.as_ref();
        let has_other_uv_set = base_color_texture.is_some_and(|base_color| base_color.uv_set() != texture.uv_set());
        if has_other_uv_set || !has_uvs {
            let reason = if has_other_uv_set { "the color texture does not use" } else { "a primitive lacks" };
            let uv_set = texture.uv_set();
            remarks.add(format!("material '{name}': the normal map is ignored: {reason} TEXCOORD_{uv_set}"));
            return Ok(None);
        }
        if base_color_texture.is_some_and(|base_color| base_color.transform() != texture.transform()) {
            remarks.add(format!("material '{name}': the normal map has the texture transform of the color texture"));
        }
        if let Some(scale) = texture.scale.filter(|scale| *scale != 1.0) {
            remarks.add(format!("material '{name}': the normal map's scale of {scale} is ignored"));
        }
        let stand_in = "the normals of the mesh are used";
        if self.texture_loader.is_unusable(texture, stand_in, remarks).map_err(prefix_with("normalTexture"))? {
            return Ok(None);
        }
        self.texture_loader.texture_index(texture, remarks).map(Some).map_err(prefix_with("normalTexture"))
    }

    /// Means of the factors of metalness and roughness in the texture, 0 to 1. The texture contains metalness in blue and roughness in green.
    fn mean_metalness_and_roughness(
        &mut self,
        pbr: &document::PbrMetallicRoughness,
        name: &str,
        remarks: &mut ImportRemarks,
    ) -> Result<[f32; 2]> {
        let Some(texture) = &pbr.metallic_roughness_texture else { return Ok([1.0; 2]) };
        let with_field = prefix_with("pbrMetallicRoughness.metallicRoughnessTexture");
        let stand_in = "the metallic and roughness factors are used";
        if self.texture_loader.is_unusable(texture, stand_in, remarks).map_err(&with_field)? {
            return Ok([1.0; 2]);
        }
        let channel_means = self.texture_loader.channel_means(texture, remarks).map_err(with_field)?;
        remarks.add(format!("material '{name}': only the mean of the metallic-roughness texture is used"));
        let [_, green, blue, _] = channel_means;
        Ok([blue, green])
    }
}

fn prefix_with(field: &str) -> impl Fn(crate::error::Error) -> crate::error::Error {
    move |error| error.prefix_field(field)
}

fn convert_alpha_mode(source: &document::Material, cutoff: f32, name: &str, remarks: &mut ImportRemarks) -> AlphaMode {
    match source.alpha_mode.as_deref() {
        None | Some("OPAQUE") => AlphaMode::Opaque,
        Some("BLEND") => AlphaMode::Blend,
        Some("MASK") => AlphaMode::Mask { cutoff },
        Some(other) => {
            let subject = format!("material '{name}': alphaMode");
            let value = || CorrectedValue::new("", "OPAQUE, MASK or BLEND", sanitize(other, 40));
            remarks.corrections.add(&subject, "OPAQUE is used", value);
            AlphaMode::Opaque
        }
    }
}
