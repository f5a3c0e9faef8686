//! Launches `kernels/apply.cu`, the first kernel of a partial step (a step that changes few domains). It applies the
//! changes to the inputs on the device: it reads the new transforms and coordinates of changed domains directly from
//! pinned host memory. It also copies the list of dirty tiles, which `deform` computes next.

use cudarc::driver::{CudaFunction, LaunchConfig};

use super::deform::DeformKernel;
use crate::gpu::executor::inputs::StepInputs;
use crate::gpu::launch::{Device, KernelDescriptor, LaunchOrder, PinnedBuffer, PinnedUse, launch_kernel};
use crate::gpu::tables::change_list::{ChangeListLengths, ChangeListWriter, ChangedDomains};
use crate::gpu::tables::input_packing::InputPacker;
use crate::gpu::tables::layout::ApplyArgs;
use modalcast_model::error::Result;
use modalcast_model::scene::SceneState;

/// The kernel, and the writer of the lists that the kernel reads.
#[derive(Debug)]
pub struct ApplyKernel {
    function: CudaFunction,
    config: LaunchConfig,
    writer: ChangeListWriter,
}

/// Pinned memory for the lists of one step (`tables::change_list`).
pub type ChangeListBuffer = PinnedBuffer<u32>;

impl ApplyKernel {
    /// Compiles the kernel for scenes in the layout of `packer`.
    ///
    /// # Errors
    /// As [`Device::function`].
    pub fn new(device: &Device, packer: &InputPacker, kernel: &KernelDescriptor) -> Result<Self> {
        Ok(Self { function: kernel.compile(device)?, config: kernel.config(), writer: ChangeListWriter::new(packer) })
    }

    /// Allocates pinned memory for the lists of a step.
    ///
    /// # Errors
    /// `Fault` when the driver cannot lock so much memory.
    pub fn allocate_list(&self, device: &Device) -> Result<ChangeListBuffer> {
        PinnedBuffer::zeroed(device, self.writer.layout().word_count, PinnedUse::ToDevice)
    }

    /// Writes the lists of a partial step to `list`. The caller has waited until the last launch with `list` has ended.
    /// Returns `None` when the changes exceed the capacity of the lists, or when a full step is less work.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub fn write(
        &mut self,
        list: &mut ChangeListBuffer,
        packer: &InputPacker,
        state: &SceneState,
        domains: ChangedDomains<'_>,
    ) -> Result<Option<ChangeListLengths>> {
        Ok(self.writer.write(list.as_mut_slice()?, packer, state, domains))
    }

    /// Starts the kernel, which updates the values of `inputs` and copies the dirty tiles of `list` to the tile list of
    /// `deform`. The header in `inputs` has the lengths of the lists.
    ///
    /// # Safety
    /// `list` is from [`Self::allocate_list`]. [`Self::write`] wrote it with the packer of the scene of `inputs` and
    /// `deform`, or the header has lengths of 0. `list`, `inputs` and `deform` exist, and `list` is not written, until
    /// the kernel has ended.
    ///
    /// # Errors
    /// `Fault` when the device fails.
    pub unsafe fn launch(
        &self,
        device: &Device,
        list: &ChangeListBuffer,
        inputs: &StepInputs,
        deform: &DeformKernel,
    ) -> Result<()> {
        let (values, layout) = (inputs.addresses(), self.writer.layout());
        let changes = list.address()?;
        let address_of_word = |word: usize| changes + 4 * word as u64;
        let args = ApplyArgs {
            header: values.header,
            changes,
            new_transforms: address_of_word(layout.transforms),
            new_q: address_of_word(layout.q),
            dirty_tiles: address_of_word(layout.tiles),
            transform_links: values.transform_links,
            transforms: values.transforms,
            q: values.q,
            change_steps: values.change_steps,
            tile_list: deform.tile_list(),
        };
        // SAFETY: the kernel's only argument is an `ApplyArgs`. Pinned memory has the same address on host and device
        // (unified addressing). The lists refer to domains and coordinates of the same scene as `inputs`. The caller
        // keeps `list`, `inputs` and `deform` until the kernel has ended.
        unsafe { launch_kernel(device, &self.function, self.config, LaunchOrder::Serial, &args) }
    }
}
