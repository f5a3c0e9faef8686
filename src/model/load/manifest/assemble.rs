//! Builds one scene from the entries of a manifest: reads each model once, places and attaches its domains, and applies
//! material overrides.

use std::collections::{HashMap, HashSet};
use std::path::PathBuf;

use super::patch::{MaterialPatch, TextureLookup};
use super::settings::LookKeys;
use super::{DomainEntry, Manifest, TransformKind};
use crate::backend_settings::{BackendSettings, RasterPolicy};
use crate::domain::{Attachment, Domain, FollowConstraint, Material, Modes, Shape, Texture, Transform};
use crate::error::{Result, invalid};
use crate::load::SceneDescription;
use crate::load::asset_dir::AssetDir;
use crate::load::obj::ModesSource;
use crate::load::{modes, source, texture_cache};
use crate::scene::{MAX_DOMAINS, SceneParts, UpAxis};

/// Number of carrying vertices of a deformable parent for an entry without `rows`.
const DEFAULT_ATTACHMENT_ROWS: usize = 8;

/// The scene of all entries, and the settings of the backends.
///
/// # Errors
/// `Invalid` with the entry.
pub(super) fn assemble(
    files: &AssetDir,
    manifest: &Manifest,
    entries: &[DomainEntry],
    own_name: &str,
) -> Result<SceneDescription> {
    let name = manifest.name.clone().unwrap_or_else(|| own_name.to_owned());
    let mut assembly = ManifestAssembler {
        files,
        manifest,
        parts: SceneParts::named(name),
        texture_by_path: HashMap::new(),
        models: HashMap::new(),
        by_name: HashMap::new(),
        patched: HashSet::new(),
    };
    for (index, entry) in entries.iter().enumerate() {
        assembly
            .add(index, entry)
            .map_err(|error| error.prefix_field(&format!("domain {} ('{}')", index, entry.model)))?;
    }
    assembly.check_patches()?;
    let mut parts = assembly.parts;
    parts.up = manifest.up.unwrap_or(parts.up);
    parts.unit = manifest.unit.unwrap_or(parts.unit);
    parts.origin = manifest.origin;
    parts.look = manifest.look.as_ref().map_or(parts.look, LookKeys::render_settings);
    parts.deformation = manifest.deform.deformation_settings();
    match manifest.shadows {
        Some(false) => parts.look.shadow = None,
        Some(true) => parts.look.shadow = Some(parts.look.shadow.unwrap_or_default()),
        None => {}
    }
    match manifest.ground {
        Some(false) => parts.look.ground = None,
        Some(true) => parts.look.ground = Some(parts.look.ground.unwrap_or_default()),
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

/// A model that was read. The indices in its domains refer to the lists of the whole scene, except indices of other
/// domains, which are relative to the model.
struct LoadedModel {
    domains: Vec<Domain>,
}

struct ManifestAssembler<'a> {
    files: &'a AssetDir,
    manifest: &'a Manifest,
    parts: SceneParts,
    texture_by_path: HashMap<String, usize>,
    models: HashMap<(PathBuf, Option<String>), LoadedModel>,
    by_name: HashMap<String, usize>,
    /// Names of all materials that were looked up in the overrides.
    patched: HashSet<String>,
}

impl TextureLookup for ManifestAssembler<'_> {
    fn index(&mut self, path: &str) -> Result<usize> {
        if let Some(index) = self.texture_by_path.get(path) {
            return Ok(*index);
        }
        self.parts.textures.push(texture_cache::decode(self.files, path)?);
        self.texture_by_path.insert(path.to_owned(), self.parts.textures.len() - 1);
        Ok(self.parts.textures.len() - 1)
    }

    fn at(&self, index: usize) -> Option<&Texture> {
        self.parts.textures.get(index)
    }
}

