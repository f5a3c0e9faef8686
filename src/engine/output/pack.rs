//! Packs the selected vertex attributes into bytes for the wire, one section per attribute. An f32 section is not
//! copied if the selected domains are large or consecutive: its bytes are those of the vertices in memory. Any other
//! section is packed once for all readers with the same selection, on a thread pool of its own.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;
use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::oneshot;

use super::step_output::{OutputBody, StepId, StepOutput};
use super::step_vertices::{PackedSection, SectionKey, StepVertices};
use super::vertex_encoding::{Encoding, encode_vectors, into_bytes};
use super::vertex_selection::{Attribute, VertexSelection};
use crate::telemetry::{Stage, StageTimes, ms_since};
use modalcast_model::deform::DeformedSurface;
use modalcast_model::error::{Result, fault, fault_in};
use modalcast_model::scene::{BoundingBox, FloatingOrigins, Scene};

// Vertices are sent in memory order, and the wire format is little-endian.
const _: () = assert!(cfg!(target_endian = "little"), "expected a little-endian target");

/// Maximum number of threads that pack.
const MAX_THREADS: usize = 4;

/// Minimum mean size of the ranges of vertices that are sent without a copy. Smaller ranges are copied into one part.
const MIN_RANGE_BYTES: usize = 64 << 10;

/// Size of a vector of an f32 attribute: three numbers, 12 bytes.
const VECTOR_NUMBERS: usize = 3;
const VECTOR_BYTES: usize = VECTOR_NUMBERS * size_of::<f32>();

/// A part of the bytes of a step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Section {
    pub attribute: Attribute,
    pub encoding: Encoding,
    /// Position of the first byte among the bytes of the step.
    pub offset: u64,
    /// Number of bytes.
    pub bytes: u64,
}

/// Origins of the positions of a reply, in world coordinates in meters: one for all positions, or one per selected
/// domain if their origins differ.
pub type Origins = Arc<[[f64; 3]]>;

/// The vertices of a step as bytes.
#[derive(Debug, Clone)]
pub struct PackedVertices {
    pub step: StepId,
    /// Steps that the subscriber skipped since its last output.
    pub skipped: u64,
    pub stages: StageTimes,
    /// In the order of their offsets, without gaps.
    pub sections: Vec<Section>,
    /// The bytes of all sections, one part after the other; no part is empty. A part may refer to the vertices that
    /// were read back, which then stay in memory until the part is dropped.
    pub parts: Vec<Bytes>,
    pub origins: Origins,
}

impl PackedVertices {
    /// Size of all sections in bytes.
    pub fn total_bytes(&self) -> u64 {
        self.sections.last().map_or(0, |last| last.offset + last.bytes)
    }

    /// Appends a section.
    fn append(&mut self, attribute: Attribute, encoding: Encoding, parts: Vec<Bytes>) {
        let (offset, bytes) = (self.total_bytes(), parts.iter().map(|part| part.len() as u64).sum());
        self.sections.push(Section { attribute, encoding, offset, bytes });
        self.parts.extend(parts.into_iter().filter(|part| !part.is_empty()));
    }
}

/// Packs vertices off the device thread. Clones share one pool of threads.
#[derive(Debug, Clone)]
pub struct VertexPacker {
    pool: Arc<ThreadPool>,
}

impl VertexPacker {
    /// Starts one thread per core, at most [`MAX_THREADS`].
    ///
    /// # Errors
    /// `Fault` when the threads cannot be started.
    pub(in crate::engine) fn start() -> Result<Self> {
        let cores = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let pool =
            ThreadPoolBuilder::new().num_threads(cores.min(MAX_THREADS)).thread_name(|index| format!("pack {index}"));
        Ok(Self { pool: Arc::new(pool.build().map_err(fault_in("threads that pack vertices"))?) })
    }

