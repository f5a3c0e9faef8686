//! Batches of small views: many pictures of the worlds of a scene that one call draws. A world is a copy of the scene
//! with its own vertices; all worlds share triangles, materials and light. A view is the picture of one world by one
//! camera, with one sample per pixel, without shadows and ambient occlusion.
//!
//! These are plain data. The renderer derives them from a scene (`modalcast_render::view_data`). `modalcast-compute` draws
//! them: `gpu::CudaViewRenderer` in CUDA, `reference::views::ReferenceViewRenderer` on the CPU.

use bytemuck::{Pod, Zeroable};

use crate::error::{Result, invalid};
use crate::raster::CutOuts;
use crate::scene::{CullMode, DrawRange, ToneMapping};

/// Largest width and height of a view in pixels.
pub const MAX_VIEW_SIDE: u32 = 1024;
/// Largest number of views of a batch.
pub const MAX_VIEWS: usize = 1 << 16;

/// A camera, and the ground as it sees it. Positions are in scene units, relative to the origin of the vertices. Twin:
/// `ViewCamera` in `kernels/view_shading.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct ViewCamera {
    /// Row-major, with reversed depth: z / w is 1 at the near plane and 0 at the far plane.
    pub clip_from_world: [f32; 16],
    /// Row-major: from (x, y, 1) in normalized device coordinates to the direction of a view ray, whose length along
    /// the view axis is 1.
    pub world_from_ndc: [f32; 9],
    pub eye: [f32; 3],
    /// A point of the ground plane.
    pub ground_center: [f32; 3],
    /// Half the side of the square in which the ground is drawn.
    pub ground_half_side: f32,
    /// Fade distance D of the ground: at distance d from the center, its weight is exp(-(d / D)^2).
    pub ground_fade: f32,
    /// 1 if the scene has a ground and the camera is above it, else 0.
    pub sees_ground: u32,
}

/// Lights and background of a scene. Colors are linear. Twin: `ViewLight` in `kernels/view_shading.cuh`.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct ViewLight {
    /// Unit vector.
    pub to_sun: [f32; 3],
    pub sunlight: [f32; 3],
    /// Ambient light from +x, -x, +y, -y, +z and -z. Outdoors, each is the skylight.
    pub ambient_cube: [[f32; 3]; 6],
    /// Diffuse light from the camera; 0 outdoors.
    pub fill: [f32; 3],
    pub zenith: [f32; 3],
    pub horizon: [f32; 3],
    /// A coordinate axis.
    pub up: [f32; 3],
    pub ground: [f32; 3],
    pub exposure: f32,
    /// [`tone_code`] of the tone curve.
    pub tone: u32,
    /// 1 if colors are dithered with a pattern of 8 x 8 pixels, else 0.
    pub dithers: u32,
}

/// The code of a tone curve in [`ViewLight::tone`].
pub const fn tone_code(tone: ToneMapping) -> u32 {
    match tone {
        ToneMapping::None => 0,
        ToneMapping::Reinhard => 1,
        ToneMapping::Aces => 2,
    }
}

/// A Phong material. Indices are those of [`ViewScene::images`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewMaterial {
    pub ambient: [f32; 3],
    pub diffuse: [f32; 3],
    pub specular: [f32; 3],
    pub exponent: f32,
    pub color_image: Option<u32>,
    pub normal_image: Option<u32>,
}

/// An RGBA8 image that repeats in both directions. Rows are in the order of increasing v.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ViewImage {
    pub width: u32,
    pub height: u32,
    /// Whether red, green and blue are sRGB; else they are linear.
    pub is_srgb: bool,
    /// The mipmap chain, from the full image down to one texel.
    pub levels: Vec<Vec<u8>>,
}

