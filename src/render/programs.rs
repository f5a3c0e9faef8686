//! Shader programs of a scene's passes, with the branches that its materials need.

use std::rc::Rc;

use super::cull::{CullPrograms, ShadowCullPrograms};
use super::geometry::{BlendMode, DrawGroup};
use super::oit::OitPrograms;
use super::plan::RenderPlan;
use super::shaders::{ProgramSource, ShaderOptions};
use crate::device::gl::Program;
use modalcast_model::error::Result;

/// Returns the program of a source, compiled or from the cache.
pub(crate) type ProgramCompiler<'a> = dyn FnMut(ProgramSource) -> Result<Rc<Program>> + 'a;

/// Programs that do not depend on the samples per pixel; none where the scene has no such pass or triangles.
#[derive(Debug)]
pub(crate) struct ScenePrograms {
    /// In execution order; empty when the shadow map has no moments.
    pub(crate) blur: Vec<Rc<Program>>,
    /// Shadow casters of each kind.
    pub(crate) shadow: [Option<Rc<Program>>; 3],
    pub(crate) opaque: Option<Rc<Program>>,
    pub(crate) ground: Option<Rc<Program>>,
    /// Culling of shadow casters.
    pub(crate) shadow_cull: Option<ShadowCullPrograms>,
}

/// Programs for one number of samples per pixel.
#[derive(Debug, Clone)]
pub(crate) struct SampleCountPrograms {
    pub(crate) samples: u32,
    pub(crate) mask: Option<Rc<Program>>,
    /// Two-pass transparency: the opaque parts of blended triangles, if there may be any. `blended` draws the rest of
    /// them.
    pub(crate) opaque_parts: Option<Rc<Program>>,
    pub(crate) blended: Option<Rc<Program>>,
    /// Exact transparency.
    pub(crate) oit: Option<OitPrograms>,
    pub(crate) background: Rc<Program>,
    pub(crate) shade: Option<Rc<Program>>,
    /// Triangle culling.
    pub(crate) cull: Option<CullPrograms>,
}

impl ScenePrograms {
    pub(crate) fn compile(
        options: &ShaderOptions,
        plan: &RenderPlan,
        groups: &[DrawGroup],
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let has = |pass: &str| plan.passes.contains(&pass);
        let blurs = if has("blur") { options.blur() } else { vec![] };
        let blur = blurs.into_iter().map(&mut *compile).collect::<Result<_>>()?;
        let mut when = |wanted: bool, source: &dyn Fn() -> ProgramSource| match wanted {
            true => compile(source()).map(Some),
            false => Ok(None),
        };
        let any = |blend_mode: BlendMode| groups.iter().any(|group| group.blend_mode == blend_mode);
        let mut caster = |blend_mode: BlendMode| when(has("shadow") && any(blend_mode), &|| options.shadow(blend_mode));
        let shadow = [caster(BlendMode::Opaque)?, caster(BlendMode::Mask)?, caster(BlendMode::Blend)?];
        Ok(Self {
            blur,
            shadow,
            opaque: when(any(BlendMode::Opaque), &|| options.visibility(BlendMode::Opaque, 1))?,
            ground: when(has("ground"), &|| options.ground())?,
            shadow_cull: if has("shadow") && options.has_culling() {
                Some(ShadowCullPrograms::compile(options, compile)?)
            } else {
                None
            },
        })
    }
}

impl SampleCountPrograms {
    pub(crate) fn compile(
        options: &ShaderOptions,
        groups: &[DrawGroup],
        samples: u32,
        compile: &mut ProgramCompiler<'_>,
    ) -> Result<Self> {
        let any = |blend_mode: BlendMode| groups.iter().any(|group| group.blend_mode == blend_mode);
        let (cut_out, triangles) =
            (any(BlendMode::Mask), any(BlendMode::Opaque) || any(BlendMode::Mask) || options.opaque_parts());
        let listed = options.defines.contains(&"OIT");
        let mut when = |wanted: bool, source: &dyn Fn() -> ProgramSource| match wanted {
            true => compile(source()).map(Some),
            false => Ok(None),
        };
        Ok(Self {
            samples,
            mask: when(cut_out, &|| options.visibility(BlendMode::Mask, samples))?,
            opaque_parts: when(options.opaque_parts(), &|| options.visibility(BlendMode::Blend, samples))?,
            blended: when(any(BlendMode::Blend) && !listed, &|| options.blended(samples))?,
            oit: if listed { Some(OitPrograms::compile(options, samples, compile)?) } else { None },
            background: compile(options.background(samples))?,
            shade: if triangles { Some(compile(options.shade(samples))?) } else { None },
            cull: CullPrograms::compile(options, samples, compile)?,
        })
    }
}
