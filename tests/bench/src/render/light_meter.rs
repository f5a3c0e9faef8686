//! Light meter: the scene with white matte surfaces of the same shapes and holes, so that the ratio of a frame with
//! shadows and one without is the sun visibility.

use std::sync::Arc;

use super::reference_image::LEAST_LIGHT;
use super::reference_texture::linear_from_srgb;
use modalcast_model::domain::{Material, Texture};
use modalcast_model::error::Result;
use modalcast_model::scene::{Ground, RenderSettings, Scene, SceneParts};

/// The scene with another look.
///
/// # Errors
/// `Invalid` when the look's options contradict each other.
pub(super) fn relit(scene: &Scene, look: RenderSettings) -> Result<Arc<Scene>> {
    Scene::new(SceneParts { look, ..scene.parts() })
}

/// The light meter of a scene. Blended surfaces keep their alpha and cut-outs their holes; the sunlight is 1, the
/// maximum of the display.
///
/// # Errors
/// Only those that the scene itself would cause.
pub(super) fn meter(scene: &Scene) -> Result<Arc<Scene>> {
    let look = RenderSettings {
        sunlight: [1.0; 3],
        skylight: [0.0; 3],
        zenith: [0.0; 3],
        horizon: [0.0; 3],
        ground: scene.look.ground.map(|_| Ground { color: [1.0; 3] }),
        ..scene.look
    };
    let mut parts = SceneParts { look, ..scene.parts() };
    for material in &mut parts.materials {
        *material = Material { ambient: [0.0; 3], diffuse: [1.0; 3], specular: [0.0; 3], ..material.clone() };
    }
    let colors: std::collections::BTreeSet<usize> =
        parts.materials.iter().filter_map(|material| material.color_texture).collect();
    for index in colors {
        let texture = &parts.textures[index];
        let white = texture.rgba().chunks_exact(4).flat_map(|texel| [255, 255, 255, texel[3]]).collect();
        let white = Texture::new(texture.name.clone(), texture.width(), texture.height(), white)?;
        // An image may be used for colors and for normals; the normals keep the original.
        parts.textures.push(white);
        let last = parts.textures.len() - 1;
        for material in parts.materials.iter_mut().filter(|material| material.color_texture == Some(index)) {
            material.color_texture = Some(last);
        }
    }
    Scene::new(parts)
}

/// Sun visibility per pixel from light-meter frames with and without shadows, both RGBA. Bytes resolve it to one part
/// in a hundred at [`LEAST_LIGHT`], and better in brighter places.
pub(super) fn read(shadowed: &[u8], unshadowed: &[u8]) -> Vec<Option<f32>> {
    let linear = |pixel: &[u8]| linear_from_srgb(f64::from(pixel[1]) / 255.0);
    let pairs = shadowed.chunks_exact(4).zip(unshadowed.chunks_exact(4));
    pairs
        .map(|(some, all)| (linear(some), linear(all)))
        .map(|(some, all)| (all >= LEAST_LIGHT).then(|| (some / all) as f32))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::reference_texture::srgb_from_linear;

    #[test]
    fn reads_visibility_only_where_enough_light_falls() {
        let byte = |linear: f64| (255.0 * srgb_from_linear(linear)).round() as u8;
        let pixel = |linear: f64| [byte(linear); 4];
        for (all, share) in [(1.0, 0.5), (0.5, 0.25), (0.11, 1.0), (0.8, 0.0)] {
            let read = read(&pixel(all * share), &pixel(all))[0].expect("enough light");
            assert!((f64::from(read) - share).abs() < 0.01, "{all} {share}: {read}");
        }
        assert_eq!(read(&pixel(0.05), &pixel(0.05)), [None]);
    }
}