    /// Waits for the vertices. Packs the selected attributes of the selected domains, then the origins, unless they equal `known_origins`,
    /// which the client has received before.
    ///
    /// # Errors
    /// The error of the device; `Fault` when `output` does not contain the selected attributes.
    pub async fn pack(
        &self,
        output: StepOutput,
        selection: &Arc<VertexSelection>,
        known_origins: Option<Origins>,
    ) -> Result<PackedVertices> {
        let StepOutput { step, skipped, mut stages, body: OutputBody::Vertices(vertices), origins } = output else {
            return Err(fault("copy", "expected vertices, got another output"));
        };
        let vertices = vertices.wait().await?;
        stages.push((Stage::Copy, vertices.copy_ms));
        let origins = self.origins_in_meters(selection, origins).await?;
        let (sections, parts) = (Vec::new(), Vec::new());
        let mut packed = PackedVertices { step, skipped, stages, sections, parts, origins };
        let mut pack_ms = 0.0;
        for (attribute, encoding) in selection.attributes.iter().copied() {
            let section = self.section(&vertices, selection, attribute, encoding).await?;
            pack_ms += section.ms;
            packed.append(attribute, encoding, section.parts);
        }
        if known_origins.is_none_or(|known_origins| known_origins != packed.origins) {
            let origin_bytes = Bytes::copy_from_slice(bytemuck::cast_slice(&packed.origins));
            packed.append(Attribute::Origins, Encoding::F64, vec![origin_bytes]);
        }
        packed.stages.push((Stage::Encode, pack_ms));
        Ok(packed)
    }

    /// A section of the vertices. The first reader of a section that must be packed packs it. If this reader is
    /// cancelled, the next one packs it.
    async fn section(
        &self,
        vertices: &Arc<StepVertices>,
        selection: &Arc<VertexSelection>,
        attribute: Attribute,
        encoding: Encoding,
    ) -> Result<PackedSection> {
        let begin = Instant::now();
        if encoding == Encoding::F32
            && let Some(parts) = vertex_parts(&vertices.surface, selection, attribute)?
        {
            return Ok(PackedSection { parts, ms: ms_since(begin) });
        }
        let domains = Arc::clone(&selection.domains);
        let section = vertices.packed_section(SectionKey { attribute, encoding, domains });
        let pack = || {
            let (surface, selection) = (Arc::clone(&vertices.surface), Arc::clone(selection));
            self.run(move || {
                let begin = Instant::now();
                let parts = pack_section(&surface, &selection, attribute, encoding)?;
                Ok(PackedSection { parts, ms: ms_since(begin) })
            })
        };
        section.get_or_try_init(pack).await.cloned()
    }

    /// The origins of the selected domains.
    async fn origins_in_meters(
        &self,
        selection: &Arc<VertexSelection>,
        floating_origins: Option<Arc<FloatingOrigins>>,
    ) -> Result<Origins> {
        let Some(floating_origins) = floating_origins else { return Ok(Arc::new([selection.scene.origin])) };
        if floating_origins.has_no_outliers() {
            return Ok(Arc::new([to_meters(&selection.scene, floating_origins.shared_origin())]));
        }
        let selection = Arc::clone(selection);
        self.run(move || Ok(origins_of_domains(&selection, &floating_origins))).await
    }

    /// Runs work on the pool. A panic becomes a `Fault`.
    async fn run<T: Send + 'static>(&self, work: impl FnOnce() -> Result<T> + Send + 'static) -> Result<T> {
        let (sender, receiver) = oneshot::channel();
        self.pool.spawn(move || {
            let result = catch_unwind(AssertUnwindSafe(work));
            // Fails only if the caller no longer waits.
            sender.send(result.unwrap_or_else(|_| Err(fault("encode", "packing vertices panicked")))).ok();
        });
        receiver.await.map_err(fault_in("encode"))?
    }
}

/// An origin in scene units from the scene's origin, in meters in the world.
fn to_meters(scene: &Scene, origin: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|axis| scene.origin[axis] + scene.unit * origin[axis])
}

/// The common origin of the selected domains, or their origins if these differ.
fn origins_of_domains(selection: &VertexSelection, floating_origins: &FloatingOrigins) -> Origins {
    let scene = &selection.scene;
    // A domain that follows another one has the origin of its transform root, the domain that follows no other.
    let origin_of = |domain: &u32| floating_origins.origin_of(scene.transform_roots.root_of(*domain as usize));
    let shared_origin = floating_origins.shared_origin();
    if selection.domains.iter().all(|domain| origin_of(domain) == shared_origin) {
        return Arc::new([to_meters(scene, shared_origin)]);
    }
    selection.domains.iter().map(|domain| to_meters(scene, origin_of(domain))).collect()
}

