//! Scene descriptions and rows of U. Arrays are assembled from chunks. Their lengths are checked against the counts in
//! the description.

use std::collections::BTreeMap;

use bytes::Bytes;
use modalcast_proto::v1;

use crate::assemble::{Assembler, Chunk, decode};
use crate::client::Client;
use crate::error::{Error, Result, malformed_reply};

/// The arrays of a domain that [`Client::describe`] can fetch.
pub use modalcast_proto::v1::Array as DomainArray;

/// The attachment of a domain to its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Attachment {
    pub parent: usize,
    /// `parent_from_child` at rest, row-major 3x4.
    pub parent_from_child: [f32; 12],
    /// Vertices of the parent whose displacement moves the child; empty on a rigid parent.
    pub parent_vertices: Vec<u32>,
}

/// The domain whose transform a domain follows.
#[derive(Debug, Clone, PartialEq)]
pub struct Follow {
    /// Index of the followed domain.
    pub leader: usize,
    /// The transform of the follower is that of the leader times this one, row-major 3x4.
    pub leader_from_follower: [f32; 12],
}

/// One domain: n vertices, r modes, and arrays. Arrays that were not requested are empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Domain {
    pub index: usize,
    pub name: String,
    /// n, the number of vertices: U has 3n rows.
    pub vertex_count: usize,
    /// r, the number of modes: U has r columns.
    pub rank: usize,
    /// Number of corners. A corner is a vertex with one normal and one pair of texture coordinates; a vertex may have
    /// several corners.
    pub corner_count: usize,
    pub triangle_count: usize,
    pub attachment: Option<Attachment>,
    /// Steps must not contain a transform of a domain that follows another one.
    pub follow: Option<Follow>,
    /// `world_from_domain` at rest, row-major 3x4.
    pub placement: [f32; 12],
    /// A domain with a smaller index, with which this domain shares its coordinates.
    pub shares_q_with: Option<usize>,
    /// Identifies the mesh and U; instances of one shape have the same value.
    pub shape: usize,
    /// (rad/s)^2, one per mode; empty when unknown.
    pub eigenvalues: Vec<f64>,
    /// Free-form metadata of the scene's author, by name.
    pub notes: BTreeMap<String, String>,
    /// Corner indices, three per triangle.
    pub indices: Vec<u32>,
    /// Vertex of each corner. Vertex v has the rows 3v, 3v + 1 and 3v + 2 of U.
    pub corner_vertices: Vec<u32>,
    /// Three numbers per vertex, in the frame of the domain.
    pub rest_positions: Vec<f32>,
    /// Texture coordinates, two per corner.
    pub uvs: Vec<f32>,
    /// Three numbers per corner, in the frame of the domain.
    pub rest_normals: Vec<f32>,
}

/// A scene and its domains.
#[derive(Debug, Clone, PartialEq)]
pub struct SceneDescription {
    pub info: v1::SceneInfo,
    pub domains: Vec<Domain>,
}

/// Selected rows of U: three rows of r entries for each requested vertex.
#[derive(Debug, Clone, PartialEq)]
pub struct ModeRows {
    pub rank: usize,
    /// 3 x r entries per requested vertex, row-major.
    pub rows: Vec<f32>,
}

impl ModeRows {
    /// The three rows of one requested vertex, r entries each; empty if r is 0. `ordinal` is the vertex's position in
    /// the request. `None` if fewer vertices were requested.
    pub fn rows_of(&self, ordinal: usize) -> Option<&[f32]> {
        let start = ordinal.checked_mul(3 * self.rank)?;
        self.rows.get(start..)?.get(..3 * self.rank)
    }
}

impl Client {
    /// Gets the description of all domains of a scene, with the requested arrays.
    ///
    /// # Errors
    /// `Status` if the scene does not exist; `Malformed` if lengths and counts contradict each other.
    pub async fn describe(&self, scene: &str, arrays: &[DomainArray]) -> Result<SceneDescription> {
        self.describe_domains(scene, &[], arrays).await
    }

    /// As [`Self::describe`], for selected domain indices; an empty list selects all.
    ///
    /// # Errors
    /// As [`Self::describe`].
    pub async fn describe_domains(
        &self,
        scene: &str,
        domains: &[u32],
        arrays: &[DomainArray],
    ) -> Result<SceneDescription> {
        let request = v1::DescribeSceneRequest {
            scene: scene.to_owned(),
            domains: domains.to_vec(),
            arrays: arrays.iter().map(|array| *array as i32).collect(),
        };
        let mut messages = self.replies(self.scenes().describe_scene(request).await)?;
        let mut builder = DescriptionBuilder::new(self.max_reply_bytes);
        while let Some(message) = messages.next().await? {
            builder.add_message(message)?;
        }
        builder.finish(arrays)
    }

