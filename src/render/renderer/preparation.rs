//! Preparation of a scene in steps, so that the device thread can execute other commands in between: its textures are
//! uploaded layer by layer, and its programs are compiled one by one.

use std::collections::{HashSet, VecDeque};
use std::rc::Rc;
use std::sync::Arc;

use super::Renderer;
use crate::device::gl::{self, PendingProgram, Program};
use crate::resources::scene_buffers::{SceneBuffers, collect_program_sources};
use crate::resources::target_desc::TargetDesc;
use crate::resources::texture_arrays::TextureUpload;
use crate::shaders::ProgramSource;
use modalcast_model::error::Result;
use modalcast_model::scene::{FrameAntialiasing, FrameStyle, Scene};

/// Textures and programs of a scene that are not on the device yet. A step uploads a layer of a texture array, or
/// compiles a program. If threads of the driver compile programs, a step only begins or ends a compilation.
#[derive(Debug)]
pub struct ScenePreparation {
    scene: Arc<Scene>,
    /// None for a frame, whose scene has its textures.
    textures: Option<TextureUpload>,
    sources: VecDeque<ProgramSource>,
    pending: Vec<(ProgramSource, PendingProgram)>,
    /// Keeps the compiled programs in the cache.
    compiled: Vec<Rc<Program>>,
}

/// A prepared scene whose buffers are not created yet.
#[derive(Debug)]
pub(super) struct PreparedScene {
    scene: Arc<Scene>,
    textures: [Vec<gl::Texture>; 2],
    /// Keeps the compiled programs in the cache.
    _compiled: Vec<Rc<Program>>,
}

impl ScenePreparation {
    /// Whether no step remains.
    pub fn is_finished(&self) -> bool {
        self.textures.as_ref().is_none_or(TextureUpload::is_finished)
            && self.sources.is_empty()
            && self.pending.is_empty()
    }

    /// Whether the next step does not wait for other threads.
    pub fn is_ready(&self) -> bool {
        let is_texture_ready =
            self.textures.as_ref().is_some_and(|textures| !textures.is_finished() && textures.is_ready());
        self.is_finished() || is_texture_ready || !self.sources.is_empty() || complete_program(&self.pending).is_some()
    }
}

/// Index of a program that is complete. Polls all programs, because polling lets the driver link them.
fn complete_program(pending: &[(ProgramSource, PendingProgram)]) -> Option<usize> {
    let complete = pending.iter().enumerate().filter(|(_, (_, program))| program.is_complete());
    complete.map(|(index, _)| index).last()
}

impl Renderer {
    /// Begins to prepare a scene for [`Renderer::load`].
    ///
    /// # Errors
    /// `Invalid` if the scene exceeds a limit of the device; `Fault` of OpenGL.
    pub fn begin_preparation(&mut self, scene: &Arc<Scene>) -> Result<ScenePreparation> {
        let _current = self.gl.make_current()?;
        let placeholder = Rc::new(self.gl.empty_program()?);
        let (positions, method) = (&self.sample_positions, self.blur_method);
        let sources = collect_program_sources(&self.gl, scene, positions, method, &placeholder)?;
        let textures = TextureUpload::begin(&self.gl, scene, &self.preparation_pool)?;
        Ok(self.preparation_of(scene, Some(textures), sources))
    }

    /// Begins to compile the programs of a frame of this size and style that are not compiled yet. Those are programs
    /// for mesh edges, or for another number of samples per pixel than most frames have.
    ///
    /// # Errors
    /// `Fault` of OpenGL.
    pub fn begin_frame_preparation(
        &mut self,
        buffers: &SceneBuffers,
        size: [u32; 2],
        style: FrameStyle,
    ) -> Result<ScenePreparation> {
        let _current = self.gl.make_current()?;
        let mut sources = Vec::new();
        let has_edges = style.edges.is_some();
        let FrameAntialiasing { method, samples } = buffers.antialiasing(size, style.samples);
        // Large frames may have fewer samples.
        let antialiasing =
            FrameAntialiasing { method, samples: TargetDesc::ids_and_depth(&self.gl, size, samples).samples };
        if !buffers.has_frame_programs(antialiasing, has_edges) {
            let placeholder = Rc::new(self.gl.empty_program()?);
            let collect = &mut |source| {
                sources.push(source);
                Ok(Rc::clone(&placeholder))
            };
            buffers.sample_programs(antialiasing.samples, has_edges, collect)?;
            buffers.encode_program(method, collect)?;
        }
        Ok(self.preparation_of(&buffers.scene, None, sources))
    }

    /// A preparation of textures and of those programs that are not in the cache.
    fn preparation_of(
        &self,
        scene: &Arc<Scene>,
        textures: Option<TextureUpload>,
        mut sources: Vec<ProgramSource>,
    ) -> ScenePreparation {
        let mut known = HashSet::new();
        sources.retain(|source| !self.programs.contains(source) && known.insert(source.clone()));
        ScenePreparation {
            scene: Arc::clone(scene),
            textures,
            sources: sources.into(),
            pending: Vec::new(),
            compiled: Vec::new(),
        }
    }

