//! Times the upload of a step's header, transforms and q from pinned memory to the device, without any kernel.

use std::cell::RefCell;
use std::sync::Arc;

use super::measure::{Cache, Timing, time};
use super::trial::Trial;
use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::inputs::{Inputs, Listing, Packing, Pinned};
use modalcast_compute::gpu::layout::Header;
use modalcast_compute::gpu::work::Coordinates;
use modalcast_model::error::Result;
use modalcast_model::scene::{Scene, State};

/// The upload of whole steps as a trial.
struct Ingest(Inputs, RefCell<Pinned>);

impl Trial for Ingest {
    fn name(&self) -> String {
        "ingest".into()
    }

    fn turns(&self) -> usize {
        1
    }

    fn launch(&self, device: &Device, _turn: usize) -> Result<()> {
        self.0.send(device, &mut self.1.borrow_mut(), None)
    }

    fn launches(&self) -> usize {
        0
    }
}

/// Bytes of a whole step's values, and the time of their upload as a graph of its own.
///
/// # Errors
/// `Fault` when the device fails; `Invalid` when `replays` is 0.
pub fn ingest(device: &Device, scene: &Arc<Scene>, state: &State, replays: usize) -> Result<(u64, Timing)> {
    let coordinates = Coordinates::new(scene);
    // Only the number of bytes matters here, so factors and tiles are empty.
    let factors = vec![Vec::new(); scene.shapes.len()];
    let packing = Packing { scene: Arc::clone(scene), coordinates, factors, listing: Listing::default() };
    let mut inputs = Inputs::new(device, &Arc::new(packing))?;
    let mut pinned = inputs.pinned(device)?;
    inputs.write(&mut pinned, &Header::default(), state)?;
    let bytes = inputs.bytes();
    let ingest = Ingest(inputs, RefCell::new(pinned));
    Ok((bytes, time(device, &ingest, Cache::Warm, replays)?))
}
