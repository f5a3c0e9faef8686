//! Launches `kernels/deform.cu`: x = T (x0 + U q) of all domains at once, and the bounds of all x.

use cudarc::driver::{CudaFunction, CudaSlice, LaunchConfig, PinnedHostSlice, PushKernelArg as _};

use super::device::Device;
use super::layout::DeformArgs;
use super::memory::{Inputs, address, room, upload};
use super::pack;
use super::plan::Kernel;
use crate::error::{Result, during};
use crate::scene::{Bounds, Scene};

/// Floats that go to the device in one piece while packing, so that packing needs little memory of its own.
const PIECE: usize = 1 << 23;

/// The kernel and what it reads of a scene.
#[derive(Debug)]
pub(super) struct Deform {
    function: CudaFunction,
    config: LaunchConfig,
    slots: CudaSlice<u8>,
    first_domains: CudaSlice<u8>,
    columns: CudaSlice<u8>,
    vertices: u32,
}

impl Deform {
    pub(super) fn new(device: &Device, scene: &Scene, kernel: &Kernel) -> Result<Self> {
        let slots = pack::vertex_slots(scene);
        let firsts = pack::first_domains(slots.iter().map(|slot| slot.first), scene.layout.vertices);
        Ok(Self {
            function: device.function(kernel.name, kernel.source, &kernel.defines)?,
            config: config(kernel),
            slots: upload(device, &slots)?,
            first_domains: upload(device, &firsts)?,
            columns: upload_columns(device, scene)?,
            vertices: scene.layout.vertices as u32,
        })
    }

    /// Starts the kernel; `positions` is the address of the packed positions.
    pub(super) fn launch(&self, device: &Device, inputs: &Inputs, extent: &Extent, positions: u64) -> Result<()> {
        let args = DeformArgs {
            slots: address(device, &self.slots),
            first_domains: address(device, &self.first_domains),
            columns: address(device, &self.columns),
            transforms: inputs.transforms,
            q: inputs.q,
            positions,
            bounds: address(device, &extent.buffer),
            vertices: self.vertices,
            reserved: 0,
        };
        let mut launch = device.stream().launch_builder(&self.function);
        // SAFETY: `DeformArgs` is the kernel's only argument. The tables come from `pack`, whose slots lie inside the
        // columns, transforms and q of the same scene, and `positions` has three floats per vertex, as `Output` checks.
        unsafe { launch.arg(&args).launch(self.config) }.map_err(during("deform"))?;
        Ok(())
    }
}

pub(super) fn config(kernel: &Kernel) -> LaunchConfig {
    LaunchConfig { grid_dim: (kernel.blocks, 1, 1), block_dim: (kernel.threads, 1, 1), shared_mem_bytes: 0 }
}

fn upload_columns(device: &Device, scene: &Scene) -> Result<CudaSlice<u8>> {
    let fail = during("upload");
    let (places, floats) = pack::placements(scene);
    let mut columns = room(device, 4 * floats)?;
    let mut send = |piece: &[f32], end: u64| {
        let (begin, end) = (4 * end as usize - size_of_val(piece), 4 * end as usize);
        let mut part = columns.slice_mut(begin..end);
        device.stream().memcpy_htod(bytemuck::cast_slice::<f32, u8>(piece), &mut part).map_err(&fail)
    };
    let mut piece = Vec::new();
    let mut end = 0;
    for (shape, place) in scene.shapes.iter().zip(&places) {
        pack::push_columns(shape, place.stride, &mut piece);
        end = place.first_entry + 3 * (1 + shape.modes.rank() as u64) * place.stride as u64;
        if piece.len() >= PIECE {
            send(&piece, end)?;
            piece.clear();
        }
    }
    if !piece.is_empty() {
        send(&piece, end)?;
    }
    Ok(columns)
}

/// Six maxima that the blocks of `deform` raise: of -x, -y, -z, x, y and z.
#[derive(Debug)]
pub(super) struct Extent {
    buffer: CudaSlice<u8>,
    pinned: PinnedHostSlice<u32>,
}

impl Extent {
    pub(super) fn new(device: &Device) -> Result<Self> {
        // SAFETY: the memory is written by the copy in `read` before anyone looks.
        let pinned = unsafe { device.context().alloc_pinned_with_flags(6, 0) }.map_err(during("allocate"))?;
        Ok(Self { buffer: room(device, 24)?, pinned })
    }

    /// Back to "no vertex yet".
    pub(super) fn clear(&mut self, device: &Device) -> Result<()> {
        device.stream().memset_zeros(&mut self.buffer).map_err(during("deform"))
    }

    /// Waits for the kernels and reads the bounds.
    pub(super) fn read(&mut self, device: &Device) -> Result<Bounds> {
        let fail = during("deform");
        let host = self.pinned.as_mut_slice().map_err(&fail)?;
        // SAFETY: the buffer was made with 24 bytes, `host` has six words.
        unsafe { super::memory::download(device, address(device, &self.buffer), host) }?;
        Ok(bounds_of(host))
    }
}

fn bounds_of(keys: &[u32]) -> Bounds {
    let mut bounds = Bounds::EMPTY;
    for axis in 0..3 {
        bounds.min[axis] = -f64::from(number_of(keys[axis]));
        bounds.max[axis] = f64::from(number_of(keys[3 + axis]));
    }
    bounds
}

/// The inverse of `ordered` in `kernels/deform.cu`. Zero, which no number has, gives a NaN like the NaN's own key.
fn number_of(key: u32) -> f32 {
    f32::from_bits(if key >> 31 == 1 { key & 0x7fff_ffff } else { !key })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// `ordered` of the kernel, word by word.
    fn ordered(x: f32) -> u32 {
        match x {
            x if x.is_nan() => u32::MAX,
            x if x.is_sign_negative() => !x.to_bits(),
            x => x.to_bits() | 0x8000_0000,
        }
    }

    #[test]
    fn keys_keep_the_order_of_numbers_and_a_nan_or_nothing_is_not_finite() {
        let rising = [f32::NEG_INFINITY, -1e30, -1.0, -1e-45, -0.0, 0.0, 1e-45, 2.5, f32::MAX, f32::INFINITY];
        for pair in rising.windows(2) {
            assert!(ordered(pair[0]) < ordered(pair[1]), "{pair:?}");
            assert!(ordered(pair[0]) > 0);
        }
        for number in rising {
            assert_eq!(number_of(ordered(number)).to_bits(), number.to_bits());
        }
        assert!(number_of(ordered(f32::NAN)).is_nan());
        assert!(number_of(0).is_nan());
        let good = [-1.0_f32, -2.0, -3.0, 4.0, 5.0, 6.0].map(ordered);
        assert_eq!(bounds_of(&good), Bounds { min: [1.0, 2.0, 3.0], max: [4.0, 5.0, 6.0] });
        for bad in [f32::NAN, f32::INFINITY] {
            let mut keys = good;
            keys[4] = ordered(bad);
            assert!(!bounds_of(&keys).is_finite());
        }
        assert!(!bounds_of(&[0; 6]).is_finite());
    }
}
