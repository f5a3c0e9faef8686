//! What a subscriber is shown, as bytes for the wire: PNG or raw pixels, packed vertices. Runs off the device thread.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::viewer::{Body, Shown, StepName};
use crate::deform::Surface;
use crate::error::{Result, during, invalid};
use crate::frame;
use crate::scene::{Cells, Layout, Scene};
use crate::telemetry::{Stage, StageTimes, ms_since};

// Vertices are copied as they lie in memory, and the wire is little-endian.
const _: () = assert!(cfg!(target_endian = "little"), "vertices would need their bytes swapped");

/// How the most domains of one reply with vertices are bounded: their counts travel in its first message.
const MOST_DOMAINS: usize = 65_536;

/// How pixels travel.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    Png,
    /// RGBA8, top row first.
    Rgba,
    /// f32 a pixel: depth.
    F32,
    /// u32 a pixel: domains.
    U32,
    /// Three f32 a pixel: normals.
    F32x3,
}

/// A step as bytes.
#[derive(Debug, Clone)]
pub struct Encoded {
    pub step: StepName,
    pub skipped: u64,
    pub stages: StageTimes,
    pub bytes: Bytes,
}

/// Vertices as bytes, and what they are relative to.
#[derive(Debug, Clone)]
pub struct Packed {
    pub encoded: Encoded,
    /// World position, metres.
    pub origin: [f64; 3],
    /// Bytes of the chosen domains' own origins at the end of the reply; 0 when `origin` holds for all of them.
    pub origin_bytes: u64,
}

/// Which vertices of a scene.
#[derive(Debug, Clone)]
pub struct Selection {
    scene: Arc<Scene>,
    /// Domains by index, in the order of the reply.
    pub domains: Vec<u32>,
    pub positions_only: bool,
}

impl Selection {
    /// The chosen domains of a scene, or all when none is named.
    ///
    /// # Errors
    /// `Invalid` when an index is out of range or the list is longer than the scene.
    pub fn new(scene: &Arc<Scene>, domains: Vec<u32>, positions_only: bool) -> Result<Self> {
        let domains = checked_domains("selection.domains", scene, domains)?;
        if domains.len() > MOST_DOMAINS {
            return Err(invalid("selection.domains", format!("at most {MOST_DOMAINS} per reply"), domains.len()));
        }
        Ok(Self { scene: Arc::clone(scene), domains, positions_only })
    }

    /// Bytes of the positions.
    pub fn position_bytes(&self) -> u64 {
        self.vertices().map(|count| 12 * u64::from(count)).sum()
    }

    /// Vertices of each chosen domain.
    pub fn vertices(&self) -> impl Iterator<Item = u32> {
        let slots = &self.scene.layout.slots;
        self.domains.iter().map(|domain| slots[*domain as usize].vertices as u32)
    }

    /// Corners of each chosen domain.
    pub fn corners(&self) -> impl Iterator<Item = u32> {
        let slots = &self.scene.layout.slots;
        self.domains.iter().map(|domain| slots[*domain as usize].corners as u32)
    }
}

/// The domains that a list names, or all.
///
/// # Errors
/// `Invalid` when an index is out of range or the list is longer than the scene.
pub fn checked_domains(field: &str, scene: &Scene, domains: Vec<u32>) -> Result<Vec<u32>> {
    let count = scene.domains.len();
    if domains.is_empty() {
        return Ok((0..count as u32).collect());
    }
    if domains.len() > count {
        return Err(invalid(field, format!("at most {count} indices"), domains.len()));
    }
    match domains.iter().position(|domain| *domain as usize >= count) {
        None => Ok(domains),
        Some(at) => Err(invalid(format!("{field}[{at}]"), format!("an index below {count}"), domains[at])),
    }
}

/// Encodes the pixels of a frame.
///
/// # Errors
/// `Fault` when the encoder refuses, or when it was vertices that were shown.
pub async fn encode_frame(shown: Shown, format: Format) -> Result<Encoded> {
    let mut stages = shown.stages;
    let begin = Instant::now();
    let (size, pixels) = match shown.body {
        Body::Frame(image) => ([image.width, image.height], image.rgba),
        Body::Survey(survey, Some(legend)) => {
            let size = [survey.width, survey.height];
            (size, aside("encode", move || frame::colour_map(&survey.bytes, survey.samples, size, &legend)).await?)
        }
        Body::Survey(survey, None) => ([survey.width, survey.height], survey.bytes),
        Body::Vertices(_) | Body::Picked(_) => return Err(during("encode")("it is no picture")),
    };
    let bytes = match format {
        Format::Rgba | Format::F32 | Format::U32 | Format::F32x3 => pixels,
        Format::Png => {
            let bytes = aside("encode", move || frame::png(size[0], size[1], &pixels)).await?;
            stages.push((Stage::Encode, ms_since(begin)));
            bytes
        }
    };
    Ok(Encoded { step: shown.step, skipped: shown.skipped, stages, bytes: bytes.into() })
}

