//! Measures one load: traces its references, compares every variant with them, then measures frame times and flicker.

use std::sync::Arc;
use std::time::Instant;

use nalgebra::Vector3;
use serde::Serialize;

use super::bare::{self, Bare, Beside};
use super::loads::{Kind, Stage};
use super::metrics::{self, Flicker, Light, Spread};
use super::packing::{Packing, packed};
use super::patience::{PATIENCE, Patience};
use super::picture::{Detail, Picture, Term, trace};
use super::pictures::{self, File};
use super::soup::Soup;
use super::studio::{Pass, Set, Size, Studio};
use super::variants::{Aim, Bounds, Method, Variant};
use super::view::View;
use super::{Entry, Request, Texels, meter};
use modalcast_model::error::Result;
use modalcast_model::scene::{Camera, Culling, Look, Scene, Shadow};
use modalcast_render::{Culled, Image, shadow_texel};

/// Step of the motion that still pictures show.
pub(super) const STILL: usize = 10;
/// Steps over which flicker is measured.
const STEPS: usize = 60;
/// Factor per side by which pictures of moving scenes are smaller.
const SMALLER: u32 = 4;

/// Results of one variant on one load.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Row {
    pub load: String,
    pub name: String,
    pub method: Method,
    pub shadow: Option<Shadow>,
    /// Packing of images in arrays, for variants that compare it.
    pub packing: Option<Packing>,
    /// Culling of the variant's look.
    pub culling: Culling,
    /// Bounds on the error against the intended result.
    pub bounds: Bounds,
    /// Whether the variant is within its bounds.
    pub passed: bool,
    /// Whether the variant is included to show a failure. The report fails if it passes.
    pub to_fail: bool,
    /// Reasons why it failed.
    pub faults: Vec<String>,
    /// Color errors against one ray per sample to the sun, which is exact for a point light.
    pub colour: Spread,
    /// Color errors against the intended result.
    pub colour_of_aim: Spread,
    /// Sun visibility against the hard shadow.
    pub light: Light,
    /// Sun visibility against the intended result.
    pub light_of_aim: Light,
    /// `None` when the variant failed or flicker was skipped.
    pub flicker: Option<Spread>,
    /// Reason why a variant that passed has no flicker.
    pub no_flicker: Option<String>,
    /// Times per pass; "frame" is the sum without readback. Empty when the variant failed.
    pub passes: Vec<Pass>,
    /// Device memory of the scene.
    pub bytes: u64,
    /// Part of `bytes` that the shadow takes.
    pub shadow_bytes: u64,
    /// Part of `bytes` that the images take, with all mip levels.
    pub image_bytes: u64,
    pub samples: u32,
    pub draws: usize,
    /// Culling counts of the last timed frame, where triangles are culled.
    pub culled: Option<Culled>,
}

impl Row {
    /// Whether it passed or failed as stated.
    pub const fn as_stated(&self) -> bool {
        self.passed != self.to_fail
    }

    /// Median time of a frame in microseconds.
    pub fn median_us(&self) -> Option<f64> {
        self.passes.iter().find(|pass| pass.name == "frame").map(|pass| pass.timing.median_us)
    }
}

/// References of a load's still picture.
struct References {
    hard: Picture,
    /// The intended result of each variant.
    aims: Vec<Picture>,
    texels: Option<Texels>,
}

/// Data that all variants of a load share.
struct Job<'a> {
    request: &'a Request,
    stage: Stage,
    camera: Camera,
    variants: Vec<Variant>,
    references: References,
    /// Light-meter image of the still picture without shadows.
    bright: Image,
    moving: Moving,
}

/// References of the moving scene per step, unshadowed and with hard shadows; or the reason why there are none.
type Moving = std::result::Result<Vec<[Picture; 2]>, String>;

