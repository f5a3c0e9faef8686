//! Decodes scene descriptions. Arrays are assembled from chunks. Counts, lengths and indices are checked, so that users
//! of a [`SceneDescription`] can index without checks.

use std::collections::HashMap;

use modalcast_proto::v1;

use crate::assemble::{Assembler, Chunk, decode};
use crate::content::ContentHash;
use crate::error::{Error, Result, malformed_reply};
use crate::scene::{
    Attachment, Domain, Follow, Inertia, Material, MaterialRange, SceneDescription, Shape, ShapeArray, Texture,
};

/// Identifies an array of a description.
#[derive(Clone, Copy, PartialEq)]
struct ArrayKey {
    /// Index of the shape in the scene.
    shape: u32,
    /// A value of [`ShapeArray`], or an unknown number.
    array: i32,
}

impl std::fmt::Display for ArrayKey {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match ShapeArray::try_from(self.array) {
            Ok(array) => write!(out, "{} of shape {}", array.as_str_name(), self.shape),
            Err(_) => write!(out, "array {} of shape {}", self.array, self.shape),
        }
    }
}

/// An array whose last chunk has not been received.
struct PartialArray {
    key: ArrayKey,
    assembler: Assembler<()>,
}

/// From an index in the scene to the index in a list of the description.
type Ordinals = HashMap<u32, usize>;

/// Assembles a description from its messages.
pub(crate) struct DescriptionBuilder {
    /// Maximum size of all arrays together, in bytes.
    limit: u64,
    received_bytes: u64,
    info: Option<v1::SceneInfo>,
    shapes: Vec<Shape>,
    shape_eigenvalues: Vec<Vec<f64>>,
    shape_ordinals: Ordinals,
    materials: Vec<v1::MaterialDescription>,
    material_ordinals: Ordinals,
    textures: Vec<Texture>,
    texture_ordinals: Ordinals,
    domains: Vec<Domain>,
    partial_array: Option<PartialArray>,
}

impl DescriptionBuilder {
    pub(crate) fn new(limit: u64) -> Self {
        Self {
            limit,
            received_bytes: 0,
            info: None,
            shapes: vec![],
            shape_eigenvalues: vec![],
            shape_ordinals: Ordinals::new(),
            materials: vec![],
            material_ordinals: Ordinals::new(),
            textures: vec![],
            texture_ordinals: Ordinals::new(),
            domains: vec![],
            partial_array: None,
        }
    }

    pub(crate) fn add_message(&mut self, message: v1::DescribeSceneResponse) -> Result<()> {
        use v1::describe_scene_response::Part;
        match message.part {
            Some(Part::Scene(info)) => self.info = Some(info),
            Some(Part::Shapes(list)) => list.shapes.into_iter().try_for_each(|wire| self.add_shape(wire))?,
            Some(Part::Materials(list)) => {
                for wire in list.materials {
                    self.material_ordinals.insert(wire.material, self.materials.len());
                    self.materials.push(wire);
                }
            }
            Some(Part::Textures(list)) => {
                for wire in list.textures {
                    self.texture_ordinals.insert(wire.texture, self.textures.len());
                    self.textures.push(decode_texture(wire)?);
                }
            }
            Some(Part::Domains(list)) => list.domains.into_iter().try_for_each(|wire| self.add_domain(wire))?,
            Some(Part::Chunk(chunk)) => self.add_chunk(chunk)?,
            None => return Err(malformed_reply("describe.part", "a part", "none")),
        }
        Ok(())
    }

    fn add_shape(&mut self, wire: v1::ShapeDescription) -> Result<()> {
        check_eigenvalues(&format!("shape {}", wire.shape), &wire.eigenvalues, wire.rank as usize)?;
        let mut hashes = vec![];
        for array in wire.arrays.iter().filter(|array| !array.sha256.is_empty()) {
            hashes.push((array.array(), decode_hash(&array.sha256)?));
        }
        self.shape_ordinals.insert(wire.shape, self.shapes.len());
        self.shape_eigenvalues.push(wire.eigenvalues);
        self.shapes.push(Shape {
            index: wire.shape as usize,
            vertex_count: wire.vertices as usize,
            rank: wire.rank as usize,
            corner_count: wire.corners as usize,
            triangle_count: wire.triangles as usize,
            hashes,
            origin: decode_numbers(format!("shape {}: origin", wire.shape), &wire.origin)?.unwrap_or_default(),
            ..Shape::default()
        });
        Ok(())
    }