    /// Gets the rows of U of selected vertices of a domain; an empty list selects all.
    ///
    /// # Errors
    /// `Status` if the scene, the domain or a vertex does not exist; `Malformed` if the reply does not have 3 r
    /// numbers per vertex.
    pub async fn read_modes(&self, scene: &str, domain: usize, vertices: &[u32]) -> Result<ModeRows> {
        // No scene has a domain u32::MAX, so the server rejects this index.
        let domain = u32::try_from(domain).unwrap_or(u32::MAX);
        let request = v1::ReadModesRequest { scene: scene.to_owned(), domain, vertices: vertices.to_vec() };
        let mut messages = self.replies(self.scenes().read_modes(request).await)?;
        let mut assembler = Assembler::new("modes", self.max_reply_bytes);
        let mut complete_reply = None;
        while let Some(message) = messages.next().await? {
            // Every message has the rank and the total. The assembler expects them on the first chunk only.
            let head = (!assembler.is_open()).then_some((message.rank, message.total));
            let reply = assembler.push(Chunk { head, offset: message.offset, data: message.data })?;
            complete_reply = reply.or(complete_reply);
        }
        if assembler.is_open() {
            return Err(Error::StreamEnded { awaited_reply: "the last chunk of the modes" });
        }
        // U of a rigid domain is empty, and the server may then send no message.
        let (rank, bytes) = complete_reply.unwrap_or((0, Bytes::new()));
        // Three rows of `rank` f32.
        let vertex_bytes = 12 * u64::from(rank);
        let expected_bytes = vertex_bytes.saturating_mul(vertices.len() as u64);
        if !vertices.is_empty() && bytes.len() as u64 != expected_bytes {
            return Err(malformed_reply("modes.total", format!("{expected_bytes} bytes"), bytes.len()));
        }
        // With a rank of 0, only an empty reply passes: 0 is the only multiple of 0.
        if !(bytes.len() as u64).is_multiple_of(vertex_bytes) {
            return Err(malformed_reply("modes.total", format!("a multiple of {vertex_bytes} bytes"), bytes.len()));
        }
        Ok(ModeRows { rank: rank as usize, rows: decode("modes.data", &bytes)? })
    }
}

/// Identifies an array of a description.
#[derive(Clone, Copy, PartialEq)]
struct ArrayKey {
    domain: u32,
    /// A value of [`DomainArray`], or an unknown number.
    array: i32,
}

impl std::fmt::Display for ArrayKey {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match DomainArray::try_from(self.array) {
            Ok(array) => write!(out, "{} of domain {}", array.as_str_name(), self.domain),
            Err(_) => write!(out, "array {} of domain {}", self.array, self.domain),
        }
    }
}

/// An array whose last chunk has not been received.
struct PartialArray {
    key: ArrayKey,
    assembler: Assembler<()>,
}

/// Assembles a description from its messages.
struct DescriptionBuilder {
    /// Maximum size of all arrays together, in bytes.
    limit: u64,
    received_bytes: u64,
    info: Option<v1::SceneInfo>,
    domains: Vec<Domain>,
    /// From a domain's index in the scene to its index in `domains`.
    domain_ordinals: BTreeMap<u32, usize>,
    partial_array: Option<PartialArray>,
}

impl DescriptionBuilder {
    const fn new(limit: u64) -> Self {
        let domain_ordinals = BTreeMap::new();
        Self { limit, received_bytes: 0, info: None, domains: vec![], domain_ordinals, partial_array: None }
    }

    fn add_message(&mut self, message: v1::DescribeSceneResponse) -> Result<()> {
        use v1::describe_scene_response::Part;
        match message.part {
            Some(Part::Scene(info)) => self.info = Some(info),
            Some(Part::Domains(list)) => {
                for wire in list.domains {
                    self.domain_ordinals.insert(wire.domain, self.domains.len());
                    self.domains.push(decode_domain(wire)?);
                }
            }
            Some(Part::Chunk(chunk)) => self.add_chunk(chunk)?,
            None => return Err(malformed_reply("describe.part", "a part", "none")),
        }
        Ok(())
    }

