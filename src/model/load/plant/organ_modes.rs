//! The modes of all organs of a plant: each organ carries at its joints the rigid inertia of everything beyond them.
//!
//! Copies of a leaf, rotated and scaled by s, are recognized by their beams. Their eigenproblem is solved once: eigenvalues
//! go as 1 / s^2 and U as s^-1.5. The copies do not share a shape, although a placement could rotate it: the frame of a
//! domain has the axes of the scene, the meshes of the file are similar only up to rounding, a scaled copy would need
//! scaled coordinates, and the mesh and the modes of a leaf are small.

use modalcast_beam::{Beam, BeamModes, RigidInertia, Similarity};
use nalgebra::{Rotation3, Vector3};
use rayon::prelude::*;

use super::skin::{Joint, Skin};
use crate::beam_shape::{inertia_of, lift_modes};
use crate::domain::{Mesh, Shape};
use crate::error::Result;
use crate::load::asset_dir::AssetDir;
use crate::load::plant_materials::PlantMaterials;
use crate::scene::SceneParts;

/// Modes of a shoot that is at least [`SLENDER`] times as long as thick: six bending modes per plane, or twist.
const SHOOT_MODES: usize = 12;

/// Modes of a stub, and of a petiole that carries leaflets: enough for any force and moment at one joint.
const STUB_MODES: usize = 6;

/// Modes of a leaf that carries nothing: two of bending and one of twist, or three of the blade.
const LEAF_MODES: usize = 3;

/// Ratio of length to mean diameter from which a shoot is not a stub.
const SLENDER: f64 = 20.0;

/// Largest deviation of a copy of a leaf, as a fraction of its size.
const COPY_TOLERANCE: f64 = 1e-3;

/// Most leaves that a leaf is compared with. Limits the time for a plant whose leaves all differ.
const MAX_ORIGINALS: usize = 64;

/// The kind of an organ.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OrganKind {
    Shoot,
    Leaf,
}

/// An organ with a beam.
#[derive(Debug)]
pub(super) struct FlexibleBody {
    /// In the frame of the domain. It has the own bodies, such as fruits.
    pub(super) beam: Beam,
    pub(super) skin: Skin,
}

/// An organ. Its index is that of its domain; parents are before their children.
#[derive(Debug)]
pub(super) struct OrganBody {
    pub(super) kind: OrganKind,
    /// Index of the parent.
    pub(super) parent: Option<usize>,
    /// Number of modes by the file; `None` for the default.
    pub(super) mode_count: Option<usize>,
    /// Origin of the frame in the scene, meters. All frames have the axes of the scene.
    pub(super) origin: Vector3<f64>,
    /// The beam, or why the organ is rigid.
    pub(super) flexible: Result<FlexibleBody, String>,
}

/// The modes of an organ: solved ones, those of a copy, or why it has none.
enum OrganModes {
    Solved(BeamModes),
    CopyOf(usize, Similarity),
    Rigid(String),
}

/// Adds modes, eigenvalues, inertia and attachment vertices to the domains of the organs, and a remark on rigid organs.
///
/// # Errors
/// `OutOfMemory`.
pub(super) fn add_modes(
    mut bodies: Vec<OrganBody>,
    materials: &PlantMaterials,
    files: &AssetDir,
    parts: &mut SceneParts,
) -> Result<()> {
    let joints = attach_children(&mut bodies, parts);
    let mut child_counts = vec![0_usize; bodies.len()];
    bodies.iter().filter_map(|body| body.parent).for_each(|parent| child_counts[parent] += 1);
    let copies = find_copies(&mut bodies, &child_counts);
    let own_inertias: Vec<RigidInertia> = bodies.par_iter().map(own_inertia).collect();
    carry_children(&mut bodies, &joints, &own_inertias);
    let ranks: Vec<usize> = (0..bodies.len()).map(|index| wanted_rank(&bodies[index], child_counts[index])).collect();
    let vertices = |index: usize| parts.shapes[parts.domains[index].shape].mesh.rest_positions().len();
    let bytes = ranks.iter().enumerate().map(|(index, rank)| 12 * (rank * vertices(index)) as u64).sum();
    files.reserve("modes of the plant", bytes)?;
    let solve = |(index, body): (usize, &OrganBody)| match (&body.flexible, copies[index]) {
        (Err(reason), _) => OrganModes::Rigid(reason.clone()),
        (Ok(_), Some((original, similarity))) => OrganModes::CopyOf(original, similarity),
        (Ok(flexible), None) => match flexible.beam.solve_modes(ranks[index]) {
            Ok(modes) => OrganModes::Solved(modes),
            Err(error) => OrganModes::Rigid(error.to_string()),
        },
    };
    let modes: Vec<OrganModes> = bodies.par_iter().enumerate().map(solve).collect();
    let results: Vec<Result<ModalBody, String>> = (0..bodies.len())
        .into_par_iter()
        .map(|index| match (&bodies[index].flexible, resolve(&modes, index)) {
            (Ok(flexible), Ok(modes)) => {
                let mesh = &parts.shapes[parts.domains[index].shape].mesh;
                ModalBody::new(flexible, &own_inertias[index], &modes, mesh).map_err(|error| error.to_string())
            }
            (Err(reason), _) => Err(reason.clone()),
            (_, Err(reason)) => Err(reason),
        })
        .collect();
    parts.remarks.extend(rigid_remark(&results, parts));
    store(results, &bodies, &joints, materials, parts);
    Ok(())
}

