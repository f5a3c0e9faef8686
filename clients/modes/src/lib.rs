//! Computes the modes of a solid body from its surface. The result is a model file with U and eigenvalues, which
//! `modalcast serve` and `modalcast view` open.
//!
//! The method is the finite cell method (Parvizian, Düster, Rank 2007: "Finite cell method", Computational Mechanics
//! 41): a regular grid of cubic 27-node cells covers the body, and the matrices of cells that the surface cuts are
//! integrated over the material inside them. No volume mesh is needed, so that open and dirty surfaces work too.
//!
//! | step | module |
//! |---|---|
//! | read a surface, weld its vertices, orient its triangles | [`surface`] |
//! | find the material along rays, with winding numbers where the surface has holes | [`material_rays`], [`inside_outside`], [`winding_number`] |
//! | divide the material of each cell into connected pieces, and the pieces into parts | [`cell_pieces`] |
//! | integrate each piece, and assemble stiffness and mass | [`cell_moments`], [`cell_matrices`], [`assembly`] |
//! | hold clamped regions, add point masses | [`region`], [`constraints`] |
//! | factorize and solve the eigenproblem | [`eigensolver`] |
//! | interpolate the modes at the vertices of the surface | [`embedding`] |
//! | write the model | [`model_file`] |

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod assembly;
pub mod body;
pub mod cell_matrices;
pub mod cell_moments;
pub mod cell_pieces;
pub mod constraints;
pub mod disjoint_sets;
pub mod eigensolver;
pub mod embedding;
pub mod grid;
pub mod inside_outside;
pub mod material_rays;
pub mod materials;
pub mod model_file;
pub mod modeling;
pub mod parameters;
pub mod refinement;
pub mod region;
pub mod surface;
pub mod surface_file;
pub mod thickness;
pub mod winding_number;

pub use modeling::{Modeling, Progress, compute_modes};
pub use parameters::ModelingParameters;
