//! How a scene's deformation is stored and computed: exactly by default, cheaper where the scene says so.

use crate::error::{Result, invalid};

/// The type that entries of U are stored in. Sums are f32 whatever it is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Storage {
    /// 4 bytes, exact.
    #[default]
    F32,
    /// 2 bytes, 11 significant bits, and a power of two per mode.
    F16,
    /// 2 bytes, 8 significant bits, and a power of two per mode.
    Bf16,
    /// 1 byte, -127 to 127, and a scale per tile of vertices and mode.
    Int8,
}

impl Storage {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::F32, Self::F16, Self::Bf16, Self::Int8];

    /// The name used in scenes, on the command line and in records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
            Self::Int8 => "int8",
        }
    }
}

/// Which normals and tangents a deformed surface gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Normals {
    /// Those of the rest state, turned by T alone (equation 3.8 of the thesis).
    #[default]
    Rigid,
    /// Those that follow the deformed triangles, weighted by area (`reference/normals.rs` defines them).
    Exact,
}

/// Whether domains that share a shape are deformed together, so that its U is read once for all of them: the same numbers,
/// bit by bit.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Batches {
    /// Where it is known to be faster.
    #[default]
    Auto,
    /// Each for itself.
    Never,
    /// Wherever several domains share a shape that has modes.
    Always,
}

/// Choices between error and time. The default leaves nothing out.
#[derive(Debug, Clone, Copy, PartialEq, Default, serde::Serialize, serde::Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Deformation {
    pub storage: Storage,
    pub normals: Normals,
    /// Leave out the modes that together move no vertex by more than this many metres.
    pub truncation: Option<f64>,
    /// Sum the modes with compensation, for modes that nearly cancel.
    pub compensated: bool,
    /// Keep u = U q of every vertex beside its position, in the domain's own frame, for a reader such as a collision test.
    pub displacements: bool,
    /// Keep an axis-aligned box of each domain's deformed positions.
    pub boxes: bool,
    /// Of the CUDA deformer. Truncated and compensated sums, and kept displacements, have no batches.
    pub batches: Batches,
}

impl Deformation {
    pub(super) fn check(&self) -> Result<()> {
        match self.truncation {
            Some(budget) if !(budget.is_finite() && budget > 0.0) => {
                Err(invalid("deform.truncation", "a positive number of metres", budget))
            }
            _ => Ok(()),
        }
    }
}