    fn add_domain(&mut self, wire: v1::DomainDescription) -> Result<()> {
        let field = |name: &str| format!("domain '{}': {name}", wire.name);
        let shape = find_ordinal(&self.shape_ordinals, wire.shape, field("shape"))?;
        let rank = self.shapes[shape].rank;
        let eigenvalues = match wire.eigenvalues {
            Some(own) => own.values,
            None => self.shape_eigenvalues[shape].clone(),
        };
        check_eigenvalues(&field("eigenvalues"), &eigenvalues, rank)?;
        let inertia = match wire.inertia {
            None => None,
            Some(inertia) => Some(decode_inertia(&field("inertia"), inertia, rank)?),
        };
        let rest_q: Vec<f32> = decode("rest_q", &wire.rest_q)?;
        if !rest_q.is_empty() && rest_q.len() != rank {
            return Err(malformed_reply(field("rest_q"), format!("none or {rank} numbers"), rest_q.len()));
        }
        let attachment = match wire.parent {
            None => None,
            Some(parent) => Some(Attachment {
                parent: parent as usize,
                parent_from_child: decode_transform(field("attachment_frame"), &wire.attachment_frame)?,
                parent_vertices: wire.attachment_vertices.clone(),
            }),
        };
        // A follow frame that equals the attachment frame is not sent.
        let follow_frame = if wire.follow_frame.is_empty() { &wire.attachment_frame } else { &wire.follow_frame };
        let follow = match wire.follows {
            None => None,
            Some(leader) => Some(Follow {
                leader: leader as usize,
                leader_from_follower: decode_transform(field("follow_frame"), follow_frame)?,
            }),
        };
        let find_material = |material| find_ordinal(&self.material_ordinals, material, field("material"));
        let decode_range = |range: &v1::MaterialRange| {
            let first_triangle = range.first_triangle as usize;
            Ok(MaterialRange { first_triangle, material: find_material(range.material)? })
        };
        let material_ranges = wire.material_ranges.iter().map(decode_range).collect::<Result<Vec<_>>>()?;
        let material = match material_ranges.first() {
            Some(range) => range.material,
            None => find_material(wire.material)?,
        };
        let placement = decode_transform(field("placement"), &wire.placement)?;
        let exact_placement = decode_numbers(field("exact_placement"), &wire.exact_placement)?;
        self.domains.push(Domain {
            index: wire.domain as usize,
            shape,
            rank,
            material,
            material_ranges,
            placement,
            exact_placement: exact_placement.unwrap_or_else(|| placement.map(f64::from)),
            attachment,
            follow,
            rest_q,
            shares_q_with: wire.shares_q_with.map(|owner| owner as usize),
            eigenvalues,
            inertia,
            name: wire.name,
            notes: wire.notes.into_iter().collect(),
        });
        Ok(())
    }

    /// Adds a chunk of an array. The chunks of one array are consecutive.
    fn add_chunk(&mut self, chunk: v1::ArrayChunk) -> Result<()> {
        let key = ArrayKey { shape: chunk.shape, array: chunk.array };
        let mut assembler = match self.partial_array.take() {
            Some(partial) if partial.key == key => partial.assembler,
            Some(partial) => {
                return Err(malformed_reply("describe.chunk", format!("the next chunk of {}", partial.key), key));
            }
            None => Assembler::new("describe.chunk", self.limit),
        };
        let head = (!assembler.is_open()).then_some(((), chunk.total));
        match assembler.push(Chunk { head, offset: chunk.offset, data: chunk.data })? {
            None => self.partial_array = Some(PartialArray { key, assembler }),
            Some(((), bytes)) => self.store_array(key, &bytes)?,
        }
        Ok(())
    }

    fn store_array(&mut self, key: ArrayKey, bytes: &[u8]) -> Result<()> {
        self.received_bytes = self.received_bytes.saturating_add(bytes.len() as u64);
        if self.received_bytes > self.limit {
            let expected = format!("at most {} bytes of arrays", self.limit);
            return Err(malformed_reply("describe.chunk", expected, self.received_bytes));
        }
        let shape = find_ordinal(&self.shape_ordinals, key.shape, "describe.chunk.shape".into())?;
        match ShapeArray::try_from(key.array) {
            Ok(array) => self.shapes[shape].set_array(array, bytes),
            Err(_) => Err(malformed_reply("describe.chunk.array", "a known array", key.array)),
        }
    }

