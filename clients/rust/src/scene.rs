//! Scene descriptions: domains, and the shapes, materials and textures that they share; and rows of U.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use bytes::Bytes;
use modalcast_proto::v1;

use crate::assemble::{Assembler, Chunk, decode};
use crate::client::Client;
use crate::content::ContentHash;
use crate::description::DescriptionBuilder;
use crate::error::{Error, Result, malformed_reply};

/// The arrays of a shape that [`Client::describe`] can fetch.
pub use modalcast_proto::v1::Array as ShapeArray;

/// How the alpha of a material is used.
pub use modalcast_proto::v1::AlphaMode;

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

/// Consecutive triangles with one material. A range ends where the next one begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MaterialRange {
    pub first_triangle: usize,
    /// Index into [`SceneDescription::materials`].
    pub material: usize,
}

/// One domain of a scene. Its mesh and modes are those of its shape.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Domain {
    /// Index in the scene.
    pub index: usize,
    pub name: String,
    /// Index into [`SceneDescription::shapes`].
    pub shape: usize,
    /// r, the number of modes of the shape.
    pub rank: usize,
    /// Index into [`SceneDescription::materials`]: the material of all triangles, unless there are ranges.
    pub material: usize,
    /// Ranges of triangles with different materials, ascending; empty if all triangles have `material`.
    pub material_ranges: Vec<MaterialRange>,
    pub attachment: Option<Attachment>,
    /// Steps must not contain a transform of a domain that follows another one.
    pub follow: Option<Follow>,
    /// `world_from_domain` at rest, row-major 3x4.
    pub placement: [f32; 12],
    /// q at rest: r numbers, or none if all are 0.
    pub rest_q: Vec<f32>,
    /// Index in the scene of an earlier domain, with which this domain shares its coordinates.
    pub shares_q_with: Option<usize>,
    /// (rad/s)^2, one per mode; empty when unknown.
    pub eigenvalues: Vec<f64>,
    /// Free-form metadata of the scene's author, by name.
    pub notes: BTreeMap<String, String>,
}

/// A mesh of n vertices and its r modes. Arrays that were not requested are empty.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Shape {
    /// Index in the scene.
    pub index: usize,
    /// n, the number of vertices: U has 3n rows.
    pub vertex_count: usize,
    /// r, the number of modes: U has r columns.
    pub rank: usize,
    /// Number of corners. A corner is a vertex with one normal and one pair of texture coordinates; a vertex may have
    /// several corners.
    pub corner_count: usize,
    pub triangle_count: usize,
    /// Hashes of the arrays, if hashes were requested.
    pub hashes: Vec<(ShapeArray, ContentHash)>,
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
    /// U: 3n x r entries, row-major.
    pub modes: Vec<f32>,
}

/// A Phong material. Colors are linear.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Material {
    /// Index in the scene.
    pub index: usize,
    pub name: String,
    pub ambient: [f32; 3],
    pub diffuse: [f32; 3],
    pub specular: [f32; 3],
    /// Phong exponent.
    pub shininess: f32,
    pub alpha: f32,
    pub alpha_mode: AlphaMode,
    /// With [`AlphaMode::Mask`], fragments with a smaller alpha are not drawn.
    pub alpha_cutoff: f32,
    pub double_sided: bool,
    /// Index into [`SceneDescription::textures`]: sRGB colors that multiply ambient and diffuse, and alpha.
    pub color_texture: Option<usize>,
    /// Index into [`SceneDescription::textures`]: a tangent-space normal map with linear values.
    pub normal_texture: Option<usize>,
}

/// An image of RGBA8 pixels.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Texture {
    /// Index in the scene.
    pub index: usize,
    pub name: String,
    pub width: u32,
    pub height: u32,
    /// Hash of the pixels, if hashes were requested.
    pub hash: Option<ContentHash>,
    /// Four bytes per pixel, top row first; empty unless [`DescriptionRequest::textures`] was set.
    pub pixels: Bytes,
}

/// A scene, and the shapes, materials and textures of the described domains, each once.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SceneDescription {
    pub info: v1::SceneInfo,
    pub shapes: Vec<Shape>,
    pub materials: Vec<Material>,
    pub textures: Vec<Texture>,
    pub domains: Vec<Domain>,
}

impl SceneDescription {
    /// The shape of a domain of this description.
    pub fn shape_of(&self, domain: &Domain) -> &Shape {
        &self.shapes[domain.shape]
    }
}

