//! The device thread. A [`handle::DeviceHandle`] sends commands ([`command`]) over a bounded queue of each scene
//! ([`command_queue`]) to the loop ([`device_loop`]), which serves the scenes in turn ([`fair_queue`]). The loop owns
//! the device context ([`context`]), the loaded scenes ([`loaded_scene`]) and the readbacks in flight.

pub(super) mod command;
mod command_queue;
pub(super) mod context;
mod device_loop;
pub(super) mod device_loss;
mod fair_queue;
#[cfg(test)]
mod fairness_tests;
mod frame_log;
pub(super) mod handle;
mod in_flight;
pub(super) mod loaded_scene;
pub(super) mod loaded_worlds;
mod partial_output;
mod recovery_limit;
pub(super) mod scalar_field;
mod watchdog;
pub(super) mod work_owners;
