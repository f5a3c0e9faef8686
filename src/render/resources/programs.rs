//! Shader programs of a scene's passes, and the cache that shares programs between scenes.

use std::collections::HashMap;
use std::rc::Rc;

use crate::device::gl::{Gl, PendingProgram, Program};
use crate::scene_data::geometry::{BlendMode, DrawGroup};
use crate::shaders::{self, ProgramSource, ShaderOptions};
use modalcast_model::error::Result;
use modalcast_model::scene::{Antialiasing, RenderSettings};

/// Maximum number of programs in the cache.
const MAX_PROGRAMS: usize = 128;

/// Returns the program of a source, compiled or from the cache.
pub(crate) type ProgramCompiler<'a> = dyn FnMut(ProgramSource) -> Result<Rc<Program>> + 'a;

/// Compiled programs by their source; at most [`MAX_PROGRAMS`].
#[derive(Debug)]
pub(crate) struct ProgramCache {
    gl: Rc<Gl>,
    programs: HashMap<ProgramSource, Rc<Program>>,
}

/// Programs that do not depend on the samples per pixel. An optional program is absent if the scene does not need it.
#[derive(Debug)]
pub(crate) struct ScenePrograms {
    /// Programs of the blur in execution order; empty if the shadow map has no moments.
    pub(crate) blur: Vec<Rc<Program>>,
    /// Draws shadow casters; one each for opaque, cut-out and blended triangles.
    pub(crate) shadow: [Option<Rc<Program>>; 3],
    /// Draws the ids of opaque triangles.
    pub(crate) opaque: Option<Rc<Program>>,
    /// Culls shadow casters.
    pub(crate) shadow_cull: Option<ShadowCullPrograms>,
}

/// Programs for one number of samples per pixel.
#[derive(Debug, Clone)]
pub(crate) struct SampleCountPrograms {
    pub(crate) samples: u32,
    /// Draws the ids of cut-out triangles.
    pub(crate) mask: Option<Rc<Program>>,
    /// Two-pass transparency: draws the opaque parts of blended triangles, if there may be any. `blended` draws the
    /// other parts.
    pub(crate) opaque_parts: Option<Rc<Program>>,
    pub(crate) blended: Option<Rc<Program>>,
    /// Programs of exact transparency.
    pub(crate) oit: Option<OitPrograms>,
    pub(crate) ambient: Option<AmbientPrograms>,
    pub(crate) background: Rc<Program>,
    pub(crate) shade: Option<Rc<Program>>,
    /// Whether `shade` draws lines along mesh edges.
    pub(crate) has_edges: bool,
    /// Programs of triangle culling.
    pub(crate) cull: Option<CullPrograms>,
}

/// Programs that list the triangles for the camera, for one number of samples per pixel.
#[derive(Debug, Clone)]
pub(crate) struct CullPrograms {
    pub(crate) cull_triangles: Rc<Program>,
    pub(crate) compact: Rc<Program>,
    pub(crate) occlusion: Option<OcclusionPrograms>,
}

/// Further programs of occlusion culling.
#[derive(Debug, Clone)]
pub(crate) struct OcclusionPrograms {
    /// Lists the triangles that were visible in the last frame.
    pub(crate) cull_previous: Rc<Program>,
    pub(crate) record_visible: Rc<Program>,
    /// Builds the first levels of the depth pyramid.
    pub(crate) fine_levels: Rc<Program>,
    /// Builds the remaining levels.
    pub(crate) coarse_levels: Rc<Program>,
}

/// Programs that list the shadow casters.
#[derive(Debug)]
pub(crate) struct ShadowCullPrograms {
    pub(crate) cull_triangles: Rc<Program>,
    pub(crate) compact: Rc<Program>,
}

/// Programs of the ambient occlusion.
#[derive(Debug, Clone)]
pub(crate) struct AmbientPrograms {
    pub(crate) surface: Rc<Program>,
    pub(crate) occlusion: Rc<Program>,
    pub(crate) filter: Rc<Program>,
}

