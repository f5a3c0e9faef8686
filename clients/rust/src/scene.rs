//! Scene descriptions and rows of U as owned values. Arrays are assembled from chunks and checked against the counts.

use std::collections::BTreeMap;

use bytes::Bytes;
use modalcast_proto::v1;

use crate::assemble::{Assembler, Chunk, decode};
use crate::client::Client;
use crate::error::{Error, Result, malformed_reply};

/// The arrays that [`Client::describe`] can fetch.
pub use modalcast_proto::v1::Array;

/// The attachment of a domain to its parent.
#[derive(Debug, Clone, PartialEq)]
pub struct Attachment {
    pub parent: usize,
    /// `parent_from_child` at rest, row-major 3x4.
    pub frame: [f32; 12],
    /// Vertices of the parent that carry the frame; empty on a rigid parent.
    pub rows: Vec<u32>,
}

/// One domain: n vertices, r modes, and the requested arrays (the others are empty).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Domain {
    pub index: usize,
    pub name: String,
    /// n: U has 3n rows.
    pub vertices: usize,
    /// r: U has r columns.
    pub rank: usize,
    pub corners: usize,
    pub triangles: usize,
    pub attachment: Option<Attachment>,
    /// `world_from_domain` at rest, row-major 3x4.
    pub placement: [f32; 12],
    /// A domain with a smaller index, with which this domain shares its coordinates.
    pub shares_q_with: Option<usize>,
    /// Identifies the mesh and U; instances of one shape have the same value.
    pub shape: usize,
    /// (rad/s)^2, one per mode; empty when unknown.
    pub eigenvalues: Vec<f64>,
    pub notes: BTreeMap<String, String>,
    /// Corner indices, three per triangle.
    pub indices: Vec<u32>,
    /// Vertex of each corner: rows 3v, 3v + 1, 3v + 2 of U.
    pub corner_vertices: Vec<u32>,
    /// Three per vertex.
    pub rest_positions: Vec<f32>,
    /// Two per corner.
    pub uvs: Vec<f32>,
    /// Three per corner.
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
    pub rows: Vec<f32>,
}

impl ModeRows {
    /// The 3 x r rows of the requested vertex with this ordinal, row-major; empty if r is 0. `None` if fewer vertices were
    /// requested.
    pub fn rows_of(&self, ordinal: usize) -> Option<&[f32]> {
        let start = ordinal.checked_mul(3 * self.rank)?;
        self.rows.get(start..)?.get(..3 * self.rank)
    }
}

impl Client {
    /// Describes all domains of a scene, with the requested arrays.
    ///
    /// # Errors
    /// `Status` if the scene does not exist; `Malformed` if lengths and counts contradict each other.
    pub async fn describe(&self, scene: &str, arrays: &[Array]) -> Result<SceneDescription> {
        self.describe_domains(scene, &[], arrays).await
    }

    /// As [`Self::describe`], for selected domain indices; an empty list selects all.
    ///
    /// # Errors
    /// As [`Self::describe`].
    pub async fn describe_domains(&self, scene: &str, domains: &[u32], arrays: &[Array]) -> Result<SceneDescription> {
        let request = v1::DescribeSceneRequest {
            scene: scene.to_owned(),
            domains: domains.to_vec(),
            arrays: arrays.iter().map(|array| *array as i32).collect(),
        };
        let mut messages = self.replies(self.scenes().describe_scene(request).await)?;
        let mut collected = DescriptionBuilder::new(self.reply_limit);
        while let Some(message) = messages.next().await? {
            collected.add(message)?;
        }
        collected.finish(arrays)
    }

