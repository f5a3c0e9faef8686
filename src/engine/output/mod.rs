//! Outputs of steps: frames, AOVs (arbitrary output variables, such as depth), picks, vertices and states, and their
//! encoding for the wire off the device thread.

mod encoder_pool;
pub(super) mod frame_encoder;
pub(super) mod frame_format;
pub(super) mod frame_queue;
pub(super) mod output_spec;
pub(super) mod pack;
pub(super) mod pick_result;
pub(super) mod rendered_picture;
pub(super) mod state_packing;
pub(super) mod step_output;
pub(super) mod step_vertices;
pub(super) mod vertex_encoding;
pub(super) mod vertex_selection;
