//! `ForceService`: forces from viewers, and the stream of all forces for a physics process.

use std::time::Duration;

use modalcast_proto::v1;
use tonic::{Request, Response, Status};
use v1::force::Kind;

use super::caller::Caller;
use super::convert::{parse_stream_delivery, wire_step_id};
use super::status::to_status;
use super::stream::{Deadline, ReplySender, ReplyStream, respond, run_while_permitted};
use crate::engine::{
    AppliedForce, Engine, Force, ForceKind, ForceOwner, ForceReceipt, ForceReport, ForceSubscription, ForceUpdate,
    SceneRight, check_force_count,
};
use modalcast_model::error::{Result as ModelResult, invalid};
use modalcast_model::scene::Scene;

/// Implementation of `ForceService`.
pub(super) struct ForceServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::force_service_server::ForceService for ForceServiceImpl {
    async fn apply_forces(
        &self,
        request: Request<v1::ApplyForcesRequest>,
    ) -> Result<Response<v1::ApplyForcesResponse>, Status> {
        let principal = Caller::of(&request)?.principal;
        let request = request.into_inner();
        let scene_handle = self.0.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        let update = parse_force_update(&scene_handle.scene, &request).map_err(to_status)?;
        let ForceReceipt { owner, receivers } = scene_handle.apply_forces(&update).map_err(to_status)?;
        let lifetime_ms = update.lifetime.as_millis() as u32;
        Ok(Response::new(v1::ApplyForcesResponse { owner, lifetime_ms, receivers: receivers as u32 }))
    }

    type StreamForcesStream = ReplyStream<v1::StreamForcesResponse>;

    async fn stream_forces(
        &self,
        request: Request<v1::StreamForcesRequest>,
    ) -> Result<Response<Self::StreamForcesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let Caller { principal, replies, .. } = Caller::of(&request)?;
        let request = request.into_inner();
        let scene_handle = self.0.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        let delivery = parse_stream_delivery(v1::Delivery::Latest.into(), request.max_hz).map_err(to_status)?;
        let right_ended = scene_handle.right_ended(&principal, SceneRight::Use);
        let subscription = ForceSubscription::new(scene_handle, delivery, request.passive).map_err(to_status)?;
        Ok(respond(replies, move |reply_sender| {
            let work = run_while_permitted(right_ended, send_reports(subscription, reply_sender));
            deadline.enforce("the stream of forces", work)
        }))
    }
}

/// Sends the newest forces whenever the channel has capacity.
async fn send_reports(
    mut subscription: ForceSubscription,
    reply_sender: ReplySender<v1::StreamForcesResponse>,
) -> Result<(), Status> {
    loop {
        reply_sender.wait_for_capacity().await?;
        let report = tokio::select! {
            report = subscription.next() => report.map_err(to_status)?,
            () = reply_sender.closed() => return Ok(()),
        };
        reply_sender.send(wire_report(&report)).await?;
    }
}

fn parse_force_update(scene: &Scene, request: &v1::ApplyForcesRequest) -> ModelResult<ForceUpdate> {
    let owner = ForceOwner::parse("owner", &request.owner)?;
    check_force_count(request.forces.len())?;
    let parse_indexed =
        |(index, force)| parse_force(scene, force).map_err(|error| error.in_message(&format!("forces[{index}]")));
    let forces = request.forces.iter().enumerate().map(parse_indexed).collect::<ModelResult<_>>()?;
    ForceUpdate::new(owner, forces, Duration::from_millis(request.lifetime_ms.into()))
}

fn parse_force(scene: &Scene, force: &v1::Force) -> ModelResult<Force> {
    let (id, domain) = (force.id, force.domain);
    match &force.kind {
        Some(Kind::Surface(surface)) => {
            Force::on_surface(scene, id, domain, surface.triangle, &surface.barycentric, &surface.vector)
        }
        Some(Kind::Modal(modal)) => Force::on_modes(scene, id, domain, &modal.f_q),
        None => Err(invalid("kind", "a surface force or a modal force", "none")),
    }
}

fn wire_report(report: &ForceReport) -> v1::StreamForcesResponse {
    v1::StreamForcesResponse {
        step: report.step.map(wire_step_id),
        receiver_error: report.receiver_error.to_string(),
        forces: report.forces.iter().map(wire_applied_force).collect(),
    }
}

fn wire_applied_force(applied: &AppliedForce) -> v1::AppliedForce {
    let Force { id, domain, kind } = &applied.force;
    let kind = match kind {
        ForceKind::Surface { triangle, barycentrics, newtons } => Kind::Surface(v1::SurfaceForce {
            triangle: *triangle,
            barycentric: barycentrics.to_vec(),
            vector: newtons.to_vec(),
        }),
        ForceKind::Modal(_) => Kind::Modal(v1::ModalForce::default()),
    };
    v1::AppliedForce {
        owner: applied.owner,
        force: Some(v1::Force { id: *id, domain: *domain, kind: Some(kind) }),
        f_q: bytemuck::cast_slice(&applied.f_q).to_vec().into(),
        rest_point: applied.rest_point.map_or(vec![], Into::into),
    }
}
