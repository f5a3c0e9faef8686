//! Static data and cameras of batches of small views, which `modalcast-compute` draws: the same triangles, materials,
//! light and matrices as those of a single frame.

use modalcast_model::domain::Material;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{CullMode, DrawRange, Scene};
use modalcast_model::views::{ViewCamera, ViewImage, ViewLight, ViewMaterial, ViewScene, tone_code};

use crate::resources::raster_mesh::cut_outs;
use crate::scene_data::geometry::{BlendMode, Geometry, blend_mode, locate_triangle, used_materials};
use crate::scene_data::textures::{TextureRole, cutoff, mip_levels};
use crate::types::FrameParams;
use crate::uniforms::frame::FrameUniforms;

/// Maximum anisotropy of texture lookups, as that of frames on hardware (`device/gl/limits.rs`).
const ANISOTROPY: f32 = 8.0;

/// The static data of the views of a scene. Shadows, ambient occlusion and anti-aliasing of the look are off.
///
/// # Errors
/// `Invalid` with the field if a material is blended, or if the look has a bloom or lines along mesh edges, which views
/// do not have.
pub fn view_scene(scene: &Scene) -> Result<ViewScene> {
    check_features(scene)?;
    let geometry = Geometry::new(scene);
    let mut images = ImageList { scene, textures: Vec::new() };
    let materials = used_materials(scene).into_iter().map(|index| images.material(&scene.materials[index])).collect();
    let triangles = geometry.triangle_vertices.len();
    let domain_of = |triangle| locate_triangle(&geometry.spans, triangle).map_or(0, |(domain, _)| domain as u32);
    let groups = geometry.groups.iter().map(|group| DrawRange {
        first_triangle: group.first_triangle as u32,
        triangle_count: group.triangle_count as u32,
        cull_mode: if group.double_sided { CullMode::None } else { CullMode::Back },
    });
    Ok(ViewScene {
        vertices: scene.layout.vertices,
        corners: scene.layout.corners,
        domains: scene.domains.len(),
        triangle_materials: match geometry.triangle_materials.is_empty() {
            true => vec![0; triangles],
            false => geometry.triangle_materials.clone(),
        },
        triangle_domains: (0..triangles).map(domain_of).collect(),
        groups: groups.collect(),
        materials,
        images: images.into_images(),
        uvs: geometry.uvs.clone(),
        cut_outs: cut_outs(scene, &geometry, ANISOTROPY),
        anisotropy: ANISOTROPY,
        light: view_light(scene),
        triangle_vertices: geometry.triangle_vertices,
        triangle_corners: geometry.triangle_corners,
    })
}

/// The camera of a view, and the ground as a single frame with these parameters has it. `origin`: that of the positions,
/// in scene units from the scene's origin.
///
/// # Errors
/// `Invalid` if the camera's matrices overflow.
pub fn view_camera(scene: &Scene, params: &FrameParams, origin: [f64; 3]) -> Result<ViewCamera> {
    Ok(FrameUniforms::new(scene, &scene.look, params, origin)?.view_camera())
}

fn check_features(scene: &Scene) -> Result<()> {
    let is_blended = |material: &&Material| blend_mode(material) == BlendMode::Blend;
    let materials = used_materials(scene).into_iter().map(|index| &scene.materials[index]);
    if let Some(material) = materials.into_iter().find(is_blended) {
        let field = format!("materials['{}'].alpha_mode", material.name);
        return Err(invalid(field, "opaque or masked materials in views", "blend"));
    }
    if scene.look.bloom.is_some() {
        return Err(invalid("look.bloom", "no bloom in views", "a bloom"));
    }
    if scene.look.edges.is_some() {
        return Err(invalid("look.edges", "no lines along mesh edges in views", "lines"));
    }
    Ok(())
}

fn view_light(scene: &Scene) -> ViewLight {
    let look = &scene.look;
    let studio = look.studio_light(scene.up);
    let to_f32 = |vector: nalgebra::Vector3<f64>| vector.cast::<f32>().into();
    ViewLight {
        to_sun: to_f32(look.to_sun(scene.up)),
        sunlight: look.sunlight,
        ambient_cube: studio.map_or([look.skylight; 6], |light| light.ambient_cube),
        fill: studio.map_or([0.0; 3], |light| light.fill),
        zenith: look.zenith,
        horizon: look.horizon,
        up: to_f32(scene.up.vector()),
        ground: look.ground_color(scene.up).unwrap_or_default(),
        exposure: look.exposure,
        tone: tone_code(look.tone),
        dithers: u32::from(look.dither),
    }
}