/// The modes of an organ, or why it has none.
fn resolve(modes: &[OrganModes], index: usize) -> Result<BeamModes, String> {
    match &modes[index] {
        OrganModes::Solved(modes) => Ok(modes.clone()),
        OrganModes::Rigid(reason) => Err(reason.clone()),
        OrganModes::CopyOf(original, similarity) => match &modes[*original] {
            OrganModes::Solved(modes) => Ok(modes.transformed(similarity)),
            _ => Err("the leaf of which it is a copy has no modes".into()),
        },
    }
}

/// Finds the section of the parent that carries each organ. A parent without such a section becomes rigid.
fn attach_children(bodies: &mut [OrganBody], parts: &SceneParts) -> Vec<Option<Joint>> {
    let mut joints = Vec::with_capacity(bodies.len());
    for index in 0..bodies.len() {
        let origin = bodies[index].origin;
        let joint = bodies[index].parent.and_then(|parent| {
            let base = origin - bodies[parent].origin;
            let positions = parts.shapes[parts.domains[parent].shape].mesh.rest_positions();
            let flexible = bodies[parent].flexible.as_mut().ok()?;
            let joint = flexible.skin.attach(&flexible.beam, positions, &base);
            if joint.is_none() {
                bodies[parent].flexible = Err("its vertices are collinear".into());
            }
            joint
        });
        joints.push(joint);
    }
    joints
}

/// For each leaf with modes that carries nothing, an earlier leaf that it is a copy of. The beam of the copy becomes exactly
/// similar.
fn find_copies(bodies: &mut [OrganBody], child_counts: &[usize]) -> Vec<Option<(usize, Similarity)>> {
    let mut copies = vec![None; bodies.len()];
    let mut originals: Vec<usize> = Vec::new();
    for index in 0..bodies.len() {
        let mode_count = bodies[index].mode_count;
        if bodies[index].kind != OrganKind::Leaf || child_counts[index] > 0 || mode_count == Some(0) {
            continue;
        }
        let Ok(flexible) = &bodies[index].flexible else { continue };
        let comparable = originals.iter().filter(|original| bodies[**original].mode_count == mode_count);
        let similar = comparable.into_iter().find_map(|original| {
            let other = bodies[*original].flexible.as_ref().ok()?;
            let similarity = other.beam.similarity_to(&flexible.beam, COPY_TOLERANCE)?;
            Some((*original, similarity, other.beam.transformed(&similarity, &flexible.beam.nodes()[0])))
        });
        match similar {
            Some((original, similarity, beam)) => {
                copies[index] = Some((original, similarity));
                if let Ok(flexible) = &mut bodies[index].flexible {
                    flexible.beam = beam;
                }
            }
            None if originals.len() < MAX_ORIGINALS => originals.push(index),
            None => {}
        }
    }
    copies
}

/// The inertia of an organ about its origin, without that of its children. A rigid organ has none.
fn own_inertia(body: &OrganBody) -> RigidInertia {
    body.flexible.as_ref().map_or(RigidInertia::zero(), |flexible| flexible.beam.rigid_inertia())
}

/// Gives each beam the rigid inertia of everything beyond each of its joints, from the leaves to the root.
fn carry_children(bodies: &mut [OrganBody], joints: &[Option<Joint>], own_inertias: &[RigidInertia]) {
    let mut carried = vec![RigidInertia::zero(); bodies.len()];
    for index in (0..bodies.len()).rev() {
        let total = own_inertias[index] + carried[index];
        let Some(parent) = bodies[index].parent else { continue };
        let base = bodies[index].origin - bodies[parent].origin;
        carried[parent] = carried[parent] + total.seen_from(&Rotation3::identity(), &base);
        if let (Ok(flexible), Some(joint)) = (&mut bodies[parent].flexible, &joints[index]) {
            let arm = base - flexible.beam.center(joint.station);
            flexible.beam.carry(joint.station, total.seen_from(&Rotation3::identity(), &arm));
        }
    }
}

