//! The tables of a scene on the device, the plan of its kernels and buffers, and the input values of its steps. All
//! functions are pure and are tested without a GPU.
//!
//! | file | content |
//! |---|---|
//! | `layout` | the structs that host and kernels share |
//! | `work` | the tiles (the work of each warp) of `deform`, and the groups of domains for `batch` |
//! | `normal_tables`, `rings`, `box_segments` | the tables of `normals` and `bounds` |
//! | `device_tables` | all tables of a scene, built once |
//! | `kernels`, `occupancy` | macros, grids and tuning of the kernels |
//! | `plan` | kernels, buffers in bytes, launches |
//! | `input_packing`, `staging` | the input values of a step |
//! | `change_list` | the lists of a partial step |
//! | `box_keys` | boxes as the kernels write them |
//! | `png_plan` | strips, tiles and memory of a picture that is encoded as PNG |

pub(crate) mod box_keys;
pub(crate) mod box_segments;
pub(crate) mod change_list;
pub(crate) mod device_tables;
pub(crate) mod input_packing;
pub(crate) mod kernels;
pub(crate) mod layout;
mod normal_tables;
pub(crate) mod occupancy;
pub(crate) mod plan;
pub(crate) mod png_plan;
mod rings;
pub(crate) mod staging;
#[cfg(test)]
pub(crate) mod test_scenes;
pub(crate) mod work;
