//! Exported device memory for the pictures of batches of views, which another process imports and reads without a copy.
//! A slot has the arrays of one step.

use std::os::fd::OwnedFd;
use std::sync::Arc;

use cudarc::driver::sys;

use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, ExportedMemory};
use modalcast_model::error::{Result, invalid};
use modalcast_model::views::ViewFormat;

/// Alignment of each array in a slot, in bytes.
const ARRAY_ALIGNMENT: u64 = 256;

/// The arrays of a slot: color, depth, domains and normals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ViewArrayLayout {
    /// Bytes of a view in each array; 0 for an array that is not drawn.
    view_bytes: [u64; 4],
    /// Offset of each array in the slot.
    offsets: [u64; 4],
    /// Bytes of a slot.
    pub slot_bytes: u64,
}

impl ViewArrayLayout {
    /// The layout for this many views.
    pub fn new(format: &ViewFormat, views: usize) -> Self {
        let outputs = format.outputs;
        let pixels = format.pixel_count() as u64;
        let array = |is_drawn: bool, pixel_bytes: u64| if is_drawn { pixel_bytes * pixels } else { 0 };
        let view_bytes =
            [array(outputs.color, 3), array(outputs.depth, 4), array(outputs.domains, 4), array(outputs.normals, 12)];
        let mut slot_bytes = 0;
        let offsets = view_bytes.map(|bytes| {
            let offset = slot_bytes;
            slot_bytes += (bytes * views as u64).next_multiple_of(ARRAY_ALIGNMENT);
            offset
        });
        Self { view_bytes, offsets, slot_bytes }
    }

    /// Offsets of the arrays that are drawn.
    pub fn drawn_offsets(&self) -> impl Iterator<Item = u64> {
        self.offsets.into_iter().zip(self.view_bytes).filter(|(_, bytes)| *bytes > 0).map(|(offset, _)| offset)
    }
}

/// Slots of exported device memory, which contain zeros before the first pictures. Dropping it waits for the work on the device's stream, which may write to a slot.
#[derive(Debug)]
pub struct ViewRing {
    device: Arc<Device>,
    slots: Vec<ExportedMemory>,
    layout: ViewArrayLayout,
    views: usize,
}

/// A part of a slot: the places of consecutive views.
#[derive(Debug, Clone)]
pub(super) struct RingViews {
    ring: Arc<ViewRing>,
    slot: usize,
    first_view: usize,
}

impl ViewRing {
    /// Allocates slots for this many views each.
    ///
    /// # Errors
    /// `Fault` if the device has not enough memory, or cannot export memory as a file descriptor.
    pub fn new(device: &Arc<Device>, slot_count: usize, format: &ViewFormat, views: usize) -> Result<Self> {
        let layout = ViewArrayLayout::new(format, views);
        let allocate = |_| ExportedMemory::new(device, layout.slot_bytes as usize);
        let slots = (0..slot_count).map(allocate).collect::<Result<_>>()?;
        let ring = Self { device: Arc::clone(device), slots, layout, views };
        // New memory may contain data of others.
        let (_current, stream) = (device.enter()?, device.stream());
        for slot in &ring.slots {
            // SAFETY: the memory has these bytes, and the ring waits for the stream before it releases them.
            unsafe { sys::cuMemsetD8Async(slot.address(), 0, slot.bytes(), stream.cu_stream()) }
                .result()
                .map_err(cuda_error("allocate"))?;
        }
        device.synchronize("allocate")?;
        Ok(ring)
    }

    /// A file descriptor of each slot, and the bytes of its allocation.
    ///
    /// # Errors
    /// `Fault` when the driver cannot export the memory.
    pub fn export(&self) -> Result<Vec<(OwnedFd, u64)>> {
        self.slots.iter().map(|slot| Ok((slot.export()?, slot.bytes() as u64))).collect()
    }

    /// The places of `count` views of a slot. All addresses are multiples of 4, because `first_view` is one.
    ///
    /// # Errors
    /// `Invalid` for a slot or views that do not exist, and for a first view that is no multiple of 4.
    pub(super) fn views(self: &Arc<Self>, slot: usize, first_view: usize, count: usize) -> Result<RingViews> {
        if slot >= self.slots.len() {
            return Err(invalid("views.slot", format!("a slot below {}", self.slots.len()), slot));
        }
        if !first_view.is_multiple_of(4) {
            return Err(invalid("views", "a first view that is a multiple of 4", first_view));
        }
        if first_view.checked_add(count).is_none_or(|end| end > self.views) {
            let given = format!("{count} views from {first_view} on");
            return Err(invalid("views", format!("views below {}", self.views), given));
        }
        Ok(RingViews { ring: Arc::clone(self), slot, first_view })
    }
}

impl RingViews {
    pub(super) fn device(&self) -> &Arc<Device> {
        &self.ring.device
    }

    /// The layout of the arrays, to compare it with that of a batch.
    pub(super) fn has_format(&self, format: &ViewFormat) -> bool {
        self.ring.layout == ViewArrayLayout::new(format, self.ring.views)
    }

    /// Device addresses of the first view in each array; 0 for an array that is not drawn.
    pub(super) fn addresses(&self) -> [u64; 4] {
        let ViewArrayLayout { view_bytes, offsets, .. } = self.ring.layout;
        let base = self.ring.slots[self.slot].address();
        std::array::from_fn(|array| match view_bytes[array] {
            0 => 0,
            bytes => base + offsets[array] + bytes * self.first_view as u64,
        })
    }
}

impl Drop for ViewRing {
    fn drop(&mut self) {
        // After a fault the call fails, but then no kernel runs.
        self.device.stream().synchronize().ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::views::ViewOutputs;

    #[test]
    fn arrays_are_aligned_and_do_not_overlap() {
        let outputs = ViewOutputs { color: true, domains: true, normals: true, ..ViewOutputs::default() };
        let format = ViewFormat { width: 5, height: 3, outputs, depth_scale: 1.0, depth_includes_ground: false };
        let layout = ViewArrayLayout::new(&format, 7);
        // 7 views of 15 pixels: 315 bytes of color, 420 of domains, and 1260 of normals.
        assert_eq!(layout.drawn_offsets().collect::<Vec<_>>(), [0, 512, 1024]);
        assert_eq!(layout.slot_bytes, 1024 + 1280);
    }
}
