//! Reproduces the figures of the thesis's chapter 4.2 with our own scenes: single trees (4.1), groups of four and
//! twenty (4.2), bump mapping (4.3), shadow maps of 4096 and 512 texels per side (4.4, 4.5), transparency (4.6); also
//! draws scenes of the user.
//!
//! The trees are the built-in one, the same in blossom, and generated conifers. Trees with modes bend as in a light
//! wind.

mod cameras;
mod conifer;
mod forest;
mod needles;

use std::path::Path;
use std::sync::Arc;

use serde::Serialize;

use self::forest::PlantInstance;
use super::harness::{RenderHarness, Size};
use super::image_files::{self, ImageFile};
use super::{light_meter, workloads};
use crate::provenance::Provenance;
use modalcast_model::domain::{AlphaMode, Texture};
use modalcast_model::error::{Result, fault_in, invalid};
use modalcast_model::load;
use modalcast_model::scene::{Camera, RenderSettings, Scene, SceneParts, ShadowMethod, ShadowSettings};
use modalcast_render::RendererInfo;

/// Settings of the figures.
#[derive(Debug, Clone)]
pub struct Request {
    /// Size of a single picture. Most figures consist of several pictures.
    pub size: Size,
    /// Scenes of the user, as given on the command line; each becomes a figure.
    pub scenes: Vec<String>,
}

/// One figure.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Figure {
    /// Number in the thesis, or the name of the user's scene.
    pub name: String,
    /// Descriptions of the pictures, from left to right and top to bottom.
    pub shows: Vec<String>,
    pub file: String,
    /// Triangles of all pictures together.
    pub triangles: usize,
}

/// All figures.
#[derive(Debug, Clone, Serialize)]
pub struct Figures {
    pub made: Provenance,
    pub renderer: RendererInfo,
    /// Size of a single picture.
    pub size: Size,
    pub figures: Vec<Figure>,
    #[serde(skip)]
    files: Vec<ImageFile>,
}

/// Draws all figures; `progress` receives the name of each.
///
/// # Errors
/// `Unavailable` without OpenGL; errors of loading and drawing a scene.
pub fn figures(request: &Request, mut progress: impl FnMut(&str)) -> Result<Figures> {
    let mut atelier =
        FigureRenderer { studio: RenderHarness::open()?, size: request.size, figures: Vec::new(), files: Vec::new() };
    progress("growing");
    let species = FigurePlants::grow()?;
    for (name, draw) in [
        ("4.1", singles as fn(&mut FigureRenderer, &FigurePlants) -> Result<()>),
        ("4.2", groups),
        ("4.3", bumps),
        ("4.4 and 4.5", shadows),
        ("4.6", leaves),
    ] {
        progress(&format!("figure {name}"));
        draw(&mut atelier, &species)?;
    }
    for source in &request.scenes {
        progress(source);
        own(&mut atelier, source)?;
    }
    let FigureRenderer { studio, size, figures, files } = atelier;
    Ok(Figures { made: Provenance::here(), renderer: studio.renderer.info().clone(), size, figures, files })
}

/// The renderer and the figures drawn so far.
struct FigureRenderer {
    studio: RenderHarness,
    size: Size,
    figures: Vec<Figure>,
    files: Vec<ImageFile>,
}

/// The species of all figures.
struct FigurePlants {
    tree: SceneParts,
    peach: SceneParts,
    fir: SceneParts,
    hemlock: SceneParts,
    spruce: SceneParts,
}

impl FigurePlants {
    fn grow() -> Result<Self> {
        let tree = load::open("tree")?.scene.parts();
        let bark = bark(&tree)?;
        let conifer = |habit: &conifer::ConiferParameters| conifer::grow(habit, bark);
        let (fir, hemlock, spruce) = (conifer(&conifer::FIR)?, conifer(&conifer::HEMLOCK)?, conifer(&conifer::SPRUCE)?);
        Ok(Self { peach: forest::in_blossom(&tree)?, fir, hemlock, spruce, tree })
    }
}

/// Color and normal images of the tree's bark, which the conifers share.
fn bark(tree: &SceneParts) -> Result<[&Texture; 2]> {
    let images = tree.materials.iter().find_map(|material| material.color_texture.zip(material.normal_texture));
    let (color, normal) = images.ok_or_else(|| fault_in("figures")("the tree has no bark"))?;
    Ok([&tree.textures[color], &tree.textures[normal]])
}

/// A look with a shadow map that is sharp enough for single leaves.
fn fine(look: RenderSettings) -> RenderSettings {
    RenderSettings { shadow: Some(ShadowSettings { size: 4096, ..ShadowSettings::default() }), ..look }
}

/// One picture to draw.
struct FigureView<'a> {
    shows: String,
    scene: &'a Arc<Scene>,
    camera: Camera,
    size: Size,
}

