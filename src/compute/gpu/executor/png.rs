//! The PNG encoder: launches `kernels/png.cu`. The pixels stay on the device, and the last kernel writes the file to
//! pinned memory, so only compressed bytes cross the bus. The file equals that of the server's CPU encoder.
//!
//! An encoder is for pictures of one size. Its memory is allocated once: work buffers on the device, and pinned slots,
//! one for each file that is in flight or that a reader holds. The order of the stream protects the work buffers from
//! the next encoding.
//!
//! | file | content |
//! |---|---|
//! | `slot` | pinned memory of a file |

mod slot;

use std::num::NonZero;
use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::{CudaFunction, LaunchConfig};

use self::slot::FileSlot;
pub use self::slot::{EncodedPng, PendingPng};
use crate::gpu::launch::cleanup::WaitForStream;
use crate::gpu::launch::{Device, DeviceBuffer, LaunchOrder, launch_kernel};
use crate::gpu::tables::png_plan::{PngChannels, PngPlan, TILE_BYTES};
use modalcast_model::error::{Result, invalid};

const STAGE: &str = "encode";

const SOURCE: &str = include_str!("../../../../kernels/png.cu");
/// The functions of the source, in launch order.
const FUNCTIONS: [&str; 4] = ["png_filter", "png_code", "png_pack", "png_finish"];
/// The macro of files with an alpha channel.
const ALPHA_DEFINE: &str = "CHANNELS=4";

/// Threads per block: BLOCK in `kernels/png.cu`, and CODE_BLOCK in `kernels/png_huffman.cuh`.
const BLOCK_THREADS: u32 = 256;
const CODE_BLOCK_THREADS: u32 = 288;

/// Bytes of `PngTile` and `PngStrip` in `kernels/png.cuh`.
const TILE_RECORD_BYTES: u64 = 592;
const STRIP_RECORD_BYTES: u64 = 1440;

/// Arguments of all kernels; pointers are device addresses. `kernels/png.cuh` documents the fields.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct PngArgs {
    pixels: u64,
    filtered: u64,
    tiles: u64,
    strips: u64,
    words: u64,
    is_translucent: u64,
    file: u64,
    result: u64,
    pitch: i64,
    width: u32,
    height: u32,
    row_bytes: u32,
    strip_rows: u32,
    strip_count: u32,
    tiles_per_strip: u32,
    words_per_tile: u32,
    reserved: u32,
}

const _: () = assert!(size_of::<PngArgs>() == 104, "PngArgs differs from kernels/png.cuh");

/// RGBA8 sRGB pixels in device memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DevicePicture {
    /// Device address of the first pixel of the top row, a multiple of 4.
    pub address: u64,
    /// Bytes from a row to the next lower one, a multiple of 4. Negative if the bottom row comes first in memory.
    pub pitch: i64,
    /// Width and height in pixels.
    pub width: u32,
    pub height: u32,
}

/// Encodes pictures of one size as PNG on a device.
#[derive(Debug)]
pub struct PngEncoder {
    device: Arc<Device>,
    plan: PngPlan,
    channels: PngChannels,
    functions: Vec<CudaFunction>,
    /// The addresses of the buffers below, and the sizes of the plan.
    args: PngArgs,
    _buffers: [DeviceBuffer; 5],
    /// Grows on demand.
    slots: Vec<Arc<FileSlot>>,
    max_slots: usize,
}

impl PngEncoder {
    /// Compiles the kernels, or takes them from the cache, and allocates all memory. At most `slot_count` files are in
    /// flight or held by readers at a time. The work runs on the stream of `device`.
    ///
    /// # Errors
    /// `Invalid` when the picture is empty or too large; `Unavailable` when NVRTC is missing; `Fault` when compiling
    /// fails or the device has not enough memory.
    pub fn new(
        device: &Arc<Device>,
        [width, height]: [u32; 2],
        channels: PngChannels,
        slot_count: NonZero<usize>,
    ) -> Result<Self> {
        let plan = PngPlan::new(width, height, channels)?;
        let defines: &[&str] = match channels {
            PngChannels::Rgb => &[],
            PngChannels::Rgba => &[ALPHA_DEFINE],
        };
        let functions = device.functions(&FUNCTIONS, SOURCE, defines)?;
        let tile_count = u64::from(plan.tile_count());
        let buffers = [
            TILE_BYTES * tile_count,
            TILE_RECORD_BYTES * tile_count,
            STRIP_RECORD_BYTES * u64::from(plan.strip_count),
            4 * u64::from(plan.words_per_tile) * tile_count,
            4,
        ];
        let [filtered, tiles, strips, words, is_translucent] = buffers.map(|bytes| DeviceBuffer::zeroed(device, bytes));
        let buffers = [filtered?, tiles?, strips?, words?, is_translucent?];
        let [filtered, tiles, strips, words, is_translucent] = buffers.each_ref().map(DeviceBuffer::address);
        let args = PngArgs {
            filtered,
            tiles,
            strips,
            words,
            is_translucent,
            width,
            height,
            row_bytes: plan.row_bytes,
            strip_rows: plan.strip_rows,
            strip_count: plan.strip_count,
            tiles_per_strip: plan.tiles_per_strip,
            words_per_tile: plan.words_per_tile,
            ..PngArgs::zeroed()
        };
        let (slots, max_slots) = (Vec::new(), slot_count.get());
        Ok(Self { device: Arc::clone(device), plan, channels, functions, args, _buffers: buffers, slots, max_slots })
    }

