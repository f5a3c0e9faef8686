//! Error against run time of the renderer: pictures by every variant against references that rays make by brute force.
//!
//! Validate first, then time: a variant whose error against what it means to show exceeds a stated bound is not timed, is
//! named, and fails the report. A variant that is shown as a failure is stated so, and fails the report if it is none.
//!
//! - [`loads`], [`variants`]: what is drawn, and how.
//! - `soup`, `paint`, `texels`, `view`, `shade`, `pattern`, `picture`: the references. 64 samples a pixel, all in f64 but
//!   the boxes of the tree; solid surfaces and cut-outs by their nearest point, transparent ones sorted by depth along
//!   every sample; the shadow by one ray a sample to the sun, or by rays over the blur's own footprint.
//! - `studio`, `meter`: frames of the renderer, and the light in them.
//! - `readback`: frames a second when each is read.
//! - [`metrics`]: errors, light bleeding, flicker.
//! - `bare`: the passes of the scene stripped to its mesh, timed in the same run; `blurs`: moments and blur in compute and in fragments.
//! - `raster`: the same passes by CUDA beside OpenGL; `paths`: whole frames with either.
//! - [`packing`]: images in one array as equation 3.13 packs them, against arrays by size.
//! - [`plants`]: the plants of table 4.5 with rendering.
//! - [`timed`]: frame times of a scene of the user, for programs that draw the same.
//! - [`figures`]: pictures to be looked at, after those of the thesis.

mod bare;
mod beside;
mod blurs;
pub mod figures;
mod images;
pub mod loads;
mod measure;
mod meter;
pub mod metrics;
mod output;
pub mod packing;
mod page;
mod paint;
mod paths;
mod patience;
mod pattern;
mod picture;
mod pictures;
pub mod plants;
mod plot;
mod raster;
mod readback;
mod shade;
mod soup;
mod studio;
#[cfg(test)]
mod tests;
mod texels;
pub mod timed;
pub mod variants;
mod view;

use serde::Serialize;

pub use self::bare::{Bare, Beside};
pub use self::blurs::Blurs;
use self::loads::Kind;
pub use self::measure::Row;
pub use self::pictures::File;
use self::plants::Plant;
pub use self::raster::{Rastered, Rasters, rasters};
pub use self::readback::Readback;
use self::studio::Studio;
pub use self::studio::{Pass, Size};
use self::variants::Variant;
use super::machine::Provenance;
use super::wants;
use modalcast_model::error::Result;
use modalcast_model::scene::Scene;
use modalcast_render::{Info, Shot, shadow_texel};

/// What to report on.
#[derive(Debug, Clone)]
pub struct Request {
    pub loads: Vec<Kind>,
    /// Plants of table 4.5 to deform and draw, counted from 0.
    pub plants: Vec<usize>,
    /// Which variants, by name or by its beginning and a `*`; empty: all.
    pub variants: Vec<String>,
    pub size: Size,
    /// Fewer variants, samples and steps, for machines of few cores.
    pub quick: bool,
    /// Frames per median.
    pub replays: usize,
}

impl Request {
    /// The variants to measure. A quick run has fewer, and those that are named in full whether or not they are of these.
    pub fn wanted(&self) -> Vec<Variant> {
        let (few, mut all) = (variants::all(self.quick), variants::all(false));
        all.retain(|variant| {
            let is_named = self.variants.contains(&variant.name);
            is_named || wants(&self.variants, &variant.name) && few.iter().any(|own| own.name == variant.name)
        });
        all
    }
}

/// One load of a report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Entry {
    pub name: String,
    pub vertices: usize,
    pub triangles: usize,
    pub domains: usize,
    /// Samples of a pixel of the reference, and rays to the sun of each where its light is filtered.
    pub samples: usize,
    pub taps: usize,
    /// What tracing all references of its still picture took.
    pub reference_ms: f64,
    /// Of the shadow map of its own look; none without one.
    pub texels: Option<Texels>,
    /// Steps over which flicker was looked at, and the size of their pictures.
    pub steps: usize,
    pub steps_size: Size,
    /// Why flicker was not looked at.
    pub no_flicker: Option<String>,
}

