//! Packs the state of a step into bytes for the wire, on the blocking pool: all domains, or those that differ from the
//! state that the client has received before.

use std::sync::Arc;
use std::time::Instant;

use bytes::Bytes;

use super::step_output::{OutputBody, StepId, StepOutput};
use crate::engine::blocking::run_blocking;
use crate::telemetry::{Stage, StageTimes, ms_since};
use modalcast_model::domain::Transform;
use modalcast_model::error::{Result, fault};
use modalcast_model::scene::{FloatingOrigins, Scene, SceneState};

/// The content of a [`StateSection`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum StateContent {
    /// u32 indices of domains that own coordinates. Omitted if all domains have theirs.
    QDomains,
    /// f32 coordinates of these domains.
    Q,
    /// u32 indices of transform roots: domains that follow no other domain. Omitted if all have their transforms.
    TransformDomains,
    /// 12 f32 per transform root.
    Transforms,
    /// 3 f64 in meters: one origin for all transform roots, or one per root.
    Origins,
}

/// A part of the bytes of a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct StateSection {
    pub content: StateContent,
    /// Position of the first byte in `PackedState::bytes`.
    pub offset: u64,
    /// Number of bytes.
    pub bytes: u64,
}

/// The state of a step as bytes.
#[derive(Debug, Clone)]
pub struct PackedState {
    pub step: StepId,
    /// Steps that the subscriber skipped since its last output.
    pub skipped: u64,
    pub stages: StageTimes,
    /// Whether the bytes contain all domains.
    pub is_complete: bool,
    /// In the order of their offsets, without gaps. Empty sections are omitted.
    pub sections: Vec<StateSection>,
    pub bytes: Bytes,
    /// The state that was packed.
    pub state: Arc<SceneState>,
}

/// Packs the domains whose coordinates or transforms differ in any bit from `previous`, the state that the client has.
/// Packs all domains if there is no previous state.
///
/// # Errors
/// `Fault` when `output` is not a state.
pub async fn pack_state(
    output: StepOutput,
    scene: &Arc<Scene>,
    previous: Option<Arc<SceneState>>,
) -> Result<PackedState> {
    let OutputBody::State(state) = output.body else {
        return Err(fault("encode", "expected a state, got another output"));
    };
    let begin = Instant::now();
    let (scene, packed_state, is_complete) = (Arc::clone(scene), Arc::clone(&state), previous.is_none());
    let pack_on_pool = move || Ok(pack(&scene, &packed_state, previous.as_deref()));
    let StateBytes { sections, bytes } = run_blocking("encode", pack_on_pool).await?;
    let mut stages = output.stages;
    stages.push((Stage::Encode, ms_since(begin)));
    let (step, skipped) = (output.step, output.skipped);
    Ok(PackedState { step, skipped, stages, is_complete, sections, bytes: bytes.into(), state })
}

/// Sections, and their bytes.
#[derive(Debug, Default)]
struct StateBytes {
    sections: Vec<StateSection>,
    bytes: Vec<u8>,
}

impl StateBytes {
    fn append(&mut self, content: StateContent, section_bytes: &[u8]) {
        if !section_bytes.is_empty() {
            let (offset, bytes) = (self.bytes.len() as u64, section_bytes.len() as u64);
            self.sections.push(StateSection { content, offset, bytes });
            self.bytes.extend_from_slice(section_bytes);
        }
    }
}

fn pack(scene: &Scene, state: &SceneState, previous: Option<&SceneState>) -> StateBytes {
    let mut packed = StateBytes::default();
    let (mut domains, mut q) = (Vec::<u32>::new(), Vec::<f32>::new());
    // The coordinates of all domains, one after the other, need no list.
    let mut is_all_q = true;
    for domain in 0..scene.domains.len() {
        let domain_q = state.q_of(scene, domain);
        let is_sent = scene.domains[domain].shares_q_with.is_none()
            && previous.is_none_or(|previous| !are_bits_equal(domain_q, previous.q_of(scene, domain)));
        if is_sent && !domain_q.is_empty() {
            domains.push(domain as u32);
            q.extend_from_slice(domain_q);
        }
        is_all_q &= is_sent || domain_q.is_empty();
    }
    if !is_all_q {
        packed.append(StateContent::QDomains, bytemuck::cast_slice(&domains));
    }
    packed.append(StateContent::Q, bytemuck::cast_slice(&q));
    domains.clear();
    let mut transforms = Vec::new();
    for root in 0..state.transforms.len() {
        let transform = sent_transform(scene, state, root);
        if previous.is_none_or(|previous| !are_bits_equal(&transform.0, &sent_transform(scene, previous, root).0)) {
            domains.push(scene.transform_roots.domain(root));
            transforms.push(transform);
        }
    }
    if transforms.len() < state.transforms.len() {
        packed.append(StateContent::TransformDomains, bytemuck::cast_slice(&domains));
    }
    packed.append(StateContent::Transforms, bytemuck::cast_slice(&transforms));
    let origins = origins_in_meters(scene, state);
    if previous.is_none_or(|previous| origins_in_meters(scene, previous) != origins) {
        packed.append(StateContent::Origins, bytemuck::cast_slice(&origins));
    }
    packed
}

