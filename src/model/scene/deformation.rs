//! Settings of the deformation: how modes are stored, and which approximations and additional outputs are computed. The
//! default has no approximations.

/// The storage type of the entries of U. Sums over modes are always f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum StorageType {
    /// 4 bytes, exact.
    #[default]
    F32,
    /// 2 bytes with 11 significant bits, and a power-of-two scale per mode.
    F16,
    /// 2 bytes with 8 significant bits, and a power-of-two scale per mode.
    Bf16,
    /// 1 byte, -127 to 127, and a scale per mode and tile (a block of consecutive vertices).
    Int8,
}

impl StorageType {
    /// All storage types.
    pub const ALL: [Self; 4] = [Self::F32, Self::F16, Self::Bf16, Self::Int8];

    /// The name in scene files, on the command line and in benchmark records.
    pub const fn name(self) -> &'static str {
        match self {
            Self::F32 => "f32",
            Self::F16 => "f16",
            Self::Bf16 => "bf16",
            Self::Int8 => "int8",
        }
    }
}

/// How normals and tangents of a deformed surface are computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum NormalMethod {
    /// Normals of the rest state, transformed by T alone (equation 3.8 of B. Wang's thesis, "CUDA Deformers for Model
    /// Reduction").
    #[default]
    Rigid,
    /// Area-weighted normals of the deformed triangles (defined in `reference/normals.rs`).
    Exact,
}

/// Options that trade accuracy for time, and additional outputs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize)]
pub struct DeformationSettings {
    pub storage: StorageType,
    pub normals: NormalMethod,
    /// Sum modes with error compensation. Useful for modes that nearly cancel.
    pub compensated: bool,
    /// Store the displacement u = U q of every vertex in the domain's own frame, for example for collision tests.
    pub displacements: bool,
    /// Store an axis-aligned bounding box of each domain's deformed positions.
    pub boxes: bool,
}
