//! Reproduces the figures of chapter 4.2 of the thesis with our own scenes: single trees (4.1), groups of four and
//! twenty trees (4.2), bump mapping (4.3), shadow maps of 4096 and 512 texels per side (4.4, 4.5), and transparency
//! (4.6). Also draws user-supplied scenes.
//!
//! The models are the built-in tree, the same tree in blossom, and procedural conifers. Trees with modes bend as in a
//! light wind. Positions, rotations and scales of plants are chosen by eye.

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
use modalcast_model::error::{Result, fault, fault_in, invalid};
use modalcast_model::load;
use modalcast_model::scene::{Camera, RenderSettings, Scene, SceneParts, ShadowMethod, ShadowSettings};
use modalcast_render::RendererInfo;

/// Settings of the figures.
#[derive(Debug, Clone)]
pub struct FigureOptions {
    /// Size of a single image. Most figures consist of several images.
    pub size: Size,
    /// User-supplied scenes, as given on the command line; each becomes a figure.
    pub scenes: Vec<String>,
}

/// One figure.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Figure {
    /// Number in the thesis, or the name of the user's scene.
    pub name: String,
    /// Captions of the images, from left to right and top to bottom.
    #[serde(rename = "shows")]
    pub captions: Vec<String>,
    /// Name of the image file.
    pub file: String,
    /// Triangles of all images together.
    pub triangles: usize,
}

/// All figures.
#[derive(Debug, Clone, Serialize)]
pub struct Figures {
    #[serde(rename = "made")]
    pub provenance: Provenance,
    pub renderer: RendererInfo,
    /// Size of a single image.
    pub size: Size,
    pub figures: Vec<Figure>,
    #[serde(skip)]
    files: Vec<ImageFile>,
}

/// Draws all figures; `progress` receives a line per stage.
///
/// # Errors
/// `Unavailable` without OpenGL; errors of loading and drawing a scene.
pub fn draw_figures(options: &FigureOptions, mut progress: impl FnMut(&str)) -> Result<Figures> {
    let mut renderer =
        FigureRenderer { harness: RenderHarness::open()?, size: options.size, figures: Vec::new(), files: Vec::new() };
    progress("building plant models");
    let plants = FigurePlants::build()?;
    for (name, draw) in [
        ("4.1", draw_single_trees as fn(&mut FigureRenderer, &FigurePlants) -> Result<()>),
        ("4.2", draw_groups),
        ("4.3", draw_bump_mapping),
        ("4.4 and 4.5", draw_shadow_maps),
        ("4.6", draw_transparency),
    ] {
        progress(&format!("figure {name}"));
        draw(&mut renderer, &plants)?;
    }
    for source in &options.scenes {
        progress(source);
        draw_user_scene(&mut renderer, source)?;
    }
    let FigureRenderer { harness, size, figures, files } = renderer;
    Ok(Figures { provenance: Provenance::collect(), renderer: harness.renderer.info().clone(), size, figures, files })
}

/// The renderer and the figures drawn so far.
struct FigureRenderer {
    harness: RenderHarness,
    size: Size,
    figures: Vec<Figure>,
    files: Vec<ImageFile>,
}

/// One plant of each species.
struct FigurePlants {
    tree: SceneParts,
    peach: SceneParts,
    fir: SceneParts,
    hemlock: SceneParts,
    spruce: SceneParts,
}

impl FigurePlants {
    fn build() -> Result<Self> {
        let tree = load::open("tree")?.scene.parts();
        let bark = bark_textures(&tree)?;
        let build_conifer = |parameters: &conifer::ConiferParameters| conifer::build(parameters, bark);
        let (fir, hemlock, spruce) =
            (build_conifer(&conifer::FIR)?, build_conifer(&conifer::HEMLOCK)?, build_conifer(&conifer::SPRUCE)?);
        Ok(Self { peach: forest::build_blossoming_tree(&tree)?, fir, hemlock, spruce, tree })
    }
}