/// The number of modes of an organ.
fn wanted_rank(body: &OrganBody, child_count: usize) -> usize {
    let Ok(FlexibleBody { beam, .. }) = &body.flexible else { return 0 };
    if let Some(count) = body.mode_count {
        return count;
    }
    match body.kind {
        OrganKind::Leaf if child_count == 0 => LEAF_MODES,
        OrganKind::Leaf => STUB_MODES,
        OrganKind::Shoot => {
            let areas = beam.nodes().windows(2).zip(beam.elements());
            let volume: f64 =
                areas.map(|(ends, element)| (ends[1] - ends[0]).norm() * element.profile.mean_area()).sum();
            let mean_diameter = 2.0 * (volume / beam.length() / std::f64::consts::PI).sqrt();
            if beam.length() >= SLENDER * mean_diameter { SHOOT_MODES } else { STUB_MODES }
        }
    }
}

/// A remark on the organs without modes, with the first few.
fn rigid_remark(results: &[Result<ModalBody, String>], parts: &SceneParts) -> Option<String> {
    const LISTED: usize = 3;
    let reasons = results.iter().zip(&parts.domains).filter_map(|(result, domain)| {
        let reason = result.as_ref().err()?;
        Some(format!("{} ({reason})", domain.name))
    });
    let reasons: Vec<String> = reasons.collect();
    let listed = reasons[..reasons.len().min(LISTED)].join(", ");
    let rest = if reasons.len() > LISTED { ", ..." } else { "" };
    let text = || format!("{} of {} organs are rigid: {listed}{rest}", reasons.len(), results.len());
    (!reasons.is_empty()).then(text)
}

/// The shape and metadata of a flexible organ.
struct ModalBody {
    shape: Shape,
    eigenvalues: Vec<f64>,
    inertia: crate::domain::Inertia,
    notes: Vec<(&'static str, String)>,
}

impl ModalBody {
    fn new(flexible: &FlexibleBody, own_inertia: &RigidInertia, modes: &BeamModes, mesh: &Mesh) -> Result<Self> {
        let FlexibleBody { beam, skin } = flexible;
        let lifted = lift_modes(beam, modes, mesh.rest_positions(), &skin.stations)?;
        let inertia = inertia_of(own_inertia, &beam.modal_inertia(modes))?;
        let carried_mass: f64 = beam.carried_bodies().iter().map(|(_, body)| body.mass()).sum();
        let notes = vec![
            ("length", format!("{:.5}", beam.length())),
            ("mass", format!("{:.3e}", inertia.mass())),
            ("carried_mass", format!("{carried_mass:.3e}")),
            // U^T M U = I with the own mass and the carried rigid bodies in M. U is in 1/sqrt(kg).
            ("mass_normalized", "true".into()),
            ("q_unit", "m sqrt(kg)".into()),
        ];
        Ok(Self { shape: Shape::new(mesh.clone(), lifted)?, eigenvalues: modes.eigenvalues.clone(), inertia, notes })
    }
}

/// Stores the results in the domains.
fn store(
    results: Vec<Result<ModalBody, String>>,
    bodies: &[OrganBody],
    joints: &[Option<Joint>],
    materials: &PlantMaterials,
    parts: &mut SceneParts,
) {
    let is_flexible: Vec<bool> = results.iter().map(Result::is_ok).collect();
    for (index, result) in results.into_iter().enumerate() {
        let domain = &mut parts.domains[index];
        if let (Some(attachment), Some(joint)) = (&mut domain.attachment, &joints[index])
            && is_flexible[attachment.parent]
        {
            attachment.vertices.clone_from(&joint.vertices);
        }
        let Ok(ModalBody { shape, eigenvalues, inertia, notes }) = result else { continue };
        parts.shapes[domain.shape] = shape;
        domain.metadata.eigenvalues = eigenvalues;
        domain.metadata.inertia = Some(inertia);
        domain.metadata.notes.extend(notes.into_iter().map(|(name, text)| (name.to_owned(), text)));
        let [wood_damping, leaf_damping] = materials.damping();
        let damping = if bodies[index].kind == OrganKind::Shoot { wood_damping } else { leaf_damping };
        domain.metadata.notes.insert("damping_ratio".into(), damping.to_string());
    }
}
