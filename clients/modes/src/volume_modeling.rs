//! The modes of a volume mesh: clamps and point masses at its nodes, assembly, and U at the nodes of its surface.

use std::collections::BTreeMap;

use modalcast_model::error::{Error, Result, fault, invalid};
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

use crate::assembly::{HELD_NODE, SystemMatrices};
use crate::eigensolver::{ElasticModes, find_elastic_modes};
use crate::large_motion::add_large_motion;
use crate::mass_properties::mass_properties;
use crate::materials::Material;
use crate::modeling::{
    Modeling, Progress, add_common_remarks, check_mode_count, remove_high_modes, rigid_motions, small_eigenvalue,
};
use crate::parameters::{ModelingParameters, PointMass};
use crate::region::Region;
use crate::stvk::StvkSolid;
use crate::tet10::{self, EDGES, NODES, Tet10Matrices};
use crate::volume_file::VolumeFile;
use crate::volume_mesh::{VolumeMesh, bounds_of};
use crate::volume_surface::{area_of, surface_of};

/// Computes the modes of a volume mesh.
///
/// # Errors
/// `Invalid` for a mesh with more freedoms than the limit, wrong groups, and clamps that hold nothing, everything, or a part
/// only at a line; `Fault` if the eigenproblem or a modal derivative cannot be solved.
pub fn compute_volume_modes(
    file: &VolumeFile,
    parameters: &ModelingParameters,
    progress: &Progress<'_>,
) -> Result<Modeling> {
    progress(0.0, "mesh");
    let mesh = &file.mesh;
    if parameters.thickness.is_some() {
        return Err(invalid("--thickness", "none for a volume mesh", "one"));
    }
    let materials = materials_of(mesh, parameters)?;
    let clamps = Clamps::new(mesh, parameters)?;
    let freedoms = 3 * clamps.free_nodes;
    check_freedoms(mesh, freedoms, parameters)?;
    check_mode_count(freedoms, parameters.modes)?;
    progress(0.02, "elements");
    let mut matrices = element_matrices(mesh, &materials)?;
    for mass in &parameters.point_masses {
        add_point_mass(mesh, &clamps, parameters, mass, &mut matrices)?;
    }
    let mass = matrices.iter().map(|matrices| matrices.mass.iter().sum::<f64>()).sum();
    progress(0.05, "assembly");
    let numbered: Vec<[u32; NODES]> =
        mesh.elements.iter().map(|element| element.map(|node| clamps.numbers[node as usize])).collect();
    let system = SystemMatrices::assemble(&numbered, clamps.free_nodes, |element| {
        (&matrices[element].stiffness[..], &matrices[element].mass[..])
    });
    drop(matrices);
    let rigid = free_motions(mesh, &clamps);
    let (drawn, surface_nodes) = surface_of(mesh);
    let thickness = 2.0 * mesh.volume() / area_of(&drawn);
    let shift = small_eigenvalue(&materials, thickness, largest_part(mesh));
    let solver_share = if parameters.is_large { 0.45 } else { 0.85 };
    let solver_progress = |share: f64, stage: &str| progress(0.1 + solver_share * share, stage);
    let mut modes = find_elastic_modes(&system, &rigid, shift, parameters.modes, &solver_progress)
        .map_err(|error| explain_hinges(error, mesh))?;
    remove_high_modes(&mut modes, parameters)?;
    let solid = StvkSolid::new(mesh, &numbered, clamps.free_nodes, &materials);
    let large_progress = |share: f64, stage: &str| progress(0.55 + 0.4 * share, stage);
    let add_large = || add_large_motion(&solid, &system, &rigid, shift, &mut modes, &large_progress);
    let large_motion = parameters.is_large.then(add_large).transpose()?;
    // Without clamps, all nodes are free, in their order.
    let is_free = parameters.clamps.is_empty();
    let mass_properties = is_free.then(|| mass_properties(&system, &mesh.positions, &modes));
    progress(0.95, "surface");
    let (low, high) = mesh.bounds();
    let mut modeling = Modeling {
        modes: rows_of(&modes, &surface_nodes, &clamps),
        mesh: drawn,
        freedoms,
        cell_size: mean_edge_length(mesh),
        tetrahedra: Some(mesh.elements.len()),
        group_materials: mesh.groups.iter().map(|group| group.name.clone()).zip(materials.clone()).collect(),
        parts: mesh.part_count,
        rigid_modes: rigid.len(),
        mass,
        mass_properties,
        size: (high - low).into(),
        damping_ratio: parameters.damping_ratio.unwrap_or_else(|| mean_damping_ratio(mesh, &materials)),
        remarks: mesh.remarks.clone(),
        large_motion,
        eigenvalues: modes.eigenvalues,
        residuals: modes.residuals,
        ..Modeling::default()
    };
    if mesh.raised_elements > 0 {
        let count = mesh.raised_elements;
        let text = "linear tetrahedra are raised to quadratic, because linear ones are too stiff in bending";
        modeling.remarks.push(format!("{count} {text}"));
    }
    modeling.remarks.extend(clamps.remarks);
    let diagonal = (high - low).norm();
    add_common_remarks(&materials, diagonal, parameters, modeling.rigid_modes, &mut modeling.remarks);
    Ok(modeling)
}