/// Color and normal images of the tree's bark, which the conifers share.
fn bark_textures(tree: &SceneParts) -> Result<[&Texture; 2]> {
    let images = tree.materials.iter().find_map(|material| material.color_texture.zip(material.normal_texture));
    let (color, normal) = images
        .ok_or_else(|| fault("figures", "expected a material with color and normal textures in the built-in tree"))?;
    Ok([&tree.textures[color], &tree.textures[normal]])
}

/// Settings with a shadow map that resolves single leaves.
fn with_large_shadow_map(settings: RenderSettings) -> RenderSettings {
    let shadow = Some(ShadowSettings { size: 4096, ..ShadowSettings::default() });
    RenderSettings { preset: None, shadow, ..settings }
}

/// One image to draw.
struct FigureView<'a> {
    caption: String,
    scene: &'a Arc<Scene>,
    camera: Camera,
    size: Size,
}

impl FigureRenderer {
    /// Draws one image as RGBA. The scene bends as in a light wind.
    fn draw(&mut self, view: &FigureView<'_>) -> Result<Vec<u8>> {
        let mut loaded_scene = self.harness.load(view.scene)?;
        self.harness.deform(&mut loaded_scene, &workloads::swaying_state(view.scene))?;
        let image = self.harness.draw(&loaded_scene, view.camera, view.size);
        self.harness.unload(loaded_scene);
        image.map(|image| image.rgba)
    }

    /// Draws a figure of equally sized images in rows of `columns`.
    fn draw_figure(&mut self, name: &str, title: &str, columns: usize, views: &[FigureView<'_>]) -> Result<()> {
        let images = views.iter().map(|view| self.draw(view)).collect::<Result<Vec<_>>>()?;
        let size = views.first().map_or(self.size, |view| view.size);
        let file = image_files::encode_grid(&format!("figure-{name}-{title}"), size, columns, &images)?;
        self.figures.push(Figure {
            name: name.into(),
            captions: views.iter().map(|view| view.caption.clone()).collect(),
            file: file.name.clone(),
            triangles: views.iter().map(|view| view.scene.layout.triangles).sum(),
        });
        self.files.push(file);
        Ok(())
    }

    /// A view of default size.
    fn view<'a>(&self, caption: &str, scene: &'a Arc<Scene>, camera: Camera) -> FigureView<'a> {
        FigureView { caption: caption.into(), scene, camera, size: self.size }
    }
}

/// One plant at the origin, rotated about its trunk.
fn single_instance(rotation: f64) -> [PlantInstance; 1] {
    [PlantInstance { species: 0, x: 0.0, z: 0.0, rotation, scale: 1.0 }]
}

/// Draws figure 4.1: single trees.
fn draw_single_trees(renderer: &mut FigureRenderer, plants: &FigurePlants) -> Result<()> {
    let build_scene = |(plant, rotation): (&SceneParts, f64)| {
        Scene::new(forest::combine_plants(
            "single",
            &[plant],
            &single_instance(rotation),
            with_large_shadow_map(plants.tree.look),
        ))
    };
    // Rotations in radians.
    let rotated_plants = [(&plants.tree, 0.6), (&plants.peach, 2.9), (&plants.fir, 0.0), (&plants.hemlock, 0.0)];
    let scenes = rotated_plants.map(build_scene);
    let names = ["broad-leaved tree", "peach tree", "fir", "eastern hemlock"];
    let mut views = Vec::new();
    for (name, scene) in names.iter().zip(&scenes) {
        let scene = scene.as_ref().map_err(Clone::clone)?;
        views.push(renderer.view(name, scene, cameras::frame_scene(scene, renderer.size, 0.14)));
    }
    renderer.draw_figure("4.1", "single-trees", 2, &views)
}

