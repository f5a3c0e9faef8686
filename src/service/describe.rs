//! Describes a scene for clients that do not have its files: shapes, materials, textures and domains, each once, and
//! the arrays of the shapes. Replies are sent in messages of about 1 MiB.

use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;
use modalcast_proto::v1::describe_scene_response::Part;
use tonic::{Response, Status};

use super::convert::{parse_hashes, wire_scene_info};
use super::status::to_status;
use super::stream::{ReplySender, ReplyStream, respond};
use crate::engine::{ContentHash, ContentHashes, SceneContent, SceneHandle, ShapeArray, hex, validate_domains};
use modalcast_model::domain::{AlphaMode, Domain, Material, MaterialRange, Transform};
use modalcast_model::error::{Error, Result, invalid};
use modalcast_model::scene::Scene;

/// Upper bound on the encoded size of a chunk without its data, in bytes.
const CHUNK_HEAD_BYTES: usize = 64;

/// Replies with the descriptions of the selected domains and of everything that they use, and with the requested
/// arrays.
pub(super) fn respond_with_description(
    scene_handle: Arc<SceneHandle>,
    request: v1::DescribeSceneRequest,
    max_chunk_bytes: usize,
) -> Result<Response<ReplyStream<v1::DescribeSceneResponse>>> {
    let domains = validate_domains("domains", &scene_handle.scene, request.domains)?;
    let arrays = parse_arrays(&request.arrays)?;
    Ok(respond(move |reply_sender| async move {
        reply_sender.send(response_with(Part::Scene(wire_scene_info(&scene_handle)))).await?;
        let hashes = match request.hashes {
            true => Some(scene_handle.content_hashes().await.map_err(to_status)?),
            false => None,
        };
        let description = Description::new(&scene_handle.scene, domains, hashes.as_deref());
        description.send(max_chunk_bytes, &reply_sender).await?;
        for shape in description.shapes {
            for array in &arrays {
                send_array(&scene_handle.scene, shape, *array, max_chunk_bytes, &reply_sender).await?;
            }
        }
        Ok(())
    }))
}

/// Sends an array in chunks. An empty array is one empty chunk.
async fn send_array(
    scene: &Arc<Scene>,
    shape: usize,
    array: ShapeArray,
    max_chunk_bytes: usize,
    reply_sender: &ReplySender<v1::DescribeSceneResponse>,
) -> Result<(), Status> {
    let size = array.size(&scene.shapes[shape]);
    for start in (0..size.max(1)).step_by(max_chunk_bytes) {
        let permit = reply_sender.reserve(max_chunk_bytes.min(size) + CHUNK_HEAD_BYTES).await?;
        let chunk = v1::ArrayChunk {
            shape: shape as u32,
            array: wire_array(array).into(),
            offset: start as u64,
            total: size as u64,
            data: array.read(scene, shape, start..size.min(start + max_chunk_bytes)),
        };
        permit.send(response_with(Part::Chunk(chunk)));
    }
    Ok(())
}

/// Replies with arrays and textures by their hashes.
pub(super) async fn respond_with_content(
    scene_handle: Arc<SceneHandle>,
    request: v1::ReadContentRequest,
    max_chunk_bytes: usize,
) -> Result<Response<ReplyStream<v1::ReadContentResponse>>> {
    let requested_hashes = parse_hashes(&request.sha256)?;
    let hashes = scene_handle.content_hashes().await?;
    let find_content = |(index, hash): (usize, &ContentHash)| {
        let not_found = || {
            let field = format!("sha256[{index}]");
            Error::ContentNotFound { field, what: "array or texture of the scene", sha256: hex(hash) }
        };
        hashes.find(hash).ok_or_else(not_found)
    };
    let items: Vec<SceneContent> = requested_hashes.iter().enumerate().map(find_content).collect::<Result<_>>()?;
    Ok(respond(move |reply_sender: ReplySender<v1::ReadContentResponse>| async move {
        for (item, content) in items.into_iter().enumerate() {
            let size = content.size(&scene_handle.scene);
            for start in (0..size.max(1)).step_by(max_chunk_bytes) {
                let permit = reply_sender.reserve(max_chunk_bytes.min(size) + CHUNK_HEAD_BYTES).await?;
                let data = content.read(&scene_handle.scene, start..size.min(start + max_chunk_bytes));
                let (item, offset, total) = (item as u32, start as u64, size as u64);
                permit.send(v1::ReadContentResponse { item, offset, total, data });
            }
        }
        Ok(())
    }))
}

