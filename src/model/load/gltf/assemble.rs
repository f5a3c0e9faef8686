//! Builds the domains of a scene, parents before children, from placed nodes and their meshes.

use std::collections::{HashMap, HashSet};

use nalgebra::Matrix4;

use super::accessor::AccessorReader;
use super::buffers::GltfBuffers;
use super::document::Document;
use super::get_element;
use super::hierarchy::{self, PlacedNode};
use super::material::MaterialConverter;
use super::primitive::{self, ConvertedPrimitive, PrimitiveOptions};
use super::remarks::{ImportRemarks, sanitize};
use super::skin;
use super::texture::TextureLoader;
use crate::domain::{Attachment, CreaseAngle, Domain, Shape, Transform};
use crate::error::{Result, invalid};
use crate::scene::{Lighting, MAX_DOMAINS, NormalMethod, SceneParts};

/// The domain to which the domains of a node's children are attached: the first domain of the node or, if the node has
/// none, of its nearest ancestor with domains.
#[derive(Debug, Clone, Copy)]
struct ParentDomain {
    domain: usize,
    /// From the coordinates of the node to those of the domain.
    domain_from_node: Matrix4<f64>,
}

/// A converted primitive, shared by all instances of its mesh.
#[derive(Debug, Clone, Copy)]
struct LoadedPrimitive {
    shape: usize,
    material: usize,
}

/// A primitive in the pose of a skin, or at rest.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
struct PrimitiveKey {
    mesh: usize,
    primitive: usize,
    skin: Option<usize>,
}

#[derive(Debug)]
struct GltfAssembler<'a> {
    reader: AccessorReader<'a>,
    material_converter: MaterialConverter<'a>,
    /// Converted primitives; `None` for points and lines.
    primitives: HashMap<PrimitiveKey, Option<LoadedPrimitive>>,
    /// The world matrices of the nodes of the scene, by their index in the document.
    world_by_node: HashMap<usize, Matrix4<f64>>,
    /// Whether a morph target has normals.
    has_target_normals: bool,
    crease_angle: CreaseAngle,
    /// Names of all nodes with a mesh so far.
    names: HashSet<String>,
    shapes: Vec<Shape>,
    domains: Vec<Domain>,
    remarks: ImportRemarks,
}

/// Builds all domains of the document's default scene.
///
/// # Errors
/// `Invalid` with the element of the document.
pub(super) fn assemble(
    name: &str,
    document: &Document,
    buffers: &GltfBuffers<'_>,
    crease_angle: CreaseAngle,
    mut remarks: ImportRemarks,
) -> Result<SceneParts> {
    let nodes = hierarchy::flatten_hierarchy(document, &mut remarks)?;
    let mut assembly = GltfAssembler {
        reader: AccessorReader { document, buffers },
        material_converter: MaterialConverter::new(document, TextureLoader::new(document, buffers)),
        primitives: HashMap::new(),
        world_by_node: nodes.iter().map(|placed_node| (placed_node.node, placed_node.world)).collect(),
        has_target_normals: false,
        crease_angle,
        names: HashSet::new(),
        shapes: Vec::new(),
        domains: Vec::new(),
        remarks,
    };
    let mut parent_domains: Vec<Option<ParentDomain>> = Vec::with_capacity(nodes.len());
    for placed_node in &nodes {
        let parent_domain = placed_node.parent.and_then(|parent| parent_domains[parent]);
        let parent_domain = parent_domain
            .map(|parent| ParentDomain { domain_from_node: parent.domain_from_node * placed_node.local, ..parent });
        let first_domain = assembly.add_node(placed_node, parent_domain);
        let first_domain = first_domain.map_err(|error| error.prefix_field(&format!("nodes[{}]", placed_node.node)))?;
        // The coordinates of a skinned domain are those of the world.
        let is_skinned = document.nodes[placed_node.node].skin.is_some();
        let domain_from_node = if is_skinned { placed_node.world } else { Matrix4::identity() };
        let node_domain = first_domain.map(|domain| ParentDomain { domain, domain_from_node });
        parent_domains.push(node_domain.or(parent_domain));
    }
    if assembly.domains.is_empty() {
        return Err(invalid("scenes", "a node with at least one primitive of triangles", "none"));
    }
    assembly.into_parts(name, buffers.is_strict())
}

