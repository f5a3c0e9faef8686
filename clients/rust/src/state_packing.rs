//! Packs complete states in the format of the wire contract, for programs that store or forward states.

use bytes::Bytes;
use modalcast_proto::v1;
use v1::StateContent;

use crate::states::SceneState;

/// Size limit of the data of a chunk in bytes, as on the server.
const CHUNK_BYTES: usize = 1 << 20;

impl SceneState {
    /// The complete state in chunks, of which the first has the head. Stage times are left out.
    pub fn to_chunks(&self) -> Vec<v1::StateChunk> {
        let domains: Vec<u32> = (0..self.layout.domain_count() as u32).collect();
        let q_domains: Vec<u32> = domains.into_iter().filter(|domain| self.layout.owns_coordinates(*domain)).collect();
        let contents: [(StateContent, &[u8]); 5] = [
            (StateContent::QDomains, bytemuck::cast_slice(&q_domains)),
            (StateContent::Q, bytemuck::cast_slice(&self.q)),
            (StateContent::TransformDomains, bytemuck::cast_slice(&self.layout.roots)),
            (StateContent::Transforms, bytemuck::cast_slice(&self.transforms)),
            (StateContent::Origins, bytemuck::cast_slice(&self.origins)),
        ];
        let (mut sections, mut bytes) = (Vec::new(), Vec::new());
        for (content, section_bytes) in contents.into_iter().filter(|(_, section_bytes)| !section_bytes.is_empty()) {
            let (offset, length) = (bytes.len() as u64, section_bytes.len() as u64);
            sections.push(v1::StateSection { content: content.into(), offset, bytes: length });
            bytes.extend_from_slice(section_bytes);
        }
        let head = v1::StateHead {
            step: Some(self.step),
            skipped: self.skipped,
            complete: true,
            sections,
            total: bytes.len() as u64,
            stages: Vec::new(),
        };
        let bytes = Bytes::from(bytes);
        let mut head = Some(head);
        // A state without values is one chunk without data.
        let starts = (0..bytes.len().max(1)).step_by(CHUNK_BYTES);
        let chunk = |start: usize| v1::StateChunk {
            head: head.take(),
            offset: start as u64,
            data: bytes.slice(start..bytes.len().min(start + CHUNK_BYTES)),
        };
        starts.map(chunk).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::*;
    use crate::scene::{Domain, Follow, SceneDescription};
    use crate::states::{StateDecoder, StateLayout};

    /// Domain 0 has 400,000 modes, domain 1 follows it without modes, and domain 2 shares the coordinates of domain 0.
    fn layout() -> Arc<StateLayout> {
        let identity = [1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0];
        let first = Domain { rank: 400_000, ..Domain::default() };
        let follow = Some(Follow { leader: 0, leader_from_follower: identity });
        let second = Domain { index: 1, follow, ..Domain::default() };
        let third = Domain { index: 2, rank: 400_000, shares_q_with: Some(0), ..Domain::default() };
        let info = v1::SceneInfo { domains: 3, ..Default::default() };
        let description = SceneDescription { info, domains: vec![first, second, third], ..SceneDescription::default() };
        StateLayout::new(&description).expect("a valid layout")
    }

    #[test]
    fn complete_state_is_decoded_without_a_difference() {
        let layout = layout();
        let state = SceneState {
            step: v1::StepId { run: 3, number: 7, time: 0.25 },
            skipped: 2,
            encoded_bytes: 0,
            stages: Vec::new(),
            layout: Arc::clone(&layout),
            q: (0..400_000).map(|number| number as f32).collect(),
            transforms: vec![[2.0; 12], [3.0; 12]],
            origins: vec![[1e7, 2.0, 3.0]],
        };
        let chunks = state.to_chunks();
        assert_eq!(chunks.len(), 2, "expected 1.6 MB in two chunks");
        let mut decoder = StateDecoder::new(&layout, 1 << 24);
        let states: Vec<_> =
            chunks.into_iter().filter_map(|chunk| decoder.add_chunk(chunk).expect("a valid chunk")).collect();
        let expected = SceneState { encoded_bytes: states[0].encoded_bytes, ..state };
        assert_eq!((states.len(), &*states[0]), (1, &expected));
    }
}