    /// The rows of U of selected vertices of a domain; an empty list selects all.
    ///
    /// # Errors
    /// `Status` if the scene, the domain or a vertex does not exist; `Malformed` if the reply does not have 3 r
    /// numbers per vertex.
    pub async fn modes(&self, scene: &str, domain: usize, vertices: &[u32]) -> Result<ModeRows> {
        let domain = u32::try_from(domain).map_err(|_| malformed_reply("modes.domain", "a 32-bit index", domain))?;
        let request = v1::ReadModesRequest { scene: scene.to_owned(), domain, vertices: vertices.to_vec() };
        let mut messages = self.replies(self.scenes().read_modes(request).await)?;
        let mut assembler = Assembler::new("modes", self.reply_limit);
        let mut whole = None;
        while let Some(message) = messages.next().await? {
            let head = (!assembler.is_open()).then_some((message.rank, message.total));
            let done = assembler.push(Chunk { head, offset: message.offset, data: message.data })?;
            whole = done.or(whole);
        }
        if assembler.is_open() {
            return Err(Error::StreamEnded { what: "the last chunk of the modes" });
        }
        // A rigid domain has no rows; a server may answer without any message.
        let (rank, bytes) = whole.unwrap_or((0, Bytes::new()));
        let per_vertex = 12 * u64::from(rank);
        let expected = per_vertex.saturating_mul(vertices.len() as u64);
        if !vertices.is_empty() && bytes.len() as u64 != expected {
            return Err(malformed_reply("modes.total", format!("{expected} bytes"), bytes.len()));
        }
        if !(bytes.len() as u64).is_multiple_of(per_vertex) {
            return Err(malformed_reply("modes.total", format!("a multiple of {per_vertex} bytes"), bytes.len()));
        }
        Ok(ModeRows { rank: rank as usize, rows: decode("modes.data", &bytes)? })
    }
}

/// The parts of a description received so far.
struct DescriptionBuilder {
    limit: u64,
    kept: u64,
    info: Option<v1::SceneInfo>,
    domains: Vec<Domain>,
    places: BTreeMap<u32, usize>,
    open: Option<((u32, i32), Assembler<()>)>,
}

impl DescriptionBuilder {
    const fn new(limit: u64) -> Self {
        Self { limit, kept: 0, info: None, domains: vec![], places: BTreeMap::new(), open: None }
    }

    fn add(&mut self, message: v1::DescribeSceneResponse) -> Result<()> {
        use v1::describe_scene_response::Part;
        match message.part {
            Some(Part::Scene(info)) => self.info = Some(info),
            Some(Part::Domains(list)) => {
                for wire in list.domains {
                    self.places.insert(wire.domain, self.domains.len());
                    self.domains.push(domain(wire)?);
                }
            }
            Some(Part::Chunk(chunk)) => self.chunk(chunk)?,
            None => return Err(malformed_reply("describe.part", "a part", "none")),
        }
        Ok(())
    }

    /// Adds a chunk of an array. The chunks of one array are consecutive.
    fn chunk(&mut self, chunk: v1::ArrayChunk) -> Result<()> {
        let key = (chunk.domain, chunk.array);
        let mut assembler = match self.open.take() {
            Some((open, assembler)) if open == key => assembler,
            Some((open, _)) => {
                return Err(malformed_reply("describe.chunk", format!("the rest of {open:?}"), format!("{key:?}")));
            }
            None => Assembler::new("describe.chunk", self.limit),
        };
        let head = (!assembler.is_open()).then_some(((), chunk.total));
        match assembler.push(Chunk { head, offset: chunk.offset, data: chunk.data })? {
            None => self.open = Some((key, assembler)),
            Some(((), bytes)) => self.store(key, &bytes)?,
        }
        Ok(())
    }

