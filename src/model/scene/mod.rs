//! A scene: an immutable set of domains that one simulation drives. [`SceneState`] is the part that steps change.
//!
//! The data of all domains is packed into shared buffers. [`Layout`] stores where the vertices, corners, triangles and
//! coordinates of each domain begin.

mod ambient_occlusion;
mod camera;
mod deformation;
mod drawn_bounds;
mod far_domains;
mod features;
mod floating_origin;
mod frame_size;
mod frame_style;
mod framing;
mod layout;
mod length_unit;
mod light_space;
mod lighting;
mod look_preset;
mod mesh_edges;
mod pixel_rect;
mod post_processing;
mod raster_input;
mod render_settings;
mod shadow;
mod state;
mod state_pool;
mod step_update;
mod transform_format;
mod transform_roots;
mod worlds;

pub use ambient_occlusion::AmbientOcclusion;
pub use camera::{BoundingBox, Camera, Lens, View};
pub use deformation::{DeformationSettings, NormalMethod, StorageType};
pub use drawn_bounds::{DrawnBounds, FrameBounds};
pub use features::SceneFeatures;
pub use floating_origin::{FloatingOrigins, HOME_REACH, OriginGrids, SHARED_REACH};
pub use frame_size::FrameSize;
pub use frame_style::FrameStyle;
pub use framing::{CameraSource, Framing};
pub use layout::{DomainLayout, Layout};
pub use length_unit::LengthUnit;
pub use light_space::{OrientedBounds, light_axes};
pub use lighting::{Lighting, StudioLight};
pub use look_preset::{FrameAntialiasing, LookOverrides, LookPreset, PresetRequest, RendererKind};
pub use mesh_edges::MeshEdges;
pub use pixel_rect::PixelRect;
pub use post_processing::{Antialiasing, Bloom, ToneMapping};
pub use raster_input::{CullMode, DrawRange, MAX_VIEWPORT_SIDE, Viewport};
pub use render_settings::{Culling, Ground, MAX_FRAGMENTS, RenderSettings, Transparency, UpAxis};
pub use shadow::{MomentFormat, ShadowFit, ShadowMethod, ShadowSettings};
pub use state::{DirtyDomains, SceneState};
pub use state_pool::StatePool;
pub use step_update::{RawStepUpdate, StepUpdate};
pub use transform_format::TransformFormat;
pub use transform_roots::TransformRoots;

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

use crate::domain::{AlphaMode, Domain, MAX_RING_TRIANGLES, Material, Shape, Texture};
use crate::error::{Result, invalid};
use crate::escaping::escape_controls;

/// The smallest plausible value of the largest eigenvalue of a domain in (rad/s)^2: a period of 55 hours.
const MIN_LARGEST_EIGENVALUE: f64 = 1e-9;

/// Largest magnitude of a negative eigenvalue that counts as a rounding error, as a fraction of the largest magnitude
/// of its domain. Solvers return the eigenvalues of rigid motions as numbers near 0 of either sign.
const EIGENVALUE_ROUNDING: f64 = 1e-9;

/// The largest number of domains in a scene.
pub const MAX_DOMAINS: usize = 1 << 20;

/// The largest size of the name of a domain, a material or a texture. With [`MAX_NOTES_BYTES`],
/// [`MAX_MATERIAL_RANGES`] and [`MAX_ATTACHMENT_VERTICES`], it keeps each description within one gRPC message.
const MAX_NAME_BYTES: usize = 4 << 10;

/// The largest number of remarks, and of characters of each.
const MAX_REMARKS: usize = 256;
const MAX_REMARK_CHARACTERS: usize = 1000;

/// The largest number of material ranges of a domain.
const MAX_MATERIAL_RANGES: usize = 65_536;

/// The largest size of all notes of a domain together, names included.
const MAX_NOTES_BYTES: usize = 64 << 10;

/// The largest number of parent vertices that define an attachment frame.
const MAX_ATTACHMENT_VERTICES: usize = 4096;