/// All results of one load.
pub(super) struct Measured {
    pub(super) entry: Entry,
    pub(super) rows: Vec<Row>,
    /// `None` when there is no row to compare it with.
    pub(super) bare: Option<Bare>,
    pub(super) files: Vec<File>,
}

/// Measures every requested variant on one load.
pub(super) fn load(
    studio: &mut Studio,
    request: &Request,
    kind: Kind,
    progress: &mut dyn FnMut(&str),
) -> Result<Measured> {
    let stage = kind.stage()?;
    let camera = stage.camera(request.size);
    let mut variants = request.wanted();
    variants.retain(|variant| variant.suits(kind));
    progress(&format!("{}: tracing the references", stage.name));
    let begin = Instant::now();
    let references = references(studio, request, &stage, camera, &variants)?;
    let reference_ms = begin.elapsed().as_secs_f64() * 1e3;
    progress(&format!("{}: tracing the moving scene", stage.name));
    let moving = moving(studio, request, &stage)?;
    let unlit = meter::relit(&stage.scene, Look { shadow: None, ..stage.scene.look })?;
    let bright = frame(studio, &meter::meter(&unlit)?, &stage, request)?;
    let job = Job { request, stage, camera, variants, references, bright, moving };
    let mut files = vec![job.reference_file("hard", &job.references.hard)?];
    files.push(job.light_file()?);
    let mut rows = Vec::new();
    for at in 0..job.variants.len() {
        progress(&format!("{}: {}", job.stage.name, job.variants[at].name));
        let (row, file) = job.measure(studio, at)?;
        rows.push(row);
        files.push(file);
    }
    progress(&format!("{}: bare passes", job.stage.name));
    let bare = job.bare(studio, &rows)?;
    Ok(Measured { entry: job.entry(reference_ms), rows, bare, files })
}

fn detail(request: &Request) -> Detail {
    if request.quick { Detail::QUICK } else { Detail::FULL }
}

fn references(
    studio: &mut Studio,
    request: &Request,
    stage: &Stage,
    camera: Camera,
    variants: &[Variant],
) -> Result<References> {
    let mut set = studio.set(&stage.scene)?;
    studio.pose(&mut set, &stage.state(STILL))?;
    let shot = set.shot(camera, request.size);
    let soup = Soup::new(&stage.scene, set.surface()?);
    let view = View::new(set.scene(), &shot);
    let mut terms = vec![Term::Hard];
    for variant in variants {
        let scene = meter::relit(&stage.scene, variant.look(stage.scene.look))?;
        terms.push(term(variant, shadow_texel(&scene, &shot)));
    }
    let mut pictures = trace(&soup, &view, &terms, detail(request));
    studio.strike(set);
    let aims = pictures.split_off(1);
    Ok(References { hard: pictures.pop().unwrap_or_default(), aims, texels: Texels::of(&stage.scene, &shot) })
}

fn term(variant: &Variant, texel: Option<[Vector3<f64>; 2]>) -> Term {
    match (variant.aim, texel) {
        (Aim::Hard, _) => Term::Hard,
        (Aim::Filtered { texels }, Some(texel)) => Term::Filtered(texel.map(|side| side * texels)),
        _ => Term::Unshadowed,
    }
}

/// Size of the pictures of the moving scene.
fn small(size: Size) -> Size {
    Size { width: (size.width / SMALLER).max(1), height: (size.height / SMALLER).max(1) }
}

/// Traces the references of every step, with a quarter of a still picture's samples.
fn moving(studio: &mut Studio, request: &Request, stage: &Stage) -> Result<Moving> {
    let size = small(request.size);
    let camera = stage.camera(size);
    let mut set = studio.set(&stage.scene)?;
    let (mut all, mut soup, mut too_long) = (Vec::new(), None::<Soup>, None);
    let mut patience = Patience::new(PATIENCE, STEPS);
    for step in 0..STEPS {
        studio.pose(&mut set, &stage.state(step))?;
        let view = View::new(set.scene(), &set.shot(camera, size));
        let own = match soup.take() {
            Some(soup) => soup.moved(&stage.scene, set.surface()?),
            None => Soup::new(&stage.scene, set.surface()?),
        };
        let detail = Detail { taps: 1, ..Detail::QUICK };
        if let Ok(pair) = trace(&own, &view, &[Term::Unshadowed, Term::Hard], detail).try_into() {
            all.push(pair);
        }
        soup = Some(own);
        too_long = patience.tick("references");
        if too_long.is_some() {
            break;
        }
    }
    studio.strike(set);
    Ok(too_long.map_or(Ok(all), Err))
}

