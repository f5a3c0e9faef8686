//! Describes a scene completely for clients without a copy of it: domains, mesh arrays and rows of U, in chunks of at
//! most 1 MiB.

use std::sync::Arc;

use bytes::Bytes;
use modalcast_proto::v1;
use modalcast_proto::v1::describe_scene_response::Part;
use prost::Message as _;
use tonic::{Response, Status};

use super::convert::scene_info;
use super::stream::{ReplySender, ReplyStream, respond};
use crate::engine::{SceneHandle, validate_domains};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Scene;

/// Describes the selected domains and sends the requested arrays.
pub(super) fn scene(
    scene_handle: Arc<SceneHandle>,
    request: v1::DescribeSceneRequest,
    most: usize,
) -> Result<Response<ReplyStream<v1::DescribeSceneResponse>>> {
    let domains = validate_domains("domains", &scene_handle.scene, request.domains)?;
    let arrays = request.arrays.into_iter().map(array).collect::<Result<Vec<_>>>()?;
    if arrays.len() > 5 {
        return Err(invalid("arrays", "at most 5", arrays.len()));
    }
    Ok(respond(move |reply_sender| async move {
        reply_sender.send(part(Part::Scene(scene_info(&scene_handle, true)))).await?;
        send_descriptions(&scene_handle.scene, &domains, most, &reply_sender).await?;
        for domain in domains {
            for array in &arrays {
                let bytes = array_bytes(&scene_handle.scene, domain as usize, *array);
                let total = bytes.len() as u64;
                // Copies one chunk at a time. An empty array is one empty chunk.
                for start in (0..bytes.len().max(1)).step_by(most) {
                    let data = Bytes::copy_from_slice(&bytes[start..bytes.len().min(start + most)]);
                    let offset = start as u64;
                    let chunk = v1::ArrayChunk { domain, array: (*array).into(), offset, total, data };
                    reply_sender.send(part(Part::Chunk(chunk))).await?;
                }
            }
        }
        Ok(())
    }))
}

/// Sends rows of one domain's U: three per requested vertex.
pub(super) fn modes(
    scene_handle: Arc<SceneHandle>,
    request: v1::ReadModesRequest,
    most: usize,
) -> Result<Response<ReplyStream<v1::ReadModesResponse>>> {
    let count = scene_handle.scene.domains.len();
    if request.domain as usize >= count {
        return Err(invalid("domain", format!("an index below {count}"), request.domain));
    }
    let shape = scene_handle.scene.shape_of(request.domain as usize);
    let (vertices, rank) = (shape.mesh.rest_positions().len(), shape.modes.rank());
    let chosen = match request.vertices {
        all if all.is_empty() => (0..vertices as u32).collect(),
        some => some,
    };
    if chosen.len() > vertices {
        return Err(invalid("vertices", format!("at most {vertices} indices"), chosen.len()));
    }
    if let Some(at) = chosen.iter().position(|vertex| *vertex as usize >= vertices) {
        return Err(invalid(format!("vertices[{at}]"), format!("an index below {vertices}"), chosen[at]));
    }
    // Chunks end between vertices, so that only one chunk of rows is in memory at a time.
    let row_bytes = 12 * rank;
    let per_chunk = (most / row_bytes.max(1)).max(1);
    let total = (row_bytes * chosen.len()) as u64;
    Ok(respond(move |reply_sender: ReplySender<v1::ReadModesResponse>| async move {
        let modes = &scene_handle.scene.shape_of(request.domain as usize).modes;
        for (index, group) in chosen.chunks(if rank == 0 { chosen.len() } else { per_chunk }).enumerate() {
            let row = |row: usize| (0..rank).map(move |mode| modes.column(mode)[row]);
            let rows = group.iter().flat_map(|vertex| (0..3).map(move |component| 3 * *vertex as usize + component));
            let data: Vec<u8> = rows.flat_map(row).flat_map(f32::to_le_bytes).collect();
            let offset = (index * per_chunk * row_bytes) as u64;
            reply_sender.send(v1::ReadModesResponse { rank: rank as u32, offset, total, data: data.into() }).await?;
        }
        Ok(())
    }))
}

const fn part(part: Part) -> v1::DescribeSceneResponse {
    v1::DescribeSceneResponse { part: Some(part) }
}

fn array(number: i32) -> Result<v1::Array> {
    match v1::Array::try_from(number) {
        Ok(v1::Array::Unspecified) | Err(_) => Err(invalid("arrays", "arrays of this version", number)),
        Ok(array) => Ok(array),
    }
}

/// Sends the descriptions, as many per message as fit a chunk.
async fn send_descriptions(
    scene: &Scene,
    domains: &[u32],
    most: usize,
    reply_sender: &ReplySender<v1::DescribeSceneResponse>,
) -> Result<(), Status> {
    let mut group = v1::DomainDescriptions::default();
    let mut size = 0;
    for domain in domains {
        let description = describe(scene, *domain);
        let more = description.encoded_len() + 8;
        if size + more > most && !group.domains.is_empty() {
            reply_sender.send(part(Part::Domains(std::mem::take(&mut group)))).await?;
            size = 0;
        }
        size += more;
        group.domains.push(description);
    }
    reply_sender.send(part(Part::Domains(group))).await
}

fn describe(scene: &Scene, index: u32) -> v1::DomainDescription {
    let domain = &scene.domains[index as usize];
    let slot = scene.layout.domains[index as usize];
    let numbers = |transform: &modalcast_model::domain::Transform| -> Bytes {
        transform.0.into_iter().flat_map(f32::to_le_bytes).collect::<Vec<u8>>().into()
    };
    let attachment = domain.attachment.as_ref();
    v1::DomainDescription {
        domain: index,
        name: domain.name.clone(),
        vertices: slot.vertices as u32,
        rank: slot.rank as u32,
        corners: slot.corners as u32,
        triangles: slot.triangles as u32,
        parent: attachment.map(|attachment| attachment.parent as u32),
        attachment_frame: attachment.map(|attachment| numbers(&attachment.frame)).unwrap_or_default(),
        attachment_rows: attachment.map(|attachment| attachment.rows.clone()).unwrap_or_default(),
        placement: numbers(&domain.placement),
        shares_q_with: domain.shares_q_with.map(|twin| twin as u32),
        shape: domain.shape as u32,
        eigenvalues: domain.metadata.eigenvalues.clone(),
        notes: domain.metadata.notes.clone().into_iter().collect(),
        follows: domain.follows.map(|follow| follow.parent as u32),
        follow_frame: domain.follows.map(|follow| numbers(&follow.frame)).unwrap_or_default(),
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