/// What the views of all worlds share. Triangles are in the draw order: at equal depths, the earlier one is visible.
#[derive(Debug, Clone, PartialEq)]
pub struct ViewScene {
    /// Numbers of vertices, corners and domains of one world. A corner is a vertex with a normal.
    pub vertices: usize,
    pub corners: usize,
    pub domains: usize,
    pub triangle_vertices: Vec<[u32; 3]>,
    pub triangle_corners: Vec<[u32; 3]>,
    /// Index in `materials` of each triangle.
    pub triangle_materials: Vec<u32>,
    /// Domain of each triangle.
    pub triangle_domains: Vec<u32>,
    /// Consecutive ranges that together cover all triangles.
    pub groups: Vec<DrawRange>,
    pub materials: Vec<ViewMaterial>,
    pub images: Vec<ViewImage>,
    /// Texture coordinates of each corner; empty without images.
    pub uvs: Vec<[f32; 2]>,
    /// Alpha-tested triangles.
    pub cut_outs: Option<CutOuts>,
    /// Maximum anisotropy of `images`, at least 1.
    pub anisotropy: f32,
    pub light: ViewLight,
}

/// A picture of a world by a camera; both are indices.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq, Pod, Zeroable)]
pub struct View {
    pub camera: u32,
    pub world: u32,
}

/// The outputs of a batch: a set of arrays, each with one picture per view, top row first.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ViewOutputs {
    /// Height x width x 3 sRGB bytes.
    pub color: bool,
    /// Height x width f32: depth along the view axis times [`ViewFormat::depth_scale`]; infinite where nothing is.
    pub depth: bool,
    /// Height x width i32: the domain of the visible triangle, or -1.
    pub domains: bool,
    /// Height x width x 3 f32: unit normal of the visible side in world axes, or zeros.
    pub normals: bool,
}

/// Size and outputs of all views of a batch.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ViewFormat {
    /// Pixels, 1 to [`MAX_VIEW_SIDE`].
    pub width: u32,
    pub height: u32,
    pub outputs: ViewOutputs,
    /// Meters per scene unit, to get depths in meters.
    pub depth_scale: f32,
    /// Whether depth contains the ground where no triangle is visible.
    pub depth_includes_ground: bool,
}

impl ViewFormat {
    /// Pixels of a view.
    pub const fn pixel_count(&self) -> usize {
        self.width as usize * self.height as usize
    }
}

/// The views to draw.
#[derive(Debug, Clone, Copy)]
pub struct ViewBatch<'a> {
    pub cameras: &'a [ViewCamera],
    pub views: &'a [View],
    pub format: ViewFormat,
}

impl ViewBatch<'_> {
    /// Checks sizes and indices. Returns the number of worlds that the views need: the largest index plus one.
    ///
    /// # Errors
    /// `Invalid` with the field.
    pub fn check(&self) -> Result<usize> {
        for (name, side) in [("width", self.format.width), ("height", self.format.height)] {
            if !(1..=MAX_VIEW_SIDE).contains(&side) {
                return Err(invalid(format!("views.{name}"), format!("1 to {MAX_VIEW_SIDE} pixels"), side));
            }
        }
        if self.format.outputs == ViewOutputs::default() {
            return Err(invalid("views.outputs", "at least one output", "none"));
        }
        if !(1..=MAX_VIEWS).contains(&self.views.len()) {
            return Err(invalid("views", format!("1 to {MAX_VIEWS} views"), self.views.len()));
        }
        if let Some(index) = self.views.iter().position(|view| view.camera as usize >= self.cameras.len()) {
            let expected = format!("a camera below {}", self.cameras.len());
            return Err(invalid(format!("views[{index}].camera"), expected, self.views[index].camera));
        }
        if let Some(index) = self.cameras.iter().position(|camera| !camera.is_finite()) {
            return Err(invalid(format!("views.cameras[{index}]"), "finite numbers", "others"));
        }
        Ok(self.views.iter().map(|view| view.world as usize + 1).max().unwrap_or(0))
    }
}

impl ViewCamera {
    fn is_finite(&self) -> bool {
        let numbers: [&[f32]; 4] = [&self.clip_from_world, &self.world_from_ndc, &self.eye, &self.ground_center];
        numbers
            .into_iter()
            .flatten()
            .chain([&self.ground_half_side, &self.ground_fade])
            .all(|number| number.is_finite())
    }
}

