//! A scene: an immutable set of domains that one simulation drives, and the state that its steps change.
//!
//! All domains share packed buffers. [`Layout`] stores where the vertices, corners, triangles and coordinates of each
//! domain begin; every deformer and the renderer use it.

mod camera;
mod deformation;
mod features;
mod floating_origin;
mod frame_size;
mod layout;
mod light_space;
mod pixel_rect;
mod post_processing;
mod raster_input;
mod render_settings;
mod shadow;
mod state;
mod step_update;
mod transform_format;
mod transform_roots;

pub use camera::{BoundingBox, Camera, Lens, View};
pub use deformation::{DeformationSettings, NormalMethod, StorageType};
pub use features::SceneFeatures;
pub use floating_origin::{FloatingOrigins, ORIGIN_GRID, ORIGIN_REACH, snap_to_origin_grid};
pub use frame_size::FrameSize;
pub use layout::{DomainLayout, Layout};
pub use light_space::{OrientedBounds, light_axes};
pub use pixel_rect::PixelRect;
pub use post_processing::{Antialiasing, Bloom, ToneMapping};
pub use raster_input::{CullMode, DrawRange, MAX_VIEWPORT_SIDE, Viewport};
pub use render_settings::{Culling, Ground, MAX_FRAGMENTS, RenderSettings, Transparency, UpAxis};
pub use shadow::{MomentFormat, ShadowFit, ShadowMethod, ShadowSettings};
pub use state::{DirtyDomains, SceneState};
pub use step_update::{RawStepUpdate, StepUpdate};
pub use transform_format::TransformFormat;
pub use transform_roots::TransformRoots;

use std::collections::BTreeMap;
use std::sync::Arc;

use crate::domain::{AlphaMode, Domain, MAX_RING_TRIANGLES, Material, Shape, Texture};
use crate::error::{Result, invalid};

/// The largest number of domains in a scene.
pub const MAX_DOMAINS: usize = 1 << 20;

/// The most bytes of a domain's name, and of all its notes together. The limits keep the description of a domain within
/// one message.
const MAX_NAME_BYTES: usize = 4 << 10;
const MAX_NOTES_BYTES: usize = 64 << 10;

/// The largest number of parent vertices that define an attachment frame.
const MAX_ATTACHMENT_ROWS: usize = 4096;

/// The input of [`Scene::new`], as a loader produces it.
#[derive(Debug, Clone, Default)]
pub struct SceneParts {
    pub name: String,
    pub shapes: Vec<Shape>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub domains: Vec<Domain>,
    pub up: UpAxis,
    /// Meters per scene unit.
    pub unit: f64,
    /// World position, in meters, of the frame in which all transforms are given.
    pub origin: [f64; 3],
    pub look: RenderSettings,
    pub deformation: DeformationSettings,
    /// Declares that no step will shear or non-uniformly scale a domain; a step that does is rejected.
    pub rigid_transforms: bool,
    /// Warnings of the loader about input that it could not use, for `inspect` and the log.
    pub remarks: Vec<String>,
}

/// A validated scene. Immutable, and shared through `Arc`.
#[derive(Debug)]
pub struct Scene {
    pub name: String,
    pub shapes: Vec<Shape>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub domains: Vec<Domain>,
    pub up: UpAxis,
    pub unit: f64,
    pub origin: [f64; 3],
    pub look: RenderSettings,
    pub deformation: DeformationSettings,
    pub rigid_transforms: bool,
    pub remarks: Vec<String>,
    pub layout: Layout,
    pub transform_roots: TransformRoots,
    /// The optional features that the scene uses.
    pub features: SceneFeatures,
    /// Bounds of the rest state in scene units.
    pub rest_bounds: BoundingBox,
}

