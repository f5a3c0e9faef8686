//! Builds one scene from the entries of a manifest: reads each model once, places and attaches its domains, and applies
//! material overrides.

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;

use nalgebra::Matrix4;

use super::patch::{MaterialPatch, TextureLookup};
use super::{DomainEntry, Manifest, TransformKind};
use crate::backend_settings::{BackendSettings, RasterPolicy};
use crate::domain::{Attachment, CreaseAngle, Domain, FollowConstraint, Material, Modes, Shape, Texture, Transform};
use crate::error::{Result, invalid};
use crate::load::SceneDescription;
use crate::load::asset_dir::AssetDir;
use crate::load::surface::{ModelOptions, ModesSource};
use crate::load::{modes, source, texture_cache};
use crate::scene::{LengthUnit, Lighting, MAX_DOMAINS, NormalMethod, PresetRequest, SceneParts, UpAxis};

/// Number of parent vertices that carry the domains of an entry without `parent_vertices`.
const DEFAULT_ATTACHMENT_VERTICES: usize = 8;
/// The largest number of names in an error message.
const MAX_LISTED_NAMES: usize = 16;

/// Assembles the scene of all entries and reads its backend settings. `default_name` is the name of a scene whose
/// manifest has none.
///
/// # Errors
/// `Invalid` with the entry.
pub(super) fn assemble(
    files: &AssetDir,
    manifest: &Manifest,
    entries: &[DomainEntry],
    default_name: &str,
) -> Result<SceneDescription> {
    let name = manifest.name.clone().unwrap_or_else(|| default_name.to_owned());
    let mut assembly = ManifestAssembler {
        files,
        manifest,
        parts: SceneParts::named(name),
        texture_by_path: HashMap::new(),
        models: HashMap::new(),
        domain_by_name: HashMap::new(),
        last_suffixes: HashMap::new(),
        material_names: HashSet::new(),
    };
    for (index, entry) in entries.iter().enumerate() {
        assembly
            .add_entry(index, entry)
            .map_err(|error| error.prefix_field(&format!("domain {} ('{}')", index, entry.model)))?;
    }
    assembly.check_override_names()?;
    let mut parts = assembly.parts;
    parts.up = manifest.up.unwrap_or(parts.up);
    parts.unit = manifest.unit.map(LengthUnit::meters).or(parts.unit);
    parts.origin = manifest.origin;
    parts.look = match &manifest.look {
        Some(keys) => keys.render_settings(&parts.look),
        None => parts.look.with_preset(PresetRequest::default()),
    };
    parts.deformation = manifest.deform.deformation_settings(parts.deformation.normals);
    match manifest.shadows {
        Some(false) => parts.look.shadow = None,
        Some(true) => parts.look.shadow = Some(parts.look.shadow.unwrap_or_default()),
        None => {}
    }
    match manifest.ground {
        Some(false) => parts.look.ground = None,
        Some(true) => parts.look.ground = parts.look.ground.or(parts.look.lighting.settings().ground),
        None => {}
    }
    match manifest.ambient_occlusion {
        Some(false) => parts.look.ambient_occlusion = None,
        Some(true) => parts.look.ambient_occlusion = Some(parts.look.ambient_occlusion.unwrap_or_default()),
        None => {}
    }
    parts.rigid_transforms = manifest.transforms == TransformKind::Rigid;
    drop_unused(&mut parts);
    let backends = BackendSettings {
        raster: manifest.look.as_ref().map_or_else(RasterPolicy::default, |look| look.raster),
        batches: manifest.deform.batches,
    };
    Ok(SceneDescription { parts, backends })
}

/// The domains of a loaded model. Their indices of shapes and materials refer to the lists of the scene. Their indices
/// of other domains are relative to the model.
struct LoadedModel {
    domains: Vec<Domain>,
}

/// What entries that share a model have in common: the path of the model file or the built-in name, the name of the
/// modes file, and the bits of the crease angle in degrees.
type ModelKey = (PathBuf, Option<String>, u64);

/// Adds the entries of a manifest to a scene, one after another.
struct ManifestAssembler<'a> {
    files: &'a AssetDir,
    manifest: &'a Manifest,
    /// The scene with the entries so far.
    parts: SceneParts,
    texture_by_path: HashMap<String, usize>,
    models: HashMap<ModelKey, LoadedModel>,
    domain_by_name: HashMap<String, usize>,
    /// By name, the last number that was appended to it. All numbers before it are in use.
    last_suffixes: HashMap<String, usize>,
    /// Names of the materials of all models.
    material_names: HashSet<String>,
}