/// The material of each group: that of an option for the group, that of an option for the whole part, that of the file, or
/// the default.
fn materials_of(mesh: &VolumeMesh, parameters: &ModelingParameters) -> Result<Vec<Material>> {
    let names: Vec<String> = mesh.groups.iter().map(|group| group.name.clone()).collect();
    let chosen = parameters.materials_of(&names)?;
    let with_file = mesh.groups.iter().zip(chosen).map(|(group, chosen)| {
        let is_given =
            parameters.replaces_materials || parameters.group_materials.iter().any(|(name, _)| *name == group.name);
        group.material.clone().filter(|_| !is_given).unwrap_or(chosen)
    });
    Ok(with_file.collect())
}

fn check_freedoms(mesh: &VolumeMesh, freedoms: usize, parameters: &ModelingParameters) -> Result<()> {
    if freedoms <= parameters.freedoms {
        return Ok(());
    }
    let expected = format!(
        "at least {freedoms}, which this mesh of {} quadratic tetrahedra has (or a coarser mesh)",
        mesh.elements.len()
    );
    Err(invalid("--freedoms", expected, parameters.freedoms))
}

/// The nodes that clamps hold.
struct Clamps {
    /// The number of each node among the free ones, or [`HELD_NODE`].
    numbers: Vec<u32>,
    free_nodes: usize,
    remarks: Vec<String>,
}

impl Clamps {
    fn new(mesh: &VolumeMesh, parameters: &ModelingParameters) -> Result<Self> {
        let unit = parameters.unit.meters();
        let names: Vec<String> = mesh
            .groups
            .iter()
            .map(|group| group.name.clone())
            .chain(mesh.node_groups.iter().map(|group| group.name.clone()))
            .collect();
        let mut is_held = vec![false; mesh.positions.len()];
        for text in &parameters.clamps {
            let nodes = nodes_in(mesh, &Region::parse(text, &names)?, unit);
            if nodes.is_empty() {
                let (low, high) = mesh.bounds();
                let range = |axis: usize| {
                    let [low, high] = [low[axis], high[axis]].map(|coordinate| coordinate / unit);
                    format!("{} from {low:.4} to {high:.4}", ["x", "y", "z"][axis])
                };
                let expected = format!("a region with nodes of the mesh: {}", [0, 1, 2].map(range).join(", "));
                return Err(invalid(format!("--clamp '{text}'"), expected, "one without"));
            }
            nodes.into_iter().for_each(|node| is_held[node as usize] = true);
        }
        let mut clamps = Self { numbers: vec![HELD_NODE; is_held.len()], free_nodes: 0, remarks: Vec::new() };
        for (number, _) in clamps.numbers.iter_mut().zip(&is_held).filter(|(_, is_held)| !**is_held) {
            *number = clamps.free_nodes as u32;
            clamps.free_nodes += 1;
        }
        if clamps.free_nodes == 0 {
            return Err(invalid("--clamp", "a region that leaves a part of the body free", "one with the whole body"));
        }
        clamps.check_parts(mesh)?;
        clamps.remark_on_faces(mesh);
        clamps.remark_on_files(mesh, parameters);
        Ok(clamps)
    }

    fn is_held(&self, node: u32) -> bool {
        self.numbers[node as usize] == HELD_NODE
    }

    /// Fails if a part is held only at a point or at a line, about which it can turn.
    fn check_parts(&self, mesh: &VolumeMesh) -> Result<()> {
        let mut held_of_part: BTreeMap<u32, Vec<Vector3<f64>>> = BTreeMap::new();
        for (node, part) in mesh.node_parts.iter().enumerate().filter(|(node, _)| self.is_held(*node as u32)) {
            held_of_part.entry(*part).or_default().push(mesh.positions[node]);
        }
        for positions in held_of_part.values() {
            let center = positions.iter().sum::<Vector3<f64>>() / positions.len() as f64;
            let spread: Matrix3<f64> =
                positions.iter().map(|position| (position - center) * (position - center).transpose()).sum();
            let mut squares: [f64; 3] = spread.symmetric_eigenvalues().into();
            squares.sort_by(f64::total_cmp);
            let (low, high) = mesh.bounds();
            let tolerance = 1e-6 * (high - low).norm();
            if squares[1] <= positions.len() as f64 * tolerance.powi(2) {
                let expected = "at least three nodes that are not on a line, in each part that is held";
                return Err(invalid("--clamp", expected, format!("{} at a point or on a line", positions.len())));
            }
        }
        Ok(())
    }

