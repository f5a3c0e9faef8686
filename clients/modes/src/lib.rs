//! Computes the modes of a solid body from its surface or from a volume mesh. The result is a model file with U and
//! eigenvalues, which `modalcast serve` and `modalcast view` open.
//!
//! The method for surfaces is the finite cell method (Parvizian, Düster, Rank 2007: "Finite cell method", Computational Mechanics
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
//!
//! A volume mesh consists of quadratic tetrahedra, which follow the material, so that no cells are cut:
//!
//! | step | module |
//! |---|---|
//! | read the cells of a file | [`volume_file`], [`gmsh_file`], [`vtk_file`], [`vtu_file`], [`vega_file`], [`cell_collector`] |
//! | check the elements, raise linear ones to quadratic, find parts and faces of the surface | [`volume_mesh`] |
//! | integrate an element | [`tet10`] |
//! | hold nodes, add point masses, assemble and solve | [`volume_modeling`], [`assembly`], [`eigensolver`] |
//! | draw the surface, whose vertices are nodes | [`volume_surface`] |
//!
//! Both: [`mass_properties`] of a body without clamps, with which it can move freely.
//!
//! Large motion of a volume mesh:
//!
//! | step | module |
//! |---|---|
//! | second derivatives and stretches of a Saint Venant-Kirchhoff material | [`stvk`] |
//! | extend linear modes by their derivatives | [`modal_derivatives`] |
//! | integrate the reduced forces, and write them | [`reduced_force`] |
//! | find how far the forces can be trusted | [`large_motion`] |

#![cfg_attr(not(test), deny(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::print_stdout))]

pub mod assembly;
pub mod body;
pub mod cell_collector;
pub mod cell_matrices;
pub mod cell_moments;
pub mod cell_pieces;
pub mod constraints;
pub mod disjoint_sets;
pub mod eigensolver;
pub mod embedding;
pub mod file_cursor;
pub mod gmsh_file;
pub mod grid;
pub mod inside_outside;
pub mod large_motion;
pub mod mass_properties;
pub mod material_rays;
pub mod materials;
pub mod modal_derivatives;
pub mod model_file;
pub mod modeling;
pub mod parameters;
pub mod part_file;
pub mod reduced_force;
pub mod refinement;
pub mod region;
pub mod stvk;
pub mod surface;
pub mod surface_file;
pub mod tet10;
pub mod thickness;
pub mod vega_file;
pub mod volume_file;
pub mod volume_mesh;
pub mod volume_modeling;
pub mod volume_surface;
pub mod vtk_cells;
pub mod vtk_file;
pub mod vtu_file;
pub mod winding_number;

pub use modeling::{Modeling, Progress, compute_modes};
pub use parameters::ModelingParameters;
pub use part_file::PartFile;
pub use volume_modeling::compute_volume_modes;