impl Scene {
    /// The parts of which this scene was built, for building a modified scene.
    pub fn parts(&self) -> SceneParts {
        SceneParts {
            name: self.name.clone(),
            shapes: self.shapes.clone(),
            materials: self.materials.clone(),
            textures: self.textures.clone(),
            domains: self.domains.clone(),
            up: self.up,
            unit: self.unit,
            origin: self.origin,
            look: self.look,
            deformation: self.deformation,
            rigid_transforms: self.rigid_transforms,
            remarks: self.remarks.clone(),
        }
    }

    /// Validates all references between the parts, and computes the layout, feature flags, tangents and rest bounds.
    ///
    /// # Errors
    /// `Invalid` with the domain and the field.
    pub fn new(mut parts: SceneParts) -> Result<Arc<Self>> {
        if parts.domains.is_empty() || parts.domains.len() > MAX_DOMAINS {
            return Err(invalid("scene.domains", format!("1 to {MAX_DOMAINS}"), parts.domains.len()));
        }
        if !(parts.unit.is_finite() && parts.unit > 0.0) {
            return Err(invalid("scene.unit", "a positive number of metres", parts.unit));
        }
        if !parts.origin.iter().all(|number| number.is_finite()) {
            return Err(invalid("scene.origin", "finite numbers", format!("{:?}", parts.origin)));
        }
        parts.materials = parts.materials.into_iter().map(Material::validated).collect::<Result<_>>()?;
        check_textures(&parts)?;
        for index in 0..parts.domains.len() {
            check_domain(&parts, index).map_err(|error| error.prefix_field(&format!("domain {index}")))?;
        }
        let transform_roots = TransformRoots::new(&mut parts.domains)?;
        parts.look.check()?;
        parts.deformation.check()?;
        drop_textures_without_uvs(&mut parts);
        add_tangents(&mut parts);
        let layout = Layout::new(&parts.shapes, &parts.domains)?;
        let features = SceneFeatures::from_parts(&parts);
        if features.exact_normals {
            add_smoothing(&mut parts)?;
        }
        let mut scene = Self {
            name: parts.name,
            shapes: parts.shapes,
            materials: parts.materials,
            textures: parts.textures,
            domains: parts.domains,
            up: parts.up,
            unit: parts.unit,
            origin: parts.origin,
            look: parts.look,
            deformation: parts.deformation,
            rigid_transforms: parts.rigid_transforms,
            remarks: parts.remarks,
            layout,
            transform_roots,
            features,
            rest_bounds: BoundingBox::EMPTY,
        };
        scene.rest_bounds = scene.bounds_at_rest();
        Ok(Arc::new(scene))
    }

    /// The packed vertex indices of each triangle, in layout order.
    pub fn triangle_vertices(&self) -> Vec<[u32; 3]> {
        let of_domain = |domain: usize| {
            let (mesh, first) = (&self.shape_of(domain).mesh, self.layout.domains[domain].first_vertex as u32);
            let vertices = &mesh.corners().vertices;
            mesh.triangles().iter().map(move |corners| corners.map(|corner| first + vertices[corner as usize]))
        };
        (0..self.domains.len()).flat_map(of_domain).collect()
    }

    /// The shape of a domain.
    pub fn shape_of(&self, domain: usize) -> &Shape {
        &self.shapes[self.domains[domain].shape]
    }

    /// The number of modes of a domain.
    pub fn rank_of(&self, domain: usize) -> usize {
        self.shape_of(domain).modes.rank()
    }

    /// The index of the domain with this name.
    pub fn find(&self, name: &str) -> Option<usize> {
        self.domains.iter().position(|domain| domain.name == name)
    }

    fn bounds_at_rest(&self) -> BoundingBox {
        let mut bounds = BoundingBox::EMPTY;
        for domain in &self.domains {
            let place = domain.placement.to_matrix();
            for position in self.shapes[domain.shape].mesh.rest_positions() {
                let world = place.transform_point(&nalgebra::Point3::from(*position).cast());
                bounds.include(world.coords.into());
            }
        }
        bounds
    }
}