    fn store(&mut self, (index, array): (u32, i32), bytes: &[u8]) -> Result<()> {
        const FIELD: &str = "describe.chunk.data";
        self.kept = self.kept.saturating_add(bytes.len() as u64);
        if self.kept > self.limit {
            return Err(malformed_reply("describe.chunk", format!("at most {} bytes in all", self.limit), self.kept));
        }
        let place = self.places.get(&index).and_then(|place| self.domains.get_mut(*place));
        let Some(domain) = place else {
            return Err(malformed_reply("describe.chunk.domain", "a domain described before", index));
        };
        match Array::try_from(array) {
            Ok(Array::Indices) => domain.indices = decode(FIELD, bytes)?,
            Ok(Array::CornerVertices) => domain.corner_vertices = decode(FIELD, bytes)?,
            Ok(Array::RestPositions) => domain.rest_positions = decode(FIELD, bytes)?,
            Ok(Array::Uvs) => domain.uvs = decode(FIELD, bytes)?,
            Ok(Array::RestNormals) => domain.rest_normals = decode(FIELD, bytes)?,
            _ => return Err(malformed_reply("describe.chunk.array", "a known array", array)),
        }
        Ok(())
    }

    fn finish(self, arrays: &[Array]) -> Result<SceneDescription> {
        if self.open.is_some() {
            return Err(Error::StreamEnded { what: "the last chunk of an array" });
        }
        let info = self.info.ok_or_else(|| malformed_reply("describe.scene", "a scene", "none"))?;
        for domain in &self.domains {
            for array in arrays {
                domain.check(*array)?;
            }
        }
        Ok(SceneDescription { info, domains: self.domains })
    }
}

impl Domain {
    /// Checks that a requested array has the length given by the counts, and that its indices are within range.
    fn check(&self, array: Array) -> Result<()> {
        let (got, wanted) = match array {
            Array::Indices => (self.indices.len(), 3 * self.triangles),
            Array::CornerVertices => (self.corner_vertices.len(), self.corners),
            Array::RestPositions => (self.rest_positions.len(), 3 * self.vertices),
            Array::RestNormals => (self.rest_normals.len(), 3 * self.corners),
            // Texture coordinates are optional.
            Array::Uvs if self.uvs.is_empty() => (0, 0),
            Array::Uvs => (self.uvs.len(), 2 * self.corners),
            Array::Unspecified => (0, 0),
        };
        let field = |what: &str| format!("domain '{}': {what}", self.name);
        if got != wanted {
            return Err(malformed_reply(field(array.as_str_name()), format!("{wanted} numbers"), got));
        }
        let below = |list: &[u32], limit: usize| list.iter().all(|index| (*index as usize) < limit);
        if !below(&self.indices, self.corners) {
            return Err(malformed_reply(field("indices"), format!("below {}", self.corners), "a larger one"));
        }
        if !below(&self.corner_vertices, self.vertices) {
            return Err(malformed_reply(field("corner_vertices"), format!("below {}", self.vertices), "a larger one"));
        }
        Ok(())
    }
}

/// Converts a domain from its wire format.
fn domain(wire: v1::DomainDescription) -> Result<Domain> {
    let place = |field: &str, bytes: &[u8]| {
        let refusal = |_| malformed_reply(format!("domain '{}': {field}", wire.name), "48 bytes", bytes.len());
        bytemuck::try_pod_read_unaligned::<[f32; 12]>(bytes).map_err(refusal)
    };
    let attachment = match wire.parent {
        None => None,
        Some(parent) => Some(Attachment {
            parent: parent as usize,
            frame: place("attachment_frame", &wire.attachment_frame)?,
            rows: wire.attachment_rows.clone(),
        }),
    };
    if !wire.eigenvalues.is_empty() && wire.eigenvalues.len() != wire.rank as usize {
        let field = format!("domain '{}': eigenvalues", wire.name);
        return Err(malformed_reply(field, format!("none or {}", wire.rank), wire.eigenvalues.len()));
    }
    Ok(Domain {
        index: wire.domain as usize,
        placement: place("placement", &wire.placement)?,
        attachment,
        vertices: wire.vertices as usize,
        rank: wire.rank as usize,
        corners: wire.corners as usize,
        triangles: wire.triangles as usize,
        shares_q_with: wire.shares_q_with.map(|twin| twin as usize),
        shape: wire.shape as usize,
        name: wire.name,
        eigenvalues: wire.eigenvalues,
        notes: wire.notes.into_iter().collect(),
        ..Domain::default()
    })
}
