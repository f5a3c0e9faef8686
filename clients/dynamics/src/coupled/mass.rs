//! The matrix of one step, (M + dt/2 C + dt^2/4 K), and its factorization. The six motions of every frame are unknowns
//! in addition to q, because M in q alone has an entry for every pair of an ancestor and a descendant.
//!
//! The block of a body is [[F, B], [B^T, S]] with F = R^T M R, B = R^T M U and S = U^T M U + dt/2 C + dt^2/4 K. The
//! elimination goes from the leaves to the roots. It eliminates the coordinates of a body, which leaves the Schur
//! complement F - B S^-1 B^T, and then the frame of the body, which adds [G H]^T (F - B S^-1 B^T) [G H] to the block of
//! the parent.

use nalgebra::{DMatrix, Matrix6, Vector6};
use rayon::prelude::*;

use super::joints::{Body, FrameMotion, JointTree};
use crate::affine::nearest_rotation;
use crate::error::{Result, invalid_input};
use crate::model::{DomainInertia, DomainModel, MIN_DOMAINS_PER_THREAD, Model};

/// Largest deviation of a placement's entries from those of a rotation. Mass properties do not say how a scale changes
/// them.
const ROTATION_TOLERANCE: f64 = 1e-3;

/// The smallest pivot of a factorization as a fraction of the diagonal entry. Heavy descendants leave rounding errors of
/// this size in the mass of a light body.
const MIN_PIVOT: f64 = 1e-15;

/// A pivot below the negative of this fraction of the diagonal entry is no rounding error.
const MAX_NEGATIVE_PIVOT: f64 = 1e-6;

/// Terms of a coordinate on the diagonal of M + dt/2 C + dt^2/4 K. `None` for a coordinate that is held still.
pub(super) type Diagonal = Option<f64>;

/// The block of a body: mass properties about its origin, in world axes at rest.
#[derive(Debug, Clone)]
pub(super) struct Block {
    /// F.
    rigid: Matrix6<f64>,
    /// The columns of B.
    coupling: Vec<Vector6<f64>>,
    /// S.
    modal: DMatrix<f64>,
}

/// The factors of a body's block.
#[derive(Debug, Clone)]
pub(super) struct Factor {
    /// The rows of the lower triangle of L with S = L L^T, with the reciprocals of the diagonal entries.
    rows: Vec<f64>,
    /// The columns of B S^-1.
    pub(super) frame_response: Vec<Vector6<f64>>,
}

impl Block {
    fn zeros(rank: usize) -> Self {
        Self { rigid: Matrix6::zeros(), coupling: vec![Vector6::zeros(); rank], modal: DMatrix::zeros(rank, rank) }
    }

    /// The mass of a domain. A domain without mass properties has a massless frame, and modes of unit mass.
    fn of_domain(domain: &DomainModel) -> Result<Self> {
        let rank = domain.rank;
        let Some(DomainInertia { rigid, coupling, modal }) = &domain.inertia else {
            let unit_masses = if domain.owns_q { 1.0 } else { 0.0 };
            return Ok(Self { modal: DMatrix::identity(rank, rank) * unit_masses, ..Self::zeros(rank) });
        };
        if coupling.len() != rank || modal.shape() != (rank, rank) {
            let field = format!("inertia of '{}'", domain.name);
            return Err(invalid_input(field, format!("{rank} modes"), format!("{} modes", coupling.len())));
        }
        let linear = domain.placement.linear;
        let rotation = nearest_rotation(&linear);
        let is_rotation = (linear - rotation).abs().max() <= ROTATION_TOLERANCE;
        if !is_rotation {
            let field = format!("placement of '{}', which has an inertia", domain.name);
            return Err(invalid_input(field, "a rotation and a translation", format!("the matrix {linear:?}")));
        }
        let mut axes = Matrix6::zeros();
        [0, 3].into_iter().for_each(|start| axes.fixed_view_mut::<3, 3>(start, start).copy_from(&rotation));
        Ok(Self {
            rigid: axes * rigid * axes.transpose(),
            coupling: coupling.iter().map(|momentum| axes * momentum).collect(),
            modal: modal.clone(),
        })
    }

