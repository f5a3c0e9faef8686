//! Pick replies. The first message has a head. Hits are sent in messages of limited size.

use bytes::Bytes;
use modalcast_proto::v1;
use tonic::Status;

use super::caller::Caller;
use super::convert::{describe_step_selector, parse_pick, parse_step_selector, wire_stages, wire_step_id};
use super::status::to_status;
use super::stream::{Deadline, ReplyStream, respond};
use crate::engine::{Engine, ModalHit, PickResult, SceneRight, resolve_picks};
use modalcast_model::scene::Scene;

/// Upper bound on the encoded size of a hit without its modes, in bytes.
const MAX_HIT_BYTES: usize = 256;

/// Answers one pick request.
pub(super) async fn respond_to_pick(
    engine: &Engine,
    caller: Caller,
    deadline: Deadline,
    request: v1::PickRequest,
) -> Result<tonic::Response<ReplyStream<v1::PickResponse>>, Status> {
    let scene_handle =
        engine.find_opened(&request.scene, &caller.principal, SceneRight::Use).await.map_err(to_status)?;
    let output_spec = parse_pick(engine, &scene_handle.scene, &request).map_err(to_status)?;
    let selector = parse_step_selector(request.step);
    let max_chunk_bytes = engine.config().chunk_bytes;
    Ok(respond(caller.replies, move |reply_sender| async move {
        let work = async {
            let output =
                scene_handle.request_output(&caller.account, selector, output_spec).await.map_err(to_status)?;
            let pick_result =
                resolve_picks(output, &scene_handle.scene, !request.without_modes).await.map_err(to_status)?;
            for response in split_reply(&pick_result, &scene_handle.scene, max_chunk_bytes) {
                reply_sender.send(response).await?;
            }
            Ok(())
        };
        deadline.enforce(&describe_step_selector(selector, &scene_handle.name), work).await
    }))
}

/// Splits a reply into at least one message. The hits of a message have at most `max_chunk_bytes` bytes, unless a
/// single hit is larger. The head of the first message is not counted.
fn split_reply(picks: &PickResult, scene: &Scene, max_chunk_bytes: usize) -> Vec<v1::PickResponse> {
    let head = v1::PickHead {
        step: Some(wire_step_id(picks.step)),
        hits: picks.hits.len() as u32,
        stages: wire_stages(&picks.stages),
    };
    let mut responses = vec![v1::PickResponse { head: Some(head), hits: Vec::new() }];
    let mut response_bytes = 0;
    for modal_hit in &picks.hits {
        let hit_bytes = MAX_HIT_BYTES + size_of_val(modal_hit.modes.as_slice());
        if response_bytes > 0 && response_bytes + hit_bytes > max_chunk_bytes {
            responses.push(v1::PickResponse::default());
            response_bytes = 0;
        }
        response_bytes += hit_bytes;
        if let Some(last_response) = responses.last_mut() {
            last_response.hits.push(wire_hit(modal_hit, scene));
        }
    }
    responses
}

fn wire_hit(modal_hit: &ModalHit, scene: &Scene) -> v1::Hit {
    let hit = &modal_hit.hit;
    v1::Hit {
        x: hit.pixel[0],
        y: hit.pixel[1],
        domain: hit.domain as u32,
        triangle: hit.triangle as u32,
        vertices: hit.vertices.to_vec(),
        barycentric: hit.barycentrics.to_vec(),
        position: hit.position.to_vec(),
        normal: hit.normal.to_vec(),
        depth: scene.unit * hit.depth,
        linear: modal_hit.linear.to_vec(),
        rank: scene.layout.domains[hit.domain].rank as u32,
        modes: modal_hit.modes.iter().flat_map(|entry| entry.to_le_bytes()).collect::<Bytes>(),
    }
}
