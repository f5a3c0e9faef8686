//! Images as textures with mipmaps and hardware filtering.

use std::sync::Arc;

use cudarc::driver::sys::{self, CUmipmappedArray, CUtexObject};
use cudarc::driver::{CudaStream, DriverError};

use crate::gpu::launch::Device;
use crate::gpu::launch::context::CurrentContext;
use crate::gpu::launch::error::cuda_error;
use modalcast_model::error::{Result, fault};

/// Maximum anisotropy that the hardware supports.
const MAX_ANISOTROPY: f32 = 16.0;

/// An image with 8 bits per channel.
#[derive(Debug, Clone, Copy)]
pub(super) struct TextureImage<'a> {
    /// Width and height in texels.
    pub(super) size: [u32; 2],
    /// The mipmap chain: texels of each level, level 0 first.
    pub(super) levels: &'a [Vec<u8>],
    /// 1 or 4.
    pub(super) channels: u32,
    /// Whether lookups convert the first three channels from sRGB to linear values.
    pub(super) is_srgb: bool,
}

impl TextureImage<'_> {
    /// Width and height of a level in texels.
    fn level_size(&self, level: usize) -> [usize; 2] {
        self.size.map(|side| (side as usize >> level).max(1))
    }

    /// Bytes of a row of a level.
    fn row_bytes(&self, level: usize) -> usize {
        self.channels as usize * self.level_size(level)[0]
    }
}

/// An image as a texture that repeats in both directions. Dropping it waits for the work on the stream, because that
/// work may read the texture.
#[derive(Debug)]
pub(super) struct MipmappedTexture {
    /// 0 until the texture is created.
    texture: CUtexObject,
    array: CUmipmappedArray,
    stream: Arc<CudaStream>,
}

// SAFETY: the driver accepts the handles of an array and of a texture on every thread on which their context is current,
// and `drop` makes it current. A texture has no other state, and no method changes it.
unsafe impl Send for MipmappedTexture {}

impl MipmappedTexture {
    /// Creates the texture and waits for the copy of its texels.
    ///
    /// # Errors
    /// `Fault` if a level has too few texels, or when the device fails, for example because the image exceeds its
    /// texture size.
    pub(super) fn new(device: &Device, image: TextureImage<'_>, anisotropy: f32) -> Result<Self> {
        let has_texels =
            |(level, texels): (usize, &Vec<u8>)| texels.len() >= image.row_bytes(level) * image.level_size(level)[1];
        if image.levels.is_empty() || !image.levels.iter().enumerate().all(has_texels) {
            return Err(fault("texture", "expected all texels of each level"));
        }
        let _current = device.enter()?;
        let to_fault = cuda_error("texture");
        let array = create_array(image).map_err(&to_fault)?;
        // From here on, dropping `texture` waits for the copies and destroys the objects created so far.
        let mut texture = Self { texture: 0, array, stream: Arc::clone(device.stream()) };
        for (level, texels) in image.levels.iter().enumerate() {
            let [_, height] = image.level_size(level);
            texture.copy_level(device, level as u32, [image.row_bytes(level), height], texels).map_err(&to_fault)?;
        }
        texture.texture = texture.create_texture(image, anisotropy).map_err(&to_fault)?;
        device.synchronize("texture")?;
        Ok(texture)
    }

    /// The texture object, for arguments of kernels. It is valid while the texture exists.
    pub(super) const fn handle(&self) -> u64 {
        self.texture
    }

