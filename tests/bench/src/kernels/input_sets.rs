//! Parts that the trials share: inputs of several steps on the device, and the rest of a deformation on the host.

use std::cell::Cell;
use std::sync::Arc;

use rayon::prelude::*;
use serde::Serialize;

use modalcast_compute::gpu::Device;
use modalcast_compute::gpu::launch::DeviceBuffer;
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, SceneState};

/// The part of a step that a trial launches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// u = U q alone. For validation, the host computes x = T (x0 + u) in f64.
    Uq,
    /// u = U q and the vertex update.
    Whole,
}

impl Part {
    /// The name of a trial that launches this part.
    pub(super) fn named(self, name: &str) -> String {
        match self {
            Self::Uq => format!("{name}_uq"),
            Self::Whole => name.to_owned(),
        }
    }
}

/// Minimum of vertices per parallel task on the host.
const SHARE: usize = 4096;

/// Device addresses of the inputs of one turn.
#[derive(Debug, Clone, Copy)]
pub(super) struct InputAddresses {
    pub q: u64,
    pub transforms: u64,
}

/// The inputs of several steps (turns) of a scene, on the device and on the host.
#[derive(Debug)]
pub(super) struct InputSets {
    scene: Arc<Scene>,
    states: Vec<SceneState>,
    q: DeviceBuffer,
    transforms: DeviceBuffer,
    /// Bytes from one turn to the next, of q and of the transforms.
    strides: [u64; 2],
    last: Cell<usize>,
}

impl InputSets {
    /// Uploads q and transforms of each state as packed by `pack`, which must return equal lengths for all states.
    ///
    /// # Errors
    /// `Invalid` when there is no state or a state does not fit the scene; `Fault` when the device fails.
    pub(super) fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[SceneState],
        pack: impl Fn(&SceneState) -> [Vec<f32>; 2],
    ) -> Result<Self> {
        if states.is_empty() {
            return Err(invalid("states", "at least 1", 0));
        }
        let fits = |state: &&SceneState| {
            state.q.len() != scene.layout.coordinates || state.transforms.len() != scene.movers.count()
        };
        if let Some(wrong) = states.iter().find(fits) {
            let expected = format!("{} coordinates, {} transforms", scene.layout.coordinates, scene.movers.count());
            let given = format!("{} and {}", wrong.q.len(), wrong.transforms.len());
            return Err(invalid("states", expected, given));
        }
        let [mut q, mut transforms] = [Vec::new(), Vec::new()];
        for state in states {
            let packed = pack(state);
            for (all, one) in [&mut q, &mut transforms].into_iter().zip(packed) {
                all.extend_from_slice(&one);
                // Turns are aligned to float4.
                all.resize(all.len().next_multiple_of(4), 0.0);
            }
        }
        let strides = [&q, &transforms].map(|all| 4 * (all.len() / states.len()) as u64);
        let (q, transforms) = (DeviceBuffer::upload(device, &q)?, DeviceBuffer::upload(device, &transforms)?);
        let (scene, states) = (Arc::clone(scene), states.to_vec());
        Ok(Self { scene, states, q, transforms, strides, last: Cell::new(0) })
    }

    pub(super) const fn count(&self) -> usize {
        self.states.len()
    }

    /// The inputs of a turn. Records it as the last turn.
    pub(super) fn start(&self, turn: usize) -> InputAddresses {
        let turn = turn % self.states.len();
        self.last.set(turn);
        let [q, transforms] = self.strides.map(|stride| stride * turn as u64);
        InputAddresses { q: self.q.address() + q, transforms: self.transforms.address() + transforms }
    }

    /// x = T (x0 + u) of the last turn, in f64 and rounded once, so that only the error of u remains. Three f32 per
    /// vertex.
    pub(super) fn finish_on_host(&self, u: impl Fn(usize, usize) -> [f32; 3] + Sync) -> Vec<f32> {
        let state = &self.states[self.last.get()];
        let mut positions = Vec::with_capacity(3 * self.scene.layout.vertices);
        let mut placed: Vec<[f32; 3]> = Vec::new();
        for domain in 0..self.scene.domains.len() {
            let t = state.composed_transform(&self.scene, domain).exact();
            let place = |(vertex, rest): (usize, &[f32; 3])| {
                let u = u(domain, vertex);
                let [x, y, z] = [0, 1, 2].map(|axis| f64::from(rest[axis]) + f64::from(u[axis]));
                let row = |row: usize| t[4 * row] * x + t[4 * row + 1] * y + t[4 * row + 2] * z + t[4 * row + 3];
                [0, 1, 2].map(|axis| row(axis) as f32)
            };
            let rest = self.scene.shape_of(domain).mesh.rest().par_iter().enumerate();
            rest.with_min_len(SHARE).map(place).collect_into_vec(&mut placed);
            positions.extend_from_slice(placed.as_flattened());
        }
        positions
    }
}