impl GltfAssembler<'_> {
    /// Adds a domain for each primitive of the node's mesh and returns the index of the first.
    fn add_node(&mut self, placed_node: &PlacedNode, parent_domain: Option<ParentDomain>) -> Result<Option<usize>> {
        let document = self.reader.document;
        let node = &document.nodes[placed_node.node];
        let Some(mesh_index) = node.mesh else { return Ok(None) };
        let mesh = get_element(&document.meshes, mesh_index, "mesh")?;
        let weights = node.weights.as_ref().or(mesh.weights.as_ref());
        let joint_matrices = match node.skin {
            Some(skin) => {
                let world_of_node = |node| self.world_by_node.get(&node).copied();
                Some(skin::joint_matrices(self.reader, skin, world_of_node)?)
            }
            None => None,
        };
        // The node of a skinned mesh does not move it.
        let placement = if node.skin.is_some() { Matrix4::identity() } else { placed_node.world };
        to_transform(&placement)?;
        let parent_domain = parent_domain.filter(|_| node.skin.is_none());
        let attachment = parent_domain.map(|parent_domain| create_attachment(&parent_domain)).transpose()?;
        let first_domain = self.domains.len();
        // The node's first domain by rank. All domains of the node with the same rank share coordinates.
        let mut first_by_rank: HashMap<usize, usize> = HashMap::new();
        let name = self.unique_name(node.name.as_ref().or(mesh.name.as_ref()), placed_node.node);
        for (primitive_index, primitive) in mesh.primitives.iter().enumerate() {
            let target_count = primitive.targets.len();
            if let Some(weight_count) =
                weights.map(Vec::len).filter(|weight_count| target_count > 0 && *weight_count != target_count)
            {
                return Err(invalid("weights", format!("{target_count} (one per morph target)"), weight_count));
            }
            let add_primitive_location = |error: crate::error::Error| {
                error.prefix_field(&format!("meshes[{mesh_index}].primitives[{primitive_index}]"))
            };
            let key = PrimitiveKey { mesh: mesh_index, primitive: primitive_index, skin: node.skin };
            let loaded = self.load_primitive(key, joint_matrices.as_deref()).map_err(add_primitive_location)?;
            let Some(loaded) = loaded else { continue };
            if self.domains.len() == MAX_DOMAINS {
                return Err(invalid("domains", format!("at most {MAX_DOMAINS}"), MAX_DOMAINS + 1));
            }
            let rank = self.shapes[loaded.shape].modes.rank();
            let rest_q = weights.filter(|_| rank > 0).cloned().unwrap_or_default();
            self.reader.buffers.charge_budget(4 * rest_q.len() as u64)?;
            let first_of_rank = *first_by_rank.entry(rank).or_insert(self.domains.len());
            let mut domain = Domain {
                material: loaded.material,
                attachment: attachment.clone(),
                rest_q,
                shares_q_with: (rank > 0 && first_of_rank < self.domains.len()).then_some(first_of_rank),
                ..Domain::new(format!("{name}.{primitive_index}"), loaded.shape)
            };
            domain.set_placement(&placement);
            self.domains.push(domain);
        }
        Ok((self.domains.len() > first_domain).then_some(first_domain))
    }

    /// Returns the shape and material of a primitive, or `None` for points and lines. The first call for a primitive
    /// converts it.
    fn load_primitive(
        &mut self,
        key: PrimitiveKey,
        joint_matrices: Option<&[Matrix4<f64>]>,
    ) -> Result<Option<LoadedPrimitive>> {
        if let Some(loaded) = self.primitives.get(&key) {
            return Ok(*loaded);
        }
        let primitive = &self.reader.document.meshes[key.mesh].primitives[key.primitive];
        let options = PrimitiveOptions {
            uv_set: self.material_converter.uv_set(primitive.material)?,
            uv_transform: self.material_converter.uv_transform(primitive.material)?,
            repeats: self.material_converter.repeats(primitive.material)?,
            crease_angle: self.crease_angle,
            joint_matrices,
        };
        let loaded = match primitive::convert_primitive(self.reader, primitive, options, &mut self.remarks)? {
            None => None,
            Some(ConvertedPrimitive { mesh, origin, modes, colors, has_target_normals }) => {
                self.has_target_normals |= has_target_normals && modes.rank() > 0;
                let has_uvs = !mesh.corners().uvs.is_empty();
                let converter = &mut self.material_converter;
                let material = converter.material_index(primitive.material, has_uvs, &mut self.remarks)?;
                let (mesh, material) = converter.with_vertex_colors(material, mesh, colors, &mut self.remarks)?;
                self.shapes.push(Shape::new(mesh, modes)?.with_origin(origin));
                Some(LoadedPrimitive { shape: self.shapes.len() - 1, material })
            }
        };
        self.primitives.insert(key, loaded);
        Ok(loaded)
    }

    /// A unique name of a node: `preferred_name` if it is not empty and not used yet; otherwise it contains the index
    /// of the node.
    fn unique_name(&mut self, preferred_name: Option<&String>, node_index: usize) -> String {
        let preferred_name = preferred_name.map(|name| sanitize(name, 120)).filter(|name| !name.is_empty());
        let mut name = preferred_name.unwrap_or_else(|| format!("node {node_index}"));
        if self.names.contains(&name) {
            name = format!("{name} #{node_index}");
        }
        while !self.names.insert(name.clone()) {
            name.push('\'');
        }
        name
    }

    fn into_parts(mut self, name: &str, is_strict: bool) -> Result<SceneParts> {
        let has_materials = self.material_converter.has_materials();
        let mut parts = SceneParts {
            shapes: self.shapes,
            materials: self.material_converter.materials,
            textures: self.material_converter.texture_loader.textures,
            domains: self.domains,
            unit: Some(1.0),
            ..SceneParts::named(name)
        };
        if !has_materials {
            parts.look = Lighting::Studio.settings();
        }
        if self.has_target_normals {
            parts.deformation.normals = NormalMethod::Exact;
            self.remarks
                .add("normals of morph targets: exact normals of the deformed surface are drawn instead".into());
        }
        parts.remarks = self.remarks.into_list(is_strict)?;
        Ok(parts)
    }
}

fn create_attachment(parent_domain: &ParentDomain) -> Result<Attachment> {
    let frame = to_transform(&parent_domain.domain_from_node)?;
    // Without vertices, because morph targets do not move the frame of a node in glTF.
    Ok(Attachment { parent: parent_domain.domain, frame, vertices: vec![] })
}

fn to_transform(matrix: &Matrix4<f64>) -> Result<Transform> {
    Transform::new(Transform::from_matrix(matrix).0)
}
