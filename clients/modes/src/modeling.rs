//! The computation as a whole: from a surface file to modes at its vertices.

use std::collections::BTreeMap;
use std::sync::Arc;

use modalcast_model::error::{Result, invalid};
use nalgebra::{DMatrix, Vector3};
use rayon::prelude::*;

use crate::assembly::SystemMatrices;
use crate::body::{Body, Layout};
use crate::cell_matrices::{CELL_FREEDOMS, CellMatrices, full_moments, node_coordinates};
use crate::constraints::{SPRING_FACTOR, embed_held_points};
use crate::eigensolver::{ElasticModes, find_elastic_modes};
use crate::embedding::{EmbeddedPoint, embed};
use crate::grid::{CELL_NODES, Grid};
use crate::large_motion::LargeMotion;
use crate::mass_properties::{mass_properties, truncated};
use crate::materials::Material;
use crate::parameters::ModelingParameters;
use crate::refinement::divide_long_edges;
use crate::surface_file::{DrawnMesh, SurfaceFile};

/// Receives the share of the work that is done, 0 to 1, and the name of the current stage.
pub type Progress<'a> = dyn Fn(f64, &str) + 'a;

/// The modes of a body.
#[derive(Debug, Default)]
pub struct Modeling {
    /// The drawn mesh. Long edges are divided, so that large triangles can bend.
    pub mesh: DrawnMesh,
    /// U: entry `(3 vertex + axis) * modes + mode`. Mass-normalized, 1 / sqrt(kg).
    pub modes: Vec<f32>,
    /// (rad/s)^2, ascending.
    pub eigenvalues: Vec<f64>,
    /// Estimates of the relative error of each frequency, from a second, coarser grid. Empty if that grid has too few
    /// cells.
    pub frequency_errors: Vec<f64>,
    /// |K x - lambda M x| / |lambda M x| of each mode.
    pub residuals: Vec<f64>,
    pub freedoms: usize,
    /// Side of a cell, meters. For a volume mesh, the mean length of the edges.
    pub cell_size: f64,
    /// Quadratic tetrahedra of a volume mesh; `None` for a surface.
    pub tetrahedra: Option<usize>,
    /// Names of the groups of a volume mesh, with their materials. Empty for a surface.
    pub group_materials: Vec<(String, Material)>,
    /// Connected parts.
    pub parts: usize,
    /// Rigid motions: six per part that is not held. They are no columns of U.
    pub rigid_modes: usize,
    /// Kilograms, with point masses. Without the material in held regions, which a surface loses.
    pub mass: f64,
    /// Those of [`mass_properties`] of a body without clamps.
    pub mass_properties: Option<DMatrix<f64>>,
    /// Extents of the surface, meters.
    pub size: [f64; 3],
    pub damping_ratio: f64,
    /// The cubic forces of large motion. The columns of U are then linear modes and their derivatives.
    pub large_motion: Option<LargeMotion>,
    /// Warnings about the input and the result.
    pub remarks: Vec<String>,
}

/// The stiffness in the rest of a cut cell, relative to that of the material. A softer fill lets nodes at slivers of
/// material move in spurious modes.
const FILL_FRACTION: f64 = 1e-8;
/// The thickness in cells below which the fill stiffens a sheet by more than 0.5 % (1e-8 of a solid cell against the cube
/// of the thickness).
const MIN_THICKNESS: f64 = 0.01;
/// The coarse grid of the error estimate has this share of the freedoms.
const COARSE_FRACTION: f64 = 0.4;
/// The order of the frequencies' error in the cell size that the error estimate assumes. Quadratic cells reach 4 for
/// smooth modes; re-entrant corners and cut cells lower it.
const ASSUMED_ORDER: i32 = 3;

