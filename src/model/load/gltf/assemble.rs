//! Builds the domains of a scene, parents before children, from placed nodes and their meshes.

use std::collections::{HashMap, HashSet};

use nalgebra::Matrix4;

use super::accessor::Reader;
use super::at;
use super::bytes::Bytes;
use super::document::Document;
use super::hierarchy::{self, Placed};
use super::material::Palette;
use super::primitive;
use super::remarks::{Remarks, tidy};
use super::texture::Gallery;
use crate::domain::{Attachment, Domain, Metadata, Shape, Transform};
use crate::error::{Result, invalid};
use crate::scene::{MAX_DOMAINS, Parts};

/// The nearest domain at or above a node, which becomes the parent of domains below.
#[derive(Debug, Clone, Copy)]
struct Carrier {
    domain: usize,
    carrier_from_node: Matrix4<f64>,
}

/// The converted primitive of a mesh, shared by all instances of the mesh.
#[derive(Debug, Clone, Copy)]
struct Made {
    shape: usize,
    material: usize,
}

#[derive(Debug)]
struct Assembly<'a> {
    reader: Reader<'a>,
    palette: Palette<'a>,
    made: HashMap<(usize, usize), Option<Made>>,
    names: HashSet<String>,
    shapes: Vec<Shape>,
    domains: Vec<Domain>,
    remarks: Remarks,
}

/// Builds all domains of the document's default scene.
///
/// # Errors
/// `Invalid` with the place in the document.
pub(super) fn assemble(name: &str, document: &Document, bytes: &Bytes<'_>, mut remarks: Remarks) -> Result<Parts> {
    let nodes = hierarchy::place(document, &mut remarks)?;
    let mut assembly = Assembly {
        reader: Reader { document, bytes },
        palette: Palette::new(document, Gallery::new(document, bytes)),
        made: HashMap::new(),
        names: HashSet::new(),
        shapes: Vec::new(),
        domains: Vec::new(),
        remarks,
    };
    let mut carriers: Vec<Option<Carrier>> = Vec::with_capacity(nodes.len());
    for placed in &nodes {
        let above = placed.parent.and_then(|parent| carriers[parent]);
        let above = above.map(|above| Carrier { carrier_from_node: above.carrier_from_node * placed.local, ..above });
        let first = assembly.add_node(placed, above);
        let first = first.map_err(|error| error.within(&format!("nodes[{}]", placed.node)))?;
        let own = first.map(|domain| Carrier { domain, carrier_from_node: Matrix4::identity() });
        carriers.push(own.or(above));
    }
    if assembly.domains.is_empty() {
        return Err(invalid("scenes", "a node with at least one primitive of triangles", "none"));
    }
    Ok(assembly.into_parts(name))
}

impl Assembly<'_> {
    /// Adds a domain for each primitive of the node's mesh and returns the index of the first.
    fn add_node(&mut self, placed: &Placed, above: Option<Carrier>) -> Result<Option<usize>> {
        let document = self.reader.document;
        let node = &document.nodes[placed.node];
        let Some(mesh_index) = node.mesh else { return Ok(None) };
        let mesh = at(&document.meshes, mesh_index, "mesh")?;
        let weights = node.weights.as_ref().or(mesh.weights.as_ref());
        let placement = transform(&placed.world)?;
        let attachment = above.map(|above| attach(&above)).transpose()?;
        let first = self.domains.len();
        // The node's first domain of each rank. The node's other domains of this rank share its coordinates.
        let mut twins: HashMap<usize, usize> = HashMap::new();
        let name = self.name(node.name.as_ref().or(mesh.name.as_ref()), placed.node);
        for (place, primitive) in mesh.primitives.iter().enumerate() {
            let targets = primitive.targets.len();
            if let Some(given) = weights.map(Vec::len).filter(|given| targets > 0 && *given != targets) {
                return Err(invalid("weights", format!("{targets}, one per morph target"), given));
            }
            let within =
                |error: crate::error::Error| error.within(&format!("meshes[{mesh_index}].primitives[{place}]"));
            let Some(made) = self.make(mesh_index, place).map_err(within)? else { continue };
            if self.domains.len() == MAX_DOMAINS {
                return Err(invalid("domains", format!("at most {MAX_DOMAINS}"), "more"));
            }
            let rank = self.shapes[made.shape].modes.rank();
            let rest_q = weights.filter(|_| rank > 0).cloned().unwrap_or_default();
            self.reader.bytes.spend(4 * rest_q.len() as u64)?;
            let twin = *twins.entry(rank).or_insert(self.domains.len());
            self.domains.push(Domain {
                name: format!("{name}.{place}"),
                shape: made.shape,
                material: made.material,
                runs: vec![],
                placement,
                attachment: attachment.clone(),
                follows: None,
                rest_q,
                shares_q_with: (rank > 0 && twin < self.domains.len()).then_some(twin),
                metadata: Metadata::default(),
            });
        }
        Ok((self.domains.len() > first).then_some(first))
    }

    /// The shape and material of a primitive, converted on first use; `None` for points and lines.
    fn make(&mut self, mesh: usize, place: usize) -> Result<Option<Made>> {
        if let Some(made) = self.made.get(&(mesh, place)) {
            return Ok(*made);
        }
        let primitive = &self.reader.document.meshes[mesh].primitives[place];
        let uv_set = self.palette.uv_set(primitive.material)?;
        let made = match primitive::shape(self.reader, primitive, uv_set, &mut self.remarks)? {
            None => None,
            Some(shape) => {
                let has_uvs = !shape.mesh.corners().uvs.is_empty();
                let material = self.palette.mix(primitive.material, has_uvs, &mut self.remarks)?;
                self.shapes.push(shape);
                Some(Made { shape: self.shapes.len() - 1, material })
            }
        };
        self.made.insert((mesh, place), made);
        Ok(made)
    }

    /// The name of the node or else of its mesh, made unique by the node's index.
    fn name(&mut self, given: Option<&String>, index: usize) -> String {
        let given = given.map(|name| tidy(name, 120)).filter(|name| !name.is_empty());
        let mut name = given.unwrap_or_else(|| format!("node {index}"));
        if self.names.contains(&name) {
            name = format!("{name} #{index}");
        }
        while !self.names.insert(name.clone()) {
            name.push('\'');
        }
        name
    }

    fn into_parts(self, name: &str) -> Parts {
        Parts {
            shapes: self.shapes,
            materials: self.palette.materials,
            textures: self.palette.gallery.textures,
            domains: self.domains,
            remarks: self.remarks.into_list(),
            ..Parts::named(name)
        }
    }
}

fn attach(above: &Carrier) -> Result<Attachment> {
    let frame = transform(&above.carrier_from_node)?;
    // A node is attached to its parent's frame, which morph targets do not move.
    Ok(Attachment { parent: above.domain, frame, rows: vec![] })
}

fn transform(matrix: &Matrix4<f64>) -> Result<Transform> {
    Transform::new(Transform::from_matrix(matrix).0)
}