    pub(crate) fn finish(self) -> Result<SceneDescription> {
        if self.partial_array.is_some() {
            return Err(Error::StreamEnded { awaited_reply: "the last chunk of an array" });
        }
        let info = self.info.ok_or_else(|| malformed_reply("describe.scene", "a scene", "none"))?;
        let decode_material = |wire| decode_material(wire, &self.texture_ordinals);
        let materials = self.materials.into_iter().map(decode_material).collect::<Result<_>>()?;
        Ok(SceneDescription { info, shapes: self.shapes, materials, textures: self.textures, domains: self.domains })
    }
}

impl Shape {
    /// The hash of an array, if hashes were requested.
    pub fn hash_of(&self, array: ShapeArray) -> Option<ContentHash> {
        self.hashes.iter().find(|(candidate, _)| *candidate == array).map(|(_, hash)| *hash)
    }

    /// Whether the shape has an origin: f32 would round x0 too coarsely without one.
    pub fn has_origin(&self) -> bool {
        self.origin != [0.0; 3]
    }

    /// Rest positions that are exact relative to [`Self::origin`]: `centered_positions`, or without an origin
    /// `rest_positions`. A vertex is at A (v + U q) + (A c + t) for T = (A, t).
    pub fn local_positions(&self) -> &[f32] {
        if self.has_origin() { &self.centered_positions } else { &self.rest_positions }
    }

    /// Sets an array to the little-endian numbers in `bytes`. [`SceneDescription::check_arrays`] checks its length.
    ///
    /// # Errors
    /// `Malformed` if the bytes are no whole numbers.
    pub fn set_array(&mut self, array: ShapeArray, bytes: &[u8]) -> Result<()> {
        const FIELD: &str = "describe.chunk.data";
        match array {
            ShapeArray::Indices => self.indices = decode(FIELD, bytes)?,
            ShapeArray::CornerVertices => self.corner_vertices = decode(FIELD, bytes)?,
            ShapeArray::RestPositions => self.rest_positions = decode(FIELD, bytes)?,
            ShapeArray::Uvs => self.uvs = decode(FIELD, bytes)?,
            ShapeArray::RestNormals => self.rest_normals = decode(FIELD, bytes)?,
            ShapeArray::Modes => self.modes = decode(FIELD, bytes)?,
            ShapeArray::CenteredPositions => self.centered_positions = decode(FIELD, bytes)?,
            ShapeArray::Unspecified => return Err(malformed_reply("describe.chunk.array", "a known array", 0)),
        }
        Ok(())
    }

    /// Checks that a requested array has the length given by the counts, and that its indices are within range.
    fn check_array(&self, array: ShapeArray) -> Result<()> {
        let (length, expected_length) = match array {
            ShapeArray::Indices => (self.indices.len(), 3 * self.triangle_count),
            ShapeArray::CornerVertices => (self.corner_vertices.len(), self.corner_count),
            ShapeArray::RestPositions => (self.rest_positions.len(), 3 * self.vertex_count),
            ShapeArray::RestNormals => (self.rest_normals.len(), 3 * self.corner_count),
            // Texture coordinates are optional.
            ShapeArray::Uvs if self.uvs.is_empty() => (0, 0),
            ShapeArray::Uvs => (self.uvs.len(), 2 * self.corner_count),
            ShapeArray::Modes => (self.modes.len(), 3 * self.vertex_count * self.rank),
            ShapeArray::CenteredPositions if !self.has_origin() => (self.centered_positions.len(), 0),
            ShapeArray::CenteredPositions => (self.centered_positions.len(), 3 * self.vertex_count),
            ShapeArray::Unspecified => (0, 0),
        };
        let field = |name: &str| format!("shape {}: {name}", self.index);
        if length != expected_length {
            return Err(malformed_reply(field(array.as_str_name()), format!("{expected_length} numbers"), length));
        }
        for (name, indices, limit) in [
            ("indices", &self.indices, self.corner_count),
            ("corner_vertices", &self.corner_vertices, self.vertex_count),
        ] {
            if let Some(index) = indices.iter().find(|index| **index as usize >= limit) {
                return Err(malformed_reply(field(name), format!("indices below {limit}"), index));
            }
        }
        Ok(())
    }
}