/// Programs of exact transparency.
#[derive(Debug, Clone)]
pub(crate) struct OitPrograms {
    /// Counts or stores fragments, depending on its phase.
    pub(crate) gather: Rc<Program>,
    pub(crate) histogram: Rc<Program>,
    pub(crate) allocate: Rc<Program>,
    pub(crate) resolve: Rc<Program>,
}

/// Post-processing programs for the look (the render settings) of a scene.
#[derive(Debug)]
pub(crate) struct PostPrograms {
    /// Encodes frames with the antialiasing `antialias`.
    pub(crate) encode: Rc<Program>,
    pub(crate) antialias: Antialiasing,
    pub(crate) bloom: Option<BloomPrograms>,
}

/// Bloom programs. `composite` is the last upsampling, which adds the bloom to the scene color.
#[derive(Debug)]
pub(crate) struct BloomPrograms {
    pub(crate) downsample: Rc<Program>,
    pub(crate) upsample: Rc<Program>,
    pub(crate) composite: Rc<Program>,
}

impl ProgramCache {
    pub(crate) fn new(gl: &Rc<Gl>) -> Self {
        Self { gl: Rc::clone(gl), programs: HashMap::new() }
    }

    /// Returns the program of a source, compiled unless it is cached. A full cache first drops all programs that no
    /// scene uses, or all programs if every one is used.
    ///
    /// # Errors
    /// `Fault` with the compiler's log.
    pub(crate) fn program(&mut self, source: ProgramSource) -> Result<Rc<Program>> {
        if let Some(program) = self.programs.get(&source) {
            return Ok(Rc::clone(program));
        }
        let pending = self.begin(&source)?;
        self.finish(source, pending)
    }

    /// Whether the program of a source is cached.
    pub(crate) fn contains(&self, source: &ProgramSource) -> bool {
        self.programs.contains_key(source)
    }

    /// Begins to compile the program of a source that is not cached.
    ///
    /// # Errors
    /// `Fault` of OpenGL.
    pub(crate) fn begin(&self, source: &ProgramSource) -> Result<PendingProgram> {
        let stages: Vec<(u32, &str)> = source.stages.iter().map(|(stage, text)| (*stage, text.as_str())).collect();
        self.gl.begin_program(&source.label, &stages)
    }

    /// Waits for the program of a source and caches it.
    ///
    /// # Errors
    /// `Fault` with the compiler's log.
    pub(crate) fn finish(&mut self, source: ProgramSource, pending: PendingProgram) -> Result<Rc<Program>> {
        let program = Rc::new(pending.finish()?);
        if self.programs.len() >= MAX_PROGRAMS {
            self.programs.retain(|_, program| Rc::strong_count(program) > 1);
        }
        if self.programs.len() >= MAX_PROGRAMS {
            self.programs.clear();
        }
        self.programs.insert(source, Rc::clone(&program));
        Ok(program)
    }

    /// Labels of the cached programs.
    #[cfg(test)]
    pub(crate) fn labels(&self) -> impl Iterator<Item = &str> {
        self.programs.keys().map(|source| source.label.as_str())
    }
}

/// Compiles a program if the scene needs it.
fn compile_if(
    is_needed: bool,
    compile: &mut ProgramCompiler<'_>,
    source: impl FnOnce() -> ProgramSource,
) -> Result<Option<Rc<Program>>> {
    if is_needed { compile(source()).map(Some) } else { Ok(None) }
}

impl ScenePrograms {
    pub(crate) fn compile(
        options: &ShaderOptions,
        groups: &[DrawGroup],
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let has_triangles = |blend_mode: BlendMode| groups.iter().any(|group| group.blend_mode == blend_mode);
        let has_shadow = options.features.shadow.is_some();
        let mut compile_caster = |blend_mode: BlendMode| {
            compile_if(has_shadow && has_triangles(blend_mode), compile, || options.shadow(blend_mode))
        };
        let shadow =
            [compile_caster(BlendMode::Opaque)?, compile_caster(BlendMode::Mask)?, compile_caster(BlendMode::Blend)?];
        let shadow_cull = match has_shadow && options.features.has_culling() {
            true => Some(ShadowCullPrograms {
                cull_triangles: compile(options.cull_casters())?,
                compact: compile(options.cull_compact())?,
            }),
            false => None,
        };
        Ok(Self {
            blur: options.blur().into_iter().map(&mut *compile).collect::<Result<_>>()?,
            shadow,
            opaque: compile_if(has_triangles(BlendMode::Opaque), compile, || options.visibility(BlendMode::Opaque, 1))?,
            shadow_cull,
        })
    }
}