impl TextureLookup for ManifestAssembler<'_> {
    fn load_texture(&mut self, path: &str) -> Result<usize> {
        if let Some(index) = self.texture_by_path.get(path) {
            return Ok(*index);
        }
        self.parts.textures.push(texture_cache::decode(self.files, path)?);
        self.texture_by_path.insert(path.to_owned(), self.parts.textures.len() - 1);
        Ok(self.parts.textures.len() - 1)
    }

    fn texture(&self, index: usize) -> Option<&Texture> {
        self.parts.textures.get(index)
    }
}

impl ManifestAssembler<'_> {
    /// Adds the domains of an entry. The first entry with a model loads it.
    fn add_entry(&mut self, entry_index: usize, entry: &DomainEntry) -> Result<()> {
        let path = match source::is_built_in(&entry.model) {
            true => PathBuf::from(&entry.model),
            false => self.files.resolve(&entry.model)?,
        };
        let crease_angle = self.crease_angle(entry)?;
        let model_key = (path, entry.modes.clone(), crease_angle.degrees().to_bits());
        if !self.models.contains_key(&model_key) {
            let model = self.load_model(entry_index, entry, crease_angle)?;
            self.models.insert(model_key.clone(), model);
        }
        let Some(model) = self.models.get(&model_key) else { return Ok(()) };
        let mut domains = model.domains.clone();
        let domain_offset = self.parts.domains.len();
        let domain_count = domain_offset + domains.len();
        if domain_count > MAX_DOMAINS {
            return Err(invalid("domains", format!("at most {MAX_DOMAINS} in a scene"), domain_count));
        }
        self.place_domains(entry, &mut domains)?;
        add_follow_constraints(entry, &mut domains)?;
        self.apply_entry_material(entry, &mut domains)?;
        self.set_metadata(entry, &mut domains)?;
        for domain in &mut domains {
            domain.shares_q_with = domain.shares_q_with.map(|other| other + domain_offset);
        }
        self.name_domains(entry, &mut domains)?;
        self.parts.domains.append(&mut domains);
        Ok(())
    }

    /// The crease angle of an entry, or that of the scene if the entry has none.
    fn crease_angle(&self, entry: &DomainEntry) -> Result<CreaseAngle> {
        let degrees = entry.crease_angle.or(self.manifest.crease_angle);
        degrees.map_or(Ok(CreaseAngle::default()), CreaseAngle::from_degrees)
    }

    /// Reads a model and appends its shapes, materials and textures to those of the scene. The model of the first entry
    /// (`entry_index` 0) also sets the scene's up axis, unit and render settings.
    fn load_model(
        &mut self,
        entry_index: usize,
        entry: &DomainEntry,
        crease_angle: CreaseAngle,
    ) -> Result<LoadedModel> {
        let modes = if entry.modes.is_some() { ModesSource::None } else { ModesSource::Sidecar };
        let mut model = source::read_model(
            self.files,
            &entry.model,
            ModelOptions { modes, crease_angle, plant: self.manifest.plant },
        )?;
        if let Some(file) = &entry.modes {
            replace_modes(self.files, file, &mut model)?;
        }
        if entry_index == 0 {
            (self.parts.up, self.parts.unit, self.parts.look) = (model.up, model.unit, model.look);
        } else if model.look.lighting == Lighting::Outdoor && self.parts.look.lighting == Lighting::Studio {
            // Models with materials of their own are drawn outdoors, and with them those without.
            self.parts.look = model.look;
        }
        if model.deformation.normals == NormalMethod::Exact {
            self.parts.deformation.normals = NormalMethod::Exact;
        }
        let up = self.manifest.up.unwrap_or(self.parts.up);
        if entry.up.is_none() && model.up != up {
            let remark = format!(
                "not rotated: {:?} is up by default in its format, and {up:?} in this scene. Set `up` in its entry to \
                 the model's up axis",
                model.up
            );
            model.remarks.push(remark);
        }
        let (shape_offset, material_offset) = (self.parts.shapes.len(), self.parts.materials.len());
        let texture_offset = self.parts.textures.len();
        for domain in &mut model.domains {
            domain.shape += shape_offset;
            domain.material += material_offset;
            domain.material_ranges.iter_mut().for_each(|range| range.material += material_offset);
        }
        self.parts.shapes.append(&mut model.shapes);
        self.parts.textures.append(&mut model.textures);
        for mut material in model.materials {
            for texture in [&mut material.color_texture, &mut material.normal_texture] {
                *texture = texture.map(|texture| texture + texture_offset);
            }
            let manifest = self.manifest;
            self.material_names.insert(material.name.clone());
            // The override of the name comes last, so that it has precedence over the override of all materials.
            for name in ["*", material.name.clone().as_str()] {
                if let Some(patch) = manifest.material.get(name) {
                    patch.apply(&mut material, self)?;
                }
            }
            self.parts.materials.push(material);
        }
        let remarks = model.remarks.into_iter().map(|remark| format!("model '{}': {remark}", entry.model));
        self.parts.remarks.extend(remarks);
        Ok(LoadedModel { domains: model.domains })
    }

    /// Checks that every override names a material of a model.
    fn check_override_names(&self) -> Result<()> {
        let is_known = |name: &&String| name.as_str() == "*" || self.material_names.contains(*name);
        let Some(unknown_name) = self.manifest.material.keys().find(|name| !is_known(name)) else { return Ok(()) };
        let mut names: Vec<&str> = self.material_names.iter().map(String::as_str).collect();
        names.sort_unstable();
        names.truncate(MAX_LISTED_NAMES);
        Err(invalid("material", format!("* or one of: {}", names.join(", ")), unknown_name))
    }

    /// Places the domains, and attaches those without a parent to the entry's parent.
    fn place_domains(&self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        let domain_offset = self.parts.domains.len();
        let to_matrix = |placement: &Option<super::Placement>, key: &str| match placement {
            Some(placement) => placement.to_matrix().map_err(|error| error.prefix_field(key)),
            None => Ok(Matrix4::identity()),
        };
        let parent = self.find_parent(entry)?;
        // f32 products as well as f64 ones, because the placement of a domain near the scene's origin is an f32
        // product.
        let (world_from_entry, exact_world_from_entry) = match parent {
            Some(parent) if entry.frame.is_some() => {
                let (parent, frame) = (&self.parts.domains[parent], to_matrix(&entry.frame, "frame")?);
                (parent.placement.compose(Transform::from_matrix(&frame)), parent.placement_matrix() * frame)
            }
            _ => {
                let placement = to_matrix(&entry.placement, "placement")?;
                (Transform::from_matrix(&placement), placement)
            }
        };
        let up_rotation = up_axis_rotation(entry.up, self.manifest.up.unwrap_or(self.parts.up));
        let world_from_model = world_from_entry.compose(up_rotation);
        let exact_world_from_model = exact_world_from_entry * up_rotation.to_matrix();
        for domain in domains {
            let exact = exact_world_from_model * domain.placement_matrix();
            domain.set_rounded_placement(world_from_model.compose(domain.placement), &exact);
            match (&mut domain.attachment, parent) {
                (Some(attachment), _) => {
                    attachment.parent += domain_offset;
                    domain.follows.iter_mut().for_each(|constraint| constraint.parent += domain_offset);
                }
                (None, Some(parent)) => {
                    domain.attachment = Some(self.create_attachment(entry, parent, domain.placement_matrix())?);
                }
                (None, None) => {}
            }
        }
        Ok(())
    }

    /// The index of the entry's parent, or `None` for an entry without a parent.
    fn find_parent(&self, entry: &DomainEntry) -> Result<Option<usize>> {
        let Some(name) = &entry.parent else {
            return match (&entry.frame, &entry.parent_vertices) {
                (None, None) => Ok(None),
                _ => Err(invalid("parent", "a parent for the keys frame and parent_vertices", "none")),
            };
        };
        if entry.frame.is_some() && entry.placement.is_some() {
            return Err(invalid("frame, placement", "only one of these keys", "both"));
        }
        let parent = self.domain_by_name.get(name).copied();
        parent.map(Some).ok_or_else(|| invalid("parent", "the name of a domain of an earlier entry", name))
    }

    fn create_attachment(
        &self,
        entry: &DomainEntry,
        parent: usize,
        world_from_child: Matrix4<f64>,
    ) -> Result<Attachment> {
        let parent_domain = &self.parts.domains[parent];
        let parent_from_world = parent_domain.placement_matrix().try_inverse();
        let singular_placement = || invalid("parent", "a parent whose placement has an inverse", &parent_domain.name);
        let exact_frame = parent_from_world.ok_or_else(singular_placement)? * world_from_child;
        let frame = Transform::from_matrix(&exact_frame);
        let vertices = match &entry.parent_vertices {
            Some(vertices) => vertices.clone(),
            None => nearest_vertices(&self.parts.shapes[parent_domain.shape], &exact_frame),
        };
        Ok(Attachment { parent, frame, vertices })
    }

    /// Gives the entry its own copies of the materials that it overrides.
    fn apply_entry_material(&mut self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        let Some(patch) = &entry.material else { return Ok(()) };
        let mut copies = HashMap::new();
        let mut material_indices: Vec<usize> = domains.iter().flat_map(Domain::materials).collect();
        material_indices.sort_unstable();
        material_indices.dedup();
        for index in material_indices {
            let mut copy: Material = self.parts.materials[index].clone();
            MaterialPatch::apply(patch, &mut copy, self)?;
            self.parts.materials.push(copy);
            copies.insert(index, self.parts.materials.len() - 1);
        }
        let replace_by_copy = |index: &mut usize| *index = copies.get(index).copied().unwrap_or(*index);
        for domain in domains {
            replace_by_copy(&mut domain.material);
            domain.material_ranges.iter_mut().for_each(|range| replace_by_copy(&mut range.material));
        }
        Ok(())
    }

    /// Sets the eigenvalues and adds the notes of the entry.
    fn set_metadata(&self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        if let Some(eigenvalues) = &entry.eigenvalues {
            let ranks: Vec<_> = domains.iter().map(|domain| self.parts.shapes[domain.shape].modes.rank()).collect();
            if ranks[..] != [eigenvalues.len()] || !eigenvalues.iter().all(|value| value.is_finite()) {
                let expected = format!("one domain, and one finite number per mode (modes per domain: {ranks:?})");
                return Err(invalid("eigenvalues", expected, format!("{} numbers", eigenvalues.len())));
            }
            domains[0].metadata.eigenvalues.clone_from(eigenvalues);
        }
        for domain in domains {
            domain.metadata.notes.extend(entry.notes.clone());
        }
        Ok(())
    }

    /// Gives every domain a unique name: the entry's name, as a prefix if the model has several domains.
    fn name_domains(&mut self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        let has_one_domain = domains.len() == 1;
        for (offset, domain) in domains.iter_mut().enumerate() {
            let index = self.parts.domains.len() + offset;
            match &entry.name {
                Some(name) if has_one_domain => domain.name.clone_from(name),
                Some(name) => domain.name = format!("{name}/{}", domain.name),
                None => {}
            }
            if self.domain_by_name.contains_key(&domain.name) {
                if entry.name.is_some() && has_one_domain {
                    return Err(invalid("name", "a name that no earlier domain has", &domain.name));
                }
                self.add_suffix(&mut domain.name);
            }
            self.domain_by_name.insert(domain.name.clone(), index);
        }
        if let (Some(name), false) = (&entry.name, has_one_domain) {
            // As the `parent` of a later entry, the name of this entry denotes its first domain.
            self.domain_by_name.entry(name.clone()).or_insert(self.parts.domains.len());
        }
        Ok(())
    }

    /// Appends the first number from 2 on with which no domain has the name.
    fn add_suffix(&mut self, name: &mut String) {
        let suffix = self.last_suffixes.entry(name.clone()).or_insert(1);
        let base_name = std::mem::take(name);
        loop {
            *suffix += 1;
            *name = format!("{base_name} {suffix}");
            if !self.domain_by_name.contains_key(name) {
                return;
            }
        }
    }
}