/// Replies with rows of one domain's U: three per requested vertex.
pub(super) fn respond_with_modes(
    scene_handle: Arc<SceneHandle>,
    request: v1::ReadModesRequest,
    max_chunk_bytes: usize,
) -> Result<Response<ReplyStream<v1::ReadModesResponse>>> {
    let domain_count = scene_handle.scene.domains.len();
    if request.domain as usize >= domain_count {
        return Err(invalid("domain", format!("an index below {domain_count}"), request.domain));
    }
    let shape = scene_handle.scene.shape_of(request.domain as usize);
    let (vertex_count, rank) = (shape.mesh.rest_positions().len(), shape.modes.rank());
    // An empty list means all vertices.
    let vertices_to_read =
        if request.vertices.is_empty() { (0..vertex_count as u32).collect() } else { request.vertices };
    if vertices_to_read.len() > vertex_count {
        return Err(invalid("vertices", format!("at most {vertex_count} indices"), vertices_to_read.len()));
    }
    if let Some(index) = vertices_to_read.iter().position(|vertex| *vertex as usize >= vertex_count) {
        let expected = format!("an index below {vertex_count}");
        return Err(invalid(format!("vertices[{index}]"), expected, vertices_to_read[index]));
    }
    // Three rows of `rank` f32.
    let bytes_per_vertex = 12 * rank;
    // A chunk has whole vertices, and only one chunk is in memory at a time. Without modes, one message without data is
    // the reply.
    let vertices_per_chunk =
        if rank == 0 { vertices_to_read.len() } else { (max_chunk_bytes / bytes_per_vertex).max(1) };
    let total = (bytes_per_vertex * vertices_to_read.len()) as u64;
    Ok(respond(move |reply_sender: ReplySender<v1::ReadModesResponse>| async move {
        let modes = &scene_handle.scene.shape_of(request.domain as usize).modes;
        for (chunk_index, vertices_of_chunk) in vertices_to_read.chunks(vertices_per_chunk).enumerate() {
            let permit = reply_sender.reserve(vertices_of_chunk.len() * bytes_per_vertex + CHUNK_HEAD_BYTES).await?;
            let entries_of_row = |row: usize| (0..rank).map(move |mode| modes.column(mode)[row]);
            let rows = vertices_of_chunk
                .iter()
                .flat_map(|vertex| (0..3).map(move |component| 3 * *vertex as usize + component));
            let data: Vec<u8> = rows.flat_map(entries_of_row).flat_map(f32::to_le_bytes).collect();
            let offset = (chunk_index * vertices_per_chunk * bytes_per_vertex) as u64;
            permit.send(v1::ReadModesResponse { rank: rank as u32, offset, total, data: data.into() });
        }
        Ok(())
    }))
}

const fn response_with(part: Part) -> v1::DescribeSceneResponse {
    v1::DescribeSceneResponse { part: Some(part) }
}

fn parse_arrays(numbers: &[i32]) -> Result<Vec<ShapeArray>> {
    let mut arrays = Vec::new();
    for (index, number) in numbers.iter().enumerate() {
        let array = match v1::Array::try_from(*number) {
            Ok(v1::Array::Indices) => ShapeArray::Indices,
            Ok(v1::Array::CornerVertices) => ShapeArray::CornerVertices,
            Ok(v1::Array::RestPositions) => ShapeArray::RestPositions,
            Ok(v1::Array::Uvs) => ShapeArray::Uvs,
            Ok(v1::Array::RestNormals) => ShapeArray::RestNormals,
            Ok(v1::Array::Modes) => ShapeArray::Modes,
            Ok(v1::Array::Unspecified) | Err(_) => {
                return Err(invalid(format!("arrays[{index}]"), "an array of this version", number));
            }
        };
        if arrays.contains(&array) {
            let given = wire_array(array).as_str_name();
            return Err(invalid(format!("arrays[{index}]"), "each array at most once", given));
        }
        arrays.push(array);
    }
    Ok(arrays)
}

const fn wire_array(array: ShapeArray) -> v1::Array {
    match array {
        ShapeArray::Indices => v1::Array::Indices,
        ShapeArray::CornerVertices => v1::Array::CornerVertices,
        ShapeArray::RestPositions => v1::Array::RestPositions,
        ShapeArray::Uvs => v1::Array::Uvs,
        ShapeArray::RestNormals => v1::Array::RestNormals,
        ShapeArray::Modes => v1::Array::Modes,
    }
}