/// Draws figure 4.2: four firs, and twenty trees of three species.
fn draw_groups(renderer: &mut FigureRenderer, plants: &FigurePlants) -> Result<()> {
    let look = with_large_shadow_map(plants.tree.look);
    let fir_instances: Vec<PlantInstance> = [[-4.2, 0.4], [-1.3, -0.9], [1.5, 0.7], [4.3, -0.3]]
        .iter()
        .enumerate()
        .map(|(index, position)| fir_instance(index, *position))
        .collect();
    let four_firs = Scene::new(forest::combine_plants("four firs", &[&plants.fir], &fir_instances, look))?;
    let species = [&plants.tree, &plants.peach, &plants.hemlock];
    let instances: Vec<PlantInstance> = (0..20).map(mixed_instance).collect();
    let twenty_trees = Scene::new(forest::combine_plants("twenty trees", &species, &instances, look))?;
    let size = Size { width: renderer.size.width * 2, ..renderer.size };
    let view = |caption: &str, scene, elevation| FigureView {
        caption: String::from(caption),
        scene,
        camera: cameras::frame_scene(scene, size, elevation),
        size,
    };
    let views = [view("four firs", &four_firs, 0.16), view("twenty trees of three species", &twenty_trees, 0.50)];
    renderer.draw_figure("4.2", "multiple-trees", 1, &views)
}

/// A fir at [x, z].
fn fir_instance(index: usize, [x, z]: [f64; 2]) -> PlantInstance {
    let scale = [1.0, 1.12, 0.94, 1.05][index % 4];
    PlantInstance { species: 0, x, z, rotation: 1.7 * index as f64, scale }
}

/// One of 20 plants in four rows with irregular offsets.
fn mixed_instance(index: usize) -> PlantInstance {
    let (row, column) = (index / 5, index % 5);
    let (x_jitter, z_jitter) = ((2.3 * index as f64).sin(), (4.1 * index as f64).cos());
    PlantInstance {
        species: (index + 2 * row) % 3,
        x: 6.2 * (column as f64 - 2.0) + 3.1 * (row % 2) as f64 + 0.6 * x_jitter,
        z: 8.5 * (1.5 - row as f64) + z_jitter,
        rotation: 1.9 * index as f64,
        scale: 0.88 + 0.14 * x_jitter * z_jitter + 0.1 * (index % 2) as f64,
    }
}

/// Draws figure 4.3: trunks with and without bump mapping.
fn draw_bump_mapping(renderer: &mut FigureRenderer, plants: &FigurePlants) -> Result<()> {
    let mut scenes = Vec::new();
    for (name, plant) in [("peach tree", &plants.peach), ("blue spruce", &plants.spruce)] {
        let look = RenderSettings { sun: [0.95, 0.28, 0.22], ..with_large_shadow_map(plants.tree.look) };
        let with_normal_map = forest::combine_plants(name, &[plant], &single_instance(0.3), look);
        let mut without_normal_map = forest::combine_plants(name, &[plant], &single_instance(0.3), look);
        without_normal_map.materials.iter_mut().for_each(|material| material.normal_texture = None);
        scenes.push((format!("{name} trunk with bump mapping"), Scene::new(with_normal_map)?));
        scenes.push((format!("{name} trunk without bump mapping"), Scene::new(without_normal_map)?));
    }
    let views: Vec<FigureView<'_>> =
        scenes.iter().map(|(caption, scene)| renderer.view(caption, scene, cameras::trunk_closeup())).collect();
    renderer.draw_figure("4.3", "bump-mapping", 2, &views)
}