fn check_textures(parts: &SceneParts) -> Result<()> {
    for material in &parts.materials {
        for texture in [material.color_texture, material.normal_texture].into_iter().flatten() {
            if texture >= parts.textures.len() {
                let field = format!("material '{}': texture", material.name);
                return Err(invalid(field, format!("an index below {}", parts.textures.len()), texture));
            }
        }
    }
    Ok(())
}

fn check_domain(parts: &SceneParts, index: usize) -> Result<()> {
    let domain = &parts.domains[index];
    let below = |field: &str, given: usize, limit: usize| match given < limit {
        true => Ok(()),
        false => Err(invalid(field, format!("an index below {limit}"), given)),
    };
    below("shape", domain.shape, parts.shapes.len())?;
    below("material", domain.material, parts.materials.len())?;
    check_runs(parts, domain)?;
    check_texts(domain)?;
    if let Some(follow) = &domain.follows {
        below("follows.parent", follow.parent, index)?;
        crate::domain::Transform::new(follow.frame.0).map_err(|error| error.prefix_field("follows.frame"))?;
    }
    let rank = parts.shapes[domain.shape].modes.rank();
    crate::domain::Transform::new(domain.placement.0).map_err(|error| error.prefix_field("placement"))?;
    if !domain.rest_q.is_empty() && domain.rest_q.len() != rank {
        return Err(invalid("rest_q", format!("none or {rank} coordinates"), domain.rest_q.len()));
    }
    if !domain.rest_q.iter().all(|number| number.is_finite()) {
        return Err(invalid("rest_q", "finite numbers", format!("{:?}", domain.rest_q)));
    }
    if let Some(twin) = domain.shares_q_with {
        below("shares_q_with", twin, index)?;
        let theirs = parts.shapes[parts.domains[twin].shape].modes.rank();
        if theirs != rank {
            return Err(invalid("shares_q_with", format!("a domain of rank {rank}"), theirs));
        }
    }
    if let Some(attachment) = &domain.attachment {
        // A parent must precede its children: the hierarchy then has no cycle, and one pass in order composes it.
        below("parent", attachment.parent, index)?;
        let vertices = parts.shapes[parts.domains[attachment.parent].shape].mesh.rest_positions().len();
        if attachment.rows.len() > MAX_ATTACHMENT_ROWS {
            let expected = format!("at most {MAX_ATTACHMENT_ROWS} vertices");
            return Err(invalid("attachment.rows", expected, attachment.rows.len()));
        }
        for row in &attachment.rows {
            below("attachment.rows", *row as usize, vertices)?;
        }
    }
    Ok(())
}

fn check_texts(domain: &Domain) -> Result<()> {
    if domain.name.len() > MAX_NAME_BYTES {
        return Err(invalid("name", format!("at most {MAX_NAME_BYTES} bytes"), domain.name.len()));
    }
    let bytes: usize = domain.metadata.notes.iter().map(|(name, text)| name.len() + text.len()).sum();
    if bytes > MAX_NOTES_BYTES {
        return Err(invalid("notes", format!("at most {MAX_NOTES_BYTES} bytes in all"), bytes));
    }
    Ok(())
}

fn check_runs(parts: &SceneParts, domain: &Domain) -> Result<()> {
    let triangles = parts.shapes[domain.shape].mesh.triangles().len();
    for (index, run) in domain.material_ranges.iter().enumerate() {
        let before = index.checked_sub(1).map(|before| domain.material_ranges[before].first_triangle);
        let in_order = before.map_or(run.first_triangle == 0, |before| run.first_triangle > before);
        if !in_order || run.first_triangle >= triangles {
            let expected = format!("0 for the first, then ascending, below {triangles}");
            return Err(invalid(format!("runs[{index}].first_triangle"), expected, run.first_triangle));
        }
        if run.material >= parts.materials.len() {
            let expected = format!("an index below {}", parts.materials.len());
            return Err(invalid(format!("runs[{index}].material"), expected, run.material));
        }
    }
    Ok(())
}

