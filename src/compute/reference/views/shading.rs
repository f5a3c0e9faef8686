//! Color of a pixel: triangle, ground or sky. Twin of `kernels/view_shading.cuh`, which has the sources of the formulas.

use nalgebra::{Matrix3, Vector3};

use super::ImagePoint;
use super::image::LinearImage;
use modalcast_model::scene::ToneMapping;
use modalcast_model::views::{ViewCamera, ViewLight, ViewMaterial, ViewScene, ViewVertices, tone_code};

/// Largest light that the tone curves distinguish; keeps their squares finite.
const MAX_RADIANCE: f32 = 1000.0;

/// What the color of a pixel of a view depends on.
#[derive(Debug, Clone, Copy)]
pub(super) struct ViewShader<'a> {
    pub(super) scene: &'a ViewScene,
    pub(super) images: &'a [LinearImage],
    pub(super) camera: &'a ViewCamera,
    pub(super) world: &'a ViewVertices<'a>,
}

/// A triangle at an image point.
#[derive(Debug)]
pub(super) struct SurfacePoint {
    triangle: usize,
    /// Barycentric coordinates of the corners, and their derivatives per pixel along x and y.
    weights: Vector3<f32>,
    ddx: Vector3<f32>,
    ddy: Vector3<f32>,
    position: Vector3<f32>,
    /// On the visible side; not normalized.
    normal: Vector3<f32>,
    /// 1 if the front side is visible, else -1.
    facing: f32,
    /// Along the view axis.
    pub(super) depth: f32,
}

impl SurfacePoint {
    /// Unit normal of the visible side; zeros if it is undefined.
    pub(super) fn visible_normal(&self) -> [f32; 3] {
        let largest = self.normal.amax();
        if largest > 0.0 && largest.is_finite() { (self.normal / largest).normalize().into() } else { [0.0; 3] }
    }
}

