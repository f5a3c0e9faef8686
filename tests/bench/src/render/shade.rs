//! Phong shading by equation 3.12, as in the shaders but in f64. The light of a point towards the eye is split into the
//! part without the sun and the part from the sun.
//!
//!   C = skylight Ca + s_f sunlight ((n . v_l) Cd + (v_e' . v_l)^k Cs),  v_e' = 2 (v_e . n) n - v_e

use nalgebra::Vector3;

use super::ray_scene::{Hit, Ray, RayScene};
use super::reference_view::View;

/// Shading of one point that a camera ray hits.
#[derive(Debug, Clone, Copy)]
pub(super) struct ShadedPoint {
    pub(super) point: Vector3<f64>,
    /// Geometric normal, on the sun's side.
    pub(super) facet: Vector3<f64>,
    /// The triangle; `None` for ground and sky.
    pub(super) triangle: Option<usize>,
    /// Linear light without the sun; below it the contribution of the unshadowed sun.
    pub(super) ambient: Vector3<f64>,
    pub(super) sun: Vector3<f64>,
    /// Fraction of the sunlight that the point would receive: the cosine, or 0 when it faces away.
    pub(super) facing: f64,
    pub(super) alpha: f64,
}

/// A point of the sky, without sunlight.
pub(super) fn sky(view: &View, ray: &Ray) -> ShadedPoint {
    let (point, zero) = (ray.from, Vector3::zeros());
    ShadedPoint {
        point,
        facet: zero,
        triangle: None,
        ambient: view.sky(&ray.along),
        sun: zero,
        facing: 0.0,
        alpha: 1.0,
    }
}

/// A point of the ground at `t`: Lambertian, with haze.
pub(super) fn ground(view: &View, ray: &Ray, t: f64) -> ShadedPoint {
    let point = ray.at(t);
    let (color, haze) = view.ground_colors();
    let clear = view.clear(&point);
    let facing = view.up.dot(&view.to_sun).max(0.0);
    ShadedPoint {
        point,
        facet: view.up,
        triangle: None,
        ambient: haze.lerp(&color.component_mul(&view.skylight), clear),
        sun: color.component_mul(&view.sunlight) * (clear * facing),
        facing: clear * facing,
        alpha: 1.0,
    }
}

/// A point of a triangle.
pub(super) fn surface(ray_scene: &RayScene, view: &View, ray: &Ray, hit: &Hit) -> ShadedPoint {
    let paint = ray_scene.paint(hit);
    let point = ray.at(hit.t);
    let [r, g, b, a] = paint.color.as_ref().map_or([1.0; 4], |image| image.at(ray_scene.uv(hit)));
    let tint = Vector3::new(r, g, b);
    let normal = normal(ray_scene, hit);
    let cosine = normal.dot(&view.to_sun);
    let mut sun = Vector3::zeros();
    if cosine > 0.0 {
        let to_eye = unit(view.eye - point);
        let reflected = 2.0 * to_eye.dot(&normal) * normal - to_eye;
        let gleam = reflected.dot(&view.to_sun);
        let highlight = if gleam > 0.0 { gleam.powf(paint.exponent) } else { 0.0 };
        let answer = cosine * paint.diffuse.component_mul(&tint) + highlight * paint.specular;
        sun = answer.component_mul(&view.sunlight);
    }
    let flat = ray_scene.triangles[hit.triangle].facet();
    ShadedPoint {
        point,
        facet: if flat.dot(&view.to_sun) < 0.0 { -flat } else { flat },
        triangle: Some(hit.triangle),
        ambient: view.skylight.component_mul(&paint.ambient).component_mul(&tint),
        sun,
        facing: cosine.max(0.0),
        alpha: if ray_scene.is_blended(hit) { paint.alpha * a } else { 1.0 },
    }
}

/// The interpolated normal, perturbed by the normal map and flipped to the visible side.
fn normal(ray_scene: &RayScene, hit: &Hit) -> Vector3<f64> {
    let corners = ray_scene.triangles[hit.triangle].corners.map(|corner| corner as usize);
    let weights = [1.0 - hit.u - hit.v, hit.u, hit.v];
    let mut normal: Vector3<f64> =
        corners.iter().zip(weights).map(|(at, weight)| ray_scene.normals[*at] * weight).sum();
    normal = unit(normal);
    if let Some(image) = ray_scene.paint(hit).normal.as_ref().filter(|_| !ray_scene.tangents.is_empty()) {
        let tangent =
            |axis: usize| corners.iter().zip(weights).map(|(at, weight)| ray_scene.tangents[*at][axis] * weight).sum();
        let [x, y, z, sign]: [f64; 4] = [0, 1, 2, 3].map(tangent);
        let along = Vector3::new(x, y, z);
        if along.norm_squared() > 0.0 {
            let [r, g, b] =
                std::array::from_fn(|channel| (image.at(ray_scene.uv(hit))[channel] * 255.0 - 128.0) / 127.0);
            let along = unit(along - normal * normal.dot(&along));
            let across = normal.cross(&along) * if sign < 0.0 { -1.0 } else { 1.0 };
            normal = unit(along * r + across * g + normal * b);
        }
    }
    if hit.front { normal } else { -normal }
}

fn unit(vector: Vector3<f64>) -> Vector3<f64> {
    vector / vector.norm_squared().max(1e-30).sqrt()
}