/// Draws the still picture of a scene.
fn frame(studio: &mut Studio, scene: &Arc<Scene>, stage: &Stage, request: &Request) -> Result<Image> {
    let mut set = studio.set(scene)?;
    studio.pose(&mut set, &stage.state(STILL))?;
    let image = studio.draw(&set, stage.camera(request.size), request.size);
    studio.strike(set);
    image
}

impl Job<'_> {
    fn entry(&self, reference_ms: f64) -> Entry {
        let (layout, detail) = (&self.stage.scene.layout, detail(self.request));
        Entry {
            name: self.stage.name.clone(),
            vertices: layout.vertices,
            triangles: layout.triangles,
            domains: self.stage.scene.domains.len(),
            samples: detail.side * detail.side,
            taps: detail.taps,
            reference_ms,
            texels: self.references.texels,
            steps: self.moving.as_ref().map_or(0, Vec::len),
            no_flicker: self.moving.as_ref().err().cloned(),
            steps_size: small(self.request.size),
        }
    }

    /// Compares one variant's still picture and sun visibility with the references; if it passes, measures its times
    /// and flicker.
    fn measure(&self, studio: &mut Studio, at: usize) -> Result<(Row, File)> {
        let (variant, aim) = (&self.variants[at], &self.references.aims[at]);
        let mut scene = meter::relit(&self.stage.scene, variant.look(self.stage.scene.look))?;
        if let Some(packing) = variant.packing {
            scene = packed(&scene, packing)?;
        }
        let dark = frame(studio, &meter::meter(&scene)?, &self.stage, self.request)?;
        let lit = meter::read(&dark.rgba, &self.bright.rgba);
        let mut set = studio.set(&scene)?;
        studio.pose(&mut set, &self.stage.state(STILL))?;
        let image = studio.draw(&set, self.camera, self.request.size)?;
        let ran = studio.renderer.ran().clone();
        let mut row = self.compared(variant, (&image, &lit), aim);
        (row.samples, row.draws) = (ran.samples, ran.draws);
        let plan = set.buffers.plan();
        row.bytes = plan.bytes();
        let of = |begins: &[&str]| -> u64 {
            let own = plan.textures.iter().filter(|texture| begins.iter().any(|begin| texture.name.starts_with(begin)));
            own.map(|texture| texture.bytes).sum()
        };
        (row.shadow_bytes, row.image_bytes) = (of(&["shadow"]), of(&["colour", "normal"]));
        if row.passed {
            row.passes = studio.time(&set, self.camera, self.request.size, self.request.replays)?;
            row.culled = studio.renderer.ran().culled;
            match self.flicker(studio, &mut set, variant)? {
                Ok(flicker) => row.flicker = Some(flicker),
                Err(why) => row.no_flicker = Some(why),
            }
        }
        studio.strike(set);
        let file = pictures::strip(&self.file_name(&variant.name), self.request.size, (&image.rgba, &aim.colours))?;
        Ok((row, file))
    }

    /// Times the passes of the stripped scene, for comparison with frames that use the largest timed variance map with
    /// default settings.
    fn bare(&self, studio: &mut Studio, rows: &[Row]) -> Result<Option<Bare>> {
        let usual = |row: &Row| {
            let own = row.shadow.filter(|own| Shadow { size: own.size, ..Shadow::default() } == *own);
            own.filter(|_| row.median_us().is_some())
        };
        let Some(shadow) = rows.iter().filter_map(usual).max_by_key(|own| own.size) else { return Ok(None) };
        let scene = bare::stripped(&self.stage.scene, shadow.size)?;
        let passes = self.timed(studio, &scene)?;
        let ran = studio.renderer.ran().clone();
        let timing = |name: &str| passes.iter().find(|pass| pass.name == name).map(|pass| pass.timing);
        let Some((depth, visibility)) = timing("shadow").zip(timing("visibility")) else { return Ok(None) };
        if !bare::is_bare(&ran) {
            tracing::warn!(load = self.stage.name, "the stripped scene was not one draw a pass: no bare passes");
            return Ok(None);
        }
        let own = Bare {
            load: self.stage.name.clone(),
            triangles: scene.layout.triangles,
            map: shadow.size,
            samples: ran.samples,
            depth,
            visibility,
            unculled: self.beside(studio, rows, (shadow, Culling::None))?,
            usual: self.beside(studio, rows, (shadow, self.stage.scene.look.culling))?,
        };
        Ok(Some(own.compared()))
    }

    /// Time of a frame with this shadow map and culling: that of an existing row, or a new measurement.
    fn beside(&self, studio: &mut Studio, rows: &[Row], (shadow, culling): (Shadow, Culling)) -> Result<Beside> {
        // A row with the load's own look may not have culled anything.
        let is = |row: &&Row| {
            let culls_so = row.culling == culling || culling == Culling::None && row.culled.is_none();
            row.shadow == Some(shadow) && culls_so
        };
        let found = rows.iter().filter(is).find_map(|row| Some((row.name.clone(), row.median_us()?)));
        let (name, frame_us) = match found {
            Some(found) => found,
            None => {
                let look = Look { shadow: Some(shadow), culling, ..self.stage.scene.look };
                let passes = self.timed(studio, &meter::relit(&self.stage.scene, look)?)?;
                let frame = passes.iter().find(|pass| pass.name == "frame").map_or(0.0, |pass| pass.timing.median_us);
                (format!("variance {}, blur {}", shadow.size, shadow.blur), frame)
            }
        };
        let way = if culling == Culling::None { "without culling" } else { "as the load culls" };
        Ok(Beside { name: format!("{name}: {way}"), frame_us, beyond_us: 0.0 })
    }

    /// Times the passes of the still picture of a scene.
    fn timed(&self, studio: &mut Studio, scene: &Arc<Scene>) -> Result<Vec<Pass>> {
        let mut set = studio.set(scene)?;
        studio.pose(&mut set, &self.stage.state(STILL))?;
        let passes = studio.time(&set, self.camera, self.request.size, self.request.replays);
        studio.strike(set);
        passes
    }

    fn compared(&self, variant: &Variant, (image, lit): (&Image, &[Option<f32>]), aim: &Picture) -> Row {
        let hard = &self.references.hard;
        let colour_of_aim = metrics::colours(&image.rgba, &aim.colours);
        let light_of_aim = metrics::light(lit, &aim.light);
        let bounds = variant.bounds(self.stage.kind);
        let faults = faults(&colour_of_aim, &light_of_aim, &bounds);
        Row {
            load: self.stage.name.clone(),
            name: variant.name.clone(),
            method: variant.method,
            shadow: variant.shadow,
            packing: variant.packing,
            culling: variant.look(self.stage.scene.look).culling,
            bounds,
            passed: faults.is_empty(),
            to_fail: variant.is_to_fail(self.stage.kind),
            faults,
            colour: metrics::colours(&image.rgba, &hard.colours),
            colour_of_aim,
            light: metrics::light(lit, &hard.light),
            light_of_aim,
            flicker: None,
            no_flicker: None,
            passes: Vec::new(),
            bytes: 0,
            shadow_bytes: 0,
            image_bytes: 0,
            samples: 0,
            draws: 0,
            culled: None,
        }
    }

    /// The flicker of a variant, or the reason why it was skipped.
    fn flicker(
        &self,
        studio: &mut Studio,
        set: &mut Set,
        variant: &Variant,
    ) -> Result<std::result::Result<Spread, String>> {
        let moving = match &self.moving {
            Ok(moving) => moving,
            Err(why) => return Ok(Err(why.clone())),
        };
        let size = small(self.request.size);
        let camera = self.stage.camera(size);
        let mut flicker = Flicker::default();
        let mut patience = Patience::new(PATIENCE, STEPS);
        for (step, [unshadowed, hard]) in moving.iter().enumerate() {
            studio.pose(set, &self.stage.state(step))?;
            let image = studio.draw(set, camera, size)?;
            let reference = if variant.aim == Aim::Unshadowed { unshadowed } else { hard };
            flicker.push(&image.rgba, &reference.colours);
            if let Some(why) = patience.tick("frames") {
                return Ok(Err(why));
            }
        }
        Ok(Ok(flicker.spread()))
    }

    fn file_name(&self, what: &str) -> String {
        format!("{}-{}", self.stage.name, what.replace(", ", "-").replace(' ', "-"))
    }

    fn reference_file(&self, what: &str, picture: &Picture) -> Result<File> {
        pictures::picture(&self.file_name(what), self.request.size, &picture.colours)
    }

    /// Sun visibility of the hard reference as a gray image; blue where it is undefined.
    fn light_file(&self) -> Result<File> {
        let shade = |light: &Option<f32>| light.map_or([60.0, 70.0, 110.0], |light| [255.0 * light; 3]);
        let colours: Vec<[f32; 3]> = self.references.hard.light.iter().map(shade).collect();
        pictures::picture(&self.file_name("hard light"), self.request.size, &colours)
    }
}

