//! The programs of a scene: those of the passes, and for each draw group the ones with the branches its material needs.

use std::rc::Rc;

use super::geometry::{Group, Kind};
use super::gl::Program;
use super::plan::Plan;
use super::shaders::{Options, Source};
use super::textures::{Array, place};
use crate::error::Result;
use crate::scene::Scene;

/// Gives the program of a source, compiled or shared.
pub(super) type Compile<'a> = dyn FnMut(Source) -> Result<Rc<Program>> + 'a;

/// Programs of whole passes; absent where the scene has no such pass.
#[derive(Debug)]
pub(super) struct Programs {
    /// In order; none where the map has no moments.
    pub(super) blur: Vec<Rc<Program>>,
    pub(super) ground: Option<Rc<Program>>,
    pub(super) sky: Rc<Program>,
}

/// A draw group with its programs and the arrays of its material's images.
#[derive(Debug)]
pub(super) struct DrawGroup {
    pub(super) group: Group,
    pub(super) surface: Rc<Program>,
    /// For pictures of one sample a pixel, where that makes a difference.
    pub(super) surface_single: Option<Rc<Program>>,
    pub(super) shadow: Option<Rc<Program>>,
    /// Indices among the scene's arrays; none when triangles look their materials up, for then all arrays are bound.
    pub(super) colour: Option<usize>,
    pub(super) normal: Option<usize>,
}

impl Programs {
    pub(super) fn compile(options: &Options, plan: &Plan, compile: &mut Compile<'_>) -> Result<Self> {
        let has = |pass: &str| plan.passes.contains(&pass);
        Ok(Self {
            blur: match has("blur") {
                true => options.blur().into_iter().map(&mut *compile).collect::<Result<_>>()?,
                false => vec![],
            },
            ground: if has("ground") { Some(compile(options.ground())?) } else { None },
            sky: compile(options.sky())?,
        })
    }
}

impl DrawGroup {
    pub(super) fn compile(
        scene: &Scene,
        group: Group,
        images: &[Vec<Array>; 2],
        options: &Options,
        compile: &mut Compile<'_>,
    ) -> Result<Self> {
        let material = group.material.map(|material| &scene.materials[material]);
        let array = |arrays: &[Array], texture: Option<usize>| {
            texture.and_then(|texture| place(arrays, texture)).map(|(array, _)| array)
        };
        let colour = material.and_then(|material| array(&images[0], material.colour_texture));
        let normal = material.and_then(|material| array(&images[1], material.normal_texture));
        let own = match material {
            Some(_) => options.narrowed(colour.is_some(), normal.is_some()),
            None => options.clone(),
        };
        let cut_out = group.kind == Kind::Mask && own.samples > 1;
        Ok(Self {
            group,
            surface: compile(own.surface(group.kind, own.samples))?,
            surface_single: if cut_out { Some(compile(own.surface(group.kind, 1))?) } else { None },
            shadow: if scene.needs.shadows { Some(compile(own.shadow(group.kind))?) } else { None },
            colour,
            normal,
        })
    }
}