/// Draws figures 4.4 and 4.5: standard and variance shadow maps of two sizes.
fn draw_shadow_maps(renderer: &mut FigureRenderer, plants: &FigurePlants) -> Result<()> {
    let tree = Scene::new(forest::combine_plants("shadows", &[&plants.tree], &single_instance(0.6), plants.tree.look))?;
    for (name, size) in [("4.4", 4096), ("4.5", 512)] {
        let standard_settings = ShadowSettings { method: ShadowMethod::Standard, size, ..ShadowSettings::default() };
        let variance_settings = ShadowSettings { size, ..ShadowSettings::default() };
        let with_shadow =
            |shadow| light_meter::with_settings(&tree, RenderSettings { shadow: Some(shadow), ..tree.look });
        let (standard, variance) = (with_shadow(standard_settings)?, with_shadow(variance_settings)?);
        let camera = cameras::frame_shadow(&tree);
        let views = [
            renderer.view(&format!("standard shadow map, {size} x {size}"), &standard, camera),
            renderer.view(&format!("variance shadow map, {size} x {size}"), &variance, camera),
        ];
        renderer.draw_figure(name, &format!("shadow-maps-{size}"), 2, &views)?;
    }
    Ok(())
}

/// Draws figure 4.6: leaves with transparency, and as opaque rectangles.
fn draw_transparency(renderer: &mut FigureRenderer, plants: &FigurePlants) -> Result<()> {
    let build_scene = |mode: AlphaMode| {
        let mut parts = forest::combine_plants(
            "leaves",
            &[&plants.tree],
            &single_instance(0.6),
            with_large_shadow_map(plants.tree.look),
        );
        let leaves = parts.materials.iter_mut().filter(|material| material.alpha_mode != AlphaMode::Opaque);
        leaves.for_each(|leaf| leaf.alpha_mode = mode);
        Scene::new(parts)
    };
    let (blended, opaque) = (build_scene(AlphaMode::Blend)?, build_scene(AlphaMode::Opaque)?);
    let camera = cameras::leaf_closeup(&blended)?;
    let views =
        [renderer.view("with transparency", &blended, camera), renderer.view("without transparency", &opaque, camera)];
    renderer.draw_figure("4.6", "transparency", 2, &views)
}

/// Draws a user-supplied scene with its own settings, and with default shadows if it has none.
fn draw_user_scene(renderer: &mut FigureRenderer, source: &str) -> Result<()> {
    let scene = load::open(source)?.scene;
    let scene = light_meter::with_settings(
        &scene,
        RenderSettings { shadow: scene.look.shadow.or(Some(ShadowSettings::default())), ..scene.look },
    )?;
    let name = Path::new(source).file_stem().map_or_else(|| "scene".into(), |stem| stem.to_string_lossy());
    if renderer.figures.iter().any(|figure| figure.name == name) {
        return Err(invalid("scene", "distinct file names", format!("'{name}' twice")));
    }
    let views = [renderer.view(&name, &scene, Camera::fit_to_scene(&scene, renderer.size.width, renderer.size.height))];
    renderer.draw_figure(&name, "user", 1, &views)
}

impl Figures {
    /// Writes the images, `figures.json` and `figures.md` into a folder, which is created.
    ///
    /// # Errors
    /// `Fault` when a file cannot be written.
    pub fn write(&self, folder: &Path) -> Result<()> {
        std::fs::create_dir_all(folder).map_err(fault_in("figures"))?;
        let write_file =
            |name: &str, bytes: &[u8]| std::fs::write(folder.join(name), bytes).map_err(fault_in("figures"));
        self.files.iter().try_for_each(|file| write_file(&file.name, &file.png))?;
        write_file("figures.json", &serde_json::to_vec_pretty(self).map_err(fault_in("figures"))?)?;
        write_file("figures.md", self.markdown().as_bytes())
    }

    fn markdown(&self) -> String {
        let Size { width, height } = self.size;
        let mut text = format!(
            "# Reproduced figures of the thesis\n\n{}\n\n{}; each image {width} x {height} pixels.\n",
            self.provenance.line(),
            self.renderer.renderer
        );
        for figure in &self.figures {
            let Figure { name, captions, file, triangles } = figure;
            let captions = captions.join("; ");
            text.push_str(&format!("\n## {name}\n\n{captions}. {triangles} triangles.\n\n![{captions}]({file})\n"));
        }
        text
    }
}