    /// Executes the next step of a preparation.
    ///
    /// # Errors
    /// `Fault` with the compiler's log, or of OpenGL.
    pub fn prepare_step(&mut self, preparation: &mut ScenePreparation) -> Result<()> {
        let _current = self.gl.make_current()?;
        let ScenePreparation { textures, sources, pending, compiled, .. } = preparation;
        let must_upload = |textures: &TextureUpload| {
            !textures.is_finished() && (textures.is_ready() || (sources.is_empty() && pending.is_empty()))
        };
        if let Some(textures) = textures.as_mut().filter(|textures| must_upload(textures)) {
            return textures.upload_layer(&self.preparation_pool);
        }
        if let Some(source) = sources.pop_front() {
            let program = self.programs.begin(&source)?;
            pending.push((source, program));
            if self.gl.limits.parallel_compile {
                return Ok(());
            }
        }
        if !pending.is_empty() {
            let (source, program) = pending.swap_remove(complete_program(pending).unwrap_or(0));
            compiled.push(self.programs.finish(source, program)?);
        }
        Ok(())
    }

    /// Keeps the textures and programs of a finished preparation until the scene is loaded or dropped. The programs of
    /// a frame stay in the cache.
    pub fn finish_preparation(&mut self, preparation: ScenePreparation) {
        let ScenePreparation { scene, textures, compiled, .. } = preparation;
        let Some(textures) = textures else { return };
        self.prepared_scenes.push(PreparedScene { scene, textures: textures.into_textures(), _compiled: compiled });
    }

