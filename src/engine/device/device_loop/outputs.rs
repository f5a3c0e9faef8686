//! Draws frames and AOVs (arbitrary output variables, such as depth), and prepares their scenes before. Long work is
//! split into draw steps, and other scenes are served between them.

use std::sync::Arc;
use std::time::Instant;

use super::{DeviceLoop, answer, find_scene};
use crate::engine::device::command::{Command, SceneId};
use crate::engine::device::command_queue::{TakenWork, Work};
use crate::engine::device::in_flight::InFlight;
use crate::engine::device::partial_output::{Charge, PartialKind, PartialOutput};
use crate::engine::output::output_spec::{FrameOutput, PictureContent, PictureSpec};
use crate::engine::output::rendered_picture::RenderedPicture;
use crate::telemetry::ms_since;
use modalcast_model::scene::Framing;
use modalcast_render::ScenePreparation;

impl DeviceLoop {
    /// Returns work that can run. If a command needs textures or programs that are not on the device yet, begins to
    /// prepare them in steps and returns `None`; the command runs after the last step. A command is prepared only once:
    /// if the preparation fails, the command runs and returns the error.
    pub(super) fn prepare(&mut self, taken: TakenWork) -> Option<TakenWork> {
        let preparation = match &taken.work {
            Work::Command(command) if self.loss.error().is_none() => self.begin_preparation(command),
            _ => None,
        };
        let Some(preparation) = preparation else { return Some(taken) };
        let TakenWork { account: id, class, .. } = taken;
        self.queue.return_taken(TakenWork {
            work: match taken.work {
                Work::Command(command) => Work::Prepared(command),
                work => work,
            },
            ..taken
        });
        let charge = Charge { is_recorded: true, ..Charge::new(class, 0.0) };
        let (kind, content) = (PartialKind::Preparation(preparation), PictureContent::PIXELS);
        let output = PartialOutput { kind, content, reply: None, charge };
        self.queue.push_continuation(id, output.step_class());
        self.partial_outputs.insert(id, output);
        None
    }

    /// Begins to prepare the textures and programs that a command needs. A command that loads a
    /// scene into OpenGL needs the textures and programs of the scene. A frame that is drawn in another way than earlier
    /// frames needs further programs. `None` if there is nothing to prepare.
    fn begin_preparation(&mut self, command: &Command) -> Option<ScenePreparation> {
        let Self { context, scenes, .. } = self;
        match command {
            Command::LoadScene { scene, .. } if context.creates_buffers_at_load() => context.begin_preparation(scene),
            Command::Draw { id, .. } | Command::Pick { id, .. } if !command.is_cancelled() => {
                let loaded_scene = scenes.get(id)?;
                match (loaded_scene.buffers(), command) {
                    (Ok(buffers), Command::Draw { picture, .. }) if picture.output == FrameOutput::Color => {
                        context.begin_frame_preparation(buffers, picture.size, picture.style)
                    }
                    (Ok(_), _) => None,
                    (Err(_), _) => context.begin_preparation(loaded_scene.scene()),
                }
            }
            _ => None,
        }
    }

    /// Begins a frame or an AOV.
    pub(super) fn begin_output(&mut self, command: Command, charge: Charge) {
        let begin = Instant::now();
        if let Some(error) = self.loss.error() {
            return command.reply_error(error);
        }
        let Command::Draw { id, picture, content, reply } = command else { return };
        let PictureSpec { camera, size, output, style } = picture;
        let Self { context, scenes, loss, .. } = self;
        let kind = find_scene(scenes, id).and_then(|scene| {
            let Framing { camera, is_moved } = camera.resolve(scene.scene(), scene.current_state(), size);
            match output {
                FrameOutput::Color => context.begin_frame(scene, &camera, size, style).map(|mut frame| {
                    frame.set_reframed(is_moved);
                    PartialKind::Frame(frame)
                }),
                output => {
                    let mut draw = context.begin_aov(scene, &camera, size, output)?;
                    draw.is_reframed = is_moved;
                    Ok(PartialKind::Aov(draw))
                }
            }
        });
        let kind = match loss.record_loss(kind) {
            Ok(kind) => kind,
            Err(error) => return answer(reply, Err(error)),
        };
        let charge = Charge { spent_ms: ms_since(begin), ..charge };
        self.continue_output(id, PartialOutput { kind, content, reply: Some(reply), charge });
    }

    /// Submits the next draw step of an output, after which other scenes are served. An output without breaks is
    /// submitted whole (`has_breaks`). Drops an output whose caller no longer waits.
    pub(super) fn continue_output(&mut self, id: SceneId, mut output: PartialOutput) {
        let begin = Instant::now();
        while !output.is_submitted() {
            if output.is_cancelled() {
                return;
            }
            let Self { context, scenes, .. } = self;
            let step = match self.loss.error() {
                Some(error) => Err(error),
                None => output.submit_step(context, find_scene(scenes, id).map(|scene| &*scene)),
            };
            if let Err(error) = self.loss.record_loss(step) {
                return output.reply_error(error);
            }
            if output.has_breaks() && !output.is_submitted() {
                output.charge.last_submit_ms = ms_since(begin);
                output.charge.spent_ms += output.charge.last_submit_ms;
                if !output.charge.is_recorded {
                    let Charge { class, charged_ms, spent_ms, .. } = output.charge;
                    self.queue.record_cost(id, class, charged_ms, spent_ms);
                    output.charge.is_recorded = true;
                }
                self.queue.push_continuation(id, output.step_class());
                self.partial_outputs.insert(id, output);
                return;
            }
        }
        output.charge.spent_ms += ms_since(begin);
        self.finish_output(id, output);
    }

    /// Charges a scene for a finished output, which took `total_ms` in all steps.
    pub(super) fn record_output_cost(&self, id: SceneId, charge: Charge, total_ms: f64) {
        let Charge { class, charged_ms, spent_ms, is_recorded, .. } = charge;
        match is_recorded {
            true => self.queue.charge(id, total_ms - spent_ms),
            false => self.queue.record_cost(id, class, charged_ms, total_ms),
        }
    }

    /// Waits for an AOV and answers it. A frame is answered later.
    fn finish_output(&mut self, id: SceneId, output: PartialOutput) {
        let begin = Instant::now();
        let PartialOutput { kind, content, reply, charge } = output;
        let Self { context, scenes, .. } = self;
        match (kind, reply) {
            (PartialKind::Frame(frame), Some(reply)) => {
                let frame = find_scene(scenes, id).and_then(|scene| context.finish_frame(scene, frame, content));
                match self.loss.record_loss(frame) {
                    Ok(pending) => self.frames.push(InFlight { id, pending, charge: Some(charge), reply }),
                    Err(error) => answer(reply, Err(error)),
                }
            }
            (PartialKind::Aov(draw), Some(reply)) => {
                let is_reframed = draw.is_reframed;
                let aov = find_scene(scenes, id).and_then(|scene| context.finish_aov(scene, draw));
                let picture =
                    aov.map(|(image, legend)| Arc::new(RenderedPicture::from_aov(image, legend, is_reframed)));
                answer(reply, self.loss.record_loss(picture));
                self.record_output_cost(id, charge, charge.spent_ms + ms_since(begin));
            }
            (PartialKind::Preparation(preparation), _) => context.finish_preparation(preparation),
            (PartialKind::Frame(_) | PartialKind::Aov(_), None) => {}
        }
    }
}