/// The vertices of all worlds, one world after another.
#[derive(Debug, Clone, Copy, Default)]
pub struct ViewVertices<'a> {
    /// 3 per vertex.
    pub positions: &'a [f32],
    /// 3 per corner: unit normals.
    pub normals: &'a [f32],
    /// 4 per corner: unit tangents and bitangent signs; empty without normal maps.
    pub tangents: &'a [f32],
}

/// The pictures of a batch, one view after another. Outputs that were not requested are empty. [`ViewOutputs`] has the
/// shapes.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct ViewPictures {
    pub color: Vec<u8>,
    pub depth: Vec<f32>,
    pub domains: Vec<i32>,
    pub normals: Vec<f32>,
}

impl ViewScene {
    /// Whether some material has a normal map.
    pub fn has_normal_maps(&self) -> bool {
        self.materials.iter().any(|material| material.normal_image.is_some())
    }

    /// The cull mode of a triangle, which is an index in the draw order.
    pub fn cull_mode(&self, triangle: u32) -> CullMode {
        let group = self.groups.partition_point(|group| group.first_triangle + group.triangle_count <= triangle);
        self.groups.get(group).map_or(CullMode::None, |group| group.cull_mode)
    }

    /// Checks lengths and indices.
    ///
    /// # Errors
    /// `Invalid` with the field.
    pub fn check(&self) -> Result<()> {
        let triangles = self.triangle_vertices.len();
        let check_length = |field: &str, expected: usize, got: usize| match got == expected {
            true => Ok(()),
            false => Err(invalid(field, format!("a length of {expected}"), got)),
        };
        check_length("triangle_corners", triangles, self.triangle_corners.len())?;
        check_length("triangle_materials", triangles, self.triangle_materials.len())?;
        check_length("triangle_domains", triangles, self.triangle_domains.len())?;
        let end = self.groups.iter().try_fold(0, |end, group| {
            (group.first_triangle == end).then(|| group.first_triangle + group.triangle_count)
        });
        if end != Some(triangles as u32) {
            let expected = format!("consecutive ranges of {triangles} triangles");
            return Err(invalid("groups", expected, format!("{:?}", self.groups)));
        }
        let image_count = self.images.len();
        let has_images = self.materials.iter().any(|material| material.color_image.or(material.normal_image).is_some());
        check_length("uvs", if has_images { self.corners } else { self.uvs.len() }, self.uvs.len())?;
        let images = || self.materials.iter().flat_map(|material| [material.color_image, material.normal_image]);
        for (field, mut indices, limit) in [
            ("triangle_vertices", boxed(self.triangle_vertices.as_flattened().iter().copied()), self.vertices),
            ("triangle_corners", boxed(self.triangle_corners.as_flattened().iter().copied()), self.corners),
            ("triangle_materials", boxed(self.triangle_materials.iter().copied()), self.materials.len()),
            ("triangle_domains", boxed(self.triangle_domains.iter().copied()), self.domains),
            ("materials", boxed(images().flatten()), image_count),
        ] {
            if let Some(index) = indices.find(|index| *index as usize >= limit) {
                return Err(invalid(field, format!("indices below {limit}"), index));
            }
        }
        self.images.iter().try_for_each(ViewImage::check)
    }
}

fn boxed<'a>(indices: impl Iterator<Item = u32> + 'a) -> Box<dyn Iterator<Item = u32> + 'a> {
    Box::new(indices)
}

impl ViewImage {
    /// Width and height of a level in texels.
    pub fn level_size(&self, level: usize) -> [usize; 2] {
        [self.width, self.height].map(|side| (side as usize >> level).max(1))
    }

