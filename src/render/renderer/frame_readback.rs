//! The readback of one frame: all pixels at once, or band by band.
//!
//! The pixels of a frame within the band limit leave the device in one piece, in memory that the host can read in place. A
//! larger frame is copied band by band through one small staging buffer, because the driver needs about 0.7 ms to allocate
//! and zero each MiB of page-locked memory, and other scenes would wait for that. The host copies a band when the device
//! has finished it, before the next band is submitted.

use std::cell::Cell;
use std::time::Duration;

use crate::device::gl::{Buffer, Fence, ReadbackView};
use crate::device::readback_ring::ReadbackSlot;
use crate::layout::cull::CULL_COUNTER_BYTES;
use crate::layout::oit::OIT_HEADER_BYTES;
use crate::pass::Pass;
use crate::passes::readback::ReadbackBuffer;
use crate::region::Band;
use crate::resources::target_desc::TargetDesc;
use modalcast_model::error::{Result, fault};

/// Maximum number of pixels of a band that is copied to the host: the host copies 16 MiB in a few milliseconds.
pub(super) const MAX_BAND_PIXELS: u64 = 1 << 22;

/// Bytes of the staging buffer of a band: its pixels, and the counters that follow the last band.
pub(super) const BAND_STAGING_BYTES: u64 = 4 * MAX_BAND_PIXELS + (OIT_HEADER_BYTES + CULL_COUNTER_BYTES) as u64;

/// The pixels of a frame on their way to the host.
#[derive(Debug)]
pub(super) enum FrameReadback {
    Whole(ReadbackSlot),
    Bands(BandReadback),
}

/// A frame that is copied to the host band by band.
#[derive(Debug)]
pub(super) struct BandReadback {
    /// Memory of one band.
    slot: ReadbackSlot,
    /// Bytes of the submitted band that the host has not copied yet.
    submitted_bytes: Cell<usize>,
    /// Bytes that the host has copied.
    copied: Vec<u8>,
    /// Bytes of the frame and of the counters that follow it.
    frame_bytes: usize,
}

impl BandReadback {
    /// `slot` has [`BAND_STAGING_BYTES`] bytes in a staging buffer.
    pub(super) fn new(slot: ReadbackSlot, desc: TargetDesc) -> Self {
        let [_, cull_range] = desc.readback_ranges();
        Self { slot, submitted_bytes: Cell::new(0), copied: Vec::new(), frame_bytes: cull_range.end as usize }
    }

    /// Copies the band that was submitted last, after a wait for `fence`, which follows it.
    fn collect(&mut self, fence: &Fence, limit: Duration) -> Result<()> {
        let bytes = self.submitted_bytes.take();
        if bytes == 0 {
            return Ok(());
        }
        fence.wait(Pass::Read.name(), limit)?;
        let missing = self.frame_bytes.saturating_sub(self.copied.len());
        let no_memory = || fault(Pass::Read.name(), format!("expected {missing} bytes of memory for the pixels"));
        self.copied.try_reserve_exact(missing).map_err(|_| no_memory())?;
        if let Some(view) = self.slot.view()? {
            self.copied.extend_from_slice(view.bytes().get(..bytes).unwrap_or_default());
        }
        Ok(())
    }
}

impl FrameReadback {
    /// The picture of another API into which the frame is drawn.
    pub(super) fn picture(&self) -> Option<&Buffer> {
        match self {
            Self::Whole(slot) => slot.picture(),
            Self::Bands(_) => None,
        }
    }

    /// Where to copy the pixels of a band. `None` if the frame is drawn into a picture of another API.
    pub(super) fn buffer(&self, desc: TargetDesc, band: Band) -> Option<ReadbackBuffer<'_>> {
        match self {
            Self::Whole(slot) => slot.staging().map(|buffer| ReadbackBuffer { buffer, first_byte: 0 }),
            Self::Bands(bands) => {
                let [first_byte, bytes] =
                    [band.first_row, band.rows].map(|rows| 4 * u64::from(desc.width) * u64::from(rows));
                let end = if band.is_last() { bands.frame_bytes as u64 } else { first_byte + bytes };
                bands.submitted_bytes.set((end - first_byte) as usize);
                bands.slot.staging().map(|buffer| ReadbackBuffer { buffer, first_byte })
            }
        }
    }

    /// Copies the submitted band before the next step of the frame is submitted. `fence` follows the band.
    pub(super) fn collect(&mut self, fence: Option<&Fence>, limit: Duration) -> Result<()> {
        match (self, fence) {
            (Self::Bands(bands), Some(fence)) => bands.collect(fence, limit),
            _ => Ok(()),
        }
    }

    /// Whether [`Self::into_view`] would return without waiting, after waiting at most `limit`. `fence` follows the frame.
    pub(super) fn is_ready_within(&self, fence: &Fence, limit: Duration) -> bool {
        match self {
            Self::Whole(slot) => slot.is_ready_within(fence, limit),
            Self::Bands(_) => fence.is_done_within(limit),
        }
    }

    /// The pixels and the counters of the frame. The caller has waited for `fence`, which follows the frame.
    ///
    /// # Errors
    /// `Fault` when the bytes cannot be copied or mapped, or bands are missing.
    pub(super) fn into_view(self, fence: &Fence, limit: Duration) -> Result<Option<ReadbackView>> {
        match self {
            Self::Whole(slot) => slot.view(),
            Self::Bands(mut bands) => {
                bands.collect(fence, limit)?;
                let (expected, got) = (bands.frame_bytes, bands.copied.len());
                if got != expected {
                    return Err(fault(Pass::Read.name(), format!("expected {expected} bytes of bands, got {got}")));
                }
                Ok(Some(ReadbackView::Copied(bands.copied)))
            }
        }
    }
}