/// The input of [`Scene::new`], as a loader produces it.
#[derive(Debug, Clone, Default)]
pub struct SceneParts {
    pub name: String,
    pub shapes: Vec<Shape>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub domains: Vec<Domain>,
    pub up: UpAxis,
    /// Meters per scene unit. `None`: the files do not say, and a unit is taken as a meter.
    pub unit: Option<f64>,
    /// World position of the scene's origin in meters. Transforms are relative to the scene's origin.
    pub origin: [f64; 3],
    /// Lights, shadow, ground, sky and rasterization: the table `look` of a scene file.
    pub look: RenderSettings,
    pub deformation: DeformationSettings,
    /// Declares that no step will shear or non-uniformly scale a domain; a step that does is rejected.
    pub rigid_transforms: bool,
    /// Warnings about input that could not be used, for clients, the command `inspect` and the log.
    pub remarks: Vec<String>,
}

/// A validated, immutable scene. Fields without a comment are those of [`SceneParts`].
#[derive(Debug)]
pub struct Scene {
    pub name: String,
    pub shapes: Vec<Shape>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub domains: Vec<Domain>,
    pub up: UpAxis,
    /// Meters per scene unit.
    pub unit: f64,
    pub origin: [f64; 3],
    pub look: RenderSettings,
    pub deformation: DeformationSettings,
    pub rigid_transforms: bool,
    pub remarks: Vec<String>,
    /// The ranges of each domain in the packed buffers.
    pub layout: Layout,
    /// The domains whose transforms steps can set, and the domains that follow them.
    pub transform_roots: TransformRoots,
    /// The optional features that the scene uses.
    pub features: SceneFeatures,
    /// Bounds of the drawn vertices of the rest state, T (x0 + U q) with the q of the files, in scene units.
    pub rest_bounds: BoundingBox,
    /// Bounds of the drawn vertices of each shape.
    pub drawn_bounds: DrawnBounds,
    /// Spacings of the floating origins of the transform roots.
    pub origin_grids: Arc<OriginGrids>,
    /// Whether a domain is so far from the scene's origin, or from the origin of its own frame, that the rest state
    /// needs floating origins.
    pub is_far: bool,
}

impl Scene {
    /// Copies the parts of this scene, for building a modified scene.
    pub fn parts(&self) -> SceneParts {
        SceneParts {
            name: self.name.clone(),
            shapes: self.shapes.clone(),
            materials: self.materials.clone(),
            textures: self.textures.clone(),
            domains: self.domains.clone(),
            up: self.up,
            unit: Some(self.unit),
            origin: self.origin,
            look: self.look,
            deformation: self.deformation,
            rigid_transforms: self.rigid_transforms,
            remarks: self.remarks.clone(),
        }
    }

    /// Builds a scene: validates the parts and the references between them, and computes the derived fields.
    ///
    /// # Errors
    /// `Invalid` with the field and, for a field of a domain, the index of the domain.
    pub fn new(mut parts: SceneParts) -> Result<Arc<Self>> {
        if parts.domains.is_empty() || parts.domains.len() > MAX_DOMAINS {
            return Err(invalid("scene.domains", format!("1 to {MAX_DOMAINS}"), parts.domains.len()));
        }
        let unit = parts.meters_per_unit();
        if !(unit.is_finite() && unit > 0.0) {
            return Err(invalid("scene.unit", "a positive number of meters", unit));
        }
        if !parts.origin.iter().all(|number| number.is_finite()) {
            return Err(invalid("scene.origin", "finite numbers", format!("{:?}", parts.origin)));
        }
        parts.materials = parts.materials.into_iter().map(Material::validated).collect::<Result<_>>()?;
        escape_names(&mut parts);
        check_names(&parts)?;
        check_textures(&parts)?;
        for index in 0..parts.domains.len() {
            check_domain(&parts, index).map_err(|error| error.prefix_field(&format!("domain {index}")))?;
        }
        let mut transform_roots = TransformRoots::new(&parts.shapes, &mut parts.domains)?;
        let had_origins = parts.shapes.iter().any(Shape::is_centered);
        let far_domains = far_domains::separate_far_domains(&mut parts)?;
        let is_far = far_domains.exist();
        if is_far || had_origins {
            // The frames of followers depend on the origins of shapes.
            transform_roots = TransformRoots::new(&parts.shapes, &mut parts.domains)?;
        }
        far_domains.round_near_placements(&mut parts.domains);
        // Parts of a scene already have its remark.
        parts.remarks.extend(far_domains.remark.filter(|remark| !parts.remarks.contains(remark)));
        parts.look.check()?;
        drop_textures_without_uvs(&mut parts);
        parts.remarks.extend(negative_eigenvalues(&parts.domains));
        parts.remarks.extend(slow_eigenvalues(&parts.domains));
        add_tangents(&mut parts);
        limit_remarks(&mut parts.remarks);
        let layout = Layout::new(&parts.shapes, &parts.domains)?;
        let features = SceneFeatures::from_parts(&parts);
        let origin_grids = Arc::new(OriginGrids::new(&parts.shapes, &parts.domains, &transform_roots));
        if features.exact_normals {
            add_smoothing(&mut parts)?;
        }
        let drawn_bounds = DrawnBounds::new(&parts.shapes);
        let mut scene = Self {
            name: parts.name,
            shapes: parts.shapes,
            materials: parts.materials,
            textures: parts.textures,
            domains: parts.domains,
            up: parts.up,
            unit,
            origin: parts.origin,
            look: parts.look,
            deformation: parts.deformation,
            rigid_transforms: parts.rigid_transforms,
            remarks: parts.remarks,
            layout,
            transform_roots,
            features,
            rest_bounds: BoundingBox::EMPTY,
            drawn_bounds,
            origin_grids,
            is_far,
        };
        scene.rest_bounds = scene.compute_rest_bounds();
        Ok(Arc::new(scene))
    }