impl SceneDescription {
    /// Decodes the messages of [`crate::Client::description_messages`]. Arrays have at most `max_bytes` bytes together.
    ///
    /// # Errors
    /// `Malformed` if lengths and counts contradict each other; `StreamEnded` if an array is incomplete.
    pub fn from_messages(
        messages: impl IntoIterator<Item = v1::DescribeSceneResponse>,
        max_bytes: u64,
    ) -> Result<Self> {
        let mut builder = DescriptionBuilder::new(max_bytes);
        messages.into_iter().try_for_each(|message| builder.add_message(message))?;
        builder.finish()
    }

    /// Checks that these arrays of all shapes have the lengths that the counts demand, and indices within range.
    ///
    /// # Errors
    /// `Malformed` with the name of the array.
    pub fn check_arrays(&self, arrays: &[ShapeArray]) -> Result<()> {
        self.shapes.iter().try_for_each(|shape| arrays.iter().try_for_each(|array| shape.check_array(*array)))
    }
}

/// The index, in a list of the description, of the object that has the index `index` in the scene.
fn find_ordinal(ordinals: &Ordinals, index: u32, field: String) -> Result<usize> {
    ordinals.get(&index).copied().ok_or_else(|| malformed_reply(field, "an index described before", index))
}

fn check_eigenvalues(field: &str, eigenvalues: &[f64], rank: usize) -> Result<()> {
    if !eigenvalues.is_empty() && eigenvalues.len() != rank {
        return Err(malformed_reply(field, format!("no eigenvalues or {rank}"), eigenvalues.len()));
    }
    Ok(())
}

fn decode_inertia(field: &str, wire: v1::Inertia, rank: usize) -> Result<Inertia> {
    let v1::Inertia { mass, center, moments, modal_momenta, modal_masses } = wire;
    let lengths = [("modal_momenta", modal_momenta.len(), 6 * rank), ("modal_masses", modal_masses.len(), rank * rank)];
    for (name, length, expected) in lengths {
        if length != expected {
            return Err(malformed_reply(format!("{field}.{name}"), format!("{expected} numbers"), length));
        }
    }
    Ok(Inertia {
        mass,
        center: decode_numbers(format!("{field}.center"), &center)?.unwrap_or_default(),
        moments: decode_numbers(format!("{field}.moments"), &moments)?.unwrap_or_default(),
        modal_momenta,
        modal_masses,
    })
}

fn decode_hash(bytes: &[u8]) -> Result<ContentHash> {
    bytes.try_into().map_err(|_| malformed_reply("describe.sha256", "32 bytes", bytes.len()))
}

/// A list of `N` numbers; `None` for an empty list.
fn decode_numbers<const N: usize>(field: String, numbers: &[f64]) -> Result<Option<[f64; N]>> {
    if numbers.is_empty() {
        return Ok(None);
    }
    let invalid = |_| malformed_reply(field, format!("none or {N} numbers"), numbers.len());
    numbers.try_into().map(Some).map_err(invalid)
}

fn decode_transform(field: String, bytes: &[u8]) -> Result<[f32; 12]> {
    bytemuck::try_pod_read_unaligned(bytes).map_err(|_| malformed_reply(field, "48 bytes", bytes.len()))
}

fn decode_texture(wire: v1::TextureDescription) -> Result<Texture> {
    let hash = if wire.sha256.is_empty() { None } else { Some(decode_hash(&wire.sha256)?) };
    Ok(Texture {
        index: wire.texture as usize,
        name: wire.name,
        width: wire.width,
        height: wire.height,
        hash,
        ..Texture::default()
    })
}

fn decode_material(wire: v1::MaterialDescription, textures: &Ordinals) -> Result<Material> {
    let field = |name: &str| format!("material '{}': {name}", wire.name);
    let color = |name: &str, numbers: &[f32]| {
        <[f32; 3]>::try_from(numbers).map_err(|_| malformed_reply(field(name), "3 numbers", numbers.len()))
    };
    let texture = |index: Option<u32>| index.map(|index| find_ordinal(textures, index, field("texture"))).transpose();
    Ok(Material {
        index: wire.material as usize,
        ambient: color("ambient", &wire.ambient)?,
        diffuse: color("diffuse", &wire.diffuse)?,
        specular: color("specular", &wire.specular)?,
        shininess: wire.shininess,
        alpha: wire.alpha,
        alpha_mode: wire.alpha_mode(),
        alpha_cutoff: wire.alpha_cutoff,
        double_sided: wire.double_sided,
        color_texture: texture(wire.color_texture)?,
        normal_texture: texture(wire.normal_texture)?,
        name: wire.name,
    })
}
