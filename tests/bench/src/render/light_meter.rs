//! Measures the sun visibility of rendered frames. All surfaces of the scene become white and matte; the ratio of a
//! frame with shadows to a frame without shadows is the sun visibility.

use std::sync::Arc;

use super::reference_image::MIN_SUNLIGHT;
use super::reference_texture::linear_from_srgb;
use modalcast_model::domain::{Material, Texture};
use modalcast_model::error::Result;
use modalcast_model::scene::{Ground, RenderSettings, Scene, SceneParts};

/// The scene with these render settings. The rule without a preset replaces none of them; a named preset remains.
///
/// # Errors
/// `Invalid` when the settings contradict each other.
pub(super) fn with_settings(scene: &Scene, look: RenderSettings) -> Result<Arc<Scene>> {
    let preset = look.preset.filter(|request| request.preset.is_some());
    Scene::new(SceneParts { look: RenderSettings { preset, ..look }, ..scene.parts() })
}

/// The scene with white, matte surfaces. The alpha of blended surfaces and cut-outs remains. The sunlight is 1, the
/// maximum of the display.
///
/// # Errors
/// Only those that the scene itself would cause.
pub(super) fn meter_scene(scene: &Scene) -> Result<Arc<Scene>> {
    let look = RenderSettings {
        sunlight: [1.0; 3],
        skylight: [0.0; 3],
        zenith: [0.0; 3],
        horizon: [0.0; 3],
        ground: scene.look.ground.map(|_| Ground { color: Some([1.0; 3]) }),
        ..scene.look
    };
    let mut parts = SceneParts { look, ..scene.parts() };
    for material in &mut parts.materials {
        *material = Material { ambient: [0.0; 3], diffuse: [1.0; 3], specular: [0.0; 3], ..material.clone() };
    }
    let color_textures: std::collections::BTreeSet<usize> =
        parts.materials.iter().filter_map(|material| material.color_texture).collect();
    for index in color_textures {
        let texture = &parts.textures[index];
        let white_rgba = texture.rgba().chunks_exact(4).flat_map(|texel| [255, 255, 255, texel[3]]).collect();
        let white_texture = Texture::new(texture.name.clone(), texture.width(), texture.height(), white_rgba)?;
        // The original remains, because another material may use it as a normal map.
        parts.textures.push(white_texture);
        let white_index = parts.textures.len() - 1;
        for material in parts.materials.iter_mut().filter(|material| material.color_texture == Some(index)) {
            material.color_texture = Some(white_index);
        }
    }
    Scene::new(parts)
}

/// Sun visibility per pixel from frames of [`meter_scene`] with and without shadows, both RGBA. At [`MIN_SUNLIGHT`],
/// rounding to 8-bit sRGB changes the sunlight by up to 1.2 %; for brighter pixels, by less.
pub(super) fn read_sun_visibility(shadowed: &[u8], unshadowed: &[u8]) -> Vec<Option<f32>> {
    // The frames are gray, so one channel is enough.
    let sunlight = |pixel: &[u8]| linear_from_srgb(f64::from(pixel[1]) / 255.0);
    let pairs = shadowed.chunks_exact(4).zip(unshadowed.chunks_exact(4));
    pairs
        .map(|(shadowed, unshadowed)| (sunlight(shadowed), sunlight(unshadowed)))
        .map(|(shadowed, unshadowed)| (unshadowed >= MIN_SUNLIGHT).then(|| (shadowed / unshadowed) as f32))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::render::reference_texture::srgb_from_linear;

    #[test]
    fn reads_visibility_only_above_the_minimum_sunlight() {
        let encode = |linear: f64| (255.0 * srgb_from_linear(linear)).round() as u8;
        let gray_pixel = |linear: f64| [encode(linear); 4];
        for (sunlight, visibility) in [(1.0, 0.5), (0.5, 0.25), (0.11, 1.0), (0.8, 0.0)] {
            let measured_visibility = read_sun_visibility(&gray_pixel(sunlight * visibility), &gray_pixel(sunlight))[0]
                .expect("a visibility");
            assert!(
                (f64::from(measured_visibility) - visibility).abs() < 0.01,
                "expected {visibility}, got {measured_visibility}"
            );
        }
        assert_eq!(read_sun_visibility(&gray_pixel(0.05), &gray_pixel(0.05)), [None]);
    }
}