/// An array of a surface as bytes.
struct SurfaceBytes {
    surface: Arc<DeformedSurface>,
    attribute: Attribute,
}

impl AsRef<[u8]> for SurfaceBytes {
    fn as_ref(&self) -> &[u8] {
        bytemuck::cast_slice(numbers_of(&self.surface, self.attribute))
    }
}

/// The numbers of an attribute of all domains; empty for attributes that are not stored as f32.
fn numbers_of(surface: &DeformedSurface, attribute: Attribute) -> &[f32] {
    match attribute {
        Attribute::Positions => &surface.positions,
        Attribute::Normals => &surface.normals,
        Attribute::Displacements => &surface.displacements,
        Attribute::Boxes | Attribute::Origins => &[],
    }
}

/// The numbers of an attribute, checked to contain all selected vectors.
fn checked_numbers<'a>(
    surface: &'a DeformedSurface,
    selection: &VertexSelection,
    attribute: Attribute,
) -> Result<&'a [f32]> {
    let numbers = numbers_of(surface, attribute);
    let required = selection.ranges(attribute).iter().map(|range| VECTOR_NUMBERS * range.end).max().unwrap_or(0);
    if numbers.len() < required {
        return Err(fault("copy", format!("expected {required} numbers of {attribute:?}, got {}", numbers.len())));
    }
    Ok(numbers)
}

/// The selected ranges of an f32 attribute, without a copy. `None` if the ranges must be copied because they are too
/// small, or if the attribute is not stored as f32.
fn vertex_parts(
    surface: &Arc<DeformedSurface>,
    selection: &VertexSelection,
    attribute: Attribute,
) -> Result<Option<Vec<Bytes>>> {
    let ranges = selection.ranges(attribute);
    let total_bytes: usize = ranges.iter().map(|range| VECTOR_BYTES * range.len()).sum();
    if ranges.is_empty() || (ranges.len() > 1 && total_bytes < ranges.len() * MIN_RANGE_BYTES) {
        return Ok(None);
    }
    checked_numbers(surface, selection, attribute)?;
    let all_vertices = Bytes::from_owner(SurfaceBytes { surface: Arc::clone(surface), attribute });
    Ok(Some(
        ranges.iter().map(|range| all_vertices.slice(VECTOR_BYTES * range.start..VECTOR_BYTES * range.end)).collect(),
    ))
}

/// Packs a section.
fn pack_section(
    surface: &DeformedSurface,
    selection: &VertexSelection,
    attribute: Attribute,
    encoding: Encoding,
) -> Result<Vec<Bytes>> {
    if attribute == Attribute::Boxes {
        // `BoundingBox` stores these f32 values as f64, so the conversion back is exact.
        let corners = |domain: &u32| {
            let missing = || fault("copy", format!("expected the box of domain {domain}, got none"));
            let BoundingBox { min, max } = surface.boxes.get(*domain as usize).ok_or_else(missing)?;
            Ok([min.map(|number| number as f32), max.map(|number| number as f32)])
        };
        let boxes: Vec<[[f32; 3]; 2]> = selection.domains.iter().map(corners).collect::<Result<_>>()?;
        return Ok(vec![into_bytes(boxes)]);
    }
    let numbers = checked_numbers(surface, selection, attribute)?;
    let numbers_of_range =
        |range: &std::ops::Range<usize>| &numbers[VECTOR_NUMBERS * range.start..VECTOR_NUMBERS * range.end];
    Ok(match selection.ranges(attribute) {
        [range] => encode_vectors(encoding, numbers_of_range(range)),
        ranges => {
            let gathered: Vec<f32> = ranges.iter().map(numbers_of_range).collect::<Vec<_>>().concat();
            match encoding {
                Encoding::F32 => vec![into_bytes(gathered)],
                _ => encode_vectors(encoding, &gathered),
            }
        }
    })
}

#[cfg(test)]
mod tests;
