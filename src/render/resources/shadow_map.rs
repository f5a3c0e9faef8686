//! Shadow map of a scene: depth from the sun and, for a variance map, its blurred moments. One array layer per cascade.

use std::cell::Cell;
use std::rc::Rc;
use std::sync::Arc;

use super::shared_targets::reserve_output;
use crate::device::gl::{self, Framebuffer, Gl, Texture, TextureDesc};
use crate::plan::shadow_map::shadow_textures;
use crate::types::BlurMethod;
use modalcast_model::error::Result;
use modalcast_model::memory::{MemoryBudget, MemoryReservation};
use modalcast_model::scene::{MomentFormat, ShadowSettings};

/// Textures and framebuffers of a shadow map.
#[derive(Debug)]
pub(crate) struct ShadowMap {
    pub(crate) shadow: ShadowSettings,
    blur_method: BlurMethod,
    pub(crate) depth: Texture,
    /// One framebuffer per layer of `depth`.
    pub(crate) framebuffers: Vec<Framebuffer>,
    pub(crate) blurred: Option<BlurredMoments>,
    /// Copy of the compute rasterizer's depth, which the blur writes; none if the lookups do not filter the depth, or
    /// if no compute rasterizer draws it.
    depth_copy: Option<DepthCopy>,
    /// Whether the content of the map is from the compute rasterizer.
    is_depth_copied: Cell<bool>,
}

#[derive(Debug)]
struct DepthCopy {
    texture: Texture,
    bytes: u64,
    _memory: Arc<MemoryReservation>,
}

/// Blurred moments of a variance shadow map.
#[derive(Debug)]
pub(crate) struct BlurredMoments {
    pub(crate) moments: Texture,
    /// One layer of moments blurred in x; none if one pass blurs both directions.
    pub(crate) horizontal: Option<Texture>,
    /// Framebuffer of `horizontal`, then one per layer of `moments`; empty if compute shaders blur.
    pub(crate) framebuffers: Vec<Framebuffer>,
}

impl ShadowMap {
    pub(crate) fn new(gl: &Rc<Gl>, shadow: ShadowSettings, blur_method: BlurMethod) -> Result<Self> {
        let max_size = gl.limits.max_side;
        if shadow.size > max_size {
            return Err(gl::too_large("look.shadow.size", u64::from(max_size), u64::from(shadow.size)));
        }
        let depth = create_image(gl, &shadow, gl::DEPTH_COMPONENT32F, gl::NEAREST, shadow.cascades)?;
        let framebuffers =
            (0..shadow.cascades).map(|layer| gl.depth_layer_framebuffer(&depth, layer)).collect::<Result<_>>()?;
        let blurred = if shadow.has_moments() { Some(BlurredMoments::new(gl, &shadow, blur_method)?) } else { None };
        let is_depth_copied = Cell::new(false);
        Ok(Self { shadow, blur_method, depth, framebuffers, blurred, depth_copy: None, is_depth_copied })
    }

    /// Allocates the copy of the compute rasterizer's depth if the lookups filter the depth.
    ///
    /// # Errors
    /// `OutOfMemory`; `Fault` of OpenGL.
    pub(super) fn add_depth_copy(&mut self, gl: &Rc<Gl>, budget: &Arc<MemoryBudget>) -> Result<()> {
        if self.shadow.filters_undecided_points() {
            let bytes = 4 * u64::from(self.shadow.size).pow(2);
            let memory = reserve_output(budget, bytes)?;
            let texture = create_image(gl, &self.shadow, gl::R32F, gl::NEAREST, 1)?;
            self.depth_copy = Some(DepthCopy { texture, bytes, _memory: memory });
        }
        Ok(())
    }

    /// Copy of the compute rasterizer's depth.
    pub(crate) fn depth_copy(&self) -> Option<&Texture> {
        self.depth_copy.as_ref().map(|copy| &copy.texture)
    }

    /// Bytes of the copy of the compute rasterizer's depth.
    pub(super) fn depth_copy_bytes(&self) -> Option<u64> {
        self.depth_copy.as_ref().map(|copy| copy.bytes)
    }

    /// Sets whether the content of the map is from the compute rasterizer.
    pub(crate) fn set_depth_copied(&self, is_copied: bool) {
        self.is_depth_copied.set(is_copied);
    }

    /// Depth of the map's content.
    pub(crate) fn current_depth(&self) -> &Texture {
        self.depth_copy().filter(|_| self.is_depth_copied.get()).unwrap_or(&self.depth)
    }

    /// Texture that the shading samples: moments if there are any, else depth.
    pub(crate) fn lookup_texture(&self) -> &Texture {
        self.blurred.as_ref().map_or(&self.depth, |blurred| &blurred.moments)
    }

    /// Number of textures that the map holds.
    pub(crate) fn texture_count(&self) -> usize {
        shadow_textures(&self.shadow, self.blur_method).len() + usize::from(self.depth_copy.is_some())
    }
}

impl BlurredMoments {
    fn new(gl: &Rc<Gl>, shadow: &ShadowSettings, blur_method: BlurMethod) -> Result<Self> {
        let format = if shadow.moments == MomentFormat::F16 { gl::RG16F } else { gl::RG32F };
        let moments = create_image(gl, shadow, format, gl::LINEAR, shadow.cascades)?;
        let horizontal = match blur_method {
            BlurMethod::Auto | BlurMethod::Tiles => None,
            BlurMethod::Rows | BlurMethod::Fragments => Some(create_image(gl, shadow, format, gl::NEAREST, 1)?),
        };
        let mut framebuffers = Vec::new();
        if let Some(horizontal) = horizontal.as_ref().filter(|_| blur_method == BlurMethod::Fragments) {
            framebuffers.push(gl.color_layer_framebuffer(horizontal, 0)?);
            for layer in 0..shadow.cascades {
                framebuffers.push(gl.color_layer_framebuffer(&moments, layer)?);
            }
        }
        Ok(Self { moments, horizontal, framebuffers })
    }
}

/// Creates an array texture of the map's size.
fn create_image(gl: &Rc<Gl>, shadow: &ShadowSettings, format: u32, filter: u32, layers: u32) -> Result<Texture> {
    let size = shadow.size;
    let target = gl::TEXTURE_2D_ARRAY;
    let texture = gl.texture(TextureDesc { target, format, width: size, height: size, depth: layers, levels: 1 })?;
    let sampling = [
        (gl::TEXTURE_MIN_FILTER, filter),
        (gl::TEXTURE_MAG_FILTER, filter),
        (gl::TEXTURE_WRAP_S, gl::CLAMP_TO_EDGE),
        (gl::TEXTURE_WRAP_T, gl::CLAMP_TO_EDGE),
    ];
    texture.set_sampling(&sampling, 1.0);
    Ok(texture)
}
