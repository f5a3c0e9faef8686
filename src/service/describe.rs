//! Describes a scene for clients that do not have its files: domains, mesh arrays and rows of U. Replies are sent in
//! chunks of at most 1 MiB.

use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;
use modalcast_proto::v1::describe_scene_response::Part;
use prost::Message as _;
use tonic::{Response, Status};

use super::convert::wire_scene_info;
use super::stream::{ReplySender, ReplyStream, respond};
use crate::engine::{SceneHandle, validate_domains};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// Limit on the arrays of one request: the number of variants of `v1::Array` without `Unspecified`.
const MAX_ARRAYS: usize = 5;

/// Replies with the descriptions of the selected domains and with the requested arrays.
pub(super) fn respond_with_description(
    scene_handle: Arc<SceneHandle>,
    request: v1::DescribeSceneRequest,
    max_chunk_bytes: usize,
) -> Result<Response<ReplyStream<v1::DescribeSceneResponse>>> {
    let domains = validate_domains("domains", &scene_handle.scene, request.domains)?;
    let arrays = request.arrays.into_iter().map(parse_array).collect::<Result<Vec<_>>>()?;
    if arrays.len() > MAX_ARRAYS {
        return Err(invalid("arrays", format!("at most {MAX_ARRAYS}"), arrays.len()));
    }
    Ok(respond(move |reply_sender| async move {
        reply_sender.send(response_with(Part::Scene(wire_scene_info(&scene_handle)))).await?;
        send_descriptions(&scene_handle.scene, &domains, max_chunk_bytes, &reply_sender).await?;
        for domain in domains {
            for array in &arrays {
                let bytes = array_bytes(&scene_handle.scene, domain as usize, *array);
                let total = bytes.len() as u64;
                // Copies one chunk at a time. An empty array is one empty chunk.
                for start in (0..bytes.len().max(1)).step_by(max_chunk_bytes) {
                    let data = Bytes::copy_from_slice(&bytes[start..bytes.len().min(start + max_chunk_bytes)]);
                    let offset = start as u64;
                    let chunk = v1::ArrayChunk { domain, array: (*array).into(), offset, total, data };
                    reply_sender.send(response_with(Part::Chunk(chunk))).await?;
                }
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
            let entries_of_row = |row: usize| (0..rank).map(move |mode| modes.column(mode)[row]);
            let rows = vertices_of_chunk
                .iter()
                .flat_map(|vertex| (0..3).map(move |component| 3 * *vertex as usize + component));
            let data: Vec<u8> = rows.flat_map(entries_of_row).flat_map(f32::to_le_bytes).collect();
            let offset = (chunk_index * vertices_per_chunk * bytes_per_vertex) as u64;
            reply_sender.send(v1::ReadModesResponse { rank: rank as u32, offset, total, data: data.into() }).await?;
        }
        Ok(())
    }))
}

const fn response_with(part: Part) -> v1::DescribeSceneResponse {
    v1::DescribeSceneResponse { part: Some(part) }
}

fn parse_array(number: i32) -> Result<v1::Array> {
    match v1::Array::try_from(number) {
        Ok(v1::Array::Unspecified) | Err(_) => Err(invalid("arrays", "arrays of this version", number)),
        Ok(array) => Ok(array),
    }
}

/// Sends descriptions of domains. A message contains as many as fit into a chunk.
async fn send_descriptions(
    scene: &Scene,
    domains: &[u32],
    max_chunk_bytes: usize,
    reply_sender: &ReplySender<v1::DescribeSceneResponse>,
) -> Result<(), Status> {
    let mut group = v1::DomainDescriptions::default();
    let mut group_bytes = 0;
    for domain in domains {
        let description = describe_domain(scene, *domain);
        // Protobuf adds at most 8 bytes to a nested message: tag and length.
        let description_bytes = description.encoded_len() + 8;
        if group_bytes + description_bytes > max_chunk_bytes && !group.domains.is_empty() {
            reply_sender.send(response_with(Part::Domains(std::mem::take(&mut group)))).await?;
            group_bytes = 0;
        }
        group_bytes += description_bytes;
        group.domains.push(description);
    }
    reply_sender.send(response_with(Part::Domains(group))).await
}

fn describe_domain(scene: &Scene, index: u32) -> v1::DomainDescription {
    let domain = &scene.domains[index as usize];
    let domain_layout = scene.layout.domains[index as usize];
    let transform_bytes = |transform: &modalcast_model::domain::Transform| -> Bytes {
        transform.0.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>().into()
    };
    let attachment = domain.attachment.as_ref();
    v1::DomainDescription {
        domain: index,
        name: domain.name.clone(),
        vertices: domain_layout.vertices as u32,
        rank: domain_layout.rank as u32,
        corners: domain_layout.corners as u32,
        triangles: domain_layout.triangles as u32,
        parent: attachment.map(|attachment| attachment.parent as u32),
        attachment_frame: attachment.map(|attachment| transform_bytes(&attachment.frame)).unwrap_or_default(),
        attachment_vertices: attachment.map(|attachment| attachment.vertices.clone()).unwrap_or_default(),
        placement: transform_bytes(&domain.placement),
        shares_q_with: domain.shares_q_with.map(|other_domain| other_domain as u32),
        shape: domain.shape as u32,
        eigenvalues: domain.metadata.eigenvalues.clone(),
        notes: domain.metadata.notes.clone().into_iter().collect(),
        follows: domain.follows.map(|follow| follow.parent as u32),
        follow_frame: domain.follows.map(|follow| transform_bytes(&follow.frame)).unwrap_or_default(),
    }
}

fn array_bytes(scene: &Scene, domain: usize, array: v1::Array) -> &[u8] {
    let mesh = &scene.shape_of(domain).mesh;
    let corners = mesh.corners();
    match array {
        v1::Array::Unspecified => &[],
        v1::Array::Indices => bytemuck::cast_slice(mesh.triangles()),
        v1::Array::CornerVertices => bytemuck::cast_slice(&corners.vertices),
        v1::Array::RestPositions => bytemuck::cast_slice(mesh.rest_positions()),
        v1::Array::Uvs => bytemuck::cast_slice(&corners.uvs),
        v1::Array::RestNormals => bytemuck::cast_slice(&corners.normals),
    }
}