/// Constrains the domains whose names start with `entry.follows` to move rigidly with their parents. The frame of a
/// constraint is that of the domain's attachment.
fn add_follow_constraints(entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
    let Some(prefix) = &entry.follows else { return Ok(()) };
    let mut has_followers = false;
    for domain in domains.iter_mut().filter(|domain| domain.name.starts_with(prefix.as_str())) {
        let to_constraint =
            |attachment: &Attachment| FollowConstraint { parent: attachment.parent, frame: attachment.frame };
        domain.follows = domain.attachment.as_ref().map(to_constraint).or(domain.follows);
        has_followers |= domain.follows.is_some();
    }
    match has_followers {
        true => Ok(()),
        false => Err(invalid("follows", "a prefix of the name of a domain that has a parent", prefix)),
    }
}

/// Replaces U and the eigenvalues of a model with one shape, and clears the inertia and the rest coordinates, which belong
/// to the old modes.
fn replace_modes(files: &AssetDir, file: &str, model: &mut SceneParts) -> Result<()> {
    let [shape] = &mut model.shapes[..] else {
        return Err(invalid("modes", "a model with one shape", format!("{} shapes", model.shapes.len())));
    };
    let loaded = if file.is_empty() { Modes::rigid().into() } else { modes::read(files, file)? };
    let new_shape = Shape::new(shape.mesh.clone(), loaded.modes);
    let new_shape = new_shape.map_err(|error| error.prefix_field(&format!("file '{file}'")))?;
    *shape = new_shape.with_origin(shape.origin());
    for domain in &mut model.domains {
        domain.rest_q.clear();
        domain.metadata.eigenvalues.clone_from(&loaded.eigenvalues);
        domain.metadata.inertia = None;
        if !file.is_empty() {
            domain.metadata.notes.insert(modes::FILE_NOTE.to_owned(), file.to_owned());
        }
    }
    Ok(())
}