/// The longer sides of a texel of a shadow map of `size` texels a side, in scene units: of the map that is drawn, which is
/// fitted to what the vertices take up in light space, and of one that is fitted to the corners of their bounds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Texels {
    pub size: u32,
    pub side: f64,
    pub by_corners: f64,
}

impl Texels {
    fn of(scene: &Scene, shot: &Shot) -> Option<Self> {
        let longer = |shot: &Shot| shadow_texel(scene, shot).map(|sides| sides[0].norm().max(sides[1].norm()));
        let (side, by_corners) = (longer(shot)?, longer(&Shot { light: None, ..*shot })?);
        scene.look.shadow.map(|shadow| Self { size: shadow.size, side, by_corners })
    }
}

/// A whole report.
#[derive(Debug, Clone, Serialize)]
pub struct Report {
    pub made: Provenance,
    pub renderer: Info,
    pub size: Size,
    /// What bounds a variant must keep against what it means to show, where its row has no closer ones.
    pub bounds: variants::Bounds,
    pub loads: Vec<Entry>,
    pub rows: Vec<Row>,
    /// One a load.
    pub readback: Vec<Readback>,
    /// What the bare passes take on each load.
    pub bare: Vec<Bare>,
    /// The passes by CUDA beside them, where there is a device.
    pub raster: Vec<Rastered>,
    /// What the passes that make the same map of moments take, in compute and in fragments.
    pub blurs: Vec<Blurs>,
    /// Plants of table 4.5, deformed and drawn.
    pub plants: Vec<Plant>,
    /// Variants that did not pass though they should, or passed though they should not, as load: variant: why.
    pub failed: Vec<String>,
    /// Pictures to be looked at.
    #[serde(skip)]
    pub pictures: Vec<File>,
}

/// Makes a report; `progress` hears what is being done.
///
/// # Errors
/// `Unavailable` without OpenGL; those of loading and drawing a scene.
pub fn render(request: &Request, mut progress: impl FnMut(&str)) -> Result<Report> {
    let mut studio = Studio::open()?;
    let (mut loads, mut rows, mut bare, mut pictures) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    let mut readback = Vec::new();
    for kind in &request.loads {
        progress(&format!("{}: building", kind.name()));
        let measured = measure::load(&mut studio, request, *kind, &mut progress)?;
        loads.push(measured.entry);
        rows.extend(measured.rows);
        bare.extend(measured.bare);
        pictures.extend(measured.files);
        progress(&format!("{}: reading back", kind.name()));
        readback.push(readback::measure(&mut studio, request, *kind)?);
    }
    let device = plants::device();
    let raster = match &device {
        Some(device) => raster::measure(&mut studio, device, request, &mut progress)?,
        None => Vec::new(),
    };
    let mut plants = Vec::new();
    for index in &request.plants {
        progress(&format!("plant-{}", index + 1));
        plants.push(plants::measure(&mut studio, device.as_ref(), request, *index)?);
    }
    let failed = rows.iter().filter(|row: &&Row| !row.as_stated()).map(why);
    let failed = failed.chain(raster.iter().filter_map(Rastered::fault)).collect();
    let (made, renderer, bounds) = (Provenance::here(), studio.renderer.info().clone(), variants::BOUNDS);
    let blurs = Blurs::of(&rows);
    let size = request.size;
    Ok(Report { made, renderer, size, bounds, loads, rows, readback, bare, raster, blurs, plants, failed, pictures })
}

fn why(row: &Row) -> String {
    let why = if row.passed { "keeps bounds that it is stated to exceed".into() } else { row.faults.join("; ") };
    format!("{}: {}: {why}", row.load, row.name)
}

impl Report {
    /// Whether every variant passed, but for those that are there to be seen to fail: these must not have.
    pub fn passed(&self) -> bool {
        self.failed.is_empty()
    }
}
