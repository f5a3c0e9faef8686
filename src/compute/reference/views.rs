//! Draws batches of small views on the CPU. Twin of `kernels/views.cu`.
//!
//! The visible triangle of each pixel is that of [`VisibilityBuffer`], so both agree exactly on opaque triangles.
//! Shading is f32, as in the kernel, but rounds differently. Images are filtered trilinearly; the hardware filters with
//! lower precision, and anisotropically if requested.

mod image;
mod shading;
#[cfg(test)]
mod tests;

use rayon::prelude::*;

use self::image::LinearImage;
use self::shading::{SurfacePoint, ViewShader};
use super::raster::{EMPTY_KEY, VisibilityBuffer};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::Viewport;
use modalcast_model::views::{View, ViewBatch, ViewCamera, ViewFormat, ViewPictures, ViewScene, ViewVertices};

/// Draws batches of views of one scene.
#[derive(Debug)]
pub struct ReferenceViewRenderer {
    scene: ViewScene,
    images: Vec<LinearImage>,
}

impl ReferenceViewRenderer {
    /// Prepares a scene.
    ///
    /// # Errors
    /// `Invalid` if the scene is inconsistent.
    pub fn new(scene: ViewScene) -> Result<Self> {
        scene.check()?;
        let images = scene.images.iter().map(LinearImage::new).collect();
        Ok(Self { scene, images })
    }

    /// Draws a batch.
    ///
    /// # Errors
    /// `Invalid` if the batch is, or if there are too few vertices for its worlds.
    pub fn draw(&self, vertices: &ViewVertices<'_>, batch: &ViewBatch<'_>) -> Result<ViewPictures> {
        let (scene, world_count) = (&self.scene, batch.check()?);
        let tangent_count = if scene.has_normal_maps() { scene.corners } else { 0 };
        for (field, list, world_floats) in [
            ("positions", vertices.positions, 3 * scene.vertices),
            ("normals", vertices.normals, 3 * scene.corners),
            ("tangents", vertices.tangents, 4 * tangent_count),
        ] {
            if list.len() < world_floats * world_count {
                let expected = format!("{} numbers for {world_count} worlds", world_floats * world_count);
                return Err(invalid(format!("views.{field}"), expected, list.len()));
            }
        }
        let draw_view = |view: &View| {
            let camera = &batch.cameras[view.camera as usize];
            self.draw_view(&self.world_of(vertices, view.world as usize), camera, &batch.format)
        };
        let views = batch.views.par_iter().map(draw_view).collect::<Result<Vec<_>>>()?;
        let mut pictures = ViewPictures::default();
        for view in views {
            pictures.color.extend(view.color);
            pictures.depth.extend(view.depth);
            pictures.domains.extend(view.domains);
            pictures.normals.extend(view.normals);
        }
        Ok(pictures)
    }

    /// The vertices of a world.
    fn world_of<'a>(&self, vertices: &ViewVertices<'a>, world: usize) -> ViewVertices<'a> {
        fn part(list: &[f32], world: usize, world_floats: usize) -> &[f32] {
            list.get(world * world_floats..(world + 1) * world_floats).unwrap_or_default()
        }
        ViewVertices {
            positions: part(vertices.positions, world, 3 * self.scene.vertices),
            normals: part(vertices.normals, world, 3 * self.scene.corners),
            tangents: part(vertices.tangents, world, 4 * self.scene.corners),
        }
    }

    fn draw_view(&self, world: &ViewVertices<'_>, camera: &ViewCamera, format: &ViewFormat) -> Result<ViewPictures> {
        let keys = self.visibility(world.positions, camera, format)?;
        let shader = ViewShader { scene: &self.scene, images: &self.images, camera, world };
        let (outputs, mut pictures) = (format.outputs, ViewPictures::default());
        for (pixel, key) in keys.into_iter().enumerate() {
            let point = ImagePoint::of_pixel(format, pixel);
            let triangle = (key != EMPTY_KEY).then_some(key as u32);
            let surface = triangle.map(|triangle| shader.interpolate(triangle, &point));
            if outputs.color {
                let light = surface.as_ref().map_or_else(|| shader.background(&point), |surface| shader.shade(surface));
                pictures.color.extend(shader.encode(light, &point));
            }
            if outputs.depth {
                let ground = || shader.ground_depth(&point).filter(|_| format.depth_includes_ground);
                let depth = surface.as_ref().map(|surface| surface.depth).or_else(ground).unwrap_or(f32::INFINITY);
                pictures.depth.push(format.depth_scale * depth);
            }
            if outputs.domains {
                let domain_of = |triangle: u32| self.scene.triangle_domains[triangle as usize] as i32;
                pictures.domains.push(triangle.map_or(-1, domain_of));
            }
            if outputs.normals {
                pictures.normals.extend(surface.as_ref().map_or([0.0; 3], SurfacePoint::visible_normal));
            }
        }
        Ok(pictures)
    }

    /// The keys of a view's samples, see [`VisibilityBuffer::keys`].
    fn visibility(&self, positions: &[f32], camera: &ViewCamera, format: &ViewFormat) -> Result<Vec<u64>> {
        let clip_from_world = nalgebra::Matrix4::from_row_slice(&camera.clip_from_world.map(f64::from));
        let mut buffer = VisibilityBuffer::new(Viewport::new(&clip_from_world, format.width, format.height)?);
        for group in &self.scene.groups {
            match &self.scene.cut_outs {
                Some(cut_outs) => buffer.draw_cut_out(positions, &self.scene.triangle_vertices, *group, cut_outs),
                None => buffer.draw(positions, &self.scene.triangle_vertices, *group),
            }
        }
        Ok(buffer.keys)
    }
}

/// The center of a pixel.
#[derive(Debug, Clone, Copy)]
struct ImagePoint {
    /// Normalized device coordinates.
    ndc: [f32; 2],
    /// Size of a pixel in normalized device coordinates.
    pixel_size: [f32; 2],
    /// Column, and row from the bottom.
    pixel: [u32; 2],
}

impl ImagePoint {
    /// `pixel`: index, row by row from the top.
    fn of_pixel(format: &ViewFormat, pixel: usize) -> Self {
        let (width, height) = (format.width, format.height);
        let pixel = [pixel as u32 % width, height - 1 - pixel as u32 / width];
        let pixel_size = [2.0 / width as f32, 2.0 / height as f32];
        Self { ndc: [0, 1].map(|axis| (pixel[axis] as f32 + 0.5) * pixel_size[axis] - 1.0), pixel_size, pixel }
    }
}
