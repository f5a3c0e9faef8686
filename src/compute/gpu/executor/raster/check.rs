//! Validation of meshes for the compute rasterizer.

use super::cut_out::size_of_level;
use modalcast_model::error::{Result, invalid};
use modalcast_model::raster::{AlphaImage, CutOuts};
use modalcast_model::scene::DrawRange;

/// Exclusive limit of triangles: 24 bits count queue entries, next to 40 bits of tiles.
const MAX_TRIANGLES: usize = 1 << 24;

/// Refuses meshes that would cause out-of-bounds reads or queue overflows. Groups must not overlap, or a triangle could
/// be queued twice.
///
/// # Errors
/// `Invalid` with the name of the invalid field.
pub fn check(vertices: u64, triangles: &[[u32; 3]], groups: &[DrawRange]) -> Result<()> {
    let count = triangles.len();
    if count >= MAX_TRIANGLES {
        return Err(invalid("triangles", format!("fewer than {MAX_TRIANGLES}"), count));
    }
    if let Some(vertex) = triangles.as_flattened().iter().find(|vertex| u64::from(**vertex) >= vertices) {
        return Err(invalid("triangles", format!("vertices below {vertices}"), vertex));
    }
    let mut end = 0;
    for group in groups {
        let own = group.first as usize + group.triangles as usize;
        if (group.first as usize) < end || own > count {
            let expected = format!("groups one after the other within {count} triangles");
            return Err(invalid("groups", expected, format!("{group:?}")));
        }
        end = own;
    }
    Ok(())
}

/// Refuses cut-outs that do not fit a mesh of `triangles` triangles, or that are inconsistent.
///
/// # Errors
/// `Invalid` with the name of the invalid field.
pub fn check_cut_outs(triangles: usize, cut_outs: &CutOuts) -> Result<()> {
    let CutOuts { first, uvs, material_indices, materials, images, anisotropy } = cut_outs;
    let left = triangles.saturating_sub(*first as usize);
    for (field, given) in [("texture coordinates", uvs.len()), ("surfaces", material_indices.len())] {
        if given != left {
            return Err(invalid(field, format!("{left}, one a triangle from {first} on"), given));
        }
    }
    if let Some(surface) = material_indices.iter().find(|surface| **surface as usize >= materials.len()) {
        return Err(invalid("surfaces", format!("places below {}", materials.len()), surface));
    }
    let asked = materials.iter().filter_map(|surface| surface.image);
    if let Some(image) = asked.into_iter().find(|image| *image as usize >= images.len()) {
        return Err(invalid("surfaces", format!("images below {}", images.len()), image));
    }
    if anisotropy.is_nan() || *anisotropy < 1.0 {
        return Err(invalid("anisotropy", "1 or more", anisotropy));
    }
    images.iter().try_for_each(check_image)
}

/// Checks that the image has all mip levels, each with all its texels.
fn check_image(image: &AlphaImage) -> Result<()> {
    let levels = image.width.max(image.height).checked_ilog2().map_or(0, |levels| levels as usize + 1);
    if image.width.min(image.height) == 0 || image.levels.len() != levels {
        let size = format!("{levels} levels of {} x {} texels", image.width, image.height);
        return Err(invalid("image", size, image.levels.len()));
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
    fn cut_outs_that_would_be_read_out_of_bounds_are_refused() {
        let image = AlphaImage { width: 3, height: 2, levels: vec![vec![0; 6], vec![0; 1]] };
        let good = CutOuts {
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
        check_cut_outs(4, &good).expect("good");
        let refused = |triangles: usize, change: fn(&mut CutOuts)| {
            let mut own = good.clone();
            change(&mut own);
            check_cut_outs(triangles, &own).is_err()
        };
        assert!(refused(3, |_| ()) && refused(5, |_| ()));
        assert!(refused(4, |own| own.first = 1));
        assert!(refused(4, |own| own.material_indices[1] = 2));
        assert!(refused(4, |own| own.materials[1].image = Some(1)));
        assert!(refused(4, |own| own.anisotropy = f32::NAN) && refused(4, |own| own.anisotropy = 0.5));
        assert!(refused(4, |own| own.images[0].levels.truncate(1)));
        assert!(refused(4, |own| own.images[0].levels[1].push(0)));
        assert!(refused(4, |own| own.images[0].width = 0));
        assert!(refused(4, |own| own.images[0].height = 4));
    }

    #[test]
    fn meshes_that_would_be_read_out_of_bounds_are_refused() {
        let group = |first, triangles| DrawRange { first, triangles, cull_mode: CullMode::None };
        let of = |triangles: &[[u32; 3]], groups: &[DrawRange]| check(3, triangles, groups).is_ok();
        let two = [[0, 1, 2], [2, 1, 0]];
        assert!(of(&two, &[group(0, 1), group(1, 1)]) && of(&[], &[]));
        assert!(!of(&[[0, 1, 3]], &[]));
        assert!(!of(&two, &[group(0, 3)]) && !of(&two, &[group(0, 2), group(1, 1)]) && !of(&two, &[group(2, 1)]));
    }

    #[test]
    fn triangles_that_the_queues_cannot_count_are_refused() {
        let list = vec![[0; 3]; MAX_TRIANGLES];
        assert!(check(1, &list[1..], &[]).is_ok());
        assert!(check(1, &list, &[]).is_err());
    }
}
