//! One open scene: its actor, the queue of steps from the writer, the delivery of outputs to subscribers, and the
//! forces that viewers apply.

pub(super) mod actor;
mod current_step;
mod current_writer;
pub(super) mod delivery;
pub(super) mod encoded_subscription;
pub(super) mod force_subscription;
pub(super) mod forces;
pub(super) mod frame_stream;
pub(super) mod handle;
pub(super) mod lease;
pub(super) mod message;
mod output_delivery;
mod output_producer;
mod outputs_in_flight;
mod stall_budget;
pub(super) mod step_queue;
pub(super) mod subscriber;
pub(super) mod work_timer;