/// The parts of a scene that a reply describes.
struct Description<'a> {
    scene: &'a Scene,
    /// Indices of domains in the order of the reply.
    domains: Vec<u32>,
    /// Indices of the shapes, materials and textures that the domains use, ascending.
    shapes: Vec<usize>,
    materials: Vec<usize>,
    textures: Vec<usize>,
    /// Per shape of the scene, the first domain that has it. The eigenvalues of a shape are those of this domain.
    first_domains: Vec<Option<usize>>,
    /// Present if hashes were requested.
    hashes: Option<&'a ContentHashes>,
}

impl<'a> Description<'a> {
    fn new(scene: &'a Scene, domains: Vec<u32>, hashes: Option<&'a ContentHashes>) -> Self {
        let mut first_domains = vec![None; scene.shapes.len()];
        for (index, domain) in scene.domains.iter().enumerate() {
            first_domains[domain.shape].get_or_insert(index);
        }
        let selected_domains = || domains.iter().map(|index| &scene.domains[*index as usize]);
        let shapes = used_indices(scene.shapes.len(), selected_domains().map(|domain| domain.shape));
        let materials = used_indices(scene.materials.len(), selected_domains().flat_map(Domain::materials));
        let textures_of = |material: &usize| {
            let material = &scene.materials[*material];
            [material.color_texture, material.normal_texture].into_iter().flatten()
        };
        let textures = used_indices(scene.textures.len(), materials.iter().flat_map(textures_of));
        Self { scene, domains, shapes, materials, textures, first_domains, hashes }
    }

    /// Sends all descriptions in messages of about `max_message_bytes`.
    async fn send(
        &self,
        max_message_bytes: usize,
        reply_sender: &ReplySender<v1::DescribeSceneResponse>,
    ) -> Result<(), Status> {
        let packer = ItemPacker { max_message_bytes, reply_sender };
        let shapes = self.shapes.iter().map(|shape| self.describe_shape(*shape));
        packer.send(shapes, |shapes| Part::Shapes(v1::ShapeDescriptions { shapes })).await?;
        let materials = self.materials.iter().map(|index| wire_material(*index, &self.scene.materials[*index]));
        packer.send(materials, |materials| Part::Materials(v1::MaterialDescriptions { materials })).await?;
        let textures = self.textures.iter().map(|texture| self.describe_texture(*texture));
        packer.send(textures, |textures| Part::Textures(v1::TextureDescriptions { textures })).await?;
        let domains = self.domains.iter().map(|domain| self.describe_domain(*domain));
        packer.send(domains, |domains| Part::Domains(v1::DomainDescriptions { domains })).await
    }

    fn describe_shape(&self, index: usize) -> v1::ShapeDescription {
        let shape = &self.scene.shapes[index];
        let array_hashes = self.hashes.map(|hashes| hashes.of_shape(index));
        let describe_array = |(ordinal, array): (usize, ShapeArray)| v1::ArrayDescription {
            array: wire_array(array).into(),
            bytes: array.size(shape) as u64,
            sha256: array_hashes.map(|hashes| hashes[ordinal].to_vec().into()).unwrap_or_default(),
        };
        v1::ShapeDescription {
            shape: index as u32,
            vertices: shape.mesh.rest_positions().len() as u32,
            rank: shape.modes.rank() as u32,
            corners: shape.mesh.corners().vertices.len() as u32,
            triangles: shape.mesh.triangles().len() as u32,
            eigenvalues: self.eigenvalues_of_shape(index).to_vec(),
            arrays: ShapeArray::ALL.into_iter().enumerate().map(describe_array).collect(),
        }
    }

    fn eigenvalues_of_shape(&self, shape: usize) -> &[f64] {
        self.first_domains[shape].map_or(&[], |domain| &self.scene.domains[domain].metadata.eigenvalues)
    }

    fn describe_texture(&self, index: usize) -> v1::TextureDescription {
        let texture = &self.scene.textures[index];
        v1::TextureDescription {
            texture: index as u32,
            name: texture.name.clone(),
            width: texture.width(),
            height: texture.height(),
            bytes: texture.rgba().len() as u64,
            sha256: self.hashes.map(|hashes| hashes.of_texture(index).to_vec().into()).unwrap_or_default(),
        }
    }

