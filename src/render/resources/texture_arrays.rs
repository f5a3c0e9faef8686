//! Uploads texture arrays with their mipmap levels, layer by layer. Other threads compute the mipmap levels.

use std::collections::VecDeque;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::rc::Rc;
use std::sync::{Arc, OnceLock};

use rayon::ThreadPool;

use crate::device::gl::{self, Gl, Texture, TextureDesc};
use crate::scene_data::textures::{TextureArray, TextureRole, arrays, cutoff, mip_levels};
use modalcast_model::error::{Result, fault};
use modalcast_model::scene::Scene;

/// Largest number of layers whose mipmap levels are being computed or wait for their upload. Small, because mipmap
/// levels take much host memory.
const MAX_LAYERS_IN_FLIGHT: usize = 8;

/// RGBA8 pixels of the levels of a layer, level 0 first; none if the computation panicked.
type MipLevels = Option<Vec<Vec<u8>>>;

/// Texture arrays of both roles. The layers are filled one by one.
#[derive(Debug)]
pub(crate) struct TextureUpload {
    scene: Arc<Scene>,
    /// The arrays of colors, then those of normals.
    arrays: [Vec<TextureArray>; 2],
    textures: [Vec<Texture>; 2],
    /// Layers whose mipmap levels are not computed yet.
    remaining: VecDeque<Layer>,
    /// Layers whose mipmap levels are computed or being computed, in the order of their upload.
    in_flight: VecDeque<(Layer, Arc<OnceLock<MipLevels>>)>,
}

/// A layer of a texture array.
#[derive(Debug, Clone, Copy)]
struct Layer {
    role: TextureRole,
    array: usize,
    layer: usize,
}

impl TextureUpload {
    /// Creates the texture arrays of a scene. The content of their layers is undefined.
    ///
    /// # Errors
    /// `Invalid` if an array has too many layers for the device; `Fault` of OpenGL.
    pub(crate) fn begin(gl: &Rc<Gl>, scene: &Arc<Scene>, pool: &ThreadPool) -> Result<Self> {
        let roles = [TextureRole::Color, TextureRole::Normal];
        let arrays = roles.map(|role| arrays(scene, role));
        let create = |role: TextureRole| {
            arrays[role as usize].iter().map(|array| create_array(gl, array, role)).collect::<Result<Vec<_>>>()
        };
        let textures = [create(TextureRole::Color)?, create(TextureRole::Normal)?];
        let layers_of = |role: TextureRole| {
            let arrays = arrays[role as usize].iter().enumerate();
            arrays.flat_map(move |(array, desc)| (0..desc.layers.len()).map(move |layer| Layer { role, array, layer }))
        };
        let remaining = roles.into_iter().flat_map(layers_of).collect();
        let mut upload = Self { scene: Arc::clone(scene), arrays, textures, remaining, in_flight: VecDeque::new() };
        upload.compute_ahead(pool);
        Ok(upload)
    }

    /// Whether all layers are filled.
    pub(crate) fn is_finished(&self) -> bool {
        self.in_flight.is_empty()
    }

    /// Whether the mipmap levels of the next layer are computed.
    pub(crate) fn is_ready(&self) -> bool {
        self.in_flight.front().is_none_or(|(_, levels)| levels.get().is_some())
    }

    /// Fills the next layer. Waits until its mipmap levels are computed.
    ///
    /// # Errors
    /// `Fault` if the computation panicked or OpenGL fails.
    pub(crate) fn upload_layer(&mut self, pool: &ThreadPool) -> Result<()> {
        let Some((Layer { role, array, layer }, levels)) = self.in_flight.pop_front() else { return Ok(()) };
        self.compute_ahead(pool);
        let levels = levels.wait().as_ref().ok_or_else(|| fault("textures", "computing mipmap levels panicked"))?;
        let (desc, texture) = (&self.arrays[role as usize][array], &self.textures[role as usize][array]);
        // In a mixed array, the image may be smaller than the layer.
        let image = &self.scene.textures[desc.layers[layer]];
        for (level, rgba) in levels.iter().enumerate() {
            let size = [(image.width() >> level).max(1), (image.height() >> level).max(1)];
            texture.upload_pixels(level as u32, layer as u32, size, rgba)?;
        }
        Ok(())
    }

    /// The textures of colors and of normals, after all layers were filled.
    pub(crate) fn into_textures(self) -> [Vec<Texture>; 2] {
        self.textures
    }

    /// Begins to compute the mipmap levels of the next layers.
    fn compute_ahead(&mut self, pool: &ThreadPool) {
        while self.in_flight.len() < MAX_LAYERS_IN_FLIGHT {
            let Some(layer) = self.remaining.pop_front() else { return };
            let levels = Arc::new(OnceLock::new());
            let (scene, result) = (Arc::clone(&self.scene), Arc::downgrade(&levels));
            let index = self.arrays[layer.role as usize][layer.array].layers[layer.layer];
            pool.spawn(move || {
                // The levels of a dropped upload are not needed.
                if let Some(result) = result.upgrade() {
                    let compute = || compute_levels(&scene, index, layer.role);
                    let levels = catch_unwind(AssertUnwindSafe(compute)).ok();
                    // Dropped first, so that a finished upload does not hold the scene.
                    drop(scene);
                    result.set(levels).ok();
                }
            });
            self.in_flight.push_back((layer, levels));
        }
    }
}

/// The mipmap levels of the texture `index` of a scene.
fn compute_levels(scene: &Scene, index: usize, role: TextureRole) -> Vec<Vec<u8>> {
    let cutoff = if role == TextureRole::Color { cutoff(scene, index) } else { None };
    mip_levels(&scene.textures[index], role, cutoff)
}

/// Creates a texture array without content.
fn create_array(gl: &Rc<Gl>, array: &TextureArray, role: TextureRole) -> Result<Texture> {
    let layer_count = array.layers.len() as u32;
    if layer_count > gl.limits.max_layers {
        let field = format!("textures of {} x {}", array.width, array.height);
        return Err(gl::too_large(&field, u64::from(gl.limits.max_layers), u64::from(layer_count)));
    }
    let texture = gl.texture(TextureDesc {
        target: gl::TEXTURE_2D_ARRAY,
        format: if role == TextureRole::Color { gl::SRGB8_ALPHA8 } else { gl::RGBA8 },
        width: array.width,
        height: array.height,
        depth: layer_count,
        levels: array.levels(),
    })?;
    // With a software rasterizer, blending two mipmap levels takes a sixth of the frame time and is hardly visible.
    let min_filter = if gl.limits.software { gl::LINEAR_MIPMAP_NEAREST } else { gl::LINEAR_MIPMAP_LINEAR };
    let sampling = [
        (gl::TEXTURE_MIN_FILTER, min_filter),
        (gl::TEXTURE_MAG_FILTER, gl::LINEAR),
        (gl::TEXTURE_WRAP_S, gl::REPEAT),
        (gl::TEXTURE_WRAP_T, gl::REPEAT),
    ];
    texture.set_sampling(&sampling, gl.limits.anisotropy);
    Ok(texture)
}
