//! Writes the uniforms of a frame and resets its counters, with stream-ordered commands: frames in flight keep their
//! own values.

use super::draw::bind_scene;
use super::recorder::PassRecorder;
use crate::layout::cull::COUNTER_BYTES;
use crate::pass::Pass;
use crate::resources::scene_buffers::SceneBuffers;
use crate::types::FrameParams;
use crate::uniforms::cascades::ShadowCascades;
use crate::uniforms::frame::{FrameUniforms, light_box_params};

/// Writes and binds the uniforms of a picture.
pub(crate) fn upload(recorder: &PassRecorder<'_>, buffers: &SceneBuffers, shot: &FrameParams, frame: &FrameUniforms) {
    recorder.begin(Pass::UniformUpload);
    upload_frame(buffers, frame);
    if let Some(culler) = &buffers.culler {
        culler.buffers.counters.write(&[0; COUNTER_BYTES]);
    }
    if let Some(cascades) = &buffers.uniforms.cascades {
        let fit = light_box_params(&buffers.scene, shot, buffers.origin);
        cascades.write(bytemuck::bytes_of(&ShadowCascades::new(&buffers.scene, shot, &fit, buffers.origin)));
    }
}

/// Writes and binds the uniforms of an output that is drawn without shadow and without culling.
pub(super) fn upload_frame(buffers: &SceneBuffers, frame: &FrameUniforms) {
    buffers.uniforms.frame.write(bytemuck::bytes_of(frame));
    bind_scene(buffers);
}
