//! Which meshes are refused.

use crate::error::{Result, invalid};
use crate::scene::Group;

/// The most triangles, exclusive: 24 bits count what is queued, beside 40 bits of tiles.
const MOST: usize = 1 << 24;

/// Refuses what would be read or queued out of bounds. Groups may not overlap, or a triangle could be queued twice.
///
/// # Errors
/// `Invalid` naming triangles or groups.
pub(in super::super) fn check(vertices: u64, triangles: &[[u32; 3]], groups: &[Group]) -> Result<()> {
    let count = triangles.len();
    if count >= MOST {
        return Err(invalid("triangles", format!("fewer than {MOST}"), count));
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Faces;

    #[test]
    fn meshes_that_would_be_read_out_of_bounds_are_refused() {
        let group = |first, triangles| Group { first, triangles, faces: Faces::Both };
        let of = |triangles: &[[u32; 3]], groups: &[Group]| check(3, triangles, groups).is_ok();
        let two = [[0, 1, 2], [2, 1, 0]];
        assert!(of(&two, &[group(0, 1), group(1, 1)]) && of(&[], &[]));
        assert!(!of(&[[0, 1, 3]], &[]));
        assert!(!of(&two, &[group(0, 3)]) && !of(&two, &[group(0, 2), group(1, 1)]) && !of(&two, &[group(2, 1)]));
    }

    #[test]
    fn triangles_that_the_queues_cannot_count_are_refused() {
        let list = vec![[0; 3]; MOST];
        assert!(check(1, &list[1..], &[]).is_ok());
        assert!(check(1, &list, &[]).is_err());
    }
}