/// Computes the modes of a surface.
///
/// # Errors
/// `Invalid` for a surface without volume, wrong groups, clamps that hold nothing or everything, and large motion; `Fault`
/// if the eigenproblem cannot be solved.
pub fn compute_modes(file: &SurfaceFile, parameters: &ModelingParameters, progress: &Progress<'_>) -> Result<Modeling> {
    progress(0.0, "surface");
    if parameters.is_large {
        let expected = "a volume mesh, such as that of `gmsh part.step -3 -order 2 -o part.msh`, because the cubic forces \
                        need elements that follow the material";
        return Err(invalid("--large", expected, format!("the surface '{}'", file.name)));
    }
    let body = Body::new(file, parameters)?;
    let layout = body.finest_layout(parameters.freedoms, body.initial_cell_size(), 0.93)?;
    body.check_clamps(&layout.grid, &parameters.clamps)?;
    check_mode_count(layout.freedoms(), parameters.modes)?;
    let count = parameters.modes;
    let mut solution = solve(&body, &layout, parameters, count, &|share, stage| progress(0.05 + 0.65 * share, stage))?;
    let coarse_progress = |share: f64, stage: &str| progress(0.7 + 0.25 * share, stage);
    let mut frequency_errors = estimate_errors(&body, &layout, parameters, &solution.modes, &coarse_progress);
    remove_high_modes(&mut solution.modes, parameters)?;
    frequency_errors.truncate(solution.modes.eigenvalues.len());
    progress(0.95, "interpolation");
    let (mesh, modes) = interpolate(&body, &layout, file, &solution.modes);
    let (low, high) = body.surface.bounds();
    let damping_ratio = parameters.damping_ratio.unwrap_or_else(|| mean_damping_ratio(&body, &layout));
    let mut modeling = Modeling {
        mesh,
        modes,
        frequency_errors,
        freedoms: layout.freedoms(),
        cell_size: layout.grid.cell_size,
        tetrahedra: None,
        group_materials: Vec::new(),
        parts: layout.pieces.part_count,
        rigid_modes: solution.rigid_modes,
        mass: solution.mass,
        mass_properties: solution.mass_properties.map(|masses| truncated(&masses, solution.modes.eigenvalues.len())),
        size: (high - low).into(),
        damping_ratio,
        large_motion: None,
        remarks: file.remarks.clone(),
        eigenvalues: solution.modes.eigenvalues,
        residuals: solution.modes.residuals,
    };
    add_remarks(&body, &layout, parameters, &mut modeling);
    Ok(modeling)
}

/// Fails for more modes than half of the freedoms.
pub(crate) fn check_mode_count(freedoms: usize, modes: usize) -> Result<()> {
    match freedoms < 2 * modes {
        true => Err(invalid("--modes", format!("at most half of the {freedoms} freedoms"), modes)),
        false => Ok(()),
    }
}

/// Removes the modes above the largest frequency.
///
/// # Errors
/// `Invalid` if no mode remains.
pub(crate) fn remove_high_modes(modes: &mut ElasticModes, parameters: &ModelingParameters) -> Result<()> {
    let Some(frequency) = parameters.max_frequency else { return Ok(()) };
    let limit = (std::f64::consts::TAU * frequency).powi(2);
    let count = modes.eigenvalues.partition_point(|eigenvalue| *eigenvalue <= limit);
    if count == 0 {
        let expected = format!("at least {:.4} Hz, the first frequency", to_hertz(modes.eigenvalues[0]));
        return Err(invalid("--max-frequency", expected, frequency));
    }
    modes.truncate(count);
    Ok(())
}

/// The damping ratio of the materials, weighted by mass.
fn mean_damping_ratio(body: &Body, layout: &Layout) -> f64 {
    let (mut sum, mut mass) = (0.0, 0.0);
    for group in layout.moments.iter().flatten() {
        let material = &body.materials[group.group as usize];
        let group_mass = group.volume_fraction() * material.density;
        sum += group_mass * material.damping_ratio;
        mass += group_mass;
    }
    sum / mass
}

/// The frequency of an eigenvalue, Hz.
pub fn to_hertz(eigenvalue: f64) -> f64 {
    eigenvalue.sqrt() / std::f64::consts::TAU
}

/// The modes on one grid.
struct Solution {
    modes: ElasticModes,
    rigid_modes: usize,
    mass: f64,
    /// `None` with clamps.
    mass_properties: Option<DMatrix<f64>>,
}

