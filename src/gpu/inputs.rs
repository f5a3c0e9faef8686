//! The values of a step on their way to the device: written to pinned memory once, in the order in which they lie there.
//!
//! ```text
//! [header][transforms: 12 f32 a mover][q, whole chunks of modes][with truncation: kept chunks of each domain]
//! ```
//! The pinned memory is write-combined: it is written from front to back and never read here.

use std::sync::Arc;

use bytemuck::Pod;
use cudarc::driver::{CudaSlice, PinnedHostSlice, result};

use super::device::Device;
use super::layout::{Following, Header};
use super::memory::{address, room, upload};
use super::work::Coordinates;
use crate::error::{Result, during};
use crate::scene::{Scene, State};
use crate::storage::{Amounts, Truncation, bound, modes_per_chunk, reaches};

/// What decides how a scene's coordinates lie on the device.
#[derive(Debug)]
pub(super) struct Packing {
    pub scene: Arc<Scene>,
    pub coordinates: Coordinates,
    /// Per shape the factors of its modes; empty lists unless the storage has factors.
    pub factors: Vec<Vec<f32>>,
    /// Of each domain, the first and the count of its tiles of vertices, and of those of corners alone.
    pub spans: Vec<[(u32, u32); 2]>,
    /// Tiles of all.
    pub tiles: usize,
}

/// Device addresses of a step's values.
#[derive(Debug, Clone, Copy)]
pub(super) struct Values {
    pub header: u64,
    pub transforms: u64,
    /// Constant: who follows whom, and by which frame. Of a scene with followers.
    pub following: u64,
    pub frames: u64,
    pub q: u64,
    /// Per domain, the step that last changed it.
    pub stamps: u64,
    /// 0 without truncation.
    pub kept_counts: u64,
    pub kept: u64,
}

/// Bytes of the parts, in their order.
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

/// Both ends of the way.
#[derive(Debug)]
pub(super) struct Inputs {
    packing: Arc<Packing>,
    pinned: PinnedHostSlice<f32>,
    buffer: CudaSlice<u8>,
    stamps: CudaSlice<u8>,
    following: CudaSlice<u8>,
    frames: CudaSlice<u8>,
    sizes: Sizes,
    truncation: Option<Choice>,
}

impl Inputs {
    pub(super) fn new(device: &Device, packing: &Arc<Packing>) -> Result<Self> {
        let sizes = Sizes::of(&packing.scene, &packing.coordinates);
        // SAFETY: the memory is written whole before it is first read, in `write`.
        let pinned =
            unsafe { device.context().alloc_pinned(sizes.total() as usize / 4) }.map_err(during("allocate"))?;
        Ok(Self {
            packing: Arc::clone(packing),
            pinned,
            buffer: room(device, sizes.total())?,
            stamps: room(device, 4 * packing.scene.domains.len() as u64)?,
            following: upload(device, &following(&packing.scene))?,
            frames: upload(device, packing.scene.movers.frames())?,
            sizes,
            truncation: packing.scene.needs.truncation.then(|| Choice::new(&packing.scene)),
        })
    }

    pub(super) fn values(&self, device: &Device) -> Values {
        let header = address(device, &self.buffer);
        let transforms = header + size_of::<Header>() as u64;
        let q = transforms + self.sizes.transforms;
        let kept_counts = q + self.sizes.q;
        let kept = kept_counts + self.sizes.kept_counts;
        let [stamps, following, frames] =
            [&self.stamps, &self.following, &self.frames].map(|buffer| address(device, buffer));
        Values { header, transforms, following, frames, q, stamps, kept_counts, kept }
    }

    /// Writes a whole step. Nothing may be reading the pinned memory: the caller has waited for the last copy.
    pub(super) fn write(&mut self, header: &Header, state: &State) -> Result<()> {
        let Self { packing, pinned, truncation, .. } = self;
        let mut to = Front(pinned.as_mut_slice().map_err(during("upload"))?);
        to.put(std::slice::from_ref(header));
        to.put(&state.transforms);
        let before = to.0.len();
        packing.write_q(state, &mut to);
        let written = before - to.0.len();
        to.zeros(packing.coordinates.total - written);
        if let Some(choice) = truncation {
            choice.write(packing, state, &mut to);
        }
        Ok(())
    }

    /// Writes the header alone.
    pub(super) fn write_header(&mut self, header: &Header) -> Result<()> {
        Front(self.pinned.as_mut_slice().map_err(during("upload"))?).put(std::slice::from_ref(header));
        Ok(())
    }

