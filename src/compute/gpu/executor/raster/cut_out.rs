//! Cut-outs on the device: texture coordinates, materials, and alpha images as textures with hardware filtering.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::sys::{self, CUmipmappedArray, CUtexObject};
use cudarc::driver::{CudaStream, DriverError};

use crate::gpu::launch::context::CurrentContext;
use crate::gpu::launch::error::cuda_error;
use crate::gpu::launch::{Device, DeviceBuffer};
use modalcast_model::error::Result;
use modalcast_model::raster::{AlphaImage, CutOuts};

/// Maximum anisotropy that the hardware supports.
const MAX_ANISOTROPY: f32 = 16.0;

/// An entry of the material table on the device. `image` is the handle of a texture object, or 0 without an image.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct AlphaMaterial {
    image: u64,
    alpha: f32,
    cutoff: f32,
}

const _: () = assert!(size_of::<AlphaMaterial>() == 16, "AlphaMaterial differs from kernels/cut_out.cuh");

/// Device tables that the kernels for cut-outs read.
#[derive(Debug)]
pub(super) struct CutOutBuffers {
    /// The first cut-out triangle.
    pub(super) first: u32,
    uvs: DeviceBuffer,
    material_indices: DeviceBuffer,
    materials: DeviceBuffer,
    /// The textures that `materials` refers to.
    _images: Vec<AlphaTexture>,
}

/// Device addresses of the tables.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct CutOutAddresses {
    pub(super) uvs: u64,
    pub(super) material_indices: u64,
    pub(super) materials: u64,
}

impl CutOutBuffers {
    /// Uploads cut-outs, which `check_cut_outs` must have accepted.
    ///
    /// # Errors
    /// `Fault` when the device fails, for example because an image exceeds its texture size.
    pub(super) fn new(device: &Device, cut_outs: &CutOuts) -> Result<Self> {
        let upload = |image| AlphaTexture::new(device, image, cut_outs.anisotropy);
        let images = cut_outs.images.iter().map(upload).collect::<Result<Vec<_>>>()?;
        let texture_of = |image: u32| images[image as usize].texture;
        let table_entry = |material: &modalcast_model::raster::AlphaMaterial| AlphaMaterial {
            image: material.image.map_or(0, texture_of),
            alpha: material.alpha,
            cutoff: material.cutoff,
        };
        let materials: Vec<AlphaMaterial> = cut_outs.materials.iter().map(table_entry).collect();
        Ok(Self {
            first: cut_outs.first,
            uvs: DeviceBuffer::upload(device, cut_outs.uvs.as_flattened())?,
            material_indices: DeviceBuffer::upload(device, &cut_outs.material_indices)?,
            materials: DeviceBuffer::upload(device, &materials)?,
            _images: images,
        })
    }

    pub(super) fn addresses(&self) -> CutOutAddresses {
        CutOutAddresses {
            uvs: self.uvs.address(),
            material_indices: self.material_indices.address(),
            materials: self.materials.address(),
        }
    }
}

/// An image as a texture. Dropping it waits for the work on the stream, because that work may read the texture.
#[derive(Debug)]
struct AlphaTexture {
    /// 0 until the texture is created.
    texture: CUtexObject,
    array: CUmipmappedArray,
    stream: Arc<CudaStream>,
}

impl AlphaTexture {
    /// Creates the texture and waits for the copy of its texels.
    fn new(device: &Device, image: &AlphaImage, anisotropy: f32) -> Result<Self> {
        let _current = device.enter()?;
        let to_fault = cuda_error("texture");
        let array = create_array(image).map_err(&to_fault)?;
        // From here on, dropping `texture` waits for the copies and destroys the objects created so far.
        let mut texture = Self { texture: 0, array, stream: Arc::clone(device.stream()) };
        for (level, texels) in image.levels.iter().enumerate() {
            texture.copy_level(device, level as u32, size_of_level(image, level), texels).map_err(&to_fault)?;
        }
        texture.texture = texture.create_texture(image, anisotropy).map_err(&to_fault)?;
        device.synchronize("texture")?;
        Ok(texture)
    }

    /// Copies a mip level from the host, on the device's stream.
    fn copy_level(
        &self,
        device: &Device,
        level: u32,
        [width, height]: [usize; 2],
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
            srcPitch: width,
            dstXInBytes: 0,
            dstY: 0,
            dstMemoryType: sys::CUmemorytype_enum::CU_MEMORYTYPE_ARRAY,
            dstHost: std::ptr::null_mut(),
            dstDevice: 0,
            dstArray: level_array,
            dstPitch: 0,
            WidthInBytes: width,
            Height: height,
        };
        // SAFETY: `check_cut_outs` verified that each level has all its texels. `new` waits for the copy before it
        // returns, also on errors and panics, and borrows the texels until then.
        unsafe { sys::cuMemcpy2DAsync_v2(&copy, device.stream().cu_stream()) }.result()
    }

    /// Creates a texture object with wrap addressing and trilinear, anisotropic filtering.
    fn create_texture(&self, image: &AlphaImage, anisotropy: f32) -> Result<CUtexObject, DriverError> {
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
            flags: sys::CU_TRSF_NORMALIZED_COORDINATES,
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

/// Allocates a mipmapped array of 8-bit texels.
fn create_array(image: &AlphaImage) -> Result<CUmipmappedArray, DriverError> {
    let description = sys::CUDA_ARRAY3D_DESCRIPTOR_st {
        Width: image.width as usize,
        Height: image.height as usize,
        Depth: 0,
        Format: sys::CUarray_format_enum::CU_AD_FORMAT_UNSIGNED_INT8,
        NumChannels: 1,
        Flags: 0,
    };
    let mut array = std::ptr::null_mut();
    // SAFETY: `array` is a live pointer and the descriptor lives for the call.
    unsafe { sys::cuMipmappedArrayCreate(&mut array, &description, image.levels.len() as u32) }.result()?;
    Ok(array)
}

/// Width and height of a mip level in texels.
pub(super) fn size_of_level(image: &AlphaImage, level: usize) -> [usize; 2] {
    [image.width, image.height].map(|side| (side as usize >> level).max(1))
}

impl Drop for AlphaTexture {
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
