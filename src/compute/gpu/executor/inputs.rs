//! The device buffers of a step's input values, and their upload from pinned memory.

use std::sync::Arc;

use cudarc::driver::result;

use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer, PinnedBuffer, PinnedUse};
use crate::gpu::tables::input_packing::{InputPacker, InputSizes, transform_links};
use crate::gpu::tables::layout::StepHeader;
use crate::gpu::tables::staging::SliceWriter;
use modalcast_model::error::{Error, Result};
use modalcast_model::scene::SceneState;

/// Device addresses of a step's values.
#[derive(Debug, Clone, Copy)]
pub(crate) struct InputAddresses {
    pub header: u64,
    pub transforms: u64,
    /// Per domain, its transform root (the domain whose transform it uses) and its index in `follower_frames`.
    /// Constant; only in scenes with followers.
    pub transform_links: u64,
    /// Per follower, its coordinate frame: its constant transform relative to its root.
    pub follower_frames: u64,
    pub q: u64,
    /// Per domain, the step that last changed it.
    pub change_steps: u64,
}

/// The device buffers of a step's values.
#[derive(Debug)]
pub struct StepInputs {
    packer: Arc<InputPacker>,
    /// Header, transforms and q.
    values: DeviceBuffer,
    change_steps: DeviceBuffer,
    transform_links: DeviceBuffer,
    follower_frames: DeviceBuffer,
    sizes: InputSizes,
}

/// Pinned staging buffer for the values of one step.
pub type StagingBuffer = PinnedBuffer<f32>;

/// The part of the staging buffer that a step copies to the device.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum InputPart {
    /// Only the header, for a partial step: the kernel `apply` reads the other values from pinned memory.
    Header,
    /// All values.
    All,
}

impl StepInputs {
    /// Allocates the buffers for steps in the layout of `packer`.
    ///
    /// # Errors
    /// `Fault` when the device has not enough memory.
    pub fn new(device: &Device, packer: &Arc<InputPacker>) -> Result<Self> {
        let (scene, sizes) = (&packer.scene, InputSizes::of(&packer.scene, &packer.coordinates));
        Ok(Self {
            packer: Arc::clone(packer),
            values: DeviceBuffer::zeroed(device, sizes.total())?,
            change_steps: DeviceBuffer::zeroed(device, 4 * scene.domains.len() as u64)?,
            transform_links: DeviceBuffer::upload(device, &transform_links(scene))?,
            follower_frames: DeviceBuffer::upload(device, scene.transform_roots.follower_frames())?,
            sizes,
        })
    }

    /// Allocates a staging buffer for the values of a step.
    ///
    /// # Errors
    /// `Fault` when the driver cannot lock so much memory.
    pub fn allocate_staging(&self, device: &Device) -> Result<StagingBuffer> {
        PinnedBuffer::zeroed(device, self.sizes.total() as usize / 4, PinnedUse::ToDevice)
    }

    pub(crate) fn addresses(&self) -> InputAddresses {
        let header = self.values.address();
        let transforms = header + size_of::<StepHeader>() as u64;
        let q = transforms + self.sizes.transforms;
        InputAddresses {
            header,
            transforms,
            transform_links: self.transform_links.address(),
            follower_frames: self.follower_frames.address(),
            q,
            change_steps: self.change_steps.address(),
        }
    }

    /// Writes the values of a full step. The caller has waited for the last copy from this memory.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn write(&self, staging: &mut StagingBuffer, header: &StepHeader, state: &SceneState) -> Result<()> {
        self.packer.write(staging.as_mut_slice()?, header, state);
        Ok(())
    }

    /// Writes only the header.
    pub(crate) fn write_header(staging: &mut StagingBuffer, header: &StepHeader) -> Result<()> {
        SliceWriter::new(staging.as_mut_slice()?).put(std::slice::from_ref(header));
        Ok(())
    }

    /// Starts the copy of a part of `staging` to the device, on the device's stream, so that a graph can capture it.
    ///
    /// # Safety
    /// `staging` is neither written nor dropped before the copy has ended. If the copy is captured in a graph, this
    /// holds for each launch of the graph, and `self` exists until the last launch has ended.
    ///
    /// # Errors
    /// `Fault` when `staging` does not have the length of these inputs, or when the device fails.
    pub unsafe fn send(&self, device: &Device, staging: &StagingBuffer, part: InputPart) -> Result<()> {
        let bytes: &[u8] = bytemuck::cast_slice(staging.as_slice()?);
        if bytes.len() as u64 != self.values.bytes() {
            let reason = format!("expected a staging buffer of {} bytes, got {}", self.values.bytes(), bytes.len());
            return Err(Error::Fault { stage: "upload", reason });
        }
        let bytes = match part {
            InputPart::Header => &bytes[..size_of::<StepHeader>()],
            InputPart::All => bytes,
        };
        let _current = device.enter()?;
        // SAFETY: both buffers have at least the size of `bytes`, as checked above. The caller keeps them alive.
        unsafe { result::memcpy_htod_async(self.values.address(), bytes, device.stream().cu_stream()) }
            .map_err(cuda_error("upload"))
    }

    /// Bytes that a full step copies.
    pub const fn bytes(&self) -> u64 {
        self.sizes.total()
    }
}