    /// Adds a chunk of an array. The chunks of one array are consecutive.
    fn add_chunk(&mut self, chunk: v1::ArrayChunk) -> Result<()> {
        let key = ArrayKey { domain: chunk.domain, array: chunk.array };
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
        const FIELD: &str = "describe.chunk.data";
        self.received_bytes = self.received_bytes.saturating_add(bytes.len() as u64);
        if self.received_bytes > self.limit {
            let expected = format!("at most {} bytes of arrays", self.limit);
            return Err(malformed_reply("describe.chunk", expected, self.received_bytes));
        }
        let ordinal = self.domain_ordinals.get(&key.domain);
        let Some(domain) = ordinal.and_then(|ordinal| self.domains.get_mut(*ordinal)) else {
            return Err(malformed_reply("describe.chunk.domain", "a domain described before", key.domain));
        };
        match DomainArray::try_from(key.array) {
            Ok(DomainArray::Indices) => domain.indices = decode(FIELD, bytes)?,
            Ok(DomainArray::CornerVertices) => domain.corner_vertices = decode(FIELD, bytes)?,
            Ok(DomainArray::RestPositions) => domain.rest_positions = decode(FIELD, bytes)?,
            Ok(DomainArray::Uvs) => domain.uvs = decode(FIELD, bytes)?,
            Ok(DomainArray::RestNormals) => domain.rest_normals = decode(FIELD, bytes)?,
            _ => return Err(malformed_reply("describe.chunk.array", "a known array", key.array)),
        }
        Ok(())
    }

    fn finish(self, arrays: &[DomainArray]) -> Result<SceneDescription> {
        if self.partial_array.is_some() {
            return Err(Error::StreamEnded { awaited_reply: "the last chunk of an array" });
        }
        let info = self.info.ok_or_else(|| malformed_reply("describe.scene", "a scene", "none"))?;
        for domain in &self.domains {
            for array in arrays {
                domain.check_array(*array)?;
            }
        }
        Ok(SceneDescription { info, domains: self.domains })
    }
}

impl Domain {
    /// Checks that a requested array has the length given by the counts, and that its indices are within range.
    fn check_array(&self, array: DomainArray) -> Result<()> {
        let (length, expected_length) = match array {
            DomainArray::Indices => (self.indices.len(), 3 * self.triangle_count),
            DomainArray::CornerVertices => (self.corner_vertices.len(), self.corner_count),
            DomainArray::RestPositions => (self.rest_positions.len(), 3 * self.vertex_count),
            DomainArray::RestNormals => (self.rest_normals.len(), 3 * self.corner_count),
            // Texture coordinates are optional.
            DomainArray::Uvs if self.uvs.is_empty() => (0, 0),
            DomainArray::Uvs => (self.uvs.len(), 2 * self.corner_count),
            DomainArray::Unspecified => (0, 0),
        };
        let field = |name: &str| format!("domain '{}': {name}", self.name);
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

/// Converts a domain from its wire format.
fn decode_domain(wire: v1::DomainDescription) -> Result<Domain> {
    let decode_transform = |field: &str, bytes: &[u8]| {
        let error = |_| malformed_reply(format!("domain '{}': {field}", wire.name), "48 bytes", bytes.len());
        bytemuck::try_pod_read_unaligned::<[f32; 12]>(bytes).map_err(error)
    };
    let attachment = match wire.parent {
        None => None,
        Some(parent) => Some(Attachment {
            parent: parent as usize,
            parent_from_child: decode_transform("attachment_frame", &wire.attachment_frame)?,
            parent_vertices: wire.attachment_vertices.clone(),
        }),
    };
    let follow = match wire.follows {
        None => None,
        Some(leader) => Some(Follow {
            leader: leader as usize,
            leader_from_follower: decode_transform("follow_frame", &wire.follow_frame)?,
        }),
    };
    if !wire.eigenvalues.is_empty() && wire.eigenvalues.len() != wire.rank as usize {
        let field = format!("domain '{}': eigenvalues", wire.name);
        return Err(malformed_reply(field, format!("none or {}", wire.rank), wire.eigenvalues.len()));
    }
    Ok(Domain {
        index: wire.domain as usize,
        placement: decode_transform("placement", &wire.placement)?,
        attachment,
        follow,
        vertex_count: wire.vertices as usize,
        rank: wire.rank as usize,
        corner_count: wire.corners as usize,
        triangle_count: wire.triangles as usize,
        shares_q_with: wire.shares_q_with.map(|owner| owner as usize),
        shape: wire.shape as usize,
        name: wire.name,
        eigenvalues: wire.eigenvalues,
        notes: wire.notes.into_iter().collect(),
        ..Domain::default()
    })
}