impl ViewShader<'_> {
    /// A triangle at an image point.
    pub(super) fn interpolate(&self, triangle: u32, point: &ImagePoint) -> SurfacePoint {
        let triangle = triangle as usize;
        let positions = self.scene.triangle_vertices[triangle].map(|vertex| vector_at(self.world.positions, vertex));
        let normals = self.scene.triangle_corners[triangle].map(|corner| vector_at(self.world.normals, corner));
        let clip = positions.map(|position| self.clip_relative_to(point, &position));
        // Scaled, so that the products neither overflow nor underflow.
        let scale = 1.0 / clip.iter().map(|corner| corner.z.abs()).fold(1e-30, f32::max);
        let [a, b, c] = clip.map(|corner| corner * scale);
        // The weight of a corner is proportional to the z component of its cross product, which is linear in the image
        // point. The other components are its derivatives.
        let edges = Matrix3::from_columns(&[b.cross(&c), c.cross(&a), a.cross(&b)]).transpose();
        let edge_values = edges.column(2).into_owned();
        let sum = edge_values.sum();
        let weights = (edge_values / sum).map(|weight| if weight > 0.0 { weight.min(1.0) } else { 0.0 });
        let weights = if weights.sum() > 0.5 { weights / weights.sum() } else { Vector3::repeat(1.0 / 3.0) };
        let derivative = |axis: usize| {
            let edge_derivatives: Vector3<f32> = edges.column(axis) * point.pixel_size[axis];
            (edge_derivatives - weights * edge_derivatives.sum()) / sum
        };
        let facing = if sum > 0.0 { 1.0 } else { -1.0 };
        SurfacePoint {
            triangle,
            weights,
            ddx: derivative(0),
            ddy: derivative(1),
            position: weighted(&weights, &positions),
            normal: weighted(&weights, &normals) * facing,
            facing,
            depth: weights.dot(&Vector3::from(clip.map(|corner| corner.z))),
        }
    }

    /// x, y and w of a position in clip space, relative to an image point.
    fn clip_relative_to(&self, point: &ImagePoint, position: &Vector3<f32>) -> Vector3<f32> {
        let row = |row: usize| {
            let m = &self.camera.clip_from_world[4 * row..][..4];
            m[0] * position.x + m[1] * position.y + m[2] * position.z + m[3]
        };
        let w = row(3);
        Vector3::new(row(0) - point.ndc[0] * w, row(1) - point.ndc[1] * w, w)
    }

    /// Light from a triangle.
    pub(super) fn shade(&self, surface: &SurfacePoint) -> Vector3<f32> {
        let material = &self.scene.materials[self.scene.triangle_materials[surface.triangle] as usize];
        let sample = |image: u32| {
            let corner_uvs =
                self.scene.triangle_corners[surface.triangle].map(|corner| self.scene.uvs[corner as usize]);
            let uv = |weights: &Vector3<f32>| {
                [0, 1].map(|axis| (0..3).map(|corner| weights[corner] * corner_uvs[corner][axis]).sum::<f32>())
            };
            let slope = |weights| Some(uv(weights)).filter(|uv| uv.iter().all(|slope| slope.is_finite()));
            let (ddx, ddy) = (slope(&surface.ddx).unwrap_or_default(), slope(&surface.ddy).unwrap_or_default());
            self.images[image as usize].sample(uv(&surface.weights), ddx, ddy)
        };
        let tint = material.color_image.map_or(Vector3::repeat(1.0), |image| {
            let [r, g, b, _] = sample(image);
            Vector3::new(r, g, b)
        });
        let mut normal = safe_normalize(surface.normal);
        if let Some(image) = material.normal_image {
            // The map belongs to the front side.
            normal = self.apply_normal_map(surface, normal * surface.facing, sample(image)) * surface.facing;
        }
        self.phong(material, &tint, &normal, &surface.position)
    }

    fn apply_normal_map(&self, surface: &SurfacePoint, normal: Vector3<f32>, texel: [f32; 4]) -> Vector3<f32> {
        let corners = self.scene.triangle_corners[surface.triangle].map(|corner| corner as usize);
        let component = |axis: usize| -> f32 {
            (0..3).map(|index| surface.weights[index] * self.world.tangents[4 * corners[index] + axis]).sum()
        };
        let raw_tangent = Vector3::new(component(0), component(1), component(2));
        if raw_tangent.norm_squared() <= 0.0 {
            return normal;
        }
        let tangent = safe_normalize(raw_tangent - normal * normal.dot(&raw_tangent));
        let bitangent = normal.cross(&tangent) * if component(3) < 0.0 { -1.0 } else { 1.0 };
        let [x, y, z, _] = texel.map(|value| (value * 255.0 - 128.0) / 127.0);
        safe_normalize(tangent * x + bitangent * y + normal * z)
    }

    fn phong(
        &self,
        material: &ViewMaterial,
        tint: &Vector3<f32>,
        normal: &Vector3<f32>,
        position: &Vector3<f32>,
    ) -> Vector3<f32> {
        let light = &self.scene.light;
        let product = |a: [f32; 3], b: Vector3<f32>| Vector3::from(a).component_mul(&b);
        let diffuse = product(material.diffuse, *tint);
        let to_eye = safe_normalize(Vector3::from(self.camera.eye) - position);
        let to_sun = Vector3::from(light.to_sun);
        let mut color = product(material.ambient, ambient_light(light, normal)).component_mul(tint);
        let eye_cosine = normal.dot(&to_eye);
        color += product(light.fill, diffuse) * eye_cosine.max(0.0);
        let cosine = normal.dot(&to_sun);
        if cosine > 0.0 {
            let highlight_cosine = (normal * (2.0 * eye_cosine) - to_eye).dot(&to_sun);
            let highlight = if highlight_cosine > 0.0 { highlight_cosine.powf(material.exponent) } else { 0.0 };
            color += product(light.sunlight, diffuse * cosine + Vector3::from(material.specular) * highlight);
        }
        color
    }

    /// Light from ground or sky.
    pub(super) fn background(&self, point: &ImagePoint) -> Vector3<f32> {
        let (light, direction) = (&self.scene.light, self.view_ray(point));
        let (up, horizon) = (Vector3::from(light.up), Vector3::from(light.horizon));
        if let Some(depth) = self.ground_depth(point) {
            let cosine = up.dot(&Vector3::from(light.to_sun)).max(0.0);
            let incident = ambient_light(light, &up) + Vector3::from(light.sunlight) * cosine;
            let position = Vector3::from(self.camera.eye) + direction * depth;
            let offset = (position - Vector3::from(self.camera.ground_center)) / self.camera.ground_fade;
            return horizon.lerp(&incident.component_mul(&Vector3::from(light.ground)), (-offset.norm_squared()).exp());
        }
        let sine = direction.normalize().dot(&up).max(0.0);
        horizon.lerp(&Vector3::from(light.zenith), 1.0 - (-6.0 * sine * sine / (sine + 0.06)).exp())
    }

    /// Depth of the ground along the view ray, if the ray hits it from above.
    pub(super) fn ground_depth(&self, point: &ImagePoint) -> Option<f32> {
        let (light, camera, direction) = (&self.scene.light, self.camera, self.view_ray(point));
        let (up, eye) = (Vector3::from(light.up), Vector3::from(camera.eye));
        let ground_center = Vector3::from(camera.ground_center);
        let (descent, eye_height) = (-direction.dot(&up), eye.dot(&up) - ground_center.dot(&up));
        let offset = eye - ground_center + direction * (eye_height / descent);
        let is_in_square = (0..3).all(|axis| offset[axis].abs() * (1.0 - up[axis]) <= camera.ground_half_side);
        let hits = camera.sees_ground == 1 && descent > 0.0 && eye_height > 0.0 && is_in_square;
        let ascent = direction.dot(&up).min(-1e-9 * direction.norm());
        hits.then(|| -eye_height / ascent)
    }

    fn view_ray(&self, point: &ImagePoint) -> Vector3<f32> {
        Matrix3::from_row_slice(&self.camera.world_from_ndc) * Vector3::new(point.ndc[0], point.ndc[1], 1.0)
    }

    /// The sRGB bytes of light.
    pub(super) fn encode(&self, light: Vector3<f32>, point: &ImagePoint) -> [u8; 3] {
        let threshold = if self.scene.light.dithers == 1 { bayer_threshold(point.pixel) } else { 0.0 };
        [light.x, light.y, light.z].map(|channel| {
            // The renderer's color image has f16 channels.
            let linear = half::f16::from_f32(tone_map(&self.scene.light, channel)).to_f32();
            let encoded = if linear <= 0.003_130_8 { 12.92 * linear } else { 1.055 * linear.powf(1.0 / 2.4) - 0.055 };
            (255.0 * (encoded + threshold / 255.0).clamp(0.0, 1.0)).round_ties_even() as u8
        })
    }
}

