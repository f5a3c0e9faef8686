//! Pick replies: a head, then the hits in messages of limited size.

use bytes::Bytes;
use modalcast_proto::v1;
use tonic::Status;

use super::convert::{pick, said, stages, step_id, which_of_pick};
use super::status::status;
use super::stream::{Deadline, Replies, respond};
use crate::engine::{Engine, Picked, Picks, resolve_picks};
use modalcast_model::scene::Scene;

/// Upper bound on the size of a hit without its modes, in bytes.
const HIT_BYTES: usize = 256;

/// Answers one pick request.
pub(super) fn answer(
    engine: &Engine,
    deadline: Deadline,
    request: v1::PickRequest,
) -> Result<tonic::Response<Replies<v1::PickResponse>>, Status> {
    let host = engine.find(&request.scene).map_err(status)?;
    let view = pick(engine, &host.scene, &request).map_err(status)?;
    let which = which_of_pick(request.step.as_ref());
    let most = engine.config().chunk_bytes;
    Ok(respond(move |outlet| async move {
        let work = async {
            let shown = host.show(which, view).await.map_err(status)?;
            let picks = resolve_picks(shown, &host.scene, !request.without_modes).await.map_err(status)?;
            for response in responses(&picks, &host.scene, most) {
                outlet.send(response).await?;
            }
            Ok(())
        };
        deadline.hold(&said(which, &host.name), work).await
    }))
}

/// Splits a reply into messages of about `most` bytes; at least one message.
fn responses(picks: &Picks, scene: &Scene, most: usize) -> Vec<v1::PickResponse> {
    let head =
        v1::PickHead { step: Some(step_id(picks.step)), hits: picks.hits.len() as u32, stages: stages(&picks.stages) };
    let mut responses = vec![v1::PickResponse { head: Some(head), hits: Vec::new() }];
    let mut bytes = 0;
    for picked in &picks.hits {
        let own = HIT_BYTES + 4 * picked.modes.len();
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

fn hit(picked: &Picked, scene: &Scene) -> v1::Hit {
    let hit = &picked.hit;
    v1::Hit {
        x: hit.pixel[0],
        y: hit.pixel[1],
        domain: hit.domain as u32,
        triangle: hit.triangle as u32,
        vertices: hit.vertices.to_vec(),
        barycentric: hit.shares.to_vec(),
        position: hit.position.to_vec(),
        normal: hit.normal.to_vec(),
        depth: scene.unit * hit.depth,
        linear: picked.linear.to_vec(),
        rank: scene.layout.slots[hit.domain].rank as u32,
        modes: picked.modes.iter().flat_map(|entry| entry.to_le_bytes()).collect::<Bytes>(),
    }
}
