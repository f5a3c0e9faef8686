//! The device thread. A [`handle::DeviceHandle`] sends commands ([`command`]) over a bounded queue to the loop
//! ([`device_loop`]), which owns the device context ([`context`]), the loaded scenes ([`loaded_scene`]) and the
//! readbacks in flight.

pub(super) mod command;
pub(super) mod context;
mod device_loop;
mod device_loss;
pub(super) mod handle;
mod in_flight;
pub(super) mod loaded_scene;
pub(super) mod scalar_field;
