//! The file of a part: a surface or a volume mesh, which its name decides.

use modalcast_model::error::Result;
use modalcast_model::load::{self, LoadOptions};

use crate::modeling::{Modeling, Progress, compute_modes};
use crate::parameters::ModelingParameters;
use crate::surface_file::{self, SurfaceFile};
use crate::volume_file::{self, VolumeFile};
use crate::volume_modeling::compute_volume_modes;

/// The file of a part.
#[derive(Debug, Clone)]
pub enum PartFile {
    Surface(SurfaceFile),
    Volume(VolumeFile),
}

/// Where the modes of a model come from.
#[derive(Debug, Clone, Copy)]
pub struct ModelSource<'a> {
    /// The file name without its folder.
    pub name: &'a str,
    /// SHA-256 of the file, hexadecimal.
    pub sha256: &'a str,
    /// The axis of the file that points up: 0 for x, 1 for y, 2 for z.
    pub up_axis: usize,
}

impl PartFile {
    /// Reads a file.
    ///
    /// # Errors
    /// Those of [`surface_file::read`] and [`volume_file::read`].
    pub fn read(path: &str, options: &LoadOptions) -> Result<Self> {
        match load::is_volume_mesh(path) {
            true => Ok(Self::Volume(volume_file::read(path, options)?)),
            false => Ok(Self::Surface(surface_file::read(path, options)?)),
        }
    }

    /// Name, hash and up axis of the file.
    pub fn source(&self) -> ModelSource<'_> {
        match self {
            Self::Surface(SurfaceFile { name, sha256, up_axis, .. })
            | Self::Volume(VolumeFile { name, sha256, up_axis, .. }) => ModelSource { name, sha256, up_axis: *up_axis },
        }
    }

    /// Computes the modes.
    ///
    /// # Errors
    /// Those of [`compute_modes`] and [`compute_volume_modes`].
    pub fn compute_modes(&self, parameters: &ModelingParameters, progress: &Progress<'_>) -> Result<Modeling> {
        match self {
            Self::Surface(file) => compute_modes(file, parameters, progress),
            Self::Volume(file) => compute_volume_modes(file, parameters, progress),
        }
    }
}