    /// The texture arrays of a scene: those of its preparation, or new ones.
    pub(super) fn textures_of(&mut self, scene: &Arc<Scene>) -> Result<[Vec<gl::Texture>; 2]> {
        let prepared = self.prepared_scenes.iter().position(|prepared| Arc::ptr_eq(&prepared.scene, scene));
        // A scene without other references was dropped before it was loaded.
        let prepared = prepared.map(|index| self.prepared_scenes.swap_remove(index));
        self.prepared_scenes.retain(|prepared| Arc::strong_count(&prepared.scene) > 1);
        if let Some(PreparedScene { textures, .. }) = prepared {
            return Ok(textures);
        }
        let mut upload = TextureUpload::begin(&self.gl, scene, &self.preparation_pool)?;
        while !upload.is_finished() {
            upload.upload_layer(&self.preparation_pool)?;
        }
        Ok(upload.into_textures())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene_data::geometry::tests::squares;
    use crate::{DevicePreference, FrameParams};
    use modalcast_model::deform::DeformedSurface;
    use modalcast_model::domain::{AlphaMode, Material, Texture};
    use modalcast_model::scene::{Bloom, Camera, Culling, MeshEdges, Transparency};

    /// Prepares a scene. Returns the number of steps.
    fn prepare(renderer: &mut Renderer, scene: &Arc<Scene>) -> usize {
        let mut preparation = renderer.begin_preparation(scene).expect("begins");
        let mut step_count = 0;
        while !preparation.is_finished() {
            while !preparation.is_ready() {
                std::thread::yield_now();
            }
            renderer.prepare_step(&mut preparation).expect("prepares");
            step_count += 1;
        }
        renderer.finish_preparation(preparation);
        step_count
    }

    #[test]
    fn load_compiles_no_program_after_the_preparation() {
        let materials = [AlphaMode::Opaque, AlphaMode::Mask { cutoff: 0.5 }, AlphaMode::Blend];
        let mut parts = squares(materials.map(|alpha_mode| Material { alpha_mode, ..Material::default() }).to_vec());
        (parts.look.bloom, parts.look.culling) = (Some(Bloom::default()), Culling::Triangles);
        parts.look.transparency = Transparency::OrderIndependent;
        let scene = Scene::new(parts).expect("a valid scene");
        let mut renderer = Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3");
        let step_count = prepare(&mut renderer, &scene);
        let program_count = renderer.programs.labels().count();
        assert!(program_count >= 15 && step_count >= program_count, "{program_count} programs, {step_count} steps");
        let buffers = renderer.load(&scene).expect("loads");
        assert_eq!(renderer.programs.labels().count(), program_count);
        renderer.unload(buffers);
        assert!(renderer.begin_preparation(&scene).expect("begins").is_finished(), "expected cached programs");
        // Negative control: without a preparation, the load compiles all programs.
        let mut renderer = Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3");
        renderer.load(&scene).expect("loads");
        assert_eq!(renderer.programs.labels().count(), program_count);
    }

    /// A scene with ten color textures of two sizes, more than are computed ahead. Each has another color.
    fn textured_scene() -> Arc<Scene> {
        let materials =
            (0..10).map(|index| Material { color_texture: Some(index), double_sided: true, ..Material::default() });
        let mut parts = squares(materials.collect());
        let texture = |index: u32| {
            let side = if index.is_multiple_of(3) { 16 } else { 32 };
            let pixel = |position: u32| [(20 * index) as u8, (position * 37 % 251) as u8, 99, 255];
            Texture::new("test", side, side, (0..side * side).flat_map(pixel).collect()).expect("a valid texture")
        };
        parts.textures = (0..10).map(texture).collect();
        Scene::new(parts).expect("a valid scene")
    }

    #[test]
    fn prepared_textures_are_those_of_an_unprepared_scene() {
        let mut images = Vec::new();
        for is_prepared in [false, true] {
            let scene = textured_scene();
            let mut renderer = Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3");
            if is_prepared {
                let step_count = prepare(&mut renderer, &scene);
                assert!(step_count >= 10, "expected a step for each texture, got {step_count} steps");
                // A prepared scene that is dropped before it is loaded frees its textures.
                prepare(&mut renderer, &textured_scene());
                assert_eq!(renderer.prepared_scenes.len(), 2);
            }
            let buffers = renderer.load(&scene).expect("loads");
            assert!(renderer.prepared_scenes.is_empty());
            // The squares side by side.
            let corner = |vertex: usize| [[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]][vertex % 4];
            let positions: Vec<[f32; 3]> = (0..scene.layout.vertices)
                .map(|vertex| [0.1 * ((vertex / 4) as f32 + corner(vertex)[0]), corner(vertex)[1], 0.0])
                .collect();
            let surface = DeformedSurface {
                positions: positions.as_flattened().to_vec(),
                normals: [0.0, 0.0, 1.0].repeat(positions.len()),
                ..DeformedSurface::default()
            };
            renderer.upload(&buffers, &surface).expect("uploads");
            let camera = Camera::fit_to_scene(&scene, 128, 128);
            let bounds = scene.rest_bounds;
            let params =
                FrameParams { camera, width: 128, height: 128, bounds, light_bounds: None, edges: None, samples: None };
            images.push(renderer.draw(&buffers, &params).expect("draws").rgba);
        }
        let colors: HashSet<&[u8]> = images[0].chunks(4).collect();
        assert!(colors.len() > 100, "expected a detailed image, got {} colors", colors.len());
        assert!(images[0] == images[1]);
    }

    #[test]
    fn frame_with_edges_compiles_no_program_after_its_preparation() {
        let mut renderer = Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3");
        let scene = Scene::new(squares(vec![Material::default()])).expect("a valid scene");
        let buffers = renderer.load(&scene).expect("loads");
        let size = [48, 32];
        let edges = Some(MeshEdges::default());
        assert!(
            renderer.begin_frame_preparation(&buffers, size, FrameStyle::default()).expect("begins").is_finished(),
            "control"
        );
        let loaded_count = renderer.programs.labels().count();
        let mut preparation =
            renderer.begin_frame_preparation(&buffers, size, FrameStyle { edges, samples: None }).expect("begins");
        assert!(!preparation.is_finished(), "expected programs for edges");
        while !preparation.is_finished() {
            while !preparation.is_ready() {
                std::thread::yield_now();
            }
            renderer.prepare_step(&mut preparation).expect("prepares");
        }
        renderer.finish_preparation(preparation);
        let prepared_count = renderer.programs.labels().count();
        assert!(prepared_count > loaded_count && renderer.prepared_scenes.is_empty());
        let (camera, bounds) = (Camera::fit_to_scene(&scene, size[0], size[1]), scene.rest_bounds);
        let params =
            FrameParams { camera, width: size[0], height: size[1], bounds, light_bounds: None, edges, samples: None };
        renderer.draw(&buffers, &params).expect("draws");
        assert_eq!(renderer.programs.labels().count(), prepared_count);
        renderer.unload(buffers);
    }

    #[test]
    fn invalid_program_is_reported_with_the_log() {
        let renderer = Renderer::open(DevicePreference::Any).expect("EGL and OpenGL 4.3");
        for (source, expected) in [
            ("#version 430 core\nvoid main() { undeclared = 1; }", "undeclared"),
            ("#version 430 core\nvoid missing(); void main() { missing(); }", "missing"),
        ] {
            let stages = [(crate::device::gl::VERTEX_SHADER, source)];
            let program = renderer.gl.begin_program("faulty", &stages).expect("begins");
            while !program.is_complete() {
                std::thread::yield_now();
            }
            let error = program.finish().expect_err("an invalid program").to_string();
            assert!(error.contains("faulty") && error.contains(expected), "{error}");
            renderer.gl.check("test").expect("no OpenGL error");
        }
    }
}
