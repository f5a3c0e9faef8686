//! Shader programs of a scene's passes, with the branches that its materials need.

use std::rc::Rc;

use super::cull::{CullPrograms, SunPrograms};
use super::geometry::{Group, Kind};
use super::gl::Program;
use super::lists::ListPrograms;
use super::plan::Plan;
use super::shaders::{Options, Source};
use modalcast_model::error::Result;

/// Returns the program of a source, compiled or from the cache.
pub(super) type Compile<'a> = dyn FnMut(Source) -> Result<Rc<Program>> + 'a;

/// Programs that do not depend on the samples per pixel; none where the scene has no such pass or triangles.
#[derive(Debug)]
pub(super) struct Programs {
    /// In execution order; empty when the shadow map has no moments.
    pub(super) blur: Vec<Rc<Program>>,
    /// Shadow casters of each kind.
    pub(super) shadow: [Option<Rc<Program>>; 3],
    pub(super) opaque: Option<Rc<Program>>,
    pub(super) ground: Option<Rc<Program>>,
    /// Culling of shadow casters.
    pub(super) sun: Option<SunPrograms>,
}

/// Programs for one number of samples per pixel.
#[derive(Debug, Clone)]
pub(super) struct Sampled {
    pub(super) samples: u32,
    pub(super) mask: Option<Rc<Program>>,
    /// Two-pass transparency: the opaque parts of blended triangles, if there may be any. `blended` draws the rest of
    /// them.
    pub(super) parts: Option<Rc<Program>>,
    pub(super) blended: Option<Rc<Program>>,
    /// Exact transparency.
    pub(super) lists: Option<ListPrograms>,
    pub(super) backdrop: Rc<Program>,
    pub(super) shade: Option<Rc<Program>>,
    /// Triangle culling.
    pub(super) cull: Option<CullPrograms>,
}

impl Programs {
    pub(super) fn compile(options: &Options, plan: &Plan, groups: &[Group], compile: &mut Compile<'_>) -> Result<Self> {
        let has = |pass: &str| plan.passes.contains(&pass);
        let blurs = if has("blur") { options.blur() } else { vec![] };
        let blur = blurs.into_iter().map(&mut *compile).collect::<Result<_>>()?;
        let mut when = |wanted: bool, source: &dyn Fn() -> Source| match wanted {
            true => compile(source()).map(Some),
            false => Ok(None),
        };
        let any = |kind: Kind| groups.iter().any(|group| group.kind == kind);
        let mut caster = |kind: Kind| when(has("shadow") && any(kind), &|| options.shadow(kind));
        let shadow = [caster(Kind::Opaque)?, caster(Kind::Mask)?, caster(Kind::Blend)?];
        Ok(Self {
            blur,
            shadow,
            opaque: when(any(Kind::Opaque), &|| options.visibility(Kind::Opaque, 1))?,
            ground: when(has("ground"), &|| options.ground())?,
            sun: if has("shadow") && options.culls() { Some(SunPrograms::compile(options, compile)?) } else { None },
        })
    }
}

impl Sampled {
    pub(super) fn compile(
        options: &Options,
        groups: &[Group],
        samples: u32,
        compile: &mut Compile<'_>,
    ) -> Result<Self> {
        let any = |kind: Kind| groups.iter().any(|group| group.kind == kind);
        let (cut_out, triangles) = (any(Kind::Mask), any(Kind::Opaque) || any(Kind::Mask) || options.opaque_parts());
        let listed = options.defines.contains(&"LISTED");
        let mut when = |wanted: bool, source: &dyn Fn() -> Source| match wanted {
            true => compile(source()).map(Some),
            false => Ok(None),
        };
        Ok(Self {
            samples,
            mask: when(cut_out, &|| options.visibility(Kind::Mask, samples))?,
            parts: when(options.opaque_parts(), &|| options.visibility(Kind::Blend, samples))?,
            blended: when(any(Kind::Blend) && !listed, &|| options.blended(samples))?,
            lists: if listed { Some(ListPrograms::compile(options, samples, compile)?) } else { None },
            backdrop: compile(options.backdrop(samples))?,
            shade: if triangles { Some(compile(options.shade(samples))?) } else { None },
            cull: CullPrograms::compile(options, samples, compile)?,
        })
    }
}