    /// Copies a mip level from the host, on the device's stream. `texels` has `height` rows of `row_bytes` bytes.
    fn copy_level(
        &self,
        device: &Device,
        level: u32,
        [row_bytes, height]: [usize; 2],
        texels: &[u8],
    ) -> Result<(), DriverError> {
        let mut level_array = std::ptr::null_mut();
        // SAFETY: `level_array` is a live pointer, and the array has this level.
        unsafe { sys::cuMipmappedArrayGetLevel(&mut level_array, self.array, level) }.result()?;
        let copy = sys::CUDA_MEMCPY2D_st {
            srcXInBytes: 0,
            srcY: 0,
            srcMemoryType: sys::CUmemorytype_enum::CU_MEMORYTYPE_HOST,
            srcHost: texels.as_ptr().cast(),
            srcDevice: 0,
            srcArray: std::ptr::null_mut(),
            srcPitch: row_bytes,
            dstXInBytes: 0,
            dstY: 0,
            dstMemoryType: sys::CUmemorytype_enum::CU_MEMORYTYPE_ARRAY,
            dstHost: std::ptr::null_mut(),
            dstDevice: 0,
            dstArray: level_array,
            dstPitch: 0,
            WidthInBytes: row_bytes,
            Height: height,
        };
        // SAFETY: `new` verified that each level has all its texels. `new` waits for the copy before it
        // returns, also on errors and panics, and borrows the texels until then.
        unsafe { sys::cuMemcpy2DAsync_v2(&copy, device.stream().cu_stream()) }.result()
    }

    /// Creates a texture object with wrap addressing and trilinear, anisotropic filtering.
    fn create_texture(&self, image: TextureImage<'_>, anisotropy: f32) -> Result<CUtexObject, DriverError> {
        use sys::CUaddress_mode_enum::CU_TR_ADDRESS_MODE_WRAP as WRAP;
        use sys::CUfilter_mode_enum::CU_TR_FILTER_MODE_LINEAR as LINEAR;
        let resource = sys::CUDA_RESOURCE_DESC_st {
            resType: sys::CUresourcetype_enum::CU_RESOURCE_TYPE_MIPMAPPED_ARRAY,
            res: sys::CUDA_RESOURCE_DESC_st__bindgen_ty_1 {
                mipmap: sys::CUDA_RESOURCE_DESC_st__bindgen_ty_1__bindgen_ty_2 { hMipmappedArray: self.array },
            },
            flags: 0,
        };
        let descriptor = sys::CUDA_TEXTURE_DESC_st {
            addressMode: [WRAP; 3],
            filterMode: LINEAR,
            flags: sys::CU_TRSF_NORMALIZED_COORDINATES | if image.is_srgb { sys::CU_TRSF_SRGB } else { 0 },
            maxAnisotropy: anisotropy.min(MAX_ANISOTROPY) as u32,
            mipmapFilterMode: LINEAR,
            mipmapLevelBias: 0.0,
            minMipmapLevelClamp: 0.0,
            maxMipmapLevelClamp: (image.levels.len() - 1) as f32,
            borderColor: [0.0; 4],
            reserved: [0; 12],
        };
        let mut texture = 0;
        // SAFETY: `texture` is a live integer and the descriptors live for the call; a null view selects the whole
        // array.
        unsafe { sys::cuTexObjectCreate(&mut texture, &resource, &descriptor, std::ptr::null()) }.result()?;
        Ok(texture)
    }
}

/// Allocates a mipmapped array.
fn create_array(image: TextureImage<'_>) -> Result<CUmipmappedArray, DriverError> {
    let description = sys::CUDA_ARRAY3D_DESCRIPTOR_st {
        Width: image.size[0] as usize,
        Height: image.size[1] as usize,
        Depth: 0,
        Format: sys::CUarray_format_enum::CU_AD_FORMAT_UNSIGNED_INT8,
        NumChannels: image.channels,
        Flags: 0,
    };
    let mut array = std::ptr::null_mut();
    // SAFETY: `array` is a live pointer and the descriptor lives for the call.
    unsafe { sys::cuMipmappedArrayCreate(&mut array, &description, image.levels.len() as u32) }.result()?;
    Ok(array)
}

impl Drop for MipmappedTexture {
    fn drop(&mut self) {
        // Ignore errors: the other objects are destroyed anyway, and a failed device reports its error at the next
        // call.
        let _current = CurrentContext::enter(self.stream.context());
        self.stream.synchronize().ok();
        if self.texture != 0 {
            // SAFETY: created once, destroyed once.
            unsafe { sys::cuTexObjectDestroy(self.texture) }.result().ok();
        }
        // SAFETY: created once, destroyed once, after its texture.
        unsafe { sys::cuMipmappedArrayDestroy(self.array) }.result().ok();
    }
}