impl FigureRenderer {
    fn draw(&mut self, piece: &FigureView<'_>) -> Result<Vec<u8>> {
        let mut set = self.studio.set(piece.scene)?;
        self.studio.pose(&mut set, &workloads::swaying(piece.scene))?;
        let image = self.studio.draw(&set, piece.camera, piece.size);
        self.studio.unload(set);
        image.map(|image| image.rgba)
    }

    /// Draws a figure of equally sized pictures in rows of `columns`.
    fn figure(&mut self, name: &str, title: &str, columns: usize, pieces: &[FigureView<'_>]) -> Result<()> {
        let drawn = pieces.iter().map(|piece| self.draw(piece)).collect::<Result<Vec<_>>>()?;
        let size = pieces.first().map_or(self.size, |piece| piece.size);
        let file = image_files::sheet(&format!("figure-{name}-{title}"), size, columns, &drawn)?;
        self.figures.push(Figure {
            name: name.into(),
            shows: pieces.iter().map(|piece| piece.shows.clone()).collect(),
            file: file.name.clone(),
            triangles: pieces.iter().map(|piece| piece.scene.layout.triangles).sum(),
        });
        self.files.push(file);
        Ok(())
    }

    fn piece<'a>(&self, shows: &str, scene: &'a Arc<Scene>, camera: Camera) -> FigureView<'a> {
        FigureView { shows: shows.into(), scene, camera, size: self.size }
    }
}

/// One plant at the origin.
fn alone(turn: f64) -> [PlantInstance; 1] {
    [PlantInstance { species: 0, right: 0.0, near: 0.0, turn, scale: 1.0 }]
}

/// Figure 4.1: single trees.
fn singles(atelier: &mut FigureRenderer, species: &FigurePlants) -> Result<()> {
    let alone = |(plant, turn): (&SceneParts, f64)| {
        Scene::new(forest::plant("single", &[plant], &alone(turn), fine(species.tree.look)))
    };
    let plants = [(&species.tree, 0.6), (&species.peach, 2.9), (&species.fir, 0.0), (&species.hemlock, 0.0)];
    let scenes = plants.map(alone);
    let names = ["broad-leaved tree", "peach tree", "fir", "eastern hemlock"];
    let mut pieces = Vec::new();
    for (name, scene) in names.iter().zip(&scenes) {
        let scene = scene.as_ref().map_err(Clone::clone)?;
        pieces.push(atelier.piece(name, scene, cameras::whole(scene, atelier.size, 0.14)));
    }
    atelier.figure("4.1", "single-trees", 2, &pieces)
}

/// Figure 4.2: four firs; three species and twenty trees.
fn groups(atelier: &mut FigureRenderer, species: &FigurePlants) -> Result<()> {
    let look = fine(species.tree.look);
    let firs: Vec<PlantInstance> =
        [[-4.2, 0.4], [-1.3, -0.9], [1.5, 0.7], [4.3, -0.3]].iter().enumerate().map(four).collect();
    let firs = Scene::new(forest::plant("four firs", &[&species.fir], &firs, look))?;
    let kinds = [&species.tree, &species.peach, &species.hemlock];
    let stands: Vec<PlantInstance> = (0..20).map(twenty).collect();
    let twenty = Scene::new(forest::plant("twenty trees", &kinds, &stands, look))?;
    let size = Size { width: atelier.size.width * 2, ..atelier.size };
    let piece = |shows: &str, scene, elevation| FigureView {
        shows: String::from(shows),
        scene,
        camera: cameras::whole(scene, size, elevation),
        size,
    };
    let pieces = [piece("four firs", &firs, 0.16), piece("twenty trees of three species", &twenty, 0.50)];
    atelier.figure("4.2", "multiple-trees", 1, &pieces)
}

fn four((index, [right, near]): (usize, &[f64; 2])) -> PlantInstance {
    let scale = [1.0, 1.12, 0.94, 1.05][index % 4];
    PlantInstance { species: 0, right: *right, near: *near, turn: 1.7 * index as f64, scale }
}

/// Four rows of five plants with irregular offsets.
fn twenty(index: usize) -> PlantInstance {
    let (row, column) = (index / 5, index % 5);
    let (wave, other) = ((2.3 * index as f64).sin(), (4.1 * index as f64).cos());
    PlantInstance {
        species: (index + 2 * row) % 3,
        right: 6.2 * (column as f64 - 2.0) + 3.1 * (row % 2) as f64 + 0.6 * wave,
        near: 8.5 * (1.5 - row as f64) + other,
        turn: 1.9 * index as f64,
        scale: 0.88 + 0.14 * wave * other + 0.1 * (index % 2) as f64,
    }
}

