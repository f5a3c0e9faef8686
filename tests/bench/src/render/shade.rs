//! Phong shading by equation 3.12 of the thesis, as in the shaders but in f64. The radiance towards the eye has three
//! parts: from the ambient light, from light that is never occluded, and from the sun.
//!
//!   C = s_a ambient(n) Ca + fill (n . v_e) Cd + s_f sunlight ((n . v_l) Cd + (v_e' . v_l)^k Cs),
//!   v_e' = 2 (v_e . n) n - v_e
//!
//! Ca, Cd and Cs are the ambient, diffuse and specular color, k is the exponent, s_a the ambient visibility, s_f the
//! sun visibility, n the normal, and v_l and v_e are unit vectors to the sun and to the eye. Outdoors, the ambient
//! light is the skylight for all n, and the fill light is 0.

use nalgebra::Vector3;

use super::ray_scene::{Hit, Ray, RayScene};
use super::reference_view::ReferenceView;

/// Shading of one point that a camera ray hits.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShadedPoint {
    pub(super) point: Vector3<f64>,
    /// Geometric normal, flipped to the sun's side.
    pub(super) geometric_normal: Vector3<f64>,
    /// Geometric normal, flipped to the eye's side; 0 for the sky.
    pub(super) visible_normal: Vector3<f64>,
    /// Index of the triangle; `None` for ground and sky.
    pub(super) triangle: Option<usize>,
    /// Linear radiance from the ambient light, without its occlusion.
    pub(super) ambient: Vector3<f64>,
    /// Linear radiance that is never occluded: from the fill light, the sky and the haze.
    pub(super) unoccluded: Vector3<f64>,
    /// Linear radiance from the unshadowed sun.
    pub(super) sun: Vector3<f64>,
    /// Cosine between normal and sun direction; 0 when the point faces away. On the ground, it is reduced by the haze.
    pub(super) cosine: f64,
    pub(super) alpha: f64,
}

/// Shades the sky.
pub(super) fn shade_sky(view: &ReferenceView, ray: &Ray) -> ShadedPoint {
    let (point, zero) = (ray.origin, Vector3::zeros());
    ShadedPoint {
        point,
        geometric_normal: zero,
        visible_normal: zero,
        triangle: None,
        ambient: zero,
        unoccluded: view.sky_color(&ray.direction),
        sun: zero,
        cosine: 0.0,
        alpha: 1.0,
    }
}

/// Shades the Lambertian ground, with haze, at ray parameter `t`.
pub(super) fn shade_ground(view: &ReferenceView, ray: &Ray, t: f64) -> ShadedPoint {
    let point = ray.point_at(t);
    let (color, haze) = view.ground_colors();
    let visibility = view.ground_visibility(&point);
    let cosine = view.up.dot(&view.to_sun).max(0.0);
    ShadedPoint {
        point,
        geometric_normal: view.up,
        visible_normal: view.up,
        triangle: None,
        ambient: color.component_mul(&view.ambient_light(&view.up)) * visibility,
        unoccluded: haze * (1.0 - visibility),
        sun: color.component_mul(&view.sunlight) * (visibility * cosine),
        cosine: visibility * cosine,
        alpha: 1.0,
    }
}

/// Shades a point of a triangle.
pub(super) fn shade_triangle(ray_scene: &RayScene, view: &ReferenceView, ray: &Ray, hit: &Hit) -> ShadedPoint {
    let material = ray_scene.material(hit);
    let point = ray.point_at(hit.t);
    let [r, g, b, texture_alpha] =
        material.color_texture.as_ref().map_or([1.0; 4], |texture| texture.sample(ray_scene.uv(hit)));
    let texture_color = Vector3::new(r, g, b);
    let normal = shading_normal(ray_scene, hit);
    let to_eye = normalize(view.eye - point);
    let cosine = normal.dot(&view.to_sun);
    let mut sun = Vector3::zeros();
    if cosine > 0.0 {
        let reflected = 2.0 * to_eye.dot(&normal) * normal - to_eye;
        let specular_cosine = reflected.dot(&view.to_sun);
        let highlight = if specular_cosine > 0.0 { specular_cosine.powf(material.exponent) } else { 0.0 };
        let reflectance = cosine * material.diffuse.component_mul(&texture_color) + highlight * material.specular;
        sun = reflectance.component_mul(&view.sunlight);
    }
    let geometric_normal = ray_scene.triangles[hit.triangle].geometric_normal();
    ShadedPoint {
        point,
        geometric_normal: if geometric_normal.dot(&view.to_sun) < 0.0 { -geometric_normal } else { geometric_normal },
        visible_normal: if hit.is_front { geometric_normal } else { -geometric_normal },
        triangle: Some(hit.triangle),
        ambient: view.ambient_light(&normal).component_mul(&material.ambient).component_mul(&texture_color),
        unoccluded: view.fill.component_mul(&material.diffuse).component_mul(&texture_color)
            * normal.dot(&to_eye).max(0.0),
        sun,
        cosine: cosine.max(0.0),
        alpha: if ray_scene.is_blended(hit) { material.alpha * texture_alpha } else { 1.0 },
    }
}

/// The interpolated normal, perturbed by the normal map and flipped to the visible side.
fn shading_normal(ray_scene: &RayScene, hit: &Hit) -> Vector3<f64> {
    let corners = ray_scene.triangles[hit.triangle].corner_indices.map(|corner| corner as usize);
    let weights = [1.0 - hit.u - hit.v, hit.u, hit.v];
    let mut normal: Vector3<f64> =
        corners.iter().zip(weights).map(|(corner, weight)| ray_scene.normals[*corner] * weight).sum();
    normal = normalize(normal);
    if let Some(normal_map) = ray_scene.material(hit).normal_texture.as_ref().filter(|_| !ray_scene.tangents.is_empty())
    {
        let tangent_component = |axis: usize| {
            corners.iter().zip(weights).map(|(corner, weight)| ray_scene.tangents[*corner][axis] * weight).sum()
        };
        let [x, y, z, sign]: [f64; 4] = [0, 1, 2, 3].map(tangent_component);
        let tangent = Vector3::new(x, y, z);
        if tangent.norm_squared() > 0.0 {
            // As in the shaders, byte 128 is 0 and byte 255 is 1.
            let [r, g, b] =
                std::array::from_fn(|channel| (normal_map.sample(ray_scene.uv(hit))[channel] * 255.0 - 128.0) / 127.0);
            let tangent = normalize(tangent - normal * normal.dot(&tangent));
            let bitangent = normal.cross(&tangent) * if sign < 0.0 { -1.0 } else { 1.0 };
            normal = normalize(tangent * r + bitangent * g + normal * b);
        }
    }
    if hit.is_front { normal } else { -normal }
}

fn normalize(vector: Vector3<f64>) -> Vector3<f64> {
    vector / vector.norm_squared().max(1e-30).sqrt()
}