    /// Single held nodes act like needles: the frequency depends on the mesh.
    fn remark_on_faces(&mut self, mesh: &VolumeMesh) {
        let held = self.numbers.len() - self.free_nodes;
        let is_face_held = |face: (u32, u8)| mesh.face_nodes(face).iter().all(|node| self.is_held(*node));
        let mut faces = (0..mesh.elements.len() as u32).flat_map(|element| (0..4).map(move |face| (element, face)));
        if held > 0 && !faces.any(is_face_held) {
            self.remarks.push(format!(
                "the clamps hold {held} nodes but no whole face of an element, so that frequencies depend on the mesh"
            ));
        }
    }

    /// Fixed vertices in a file beside the mesh are held on request only.
    fn remark_on_files(&mut self, mesh: &VolumeMesh, parameters: &ModelingParameters) {
        for group in mesh.node_groups.iter().filter(|group| group.name.ends_with(".bou")) {
            let clamp = format!("group {}", group.name);
            if !parameters.clamps.iter().any(|text| text.trim() == clamp) {
                self.remarks.push(format!("{} lists fixed vertices; --clamp '{clamp}' holds them", group.name));
            }
        }
    }
}

/// The nodes in a region.
fn nodes_in(mesh: &VolumeMesh, region: &Region, unit: f64) -> Vec<u32> {
    match region {
        Region::Group(index) => match (*index as usize).checked_sub(mesh.groups.len()) {
            Some(node_group) => mesh.node_groups[node_group].nodes.clone(),
            None => {
                let members = mesh.elements.iter().zip(&mesh.element_groups).filter(|(_, group)| *group == index);
                members.flat_map(|(element, _)| *element).collect()
            }
        },
        _ => {
            let contains = |node: &u32| region.contains(mesh.positions[*node as usize] / unit);
            (0..mesh.positions.len() as u32).filter(contains).collect()
        }
    }
}

/// The matrices of all elements.
fn element_matrices(mesh: &VolumeMesh, materials: &[Material]) -> Result<Vec<Tet10Matrices>> {
    let matrices_of = |element: usize| {
        let material = &materials[mesh.element_groups[element] as usize];
        // The mesh has no inverted elements, so this is an error of the program.
        tet10::matrices(&mesh.nodes_of(element), material).ok_or_else(|| fault("elements", "an inverted element"))
    };
    (0..mesh.elements.len()).into_par_iter().map(matrices_of).collect()
}

/// Adds a point mass to the element that contains it.
fn add_point_mass(
    mesh: &VolumeMesh,
    clamps: &Clamps,
    parameters: &ModelingParameters,
    mass: &PointMass,
    matrices: &mut [Tet10Matrices],
) -> Result<()> {
    let is_free = |(element, _): &(usize, _)| mesh.elements[*element].iter().any(|node| !clamps.is_held(*node));
    let position = mass.position * parameters.unit.meters();
    let Some((element, weights)) = find_element(mesh, position).filter(is_free) else {
        let [x, y, z]: [f64; 3] = mass.position.into();
        let expected = "a position at the body, outside of clamps";
        return Err(invalid("--point-mass", expected, format!("{x} {y} {z}")));
    };
    for (i, weight) in weights.iter().enumerate() {
        for (j, other) in weights.iter().enumerate() {
            matrices[element].mass[i * NODES + j] += mass.mass * weight * other;
        }
    }
    Ok(())
}

