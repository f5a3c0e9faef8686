//! The input values of a step and their upload. The host writes them once to pinned memory, in the layout of the device
//! buffer; several cores write large steps.
//!
//! ```text
//! [header][transforms: 12 f32 per transform root][q, padded to whole chunks of modes][kept chunks of each domain]
//! ```
//! The kept chunks are present only with truncation. The pinned memory is write-combined: the host writes it from front
//! to back and never reads it.

use std::sync::Arc;

use cudarc::driver::{CudaSlice, PinnedHostSlice, result};
use rayon::prelude::*;

use super::device::Device;
use super::layout::{Following, Header};
use super::memory::{address, room, upload};
use super::staging::{Front, fill_parts};
use super::work::Coordinates;
use crate::storage::{Amounts, Truncation, bound, modes_per_chunk, reaches};
use modalcast_model::error::{Result, during};
use modalcast_model::scene::{Scene, State};

/// Layout of a scene's modal coordinates on the device.
#[derive(Debug)]
pub struct Packing {
    pub scene: Arc<Scene>,
    pub coordinates: Coordinates,
    /// Per shape, the factors of its modes; empty unless the storage has factors.
    pub factors: Vec<Vec<f32>>,
    pub listing: Listing,
}

/// Tiles of each domain, from which a partial step derives its tile list.
#[derive(Debug, Default)]
pub struct Listing {
    /// Per domain, first tile and tile count: of tiles with vertices, and of tiles with corners alone.
    pub spans: Vec<[(u32, u32); 2]>,
    /// Number of all tiles.
    pub tiles: usize,
    /// Cost of a full step in tiles, the limit of a partial step. A batched tile counts as several, because a batch
    /// reads U once but computes every member.
    pub whole: usize,
}

/// Device addresses of a step's values.
#[derive(Debug, Clone, Copy)]
pub struct Values {
    pub header: u64,
    pub transforms: u64,
    /// Constant: each follower's transform root and frame. Only in scenes with followers.
    pub following: u64,
    pub frames: u64,
    pub q: u64,
    /// Per domain, the step that last changed it.
    pub stamps: u64,
    /// 0 without truncation.
    pub kept_counts: u64,
    pub kept: u64,
}

/// Sizes of the parts in bytes, in buffer order.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sizes {
    pub transforms: u64,
    pub q: u64,
    pub kept_counts: u64,
    pub kept: u64,
}

impl Sizes {
    pub(super) fn of(scene: &Scene, coordinates: &Coordinates) -> Self {
        let domains = scene.domains.len() as u64;
        let (truncation, per_chunk) = (scene.needs.truncation, modes_per_chunk(scene.deformation.storage));
        Self {
            transforms: 48 * scene.movers.count() as u64,
            q: 4 * coordinates.total as u64,
            kept_counts: if truncation { 4 * domains.next_multiple_of(4) } else { 0 },
            kept: if truncation { 2 * (coordinates.total / per_chunk).next_multiple_of(8) as u64 } else { 0 },
        }
    }

    pub(super) const fn total(self) -> u64 {
        size_of::<Header>() as u64 + self.transforms + self.q + self.kept_counts + self.kept
    }
}

/// The device buffers of a step's values, and their writer.
#[derive(Debug)]
pub struct Inputs {
    writer: Writer,
    buffer: CudaSlice<u8>,
    stamps: CudaSlice<u8>,
    following: CudaSlice<u8>,
    frames: CudaSlice<u8>,
    sizes: Sizes,
}

/// Pinned staging buffer for the values of one step.
pub type Pinned = PinnedHostSlice<f32>;

impl Inputs {
    pub fn new(device: &Device, packing: &Arc<Packing>) -> Result<Self> {
        let sizes = Sizes::of(&packing.scene, &packing.coordinates);
        Ok(Self {
            writer: Writer::new(packing),
            buffer: room(device, sizes.total())?,
            stamps: room(device, 4 * packing.scene.domains.len() as u64)?,
            following: upload(device, &following(&packing.scene))?,
            frames: upload(device, packing.scene.movers.frames())?,
            sizes,
        })
    }

    /// Allocates a staging buffer for the values of a step.
    pub fn pinned(&self, device: &Device) -> Result<Pinned> {
        // SAFETY: the contents of the memory are uninitialized; `write` writes all of it before the first copy reads
        // it.
        unsafe { device.context().alloc_pinned(self.sizes.total() as usize / 4) }.map_err(during("allocate"))
    }

    pub fn values(&self, device: &Device) -> Values {
        let header = address(device, &self.buffer);
        let transforms = header + size_of::<Header>() as u64;
        let q = transforms + self.sizes.transforms;
        let kept_counts = q + self.sizes.q;
        let kept = kept_counts + self.sizes.kept_counts;
        let [stamps, following, frames] =
            [&self.stamps, &self.following, &self.frames].map(|buffer| address(device, buffer));
        Values { header, transforms, following, frames, q, stamps, kept_counts, kept }
    }

