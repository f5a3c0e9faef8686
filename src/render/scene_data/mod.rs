//! Static data of a scene in the layout of the device, computed on the host: index lists in draw groups, and texture
//! arrays with mipmap levels.

pub(crate) mod geometry;
pub(crate) mod inner_edges;
pub(crate) mod textures;