/// Figure 4.3: trunks with and without bump mapping.
fn bumps(atelier: &mut FigureRenderer, species: &FigurePlants) -> Result<()> {
    let mut scenes = Vec::new();
    for (name, plant) in [("peach tree", &species.peach), ("blue spruce", &species.spruce)] {
        let look = RenderSettings { sun: [0.95, 0.28, 0.22], ..fine(species.tree.look) };
        let bumpy = forest::plant(name, &[plant], &alone(0.3), look);
        let mut flat = forest::plant(name, &[plant], &alone(0.3), look);
        flat.materials.iter_mut().for_each(|material| material.normal_texture = None);
        scenes.push((format!("{name} trunk with bump mapping"), Scene::new(bumpy)?));
        scenes.push((format!("{name} trunk without"), Scene::new(flat)?));
    }
    let pieces: Vec<FigureView<'_>> =
        scenes.iter().map(|(shows, scene)| atelier.piece(shows, scene, cameras::trunk())).collect();
    atelier.figure("4.3", "bump-mapping", 2, &pieces)
}

/// Figures 4.4 and 4.5: standard and variance shadow maps of two sizes.
fn shadows(atelier: &mut FigureRenderer, species: &FigurePlants) -> Result<()> {
    let tree = Scene::new(forest::plant("shadows", &[&species.tree], &alone(0.6), species.tree.look))?;
    for (name, size) in [("4.4", 4096), ("4.5", 512)] {
        let standard = ShadowSettings { method: ShadowMethod::Standard, size, ..ShadowSettings::default() };
        let variance = ShadowSettings { size, ..ShadowSettings::default() };
        let lit = |shadow| light_meter::relit(&tree, RenderSettings { shadow: Some(shadow), ..tree.look });
        let (standard, variance) = (lit(standard)?, lit(variance)?);
        let camera = cameras::shadow(&tree);
        let pieces = [
            atelier.piece(&format!("standard shadow map, {size} x {size}"), &standard, camera),
            atelier.piece(&format!("variance shadow map, {size} x {size}"), &variance, camera),
        ];
        atelier.figure(name, &format!("shadow-maps-{size}"), 2, &pieces)?;
    }
    Ok(())
}

/// Figure 4.6: leaves with transparency, and their opaque cards.
fn leaves(atelier: &mut FigureRenderer, species: &FigurePlants) -> Result<()> {
    let drawn = |mode: AlphaMode| {
        let mut parts = forest::plant("leaves", &[&species.tree], &alone(0.6), fine(species.tree.look));
        let leaves = parts.materials.iter_mut().filter(|material| material.alpha_mode != AlphaMode::Opaque);
        leaves.for_each(|leaf| leaf.alpha_mode = mode);
        Scene::new(parts)
    };
    let (with, without) = (drawn(AlphaMode::Blend)?, drawn(AlphaMode::Opaque)?);
    let camera = cameras::bough(&with)?;
    let pieces =
        [atelier.piece("with transparency", &with, camera), atelier.piece("without transparency", &without, camera)];
    atelier.figure("4.6", "transparency", 2, &pieces)
}

/// A scene of the user with its own look, and default shadows if it has none.
fn own(atelier: &mut FigureRenderer, source: &str) -> Result<()> {
    let scene = load::open(source)?.scene;
    let scene = light_meter::relit(
        &scene,
        RenderSettings { shadow: scene.look.shadow.or(Some(ShadowSettings::default())), ..scene.look },
    )?;
    let name = Path::new(source).file_stem().map_or_else(|| "scene".into(), |stem| stem.to_string_lossy());
    if atelier.figures.iter().any(|figure| figure.name == name) {
        return Err(invalid("scene", "scenes of different names", source));
    }
    let pieces = [atelier.piece(&name, &scene, Camera::fit_to_scene(&scene, atelier.size.width, atelier.size.height))];
    atelier.figure(&name, "own", 1, &pieces)
}

impl Figures {
    /// Writes the pictures, `figures.json` and `figures.md` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(fault_in("figures"))?;
        let write = |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).map_err(fault_in("figures"));
        self.files.iter().try_for_each(|file| write(&file.name, &file.png))?;
        write("figures.json", &serde_json::to_vec_pretty(self).map_err(fault_in("figures"))?)?;
        write("figures.md", self.markdown().as_bytes())
    }

    fn markdown(&self) -> String {
        let Size { width, height } = self.size;
        let mut text = format!(
            "# The thesis's figures, remade\n\n{}\n\n{}; each picture {width} x {height} pixels.\n",
            self.made.line(),
            self.renderer.renderer
        );
        for figure in &self.figures {
            let Figure { name, shows, file, triangles } = figure;
            let shows = shows.join("; ");
            text.push_str(&format!("\n## {name}\n\n{shows}. {triangles} triangles.\n\n![{shows}]({file})\n"));
        }
        text
    }
}