/// The element at a point, and the values of its shape functions there. `None` if the point is farther from all elements
/// than a fifth of an element.
fn find_element(mesh: &VolumeMesh, point: Vector3<f64>) -> Option<(usize, [f64; NODES])> {
    const MAX_OUTSIDE: f64 = 0.2;
    const CURVATURE_STEPS: usize = 8;
    let outside = |barycentric: &[f64; 4]| barycentric.iter().fold(0.0, |largest: f64, share| largest.max(-share));
    let of_element = |element: usize| {
        let nodes = mesh.nodes_of(element);
        let mut barycentric = [0.25; 4];
        // One step of Newton's method is exact for straight edges.
        for _ in 0..CURVATURE_STEPS {
            let values = tet10::shape_values(barycentric);
            let position: Vector3<f64> = nodes.iter().zip(values).map(|(node, value)| node * value).sum();
            let step = tet10::jacobian(&nodes, barycentric).try_inverse()? * (point - position);
            (0..3).for_each(|axis| barycentric[axis + 1] += step[axis]);
            barycentric[0] = 1.0 - barycentric[1..].iter().sum::<f64>();
            if step.amax() < 1e-12 || outside(&barycentric) > 2.0 {
                break;
            }
        }
        Some((element, barycentric))
    };
    let candidates = (0..mesh.elements.len()).into_par_iter().filter_map(of_element);
    let (element, barycentric) = candidates
        .min_by(|(first, a), (second, b)| outside(a).total_cmp(&outside(b)).then(first.cmp(second)))
        .filter(|(_, barycentric)| outside(barycentric) <= MAX_OUTSIDE)?;
    Some((element, tet10::shape_values(barycentric)))
}

/// The rigid motions of the parts without held nodes.
fn free_motions(mesh: &VolumeMesh, clamps: &Clamps) -> Vec<Vec<f64>> {
    let mut nodes_of_part = vec![BTreeMap::new(); mesh.part_count];
    let mut is_held = vec![false; mesh.part_count];
    for (node, part) in mesh.node_parts.iter().enumerate() {
        is_held[*part as usize] |= clamps.is_held(node as u32);
        nodes_of_part[*part as usize].insert(clamps.numbers[node] as usize, mesh.positions[node]);
    }
    let free = nodes_of_part.iter().zip(is_held).filter(|(_, is_held)| !is_held).map(|(nodes, _)| nodes);
    free.flat_map(|nodes| rigid_motions(3 * clamps.free_nodes, nodes)).collect()
}

/// The diagonal of the bounding box of the largest part, meters.
fn largest_part(mesh: &VolumeMesh) -> f64 {
    let mut positions_of_part = vec![Vec::new(); mesh.part_count];
    for (position, part) in mesh.positions.iter().zip(&mesh.node_parts) {
        positions_of_part[*part as usize].push(*position);
    }
    let diagonal = |positions: &Vec<Vector3<f64>>| {
        let (low, high) = bounds_of(positions.iter());
        (high - low).norm()
    };
    positions_of_part.iter().map(diagonal).fold(0.0, f64::max)
}

/// An error of the eigensolver for a mesh whose pieces can swing.
fn explain_hinges(error: Error, mesh: &VolumeMesh) -> Error {
    match mesh.hinged_pieces {
        0 => error,
        count => {
            let given = format!("{count} that other elements touch only at edges or points ({error})");
            invalid("mesh", "pieces that common faces connect", given)
        }
    }
}

/// U at the vertices of the surface: entry `(3 vertex + axis) * modes + mode`.
fn rows_of(modes: &ElasticModes, surface_nodes: &[u32], clamps: &Clamps) -> Vec<f32> {
    let rank = modes.vectors.len();
    let mut rows = vec![0.0; 3 * surface_nodes.len() * rank];
    for (vertex, node) in surface_nodes.iter().enumerate().filter(|(_, node)| !clamps.is_held(**node)) {
        let number = clamps.numbers[*node as usize] as usize;
        for axis in 0..3 {
            for (mode, vector) in modes.vectors.iter().enumerate() {
                rows[(3 * vertex + axis) * rank + mode] = vector[3 * number + axis] as f32;
            }
        }
    }
    rows
}

/// The mean distance of the ends of an edge, meters.
fn mean_edge_length(mesh: &VolumeMesh) -> f64 {
    let length = |element: &[u32; NODES], [a, b]: [usize; 2]| {
        (mesh.positions[element[b] as usize] - mesh.positions[element[a] as usize]).norm()
    };
    let sum: f64 = mesh.elements.iter().flat_map(|element| EDGES.map(|edge| length(element, edge))).sum();
    sum / (EDGES.len() * mesh.elements.len()) as f64
}

/// The damping ratio of the materials, weighted by mass.
fn mean_damping_ratio(mesh: &VolumeMesh, materials: &[Material]) -> f64 {
    let (mut sum, mut mass) = (0.0, 0.0);
    for (element, group) in mesh.element_groups.iter().enumerate() {
        let material = &materials[*group as usize];
        let [a, b, c, d, ..] = mesh.nodes_of(element);
        let element_mass = tet10::signed_volume([a, b, c, d]) * material.density;
        sum += element_mass * material.damping_ratio;
        mass += element_mass;
    }
    sum / mass
}