/// The images of the materials, each a texture of the scene in a role.
struct ImageList<'a> {
    scene: &'a Scene,
    textures: Vec<(usize, TextureRole)>,
}

impl ImageList<'_> {
    fn material(&mut self, material: &Material) -> ViewMaterial {
        let features = &self.scene.features;
        let color_texture = material.color_texture.filter(|_| features.textures);
        let normal_texture = material.normal_texture.filter(|_| features.normal_maps);
        ViewMaterial {
            ambient: material.ambient,
            diffuse: material.diffuse,
            specular: material.specular,
            exponent: material.shininess,
            color_image: color_texture.map(|texture| self.index_of(texture, TextureRole::Color)),
            normal_image: normal_texture.map(|texture| self.index_of(texture, TextureRole::Normal)),
        }
    }

    /// The index of an image, which is added if it is not in the list.
    fn index_of(&mut self, texture: usize, role: TextureRole) -> u32 {
        let position = self.textures.iter().position(|image| *image == (texture, role));
        position.unwrap_or_else(|| {
            self.textures.push((texture, role));
            self.textures.len() - 1
        }) as u32
    }

    fn into_images(self) -> Vec<ViewImage> {
        let image = |(texture, role): (usize, TextureRole)| {
            let cutoff = if role == TextureRole::Color { cutoff(self.scene, texture) } else { None };
            let source = &self.scene.textures[texture];
            ViewImage {
                width: source.width(),
                height: source.height(),
                is_srgb: role == TextureRole::Color,
                levels: mip_levels(source, role, cutoff),
            }
        };
        self.textures.into_iter().map(image).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::tests::squares;
    use modalcast_model::domain::AlphaMode;
    use modalcast_model::scene::{Bloom, MeshEdges, SceneParts};

    #[test]
    fn view_scenes_have_the_domains_and_images_of_their_triangles() {
        let material = |color_texture, alpha_mode| Material { color_texture, alpha_mode, ..Material::default() };
        let mut parts = squares(vec![
            material(Some(0), AlphaMode::Mask { cutoff: 0.5 }),
            material(None, AlphaMode::Opaque),
            material(Some(0), AlphaMode::Opaque),
        ]);
        let texture = modalcast_model::domain::Texture::new("one", 2, 1, vec![200; 8]).expect("a valid texture");
        parts.textures = vec![texture];
        let scene = Scene::new(parts).expect("a valid scene");
        let view_scene = view_scene(&scene).expect("a scene without blending");
        view_scene.check().expect("a consistent scene");
        // Opaque triangles come first: those of the squares 1 and 2, then those of square 0.
        assert_eq!(view_scene.triangle_domains, [1, 1, 2, 2, 0, 0]);
        assert_eq!(view_scene.cut_outs.as_ref().map(|cut_outs| cut_outs.first), Some(4));
        assert_eq!(view_scene.images.len(), 1, "expected two materials to share an image");
        assert_eq!(view_scene.images[0].levels.len(), 2);
    }

    #[test]
    fn features_that_views_lack_are_refused_by_name() {
        let refusal = |change: fn(&mut SceneParts)| {
            let mut parts = squares(vec![Material { name: "glass".into(), ..Material::default() }]);
            change(&mut parts);
            view_scene(&Scene::new(parts).expect("a valid scene")).err().map(|error| error.to_string())
        };
        assert_eq!(refusal(|_| ()), None);
        for (change, field) in [
            ((|parts| parts.materials[0].alpha_mode = AlphaMode::Blend) as fn(&mut SceneParts), "materials['glass']"),
            (|parts| parts.look.bloom = Some(Bloom::default()), "look.bloom"),
            (|parts| parts.look.edges = Some(MeshEdges::default()), "look.edges"),
        ] {
            let message = refusal(change).expect("a refusal");
            assert!(message.starts_with(field), "expected {field}, got {message}");
        }
    }
}