/// Descriptions of the exceeded bounds.
fn faults(colour: &Spread, light: &Light, bounds: &Bounds) -> Vec<String> {
    let found = [
        ("mean error of colour", Some(colour.mean), bounds.mean_colour),
        ("mean error of light", Some(light.all.mean), bounds.mean_light),
        ("mean light in the umbra", light.in_umbra, bounds.bleeding),
        ("mean light lost outside of shadows", light.lost, bounds.lost),
    ];
    let over = |(what, found, bound): (&str, Option<f64>, f64)| {
        let found = found.filter(|found| found.is_nan() || *found > bound)?;
        Some(format!("{what} {found:.3}, bound {bound}"))
    };
    found.into_iter().filter_map(over).collect()
}

#[cfg(test)]
mod tests {
    use super::super::variants::BOUNDS;
    use super::*;

    #[test]
    fn detects_missing_dark_or_displaced_small_shadows() {
        let shadow = |first: usize| -> Vec<Option<f32>> {
            (0..1000).map(|at| Some(if (first..first + 10).contains(&at) { 0.0 } else { 1.0 })).collect()
        };
        let judged = |own: &[Option<f32>]| faults(&Spread::default(), &metrics::light(own, &shadow(100)), &BOUNDS);
        assert_eq!(judged(&shadow(100)), Vec::<String>::new(), "control: the right one");
        assert_eq!(judged(&shadow(102)), Vec::<String>::new(), "a fifth of it beside its place is within the bound");
        for wrong in [shadow(200), vec![Some(1.0); 1000], shadow(105)] {
            assert!(judged(&wrong)[0].starts_with("mean light in the umbra"), "{:?}", judged(&wrong));
        }
        assert!(judged(&vec![Some(0.5); 1000]).iter().any(|fault| fault.starts_with("mean light lost")));
        let loud = Spread { mean: f64::NAN, ..Spread::default() };
        assert_eq!(faults(&loud, &Light::default(), &BOUNDS).len(), 1, "what is no number is a fault");
    }
}
