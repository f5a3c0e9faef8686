//! Starts the outputs of a scene's current step: pictures, picks and copies of vertices. The readers of an output get it
//! at once and wait for the device themselves. Equal outputs are shared.

use std::cmp::Ordering;
use std::sync::{Arc, Weak};

use super::current_step::CurrentStep;
use super::frame_stream::CameraState;
use super::message::StepSelector;
use super::outputs_in_flight::OutputsInFlight;
use super::subscriber::Subscriber;
use crate::engine::device::command::SceneId;
use crate::engine::device::handle::{DeviceHandle, PendingReply};
use crate::engine::output::output_spec::{OutputSpec, PictureContent, PictureSpec};
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::engine::output::step_output::{OutputBody, SharedPicture, StepFrames, StepOutput};
use crate::engine::output::step_vertices::StepVertices;
use modalcast_model::deform::VertexAttributes;
use modalcast_model::error::{Error, Result};
use modalcast_render::MAX_FRAMES_IN_FLIGHT;

/// How the current step is delivered to subscribers.
#[derive(Debug, Clone, Copy)]
pub(super) struct DeliveryMode {
    /// Whether another step is queued. Its frame will show a moved camera, too.
    pub overlaps_next_step: bool,
}

/// The vertex attributes that a subscriber requests of the current step. `None` if it has no credit or has received the
/// step.
pub(super) fn attributes_for(subscriber: &Subscriber, current: &CurrentStep) -> Option<VertexAttributes> {
    match subscriber.spec {
        OutputSpec::Vertices(attributes)
            if subscriber.delivered_step_count < current.step_count && subscriber.has_credit() =>
        {
            Some(attributes)
        }
        _ => None,
    }
}

/// What all readers of the current step need together, so that one output serves them all.
#[derive(Debug, Clone, Copy)]
pub(super) struct SharedNeeds {
    pub attributes: VertexAttributes,
    /// The forms in which color pictures are read.
    pub content: PictureContent,
}

impl SharedNeeds {
    /// The needs of a single request.
    fn of_request() -> Self {
        Self { attributes: VertexAttributes::default(), content: PictureContent::PIXELS }
    }
}

/// Identifies a scene that is loaded on the device.
pub(super) struct SceneOnDevice {
    pub name: String,
    pub id: SceneId,
}

/// A picture of the current step that was started.
struct StartedPicture {
    spec: PictureSpec,
    content: PictureContent,
    /// Gone when no reader has the picture any longer.
    picture: Weak<PendingReply<Arc<RenderedPicture>>>,
}

/// A copy of the current step's vertices that was started.
struct StartedCopy {
    attributes: VertexAttributes,
    vertices: Arc<PendingReply<Arc<StepVertices>>>,
}

/// Starts outputs of the current step.
pub(super) struct OutputProducer {
    scene_on_device: SceneOnDevice,
    device: DeviceHandle,
    pub(super) in_flight: OutputsInFlight,
    pictures: Vec<StartedPicture>,
    /// The newest copy. It is kept for later readers until the next step.
    copy: Option<StartedCopy>,
}

impl OutputProducer {
    pub(super) fn new(scene_on_device: SceneOnDevice, device: DeviceHandle) -> Self {
        let in_flight = OutputsInFlight::new(device.loss().clone());
        Self { scene_on_device, device, in_flight, pictures: Vec::new(), copy: None }
    }

    pub(super) fn scene_name(&self) -> &str {
        &self.scene_on_device.name
    }

    /// Forgets the outputs of the previous step.
    pub(super) fn begin_step(&mut self) {
        self.pictures.clear();
        self.copy = None;
    }

    /// Delivers the current step to one subscriber. Returns false if the subscriber must be dropped.
    pub(super) async fn serve(
        &mut self,
        subscriber: &mut Subscriber,
        current: &CurrentStep,
        mode: DeliveryMode,
        needs: SharedNeeds,
    ) -> bool {
        let is_new_step = subscriber.delivered_step_count < current.step_count;
        let redraws = !mode.overlaps_next_step && subscriber.has_moved_camera();
        if !is_new_step && !redraws {
            return true;
        }
        if !subscriber.has_credit() {
            return true;
        }
        let cameras = subscriber.take_pictures();
        let start = async {
            match &cameras {
                Some(cameras) => self.start_frames(cameras, current, needs.content).await,
                None => self.start(&subscriber.spec, current, needs).await,
            }
        };
        let body = tokio::select! {
            biased;
            body = start => body,
            // The subscriber no longer waits. Dropping the outputs cancels their commands to the device.
            () = subscriber.closed() => return false,
        };
        let skipped = subscriber.mark_delivered(current.step_count);
        subscriber.send(StepOutput { skipped, ..output(current, body) })
    }

    /// Starts an output of the current step for a single request.
    pub(super) async fn answer(&mut self, spec: &OutputSpec, current: &CurrentStep) -> StepOutput {
        output(current, self.start(spec, current, SharedNeeds::of_request()).await)
    }