    /// Starts the copy of the first `bytes`; the whole when `None`.
    pub(super) fn send(&mut self, device: &Device, bytes: Option<usize>) -> Result<()> {
        let fail = during("upload");
        let (to, host) = (address(device, &self.buffer), self.pinned.as_mut_slice().map_err(&fail)?);
        let bytes = bytes.unwrap_or(size_of_val(host));
        // SAFETY: `pinned` and `buffer` have `bytes` bytes and outlive the copy: the deformer waits for the stream
        // before it writes here again and before it goes away, and a graph that holds the copy goes before both.
        let sent = unsafe {
            let host = std::slice::from_raw_parts(host.as_ptr().cast::<u8>(), bytes);
            result::memcpy_htod_async(to, host, device.stream().cu_stream())
        };
        sent.map_err(fail)
    }

    /// Bytes that a whole step copies.
    pub(super) const fn bytes(&self) -> u64 {
        self.sizes.total()
    }

    /// Chunks of modes that each domain sums at the last step; `None` when it sums all.
    pub(super) fn kept_chunks(&self) -> Option<&[u32]> {
        self.truncation.as_ref().map(|choice| choice.counts.as_slice())
    }

    /// How far leaving modes out may move a vertex at the last step, scene units.
    pub(super) fn truncation_bound(&self) -> f64 {
        self.truncation.as_ref().map_or(0.0, |choice| choice.bound)
    }
}

/// Who follows whom; empty where nobody does.
pub(super) fn following(scene: &Scene) -> Vec<Following> {
    scene.movers.following().iter().map(|[mover, frame]| Following { mover: *mover, frame: *frame }).collect()
}

impl Packing {
    /// All coordinates as they lie on the device, without the padding at the end.
    fn write_q(&self, state: &State, to: &mut Front) {
        if self.coordinates.as_packed {
            to.put(&state.q);
            return;
        }
        for domain in 0..self.scene.domains.len() {
            self.put_q(domain, state.q_of(&self.scene, domain), |number| to.put(&[number]));
        }
    }

    /// The coordinates of one domain, times the factors of its modes, filled up to whole chunks.
    pub(super) fn put_q(&self, domain: usize, q: &[f32], mut put: impl FnMut(f32)) {
        let factors = &self.factors[self.scene.domains[domain].shape];
        // A power of two: exact, unless the product leaves f32.
        q.iter()
            .enumerate()
            .for_each(|(mode, amount)| put(factors.get(mode).map_or(*amount, |factor| amount * factor)));
        if !self.coordinates.as_packed {
            let whole = q.len().next_multiple_of(modes_per_chunk(self.scene.deformation.storage));
            (q.len()..whole).for_each(|_| put(0.0));
        }
    }
}

/// The unwritten rest of a list, written from its front.
struct Front<'a>(&'a mut [f32]);

impl Front<'_> {
    fn put<T: Pod>(&mut self, values: &[T]) {
        let words: &[f32] = bytemuck::cast_slice(values);
        let (part, rest) = std::mem::take(&mut self.0).split_at_mut(words.len());
        part.copy_from_slice(words);
        self.0 = rest;
    }

    fn zeros(&mut self, count: usize) {
        let (part, rest) = std::mem::take(&mut self.0).split_at_mut(count);
        part.fill(0.0);
        self.0 = rest;
    }
}

/// Which chunks of modes each domain sums.
#[derive(Debug)]
struct Choice {
    /// Scene units.
    budget: f64,
    /// Per shape.
    reaches: Vec<Vec<f64>>,
    /// Per domain.
    truncations: Vec<Truncation>,
    bound: f64,
    counts: Vec<u32>,
    /// Two chunks a word.
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

    /// A chunk is summed when one of its modes is: its others come for free.
    fn write(&mut self, packing: &Packing, state: &State, to: &mut Front) {
        let scene = &packing.scene;
        let per_chunk = modes_per_chunk(scene.deformation.storage);
        self.counts.clear();
        self.counts.resize(scene.domains.len().next_multiple_of(4), 0);
        self.chunks.clear();
        self.chunks.resize((packing.coordinates.total / per_chunk).next_multiple_of(8) / 2, 0);
        let chunks: &mut [u16] = bytemuck::cast_slice_mut(&mut self.chunks);
        self.bound = 0.0;
        for (domain, truncation) in self.truncations.iter_mut().enumerate() {
            let amounts = Amounts {
                q: state.q_of(scene, domain),
                reaches: &self.reaches[scene.domains[domain].shape],
                norm: bound::norm(&state.composed(scene, domain)),
            };
            truncation.update(amounts, self.budget);
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
