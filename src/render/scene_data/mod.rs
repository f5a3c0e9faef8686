//! Static data of a scene in the form in which the device gets it: index lists in draw groups, and texture arrays with
//! mipmap levels. Computed on the host.

pub(crate) mod geometry;
pub(crate) mod textures;