    /// Per triangle of all domains, in layout order, the indices of its vertices (not corners) in the packed positions.
    pub fn triangle_vertices(&self) -> Vec<[u32; 3]> {
        let vertices_of_domain = |domain: usize| {
            let (mesh, first_vertex) = (&self.shape_of(domain).mesh, self.layout.domains[domain].first_vertex as u32);
            let vertices = &mesh.corners().vertices;
            mesh.triangles().iter().map(move |corners| corners.map(|corner| first_vertex + vertices[corner as usize]))
        };
        (0..self.domains.len()).flat_map(vertices_of_domain).collect()
    }

    /// The shape of a domain.
    pub fn shape_of(&self, domain: usize) -> &Shape {
        &self.shapes[self.domains[domain].shape]
    }

    /// The number of modes of a domain.
    pub fn rank_of(&self, domain: usize) -> usize {
        self.shape_of(domain).modes.rank()
    }

    fn compute_rest_bounds(&self) -> BoundingBox {
        let mut bounds = BoundingBox::EMPTY;
        let is_deformed = self.domains.iter().any(|domain| !domain.rest_q.is_empty());
        let rest_state = is_deformed.then(|| SceneState::rest(self));
        let drawn_vertices: Vec<Vec<u32>> = self.shapes.iter().map(|shape| shape.mesh.drawn_vertices()).collect();
        for (index, domain) in self.domains.iter().enumerate() {
            let (world_from_domain, shape) = (domain.placement_matrix(), &self.shapes[domain.shape]);
            let rest_q = rest_state.as_ref().map_or(&[][..], |state| state.q_of(self, index));
            for vertex in drawn_vertices[domain.shape].iter().map(|vertex| *vertex as usize) {
                let x0 = shape.mesh.rest_positions()[vertex];
                let displacement = |axis: usize| -> f64 {
                    let modes = rest_q.iter().enumerate().filter(|(_, q)| **q != 0.0);
                    modes.map(|(mode, q)| f64::from(*q) * f64::from(shape.modes.entry(vertex, axis, mode))).sum()
                };
                let x = std::array::from_fn(|axis| f64::from(x0[axis]) + shape.origin()[axis] + displacement(axis));
                bounds.include(far_domains::transform_point(&world_from_domain, x));
            }
        }
        bounds
    }
}

/// Limits number and length of the remarks. Escapes control characters: remarks contain texts of files, which may be written
/// to make trouble in a terminal or a log.
fn limit_remarks(remarks: &mut Vec<String>) {
    let suppressed = remarks.len().saturating_sub(MAX_REMARKS);
    remarks.truncate(MAX_REMARKS);
    for remark in remarks.iter_mut() {
        if remark.chars().nth(MAX_REMARK_CHARACTERS).is_some() {
            *remark = remark.chars().take(MAX_REMARK_CHARACTERS).chain("...".chars()).collect();
        }
        escape_in_place(remark);
    }
    if suppressed > 0 {
        remarks.push(format!("and {suppressed} more remarks"));
    }
}

