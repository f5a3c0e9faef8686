//! Validation of meshes for the compute rasterizer.

use super::cut_out::size_of_level;
use modalcast_model::error::{Result, invalid};
use modalcast_model::raster::{AlphaImage, CutOuts};
use modalcast_model::scene::DrawRange;

/// Exclusive limit of the number of triangles. The 64-bit counter of the large queue has 24 bits for triangles and 40
/// bits for their tiles.
const MAX_TRIANGLES: usize = 1 << 24;

/// Rejects meshes that would cause out-of-bounds reads or queue overflows. Groups (the ranges of triangles that are
/// drawn) must not overlap, because a triangle must not be queued twice.
///
/// # Errors
/// `Invalid` with the name of the invalid field.
pub fn check_mesh(vertices: u64, triangles: &[[u32; 3]], groups: &[DrawRange]) -> Result<()> {
    let triangle_count = triangles.len();
    if triangle_count >= MAX_TRIANGLES {
        return Err(invalid("triangles", format!("fewer than {MAX_TRIANGLES}"), triangle_count));
    }
    if let Some(vertex) = triangles.as_flattened().iter().find(|vertex| u64::from(**vertex) >= vertices) {
        return Err(invalid("triangles", format!("vertices below {vertices}"), vertex));
    }
    let mut previous_end = 0;
    for group in groups {
        let group_end = group.first_triangle as usize + group.triangle_count as usize;
        if (group.first_triangle as usize) < previous_end || group_end > triangle_count {
            let expected = format!("ascending, disjoint groups within {triangle_count} triangles");
            return Err(invalid("groups", expected, format!("{group:?}")));
        }
        previous_end = group_end;
    }
    Ok(())
}

/// Rejects cut-outs that do not fit a mesh of `triangles` triangles, or that are inconsistent.
///
/// # Errors
/// `Invalid` with the name of the invalid field.
pub fn check_cut_outs(triangles: usize, cut_outs: &CutOuts) -> Result<()> {
    let CutOuts { first, uvs, material_indices, materials, images, anisotropy } = cut_outs;
    let cut_out_count = triangles.saturating_sub(*first as usize);
    for (field, got) in [("texture coordinates", uvs.len()), ("material indices", material_indices.len())] {
        if got != cut_out_count {
            return Err(invalid(field, format!("{cut_out_count}, one per triangle from {first} on"), got));
        }
    }
    if let Some(material_index) =
        material_indices.iter().find(|material_index| **material_index as usize >= materials.len())
    {
        return Err(invalid("material indices", format!("indices below {}", materials.len()), material_index));
    }
    let image_indices = materials.iter().filter_map(|material| material.image);
    if let Some(image) = image_indices.into_iter().find(|image| *image as usize >= images.len()) {
        return Err(invalid("materials", format!("image indices below {}", images.len()), image));
    }
    if anisotropy.is_nan() || *anisotropy < 1.0 {
        return Err(invalid("anisotropy", "1 or more", anisotropy));
    }
    images.iter().try_for_each(check_image)
}

/// Checks that the image has all mip levels, each with all its texels.
fn check_image(image: &AlphaImage) -> Result<()> {
    let level_count = image.width.max(image.height).checked_ilog2().map_or(0, |last_level| last_level as usize + 1);
    if image.width.min(image.height) == 0 || image.levels.len() != level_count {
        let expected = format!("{level_count} levels of {} x {} texels", image.width, image.height);
        return Err(invalid("image", expected, image.levels.len()));
    }
    for (level, texels) in image.levels.iter().enumerate() {
        let [width, height] = size_of_level(image, level);
        if texels.len() != width * height {
            return Err(invalid("image", format!("{width} x {height} texels in level {level}"), texels.len()));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use modalcast_model::raster::AlphaMaterial;
    use modalcast_model::scene::CullMode;

    #[test]
    fn cut_outs_with_invalid_indices_or_sizes_are_rejected() {
        // A valid mesh has four triangles: triangles 2 and 3 are cut-outs.
        let image = AlphaImage { width: 3, height: 2, levels: vec![vec![0; 6], vec![0; 1]] };
        let valid = CutOuts {
            first: 2,
            uvs: vec![[[0.0; 2]; 3]; 2],
            material_indices: vec![0, 1],
            materials: vec![
                AlphaMaterial { alpha: 1.0, cutoff: 0.5, image: Some(0) },
                AlphaMaterial { alpha: 1.0, cutoff: 0.5, image: None },
            ],
            images: vec![image.clone()],
            anisotropy: 1.0,
        };
        check_cut_outs(4, &valid).expect("valid cut-outs");
        let is_rejected = |triangles: usize, change: fn(&mut CutOuts)| {
            let mut changed = valid.clone();
            change(&mut changed);
            check_cut_outs(triangles, &changed).is_err()
        };
        // With three or five triangles, there would be one or three cut-outs.
        assert!(is_rejected(3, |_| ()) && is_rejected(5, |_| ()));
        assert!(is_rejected(4, |cut_outs| cut_outs.first = 1));
        assert!(is_rejected(4, |cut_outs| cut_outs.material_indices[1] = 2));
        assert!(is_rejected(4, |cut_outs| cut_outs.materials[1].image = Some(1)));
        assert!(is_rejected(4, |cut_outs| cut_outs.anisotropy = f32::NAN));
        assert!(is_rejected(4, |cut_outs| cut_outs.anisotropy = 0.5));
        assert!(is_rejected(4, |cut_outs| cut_outs.images[0].levels.truncate(1)));
        assert!(is_rejected(4, |cut_outs| cut_outs.images[0].levels[1].push(0)));
        assert!(is_rejected(4, |cut_outs| cut_outs.images[0].width = 0));
        assert!(is_rejected(4, |cut_outs| cut_outs.images[0].height = 4));
    }

    #[test]
    fn meshes_with_invalid_indices_or_groups_are_rejected() {
        let group = |first, triangles| DrawRange {
            first_triangle: first,
            triangle_count: triangles,
            cull_mode: CullMode::None,
        };
        let is_valid = |triangles: &[[u32; 3]], groups: &[DrawRange]| check_mesh(3, triangles, groups).is_ok();
        let triangles = [[0, 1, 2], [2, 1, 0]];
        assert!(is_valid(&triangles, &[group(0, 1), group(1, 1)]));
        assert!(is_valid(&[], &[]));
        assert!(!is_valid(&[[0, 1, 3]], &[]));
        assert!(!is_valid(&triangles, &[group(0, 3)]));
        assert!(!is_valid(&triangles, &[group(0, 2), group(1, 1)]));
        assert!(!is_valid(&triangles, &[group(2, 1)]));
    }

    #[test]
    fn more_triangles_than_the_queues_can_count_are_rejected() {
        let triangles = vec![[0; 3]; MAX_TRIANGLES];
        assert!(check_mesh(1, &triangles[1..], &[]).is_ok());
        assert!(check_mesh(1, &triangles, &[]).is_err());
    }
}
