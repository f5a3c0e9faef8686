//! The bounding box of each domain: boxes of its segments (parts of a domain) on the device, and their readback.

use crate::gpu::launch::{Device, DeviceBuffer, PinnedBuffer, PinnedUse};
use crate::gpu::tables::box_segments::{BOX_KEYS, box_bytes, unite_boxes};
use crate::gpu::tables::layout::BoxSegment;
use modalcast_model::error::Result;
use modalcast_model::scene::BoundingBox;

/// Segments of domains and their boxes on the device.
#[derive(Debug)]
pub(crate) struct DomainBoxes {
    segments: DeviceBuffer,
    /// Per segment its box, as six keys (`tables::box_keys`).
    boxes: DeviceBuffer,
    /// The domain of each segment.
    domains: Vec<u32>,
    /// Pinned copy of `boxes`, allocated on the first read.
    keys: Option<PinnedBuffer<u32>>,
}

/// Addresses of the segments and of their boxes, and the number of segments. The default, all zeros, is that of a scene
/// without the feature `boxes`.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct DomainBoxAddresses {
    pub segments: u64,
    pub boxes: u64,
    pub count: u32,
}

impl DomainBoxes {
    pub(super) fn new(device: &Device, segments: &[BoxSegment]) -> Result<Self> {
        Ok(Self {
            segments: DeviceBuffer::upload(device, segments)?,
            boxes: DeviceBuffer::zeroed(device, box_bytes(segments.len()))?,
            domains: segments.iter().map(|segment| segment.domain).collect(),
            keys: None,
        })
    }

    pub(super) fn addresses(&self) -> DomainBoxAddresses {
        DomainBoxAddresses {
            segments: self.segments.address(),
            boxes: self.boxes.address(),
            count: self.domains.len() as u32,
        }
    }

    /// Reads the boxes of all segments back, waits for the copy, and writes one box per domain to `boxes`.
    pub(crate) fn read(&mut self, device: &Device, boxes: &mut Vec<BoundingBox>) -> Result<()> {
        let keys = match &mut self.keys {
            Some(keys) => keys,
            empty => {
                let length = BOX_KEYS * self.domains.len();
                empty.insert(PinnedBuffer::zeroed(device, length, PinnedUse::FromDevice)?)
            }
        };
        let keys = keys.as_mut_slice()?;
        self.boxes.read(device, 0, keys)?;
        unite_boxes(&self.domains, keys, boxes);
        Ok(())
    }
}
