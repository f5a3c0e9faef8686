//! Cut-outs on the device: texture coordinates, surfaces, and images as textures that the device filters.

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use cudarc::driver::sys::{self, CUmipmappedArray, CUtexObject};
use cudarc::driver::{CudaContext, CudaSlice, DriverError};

use super::super::device::Device;
use super::super::memory::{address, upload};
use modalcast_model::error::{Result, during};
use modalcast_model::raster::{AlphaImage, CutOuts};

/// The most samples that hardware takes along the longer side of a footprint.
const MOST_ANISOTROPY: f32 = 16.0;

/// An entry of the table of surfaces.
#[repr(C)]
#[derive(Debug, Clone, Copy, Pod, Zeroable)]
struct Surface {
    image: u64,
    alpha: f32,
    least: f32,
}

const _: () = assert!(size_of::<Surface>() == 16, "Surface differs from kernels/cut_out.cuh");

/// What `CUT` reads.
#[derive(Debug)]
pub(super) struct Cut {
    /// The first triangle that is cut out.
    pub(super) first: u32,
    uvs: CudaSlice<u8>,
    surfaces: CudaSlice<u8>,
    table: CudaSlice<u8>,
    _images: Vec<Image>,
}

/// Its addresses.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Addresses {
    pub(super) uvs: u64,
    pub(super) surfaces: u64,
    pub(super) table: u64,
}

impl Cut {
    /// Puts cut-outs that `check` let pass onto the device.
    ///
    /// # Errors
    /// `Fault` when the device refuses, as it does an image that is too large for it.
    pub(super) fn new(device: &Device, cut_outs: &CutOuts) -> Result<Self> {
        let image = |image| Image::new(device, image, cut_outs.anisotropy);
        let images = cut_outs.images.iter().map(image).collect::<Result<Vec<_>>>()?;
        let handle = |place: u32| images[place as usize].texture;
        let entry = |surface: &modalcast_model::raster::Surface| Surface {
            image: surface.image.map_or(0, handle),
            alpha: surface.alpha,
            least: surface.least,
        };
        let table: Vec<Surface> = cut_outs.table.iter().map(entry).collect();
        let cut = Self {
            first: cut_outs.first,
            uvs: upload(device, cut_outs.uvs.as_flattened())?,
            surfaces: upload(device, &cut_outs.surfaces)?,
            table: upload(device, &table)?,
            _images: images,
        };
        // The table goes now, and so may what it was made of.
        device.stream().synchronize().map_err(during("upload"))?;
        Ok(cut)
    }

    pub(super) fn addresses(&self, device: &Device) -> Addresses {
        Addresses {
            uvs: address(device, &self.uvs),
            surfaces: address(device, &self.surfaces),
            table: address(device, &self.table),
        }
    }
}

/// An image as a texture. Dropped when nothing on the stream reads it any more.
#[derive(Debug)]
struct Image {
    /// Never 0 for a texture that is there.
    texture: CUtexObject,
    array: CUmipmappedArray,
    context: Arc<CudaContext>,
}

impl Image {
    fn new(device: &Device, image: &AlphaImage, anisotropy: f32) -> Result<Self> {
        let fail = during("texture");
        let array = create(image).map_err(&fail)?;
        // From here on its drop destroys what there is.
        let mut own = Self { texture: 0, array, context: Arc::clone(device.context()) };
        for (level, texels) in image.levels.iter().enumerate() {
            own.fill(device, level as u32, (size_of_level(image, level), texels)).map_err(&fail)?;
        }
        own.texture = own.filtered(image, anisotropy).map_err(&fail)?;
        Ok(own)
    }

    /// Copies a level from the host, on the device's stream.
    fn fill(
        &self,
        device: &Device,
        level: u32,
        ([width, height], texels): ([usize; 2], &[u8]),
    ) -> Result<(), DriverError> {
        let mut to = std::ptr::null_mut();
        // SAFETY: `to` is a live pointer, and the array has this level.
        unsafe { sys::cuMipmappedArrayGetLevel(&mut to, self.array, level) }.result()?;
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
            dstArray: to,
            dstPitch: 0,
            WidthInBytes: width,
            Height: height,
        };
        // SAFETY: `check` saw that a level has its texels; `Cut::new` waits for the copy before they can go.
        unsafe { sys::cuMemcpy2DAsync_v2(&copy, device.stream().cu_stream()) }.result()
    }

    /// A texture that repeats, filtered within levels, between them, and along footprints.
    fn filtered(&self, image: &AlphaImage, anisotropy: f32) -> Result<CUtexObject, DriverError> {
        use sys::CUaddress_mode_enum::CU_TR_ADDRESS_MODE_WRAP as WRAP;
        use sys::CUfilter_mode_enum::CU_TR_FILTER_MODE_LINEAR as LINEAR;
        let resource = sys::CUDA_RESOURCE_DESC_st {
            resType: sys::CUresourcetype_enum::CU_RESOURCE_TYPE_MIPMAPPED_ARRAY,
            res: sys::CUDA_RESOURCE_DESC_st__bindgen_ty_1 {
                mipmap: sys::CUDA_RESOURCE_DESC_st__bindgen_ty_1__bindgen_ty_2 { hMipmappedArray: self.array },
            },
            flags: 0,
        };
        let filter = sys::CUDA_TEXTURE_DESC_st {
            addressMode: [WRAP; 3],
            filterMode: LINEAR,
            flags: sys::CU_TRSF_NORMALIZED_COORDINATES,
            maxAnisotropy: anisotropy.min(MOST_ANISOTROPY) as u32,
            mipmapFilterMode: LINEAR,
            mipmapLevelBias: 0.0,
            minMipmapLevelClamp: 0.0,
            maxMipmapLevelClamp: (image.levels.len() - 1) as f32,
            borderColor: [0.0; 4],
            reserved: [0; 12],
        };
        let mut texture = 0;
        // SAFETY: `texture` is a live integer and the descriptions live for the call; no view means the whole array.
        unsafe { sys::cuTexObjectCreate(&mut texture, &resource, &filter, std::ptr::null()) }.result()?;
        Ok(texture)
    }
}

fn create(image: &AlphaImage) -> Result<CUmipmappedArray, DriverError> {
    let description = sys::CUDA_ARRAY3D_DESCRIPTOR_st {
        Width: image.width as usize,
        Height: image.height as usize,
        Depth: 0,
        Format: sys::CUarray_format_enum::CU_AD_FORMAT_UNSIGNED_INT8,
        NumChannels: 1,
        Flags: 0,
    };
    let mut array = std::ptr::null_mut();
    // SAFETY: `array` is a live pointer and the description lives for the call.
    unsafe { sys::cuMipmappedArrayCreate(&mut array, &description, image.levels.len() as u32) }.result()?;
    Ok(array)
}

/// Texels across and down of a level.
pub(super) fn size_of_level(image: &AlphaImage, level: usize) -> [usize; 2] {
    [image.width, image.height].map(|side| (side as usize >> level).max(1))
}

impl Drop for Image {
    fn drop(&mut self) {
        // Answers are dropped on purpose: nothing is left to be done, and a device that failed says so at its next call.
        self.context.bind_to_thread().ok();
        if self.texture != 0 {
            // SAFETY: created once, destroyed once.
            unsafe { sys::cuTexObjectDestroy(self.texture) }.result().ok();
        }
        // SAFETY: as above; its texture is gone.
        unsafe { sys::cuMipmappedArrayDestroy(self.array) }.result().ok();
    }
}