/// Escapes control characters in the names of domains and materials. Textures have escaped names.
fn escape_names(parts: &mut SceneParts) {
    parts.domains.iter_mut().for_each(|domain| escape_in_place(&mut domain.name));
    parts.materials.iter_mut().for_each(|material| escape_in_place(&mut material.name));
}

fn escape_in_place(text: &mut String) {
    if let Cow::Owned(escaped) = escape_controls(text) {
        *text = escaped;
    }
}

/// Limits the sizes of the names of materials and textures.
fn check_names(parts: &SceneParts) -> Result<()> {
    let materials = parts.materials.iter().map(|material| ("material", &material.name));
    let textures = parts.textures.iter().map(|texture| ("texture", &texture.name));
    match materials.chain(textures).find(|(_, name)| name.len() > MAX_NAME_BYTES) {
        None => Ok(()),
        Some((kind, name)) => {
            let expected = format!("at most {MAX_NAME_BYTES} bytes");
            Err(invalid(format!("{kind}: name"), expected, format!("{} bytes", name.len())))
        }
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

/// Validates the indices, transforms, coordinates and sizes of one domain.
fn check_domain(parts: &SceneParts, index: usize) -> Result<()> {
    let domain = &parts.domains[index];
    let check_index = |field: &str, given: usize, limit: usize| match given < limit {
        true => Ok(()),
        false => Err(invalid(field, format!("an index below {limit}"), given)),
    };
    check_index("shape", domain.shape, parts.shapes.len())?;
    check_index("material", domain.material, parts.materials.len())?;
    check_material_ranges(parts, domain)?;
    check_text_sizes(domain)?;
    if let Some(constraint) = &domain.follows {
        check_index("follows.parent", constraint.parent, index)?;
        crate::domain::Transform::new(constraint.frame.0).map_err(|error| error.prefix_field("follows.frame"))?;
    }
    let rank = parts.shapes[domain.shape].modes.rank();
    crate::domain::Transform::new(domain.placement.0).map_err(|error| error.prefix_field("placement"))?;
    let origin = parts.shapes[domain.shape].origin();
    let mut exact_numbers = domain.placement_remainder.iter().chain(&origin);
    if let Some(number) = exact_numbers.find(|number| !number.is_finite()) {
        return Err(invalid("placement", "finite numbers", number));
    }
    if let Some(inertia) = domain.metadata.inertia.as_ref().filter(|inertia| inertia.rank() != rank) {
        return Err(invalid("inertia", format!("{rank} modes, as the shape has"), inertia.rank()));
    }
    if !domain.rest_q.is_empty() && domain.rest_q.len() != rank {
        return Err(invalid("rest_q", format!("none or {rank} coordinates"), domain.rest_q.len()));
    }
    if !domain.rest_q.iter().all(|number| number.is_finite()) {
        return Err(invalid("rest_q", "finite numbers", format!("{:?}", domain.rest_q)));
    }
    if let Some(other_domain) = domain.shares_q_with {
        check_index("shares_q_with", other_domain, index)?;
        let other_rank = parts.shapes[parts.domains[other_domain].shape].modes.rank();
        if other_rank != rank {
            return Err(invalid("shares_q_with", format!("a domain of rank {rank}"), other_rank));
        }
    }
    if let Some(attachment) = &domain.attachment {
        // A parent precedes its children, so that the hierarchy has no cycles and one pass in order can compose it.
        check_index("parent", attachment.parent, index)?;
        let vertices = parts.shapes[parts.domains[attachment.parent].shape].mesh.rest_positions().len();
        if attachment.vertices.len() > MAX_ATTACHMENT_VERTICES {
            let expected = format!("at most {MAX_ATTACHMENT_VERTICES} vertices");
            return Err(invalid("attachment.vertices", expected, attachment.vertices.len()));
        }
        for vertex in &attachment.vertices {
            check_index("attachment.vertices", *vertex as usize, vertices)?;
        }
    }
    Ok(())
}

/// Limits the sizes of a domain's name and notes.
fn check_text_sizes(domain: &Domain) -> Result<()> {
    if domain.name.len() > MAX_NAME_BYTES {
        return Err(invalid("name", format!("at most {MAX_NAME_BYTES} bytes"), domain.name.len()));
    }
    let bytes: usize = domain.metadata.notes.iter().map(|(name, text)| name.len() + text.len()).sum();
    if bytes > MAX_NOTES_BYTES {
        return Err(invalid("notes", format!("at most {MAX_NOTES_BYTES} bytes in all"), bytes));
    }
    Ok(())
}

fn check_material_ranges(parts: &SceneParts, domain: &Domain) -> Result<()> {
    if domain.material_ranges.len() > MAX_MATERIAL_RANGES {
        let expected = format!("at most {MAX_MATERIAL_RANGES} ranges");
        return Err(invalid("material_ranges", expected, domain.material_ranges.len()));
    }
    let triangle_count = parts.shapes[domain.shape].mesh.triangles().len();
    for (index, range) in domain.material_ranges.iter().enumerate() {
        let previous_start = index.checked_sub(1).map(|previous| domain.material_ranges[previous].first_triangle);
        let is_ascending = previous_start.map_or(range.first_triangle == 0, |start| range.first_triangle > start);
        if !is_ascending || range.first_triangle >= triangle_count {
            let expected = format!("0 for the first range, then ascending, below {triangle_count}");
            return Err(invalid(format!("material_ranges[{index}].first_triangle"), expected, range.first_triangle));
        }
        if range.material >= parts.materials.len() {
            let expected = format!("an index below {}", parts.materials.len());
            return Err(invalid(format!("material_ranges[{index}].material"), expected, range.material));
        }
    }
    Ok(())
}

/// A remark on the domains with a negative eigenvalue that is not a rounding error. These domains are accepted, because
/// the server only stores eigenvalues.
fn negative_eigenvalues(domains: &[Domain]) -> Option<String> {
    let most_negative = |domain: &Domain| {
        let eigenvalues = || domain.metadata.eigenvalues.iter().copied();
        let tolerance = EIGENVALUE_ROUNDING * eigenvalues().fold(0.0, |largest: f64, value| largest.max(value.abs()));
        eigenvalues().min_by(f64::total_cmp).filter(|value| *value < -tolerance)
    };
    let mut found = domains.iter().filter_map(|domain| Some((&domain.name, most_negative(domain)?)));
    let (name, value) = found.next()?;
    let others = found.count();
    let more = if others > 0 { format!(", and in {others} other domains") } else { String::new() };
    Some(format!(
        "negative eigenvalue {value} (rad/s)^2 in '{name}'{more}: such a mode is unstable, and modalcast-sim refuses it"
    ))
}

/// A remark on the domains whose largest eigenvalue belongs to a period of days. Such numbers are not in (rad/s)^2.
fn slow_eigenvalues(domains: &[Domain]) -> Option<String> {
    let largest = |domain: &Domain| {
        let largest = domain.metadata.eigenvalues.iter().copied().fold(0.0, f64::max);
        (largest > 0.0 && largest < MIN_LARGEST_EIGENVALUE).then_some(largest)
    };
    let mut found = domains.iter().filter_map(|domain| Some((&domain.name, largest(domain)?)));
    let (name, value) = found.next()?;
    let others = found.count();
    let more = if others > 0 { format!(", and in {others} other domains") } else { String::new() };
    let period = std::f64::consts::TAU / value.sqrt();
    Some(format!(
        "the largest eigenvalue is {value:e} (rad/s)^2 in '{name}'{more}, a period of {period:.0e} s: modes do not move \
         visibly in a simulation"
    ))
}

/// Replaces the materials of domains without texture coordinates by untextured copies, because a texture would show the
/// same texel everywhere. Each replaced material adds a remark.
fn drop_textures_without_uvs(parts: &mut SceneParts) {
    let mut untextured_materials: BTreeMap<usize, usize> = BTreeMap::new();
    let SceneParts { shapes, materials, domains, remarks, .. } = parts;
    for domain in domains.iter_mut().filter(|domain| shapes[domain.shape].mesh.corners().uvs.is_empty()) {
        let range_materials = domain.material_ranges.iter_mut().map(|range| &mut range.material);
        for material_index in std::iter::once(&mut domain.material).chain(range_materials) {
            let material = &materials[*material_index];
            if material.color_texture.is_none() && material.normal_texture.is_none() {
                continue;
            }
            let material = material.clone();
            *material_index = *untextured_materials.entry(*material_index).or_insert_with(|| {
                let name = &material.name;
                remarks.push(format!("textures of material '{name}' left out where there are no texture coordinates"));
                // Without a texture, alpha is constant: the mask keeps either all fragments or none.
                let alpha_mode = match material.alpha_mode {
                    AlphaMode::Mask { cutoff } if material.alpha >= cutoff => AlphaMode::Opaque,
                    alpha_mode => alpha_mode,
                };
                let untextured = Material { color_texture: None, normal_texture: None, alpha_mode, ..material };
                materials.push(untextured);
                materials.len() - 1
            });
        }
    }
}

/// Computes the tangents of shapes that have texture coordinates and are used with a normal map.
fn add_tangents(parts: &mut SceneParts) {
    for domain in &parts.domains {
        let shape = &mut parts.shapes[domain.shape];
        let has_normal_map = domain.materials().any(|material| parts.materials[material].normal_texture.is_some());
        if has_normal_map && !shape.mesh.corners().uvs.is_empty() {
            shape.add_tangents();
        }
    }
}

/// Computes the smoothing groups of shapes with modes. Rest normals suffice for shapes without modes.
fn add_smoothing(parts: &mut SceneParts) -> Result<()> {
    let mut triangle_count = 0;
    for domain in &parts.domains {
        let shape = &mut parts.shapes[domain.shape];
        if shape.modes.rank() > 0 && shape.smoothing().is_none() {
            triangle_count += shape.mesh.triangles().len();
            if triangle_count > MAX_RING_TRIANGLES {
                let expected = format!("at most {MAX_RING_TRIANGLES} triangles of shapes with modes");
                return Err(invalid("deform.normals", expected, triangle_count));
            }
            shape.add_smoothing();
        }
    }
    Ok(())
}

impl SceneParts {
    /// Parts without domains, with default settings.
    pub fn named(name: impl Into<String>) -> Self {
        Self { name: name.into(), ..Self::default() }
    }

    /// Meters per scene unit.
    pub(crate) fn meters_per_unit(&self) -> f64 {
        self.unit.unwrap_or(1.0)
    }

    /// Whether the predicate holds for a material of any domain.
    pub(crate) fn has_used_material(&self, predicate: impl Fn(&Material) -> bool) -> bool {
        self.domains.iter().flat_map(Domain::materials).any(|material| predicate(&self.materials[material]))
    }

    pub(crate) fn has_masked_material(&self) -> bool {
        self.has_used_material(|material| matches!(material.alpha_mode, AlphaMode::Mask { .. }))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::domain::{Attachment, MaterialRange, Mesh, Modes, Transform};

    /// One domain of two triangles, with an opaque and a blended material.
    fn square(material_ranges: Vec<MaterialRange>) -> SceneParts {
        let rest_positions = vec![[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 1.0, 0.0], [0.0, 1.0, 0.0]];
        let mesh = Mesh::from_indexed(rest_positions, vec![[0.0, 0.0, 1.0]; 4], vec![], vec![[0, 1, 2], [0, 2, 3]])
            .expect("a square");
        let domain = Domain { material_ranges, ..Domain::new("square", 0) };
        let mut parts = SceneParts::named("square");
        parts.shapes.push(Shape::new(mesh, Modes::rigid()).expect("rigid"));
        parts.materials = vec![Material::default(), Material { alpha_mode: AlphaMode::Blend, ..Material::default() }];
        parts.domains.push(domain);
        parts
    }

    #[test]
    fn textures_without_uvs_are_dropped_with_a_remark() {
        let textured_parts = || {
            let mut parts = square(vec![]);
            parts.textures = vec![Texture::new("leaf", 1, 1, vec![0; 4]).expect("a texture")];
            parts.materials[0].color_texture = Some(0);
            parts.materials[0].alpha_mode = AlphaMode::Mask { cutoff: 0.5 };
            parts
        };
        let scene = Scene::new(textured_parts()).expect("a scene");
        let material = &scene.materials[scene.domains[0].material];
        assert_eq!((material.color_texture, material.alpha_mode), (None, AlphaMode::Opaque));
        assert!(!scene.features.textures && !scene.features.mask);
        assert!(scene.remarks[0].contains("no texture coordinates"), "{:?}", scene.remarks);
        let mut parts_with_uvs = textured_parts();
        let mesh = &parts_with_uvs.shapes[0].mesh;
        let corners = mesh.corners().clone();
        let uvs = vec![[0.0, 0.0]; 4];
        let mesh = Mesh::from_indexed(mesh.rest_positions().to_vec(), corners.normals, uvs, mesh.triangles().to_vec());
        parts_with_uvs.shapes[0] = Shape::new(mesh.expect("a square"), Modes::rigid()).expect("rigid");
        let scene = Scene::new(parts_with_uvs).expect("a scene");
        assert!(scene.features.textures && scene.features.mask && scene.remarks.is_empty());
    }

    #[test]
    fn negative_eigenvalues_are_remarked_and_rounding_errors_are_not() {
        let remarks = |eigenvalues: &[f64]| {
            let mut parts = square(vec![]);
            parts.domains[0].metadata.eigenvalues = eigenvalues.to_vec();
            Scene::new(parts).expect("a scene").remarks.clone()
        };
        let negative = remarks(&[-4.0, 100.0]);
        assert!(negative.len() == 1 && negative[0].starts_with("negative eigenvalue -4 (rad/s)^2 in "), "{negative:?}");
        for eigenvalues in [&[-1e-8, 100.0][..], &[0.0, 100.0], &[]] {
            assert_eq!(remarks(eigenvalues), [""; 0], "{eigenvalues:?}");
        }
    }

    #[test]
    fn eigenvalues_of_periods_of_days_are_remarked() {
        let remarks = |eigenvalues: &[f64]| {
            let mut parts = square(vec![]);
            parts.domains[0].metadata.eigenvalues = eigenvalues.to_vec();
            Scene::new(parts).expect("a scene").remarks.clone()
        };
        let slow = remarks(&[1e-30, 2e-31]);
        assert!(slow.len() == 1 && slow[0].starts_with("the largest eigenvalue is 1e-30 (rad/s)^2 in "), "{slow:?}");
        for eigenvalues in [&[1e-30, 100.0][..], &[0.0], &[1e-6]] {
            assert_eq!(remarks(eigenvalues), [""; 0], "{eigenvalues:?}");
        }
    }

    fn material_range(first_triangle: usize, material: usize) -> MaterialRange {
        MaterialRange { first_triangle, material }
    }

    #[test]
    fn features_include_materials_of_all_ranges() {
        assert!(
            Scene::new(square(vec![material_range(0, 0), material_range(1, 1)])).expect("a valid scene").features.blend
        );
        assert!(
            !Scene::new(square(vec![])).expect("a valid scene").features.blend,
            "expected an unused material to be ignored"
        );
    }

    #[test]
    fn oversized_names_notes_and_attachments_are_rejected() {
        let build_scene = |name_bytes: usize, notes_bytes: usize, vertex_count: usize| {
            let mut parts = square(vec![]);
            let mut domain = parts.domains[0].clone();
            domain.name = "x".repeat(name_bytes);
            // The names "a" and "b" and the text "y" take 3 bytes.
            domain.metadata.notes = [("a".into(), "x".repeat(notes_bytes - 3)), ("b".into(), "y".into())].into();
            domain.attachment =
                Some(Attachment { parent: 0, frame: Transform::IDENTITY, vertices: vec![3; vertex_count] });
            parts.domains.push(domain);
            Scene::new(parts).map(drop).map_err(|error| error.to_string())
        };
        assert_eq!(build_scene(4096, 65536, 4096), Ok(()));
        let rejection =
            |field, limit, actual| Err(format!("domain 1: {field}: expected at most {limit}, got {actual}"));
        assert_eq!(build_scene(4097, 65536, 4096), rejection("name", "4096 bytes", 4097));
        assert_eq!(build_scene(4096, 65537, 4096), rejection("notes", "65536 bytes in all", 65537));
        assert_eq!(build_scene(4096, 65536, 4097), rejection("attachment.vertices", "4096 vertices", 4097));
    }

    #[test]
    fn invalid_material_ranges_are_rejected_with_their_field() {
        for (material_ranges, field) in [
            (vec![material_range(1, 0)], "domain 0: material_ranges[0].first_triangle"),
            (vec![material_range(0, 0), material_range(0, 1)], "domain 0: material_ranges[1].first_triangle"),
            (vec![material_range(0, 0), material_range(2, 1)], "domain 0: material_ranges[1].first_triangle"),
            (vec![material_range(0, 2)], "domain 0: material_ranges[0].material"),
        ] {
            let message = Scene::new(square(material_ranges)).expect_err(field).to_string();
            assert!(message.starts_with(field), "expected an error about {field}, got {message}");
        }
    }
}
