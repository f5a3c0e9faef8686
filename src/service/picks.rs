//! Pick replies: a head, then the hits in messages of limited size.

use bytes::Bytes;
use modalcast_proto::v1;
use tonic::Status;

use super::convert::{describe_step_selector, pick, stages, step_id};
use super::status::status;
use super::stream::{Deadline, ReplyStream, respond};
use crate::engine::{Engine, ModalHit, PickResult, StepSelector, resolve_picks};
use modalcast_model::scene::Scene;

/// Upper bound on the size of a hit without its modes, in bytes.
const MAX_HIT_BYTES: usize = 256;

/// Answers one pick request.
pub(super) fn answer(
    engine: &Engine,
    deadline: Deadline,
    request: v1::PickRequest,
) -> Result<tonic::Response<ReplyStream<v1::PickResponse>>, Status> {
    let scene_handle = engine.find(&request.scene).map_err(status)?;
    let view = pick(engine, &scene_handle.scene, &request).map_err(status)?;
    let selector = StepSelector::from(request.step);
    let most = engine.config().chunk_bytes;
    Ok(respond(move |reply_sender| async move {
        let work = async {
            let output = scene_handle.request_output(selector, view).await.map_err(status)?;
            let picks = resolve_picks(output, &scene_handle.scene, !request.without_modes).await.map_err(status)?;
            for response in responses(&picks, &scene_handle.scene, most) {
                reply_sender.send(response).await?;
            }
            Ok(())
        };
        deadline.enforce(&describe_step_selector(selector, &scene_handle.name), work).await
    }))
}

/// Splits a reply into messages of about `most` bytes; at least one message.
fn responses(picks: &PickResult, scene: &Scene, most: usize) -> Vec<v1::PickResponse> {
    let head =
        v1::PickHead { step: Some(step_id(picks.step)), hits: picks.hits.len() as u32, stages: stages(&picks.stages) };
    let mut responses = vec![v1::PickResponse { head: Some(head), hits: Vec::new() }];
    let mut bytes = 0;
    for picked in &picks.hits {
        let own = MAX_HIT_BYTES + 4 * picked.modes.len();
        if bytes > 0 && bytes + own > most {
            responses.push(v1::PickResponse::default());
            bytes = 0;
        }
        bytes += own;
        if let Some(last) = responses.last_mut() {
            last.hits.push(hit(picked, scene));
        }
    }
    responses
}

fn hit(picked: &ModalHit, scene: &Scene) -> v1::Hit {
    let hit = &picked.hit;
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
        linear: picked.linear.to_vec(),
        rank: scene.layout.domains[hit.domain].rank as u32,
        modes: picked.modes.iter().flat_map(|entry| entry.to_le_bytes()).collect::<Bytes>(),
    }
}
