//! Builds the domains of a scene, parents before children, from placed nodes and their meshes.

use std::collections::{HashMap, HashSet};

use nalgebra::Matrix4;

use super::accessor::AccessorReader;
use super::buffers::GltfBuffers;
use super::document::Document;
use super::get_element;
use super::hierarchy::{self, PlacedNode};
use super::material::MaterialConverter;
use super::primitive;
use super::texture::TextureLoader;
use super::warnings::{ImportWarnings, sanitize};
use crate::domain::{Attachment, Domain, Shape, Transform};
use crate::error::{Result, invalid};
use crate::scene::{MAX_DOMAINS, SceneParts};

/// The nearest domain at or above a node, which becomes the parent of domains below.
#[derive(Debug, Clone, Copy)]
struct ParentDomain {
    domain: usize,
    domain_from_node: Matrix4<f64>,
}

/// The converted primitive of a mesh, shared by all instances of the mesh.
#[derive(Debug, Clone, Copy)]
struct LoadedPrimitive {
    shape: usize,
    material: usize,
}

#[derive(Debug)]
struct GltfAssembler<'a> {
    reader: AccessorReader<'a>,
    material_converter: MaterialConverter<'a>,
    made: HashMap<(usize, usize), Option<LoadedPrimitive>>,
    names: HashSet<String>,
    shapes: Vec<Shape>,
    domains: Vec<Domain>,
    remarks: ImportWarnings,
}

/// Builds all domains of the document's default scene.
///
/// # Errors
/// `Invalid` with the place in the document.
pub(super) fn assemble(
    name: &str,
    document: &Document,
    bytes: &GltfBuffers<'_>,
    mut remarks: ImportWarnings,
) -> Result<SceneParts> {
    let nodes = hierarchy::flatten_hierarchy(document, &mut remarks)?;
    let mut assembly = GltfAssembler {
        reader: AccessorReader { document, bytes },
        material_converter: MaterialConverter::new(document, TextureLoader::new(document, bytes)),
        made: HashMap::new(),
        names: HashSet::new(),
        shapes: Vec::new(),
        domains: Vec::new(),
        remarks,
    };
    let mut carriers: Vec<Option<ParentDomain>> = Vec::with_capacity(nodes.len());
    for placed in &nodes {
        let above = placed.parent.and_then(|parent| carriers[parent]);
        let above =
            above.map(|above| ParentDomain { domain_from_node: above.domain_from_node * placed.local, ..above });
        let first = assembly.add_node(placed, above);
        let first = first.map_err(|error| error.prefix_field(&format!("nodes[{}]", placed.node)))?;
        let own = first.map(|domain| ParentDomain { domain, domain_from_node: Matrix4::identity() });
        carriers.push(own.or(above));
    }
    if assembly.domains.is_empty() {
        return Err(invalid("scenes", "a node with at least one primitive of triangles", "none"));
    }
    Ok(assembly.into_parts(name))
}

impl GltfAssembler<'_> {
    /// Adds a domain for each primitive of the node's mesh and returns the index of the first.
    fn add_node(&mut self, placed: &PlacedNode, above: Option<ParentDomain>) -> Result<Option<usize>> {
        let document = self.reader.document;
        let node = &document.nodes[placed.node];
        let Some(mesh_index) = node.mesh else { return Ok(None) };
        let mesh = get_element(&document.meshes, mesh_index, "mesh")?;
        let weights = node.weights.as_ref().or(mesh.weights.as_ref());
        let placement = transform(&placed.world)?;
        let attachment = above.map(|above| attach(&above)).transpose()?;
        let first = self.domains.len();
        // The node's first domain of each rank. The node's other domains of this rank share its coordinates.
        let mut twins: HashMap<usize, usize> = HashMap::new();
        let name = self.name(node.name.as_ref().or(mesh.name.as_ref()), placed.node);
        for (flatten_hierarchy, primitive) in mesh.primitives.iter().enumerate() {
            let targets = primitive.targets.len();
            if let Some(given) = weights.map(Vec::len).filter(|given| targets > 0 && *given != targets) {
                return Err(invalid("weights", format!("{targets}, one per morph target"), given));
            }
            let within = |error: crate::error::Error| {
                error.prefix_field(&format!("meshes[{mesh_index}].primitives[{flatten_hierarchy}]"))
            };
            let Some(made) = self.load_primitive(mesh_index, flatten_hierarchy).map_err(within)? else { continue };
            if self.domains.len() == MAX_DOMAINS {
                return Err(invalid("domains", format!("at most {MAX_DOMAINS}"), "more"));
            }
            let rank = self.shapes[made.shape].modes.rank();
            let rest_q = weights.filter(|_| rank > 0).cloned().unwrap_or_default();
            self.reader.bytes.charge_budget(4 * rest_q.len() as u64)?;
            let twin = *twins.entry(rank).or_insert(self.domains.len());
            self.domains.push(Domain {
                material: made.material,
                placement,
                attachment: attachment.clone(),
                rest_q,
                shares_q_with: (rank > 0 && twin < self.domains.len()).then_some(twin),
                ..Domain::new(format!("{name}.{flatten_hierarchy}"), made.shape)
            });
        }
        Ok((self.domains.len() > first).then_some(first))
    }

    /// The shape and material of a primitive, converted on first use; `None` for points and lines.
    fn load_primitive(&mut self, mesh: usize, flatten_hierarchy: usize) -> Result<Option<LoadedPrimitive>> {
        if let Some(made) = self.made.get(&(mesh, flatten_hierarchy)) {
            return Ok(*made);
        }
        let primitive = &self.reader.document.meshes[mesh].primitives[flatten_hierarchy];
        let uv_set = self.material_converter.uv_set(primitive.material)?;
        let made = match primitive::shape(self.reader, primitive, uv_set, &mut self.remarks)? {
            None => None,
            Some(shape) => {
                let has_uvs = !shape.mesh.corners().uvs.is_empty();
                let material =
                    self.material_converter.material_index(primitive.material, has_uvs, &mut self.remarks)?;
                self.shapes.push(shape);
                Some(LoadedPrimitive { shape: self.shapes.len() - 1, material })
            }
        };
        self.made.insert((mesh, flatten_hierarchy), made);
        Ok(made)
    }

    /// The name of the node or else of its mesh, made unique by the node's index.
    fn name(&mut self, given: Option<&String>, index: usize) -> String {
        let given = given.map(|name| sanitize(name, 120)).filter(|name| !name.is_empty());
        let mut name = given.unwrap_or_else(|| format!("node {index}"));
        if self.names.contains(&name) {
            name = format!("{name} #{index}");
        }
        while !self.names.insert(name.clone()) {
            name.push('\'');
        }
        name
    }

    fn into_parts(self, name: &str) -> SceneParts {
        SceneParts {
            shapes: self.shapes,
            materials: self.material_converter.materials,
            textures: self.material_converter.texture_loader.textures,
            domains: self.domains,
            remarks: self.remarks.into_list(),
            ..SceneParts::named(name)
        }
    }
}

fn attach(above: &ParentDomain) -> Result<Attachment> {
    let frame = transform(&above.domain_from_node)?;
    // A node is attached to its parent's frame, which morph targets do not move.
    Ok(Attachment { parent: above.domain, frame, rows: vec![] })
}

fn transform(matrix: &Matrix4<f64>) -> Result<Transform> {
    Transform::new(Transform::from_matrix(matrix).0)
}