/// What [`Client::describe_with`] fetches.
#[derive(Debug, Clone, PartialEq)]
pub struct DescriptionRequest {
    scene: String,
    domains: Vec<u32>,
    arrays: Vec<ShapeArray>,
    hashes: bool,
    textures: bool,
    cache: Option<PathBuf>,
}

impl DescriptionRequest {
    /// All domains of a scene, without arrays.
    pub fn new(scene: &str) -> Self {
        let (domains, arrays) = (vec![], vec![]);
        Self { scene: scene.to_owned(), domains, arrays, hashes: false, textures: false, cache: None }
    }

    /// Selects domains by their indices; an empty list selects all.
    #[must_use]
    pub fn domains(self, domains: &[u32]) -> Self {
        Self { domains: domains.to_vec(), ..self }
    }

    /// Fetches arrays of each shape.
    #[must_use]
    pub fn arrays(self, arrays: &[ShapeArray]) -> Self {
        Self { arrays: arrays.to_vec(), ..self }
    }

    /// Fetches the hashes of all arrays and textures, for [`Client::read_content`].
    #[must_use]
    pub const fn hashes(mut self) -> Self {
        self.hashes = true;
        self
    }

    /// Fetches the pixels of the textures.
    #[must_use]
    pub const fn textures(mut self) -> Self {
        self.textures = true;
        self
    }

    /// Stores arrays and pixels as files in `folder`, one per SHA-256, and reads those that are already there instead
    /// of fetching them. Nothing removes files from the folder; the caller may do so at any time.
    #[must_use]
    pub fn cache(self, folder: impl Into<PathBuf>) -> Self {
        Self { cache: Some(folder.into()), ..self }
    }
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
    /// Gets the description of all domains of a scene, with the requested arrays of their shapes.
    ///
    /// # Errors
    /// `Status` if the scene does not exist; `Malformed` if lengths and counts contradict each other.
    pub async fn describe(&self, scene: &str, arrays: &[ShapeArray]) -> Result<SceneDescription> {
        self.describe_with(&DescriptionRequest::new(scene).arrays(arrays)).await
    }

    /// As [`Self::describe`], with a selection of domains, hashes, textures or a cache.
    ///
    /// # Errors
    /// As [`Self::describe`]; `File` if the cache cannot be written.
    pub async fn describe_with(&self, request: &DescriptionRequest) -> Result<SceneDescription> {
        // With a cache, arrays are fetched by their hashes. Pixels always are.
        let arrays_in_reply = if request.cache.is_some() { &[][..] } else { &request.arrays };
        let wire_request = v1::DescribeSceneRequest {
            scene: request.scene.clone(),
            domains: request.domains.clone(),
            arrays: arrays_in_reply.iter().map(|array| *array as i32).collect(),
            hashes: request.hashes || request.textures || request.cache.is_some(),
        };
        let mut messages = self.replies(self.scenes().describe_scene(wire_request).await)?;
        let mut builder = DescriptionBuilder::new(self.max_reply_bytes);
        while let Some(message) = messages.next().await? {
            builder.add_message(message)?;
        }
        let mut description = builder.finish()?;
        self.fetch_description_contents(request, &mut description).await?;
        description.check_arrays(&request.arrays)?;
        Ok(description)
    }

    /// Fetches the arrays and pixels of a description that the reply did not contain.
    async fn fetch_description_contents(
        &self,
        request: &DescriptionRequest,
        description: &mut SceneDescription,
    ) -> Result<()> {
        let arrays = if request.cache.is_some() { &request.arrays[..] } else { &[] };
        if arrays.is_empty() && !request.textures {
            return Ok(());
        }
        let textures = if request.textures { &mut description.textures[..] } else { &mut [] };
        let mut hashes: BTreeSet<ContentHash> = textures.iter().filter_map(|texture| texture.hash).collect();
        for shape in &description.shapes {
            hashes.extend(arrays.iter().filter_map(|array| shape.hash_of(*array)));
        }
        let contents = self.fetch_contents(&request.scene, hashes, request.cache.as_deref()).await?;
        let content = |hash: Option<ContentHash>| {
            let bytes = hash.and_then(|hash| contents.get(&hash)).cloned();
            bytes.ok_or_else(|| malformed_reply("describe.sha256", "32 bytes", "none"))
        };
        for texture in textures {
            texture.pixels = content(texture.hash)?;
        }
        for shape in &mut description.shapes {
            for array in arrays {
                let bytes = content(shape.hash_of(*array))?;
                shape.set_array(*array, &bytes)?;
            }
        }
        Ok(())
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
