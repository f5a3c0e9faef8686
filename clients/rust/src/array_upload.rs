//! Uploads meshes and modes from memory and opens them as a scene, without files.

use bytes::Bytes;
use modalcast_proto::v1;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use v1::upload_arrays_request::Part;

use crate::client::Client;
use crate::error::{Error, Result, malformed_reply};

/// Bytes of arrays per message: far below 4 MiB, the default limit of gRPC.
const CHUNK_BYTES: usize = 512 << 10;

/// The mesh and the modes of an uploaded domain.
#[derive(Debug, Clone, PartialEq)]
pub enum UploadShape {
    /// n vertices, triangles of vertex indices, and U: 3n rows of `rank` entries, row-major. A rigid domain has rank 0
    /// and no entries.
    Arrays { positions: Vec<[f32; 3]>, triangles: Vec<[u32; 3]>, rank: u32, modes: Vec<f32> },
    /// The mesh and the modes of an earlier domain, by its index in the upload.
    OfDomain(u32),
}

impl UploadShape {
    /// Size of the arrays according to the counts of vertices, triangles and modes: three numbers of four bytes per
    /// vertex, per vertex and mode, and per triangle. The server rejects arrays of another size.
    const fn declared_bytes(&self) -> u64 {
        match self {
            Self::Arrays { positions, triangles, rank, .. } => {
                12 * (positions.len() as u64 * (1 + *rank as u64) + triangles.len() as u64)
            }
            Self::OfDomain(_) => 0,
        }
    }
}

/// A domain of [`ArrayUpload`].
#[derive(Debug, Clone, PartialEq)]
pub struct UploadDomain {
    name: String,
    shape: UploadShape,
    origin: [f64; 3],
    placement: Option<[f64; 12]>,
    color: Option<[f32; 3]>,
    eigenvalues: Vec<f64>,
    crease_angle: Option<f64>,
}

impl UploadDomain {
    /// A domain of the default color at the origin. Its name must be unique in the upload.
    pub fn new(name: &str, shape: UploadShape) -> Self {
        Self {
            name: name.to_owned(),
            shape,
            origin: [0.0; 3],
            placement: None,
            color: None,
            eigenvalues: vec![],
            crease_angle: None,
        }
    }

    /// Sets the point that the positions are relative to, in scene units and in the domain's own frame. It keeps f32
    /// positions accurate at any distance from the origin of this frame. For [`UploadShape::Arrays`] only.
    #[must_use]
    pub const fn origin(mut self, origin: [f64; 3]) -> Self {
        self.origin = origin;
        self
    }

    /// Sets `world_from_domain` at rest: row-major 3x4, translation in scene units.
    #[must_use]
    pub fn placement(self, world_from_domain: [f32; 12]) -> Self {
        self.exact_placement(world_from_domain.map(f64::from))
    }

    /// As [`Self::placement`], in f64 for domains that are far from the scene's origin.
    #[must_use]
    pub const fn exact_placement(mut self, world_from_domain: [f64; 12]) -> Self {
        self.placement = Some(world_from_domain);
        self
    }

    /// Sets the linear color: red, green and blue, 0 to 1.
    #[must_use]
    pub const fn color(mut self, color: [f32; 3]) -> Self {
        self.color = Some(color);
        self
    }

    /// Sets the eigenvalues in (rad/s)^2, one per mode.
    #[must_use]
    pub fn eigenvalues(self, eigenvalues: &[f64]) -> Self {
        Self { eigenvalues: eigenvalues.to_vec(), ..self }
    }

    /// Sets the crease angle in degrees: an edge is shaded as hard if the normals of its two triangles differ by more
    /// than this angle at rest. 0 is flat, 180 is smooth, and the default is 40. For [`UploadShape::Arrays`] only.
    #[must_use]
    pub const fn crease_angle(mut self, degrees: f64) -> Self {
        self.crease_angle = Some(degrees);
        self
    }

    fn to_wire(&self) -> v1::UploadedDomain {
        let mut wire = v1::UploadedDomain {
            name: self.name.clone(),
            placement: self.placement.map(|entries| pack_placement(&entries)).unwrap_or_default(),
            origin: if self.origin == [0.0; 3] { vec![] } else { self.origin.to_vec() },
            color: self.color.map(|color| color.to_vec()).unwrap_or_default(),
            eigenvalues: self.eigenvalues.clone(),
            crease_angle: self.crease_angle,
            ..Default::default()
        };
        match &self.shape {
            UploadShape::Arrays { positions, triangles, rank, .. } => {
                (wire.vertices, wire.triangles) = (wire_count(positions), wire_count(triangles));
                wire.rank = *rank;
            }
            UploadShape::OfDomain(index) => wire.shares_shape_with = Some(*index),
        }
        wire
    }

