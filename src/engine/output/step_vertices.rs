//! The vertices of a step and their packed sections. A section has the bytes of one attribute for the wire.

use std::sync::{Arc, Mutex};

use bytes::Bytes;
use tokio::sync::OnceCell;

use super::vertex_encoding::Encoding;
use super::vertex_selection::Attribute;
use crate::engine::lock::lock;
use modalcast_model::deform::DeformedSurface;

/// The vertices of a step. All readers share them, and share each packed section, which is computed once, on first use.
#[derive(Debug, Default)]
pub struct StepVertices {
    pub surface: Arc<DeformedSurface>,
    /// Milliseconds from the start of the copy to its completion.
    pub copy_ms: f64,
    /// At most one entry per key.
    packed_sections: Mutex<Vec<(SectionKey, SharedSection)>>,
}

/// What a packed section contains.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct SectionKey {
    pub(super) attribute: Attribute,
    pub(super) encoding: Encoding,
    pub(super) domains: Arc<[u32]>,
}

/// The bytes of a packed section.
#[derive(Debug, Clone)]
pub(super) struct PackedSection {
    /// One after the other.
    pub(super) parts: Vec<Bytes>,
    /// Milliseconds that packing took.
    pub(super) ms: f64,
}

/// Empty until the section is packed.
pub(super) type SharedSection = Arc<OnceCell<PackedSection>>;

impl StepVertices {
    /// Vertices without packed sections.
    pub(in crate::engine) fn new(surface: Arc<DeformedSurface>, copy_ms: f64) -> Self {
        Self { surface, copy_ms, packed_sections: Mutex::default() }
    }

    /// The cell for a packed section. The caller packs the section if the cell is empty.
    pub(super) fn packed_section(&self, key: SectionKey) -> SharedSection {
        let mut packed_sections = lock(&self.packed_sections);
        if let Some((_, section)) = packed_sections.iter().find(|(packed_key, _)| *packed_key == key) {
            return Arc::clone(section);
        }
        let section = SharedSection::default();
        packed_sections.push((key, Arc::clone(&section)));
        section
    }
}
