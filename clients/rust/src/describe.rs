//! Calls that describe a scene: its domains, shapes, materials and textures, and rows of U.

use std::collections::BTreeSet;
use std::path::PathBuf;

use bytes::Bytes;
use modalcast_proto::v1;

use crate::assemble::{Assembler, Chunk, decode};
use crate::client::Client;
use crate::content::ContentHash;
use crate::description::DescriptionBuilder;
use crate::error::{Error, Result, malformed_reply};
use crate::scene::{SceneDescription, ShapeArray};

/// Selects the parts of a description that [`Client::describe_with`] fetches.
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
        // With a cache, arrays are fetched by their hashes instead of in the reply. Pixels are always fetched by their
        // hashes.
        let arrays_in_reply = if request.cache.is_some() { &[][..] } else { &request.arrays };
        let wire_request = v1::DescribeSceneRequest {
            scene: request.scene.clone(),
            domains: request.domains.clone(),
            arrays: arrays_in_reply.iter().map(|array| *array as i32).collect(),
            hashes: request.hashes || request.textures || request.cache.is_some(),
        };
        let mut messages = self.replies(self.scene_streams().describe_scene(wire_request).await)?;
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
        let mut messages = self.replies(self.scene_streams().read_modes(request).await)?;
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
