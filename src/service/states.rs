//! `StateService`: sends q and transforms, either of one step or of every step of a stream. A state is sent in chunks,
//! the first of which has a head that lists the sections of the state.

use std::sync::Arc;

use modalcast_proto::v1;
use tonic::{Request, Response, Status};
use v1::stream_states_response::Part;

use super::caller::Caller;
use super::convert::{
    describe_step_selector, parse_step_selector, parse_stream_delivery, right_to_receive, wire_stages, wire_step_id,
};
use super::sent_steps::SentSteps;
use super::status::to_status;
use super::stream::{Deadline, ReplySender, ReplyStream, chunks_with_head, respond, run_while_permitted};
use crate::engine::{
    Engine, OutputSpec, PackedState, SceneRight, StateContent, StateSection, Subscription, pack_state,
};
use modalcast_model::domain::Transform;
use modalcast_model::scene::Scene;

/// Upper bound on the bytes of the heads of all chunks of a state, apart from their data.
const HEAD_BYTES: usize = 4 << 10;

/// Upper bound on the bytes of a packed state: coordinates, and per domain two indices, a transform and an origin.
fn max_state_bytes(scene: &Scene) -> usize {
    size_of::<f32>() * scene.layout.coordinates
        + (2 * size_of::<u32>() + size_of::<Transform>() + size_of::<[f64; 3]>()) * scene.domains.len()
        + HEAD_BYTES
}

/// Implementation of `StateService`.
pub(super) struct StateServiceImpl(pub(super) Engine);

#[tonic::async_trait]
impl v1::state_service_server::StateService for StateServiceImpl {
    type GetStateStream = ReplyStream<v1::GetStateResponse>;

    async fn get_state(&self, request: Request<v1::GetStateRequest>) -> Result<Response<Self::GetStateStream>, Status> {
        let config = self.0.config();
        let deadline = Deadline::of_request(request.metadata(), request.get_ref().deadline_ms, config);
        let Caller { principal, account, replies, .. } = Caller::of(&request)?;
        let request = request.into_inner();
        let scene_handle = self.0.find_opened(&request.scene, &principal, SceneRight::Use).await.map_err(to_status)?;
        let selector = parse_step_selector(request.step);
        let max_chunk_bytes = config.chunk_bytes;
        Ok(respond(replies, move |reply_sender| async move {
            let work = async {
                let output =
                    scene_handle.request_output(&account, selector, OutputSpec::State).await.map_err(to_status)?;
                let mut reply = reply_sender.reserve_whole(max_state_bytes(&scene_handle.scene)).await?;
                let packed = pack_state(output, &scene_handle.scene, None).await.map_err(to_status)?;
                reply.shrink_to(packed.bytes.len() + HEAD_BYTES);
                for chunk in state_chunks(&packed, max_chunk_bytes) {
                    reply.send(v1::GetStateResponse { chunk: Some(chunk) }).await?;
                }
                Ok(())
            };
            deadline.enforce(&describe_step_selector(selector, &scene_handle.name), work).await
        }))
    }

    type StreamStatesStream = ReplyStream<v1::StreamStatesResponse>;

    async fn stream_states(
        &self,
        request: Request<v1::StreamStatesRequest>,
    ) -> Result<Response<Self::StreamStatesStream>, Status> {
        let deadline = Deadline::of_stream(request.metadata());
        let Caller { principal, account, replies, .. } = Caller::of(&request)?;
        let request = request.into_inner();
        let delivery = parse_stream_delivery(request.delivery, request.max_hz).map_err(to_status)?;
        let right = right_to_receive(delivery);
        let scene_handle = self.0.find_opened(&request.scene, &principal, right).await.map_err(to_status)?;
        // Subscribe before the response headers are sent, so that a client can rely on receiving the next step.
        let subscription = scene_handle.subscribe(&account, OutputSpec::State, delivery).await.map_err(to_status)?;
        let settings = v1::StateStreamSettings {
            delivery: request.delivery,
            max_hz: request.max_hz,
            steps: request.steps,
            stages_every: request.stages_every,
        };
        let right_ended = scene_handle.right_ended(&principal, right);
        let scene = Arc::clone(&scene_handle.scene);
        let state_stream = StateStream { scene, max_chunk_bytes: self.0.config().chunk_bytes, settings };
        Ok(respond(replies, move |reply_sender| {
            let work = run_while_permitted(right_ended, state_stream.run(subscription, reply_sender));
            deadline.enforce("the stream of states", work)
        }))
    }
}

/// Parameters of a stream of states.
struct StateStream {
    scene: Arc<Scene>,
    max_chunk_bytes: usize,
    settings: v1::StateStreamSettings,
}

impl StateStream {
    async fn run(
        self,
        mut subscription: Subscription,
        reply_sender: ReplySender<v1::StreamStatesResponse>,
    ) -> Result<(), Status> {
        let to_response = |part| v1::StreamStatesResponse { part: Some(part) };
        reply_sender.send(to_response(Part::Settings(self.settings))).await?;
        let work_timer = Arc::clone(subscription.work_timer());
        let (mut sent_steps, mut sent_count, mut previous_state) = (SentSteps::default(), 0, None);
        while self.settings.steps == 0 || sent_count < self.settings.steps {
            let output = tokio::select! {
                output = work_timer.measure(subscription.next()) => output.map_err(|error| sent_steps.end(error, None))?,
                () = reply_sender.closed() => return Ok(()),
            };
            let step = output.step;
            let send_state = async {
                let mut reply = reply_sender.reserve_whole(max_state_bytes(&self.scene)).await?;
                let pack = pack_state(output, &self.scene, previous_state);
                let mut packed = work_timer.measure(pack).await.map_err(to_status)?;
                reply.shrink_to(packed.bytes.len() + HEAD_BYTES);
                // A division by 0 has no remainder: no state has stages then.
                if sent_count.checked_rem(u64::from(self.settings.stages_every)) != Some(0) {
                    packed.stages.clear();
                }
                for chunk in state_chunks(&packed, self.max_chunk_bytes) {
                    reply.send(to_response(Part::Chunk(chunk))).await?;
                }
                Ok(packed.state)
            };
            let sent_state = tokio::select! {
                sent = send_state => sent,
                error = subscription.disconnected() => Err(sent_steps.end(error, Some(step))),
            };
            previous_state = Some(sent_state?);
            sent_steps.complete(step);
            sent_count += 1;
        }
        Ok(())
    }
}

/// Splits a state into chunks, of which the first has the head.
fn state_chunks(packed: &PackedState, max_chunk_bytes: usize) -> impl Iterator<Item = v1::StateChunk> + use<> {
    let head = v1::StateHead {
        step: Some(wire_step_id(packed.step)),
        skipped: packed.skipped,
        complete: packed.is_complete,
        sections: packed.sections.iter().map(wire_section).collect(),
        total: packed.bytes.len() as u64,
        stages: wire_stages(&packed.stages),
    };
    chunks_with_head(head, packed.bytes.clone(), max_chunk_bytes, |head, offset, data| v1::StateChunk {
        head,
        offset,
        data,
    })
}

fn wire_section(section: &StateSection) -> v1::StateSection {
    let content = match section.content {
        StateContent::QDomains => v1::StateContent::QDomains,
        StateContent::Q => v1::StateContent::Q,
        StateContent::TransformDomains => v1::StateContent::TransformDomains,
        StateContent::Transforms => v1::StateContent::Transforms,
        StateContent::Origins => v1::StateContent::Origins,
    };
    v1::StateSection { content: content.into(), offset: section.offset, bytes: section.bytes }
}