/// The rotation that maps the up axis of a model to that of the scene; the identity if `model_up` is `None`.
fn up_axis_rotation(model_up: Option<UpAxis>, scene_up: UpAxis) -> Transform {
    let Some(model_up) = model_up.filter(|axis| *axis != scene_up) else { return Transform::IDENTITY };
    let rotation = scene_up.rotation_from_y_up() * model_up.rotation_from_y_up().inverse();
    Transform::from_parts(rotation.matrix(), &nalgebra::Vector3::zeros())
}

/// The [`DEFAULT_ATTACHMENT_VERTICES`] vertices of a deformable shape nearest to the translation of `frame`, in
/// ascending order of their indices. Empty for a rigid shape.
fn nearest_vertices(shape: &Shape, frame: &Matrix4<f64>) -> Vec<u32> {
    if shape.modes.rank() == 0 {
        return Vec::new();
    }
    let origin = frame.fixed_view::<3, 1>(0, 3).into_owned();
    let squared_distances: Vec<f64> =
        shape.exact_positions().map(|position| (nalgebra::Vector3::from(position) - origin).norm_squared()).collect();
    let mut vertices: Vec<u32> = (0..squared_distances.len() as u32).collect();
    vertices.sort_by(|a, b| squared_distances[*a as usize].total_cmp(&squared_distances[*b as usize]));
    vertices.truncate(DEFAULT_ATTACHMENT_VERTICES);
    vertices.sort_unstable();
    vertices
}