/// Removes textures from shapes without texture coordinates, where they would show one texel everywhere. Affected
/// domains get an untextured copy of their material, and a remark is recorded.
fn drop_textures_without_uvs(parts: &mut SceneParts) {
    let mut copies: BTreeMap<usize, usize> = BTreeMap::new();
    let SceneParts { shapes, materials, domains, remarks, .. } = parts;
    for domain in domains.iter_mut().filter(|domain| shapes[domain.shape].mesh.corners().uvs.is_empty()) {
        let material_ranges = domain.material_ranges.iter_mut().map(|run| &mut run.material);
        for material in std::iter::once(&mut domain.material).chain(material_ranges) {
            let textured = &materials[*material];
            if textured.color_texture.is_none() && textured.normal_texture.is_none() {
                continue;
            }
            let textured = textured.clone();
            *material = *copies.entry(*material).or_insert_with(|| {
                let name = &textured.name;
                remarks.push(format!("textures of material '{name}' left out where there are no texture coordinates"));
                let alpha_mode = match textured.alpha_mode {
                    AlphaMode::Mask { cutoff } if textured.alpha >= cutoff => AlphaMode::Opaque,
                    kept => kept,
                };
                let plain = Material { color_texture: None, normal_texture: None, alpha_mode, ..textured };
                materials.push(plain);
                materials.len() - 1
            });
        }
    }
}

/// Computes tangents of shapes that are used with a normal map.
fn add_tangents(parts: &mut SceneParts) {
    for domain in &parts.domains {
        let shape = &mut parts.shapes[domain.shape];
        let mapped = domain.materials().any(|material| parts.materials[material].normal_texture.is_some());
        if mapped && !shape.mesh.corners().uvs.is_empty() {
            shape.add_tangents();
        }
    }
}

/// Computes smoothing groups of shapes with modes. Normals of rigid shapes only rotate with their domain.
fn add_smoothing(parts: &mut SceneParts) -> Result<()> {
    let mut triangles = 0;
    for domain in &parts.domains {
        let shape = &mut parts.shapes[domain.shape];
        if shape.modes.rank() > 0 && shape.smoothing().is_none() {
            triangles += shape.mesh.triangles().len();
            if triangles > MAX_RING_TRIANGLES {
                let expected = format!("at most {MAX_RING_TRIANGLES} triangles of shapes with modes");
                return Err(invalid("deform.normals", expected, triangles));
            }
            shape.add_smoothing();
        }
    }
    Ok(())
}

impl SceneParts {
    /// Empty parts with default conventions: meters, origin at zero, default look.
    pub fn named(name: impl Into<String>) -> Self {
        Self { name: name.into(), unit: 1.0, ..Self::default() }
    }

    /// Whether `has` holds for a material of any domain.
    pub(crate) fn any_material(&self, has: impl Fn(&Material) -> bool) -> bool {
        self.domains.iter().flat_map(Domain::materials).any(|material| has(&self.materials[material]))
    }

    pub(crate) fn any_mask(&self) -> bool {
        self.any_material(|material| matches!(material.alpha_mode, AlphaMode::Mask { .. }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Attachment, MaterialRange, Mesh, Modes, Transform};

    /// One domain of two triangles, with an opaque and a blended material.
    fn square(material_ranges: Vec<MaterialRange>) -> SceneParts {
        let rest = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        let mesh =
            Mesh::from_indexed(rest, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]]).expect("a square");
        let domain = Domain {
            name: "square".into(),
            shape: 0,
            material: 0,
            material_ranges,
            placement: Transform::IDENTITY,
            attachment: None,
            follows: None,
            rest_q: vec![],
            shares_q_with: None,
            metadata: crate::domain::Metadata::default(),
        };
        let mut parts = SceneParts::named("square");
        parts.shapes.push(Shape::new(mesh, Modes::rigid()).expect("rigid"));
        parts.materials = vec![Material::default(), Material { alpha_mode: AlphaMode::Blend, ..Material::default() }];
        parts.domains.push(domain);
        parts
    }