/// Packs the chosen vertices: all positions in row order of U, then all normals, then the origins of the domains when
/// they are not all the same.
///
/// # Errors
/// `Fault` when it was a picture that was shown.
pub async fn pack_vertices(shown: Shown, selection: &Arc<Selection>) -> Result<Packed> {
    let Body::Vertices(surface) = shown.body else { return Err(during("copy")("a picture is no vertices")) };
    let mut stages = shown.stages;
    let begin = Instant::now();
    let (selection, cells) = (Arc::clone(selection), shown.cells);
    let work = move || {
        let mut bytes = pack(&surface, &selection);
        let before = bytes.len();
        let origin = push_origins(&selection, cells.as_deref(), &mut bytes);
        Ok((origin, (bytes.len() - before) as u64, bytes))
    };
    let (origin, origin_bytes, bytes) = aside("copy", work).await?;
    stages.push((Stage::Encode, ms_since(begin)));
    let encoded = Encoded { step: shown.step, skipped: shown.skipped, stages, bytes: bytes.into() };
    Ok(Packed { encoded, origin, origin_bytes })
}

/// The origin of the reply in metres; appends the chosen domains' own ones when they differ from it.
fn push_origins(selection: &Selection, cells: Option<&Cells>, bytes: &mut Vec<u8>) -> [f64; 3] {
    let scene = &selection.scene;
    let metres = |cell: [f64; 3]| std::array::from_fn(|axis| scene.origin[axis] + scene.unit * cell[axis]);
    let Some(cells) = cells else { return scene.origin };
    let own = || selection.domains.iter().map(|domain| cells.cell_of(*domain as usize));
    if own().any(|cell| cell != cells.shared()) {
        bytes.extend(own().map(metres).flat_map(|origin: [f64; 3]| origin.map(f64::to_le_bytes)).flatten());
    }
    metres(cells.shared())
}

fn pack(surface: &Surface, selection: &Selection) -> Vec<u8> {
    let layout: &Layout = &selection.scene.layout;
    let slots = || selection.domains.iter().map(|domain| layout.slots[*domain as usize]);
    let corners: usize = if selection.positions_only { 0 } else { slots().map(|slot| slot.corners).sum() };
    let vertices: usize = slots().map(|slot| slot.vertices).sum();
    let mut bytes = Vec::with_capacity(12 * (vertices + corners));
    for slot in slots() {
        let positions = &surface.positions[3 * slot.first_vertex..][..3 * slot.vertices];
        bytes.extend_from_slice(bytemuck::cast_slice(positions));
    }
    if !selection.positions_only {
        for slot in slots() {
            let normals = &surface.normals[3 * slot.first_corner..][..3 * slot.corners];
            bytes.extend_from_slice(bytemuck::cast_slice(normals));
        }
    }
    bytes
}

/// Runs work that takes a while on a thread where that hurts nobody. A panic there is a fault of that work alone.
pub(super) async fn aside<T: Send + 'static>(
    stage: &'static str,
    work: impl FnOnce() -> Result<T> + Send + 'static,
) -> Result<T> {
    tokio::task::spawn_blocking(work).await.map_err(during(stage))?
}

#[cfg(test)]
mod tests {
    use super::super::testing;
    use super::*;

    #[test]
    fn a_selection_packs_positions_then_normals_of_its_domains_in_order() {
        let scene = testing::two_strips();
        let count = |from: f32, len: usize| (0..len).map(|at| from + at as f32).collect::<Vec<_>>();
        let surface = Surface { positions: count(0.0, 24), normals: count(100.0, 24), tangents: vec![] };
        let selection = Selection::new(&scene, vec![1], false).expect("in range");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &selection));
        assert_eq!(floats, [count(12.0, 12), count(112.0, 12)].concat());
        assert_eq!(selection.position_bytes(), 48);
        let bare = Selection::new(&scene, vec![1, 0], true).expect("in range");
        let floats: Vec<f32> = bytemuck::pod_collect_to_vec(&pack(&surface, &bare));
        assert_eq!(floats, [count(12.0, 12), count(0.0, 12)].concat());
    }

    #[test]
    fn indices_out_of_range_and_lists_longer_than_the_scene_are_refused() {
        let scene = testing::two_strips();
        let refusal = Selection::new(&scene, vec![0, 2], false).expect_err("out of range").to_string();
        assert!(refusal.starts_with("selection.domains[1]: expected an index below 2, given 2"), "{refusal}");
        assert!(Selection::new(&scene, vec![0; 3], false).is_err());
    }
}