/// Assembles and solves the eigenproblem of one grid.
fn solve(
    body: &Body,
    layout: &Layout,
    parameters: &ModelingParameters,
    count: usize,
    progress: &Progress<'_>,
) -> Result<Solution> {
    progress(0.0, "cells");
    let mut matrices = cell_matrices(body, layout);
    let held = embed_held_points(&layout.grid, &layout.pieces, &layout.held_points);
    add_springs(body, &layout.grid, &held, &mut matrices);
    for mass in &parameters.point_masses {
        let point = layout.grid.to_cell_units(mass.position * body.unit);
        let is_held = body.regions.iter().any(|region| region.contains(mass.position));
        let Some(embedded) = embed(&layout.grid, &layout.pieces, point).filter(|_| !is_held) else {
            let [x, y, z]: [f64; 3] = mass.position.into();
            let expected = "a position at the body, outside of clamps";
            return Err(invalid("--point-mass", expected, format!("{x} {y} {z}")));
        };
        add_outer_product(&mut Arc::make_mut(&mut matrices[embedded.piece]).mass, &embedded.weights, mass.mass);
    }
    let mass = matrices.iter().map(|matrices| matrices.mass.iter().sum::<f64>()).sum();
    progress(0.05, "assembly");
    let system = SystemMatrices::assemble(&layout.pieces.nodes, layout.pieces.node_count, |piece| {
        (&matrices[piece].stiffness[..], &matrices[piece].mass[..])
    });
    drop(matrices);
    let rigid = free_motions(layout, &held);
    let size = largest_part(layout).min(body.diagonal());
    let shift = small_eigenvalue(&body.materials, mean_thickness(body, layout), size);
    let modes = find_elastic_modes(&system, &rigid, shift, count, &|share, stage| {
        progress(0.1 + 0.9 * share, stage);
    })?;
    let is_free = parameters.clamps.is_empty();
    let mass_properties = is_free.then(|| mass_properties(&system, &node_positions(layout), &modes));
    Ok(Solution { modes, rigid_modes: rigid.len(), mass, mass_properties })
}

/// The matrices of each piece. Full cells of one material share theirs.
fn cell_matrices(body: &Body, layout: &Layout) -> Vec<Arc<CellMatrices>> {
    let cell_size = layout.grid.cell_size;
    let full: Vec<Arc<CellMatrices>> = body
        .materials
        .iter()
        .map(|material| {
            let mut matrices = CellMatrices::zeros();
            matrices.add_material(&full_moments(), material, cell_size);
            Arc::new(matrices)
        })
        .collect();
    let matrices_of = |groups: &Vec<crate::cell_moments::GroupMoments>| {
        if let [group] = &groups[..]
            && group.volume_fraction() > 1.0 - 1e-12
        {
            return full[group.group as usize].clone();
        }
        let mut matrices = CellMatrices::zeros();
        for group in groups {
            matrices.add_material(&group.moments, &body.materials[group.group as usize], cell_size);
            matrices.add_fill(&full[group.group as usize], FILL_FRACTION);
        }
        Arc::new(matrices)
    };
    layout.moments.par_iter().map(matrices_of).collect()
}

/// Adds the springs that hold points.
fn add_springs(body: &Body, grid: &Grid, held: &[(EmbeddedPoint, f64)], matrices: &mut [Arc<CellMatrices>]) {
    let modulus = body.materials.iter().map(|material| material.youngs_modulus).fold(0.0, f64::max);
    // Newtons per meter and cell face: the modulus divided by the cell size, times the area of a face.
    let face_stiffness = SPRING_FACTOR * modulus * grid.cell_size;
    for (point, area) in held {
        let stiffness = &mut Arc::make_mut(&mut matrices[point.piece]).stiffness;
        for (i, weight) in point.weights.iter().enumerate() {
            for (j, other) in point.weights.iter().enumerate() {
                let entry = face_stiffness * area * weight * other;
                for axis in 0..3 {
                    stiffness[(3 * i + axis) * CELL_FREEDOMS + 3 * j + axis] += entry;
                }
            }
        }
    }
}

/// Adds `scale w w^T`.
fn add_outer_product(matrix: &mut [f64], weights: &[f64; CELL_NODES], scale: f64) {
    for (i, weight) in weights.iter().enumerate() {
        for (j, other) in weights.iter().enumerate() {
            matrix[i * CELL_NODES + j] += scale * weight * other;
        }
    }
}

/// The positions of all nodes, meters.
fn node_positions(layout: &Layout) -> Vec<Vector3<f64>> {
    let grid = &layout.grid;
    let mut positions = vec![Vector3::zeros(); layout.pieces.node_count];
    for (index, nodes) in layout.pieces.nodes.iter().enumerate() {
        let cell = grid.cell_at(layout.pieces.pieces[index].cell);
        for (local, node) in nodes.iter().enumerate() {
            let offset = node_coordinates(local);
            let point = Vector3::from_fn(|axis, _| cell[axis] as f64 + offset[axis] as f64 / 2.0);
            positions[*node as usize] = grid.origin + point * grid.cell_size;
        }
    }
    positions
}

