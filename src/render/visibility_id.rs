//! Decodes the ids of the visibility image.

/// What a sample of a frame sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum VisibilityId {
    /// Neither triangle nor ground, that is, the sky.
    Background,
    Ground,
    /// A triangle, by its index in the renderer's draw order; [`super::SceneBuffers::source_triangle`] maps it to its domain.
    Triangle(usize),
}

impl VisibilityId {
    /// Twin of `shaders/shared/visibility_ids.glsl`.
    pub(super) const fn from_id(id: u32) -> Self {
        match id {
            0 => Self::Background,
            u32::MAX => Self::Ground,
            place => Self::Triangle(place as usize - 1),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_of_the_sky_the_ground_and_the_first_triangle_are_told_apart() {
        assert_eq!(
            [0, 1, u32::MAX].map(VisibilityId::from_id),
            [VisibilityId::Background, VisibilityId::Triangle(0), VisibilityId::Ground]
        );
    }
}
