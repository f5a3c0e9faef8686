//! The tools of the device thread: a backend that deforms and, where there is one, a renderer. Scenes become [`Staged`].

use std::sync::Arc;
use std::time::{Duration, Instant};

use super::staged::Staged;
use super::viewer::Showing;
use crate::config::{BackendChoice, Config, RendererChoice};
use crate::frame::Legend;
use crate::telemetry::{Stage, ms_since};
use modalcast_compute::cpu::CpuDeformer;
use modalcast_compute::gpu::{self, CudaDeformer, GlBuffers, GlRaster};
use modalcast_compute::reference::ReferenceDeformer;
use modalcast_model::deform::{Backend, Deformer};
use modalcast_model::error::{Error, Result};
use modalcast_model::raster::{Mesh, Rasteriser};
use modalcast_model::scene::{Camera, Rastering, Rectangle, Scene};
use modalcast_render::{Field, Hit, Image, Pick, Pixels, Prefer, Renderer, SceneBuffers, Survey, Ticket};

/// What deforms and what draws, for people to read.
#[derive(Debug, Clone)]
pub struct Info {
    pub backend: Backend,
    /// The CUDA device's name, or the reason why there is none.
    pub device: String,
    /// What draws, or why nothing does.
    pub renderer: Result<modalcast_render::Info>,
}

/// A frame under way.
#[derive(Debug)]
pub struct Drawing {
    ticket: Ticket,
    /// Milliseconds of bringing its vertices to the renderer, if they had to be.
    upload_ms: Option<f64>,
}

impl Drawing {
    /// Whether [`Workbench::finish_draw`] would not wait, after waiting for it at most so long.
    pub fn is_ready_within(&self, limit: Duration) -> bool {
        self.ticket.is_ready_within(limit)
    }
}

/// Owns the device and the renderer. Lives on one thread; the command line's `render` uses it directly.
#[derive(Debug)]
pub struct Workbench {
    // Scenes are put away by `unstage` before either is dropped; OpenGL goes before the CUDA context that it maps.
    renderer: Result<Renderer>,
    device: Option<Arc<gpu::Device>>,
    info: Info,
}

impl Workbench {
    /// Opens what the settings ask for and the machine has.
    ///
    /// # Errors
    /// `Unavailable` when CUDA is asked for by name and is not there. A missing renderer is no error until a frame is
    /// asked for.
    pub fn open(config: &Config) -> Result<Self> {
        let (backend, device, note) = open_backend(config)?;
        let renderer = open_renderer(config, device.is_some());
        let info = Info {
            backend,
            device: note,
            renderer: renderer.as_ref().map(|renderer| renderer.info().clone()).map_err(Clone::clone),
        };
        Ok(Self { renderer, device, info })
    }

    /// The backend in use.
    pub const fn backend(&self) -> Backend {
        self.info.backend
    }

    /// What deforms and what draws.
    pub const fn info(&self) -> &Info {
        &self.info
    }

    /// What the last frame really ran; none without a renderer.
    pub fn ran(&self) -> Option<&modalcast_render::Ran> {
        self.renderer.as_ref().ok().map(Renderer::ran)
    }

    /// Prepares a scene and deforms it at rest. OpenGL buffers are made now only when the deformer writes into them.
    ///
    /// # Errors
    /// `Fault` when the device refuses; `Invalid` when the rest state itself overflows.
    pub fn stage(&mut self, scene: &Arc<Scene>) -> Result<Staged> {
        let mut buffers = None;
        let deformer: Box<dyn Deformer> = match (self.device.clone(), self.info.backend) {
            (Some(device), Backend::Cuda) => {
                buffers = self.shareable_buffers(scene)?;
                let gl = buffers.as_ref().map(gl_buffers);
                match CudaDeformer::new(&device, scene, gl) {
                    Ok(deformer) => Box::new(deformer),
                    Err(error) => {
                        self.unload(buffers);
                        return Err(error);
                    }
                }
            }
            (_, Backend::Reference) => Box::new(ReferenceDeformer::new(scene)),
            _ => Box::new(CpuDeformer::new(scene)),
        };
        let mut staged = Staged::new(scene, deformer, buffers);
        let ready = staged.rest().and_then(|()| self.draw_beside(&mut staged));
        match ready {
            Ok(()) => Ok(staged),
            Err(error) => {
                self.unstage(staged);
                Err(error)
            }
        }
    }

