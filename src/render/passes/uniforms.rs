//! Writes the uniforms of a frame and resets its counters. The commands are stream-ordered, so frames in flight keep
//! their values.

use super::draw::bind_scene;
use super::recorder::PassRecorder;
use crate::layout::TRIANGLE_ID_UNIT;
use crate::layout::cull::CULL_COUNTER_BYTES;
use crate::pass::Pass;
use crate::resources::scene_buffers::SceneBuffers;
use crate::types::FrameParams;
use crate::uniforms::cascades::ShadowCascades;
use crate::uniforms::frame::{FrameUniforms, light_box_params};

/// Writes and binds the uniforms of a frame, and resets its culling counters.
pub(crate) fn upload(recorder: &PassRecorder<'_>, buffers: &SceneBuffers, params: &FrameParams, frame: &FrameUniforms) {
    recorder.begin(Pass::UniformUpload);
    upload_frame(buffers, frame);
    if let Some(cull_resources) = &buffers.cull_resources {
        cull_resources.buffers.counters.write(&[0; CULL_COUNTER_BYTES]);
    }
    if let Some(cascades) = &buffers.uniforms.cascades {
        let box_params = light_box_params(&buffers.scene, &buffers.look, params, buffers.origin);
        cascades.write(bytemuck::bytes_of(&ShadowCascades::new(&buffers.scene, params, &box_params, buffers.origin)));
    }
}

/// Binds the uniforms, buffers and textures of a scene for a further draw step of a frame, whose uniforms are written.
pub(crate) fn bind(buffers: &SceneBuffers) {
    bind_scene(buffers);
    if let Some(cull_resources) = &buffers.cull_resources {
        cull_resources.triangle_ids.bind(TRIANGLE_ID_UNIT);
    }
}

/// Writes the frame uniforms, and binds the buffers and textures of the scene. Outputs without shadow and culling need
/// only this call.
pub(super) fn upload_frame(buffers: &SceneBuffers, frame: &FrameUniforms) {
    buffers.uniforms.frame.write(bytemuck::bytes_of(frame));
    bind_scene(buffers);
}