fn vector_at(list: &[f32], index: u32) -> Vector3<f32> {
    Vector3::from_column_slice(&list[3 * index as usize..][..3])
}

fn weighted(weights: &Vector3<f32>, corners: &[Vector3<f32>; 3]) -> Vector3<f32> {
    corners[0] * weights.x + corners[1] * weights.y + corners[2] * weights.z
}

/// Vectors shorter than 1e-15 give a finite result that is shorter than 1.
fn safe_normalize(vector: Vector3<f32>) -> Vector3<f32> {
    vector / vector.norm_squared().max(1e-30).sqrt()
}

/// The ambient cube: a color for each side of a box, weighted by the squared components of the normal.
fn ambient_light(light: &ViewLight, normal: &Vector3<f32>) -> Vector3<f32> {
    let squared_length = normal.norm_squared();
    let is_unit = squared_length > 0.25 && squared_length < 4.0;
    let weights = if is_unit { normal.component_mul(normal) } else { Vector3::repeat(1.0 / 3.0) };
    let side = |axis: usize| Vector3::from(light.ambient_cube[2 * axis + usize::from(normal[axis] < 0.0)]);
    (0..3).map(|axis| side(axis) * weights[axis]).sum()
}

/// Light from 0 to 1, after exposure and tone curve. NaN becomes 0.
fn tone_map(light: &ViewLight, radiance: f32) -> f32 {
    let radiance = radiance * light.exposure;
    if radiance.is_nan() || radiance <= 0.0 {
        return 0.0;
    }
    if light.tone == tone_code(ToneMapping::Reinhard) {
        return 1.0 - 1.0 / (1.0 + radiance);
    }
    if light.tone == tone_code(ToneMapping::Aces) {
        let x = radiance.min(MAX_RADIANCE);
        return (x * (2.51 * x + 0.03) / (x * (2.43 * x + 0.59) + 0.14)).min(1.0);
    }
    radiance.min(1.0)
}

/// Threshold of ordered dithering in output levels, see `shaders/encode_srgb.comp`.
fn bayer_threshold([x, y]: [u32; 2]) -> f32 {
    let x = x ^ y;
    let rank = (x & 1) << 5 | (y & 1) << 4 | (x & 2) << 2 | (y & 2) << 1 | (x & 4) >> 1 | (y & 4) >> 2;
    (rank as f32 - 31.5) / 64.0
}
