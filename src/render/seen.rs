//! Decodes the ids of the visibility image.

/// What a sample of a frame sees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Seen {
    /// Neither triangle nor ground, that is, the sky.
    Nothing,
    Ground,
    /// A triangle, by its index in the renderer's draw order; [`super::SceneBuffers::triangle`] maps it to its domain.
    Triangle(usize),
}

impl Seen {
    /// Twin of `shaders/shared/ids.glsl`.
    pub(super) const fn from_id(id: u32) -> Self {
        match id {
            0 => Self::Nothing,
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
        assert_eq!([0, 1, u32::MAX].map(Seen::from_id), [Seen::Nothing, Seen::Triangle(0), Seen::Ground]);
    }
}