    /// R^T M R.
    pub(super) const fn rigid(&self) -> &Matrix6<f64> {
        &self.rigid
    }

    /// U^T M R X: the momenta of the coordinates of the body while its frame moves by X.
    pub(super) fn modal_momenta(&self, motion: &Vector6<f64>) -> impl Iterator<Item = f64> {
        self.coupling.iter().map(|coupling| coupling.dot(motion))
    }

    /// Adds the block of a frame that moves by G X + H q: the terms of the same kinetic energy. `other.coupling` and
    /// `other.modal` are in the coordinates of this body.
    fn add(&mut self, frame: &FrameMotion, other: &Self) {
        let transport = frame.matrix();
        self.rigid += transport.transpose() * other.rigid * transport;
        // F H: the momentum of the frame per unit rate of a coordinate.
        let momenta: Vec<Vector6<f64>> = frame.modes.iter().map(|mode| other.rigid * mode).collect();
        let zero = Vector6::zeros();
        for (mode, coupling) in self.coupling.iter_mut().enumerate() {
            let momentum = momenta.get(mode).unwrap_or(&zero) + other.coupling.get(mode).unwrap_or(&zero);
            *coupling += frame.transport_back(&momentum);
        }
        for (column, mode) in frame.modes.iter().enumerate() {
            for (row, momentum) in momenta.iter().enumerate() {
                self.modal[(row, column)] += momentum.dot(mode);
            }
            for (row, coupling) in other.coupling.iter().enumerate() {
                let product = coupling.dot(mode);
                self.modal[(row, column)] += product;
                self.modal[(column, row)] += product;
            }
        }
        if !other.modal.is_empty() {
            self.modal += &other.modal;
        }
    }

    /// Adds the terms of damping and stiffness, and removes the coordinates that are held still.
    fn add_diagonal(&mut self, diagonal: &[Diagonal]) {
        for (mode, term) in diagonal.iter().enumerate() {
            match term {
                Some(term) => self.modal[(mode, mode)] += term,
                None => {
                    self.coupling[mode] = Vector6::zeros();
                    self.modal.row_mut(mode).fill(0.0);
                    self.modal.column_mut(mode).fill(0.0);
                    self.modal[(mode, mode)] = 1.0;
                }
            }
        }
    }

    /// Factors S. Returns the factors and the Schur complement of S. `None` if S is not positive definite.
    fn factor(&self) -> Option<(Factor, Matrix6<f64>)> {
        let rank = self.coupling.len();
        let mut rows: Vec<f64> = Vec::with_capacity(rank * (rank + 1) / 2);
        // The columns of B L^-T.
        let mut halves: Vec<Vector6<f64>> = Vec::with_capacity(rank);
        let mut complement = self.rigid;
        for row in 0..rank {
            let start = rows.len();
            let diagonal = self.modal[(row, row)];
            let (mut pivot, mut half) = (diagonal, self.coupling[row]);
            for column in 0..row {
                let other = column * (column + 1) / 2;
                let products = rows[start..].iter().zip(&rows[other..other + column]).map(|(a, b)| a * b);
                let entry = (self.modal[(row, column)] - products.sum::<f64>()) * rows[other + column];
                pivot -= entry * entry;
                half -= halves[column] * entry;
                rows.push(entry);
            }
            let is_valid = diagonal > 0.0 && diagonal.is_finite() && pivot >= -MAX_NEGATIVE_PIVOT * diagonal;
            if !is_valid {
                return None;
            }
            let reciprocal = pivot.max(MIN_PIVOT * diagonal).sqrt().recip();
            rows.push(reciprocal);
            half *= reciprocal;
            complement -= half * half.transpose();
            halves.push(half);
        }
        let mut factor = Factor { rows, frame_response: halves };
        factor.finish_frame_response();
        Some((factor, complement))
    }
}