    #[test]
    fn a_texture_that_has_no_place_is_left_out_with_a_remark_and_one_that_has_stays() {
        let textured = || {
            let mut parts = square(vec![]);
            parts.textures = vec![Texture::new("leaf", 1, 1, vec![0; 4]).expect("a texture")];
            parts.materials[0].color_texture = Some(0);
            parts.materials[0].alpha_mode = AlphaMode::Mask { cutoff: 0.5 };
            parts
        };
        let scene = Scene::new(textured()).expect("a scene");
        let shown = &scene.materials[scene.domains[0].material];
        assert_eq!((shown.color_texture, shown.alpha_mode), (None, AlphaMode::Opaque));
        assert!(!scene.features.textures && !scene.features.mask);
        assert!(scene.remarks[0].contains("no texture coordinates"), "{:?}", scene.remarks);
        let mut placed = textured();
        let mesh = &placed.shapes[0].mesh;
        let corners = mesh.corners().clone();
        let uvs = vec![[0.0, 0.0]; 4];
        let mesh = Mesh::from_indexed(mesh.rest_positions().to_vec(), corners.normals, uvs, mesh.triangles().to_vec());
        placed.shapes[0] = Shape::new(mesh.expect("a square"), Modes::rigid()).expect("rigid");
        let scene = Scene::new(placed).expect("a scene");
        assert!(scene.features.textures && scene.features.mask && scene.remarks.is_empty());
    }

    fn run(first_triangle: usize, material: usize) -> MaterialRange {
        MaterialRange { first_triangle, material }
    }

    #[test]
    fn a_material_of_any_run_counts_for_what_the_scene_needs() {
        assert!(Scene::new(square(vec![run(0, 0), run(1, 1)])).expect("good").features.blend);
        assert!(!Scene::new(square(vec![])).expect("good").features.blend, "the second material is unused");
    }

    #[test]
    fn names_notes_and_attachments_that_no_description_could_carry_are_refused_by_name() {
        let with = |name: usize, note: usize, rows: usize| {
            let mut parts = square(vec![]);
            let mut second = parts.domains[0].clone();
            second.name = "x".repeat(name);
            second.metadata.notes = [("a".into(), "x".repeat(note - 3)), ("b".into(), "y".into())].into();
            second.attachment = Some(Attachment { parent: 0, frame: Transform::IDENTITY, rows: vec![3; rows] });
            parts.domains.push(second);
            Scene::new(parts).map(drop).map_err(|error| error.to_string())
        };
        assert_eq!(with(4096, 65536, 4096), Ok(()));
        let refusal = |field, most, given| Err(format!("domain 1: {field}: expected at most {most}, got {given}"));
        assert_eq!(with(4097, 65536, 4096), refusal("name", "4096 bytes", 4097));
        assert_eq!(with(4096, 65537, 4096), refusal("notes", "65536 bytes in all", 65537));
        assert_eq!(with(4096, 65536, 4097), refusal("attachment.rows", "4096 vertices", 4097));
    }

    #[test]
    fn runs_out_of_order_or_out_of_range_are_refused_by_name() {
        for (material_ranges, field) in [
            (vec![run(1, 0)], "domain 0: runs[0].first_triangle"),
            (vec![run(0, 0), run(0, 1)], "domain 0: runs[1].first_triangle"),
            (vec![run(0, 0), run(2, 1)], "domain 0: runs[1].first_triangle"),
            (vec![run(0, 2)], "domain 0: runs[0].material"),
        ] {
            let refusal = Scene::new(square(material_ranges)).expect_err(field).to_string();
            assert!(refusal.starts_with(field), "{refusal}");
        }
    }
}