    /// Width and height of the pictures in pixels.
    pub const fn size(&self) -> [u32; 2] {
        [self.plan.width, self.plan.height]
    }

    /// Starts to encode a picture, after all work that the stream of the device has received, without waiting. Returns
    /// `None` if all slots are in flight or held by readers.
    ///
    /// # Safety
    /// The picture's rows are readable device memory, which is not written before the encoding is complete.
    ///
    /// # Errors
    /// `Invalid` when the picture has another size or is not aligned; `Fault` when the device refuses the work.
    pub unsafe fn encode(&mut self, picture: &DevicePicture) -> Result<Option<PendingPng>> {
        self.check(picture)?;
        // Kernels of a dropped encoding may still write to a free slot. The stream orders them before those of this one.
        let Some(slot) = self.free_slot()? else { return Ok(None) };
        let [file, result] = slot.addresses();
        let args = PngArgs { pixels: picture.address, pitch: picture.pitch, file, result, ..self.args };
        let guard = WaitForStream::new(self.device.stream());
        slot.record_begin(&self.device)?;
        let tile_launch = (self.plan.tile_count(), BLOCK_THREADS);
        let strip_launch = (self.plan.strip_count, BLOCK_THREADS);
        let launches = [tile_launch, (self.plan.strip_count, CODE_BLOCK_THREADS), tile_launch, strip_launch];
        for (function, (blocks, threads)) in self.functions.iter().zip(launches) {
            let config = LaunchConfig { grid_dim: (blocks, 1, 1), block_dim: (threads, 1, 1), shared_mem_bytes: 0 };
            // SAFETY: the kernels' only argument is a `PngArgs`. Its buffers have the sizes of the plan and belong to
            // this encoder, whose `drop` waits for the work. The slot is not read before the event below, and the
            // caller guarantees the picture.
            unsafe { launch_kernel(&self.device, function, config, LaunchOrder::Serial, &args) }?;
        }
        slot.record(&self.device)?;
        guard.disarm();
        Ok(Some(PendingPng::new(slot, self.channels == PngChannels::Rgb)))
    }

    /// A slot that no file uses. Allocates one if there is none; `None` if there are as many as allowed.
    fn free_slot(&mut self) -> Result<Option<Arc<FileSlot>>> {
        let free_slot = self.slots.iter_mut().find_map(|slot| Arc::get_mut(slot).is_some().then(|| Arc::clone(slot)));
        if free_slot.is_some() || self.slots.len() >= self.max_slots {
            return Ok(free_slot);
        }
        let slot = Arc::new(FileSlot::new(&self.device, self.plan.max_file_bytes)?);
        self.slots.push(Arc::clone(&slot));
        Ok(Some(slot))
    }

    fn check(&self, picture: &DevicePicture) -> Result<()> {
        let DevicePicture { address, pitch, width, height } = *picture;
        if [width, height] != self.size() {
            let expected = format!("{}x{} pixels", self.plan.width, self.plan.height);
            return Err(invalid("picture", expected, format!("{width}x{height}")));
        }
        if !address.is_multiple_of(4) || pitch % 4 != 0 || pitch.unsigned_abs() < 4 * u64::from(width) {
            let expected = format!("an address and a pitch that are multiples of 4, and rows of {} bytes", 4 * width);
            return Err(invalid("picture", expected, format!("address {address}, pitch {pitch}")));
        }
        Ok(())
    }
}

impl Drop for PngEncoder {
    fn drop(&mut self) {
        // The kernels of dropped encodings may still write to buffers and slots. A fault is reported by the next call.
        self.device.synchronize(STAGE).ok();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{CAPABILITIES, assert_compiles};

    #[test]
    fn any_thread_may_wait_for_a_file_and_read_it() {
        fn assert_send_and_sync<T: Send + Sync>() {}
        assert_send_and_sync::<PendingPng>();
        assert_send_and_sync::<EncodedPng>();
    }

    #[test]
    #[ignore = "needs NVRTC: deploy/check installs it"]
    fn nvrtc_compiles_every_png_variant() {
        assert_compiles(SOURCE, &FUNCTIONS, &[&[], &[ALPHA_DEFINE]], &CAPABILITIES);
    }
}