/// The rigid motions of the parts without held points.
fn free_motions(layout: &Layout, held: &[(EmbeddedPoint, f64)]) -> Vec<Vec<f64>> {
    let pieces = &layout.pieces;
    let mut is_held = vec![false; pieces.part_count];
    for (point, _) in held {
        is_held[pieces.parts[point.piece] as usize] = true;
    }
    let mut nodes_of_part = vec![BTreeMap::new(); pieces.part_count];
    for (index, nodes) in pieces.nodes.iter().enumerate() {
        let cell = layout.grid.cell_at(pieces.pieces[index].cell);
        for (local, node) in nodes.iter().enumerate() {
            let offset = node_coordinates(local);
            let position = Vector3::from_fn(|axis, _| cell[axis] as f64 + offset[axis] as f64 / 2.0);
            nodes_of_part[pieces.parts[index] as usize].insert(*node as usize, position);
        }
    }
    let free = nodes_of_part.iter().zip(is_held).filter(|(_, is_held)| !is_held).map(|(nodes, _)| nodes);
    free.flat_map(|nodes| rigid_motions(layout.freedoms(), nodes)).collect()
}

/// Six rigid motions of a part: translations, and rotations about its center. `nodes` are the positions of its nodes.
pub(crate) fn rigid_motions(freedoms: usize, nodes: &BTreeMap<usize, Vector3<f64>>) -> Vec<Vec<f64>> {
    let center = nodes.values().sum::<Vector3<f64>>() / nodes.len() as f64;
    let motion = |displacement: &dyn Fn(&Vector3<f64>) -> Vector3<f64>| {
        let mut motion = vec![0.0; freedoms];
        for (node, position) in nodes {
            motion[3 * node..3 * node + 3].copy_from_slice(displacement(position).as_slice());
        }
        motion
    };
    let of_axis = |axis: usize| {
        let unit: Vector3<f64> = Vector3::ith(axis, 1.0);
        [motion(&|_| unit), motion(&|position| unit.cross(&(position - center)))]
    };
    (0..3).flat_map(of_axis).collect()
}

/// The mean thickness of the body, meters: that of a plate with its volume and area.
fn mean_thickness(body: &Body, layout: &Layout) -> f64 {
    2.0 * layout.volume_fractions().iter().sum::<f64>() * layout.grid.cell_size.powi(3) / body.surface.area()
}

/// A small eigenvalue, (rad/s)^2: 1/100 of that of a plate with the given thickness and size, in meters.
pub(crate) fn small_eigenvalue(materials: &[Material], thickness: f64, size: f64) -> f64 {
    let speed = materials.iter().map(|material| material.bar_wave_speed()).fold(f64::INFINITY, f64::min);
    0.01 * (speed * thickness / size.powi(2)).powi(2)
}

/// The diagonal of the bounding box of the largest part, meters.
fn largest_part(layout: &Layout) -> f64 {
    let pieces = &layout.pieces;
    let mut bounds = vec![([usize::MAX; 3], [0; 3]); pieces.part_count];
    for (piece, part) in pieces.pieces.iter().zip(&pieces.parts) {
        let (low, high) = &mut bounds[*part as usize];
        for (axis, coordinate) in layout.grid.cell_at(piece.cell).into_iter().enumerate() {
            low[axis] = low[axis].min(coordinate);
            high[axis] = high[axis].max(coordinate + 1);
        }
    }
    let diagonal = |(low, high): ([usize; 3], [usize; 3])| {
        (0..3).map(|axis| ((high[axis] - low[axis]) as f64).powi(2)).sum::<f64>().sqrt() * layout.grid.cell_size
    };
    bounds.into_iter().map(diagonal).fold(0.0, f64::max)
}

/// Estimates the relative errors of the frequencies from the difference to those of a coarser grid (Richardson). Empty if
/// there is no coarser grid.
fn estimate_errors(
    body: &Body,
    layout: &Layout,
    parameters: &ModelingParameters,
    modes: &ElasticModes,
    progress: &Progress<'_>,
) -> Vec<f64> {
    let limit = (layout.freedoms() as f64 * COARSE_FRACTION) as usize;
    let count = modes.eigenvalues.len();
    let first = layout.grid.cell_size * COARSE_FRACTION.powf(-0.38);
    let coarse = body.finest_layout(limit, first, 0.75).and_then(|coarse| {
        let solution = solve(body, &coarse, parameters, count, progress)?;
        Ok((coarse.grid.cell_size / layout.grid.cell_size, solution.modes.eigenvalues))
    });
    let Ok((ratio, coarse_eigenvalues)) = coarse else { return Vec::new() };
    let scale = (ratio.powi(ASSUMED_ORDER) - 1.0).max(0.5);
    let pairs = modes.eigenvalues.iter().zip(coarse_eigenvalues);
    pairs.map(|(fine, coarse)| ((coarse / fine).sqrt() - 1.0).abs() / scale).collect()
}