    fn check(&self) -> Result<()> {
        let level_count = self.width.max(self.height).checked_ilog2().map_or(0, |last_level| last_level as usize + 1);
        let has_texels = |(level, texels): (usize, &Vec<u8>)| {
            let [width, height] = self.level_size(level);
            texels.len() == 4 * width * height
        };
        let is_complete = self.levels.iter().enumerate().all(has_texels);
        if self.width.min(self.height) == 0 || self.levels.len() != level_count || !is_complete {
            let expected = format!("{level_count} complete levels of {} x {} texels", self.width, self.height);
            return Err(invalid("images", expected, self.levels.len()));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene() -> ViewScene {
        let material = ViewMaterial {
            ambient: [1.0; 3],
            diffuse: [1.0; 3],
            specular: [0.0; 3],
            exponent: 1.0,
            color_image: Some(0),
            normal_image: None,
        };
        ViewScene {
            vertices: 3,
            corners: 3,
            domains: 1,
            triangle_vertices: vec![[0, 1, 2]; 2],
            triangle_corners: vec![[0, 1, 2]; 2],
            triangle_materials: vec![0; 2],
            triangle_domains: vec![0; 2],
            groups: vec![
                DrawRange { first_triangle: 0, triangle_count: 1, cull_mode: CullMode::Back },
                DrawRange { first_triangle: 1, triangle_count: 1, cull_mode: CullMode::None },
            ],
            materials: vec![material],
            images: vec![ViewImage { width: 2, height: 1, is_srgb: true, levels: vec![vec![0; 8], vec![0; 4]] }],
            uvs: vec![[0.0; 2]; 3],
            cut_outs: None,
            anisotropy: 1.0,
            light: ViewLight::zeroed(),
        }
    }

    #[test]
    fn scenes_with_invalid_lengths_or_indices_are_rejected() {
        scene().check().expect("a valid scene");
        assert_eq!([0, 1].map(|triangle| scene().cull_mode(triangle)), [CullMode::Back, CullMode::None]);
        type Change = (&'static str, fn(&mut ViewScene));
        let changes: [Change; 10] = [
            ("triangle_corners", |scene| scene.triangle_corners.truncate(1)),
            ("triangle_materials", |scene| scene.triangle_materials.push(0)),
            ("triangle_domains", |scene| scene.triangle_domains[1] = 1),
            ("groups", |scene| scene.groups[1].triangle_count = 2),
            ("uvs", |scene| scene.uvs.truncate(2)),
            ("triangle_vertices", |scene| scene.triangle_vertices[0][2] = 3),
            ("triangle_corners", |scene| scene.corners = 2),
            ("materials", |scene| scene.materials[0].normal_image = Some(1)),
            ("images", |scene| scene.images[0].levels.truncate(1)),
            ("images", |scene| scene.images[0].height = 2),
        ];
        for (field, change) in changes {
            let mut changed = scene();
            change(&mut changed);
            if field == "triangle_corners" {
                changed.uvs.truncate(changed.corners);
            }
            let error = changed.check().expect_err("an invalid scene").to_string();
            assert!(error.starts_with(field), "expected {field}, got {error}");
        }
    }

    #[test]
    fn batches_with_invalid_sizes_or_indices_are_rejected() {
        let outputs = ViewOutputs { color: true, ..ViewOutputs::default() };
        let format = ViewFormat { width: 64, height: 1, outputs, depth_scale: 1.0, depth_includes_ground: false };
        let cameras = [ViewCamera::zeroed(); 2];
        let views = [View { camera: 1, world: 4 }, View { camera: 0, world: 2 }];
        let batch = ViewBatch { cameras: &cameras, views: &views, format };
        assert_eq!(batch.check(), Ok(5));
        let is_rejected = |batch: ViewBatch<'_>| batch.check().is_err();
        let no_outputs = ViewFormat { outputs: ViewOutputs::default(), ..format };
        for format in
            [ViewFormat { width: 0, ..format }, ViewFormat { height: MAX_VIEW_SIDE + 1, ..format }, no_outputs]
        {
            assert!(is_rejected(ViewBatch { format, ..batch }), "{format:?}");
        }
        assert!(is_rejected(ViewBatch { views: &[], ..batch }));
        assert!(is_rejected(ViewBatch { views: &vec![views[1]; MAX_VIEWS + 1], ..batch }));
        assert!(is_rejected(ViewBatch { cameras: &cameras[..1], ..batch }));
        let mut not_finite = cameras;
        not_finite[1].world_from_ndc[3] = f32::NAN;
        assert!(is_rejected(ViewBatch { cameras: &not_finite, ..batch }));
    }
}