    /// Starts an output of the current step, or shares one that was started. A copy of vertices also includes the
    /// attributes in `needs`.
    async fn start(&mut self, spec: &OutputSpec, current: &CurrentStep, needs: SharedNeeds) -> OutputBody {
        match spec {
            OutputSpec::Frames(pictures) => {
                let cameras = CameraState { pictures: Arc::clone(pictures), camera_version: 0 };
                self.start_frames(&cameras, current, needs.content).await
            }
            OutputSpec::Pick { camera, picture, rectangle } => {
                self.wait_for_capacity(current).await;
                let hits = self.device.pick(self.scene_on_device.id, *camera, *picture, *rectangle);
                OutputBody::Pick(self.track(hits, current), Arc::clone(&current.state))
            }
            OutputSpec::Vertices(attributes) => {
                OutputBody::Vertices(self.start_copy(*attributes, needs.attributes, current).await)
            }
            OutputSpec::State => OutputBody::State(Arc::clone(&current.state)),
        }
    }

    async fn start_frames(
        &mut self,
        cameras: &CameraState,
        current: &CurrentStep,
        content: PictureContent,
    ) -> OutputBody {
        let CameraState { pictures, camera_version } = cameras;
        let mut started = Vec::with_capacity(pictures.len());
        for picture in pictures.iter() {
            started.push(self.start_picture(picture, content, current).await);
        }
        OutputBody::Frames(StepFrames { pictures: started, camera_version: *camera_version })
    }

    /// Starts a picture of the current step, or shares an equal one that another reader still has.
    async fn start_picture(
        &mut self,
        spec: &PictureSpec,
        content: PictureContent,
        current: &CurrentStep,
    ) -> SharedPicture {
        let is_equal = |started: &&StartedPicture| started.spec == *spec && started.content.can_serve(content);
        let mut equal_pictures = self.pictures.iter().filter(is_equal).filter_map(|started| started.picture.upgrade());
        // A picture that has failed is drawn again.
        if let Some(picture) = equal_pictures.find(|picture| !picture.has_failed()) {
            return picture;
        }
        self.wait_for_capacity(current).await;
        let reply = self.device.draw(self.scene_on_device.id, *spec, content);
        let picture = self.track(reply, current);
        self.pictures.retain(|started| started.picture.strong_count() > 0);
        self.pictures.push(StartedPicture { spec: *spec, content, picture: Arc::downgrade(&picture) });
        picture
    }

    /// Starts a copy of the vertices with at least these attributes, or shares one that was started. A new copy also
    /// includes `other_attributes` and those of the copy before it, so that alternating readers need no further copies.
    async fn start_copy(
        &mut self,
        attributes: VertexAttributes,
        other_attributes: VertexAttributes,
        current: &CurrentStep,
    ) -> Arc<PendingReply<Arc<StepVertices>>> {
        let mut copied_attributes = attributes.union(other_attributes);
        if let Some(copy) = self.copy.as_ref().filter(|copy| !copy.vertices.has_failed()) {
            if copy.attributes.contains(attributes) {
                return Arc::clone(&copy.vertices);
            }
            copied_attributes = copied_attributes.union(copy.attributes);
        }
        self.wait_for_capacity(current).await;
        let reply = self.device.read_vertices(self.scene_on_device.id, copied_attributes);
        let vertices = self.track(reply, current);
        self.copy = Some(StartedCopy { attributes: copied_attributes, vertices: Arc::clone(&vertices) });
        vertices
    }

    /// Waits until less than [`MAX_FRAMES_IN_FLIGHT`] outputs of the current step are in flight.
    async fn wait_for_capacity(&mut self, current: &CurrentStep) {
        while self.in_flight.count_of(current.step_count) >= MAX_FRAMES_IN_FLIGHT {
            self.in_flight.finish_oldest().await;
        }
    }

    /// Counts a command to the device as an output in flight.
    fn track<T: Clone>(&mut self, mut reply: PendingReply<T>, current: &CurrentStep) -> Arc<PendingReply<T>> {
        if let Some(end) = reply.take_end() {
            self.in_flight.push(current.step_count, end);
        }
        Arc::new(reply)
    }

    /// Whether a request can be answered now. `run` is the run of the latest writer.
    ///
    /// # Errors
    /// `StepPassed` when the scene has passed the requested exact step.
    pub(super) fn is_reached(&self, selector: StepSelector, current: &CurrentStep, run: u64) -> Result<bool> {
        let current_step = (current.state.run > 0).then_some((current.state.run, current.state.step));
        let compare = |requested_run: u64, number: u64| {
            let requested_run = if requested_run == 0 { run } else { requested_run };
            // Before the first step every requested step is in the future.
            current_step.map_or(Ordering::Less, |current_step| current_step.cmp(&(requested_run, number)))
        };
        match selector {
            StepSelector::Current => Ok(true),
            StepSelector::Minimum { run, number } => Ok(compare(run, number) != Ordering::Less),
            StepSelector::Exact { run, number } => match compare(run, number) {
                Ordering::Less => Ok(false),
                Ordering::Equal => Ok(true),
                Ordering::Greater => {
                    let (name, state) = (&self.scene_on_device.name, &current.state);
                    let expected =
                        format!("run {}, step {} (the current one of scene '{name}') or later", state.run, state.step);
                    Err(Error::StepPassed { field: "step.exact", expected, given: number.to_string() })
                }
            },
        }
    }
}

/// An output of the current step.
fn output(current: &CurrentStep, body: OutputBody) -> StepOutput {
    let (step, stages, origins) = (current.id(), current.stages.clone(), current.state.origins.clone());
    StepOutput { step, skipped: 0, stages, origins, body }
}