impl Factor {
    /// Turns the columns of B L^-T into those of B S^-1 = B L^-T L^-1.
    fn finish_frame_response(&mut self) {
        for row in (0..self.frame_response.len()).rev() {
            let start = row * (row + 1) / 2;
            let solved = self.frame_response[row] * self.rows[start + row];
            self.frame_response[row] = solved;
            for column in 0..row {
                self.frame_response[column] -= solved * self.rows[start + column];
            }
        }
    }

    /// Replaces `forces` by S^-1 times them.
    pub(super) fn solve(&self, forces: &mut [f64]) {
        let mut start = 0;
        for row in 0..forces.len() {
            let products = self.rows[start..start + row].iter().zip(&forces[..row]).map(|(a, b)| a * b);
            forces[row] = (forces[row] - products.sum::<f64>()) * self.rows[start + row];
            start += row + 1;
        }
        for row in (0..forces.len()).rev() {
            start -= row + 1;
            let solved = forces[row] * self.rows[start + row];
            let (earlier, rest) = forces.split_at_mut(row);
            rest[0] = solved;
            for (force, entry) in earlier.iter_mut().zip(&self.rows[start..start + row]) {
                *force -= entry * solved;
            }
        }
    }
}

/// Factors the matrix of a step. `diagonal` has dt/2 C + dt^2/4 K per coordinate of the scene. Returns the factors of
/// all bodies, and the Schur complements of the roots.
///
/// # Errors
/// `Invalid` if the mass properties of a domain do not fit to its modes or its placement, or are not positive definite.
pub(super) fn factor_bodies(
    model: &Model,
    tree: &JointTree,
    diagonal: &[Diagonal],
) -> Result<(Vec<Factor>, Vec<Matrix6<f64>>)> {
    let mut blocks = assemble_blocks(model, tree)?;
    let mut factors: Vec<Factor> = vec![];
    // The Schur complements of the bodies from `level.end` on.
    let mut complements = vec![Matrix6::zeros(); blocks.len()];
    for level in tree.levels.iter().rev() {
        let factor_body = |block: &mut Block, body: &Body| {
            for child in body.children.clone() {
                let complement = Block { rigid: complements[child], ..Block::zeros(0) };
                if let Some(joint) = &tree.bodies[child].joint {
                    block.add(joint, &complement);
                }
            }
            block.add_diagonal(&diagonal[body.first_coordinate..][..body.rank]);
            block.factor()
        };
        let bodies = blocks[level.clone()].par_iter_mut().with_min_len(MIN_DOMAINS_PER_THREAD);
        let results: Vec<_> =
            bodies.zip(&tree.bodies[level.clone()]).map(|(block, body)| factor_body(block, body)).collect();
        for (body, result) in level.clone().zip(results).rev() {
            let (factor, complement) = result.ok_or_else(|| indefinite_error(model, tree, body))?;
            complements[body] = complement;
            factors.push(factor);
        }
    }
    factors.reverse();
    complements.truncate(tree.levels.first().map_or(0, std::ops::Range::len));
    Ok((factors, complements))
}

/// The blocks of all bodies without their children: M.
pub(super) fn assemble_blocks(model: &Model, tree: &JointTree) -> Result<Vec<Block>> {
    let mut blocks: Vec<Block> = tree.bodies.iter().map(|body| Block::zeros(body.rank)).collect();
    for (domain, frame) in model.domains.iter().zip(&tree.frames) {
        blocks[frame.body].add(frame, &Block::of_domain(domain)?);
    }
    Ok(blocks)
}

fn indefinite_error(model: &Model, tree: &JointTree, body: usize) -> crate::error::Error {
    let domain = tree.frames.iter().position(|frame| frame.body == body);
    let name = domain.map_or("", |domain| model.domains[domain].name.as_str());
    let expected = "mass properties of positive energy in every motion";
    invalid_input(format!("inertia of '{name}' and of its descendants"), expected, "a negative or infinite energy")
}
