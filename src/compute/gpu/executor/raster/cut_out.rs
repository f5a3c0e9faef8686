//! Cut-outs on the device: texture coordinates, materials, and alpha images as textures with hardware filtering.

use bytemuck::{Pod, Zeroable};

use crate::gpu::executor::texture::{MipmappedTexture, TextureImage};
use crate::gpu::launch::{Device, DeviceBuffer};
use modalcast_model::error::Result;
use modalcast_model::raster::{AlphaImage, CutOuts};

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
pub(crate) struct CutOutBuffers {
    /// The first cut-out triangle.
    pub(crate) first: u32,
    uvs: DeviceBuffer,
    material_indices: DeviceBuffer,
    materials: DeviceBuffer,
    /// The textures that `materials` refers to.
    _images: Vec<MipmappedTexture>,
}

/// Device addresses of the tables.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct CutOutAddresses {
    pub(crate) uvs: u64,
    pub(crate) material_indices: u64,
    pub(crate) materials: u64,
}

impl CutOutBuffers {
    /// Uploads cut-outs, which `check_cut_outs` must have accepted.
    ///
    /// # Errors
    /// `Fault` when the device fails, for example because an image exceeds its texture size.
    pub(crate) fn new(device: &Device, cut_outs: &CutOuts) -> Result<Self> {
        let upload = |image: &AlphaImage| {
            let AlphaImage { width, height, levels } = image;
            let texture_image = TextureImage { size: [*width, *height], levels, channels: 1, is_srgb: false };
            MipmappedTexture::new(device, texture_image, cut_outs.anisotropy)
        };
        let images = cut_outs.images.iter().map(upload).collect::<Result<Vec<_>>>()?;
        let texture_of = |image: u32| images[image as usize].handle();
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

    pub(crate) fn addresses(&self) -> CutOutAddresses {
        CutOutAddresses {
            uvs: self.uvs.address(),
            material_indices: self.material_indices.address(),
            materials: self.materials.address(),
        }
    }
}

/// Width and height of a mip level in texels.
pub(super) fn size_of_level(image: &AlphaImage, level: usize) -> [usize; 2] {
    [image.width, image.height].map(|side| (side as usize >> level).max(1))
}