impl SampleCountPrograms {
    pub(crate) fn compile(
        options: &ShaderOptions,
        groups: &[DrawGroup],
        samples: u32,
        has_edges: bool,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let has_triangles = |blend_mode: BlendMode| groups.iter().any(|group| group.blend_mode == blend_mode);
        let (oit, opaque_parts) = (options.features.oit, options.features.opaque_parts);
        let has_visibility = has_triangles(BlendMode::Opaque) || has_triangles(BlendMode::Mask) || opaque_parts;
        Ok(Self {
            samples,
            mask: compile_if(has_triangles(BlendMode::Mask), compile, || options.visibility(BlendMode::Mask, samples))?,
            opaque_parts: compile_if(opaque_parts, compile, || options.visibility(BlendMode::Blend, samples))?,
            blended: compile_if(has_triangles(BlendMode::Blend) && !oit, compile, || options.blended(samples))?,
            oit: if oit { Some(OitPrograms::compile(options, samples, compile)?) } else { None },
            ambient: match options.features.ambient_occlusion {
                Some(sampling) => Some(AmbientPrograms {
                    surface: compile(options.ambient_surface(sampling, samples))?,
                    occlusion: compile(options.ambient_occlusion(sampling, samples))?,
                    filter: compile(options.ambient_filter(sampling, samples))?,
                }),
                None => None,
            },
            background: compile(options.background(samples))?,
            shade: compile_if(has_visibility, compile, || options.shade(samples, has_edges))?,
            has_edges,
            cull: if options.features.has_culling() {
                Some(CullPrograms::compile(options, samples, compile)?)
            } else {
                None
            },
        })
    }
}

impl CullPrograms {
    fn compile(options: &ShaderOptions, samples: u32, compile: &mut ProgramCompiler<'_>) -> Result<Self> {
        let (cull_triangles, compact) = (compile(options.cull_triangles(samples))?, compile(options.cull_compact())?);
        let occlusion = match options.features.has_occlusion_culling() {
            true => Some(OcclusionPrograms {
                cull_previous: compile(options.cull_previously_visible())?,
                record_visible: compile(options.record_visible(samples))?,
                fine_levels: compile(options.depth_pyramid(samples, true))?,
                coarse_levels: compile(options.depth_pyramid(samples, false))?,
            }),
            false => None,
        };
        Ok(Self { cull_triangles, compact, occlusion })
    }
}

impl OitPrograms {
    fn compile(options: &ShaderOptions, samples: u32, compile: &mut ProgramCompiler<'_>) -> Result<Self> {
        Ok(Self {
            gather: compile(options.oit_gather(samples))?,
            histogram: compile(shaders::oit::histogram())?,
            allocate: compile(shaders::oit::allocate())?,
            resolve: compile(options.oit_resolve(samples))?,
        })
    }
}

impl PostPrograms {
    /// `antialias`: the antialiasing of most frames.
    pub(crate) fn compile(
        look: &RenderSettings,
        antialias: Antialiasing,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let bloom = match look.bloom {
            Some(bloom) => Some(BloomPrograms {
                downsample: compile(shaders::post::bloom_downsample())?,
                upsample: compile(shaders::post::bloom_upsample(look, bloom, false))?,
                composite: compile(shaders::post::bloom_upsample(look, bloom, true))?,
            }),
            None => None,
        };
        Ok(Self { encode: compile(shaders::post::encode(look, antialias))?, antialias, bloom })
    }
}