/// Interpolates the modes at the vertices of the drawn mesh, whose long edges are divided. Vertices in held regions do
/// not move.
fn interpolate(body: &Body, layout: &Layout, file: &SurfaceFile, modes: &ElasticModes) -> (DrawnMesh, Vec<f32>) {
    let grid = &layout.grid;
    let mut mesh = file.mesh.clone();
    divide_long_edges(&mut mesh, grid.cell_size);
    let rank = modes.vectors.len();
    let row = |position: &Vector3<f64>| {
        let mut row = vec![0.0_f32; 3 * rank];
        let is_held = body.regions.iter().any(|region| region.contains(position / body.unit));
        let point = if is_held { None } else { embed(grid, &layout.pieces, grid.to_cell_units(*position)) };
        if let Some(point) = point {
            let nodes = &layout.pieces.nodes[point.piece];
            for (mode, vector) in modes.vectors.iter().enumerate() {
                for axis in 0..3 {
                    let weighted = nodes.iter().zip(point.weights);
                    let displacement: f64 =
                        weighted.map(|(node, weight)| weight * vector[3 * *node as usize + axis]).sum();
                    row[axis * rank + mode] = displacement as f32;
                }
            }
        }
        row
    };
    let rows: Vec<Vec<f32>> = mesh.positions.par_iter().map(row).collect();
    (mesh, rows.concat())
}

/// Adds remarks about constants in units of millimeters, which differ from those in meters by factors of 1e6 and 1e12.
fn add_unit_remarks(material: &Material, remarks: &mut Vec<String>) {
    let Material { youngs_modulus, density, .. } = material;
    if *youngs_modulus < 0.9e6 && material.name == "custom" {
        remarks.push(format!("E = {youngs_modulus:e} Pa is softer than rubber; a modulus in MPa (N/mm2) is E=...e6"));
    }
    if *density < 1.0 {
        remarks.push(format!("rho = {density:e} kg/m3 is lighter than air; a density in t/mm3 is rho=...e12"));
    }
}

/// Adds the remarks that do not depend on the method. `diagonal` is that of the bounding box, meters.
pub(crate) fn add_common_remarks(
    materials: &[Material],
    diagonal: f64,
    parameters: &ModelingParameters,
    rigid_modes: usize,
    remarks: &mut Vec<String>,
) {
    if !(1e-3..=100.0).contains(&diagonal) {
        let unit = parameters.unit;
        remarks.push(format!("the part measures {diagonal:.3e} m from corner to corner; is '{unit}' its --unit?"));
    }
    for material in materials {
        add_unit_remarks(material, remarks);
    }
    if rigid_modes > 0 {
        let parts = rigid_modes / 6;
        let text = if parts == 1 { "1 part is".to_owned() } else { format!("{parts} parts are") };
        remarks.push(format!("{text} free: deformation in place, without rigid motions (--clamp holds a part)"));
    }
}

/// Adds warnings about the input and the result.
fn add_remarks(body: &Body, layout: &Layout, parameters: &ModelingParameters, modeling: &mut Modeling) {
    let remarks = &mut modeling.remarks;
    if !body.surface.is_closed {
        let text = "the surface is not closed (holes, or triangles that belong to no wall); its inside is found by winding \
                    numbers";
        remarks.push(text.into());
    }
    if body.surface.flipped_triangles > 0 {
        remarks.push(format!("{} triangles faced the other way and were turned over", body.surface.flipped_triangles));
    }
    if layout.removed_parts > 0 {
        let count = layout.removed_parts;
        let text = if count == 1 { "1 part".to_owned() } else { format!("{count} parts") };
        remarks.push(format!("{text} with less than 0.1 % of the volume left out; such a part stays at rest"));
    }
    add_common_remarks(&body.materials, body.diagonal(), parameters, modeling.rigid_modes, remarks);
    let thickness = mean_thickness(body, layout);
    if thickness < MIN_THICKNESS * modeling.cell_size {
        remarks.push(format!(
            "the walls are about {thickness:.1e} m thick, {:.0} times less than a cell: their frequencies are too high; \
             more --freedoms help",
            modeling.cell_size / thickness
        ));
    }
    if modeling.frequency_errors.is_empty() {
        remarks.push("the errors of the frequencies are unknown: a coarser grid does not resolve the part".into());
    } else if let Some(worst) = modeling.frequency_errors.iter().copied().reduce(f64::max).filter(|worst| *worst > 0.05)
    {
        let percent = 100.0 * worst;
        remarks.push(format!("the error of a frequency is about {percent:.0} %; more --freedoms reduce it"));
    }
}