/// Removes unused materials and textures, for example replaced textures.
fn drop_unused(parts: &mut SceneParts) {
    let mut is_material_used = vec![false; parts.materials.len()];
    for domain in &parts.domains {
        domain.materials().for_each(|material| is_material_used[material] = true);
    }
    let new_material_indices = retain_used(&mut parts.materials, &is_material_used);
    for domain in &mut parts.domains {
        domain.material = new_material_indices[domain.material];
        domain.material_ranges.iter_mut().for_each(|range| range.material = new_material_indices[range.material]);
    }
    let mut is_texture_used = vec![false; parts.textures.len()];
    let textures = |material: &Material| [material.color_texture, material.normal_texture];
    parts.materials.iter().flat_map(textures).flatten().for_each(|texture| is_texture_used[texture] = true);
    let new_texture_indices = retain_used(&mut parts.textures, &is_texture_used);
    for material in &mut parts.materials {
        material.color_texture = material.color_texture.map(|texture| new_texture_indices[texture]);
        material.normal_texture = material.normal_texture.map(|texture| new_texture_indices[texture]);
    }
}

/// Retains the used elements. Returns the new index of each old index; that of a removed element is meaningless.
fn retain_used<T>(list: &mut Vec<T>, used_flags: &[bool]) -> Vec<usize> {
    let mut retained_count = 0;
    let mut new_indices = Vec::with_capacity(list.len());
    for is_used in used_flags {
        new_indices.push(retained_count);
        retained_count += usize::from(*is_used);
    }
    let mut used_flags = used_flags.iter();
    list.retain(|_| *used_flags.next().unwrap_or(&false));
    new_indices
}