    /// Gives a scene whose look asks for it a rasteriser in CUDA, and lets the faster of both draw each pass where it asks for
    /// that. Where there can be none, OpenGL draws and the log says why.
    ///
    /// # Errors
    /// Those of drawing the frames that are measured.
    fn draw_beside(&mut self, staged: &mut Staged) -> Result<()> {
        let scene = Arc::clone(staged.scene());
        let (wanted, Some(device), Ok(renderer)) = (scene.look.raster, &self.device, &mut self.renderer) else {
            return Ok(());
        };
        if wanted == Rastering::OpenGl || renderer.info().cuda_device.is_none() {
            return Ok(());
        }
        let make = |mesh: Mesh| Ok(Box::new(GlRaster::new(device, mesh)?) as Box<dyn Rasteriser>);
        if let Err(error) = staged.draw_beside(renderer, make) {
            tracing::warn!(%error, "OpenGL draws: its buffers have no rasteriser in CUDA");
            return Ok(());
        }
        if wanted == Rastering::Fastest { staged.choose_paths(renderer) } else { Ok(()) }
    }

    /// Frees what a staged scene holds.
    pub fn unstage(&mut self, staged: Staged) {
        let buffers = staged.into_buffers();
        self.unload(buffers);
    }

    /// Draws the vertices of the last deformation. The image's passes name "upload" too when there was one.
    ///
    /// # Errors
    /// `Unavailable` without a renderer, `Invalid` for a camera or size that makes no sense, `Fault` of OpenGL.
    pub fn draw(&mut self, staged: &mut Staged, camera: &Camera, width: u32, height: u32) -> Result<Image> {
        let drawing = self.begin_draw(staged, camera, width, height)?;
        self.finish_draw(drawing).map(Pixels::into_image)
    }

    /// Begins to draw the vertices of the last deformation, without waiting for the device; another may be deformed then.
    ///
    /// # Errors
    /// As [`Self::draw`]; `Busy` when too many are under way.
    pub fn begin_draw(&mut self, staged: &mut Staged, camera: &Camera, width: u32, height: u32) -> Result<Drawing> {
        let camera = camera.checked()?;
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        let begin = Instant::now();
        let filled = staged.fill_buffers(renderer, &camera)?;
        let upload_ms = filled.uploaded.then(|| ms_since(begin));
        let shot = filled.shot(camera, [width, height]);
        Ok(Drawing { ticket: renderer.submit(staged.buffers()?, &shot)?, upload_ms })
    }

    /// Waits for a frame; any thread may then take its pixels.
    ///
    /// # Errors
    /// `Fault` when the device does not finish.
    pub fn finish_draw(&mut self, drawing: Drawing) -> Result<Pixels> {
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        let pixels = renderer.retrieve(drawing.ticket)?;
        Ok(match drawing.upload_ms {
            Some(ms) => pixels.after(Stage::Upload.name(), ms),
            None => pixels,
        })
    }

    /// Numbers in place of colours, and the legend when they are to be a colour map. For what shows colour, use
    /// [`Self::draw`].
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn survey(
        &mut self,
        staged: &mut Staged,
        camera: &Camera,
        size: [u32; 2],
        showing: Showing,
    ) -> Result<(Survey, Option<Legend>)> {
        let camera = camera.checked()?;
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        let shot = staged.fill_buffers(renderer, &camera)?.shot(camera, size);
        let legend = staged.map_values(renderer, showing)?;
        let field = match (showing, &legend) {
            (_, Some(legend)) => Field::Values { largest: legend.largest as f32 },
            (Showing::Depth, _) => Field::Depth,
            (Showing::Normals, _) => Field::Normals,
            _ => Field::Domains,
        };
        let survey = renderer.survey(staged.buffers()?, &shot, field)?;
        Ok((survey, legend))
    }

