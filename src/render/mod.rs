//! Headless OpenGL: a scene's buffers, the passes that draw it, and the pixels back.

use std::sync::Arc;

use crate::deform::Surface;
use crate::error::{Result, during};
use crate::scene::{Bounds, Camera, Scene};

/// Which EGL device to draw on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Prefer {
    /// The device that is this CUDA device.
    Cuda(i32),
    /// Any hardware device, else Mesa's software rasteriser.
    Any,
    /// Mesa's software rasteriser.
    Software,
}

/// What draws.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Info {
    /// GL_RENDERER.
    pub renderer: String,
    /// GL_VERSION.
    pub version: String,
    /// Whether it runs on the CPU.
    pub software: bool,
    /// The CUDA device that it is, by EGL_CUDA_DEVICE_NV.
    pub cuda_device: Option<i32>,
    /// The largest side of a frame, in pixels.
    pub max_side: u32,
}

/// One frame to be drawn of what the buffers hold.
#[derive(Debug, Clone, Copy)]
pub struct Shot {
    pub camera: Camera,
    pub width: u32,
    pub height: u32,
    /// Bounds of the deformed vertices; the shadow map is fitted to them.
    pub bounds: Bounds,
}

/// RGBA8 sRGB pixels, top row first.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    pub width: u32,
    pub height: u32,
    pub rgba: Vec<u8>,
    /// Milliseconds per pass, by the name of the stage: "shadow", "draw", "read".
    pub passes: Vec<(&'static str, f64)>,
}

/// Names of the OpenGL buffers that a deformer may write in place of an upload.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SharedBuffers {
    /// 3 f32 per vertex.
    pub positions: u32,
    /// 3 f32 per corner.
    pub normals: u32,
    /// 4 f32 per corner, when the scene has normal maps.
    pub tangents: Option<u32>,
}

/// A scene's buffers, textures and programs on the device.
#[derive(Debug)]
pub struct SceneBuffers {
    pub shared: SharedBuffers,
}

/// The EGL and OpenGL contexts. Lives and dies on the device thread.
#[derive(Debug)]
pub struct Renderer {
    info: Info,
}

impl Renderer {
    /// Opens a surfaceless context and makes it current on this thread.
    ///
    /// # Errors
    /// `Unavailable` naming the missing library or vendor file.
    pub fn open(prefer: Prefer) -> Result<Self> {
        Err(during("render")(format!("not built yet: {prefer:?}")))
    }

    /// What draws.
    pub const fn info(&self) -> &Info {
        &self.info
    }

    /// Loads what never changes of a scene, and makes room for what does.
    ///
    /// # Errors
    /// `Fault` when a shader or a buffer is refused.
    pub fn load(&mut self, scene: &Arc<Scene>) -> Result<SceneBuffers> {
        Err(during("render")(format!("not built yet: {}", scene.name)))
    }

    /// Frees a scene's buffers.
    pub fn unload(&mut self, _buffers: SceneBuffers) {}

    /// Fills the shared buffers from host memory.
    ///
    /// # Errors
    /// `Fault` when OpenGL reports one.
    pub fn upload(&mut self, _buffers: &SceneBuffers, _surface: &Surface) -> Result<()> {
        Err(during("render")("not built yet"))
    }

    /// Draws one frame of what the shared buffers hold.
    ///
    /// # Errors
    /// `Invalid` for a size above the limit, `Fault` when OpenGL reports one.
    pub fn draw(&mut self, _buffers: &SceneBuffers, _shot: &Shot) -> Result<Image> {
        Err(during("render")("not built yet"))
    }
}