    /// Writes a full step. The caller has waited for the last copy from this memory, so nothing reads it.
    pub fn write(&mut self, to: &mut Pinned, header: &Header, state: &State) -> Result<()> {
        self.writer.write(to.as_mut_slice().map_err(during("upload"))?, header, state);
        Ok(())
    }

    /// Writes only the header.
    pub(super) fn write_header(to: &mut Pinned, header: &Header) -> Result<()> {
        Front::new(to.as_mut_slice().map_err(during("upload"))?).put(std::slice::from_ref(header));
        Ok(())
    }

    /// Starts the copy of the first `bytes` bytes, or of all with `None`.
    pub fn send(&self, device: &Device, from: &mut Pinned, bytes: Option<usize>) -> Result<()> {
        let fail = during("upload");
        let (to, host) = (address(device, &self.buffer), from.as_mut_slice().map_err(&fail)?);
        let bytes = bytes.unwrap_or(size_of_val(host));
        // SAFETY: the staging buffer and `self.buffer` have `bytes` bytes and outlive the copy: the deformer waits for
        // the copy before it writes the staging buffer again and before it drops it. A graph that contains the copy is
        // dropped first.
        let sent = unsafe {
            let host = std::slice::from_raw_parts(host.as_ptr().cast::<u8>(), bytes);
            result::memcpy_htod_async(to, host, device.stream().cu_stream())
        };
        sent.map_err(fail)
    }

    /// Bytes that a full step copies.
    pub const fn bytes(&self) -> u64 {
        self.sizes.total()
    }

    /// Number of chunks of modes that each domain sums in the last step; `None` when all are summed.
    pub fn kept_chunks(&self) -> Option<&[u32]> {
        self.writer.truncation.as_ref().map(|choice| choice.counts.as_slice())
    }

    /// Bound of the displacement that the truncated modes cause at any vertex in the last step, scene units.
    pub(super) fn truncation_bound(&self) -> f64 {
        self.writer.truncation.as_ref().map_or(0.0, |choice| choice.bound)
    }
}

/// Writes the values of steps in buffer order. Pure.
#[derive(Debug)]
pub struct Writer {
    packing: Arc<Packing>,
    truncation: Option<Choice>,
}

impl Writer {
    pub fn new(packing: &Arc<Packing>) -> Self {
        let truncation = packing.scene.needs.truncation.then(|| Choice::new(&packing.scene));
        Self { packing: Arc::clone(packing), truncation }
    }

    /// Writes a full step; `to` has [`Sizes::total`] bytes.
    pub fn write(&mut self, to: &mut [f32], header: &Header, state: &State) {
        let mut to = Front::new(to);
        to.put(std::slice::from_ref(header));
        to.put(&state.transforms);
        self.packing.write_q(state, to.take(self.packing.coordinates.total));
        if let Some(choice) = &mut self.truncation {
            choice.write(&self.packing, state, &mut to);
        }
    }
}

/// Transform root and frame of each domain; empty in a scene without followers.
pub(super) fn following(scene: &Scene) -> Vec<Following> {
    scene.movers.following().iter().map(|[mover, frame]| Following { mover: *mover, frame: *frame }).collect()
}

impl Packing {
    /// Writes all coordinates in the layout of the device, and zeros the padding at the end.
    fn write_q(&self, state: &State, to: &mut [f32]) {
        if self.coordinates.as_packed {
            let mut to = Front::new(to);
            to.put(&state.q);
            to.take(self.coordinates.total - state.q.len()).fill(0.0);
            return;
        }
        fill_parts(to, &self.coordinates.first, |domains, part| {
            let mut at = 0;
            for domain in domains {
                self.put_q(domain, state.q_of(&self.scene, domain), |number| {
                    part[at] = number;
                    at += 1;
                });
            }
            part[at..].fill(0.0);
        });
    }

    /// Passes the coordinates of one domain to `put`, multiplied by the factors of their modes and padded to whole
    /// chunks.
    pub(super) fn put_q(&self, domain: usize, q: &[f32], mut put: impl FnMut(f32)) {
        let factors = &self.factors[self.scene.domains[domain].shape];
        // The factor is a power of two, so the product is exact unless it overflows or underflows f32.
        q.iter()
            .enumerate()
            .for_each(|(mode, amount)| put(factors.get(mode).map_or(*amount, |factor| amount * factor)));
        if !self.coordinates.as_packed {
            let whole = q.len().next_multiple_of(modes_per_chunk(self.scene.deformation.storage));
            (q.len()..whole).for_each(|_| put(0.0));
        }
    }
}

/// Domains per parallel work item of the truncation; a domain takes a few microseconds.
const DECIDED_TOGETHER: usize = 64;

/// Modal truncation: which chunks of modes each domain sums.
#[derive(Debug)]
struct Choice {
    /// Error budget, scene units.
    budget: f64,
    /// Per shape.
    reaches: Vec<Vec<f64>>,
    /// Per domain.
    truncations: Vec<Truncation>,
    bound: f64,
    counts: Vec<u32>,
    /// Chunk indices, two u16 per word.
    chunks: Vec<u32>,
}