impl ManifestAssembler<'_> {
    fn add(&mut self, index: usize, entry: &DomainEntry) -> Result<()> {
        let path = self.files.resolve(&entry.model)?;
        let key = (path, entry.modes.clone());
        if !self.models.contains_key(&key) {
            let loaded = self.load(index, entry)?;
            self.models.insert(key.clone(), loaded);
        }
        let Some(loaded) = self.models.get(&key) else { return Ok(()) };
        let mut domains = loaded.domains.clone();
        let first = self.parts.domains.len();
        if first + domains.len() > MAX_DOMAINS {
            return Err(invalid("domains", format!("at most {MAX_DOMAINS} in a scene"), first + domains.len()));
        }
        self.place(entry, &mut domains)?;
        add_follow_constraints(entry, &mut domains)?;
        self.apply_entry_material(entry, &mut domains)?;
        self.annotate(entry, &mut domains)?;
        for domain in &mut domains {
            domain.shares_q_with = domain.shares_q_with.map(|twin| twin + first);
        }
        self.name(entry, &mut domains)?;
        self.parts.domains.append(&mut domains);
        Ok(())
    }

    /// Reads a model and appends its shapes, materials and textures to those of the scene.
    fn load(&mut self, index: usize, entry: &DomainEntry) -> Result<LoadedModel> {
        let source = if entry.modes.is_some() { ModesSource::None } else { ModesSource::Sidecar };
        let mut model = source::model(self.files, &entry.model, source)?;
        if let Some(file) = &entry.modes {
            replace_modes(self.files, file, &mut model)?;
        }
        if index == 0 {
            (self.parts.up, self.parts.unit, self.parts.look) = (model.up, model.unit, model.look);
        }
        let up = self.manifest.up.unwrap_or(self.parts.up);
        if entry.up.is_none() && model.up != up {
            let remark = format!("{:?} is up in it and {up:?} in the scene; its entry can say so with `up`", model.up);
            model.remarks.push(remark);
        }
        let (shapes, materials) = (self.parts.shapes.len(), self.parts.materials.len());
        let textures = self.parts.textures.len();
        for domain in &mut model.domains {
            domain.shape += shapes;
            domain.material += materials;
            domain.material_ranges.iter_mut().for_each(|run| run.material += materials);
        }
        self.parts.shapes.append(&mut model.shapes);
        self.parts.textures.append(&mut model.textures);
        for mut material in model.materials {
            for texture in [&mut material.color_texture, &mut material.normal_texture] {
                *texture = texture.map(|texture| texture + textures);
            }
            let manifest = self.manifest;
            self.patched.insert(material.name.clone());
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

    fn check_patches(&self) -> Result<()> {
        let known = |name: &&String| name.as_str() == "*" || self.patched.contains(*name);
        let Some(stray) = self.manifest.material.keys().find(|name| !known(name)) else { return Ok(()) };
        let mut names: Vec<&str> = self.patched.iter().map(String::as_str).collect();
        names.sort_unstable();
        names.truncate(16);
        Err(invalid("material", format!("* or one of {}", names.join(", ")), stray))
    }

    /// Places the domains, and attaches those without a parent to the entry's parent.
    fn place(&self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        let first = self.parts.domains.len();
        let said = |placement: &Option<super::Placement>, key: &str| match placement {
            Some(placement) => placement.transform().map_err(|error| error.prefix_field(key)),
            None => Ok(Transform::IDENTITY),
        };
        let parent = self.parent(entry)?;
        let world_from_entry = match parent {
            Some(parent) if entry.frame.is_some() => {
                self.parts.domains[parent].placement.compose(said(&entry.frame, "frame")?)
            }
            _ => said(&entry.placement, "placement")?,
        };
        let world_from_model =
            world_from_entry.compose(up_axis_rotation(entry.up, self.manifest.up.unwrap_or(self.parts.up)));
        for domain in domains {
            domain.placement = world_from_model.compose(domain.placement);
            match (&mut domain.attachment, parent) {
                (Some(attachment), _) => {
                    attachment.parent += first;
                    domain.follows.iter_mut().for_each(|add_follow_constraints| add_follow_constraints.parent += first);
                }
                (None, Some(parent)) => domain.attachment = Some(self.attach(entry, parent, domain.placement)?),
                (None, None) => {}
            }
        }
        Ok(())
    }

    fn parent(&self, entry: &DomainEntry) -> Result<Option<usize>> {
        let Some(name) = &entry.parent else {
            return match (&entry.frame, &entry.rows) {
                (None, None) => Ok(None),
                _ => Err(invalid("frame, rows", "none without a parent", "some")),
            };
        };
        if entry.frame.is_some() && entry.placement.is_some() {
            return Err(invalid("frame", "either a frame in the parent or a placement in the world", "both"));
        }
        let found = self.by_name.get(name).copied();
        found.map(Some).ok_or_else(|| invalid("parent", "the name of a domain of an earlier entry", name))
    }

    fn attach(&self, entry: &DomainEntry, parent: usize, world_from_child: Transform) -> Result<Attachment> {
        let carrier = &self.parts.domains[parent];
        let parent_from_world = carrier.placement.inverse();
        let singular = || invalid("parent", "a parent whose placement has an inverse", &carrier.name);
        let frame = parent_from_world.ok_or_else(singular)?.compose(world_from_child);
        let rows = match &entry.rows {
            Some(rows) => rows.clone(),
            None => nearest_vertices(&self.parts.shapes[carrier.shape], frame),
        };
        Ok(Attachment { parent, frame, rows })
    }

    /// Gives the entry its own copies of the materials that it overrides.
    fn apply_entry_material(&mut self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        let Some(patch) = &entry.material else { return Ok(()) };
        let mut copies = HashMap::new();
        let mut used: Vec<usize> = domains.iter().flat_map(Domain::materials).collect();
        used.sort_unstable();
        used.dedup();
        for index in used {
            let mut copy: Material = self.parts.materials[index].clone();
            MaterialPatch::apply(patch, &mut copy, self)?;
            self.parts.materials.push(copy);
            copies.insert(index, self.parts.materials.len() - 1);
        }
        let copied = |index: &mut usize| *index = copies.get(index).copied().unwrap_or(*index);
        for domain in domains {
            copied(&mut domain.material);
            domain.material_ranges.iter_mut().for_each(|run| copied(&mut run.material));
        }
        Ok(())
    }

    fn annotate(&self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        if let Some(eigenvalues) = &entry.eigenvalues {
            let ranks: Vec<_> = domains.iter().map(|domain| self.parts.shapes[domain.shape].modes.rank()).collect();
            if ranks[..] != [eigenvalues.len()] || !eigenvalues.iter().all(|value| value.is_finite()) {
                let expected = format!("finite numbers for one domain of as many modes (there: {ranks:?})");
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
    fn name(&mut self, entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
        let single = domains.len() == 1;
        for (offset, domain) in domains.iter_mut().enumerate() {
            let index = self.parts.domains.len() + offset;
            match &entry.name {
                Some(name) if single => domain.name.clone_from(name),
                Some(name) => domain.name = format!("{name}/{}", domain.name),
                None => {}
            }
            let wanted = domain.name.clone();
            let mut count = 1;
            while self.by_name.contains_key(&domain.name) {
                if entry.name.is_some() && single {
                    return Err(invalid("name", "a name that no earlier domain has", wanted));
                }
                count += 1;
                domain.name = format!("{wanted} {count}");
            }
            self.by_name.insert(domain.name.clone(), index);
        }
        if let (Some(name), false) = (&entry.name, single) {
            // As a parent of later entries, the entry's name denotes its first domain.
            self.by_name.entry(name.clone()).or_insert(self.parts.domains.len());
        }
        Ok(())
    }
}

/// Makes the domains with the entry's name prefix followers of their parents, with their rest poses as frames.
fn add_follow_constraints(entry: &DomainEntry, domains: &mut [Domain]) -> Result<()> {
    let Some(start) = &entry.follows else { return Ok(()) };
    let mut any = false;
    for domain in domains.iter_mut().filter(|domain| domain.name.starts_with(start.as_str())) {
        let add_follow_constraints = |on: &Attachment| FollowConstraint { parent: on.parent, frame: on.frame };
        domain.follows = domain.attachment.as_ref().map(add_follow_constraints).or(domain.follows);
        any |= domain.follows.is_some();
    }
    match any {
        true => Ok(()),
        false => Err(invalid("follows", "how the names of domains begin that hang on others", start)),
    }
}

/// Replaces U of a model with one shape, and clears the rest coordinates, which belong to the old modes.
fn replace_modes(files: &AssetDir, file: &str, model: &mut SceneParts) -> Result<()> {
    let [shape] = &mut model.shapes[..] else {
        return Err(invalid("modes", "a model of one domain", format!("one of {}", model.shapes.len())));
    };
    let found = if file.is_empty() { Modes::rigid() } else { modes::read(files, file)? };
    *shape = Shape::new(shape.mesh.clone(), found).map_err(|error| error.prefix_field(&format!("file '{file}'")))?;
    model.domains.iter_mut().for_each(|domain| domain.rest_q.clear());
    Ok(())
}

/// The rotation from up axis `from` to `to`; the identity if `from` is `None`.
fn up_axis_rotation(from: Option<UpAxis>, to: UpAxis) -> Transform {
    let Some(from) = from.filter(|from| *from != to) else { return Transform::IDENTITY };
    let turn = to.rotation_from_y_up() * from.rotation_from_y_up().inverse();
    Transform::from_parts(turn.matrix(), &nalgebra::Vector3::zeros())
}

/// The vertices of a deformable shape that are nearest to the origin of `frame`, ascending. Empty for a rigid shape.
fn nearest_vertices(shape: &Shape, frame: Transform) -> Vec<u32> {
    if shape.modes.rank() == 0 {
        return Vec::new();
    }
    let origin = frame.translation();
    let rest = shape.mesh.rest_positions();
    let distance = |vertex: u32| (nalgebra::Vector3::from(rest[vertex as usize]).cast::<f64>() - origin).norm_squared();
    let mut vertices: Vec<u32> = (0..rest.len() as u32).collect();
    vertices.sort_by(|a, b| distance(*a).total_cmp(&distance(*b)));
    vertices.truncate(DEFAULT_ATTACHMENT_ROWS);
    vertices.sort_unstable();
    vertices
}

/// Removes unused materials and textures, for example replaced textures.
fn drop_unused(parts: &mut SceneParts) {
    let mut used = vec![false; parts.materials.len()];
    for domain in &parts.domains {
        used[domain.material] = true;
        domain.material_ranges.iter().for_each(|run| used[run.material] = true);
    }
    let new = retain_used(&mut parts.materials, &used);
    for domain in &mut parts.domains {
        domain.material = new[domain.material];
        domain.material_ranges.iter_mut().for_each(|run| run.material = new[run.material]);
    }
    let mut used = vec![false; parts.textures.len()];
    let textures = |material: &Material| [material.color_texture, material.normal_texture];
    parts.materials.iter().flat_map(textures).flatten().for_each(|texture| used[texture] = true);
    let new = retain_used(&mut parts.textures, &used);
    for material in &mut parts.materials {
        material.color_texture = material.color_texture.map(|texture| new[texture]);
        material.normal_texture = material.normal_texture.map(|texture| new[texture]);
    }
}

/// Keeps the used elements, and returns the new index of each of them.
fn retain_used<T>(list: &mut Vec<T>, used: &[bool]) -> Vec<usize> {
    let before: Vec<usize> =
        used.iter().scan(0, |kept, used| Some(std::mem::replace(kept, *kept + usize::from(*used)))).collect();
    let mut flags = used.iter();
    list.retain(|_| *flags.next().unwrap_or(&false));
    before
}