    /// The arrays in the order of the wire.
    fn arrays(&self) -> Vec<&[u8]> {
        match &self.shape {
            UploadShape::Arrays { positions, triangles, modes, .. } => {
                vec![bytemuck::cast_slice(positions), bytemuck::cast_slice(triangles), bytemuck::cast_slice(modes)]
            }
            UploadShape::OfDomain(_) => vec![],
        }
    }
}

/// A scene of meshes and modes in memory, for [`Client::upload_arrays`].
#[derive(Debug, Clone, PartialEq)]
pub struct ArrayUpload {
    scene: String,
    unit: f64,
    up: String,
    domains: Vec<UploadDomain>,
}

impl ArrayUpload {
    /// A scene without domains, with meters as units and y as up axis.
    pub fn new(scene: &str) -> Self {
        Self { scene: scene.to_owned(), unit: 1.0, up: "y".to_owned(), domains: vec![] }
    }

    /// Sets the meters per scene unit.
    #[must_use]
    pub const fn unit(mut self, meters: f64) -> Self {
        self.unit = meters;
        self
    }

    /// Sets the up axis: `x`, `y` or `z`.
    #[must_use]
    pub fn up(self, axis: &str) -> Self {
        Self { up: axis.to_owned(), ..self }
    }

    /// Adds a domain.
    #[must_use]
    pub fn domain(mut self, domain: UploadDomain) -> Self {
        self.domains.push(domain);
        self
    }

    fn header(&self) -> v1::UploadArraysHeader {
        v1::UploadArraysHeader {
            scene: self.scene.clone(),
            domains: wire_count(&self.domains),
            total_bytes: self.domains.iter().map(|domain| domain.shape.declared_bytes()).sum(),
            unit: self.unit,
            up: self.up.clone(),
        }
    }
}

/// The length of a list. The server rejects `u32::MAX`, which stands for all larger lengths.
fn wire_count<T>(list: &[T]) -> u32 {
    u32::try_from(list.len()).unwrap_or(u32::MAX)
}

/// A placement in f32 if that is exact, else in f64.
fn pack_placement(entries: &[f64; 12]) -> Bytes {
    let rounded = entries.map(|entry| entry as f32);
    if rounded.map(f64::from) == *entries { pack(&rounded) } else { pack(entries) }
}

fn pack<T: bytemuck::NoUninit>(numbers: &[T]) -> Bytes {
    Bytes::copy_from_slice(bytemuck::cast_slice(numbers))
}

impl Client {
    /// Uploads meshes and modes and opens them as a scene. The server keeps them until the scene is deleted, also
    /// across restarts.
    ///
    /// # Errors
    /// `Status` if the server rejects the upload, with the path of the invalid field, such as `domains[2].rank`.
    pub async fn upload_arrays(&self, upload: ArrayUpload) -> Result<v1::SceneInfo> {
        // At most 4 messages (2 MiB) are queued. When the queue is full, `send_arrays` waits.
        let (sender, queue) = mpsc::channel(4);
        let send_task = tokio::spawn(async move { send_arrays(&sender, &upload).await });
        let reply = self.reply(self.scenes().upload_arrays(ReceiverStream::new(queue)).await);
        send_task.await.map_err(|error| Error::file("upload", error))?;
        reply?.scene.ok_or_else(|| malformed_reply("upload_arrays.scene", "a scene", "none"))
    }
}

/// Sends the header, then each domain and its arrays. Stops if the server has closed the stream.
async fn send_arrays(sender: &mpsc::Sender<v1::UploadArraysRequest>, upload: &ArrayUpload) {
    let send = async |part| sender.send(v1::UploadArraysRequest { part: Some(part) }).await.is_ok();
    let mut is_open = send(Part::Header(upload.header())).await;
    for domain in &upload.domains {
        is_open = is_open && send(Part::Domain(domain.to_wire())).await;
        for chunk in domain.arrays().into_iter().flat_map(|array| array.chunks(CHUNK_BYTES)) {
            is_open = is_open && send(Part::Chunk(Bytes::copy_from_slice(chunk))).await;
        }
    }
}