impl Choice {
    fn new(scene: &Scene) -> Self {
        Self {
            budget: scene.deformation.truncation.unwrap_or(0.0) / scene.unit,
            reaches: scene.shapes.iter().map(|shape| reaches(&shape.modes)).collect(),
            truncations: (0..scene.domains.len()).map(|domain| Truncation::new(scene.rank_of(domain))).collect(),
            bound: 0.0,
            counts: Vec::new(),
            chunks: Vec::new(),
        }
    }

    /// Keeps a chunk when at least one of its modes is kept: reading the chunk reads its other modes too.
    fn write(&mut self, packing: &Packing, state: &State, to: &mut Front) {
        let scene = &packing.scene;
        let per_chunk = modes_per_chunk(scene.deformation.storage);
        self.counts.clear();
        self.counts.resize(scene.domains.len().next_multiple_of(4), 0);
        self.chunks.clear();
        self.chunks.resize((packing.coordinates.total / per_chunk).next_multiple_of(8) / 2, 0);
        let chunks: &mut [u16] = bytemuck::cast_slice_mut(&mut self.chunks);
        self.bound = 0.0;
        let (reaches, budget) = (&self.reaches, self.budget);
        let decide = |(domain, truncation): (usize, &mut Truncation)| {
            // Without modes nothing can be truncated, and the norm of T does not matter.
            if scene.rank_of(domain) > 0 {
                let reaches = &reaches[scene.domains[domain].shape];
                let norm = bound::norm(&state.composed(scene, domain));
                truncation.update(Amounts { q: state.q_of(scene, domain), reaches, norm }, budget);
            }
        };
        self.truncations.par_iter_mut().enumerate().with_min_len(DECIDED_TOGETHER).for_each(decide);
        for (domain, truncation) in self.truncations.iter().enumerate() {
            self.bound = self.bound.max(truncation.bound());
            let first = packing.coordinates.first[domain] as usize / per_chunk;
            let mut count = 0;
            for mode in truncation.kept() {
                let chunk = mode / per_chunk as u16;
                if count == 0 || chunks[first + count - 1] != chunk {
                    chunks[first + count] = chunk;
                    count += 1;
                }
            }
            self.counts[domain] = count as u32;
        }
        to.put(&self.counts);
        to.put(&self.chunks);
    }
}

#[cfg(test)]
mod tests {
    use super::super::pack::tests::{deformed, scene};
    use super::*;
    use modalcast_model::scene::{Deformation, Storage};

    fn packing(scene: &Arc<Scene>) -> Arc<Packing> {
        let coordinates = Coordinates::new(scene);
        let factors = vec![vec![0.5; 64]; scene.shapes.len()];
        Arc::new(Packing { scene: Arc::clone(scene), coordinates, factors, listing: Listing::default() })
    }

    fn state(scene: &Scene) -> State {
        let mut state = State::rest(scene);
        state.q.iter_mut().enumerate().for_each(|(at, amount)| *amount = (at % 1000) as f32);
        let transforms = state.transforms.iter_mut().enumerate();
        transforms.for_each(|(at, transform)| transform.0[3] = at as f32);
        state
    }

    /// All words of a step, written one by one.
    fn plainly(packing: &Packing, state: &State) -> Vec<f32> {
        let scene = &packing.scene;
        let mut words = vec![0.0; size_of::<Header>() / 4];
        words.extend(state.transforms.iter().flat_map(|transform| transform.0));
        let begin = words.len();
        words.resize(begin + packing.coordinates.total, 0.0);
        for domain in 0..scene.domains.len() {
            let first = begin + packing.coordinates.first[domain] as usize;
            for (mode, amount) in state.q_of(scene, domain).iter().enumerate() {
                words[first + mode] = if packing.coordinates.as_packed { *amount } else { 0.5 * amount };
            }
        }
        words
    }

    #[test]
    fn small_and_large_steps_are_written_word_for_word_whatever_the_cores() {
        let f16 = Deformation { storage: Storage::F16, ..Deformation::default() };
        for (shapes, cores) in [(3, 1), (3, 4), (20_000, 1), (20_000, 4)] {
            let ranks: Vec<(usize, usize)> = (0..shapes).map(|at| (7, at % 20)).collect();
            for scene in [scene(&ranks, false, false), deformed(&ranks, f16)] {
                let (packing, state) = (packing(&scene), state(&scene));
                let mut words = vec![f32::NAN; Sizes::of(&scene, &packing.coordinates).total() as usize / 4];
                let pool = rayon::ThreadPoolBuilder::new().num_threads(cores).build().expect("a pool");
                pool.install(|| Writer::new(&packing).write(&mut words, &Header::default(), &state));
                let mut want = plainly(&packing, &state);
                assert!(words == want, "{shapes} shapes, {cores} cores");
                want[24] += 1.0;
                assert!(words != want, "the judge can fail");
            }
        }
    }
}