    fn describe_domain(&self, index: u32) -> v1::DomainDescription {
        let domain = &self.scene.domains[index as usize];
        let attachment = domain.attachment.as_ref();
        let follow_frame = domain.follows.map(|follow| follow.frame);
        let is_attachment_frame = attachment.map(|attachment| attachment.frame) == follow_frame;
        let eigenvalues = &domain.metadata.eigenvalues;
        v1::DomainDescription {
            domain: index,
            name: domain.name.clone(),
            shape: domain.shape as u32,
            material: domain.material as u32,
            material_ranges: domain.material_ranges.iter().map(wire_material_range).collect(),
            placement: transform_bytes(&domain.placement),
            rest_q: domain.rest_q.iter().flat_map(|number| number.to_le_bytes()).collect::<Vec<u8>>().into(),
            parent: attachment.map(|attachment| attachment.parent as u32),
            attachment_frame: attachment.map(|attachment| transform_bytes(&attachment.frame)).unwrap_or_default(),
            attachment_vertices: attachment.map(|attachment| attachment.vertices.clone()).unwrap_or_default(),
            follows: domain.follows.map(|follow| follow.parent as u32),
            follow_frame: follow_frame
                .filter(|_| !is_attachment_frame)
                .map(|frame| transform_bytes(&frame))
                .unwrap_or_default(),
            shares_q_with: domain.shares_q_with.map(|other_domain| other_domain as u32),
            eigenvalues: (eigenvalues != self.eigenvalues_of_shape(domain.shape))
                .then(|| v1::Eigenvalues { values: eigenvalues.clone() }),
            notes: domain.metadata.notes.clone().into_iter().collect(),
        }
    }
}

/// The indices below `count` that occur in `indices`, ascending.
fn used_indices(count: usize, indices: impl Iterator<Item = usize>) -> Vec<usize> {
    let mut is_used = vec![false; count];
    indices.for_each(|index| is_used[index] = true);
    (0..count).filter(|index| is_used[*index]).collect()
}

/// Sends lists of descriptions, several in a message.
struct ItemPacker<'a> {
    max_message_bytes: usize,
    reply_sender: &'a ReplySender<v1::DescribeSceneResponse>,
}

impl ItemPacker<'_> {
    /// Sends `items` in the order of the list. A message contains as many items as fit, and at least one.
    async fn send<T: prost::Message>(
        &self,
        items: impl Iterator<Item = T>,
        wrap: impl Fn(Vec<T>) -> Part,
    ) -> Result<(), Status> {
        let mut group = Vec::new();
        let mut group_bytes = 0;
        for item in items {
            // Protobuf adds at most 8 bytes to a nested message: tag and length.
            let item_bytes = item.encoded_len() + 8;
            if group_bytes + item_bytes > self.max_message_bytes && !group.is_empty() {
                self.reply_sender.send(response_with(wrap(std::mem::take(&mut group)))).await?;
                group_bytes = 0;
            }
            group_bytes += item_bytes;
            group.push(item);
        }
        if group.is_empty() {
            return Ok(());
        }
        self.reply_sender.send(response_with(wrap(group))).await
    }
}

fn wire_material(index: usize, material: &Material) -> v1::MaterialDescription {
    let (alpha_mode, alpha_cutoff) = match material.alpha_mode {
        AlphaMode::Opaque => (v1::AlphaMode::Opaque, 0.0),
        AlphaMode::Mask { cutoff } => (v1::AlphaMode::Mask, cutoff),
        AlphaMode::Blend => (v1::AlphaMode::Blend, 0.0),
    };
    v1::MaterialDescription {
        material: index as u32,
        name: material.name.clone(),
        ambient: material.ambient.to_vec(),
        diffuse: material.diffuse.to_vec(),
        specular: material.specular.to_vec(),
        shininess: material.shininess,
        alpha: material.alpha,
        alpha_mode: alpha_mode.into(),
        alpha_cutoff,
        double_sided: material.double_sided,
        color_texture: material.color_texture.map(|texture| texture as u32),
        normal_texture: material.normal_texture.map(|texture| texture as u32),
    }
}

const fn wire_material_range(range: &MaterialRange) -> v1::MaterialRange {
    v1::MaterialRange { first_triangle: range.first_triangle as u32, material: range.material as u32 }
}

/// 48 bytes: twelve little-endian f32.
fn transform_bytes(transform: &Transform) -> Bytes {
    transform.0.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>().into()
}