    /// Begins to pick in a rectangle of a picture of this size, without waiting for the device.
    ///
    /// # Errors
    /// As [`Self::draw`].
    pub fn begin_pick(
        &mut self,
        staged: &mut Staged,
        camera: &Camera,
        size: [u32; 2],
        rectangle: Rectangle,
    ) -> Result<Pick> {
        let camera = camera.checked()?;
        let renderer = self.renderer.as_mut().map_err(|error| error.clone())?;
        let shot = staged.fill_buffers(renderer, &camera)?.shot(camera, size);
        renderer.begin_pick(staged.buffers()?, &shot, rectangle)
    }

    /// Waits for a pick; the hits, row by row.
    ///
    /// # Errors
    /// `Fault` when the device does not finish.
    pub fn finish_pick(&mut self, pick: Pick) -> Result<Vec<Hit>> {
        self.renderer.as_mut().map_err(|error| error.clone())?.finish_pick(pick)
    }

    /// Buffers that CUDA may map: only when the renderer is that very device.
    fn shareable_buffers(&mut self, scene: &Arc<Scene>) -> Result<Option<SceneBuffers>> {
        match &mut self.renderer {
            Ok(renderer) if renderer.info().cuda_device.is_some() => renderer.load(scene).map(Some),
            _ => Ok(None),
        }
    }

    fn unload(&mut self, buffers: Option<SceneBuffers>) {
        if let (Some(buffers), Ok(renderer)) = (buffers, &mut self.renderer) {
            renderer.unload(buffers);
        }
    }
}

fn gl_buffers(buffers: &SceneBuffers) -> GlBuffers {
    let shared = buffers.shared;
    GlBuffers { positions: shared.positions, normals: shared.normals, tangents: shared.tangents }
}

fn open_backend(config: &Config) -> Result<(Backend, Option<Arc<gpu::Device>>, String)> {
    match config.backend {
        BackendChoice::Cpu => Ok((Backend::Cpu, None, "not asked for".into())),
        BackendChoice::Reference => Ok((Backend::Reference, None, "not asked for".into())),
        BackendChoice::Cuda => open_cuda(config),
        BackendChoice::Auto => open_cuda(config).or_else(|error| Ok((Backend::Cpu, None, error.to_string()))),
    }
}

/// A device that deforms: one without a compiler for its kernels does not count.
fn open_cuda(config: &Config) -> Result<(Backend, Option<Arc<gpu::Device>>, String)> {
    let device = gpu::Device::open(config.cuda_device)?;
    device.check_compiler()?;
    let name = device.name().to_owned();
    Ok((Backend::Cuda, Some(device), name))
}

fn open_renderer(config: &Config, cuda: bool) -> Result<Renderer> {
    let refusal = |reason: &str, remedy: &str| Error::Unavailable {
        what: "renderer",
        reason: reason.into(),
        remedy: remedy.into(),
    };
    let renderer = match config.renderer {
        RendererChoice::Off => return Err(refusal("it was switched off", "Start the server with a renderer")),
        RendererChoice::Software => Renderer::open(Prefer::Software),
        RendererChoice::Auto if cuda => {
            let ordinal = i32::try_from(config.cuda_device).unwrap_or(i32::MAX);
            // A driver without its EGL half still deforms; frames then come from whatever else draws.
            Renderer::open(Prefer::Cuda(ordinal)).or_else(|_| Renderer::open(Prefer::Any))
        }
        RendererChoice::Auto => Renderer::open(Prefer::Any),
    }?;
    if renderer.info().software && !config.allow_software {
        let reason = format!("only {} is there and software renderers are not allowed", renderer.info().renderer);
        return Err(refusal(&reason, "Install the GPU's EGL driver or allow software"));
    }
    Ok(renderer)
}
