//! What the trials share: the values of several steps on the device, and the end of a deformation on the host.

use std::cell::Cell;
use std::sync::Arc;

use cudarc::driver::CudaSlice;
use rayon::prelude::*;
use serde::Serialize;

use super::super::device::Device;
use super::super::memory::{address, upload};
use modalcast_model::error::{Result, invalid};
use modalcast_model::scene::{Scene, State};

/// Which part of a step a trial launches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Part {
    /// u = U q alone. For the judge, x = T (x0 + u) follows on the host, in f64.
    Uq,
    /// The vertex update too.
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

/// The fewest vertices that a core places on the host at a time.
const SHARE: usize = 4096;

/// The values of one turn, as addresses on the device.
#[derive(Debug, Clone, Copy)]
pub(super) struct Values {
    pub q: u64,
    pub transforms: u64,
}

/// The values of several steps of a scene, on the device and on the host.
#[derive(Debug)]
pub(super) struct Turns {
    scene: Arc<Scene>,
    states: Vec<State>,
    q: CudaSlice<u8>,
    transforms: CudaSlice<u8>,
    /// Bytes from one turn to the next: of q and of the transforms.
    strides: [u64; 2],
    last: Cell<usize>,
}

impl Turns {
    /// Uploads q and transforms of each state as `pack` lays them out; each must give all states the same length.
    ///
    /// # Errors
    /// `Invalid` when there is no state or one is not of this scene; `Fault` when the device refuses.
    pub(super) fn new(
        device: &Device,
        scene: &Arc<Scene>,
        states: &[State],
        pack: impl Fn(&State) -> [Vec<f32>; 2],
    ) -> Result<Self> {
        if states.is_empty() {
            return Err(invalid("states", "at least 1", 0));
        }
        let fits = |state: &&State| {
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
                // Turns begin where a float4 may.
                all.resize(all.len().next_multiple_of(4), 0.0);
            }
        }
        let strides = [&q, &transforms].map(|all| 4 * (all.len() / states.len()) as u64);
        let (q, transforms) = (upload(device, &q)?, upload(device, &transforms)?);
        let (scene, states) = (Arc::clone(scene), states.to_vec());
        Ok(Self { scene, states, q, transforms, strides, last: Cell::new(0) })
    }

    pub(super) const fn count(&self) -> usize {
        self.states.len()
    }

    /// The values of a turn, which is remembered as the last.
    pub(super) fn start(&self, device: &Device, turn: usize) -> Values {
        let turn = turn % self.states.len();
        self.last.set(turn);
        let [q, transforms] = self.strides.map(|stride| stride * turn as u64);
        Values { q: address(device, &self.q) + q, transforms: address(device, &self.transforms) + transforms }
    }

    /// x = T (x0 + u) of the last turn, in f64 and rounded once, so that the error of u alone is left.
    pub(super) fn finish_on_host(&self, u: impl Fn(usize, usize) -> [f32; 3] + Sync) -> Vec<f32> {
        let state = &self.states[self.last.get()];
        let mut positions = Vec::with_capacity(3 * self.scene.layout.vertices);
        let mut placed: Vec<[f32; 3]> = Vec::new();
        for domain in 0..self.scene.domains.len() {
            let t = state.composed(&self.scene, domain).exact();
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

#[cfg(test)]
pub(in super::super) mod tests {
    use super::*;
    use modalcast_model::domain::{Corners, Domain, Material, Mesh, Metadata, Modes, Shape, Transform};
    use modalcast_model::scene::Parts;

    /// Numbers between -1 and 1 that repeat (a linear congruential generator).
    pub(in super::super::super) struct Random(pub(in super::super::super) u64);

    impl Random {
        pub(in super::super::super) fn number(&mut self) -> f32 {
            self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (self.0 >> 40) as f32 / (1 << 23) as f32 - 1.0
        }
    }

    fn shape(random: &mut Random, vertices: usize, rank: usize, triangles: usize) -> Shape {
        let rest = (0..vertices).map(|_| [0; 3].map(|_| random.number())).collect();
        let corners = Corners {
            vertices: (0..vertices as u32).collect(),
            normals: (0..vertices).map(|_| [0; 3].map(|_| random.number())).collect(),
            uvs: Vec::new(),
        };
        let corner = |index: usize| (index % vertices) as u32;
        let triangles = (0..triangles).map(|first| [3 * first, 3 * first + 1, 3 * first + 2].map(corner)).collect();
        let entries = (0..3 * vertices * rank).map(|_| random.number()).collect();
        let modes = Modes::from_columns(3 * vertices, rank, entries).expect("modes");
        Shape::new(Mesh::new(rest, corners, triangles).expect("a mesh"), modes).expect("a shape")
    }

    /// One domain of each (vertices, rank, triangles), and a state of it.
    pub(in super::super::super) fn scene(shapes: &[(usize, usize, usize)]) -> (Arc<Scene>, State) {
        let mut random = Random(shapes.len() as u64);
        let mut parts = Parts::named("trial");
        parts.materials = vec![Material::default()];
        for (index, (vertices, rank, triangles)) in shapes.iter().enumerate() {
            parts.shapes.push(shape(&mut random, *vertices, *rank, *triangles));
            parts.domains.push(Domain {
                name: String::new(),
                shape: index,
                material: 0,
                runs: Vec::new(),
                placement: Transform::IDENTITY,
                attachment: None,
                follows: None,
                rest_q: Vec::new(),
                shares_q_with: None,
                metadata: Metadata::default(),
            });
        }
        let scene = Scene::new(parts).expect("a scene");
        let mut state = State::rest(&scene);
        state.q.iter_mut().for_each(|coordinate| *coordinate = random.number());
        state.transforms.iter_mut().for_each(|transform| transform.0 = [0; 12].map(|_| random.number()));
        (scene, state)
    }

    /// u of a vertex, in f64.
    pub(in super::super) fn u_of(scene: &Scene, state: &State, domain: usize, vertex: usize) -> [f64; 3] {
        let modes = &scene.shape_of(domain).modes;
        let q = state.q_of(scene, domain);
        [0, 1, 2].map(|axis| {
            q.iter().enumerate().map(|(mode, q)| f64::from(modes.at(vertex, axis, mode)) * f64::from(*q)).sum()
        })
    }

    /// x = T (x0 + u) of a vertex, in f64.
    pub(in super::super) fn x_of(scene: &Scene, state: &State, domain: usize, vertex: usize) -> [f64; 3] {
        let (u, rest) = (u_of(scene, state, domain, vertex), scene.shape_of(domain).mesh.rest()[vertex]);
        let (linear, offset) = (state.transforms[domain].linear(), state.transforms[domain].translation());
        let bent = nalgebra::Vector3::from([0, 1, 2].map(|axis| f64::from(rest[axis]) + u[axis]));
        (linear * bent + offset).into()
    }
}