/// The transform of a root that acts on x0. That of a root with a pivot has no translation: its origin contains it
/// ([`sent_origin`]), because its translation from an origin near the domain is as large as the distance of the domain
/// from the origin of its own frame, which f32 rounds.
fn sent_transform(scene: &Scene, state: &SceneState, root: usize) -> Transform {
    let mut transform = state.transforms[root];
    if scene.transform_roots.pivot_of(root).is_some() {
        [3, 7, 11].into_iter().for_each(|entry| transform.0[entry] = 0.0);
    }
    transform
}

/// The origin of the [`sent_transform`] of a root, in scene units from the scene's origin.
fn sent_origin(scene: &Scene, origins: &FloatingOrigins, state: &SceneState, root: usize) -> [f64; 3] {
    match scene.transform_roots.pivot_of(root) {
        None => origins.origin_of(root),
        // With T = (A, t) of the state, (A, t) v = A x0 + t - A p.
        Some(pivot) => {
            let moved = state.transforms[root].linear() * nalgebra::Vector3::from(pivot);
            std::array::from_fn(|axis| origins.translations()[root][axis] - moved[axis])
        }
    }
}

/// Whether two lists have the same bits, so that 0 differs from -0.
fn are_bits_equal(a: &[f32], b: &[f32]) -> bool {
    bytemuck::cast_slice::<f32, u32>(a) == bytemuck::cast_slice::<f32, u32>(b)
}

/// The world position of the origin of all transforms in meters, or of the origin of each transform root if they
/// differ.
fn origins_in_meters(scene: &Scene, state: &SceneState) -> Vec<[f64; 3]> {
    let to_meters = |origin: [f64; 3]| std::array::from_fn(|axis| scene.origin[axis] + scene.unit * origin[axis]);
    match &state.origins {
        None => vec![scene.origin],
        Some(origins) if origins.has_no_outliers() && origins.pivots().is_empty() => {
            vec![to_meters(origins.shared_origin())]
        }
        Some(origins) => {
            (0..state.transforms.len()).map(|root| to_meters(sent_origin(scene, origins, state, root))).collect()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::engine::testing;

    fn section_bytes(packed: &StateBytes, content: StateContent) -> Option<&[u8]> {
        let section = packed.sections.iter().find(|section| section.content == content)?;
        Some(&packed.bytes[section.offset as usize..][..section.bytes as usize])
    }

    #[test]
    fn complete_state_has_all_values_and_no_lists() {
        let scene = testing::two_strips();
        let mut state = SceneState::rest(&scene);
        state.q = vec![1.0, 2.0, 3.0, 4.0];
        let packed = pack(&scene, &state, None);
        let mut end = 0;
        for section in &packed.sections {
            assert_eq!(section.offset, end);
            end += section.bytes;
        }
        assert_eq!((end, packed.sections.len()), (packed.bytes.len() as u64, 3));
        assert_eq!(section_bytes(&packed, StateContent::Q), Some(bytemuck::cast_slice(&state.q)));
        assert_eq!(section_bytes(&packed, StateContent::Transforms), Some(bytemuck::cast_slice(&state.transforms)));
        assert_eq!(section_bytes(&packed, StateContent::Origins), Some(&[0; 24][..]));
    }

    #[test]
    fn shared_coordinates_need_a_list() {
        let mut scene = testing::two_strips();
        let mut state = SceneState::rest(&scene);
        state.q = vec![1.0, 2.0, 3.0, 4.0];
        assert_eq!(section_bytes(&pack(&scene, &state, None), StateContent::QDomains), None, "control");
        Arc::get_mut(&mut scene).expect("expected the only owner").domains[1].shares_q_with = Some(0);
        let packed = pack(&scene, &state, None);
        assert_eq!(section_bytes(&packed, StateContent::QDomains), Some(&0_u32.to_le_bytes()[..]));
        assert_eq!(section_bytes(&packed, StateContent::Q), Some(bytemuck::cast_slice(&[1.0_f32, 2.0])));
    }

    #[test]
    fn later_state_has_only_the_domains_with_other_bits() {
        let scene = testing::two_strips();
        let previous = SceneState::rest(&scene);
        assert!(pack(&scene, &previous, Some(&previous)).sections.is_empty());
        let mut state = previous.clone();
        // Equal to 0 as a number, but with another bit.
        state.q[3] = -0.0;
        let packed = pack(&scene, &state, Some(&previous));
        let domain_one = 1_u32.to_le_bytes();
        assert_eq!(section_bytes(&packed, StateContent::QDomains), Some(&domain_one[..]));
        assert_eq!(section_bytes(&packed, StateContent::Q), Some(bytemuck::cast_slice(&[0.0_f32, -0.0])));
        assert_eq!(packed.sections.len(), 2);
        state = previous.clone();
        state.transforms[1] = Transform([2.0; 12]);
        let packed = pack(&scene, &state, Some(&previous));
        assert_eq!(section_bytes(&packed, StateContent::TransformDomains), Some(&domain_one[..]));
        assert_eq!(packed.bytes.len(), 4 + 48);
    }
}
